//! The page of a request that was refused or failed.

use maud::html;

use super::frame::{Frame, Section, Visitor};

/// A problem in words.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Refusal<'a> {
    /// Title of its kind.
    pub title: &'a str,
    /// HTTP status.
    pub status: u16,
    /// Description of this case.
    pub detail: &'a str,
    /// Stable code.
    pub code: &'a str,
    /// Id of the request, under which the log has it.
    pub request_id: &'a str,
}

/// The page; with the navigation for somebody who is known.
pub fn page(of: &Refusal<'_>, visitor: Option<&Visitor>) -> String {
    let main = html! {
        h1 { (of.title) }
        div.refused role="alert" { p { (of.detail) } }
        p {
            @match of.status {
                404 | 410 => "It may have been deleted, or the address is mistyped.",
                401 | 403 => "Sign in with another token, or ask for one with the right that this takes.",
                429 | 503 | 507 => "Wait a moment, then load the page again.",
                _ => "Go back, change what was refused, and try again.",
            }
        }
        p.actions {
            a.button href="/" { "To the rigs" }
            @if matches!(of.status, 401 | 403) { a.button href="/sign-in" { "Sign in" } }
        }
        p.soft { "Request " code { (of.request_id) } " (" (of.code) ")" }
    };
    let frame = Frame {
        title: of.title,
        section: Section::Elsewhere,
        way: Vec::new(),
        visitor,
        class: "narrow",
        scripts: &[],
    };
    frame.page(&main)
}
