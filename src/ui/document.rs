//! The HTML around every page: head, style and body, complete in itself, without scripts and other files.

use maud::{DOCTYPE, Markup, PreEscaped, html};

/// A page with this title, style and main part.
pub(super) fn document(title: &str, style: &str, main: &Markup) -> String {
    html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                meta name="color-scheme" content="light dark";
                title { (title) }
                style { (PreEscaped(style)) }
            }
            body { main { (main) } }
        }
    }
    .into_string()
}
