//! The page that a browser gets at the service's root: what is there, and where to go on.

use maud::{Markup, html};

use super::document::document;

/// Style of the page; the only thing beside its text.
pub const STYLE: &str = include_str!("style.css");

/// What the page says.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Start {
    /// Version of the program, for those who may see the rigs.
    pub version: String,
    /// Rigs that may be seen; `None` where the request may see none.
    pub rigs: Option<Rigs>,
}

/// Rigs, as many as the page has room for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Rigs {
    /// In the order of their ids.
    pub items: Vec<Rig>,
    /// Whether there are more.
    pub more: bool,
}

/// A rig with the model that answers for it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Rig {
    /// Id, a slug.
    pub id: String,
    /// Name, any text.
    pub name: String,
    /// Version and kind of the active model, if there is one.
    pub active: Option<(u32, String)>,
}

/// Pages and documents of the service: path, name, what is there.
const LINKS: [(&str, &str, &str); 4] = [
    ("/docs", "Documentation", "every operation, with a form to try it"),
    ("/openapi.yaml", "Contract", "OpenAPI 3.1, for programs"),
    ("/readyz?verbose", "Readiness", "store, queues and jobs"),
    ("/metrics", "Metrics", "for Prometheus"),
];

/// The page as HTML, complete in itself: no scripts, no other files.
pub fn page(of: &Start) -> String {
    let main = html! {
        h1 { "Rigcast" }
        p.soft { "Prediction service for fatigue test rigs" }
        h2 { "Rigs" }
        @match &of.rigs {
            Some(rigs) => (table(rigs)),
            None => p {
                "This request may not see the rigs. The service wants a token in the header "
                code { "Authorization: Bearer …" }
                "; as long as no token was ever made, it answers to this machine alone."
            },
        }
        h2 { "More" }
        dl {
            @for (path, name, what) in LINKS {
                dt { a href=(path) { (name) } }
                dd { (what) }
            }
        }
        @if of.rigs.is_some() { p.soft { "Version " (of.version) } }
    };
    document("Rigcast", STYLE, &main)
}

fn table(rigs: &Rigs) -> Markup {
    if rigs.items.is_empty() {
        return html! {
            p { "There is no rig yet. " code { "POST /v1/rigs" } " makes one; the documentation has a form for it." }
        };
    }
    html! {
        table {
            thead { tr { th { "Rig" } th { "Id" } th { "Active model" } } }
            tbody {
                @for rig in &rigs.items {
                    @let path = format!("/v1/rigs/{}", rig.id);
                    tr {
                        td { a href=(path) { (rig.name) } }
                        td { (rig.id) }
                        td {
                            @match &rig.active {
                                Some((version, kind)) => {
                                    a href={ (path) "/models/" (version) } { "Version " (version) }
                                    " (" (kind) ")"
                                }
                                None => span.soft { "none" },
                            }
                        }
                    }
                }
            }
        }
        @if rigs.more { p { "There are more: " a href="/v1/rigs" { "/v1/rigs" } " lists all." } }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn start(rigs: Option<Vec<Rig>>) -> Start {
        Start { version: "1.2.3".into(), rigs: rigs.map(|items| Rigs { items, more: false }) }
    }

    #[test]
    fn rigs_are_named_with_their_active_models_and_names_are_text() {
        let hostile = "<script>alert(1)</script>\" onmouseover=\"x";
        let rig = |id: &str, active| Rig { id: id.into(), name: hostile.into(), active };
        let html = page(&start(Some(vec![rig("a", Some((3, "hybrid2".into()))), rig("b", None)])));
        assert!(!html.contains("<script") && !html.contains("\" onmouseover"), "{html}");
        assert!(html.contains("&lt;script&gt;alert(1)"), "{html}");
        assert!(html.contains(r#"<a href="/v1/rigs/a/models/3">Version 3</a> (hybrid2)"#), "{html}");
        assert!(html.contains("1.2.3"), "{html}");
    }

    #[test]
    fn a_request_that_may_see_no_rigs_is_told_what_it_needs_and_nothing_of_the_service() {
        let html = page(&start(None));
        assert!(html.contains("Authorization: Bearer") && !html.contains("1.2.3"), "{html}");
        let html = page(&start(Some(Vec::new())));
        assert!(html.contains("There is no rig yet"), "{html}");
    }

    #[test]
    fn every_link_stays_in_the_service() {
        let rig = Rig { id: "a".into(), name: "A".into(), active: Some((1, "frf".into())) };
        let html = page(&start(Some(vec![rig])));
        let links: Vec<&str> =
            html.split("href=\"").skip(1).filter_map(|rest| rest.split('"').next()).collect();
        assert!(links.len() >= 6 && links.iter().all(|link| link.starts_with('/')), "{links:?}");
        assert!(!html.contains("src=") && !html.contains("style="), "{html}");
    }
}
