//! Signing in with a token, and out.
//!
//! The form's CSRF token is bound to a cookie of its own, since there is no session yet: another site can send the form,
//! but neither read nor set the cookie, so that nobody is signed in as somebody else.

use axum::body::Body;
use axum::extract::State;
use axum::http::header::{CONTENT_TYPE, LOCATION, SET_COOKIE};
use axum::http::{HeaderMap, HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use serde_json::json;

use super::{Visitor, html};
use crate::domain::{Secret, SecretDigest};
use crate::http::auth::{COOKIE_NAME, cookie};
use crate::http::body::{Limited, media_type, unsupported};
use crate::http::params::{NoParams, Params};
use crate::http::problem::{Answer, Problem};
use crate::http::{Shared, codes, json as body_json};
use crate::ui::sign_in::{self as ui, SignIn};

/// Cookie of the form.
const FORM_COOKIE: &str = "rigcast_sign_in";

/// Media type of a form's fields.
const FORM: &str = "application/x-www-form-urlencoded";

/// Largest form, bytes.
const MAX_FORM: u64 = 8 << 10;

/// `GET /sign-in`
pub async fn show(headers: HeaderMap, mut params: Params) -> Answer {
    let to = local(params.one("to")?);
    params.finish()?;
    form(&headers, to, None)
}

/// The page with the form, and the cookie that belongs to it.
fn form(headers: &HeaderMap, to: String, refused: Option<String>) -> Answer {
    let csrf = Secret::draw().map_err(Problem::internal)?;
    let page = ui::page(&SignIn { to, csrf: csrf.reveal().to_owned(), refused });
    let mut response = html(page)?;
    put_cookie(&mut response, headers, FORM_COOKIE, csrf.reveal(), "/sign-in", None)?;
    Ok(response)
}

/// `POST /sign-in`
pub async fn sign_in(State(http): State<Shared>, _: NoParams, headers: HeaderMap, body: Body) -> Answer {
    let fields = fields(&http, &headers, body).await?;
    let to = local(Some(field(&fields, "to")));
    let sent = cookie(&headers, FORM_COOKIE).map(|value| SecretDigest::of(value.as_bytes()));
    if !sent.is_some_and(|sent| sent.matches(&SecretDigest::of(field(&fields, "csrf").as_bytes()))) {
        return form(&headers, to, Some("The form was too old. Enter the token once more.".into()));
    }
    match http.auth.sign_in(field(&fields, "token").trim(), http.now()).await {
        Ok(id) => {
            let mut response = redirect(&to)?;
            put_cookie(&mut response, &headers, COOKIE_NAME, id.reveal(), "/", None)?;
            put_cookie(&mut response, &headers, FORM_COOKIE, "", "/sign-in", Some(0))?;
            Ok(response)
        }
        Err(problem) if problem.code() == codes::TOKEN_INVALID.name => {
            let refused = "No token in force has this secret: it is mistyped, was revoked, or has expired.";
            form(&headers, to, Some(refused.into()))
        }
        Err(problem) => Err(problem),
    }
}

/// `POST /sign-out`
pub async fn sign_out(State(http): State<Shared>, _: NoParams, headers: HeaderMap, body: Body) -> Answer {
    let fields = fields(&http, &headers, body).await?;
    http.auth.sign_out(&headers, &field(&fields, "csrf"), http.now())?;
    let mut response = redirect("/sign-in")?;
    put_cookie(&mut response, &headers, COOKIE_NAME, "", "/", Some(0))?;
    Ok(response)
}

/// `GET /session`: the CSRF token of the session, for a page that was opened in another one.
pub async fn session(visitor: Visitor, _: NoParams) -> Answer {
    body_json::answer(&json!({"csrf": visitor.shown.csrf}))
}

/// `GET /signed-in`
pub async fn signed_in(_: NoParams) -> Answer {
    html(ui::done())
}

/// The fields of a form.
async fn fields(http: &Shared, headers: &HeaderMap, body: Body) -> Answer<Vec<(String, String)>> {
    let found = media_type(headers);
    if found.as_deref() != Some(FORM) {
        return Err(unsupported(found.as_deref(), &[FORM]));
    }
    let bytes = Limited::new(headers, body, MAX_FORM, http.limits.pace)?.collect().await?;
    Ok(form_urlencoded::parse(&bytes).into_owned().collect())
}

fn field(fields: &[(String, String)], name: &str) -> String {
    fields.iter().find(|(key, _)| key == name).map(|(_, value)| value.clone()).unwrap_or_default()
}

/// An address inside the service; `/` in place of any other, so that a link cannot lead elsewhere by way of the form.
fn local(to: Option<String>) -> String {
    let to = to.unwrap_or_default();
    let inside = to.starts_with('/')
        && !to.starts_with("//")
        && to.bytes().all(|byte| byte.is_ascii_graphic() && byte != b'\\')
        && to.len() < 2000;
    if inside { to } else { "/".into() }
}

fn redirect(to: &str) -> Answer {
    let to = HeaderValue::try_from(to).map_err(Problem::internal)?;
    Ok((StatusCode::SEE_OTHER, [(LOCATION, to), (CONTENT_TYPE, HeaderValue::from_static("text/plain"))])
        .into_response())
}

/// Sets a cookie that scripts cannot read and other sites cannot cause to be sent; `Secure` where a proxy says that the
/// browser speaks TLS.
fn put_cookie(
    response: &mut Response,
    headers: &HeaderMap,
    name: &str,
    value: &str,
    path: &str,
    max_age_s: Option<u32>,
) -> Answer<()> {
    let secure = if is_tls(headers) { "; Secure" } else { "" };
    let age = max_age_s.map(|s| format!("; Max-Age={s}")).unwrap_or_default();
    let text = format!("{name}={value}; Path={path}; HttpOnly; SameSite=Strict{secure}{age}");
    response.headers_mut().append(SET_COOKIE, HeaderValue::try_from(text).map_err(Problem::internal)?);
    Ok(())
}

/// Whether a proxy says that the browser speaks TLS with it.
fn is_tls(headers: &HeaderMap) -> bool {
    let has = |name: &str, wanted: &str| {
        headers
            .get(name)
            .and_then(|value| value.to_str().ok())
            .is_some_and(|value| value.to_ascii_lowercase().contains(wanted))
    };
    has("x-forwarded-proto", "https") || has("forwarded", "proto=https")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_form_leads_back_into_the_service_only() {
        for to in ["/", "/rigs/a?x=1", "/jobs"] {
            assert_eq!(local(Some(to.into())), to);
        }
        for to in ["", "//evil.lab", "https://evil.lab", "/\\evil.lab", "/a\r\nb", "evil", "/ä"] {
            assert_eq!(local(Some(to.into())), "/", "{to:?}");
        }
        assert_eq!(local(None), "/");
    }

    #[test]
    fn cookies_are_secure_behind_tls_and_never_seen_by_scripts() {
        let mut headers = HeaderMap::new();
        let cookie = |headers: &HeaderMap| {
            let mut response = Response::new(Body::empty());
            put_cookie(&mut response, headers, "a", "b", "/", None).unwrap();
            response.headers()[SET_COOKIE].to_str().unwrap().to_owned()
        };
        assert_eq!(cookie(&headers), "a=b; Path=/; HttpOnly; SameSite=Strict");
        headers.insert("x-forwarded-proto", HeaderValue::from_static("https"));
        assert!(cookie(&headers).ends_with("; Secure"));
    }
}
