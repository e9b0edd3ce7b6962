//! The first page: the rigs, and the form to make one.

use maud::{Markup, html};

use super::frame::{Frame, Section, Visitor, csrf};
use super::text::percent;
use super::words::{clamped, count};
use crate::domain::{Rig, TokenRole};

/// A rig with what a person wants to know first.
#[derive(Debug, Clone, PartialEq)]
pub struct Row {
    /// The rig.
    pub rig: Rig,
    /// Version and kind of the active model, and its error on data that compared it.
    pub active: Option<Active>,
    /// Jobs that wait or run.
    pub jobs: usize,
}

/// The active model in a row.
#[derive(Debug, Clone, PartialEq)]
pub struct Active {
    /// Version.
    pub version: u32,
    /// Kind, in words.
    pub kind: String,
    /// Mean over the outputs of the RMS error on the data that compare models.
    pub rms: Option<f64>,
    /// When it was made, as people read it.
    pub when: String,
}

/// The page of these rigs; `next` is the address of further ones.
pub fn page(visitor: &Visitor, rows: &[Row], next: Option<&str>, version: &str) -> String {
    let main = html! {
        div.head {
            div {
                h1 { "Rigs" }
                p.soft { "Predictions of what a test rig answers to a drive, from models of its own measurements." }
            }
            @if visitor.may(TokenRole::Operator) { p.actions { a.button.main href="#make" { "Make a rig" } } }
        }
        @if rows.is_empty() { (empty(visitor)) } @else { (table(rows)) }
        @if let Some(next) = next { p { a href=(next) { "Further rigs" } } }
        @if visitor.may(TokenRole::Operator) {
            h2 #make { "Make a rig" }
            (form(visitor))
        }
        p.soft { "Rigcast " (version) }
    };
    Frame::new("Rigs", Section::Rigs, visitor).page(&main)
}

fn empty(visitor: &Visitor) -> Markup {
    html! {
        div.empty {
            p { b { "There is no rig yet." } }
            @if visitor.may(TokenRole::Operator) {
                p { "Make one below: its sample rate, and its channels as your measurement files name them. Then upload two noise runs, and fit a model." }
            } @else {
                p { "Somebody with the role operator makes one; or your token is limited to rigs that do not exist yet." }
            }
        }
    }
}

fn table(rows: &[Row]) -> Markup {
    html! {
        div.wide {
            table.full {
                thead { tr {
                    th { "Rig" } th { "Channels" } th { "Active model" } th.number { "Error on validation data" } th { "Work" }
                } }
                tbody {
                    @for Row { rig, active, jobs } in rows {
                        tr {
                            td {
                                a href={ "/rigs/" (rig.id) } { (clamped(&rig.name)) }
                                @if rig.name != rig.id.as_str() { br; span.soft { (rig.id) } }
                            }
                            td { (count(rig.drives().count(), "drive", "drives")) ", " (count(rig.responses().count(), "response", "responses")) }
                            td {
                                @match active {
                                    Some(active) => {
                                        a href={ "/rigs/" (rig.id) "/models/" (active.version) } { "Version " (active.version) }
                                        " (" (active.kind) ")" br; span.soft { "of " (active.when) }
                                    }
                                    None => span.soft { "none: upload runs, then fit one" },
                                }
                            }
                            td.number {
                                @match active.as_ref().and_then(|active| active.rms) {
                                    Some(rms) => (percent(rms)),
                                    None => span.soft { "–" },
                                }
                            }
                            td { @if *jobs > 0 { a href={ "/jobs?rig=" (rig.id) } { span.tag.busy { (count(*jobs, "job", "jobs")) } } } @else { span.soft { "idle" } } }
                        }
                    }
                }
            }
        }
        p.soft { "The error is the RMS of predicted minus measured over the RMS of the measured response, on data that the model has not seen, averaged over the responses." }
    }
}

/// The form of a new rig, with the channels of a single-axis rig as an example.
fn form(visitor: &Visitor) -> Markup {
    html! {
        form.fields.broad data-api="POST /v1/rigs" data-then="follow" {
            (csrf(visitor))
            div.row {
                label { "Id" input name="id" required pattern="[a-z0-9][a-z0-9_\\-]{0,62}" placeholder="hydromount-3x"; span.soft { "small letters, digits, - and _; it stays" } }
                label { "Name" input name="name" placeholder="Hydro-mount 3 axis"; span.soft { "any text" } }
                label { "Sample rate in Hz" input type="number" name="sample_rate_hz" data-as="number" required min="0.000001" max="1000000" step="any" value="1000"; }
            }
            fieldset {
                legend { "Channels" }
                p.soft { "In the order of your files. Three channels of one group are x, y and z for Multi-Rain. They stay as they are once a run exists." }
                div data-rows="channels" {
                    (channel("drive_x", "kN", "drive", "force"))
                    (channel("force_x", "kN", "response", "force"))
                }
                button type="button" data-add="channels" { "Add a channel" }
            }
            div { button.main type="submit" { "Make the rig" } }
        }
        template data-of="channels" { (channel("", "", "response", "other")) }
    }
}

fn channel(name: &str, unit: &str, role: &str, quantity: &str) -> Markup {
    let choice =
        |value: &str, chosen: &str| html! { option value=(value) selected[value == chosen] { (value) } };
    html! {
        div.row data-row {
            label { "Name" input name="name" value=(name) required size="14"; }
            label { "Unit" input name="unit" value=(unit) size="5"; }
            label { "Role" select name="role" { @for word in ["drive", "response"] { (choice(word, role)) } } }
            label { "Quantity" select name="quantity" {
                @for word in ["displacement", "velocity", "acceleration", "force", "other"] { (choice(word, quantity)) }
            } }
            label { "Axis" input name="axis" size="4"; }
            label { "Group" input name="group" size="8"; }
            button type="button" data-remove aria-label="Take this channel away" { "Remove" }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ui::testing::{hostile_rig, visitor};

    #[test]
    fn hostile_names_are_text_and_links_stay_in_the_service() {
        let active =
            Some(Active { version: 3, kind: "hybrid2".into(), rms: Some(0.034), when: "<b>".into() });
        let row = Row { rig: hostile_rig(), active, jobs: 2 };
        let html = page(&visitor(TokenRole::Admin), &[row], None, "1.2.3");
        assert!(!html.contains("<script>alert") && html.contains("&lt;script&gt;alert(1)"), "{html}");
        assert!(
            html.contains("Version 3") && html.contains("3.4\u{a0}%") && html.contains("2 jobs"),
            "{html}"
        );
        let links = html.split("href=\"").skip(1).filter_map(|rest| rest.split('"').next());
        assert!(links.clone().count() > 6);
        for link in links {
            assert!(link.starts_with(['/', '#']) || link == "data:,", "{link}");
        }
        assert!(!html.contains(" style=") && !html.contains("<style"), "{html}");
    }

    #[test]
    fn an_empty_service_says_what_to_do_next_and_a_reader_gets_no_form() {
        let html = page(&visitor(TokenRole::Operator), &[], None, "1");
        assert!(html.contains("There is no rig yet") && html.contains("POST /v1/rigs"), "{html}");
        assert!(html.contains("name=\"csrf\""));
        let html = page(&visitor(TokenRole::Reader), &[], None, "1");
        assert!(!html.contains("data-api"), "{html}");
    }
}
