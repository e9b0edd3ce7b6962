//! A figure of a page by itself: as a part of the page, which its script puts in place, or as a file.

use axum::http::header::{CONTENT_DISPOSITION, CONTENT_TYPE};
use axum::http::{HeaderMap, HeaderValue};
use axum::response::IntoResponse;

use crate::http::params::{Params, invalid};
use crate::http::problem::Answer;
use crate::ui::figures::Drawing;

/// Widths of pictures, pixels.
const WIDTHS: std::ops::RangeInclusive<f64> = 200.0..=4000.0;

/// Width of the page's main part on a screen of 1280 pixels.
const WIDTH: f64 = 1200.0;

/// A form of a figure.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Form {
    Part,
    Svg,
    Csv,
}

/// The figure that a request asks for, if it asks for one, and the view of it.
#[derive(Debug, Clone, PartialEq)]
pub struct FigureQuery {
    /// Its name.
    pub name: Option<String>,
    form: Form,
    /// Width of the picture, pixels.
    pub width: f64,
    /// Range of time, s.
    pub range: [Option<f64>; 2],
}

impl FigureQuery {
    /// Takes `figure`, `as`, `width`, `from_s` and `to_s`.
    ///
    /// # Errors
    /// `query.invalid`
    pub fn take(params: &mut Params) -> Answer<Self> {
        let form = match params.one("as")?.as_deref() {
            None | Some("part") => Form::Part,
            Some("svg") => Form::Svg,
            Some("csv") => Form::Csv,
            Some(other) => return Err(invalid("as", format!("is {other:?}"), "part, svg or csv")),
        };
        let limit = format!("a number of pixels from {} to {}", WIDTHS.start(), WIDTHS.end());
        let width = params.number("width", &limit)?.unwrap_or(WIDTH);
        if !WIDTHS.contains(&width) {
            return Err(invalid("width", format!("is {width}"), &limit));
        }
        let seconds = "a number of seconds";
        let range = [params.number("from_s", seconds)?, params.number("to_s", seconds)?];
        Ok(Self { name: params.one("figure")?, form, width, range })
    }

    /// The figure as it was asked for; `file` begins the name of the file.
    pub fn answer(&self, drawing: &Drawing, file: &str) -> Answer {
        let (body, kind, ending) = match self.form {
            Form::Part => return super::html(drawing.part().into_string()),
            Form::Svg => (drawing.svg(), "image/svg+xml", "svg"),
            Form::Csv => (drawing.csv(), "text/csv; charset=utf-8", "csv"),
        };
        // Names of rigs and figures are letters, digits, `-` and `_`.
        let name: String = self
            .name
            .iter()
            .flat_map(|name| name.chars())
            .filter(|c| c.is_ascii_alphanumeric() || *c == '_')
            .collect();
        let mut head = HeaderMap::new();
        head.insert(CONTENT_TYPE, HeaderValue::from_static(kind));
        if let Ok(value) = HeaderValue::try_from(format!("attachment; filename=\"{file}-{name}.{ending}\"")) {
            head.insert(CONTENT_DISPOSITION, value);
        }
        Ok((head, body).into_response())
    }

    /// The refusal of a figure that the page does not have.
    pub fn unknown(&self, known: &str) -> crate::http::problem::Problem {
        invalid("figure", format!("is {:?}", self.name.as_deref().unwrap_or_default()), known)
    }
}
