//! The HTML around every page: head, navigation, and the form to sign out.

use maud::{DOCTYPE, Markup, html};

use super::assets;
use super::words::clamped;
use crate::domain::TokenRole;

/// The person who looks at a page.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Visitor {
    /// Name of the token, with or without letters; `None` while the service is open to this machine.
    pub token: Option<String>,
    /// What the person may do.
    pub role: TokenRole,
    /// Whether the token is for all rigs.
    pub all_rigs: bool,
    /// Text that every form repeats; empty without a session.
    pub csrf: String,
}

impl Visitor {
    /// Whether the person may do what takes this role.
    pub fn may(&self, role: TokenRole) -> bool {
        self.role >= role
    }
}

/// Part of the navigation that a page belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Section {
    /// Rigs and what belongs to them.
    Rigs,
    /// Jobs.
    Jobs,
    /// Tokens.
    Tokens,
    /// Operations.
    Operations,
    /// Documentation.
    Docs,
    /// None of them.
    Elsewhere,
}

/// What stands around the content of a page.
#[derive(Debug)]
pub struct Frame<'a> {
    /// Title of the window.
    pub title: &'a str,
    /// Part of the navigation.
    pub section: Section,
    /// The way to the page: addresses and names of the pages above it.
    pub way: Vec<(String, String)>,
    /// Who looks; nobody on the pages before signing in.
    pub visitor: Option<&'a Visitor>,
    /// Class of the main part.
    pub class: &'static str,
    /// Scripts that it loads.
    pub scripts: &'a [&'a str],
}

impl<'a> Frame<'a> {
    /// A page of the navigation's part `section`.
    pub fn new(title: &'a str, section: Section, visitor: &'a Visitor) -> Self {
        let visitor = Some(visitor);
        Self { title, section, way: Vec::new(), visitor, class: "", scripts: &["forms.js", "figures.js"] }
    }

    /// The same below these pages.
    pub fn below(mut self, way: &[(String, &str)]) -> Self {
        self.way = way.iter().map(|(address, name)| (address.clone(), (*name).to_owned())).collect();
        self
    }

    /// The page with this content.
    pub fn page(&self, main: &Markup) -> String {
        let csrf = self.visitor.map_or("", |visitor| &visitor.csrf);
        html! {
            (DOCTYPE)
            html lang="en" {
                head {
                    meta charset="utf-8";
                    meta name="viewport" content="width=device-width, initial-scale=1";
                    meta name="color-scheme" content="light dark";
                    meta name="csrf" content=(csrf);
                    title { (self.title) " · Rigcast" }
                    link rel="icon" href="data:,";
                    link rel="stylesheet" href=(assets::path("style.css"));
                    @for script in self.scripts { script type="module" src=(assets::path(script)) {} }
                }
                body {
                    a.skip href="#main" { "To the content" }
                    (self.top())
                    main #main class=(self.class) {
                        @if !self.way.is_empty() {
                            nav aria-label="The way here" {
                                p.crumbs {
                                    @for (address, name) in &self.way { a href=(address) { (clamped(name)) } " › " }
                                }
                            }
                        }
                        (main)
                    }
                }
            }
        }
        .into_string()
    }

    fn top(&self) -> Markup {
        let link = |section: Section, address: &str, name: &str| {
            let current = (self.section == section).then_some("page");
            html! { a href=(address) aria-current=[current] { (name) } }
        };
        html! {
            header.top {
                div {
                    a.brand href="/" { "Rigcast" }
                    @if let Some(visitor) = self.visitor {
                        nav aria-label="Parts of the service" {
                            (link(Section::Rigs, "/", "Rigs"))
                            (link(Section::Jobs, "/jobs", "Jobs"))
                            @if visitor.may(TokenRole::Admin) && visitor.all_rigs { (link(Section::Tokens, "/tokens", "Tokens")) }
                            (link(Section::Operations, "/operations", "Operations"))
                            (link(Section::Docs, "/docs", "Documentation"))
                        }
                        div.who { (who(visitor)) }
                    }
                }
            }
        }
    }
}

fn who(visitor: &Visitor) -> Markup {
    html! {
        @match &visitor.token {
            Some(name) => {
                (clamped(if name.is_empty() { "Token without a name" } else { name }))
                span { "(" (visitor.role.as_str()) ")" }
                @if !visitor.csrf.is_empty() {
                    form method="post" action="/sign-out" {
                        input type="hidden" name="csrf" value=(visitor.csrf);
                        button.plain type="submit" { "Sign out" }
                    }
                }
            }
            None => span { "Open to this machine: there is no token yet" },
        }
    }
}

/// The hidden field of a form's CSRF token.
pub(super) fn csrf(visitor: &Visitor) -> Markup {
    html! { input type="hidden" name="csrf" value=(visitor.csrf); }
}

/// A document that is complete in itself, for saving: no navigation, no scripts, its style inside.
pub fn alone(title: &str, main: &Markup) -> String {
    html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                meta name="color-scheme" content="light dark";
                title { (title) }
                style { (maud::PreEscaped(assets::STYLE)) }
            }
            body { main.report { (main) } }
        }
    }
    .into_string()
}
