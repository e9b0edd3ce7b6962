//! Tokens: who may do what, and for how long.

use maud::html;

use super::frame::{Frame, Section, Visitor, csrf};
use super::words::{self, clamped, minute};
use crate::domain::{Token, TokenRole};

/// The page.
pub fn page(visitor: &Visitor, tokens: &[Token], more: bool) -> String {
    let main = html! {
        h1 { "Tokens" }
        p { "Programs and people sign in with a token. A reader sees and predicts. An operator also uploads, fits and activates. An admin also deletes, and makes tokens." }
        @if tokens.is_empty() {
            div.empty {
                p { b { "There is no token yet: the service is open to everybody on this machine." } }
                p { "The first one must be an admin's for all rigs. Keep its secret: from then on nobody gets in without a token, you neither." }
            }
        } @else {
            div.wide { table.full {
                thead { tr { th { "Name" } th { "Role" } th { "Rigs" } th { "Made" } th { "Expires" } th { "" } } }
                tbody { @for token in tokens { tr {
                    td { (clamped(if token.name.is_empty() { "without a name" } else { &token.name })) }
                    td { (token.role.as_str()) }
                    td { @match &token.rigs { Some(rigs) => (rigs.iter().map(|rig| rig.as_str()).collect::<Vec<_>>().join(", ")), None => "all" } }
                    td.soft { (minute(&token.created_at)) }
                    td { @match &token.expires_at { Some(at) => (minute(at)), None => "never" } }
                    td.number { form data-api={ "DELETE /v1/tokens/" (token.id) } data-confirm="Revoke this token? Nobody can use it from then on." {
                        (csrf(visitor)) button.grave type="submit" { "Revoke" }
                    } }
                } } }
            } }
            @if more { p.soft { "There are more: " code { "GET /v1/tokens" } " lists all." } }
        }
        div.empty.hidden #secret tabindex="-1" role="status" {
            p { b { "The secret of the new token. It is shown this once:" } }
            p { code {} }
            p { a.button href="/tokens" { "I have kept it" } }
        }
        h2 { "Make a token" }
        form.fields.broad data-api="POST /v1/tokens" data-then="secret" data-shown="#secret" {
            (csrf(visitor))
            div.row {
                label { "Name" input name="name" required maxlength="1000"; span.soft { "whose, or for what" } }
                label { "Role" select name="role" {
                    @for role in [TokenRole::Reader, TokenRole::Operator, TokenRole::Admin] {
                        option value=(role.as_str()) selected[tokens.is_empty() && role == TokenRole::Admin] { (role.as_str()) }
                    }
                } }
                label { "Rigs" input name="rigs" data-as="list"; span.soft { "ids, separated by commas; empty: all" } }
                label { "Expires" input type="datetime-local" name="expires_at" data-as="time"; span.soft { "empty: never" } }
            }
            div { button.main type="submit" { "Make the token" } }
        }
    };
    let mut frame = Frame::new("Tokens", Section::Tokens, visitor);
    frame.scripts = &["forms.js"];
    frame.page(&main)
}

/// Depths of queues, workers and health, as the readiness report has them.
#[derive(Debug, Clone, PartialEq)]
pub struct Operations {
    /// Whether the store has room for more.
    pub has_room: bool,
    /// Class of traffic, requests in work, requests that wait.
    pub queues: Vec<(String, u64, u64)>,
    /// State of jobs, and how many there are.
    pub jobs: Vec<(String, u64)>,
    /// Models in memory.
    pub loaded_models: u64,
    /// Models, runs and reports that could not be read: rig and reason.
    pub degraded: Vec<(String, String)>,
    /// Objects that were put aside.
    pub quarantined: usize,
    /// Version of the program.
    pub version: String,
}

/// The page of operations.
pub fn operations(visitor: &Visitor, of: &Operations) -> String {
    let healthy = of.has_room && of.degraded.is_empty();
    let main = html! {
        h1 { "Operations" }
        p {
            @if healthy { span.tag.good { "ready" } " Nothing is wrong." }
            @else if !of.has_room { span.tag.bad { "full" } " The disk is full: only deletions and changes of the active model are taken." }
            @else { span.tag.bad { "degraded" } " Some stored data cannot be read; the rest works." }
        }
        @for (rig, reason) in &of.degraded { p.notes { a href={ "/rigs/" (rig) } { (rig) } ": " (reason) } }
        @if of.quarantined > 0 { p { (words::count(of.quarantined, "object", "objects")) " that no row names are in quarantine." } }
        div.cards {
            section.card { h2 { "Requests" }
                table.full { thead { tr { th { "Class" } th.number { "In work" } th.number { "Waiting" } } }
                    tbody { @for (class, in_use, waiting) in &of.queues { tr { td { (class) } td.number { (in_use) } td.number { (waiting) } } } } }
            }
            section.card { h2 { "Jobs" }
                table.full { thead { tr { th { "State" } th.number { "Jobs" } } }
                    tbody { @for (state, n) in &of.jobs { tr { td { (state) } td.number { (n) } } } } }
                p { a href="/jobs" { "All jobs" } }
            }
            section.card { h2 { "Program" }
                dl { dt { "Version" } dd { (of.version) } dt { "Models in memory" } dd { (of.loaded_models) } }
                p { a href="/readyz?verbose" { "Readiness for programs" } " · " a href="/metrics" { "Metrics for Prometheus" } " · " a href="/openapi.yaml" { "Contract" } }
            }
        }
    };
    let mut frame = Frame::new("Operations", Section::Operations, visitor);
    frame.scripts = &[];
    frame.page(&main)
}

/// The page that holds the documentation of the API.
pub fn docs(visitor: Option<&Visitor>) -> String {
    let main = html! {
        link rel="stylesheet" href="/docs/swagger-ui.css";
        script src="/docs/swagger-ui-bundle.js" {}
        div #swagger-ui {}
        noscript { p { "The documentation needs scripts; " a href="/openapi.yaml" { "the contract" } " is a plain file." } }
    };
    Frame {
        title: "Documentation",
        section: Section::Docs,
        way: Vec::new(),
        visitor,
        class: "docs",
        scripts: &["docs.js"],
    }
    .page(&main)
}
