//! Query parameters: each is taken by name; parameters that are left over are refused.

use std::fmt::Display;
use std::str::FromStr;

use axum::extract::{FromRequestParts, Query};
use axum::http::request::Parts;
use percent_encoding::percent_decode_str;

use super::codes;
use super::problem::{Answer, FieldError, Problem};
use crate::domain::page::{DEFAULT_LIMIT, MAX_LIMIT};
use crate::domain::{Cursor, PageRequest};

/// The parameters of a request that were not taken yet.
#[derive(Debug)]
pub struct Params(Vec<(String, String)>);

/// For operations without parameters: any is refused.
#[derive(Debug)]
pub struct NoParams;

impl Params {
    /// No parameters.
    pub fn none() -> Self {
        Self(Vec::new())
    }

    /// Adds the fields of a form, each of which is a parameter in another place. The same values in both places count
    /// once.
    ///
    /// # Errors
    /// `form.invalid` where the query has other values under a field's name.
    pub fn add_fields(&mut self, fields: Vec<(String, String)>) -> Answer<()> {
        let values = |of: &[(String, String)], name: &str| -> Vec<String> {
            of.iter().filter(|(key, _)| key == name).map(|(_, value)| value.clone()).collect()
        };
        for (name, _) in &fields {
            let in_query = values(&self.0, name);
            if !in_query.is_empty() && in_query != values(&fields, name) {
                let detail = format!("The query and the form give different values for {name}.");
                return Err(Problem::new(codes::FORM_INVALID, detail)
                    .with(FieldError::new(format!("?{name}"), "in one of them, or alike in both")));
            }
        }
        let added: Vec<_> = fields.into_iter().filter(|(name, _)| values(&self.0, name).is_empty()).collect();
        self.0.extend(added);
        Ok(())
    }

    /// Takes all values of a parameter that may be repeated.
    pub fn all(&mut self, name: &str) -> Vec<String> {
        self.0.extract_if(.., |(key, _)| key == name).map(|(_, value)| value).collect()
    }

    /// Takes a parameter that may be given once.
    ///
    /// # Errors
    /// `query.invalid` when it is repeated.
    pub fn one(&mut self, name: &str) -> Answer<Option<String>> {
        let mut values = self.all(name);
        match values.len() {
            0 | 1 => Ok(values.pop()),
            n => Err(invalid(name, format!("is given {n} times"), "once")),
        }
    }

    /// Takes and parses a parameter; `limit` names the allowed values in words.
    ///
    /// # Errors
    /// `query.invalid` when it is repeated or is no `T`.
    pub fn parse<T: FromStr>(&mut self, name: &str, limit: &str) -> Answer<Option<T>> {
        self.one(name)?
            .map(|text| text.parse().map_err(|_| invalid(name, format!("is {text:?}"), limit)))
            .transpose()
    }

    /// Takes a parameter that is a finite number.
    ///
    /// # Errors
    /// `query.invalid` for anything else.
    pub fn number(&mut self, name: &str, limit: &str) -> Answer<Option<f64>> {
        let value = self.parse::<f64>(name, limit)?;
        match value {
            Some(v) if !v.is_finite() => Err(invalid(name, format!("is {v}"), limit)),
            value => Ok(value),
        }
    }

    /// Takes a parameter that is `true` or `false`; without a value it is true.
    ///
    /// # Errors
    /// `query.invalid` for anything else.
    pub fn flag(&mut self, name: &str) -> Answer<bool> {
        match self.one(name)?.as_deref() {
            None | Some("false") => Ok(false),
            Some("" | "true") => Ok(true),
            Some(other) => Err(invalid(name, format!("is {other:?}"), "true or false")),
        }
    }

    /// Refuses the parameters that were not taken.
    ///
    /// # Errors
    /// `query.unknown_parameter` naming the first that is left.
    pub fn finish(self) -> Answer<()> {
        match self.0.first() {
            None => Ok(()),
            Some((name, _)) => {
                let detail = format!("There is no query parameter {name:?} here.");
                Err(Problem::new(codes::QUERY_UNKNOWN_PARAMETER, detail).with_all(self.0.iter().map(
                    |(name, _)| FieldError::new(format!("?{name}"), "not a parameter of this operation"),
                )))
            }
        }
    }
}

/// Takes `limit` and `cursor`, the parameters of every list.
///
/// # Errors
/// `query.invalid` for a limit out of range or a cursor that the service did not make.
pub fn page(params: &mut Params) -> Answer<PageRequest> {
    let limit = limit(params)?;
    let cursor = params
        .one("cursor")?
        .map(|text| {
            Cursor::parse(&text)
                .map_err(|_| invalid("cursor", "is none", "the `next` of a page of this list"))
        })
        .transpose()?;
    Ok(PageRequest { limit, cursor })
}

/// Takes `limit`, the most items that an answer has.
///
/// # Errors
/// `query.invalid` for a limit out of range.
pub fn limit(params: &mut Params) -> Answer<u32> {
    let range = format!("a number from 1 to {MAX_LIMIT}");
    let limit = params.parse::<u32>("limit", &range)?.unwrap_or(DEFAULT_LIMIT);
    if !(1..=MAX_LIMIT).contains(&limit) {
        return Err(invalid("limit", format!("is {limit}"), &range));
    }
    Ok(limit)
}

/// The refusal of a parameter's value.
pub fn invalid(name: &str, found: impl Display, limit: &str) -> Problem {
    Problem::new(codes::QUERY_INVALID, format!("Query parameter {name} {found}; it must be {limit}."))
        .with(FieldError::new(format!("?{name}"), limit))
}

impl<S: Send + Sync> FromRequestParts<S> for Params {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Problem> {
        if let Some(name) = parts.uri.query().and_then(not_utf8) {
            let detail = format!("Query parameter {name} is no UTF-8 text.");
            return Err(Problem::new(codes::REQUEST_MALFORMED, detail)
                .with(FieldError::new(format!("?{name}"), "percent-encoded UTF-8")));
        }
        Query::<Vec<(String, String)>>::try_from_uri(&parts.uri)
            .map(|Query(pairs)| Self(pairs))
            .map_err(|e| Problem::new(codes::REQUEST_MALFORMED, format!("The query cannot be read: {e}.")))
    }
}

/// The first parameter of a query whose name or value is no UTF-8. The parser would put U+FFFD in place of its bytes.
fn not_utf8(query: &str) -> Option<String> {
    let pair = query.split('&').find(|pair| percent_decode_str(pair).decode_utf8().is_err())?;
    let (name, _) = form_urlencoded::parse(pair.as_bytes()).next()?;
    Some(name.into_owned())
}

impl<S: Send + Sync> FromRequestParts<S> for NoParams {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Problem> {
        Params::from_request_parts(parts, state).await?.finish().map(|()| Self)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    async fn params(query: &str) -> Params {
        let request = axum::http::Request::get(format!("/?{query}")).body(()).expect("a request");
        Params::from_request_parts(&mut request.into_parts().0, &()).await.expect("a query")
    }

    #[test]
    fn a_parameter_that_is_no_utf8_is_found() {
        assert_eq!(not_utf8("name=%ff"), Some("name".into()));
        assert_eq!(not_utf8("kind=noise&name=a%C3&x=1"), Some("name".into()));
        assert_eq!(not_utf8("name=%C3%BC+%EF%BF%BD&tag=%ef%bf%bd"), None);
        assert_eq!(not_utf8(""), None);
    }

    #[tokio::test]
    async fn what_nobody_took_is_refused_by_name() {
        let mut params = params("tag=a&tag=b%20c&limt=3").await;
        assert_eq!(params.all("tag"), ["a", "b c"]);
        let problem = params.finish().expect_err("limt is unknown");
        assert_eq!(problem.code(), codes::QUERY_UNKNOWN_PARAMETER.name);
        assert!(String::from_utf8(problem.document("")).expect("text").contains("?limt"));
    }

    #[tokio::test]
    async fn fields_of_a_form_join_the_query_where_both_agree() {
        let field = |name: &str, value: &str| (name.to_owned(), value.to_owned());
        let mut both = params("tag=a&tag=b&kind=noise").await;
        let fields = vec![field("tag", "a"), field("name", "n"), field("tag", "b"), field("ignore", "x")];
        both.add_fields(fields).expect("they agree");
        assert_eq!((both.all("tag").len(), both.all("name").len(), both.all("kind").len()), (2, 1, 1));
        for differing in [vec![field("tag", "b"), field("tag", "a")], vec![field("tag", "a")]] {
            let problem = params("tag=a&tag=b").await.add_fields(differing).expect_err("they differ");
            assert_eq!(problem.code(), codes::FORM_INVALID.name);
        }
    }

    #[tokio::test]
    async fn repeated_and_senseless_values_are_refused() {
        assert!(params("a=1&a=2").await.one("a").is_err());
        assert!(params("a=x").await.parse::<u32>("a", "a number").is_err());
        for value in ["nan", "inf", "1e999", ""] {
            assert!(params(&format!("a={value}")).await.number("a", "a number").is_err(), "{value}");
        }
        assert_eq!(params("a=1.5").await.number("a", "a number").expect("a number"), Some(1.5));
        assert!(params("verbose").await.flag("verbose").expect("a flag"));
        assert!(params("verbose=perhaps").await.flag("verbose").is_err());
    }
}
