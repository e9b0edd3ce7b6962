//! The page that takes a measurement file: what the service understood comes before anything is stored.

use maud::html;

use super::frame::{Frame, Section, Visitor, csrf};
use crate::domain::{Rig, RunKind, Split};

/// The page.
pub fn page(visitor: &Visitor, rig: &Rig) -> String {
    let main = html! {
        h1 { "Upload a run" }
        p { "CSV, NPY, NPZ, MAT, HDF5, RPC III, UFF 58 or JSON. The file is read first and shown as it was understood; it is stored only when you accept it." }
        form.fields data-upload={ "/v1/rigs/" (rig.id) "/runs" } {
            (csrf(visitor))
            div.drop {
                p { label for="file" { "Drop a file here, or choose one" } }
                input #file type="file";
                p.soft data-file { "No file yet" }
            }
            progress.hidden max="1" value="0" aria-label="Share of the file that was sent" {}
            p data-said role="status" aria-live="polite" {}
            div.hidden data-refused {}
            div.row {
                label { "Name" input name="name" maxlength="1000"; }
                label { "Kind" select name="kind" {
                    @for kind in RunKind::ALL { option value=(kind.as_str()) { (kind.as_str()) } }
                } span.soft { "noise makes models" } }
                label { "Split" select name="split" {
                    @for split in [Split::Training, Split::Validation, Split::Test] { option value=(split.as_str()) { (split.as_str()) } }
                } span.soft { "test never enters a fit" } }
                label { "Tags" input name="tag"; span.soft { "separated by commas" } }
            }
            details {
                summary { "If the file does not name its channels, or has another rate" }
                div.row {
                    label { "Channels in order" input name="channels"; span.soft { "names, separated by commas" } }
                    label { "Leave out" input name="ignore"; span.soft { "columns, or * for all that are no channels" } }
                    label { "Sample rate in Hz" input type="number" name="sample_rate_hz" min="0" step="any"; }
                    label.check { input type="checkbox" name="resample"; "Convert to the rig's rate" }
                }
            }
        }
        section.hidden data-understood aria-labelledby="understood" {
            h2 #understood { "What the service understood" }
            dl {}
            div.wide { table {
                thead { tr { th { "Column of the file" } th { "Channel of the rig" } th { "Conversion" } } }
                tbody {}
            } }
            h3 { "Quality" }
            p data-clean { "No warning: no spikes, drop-outs, clipping, hum or constant channels were found." }
            ul {}
            p.actions { button.main type="button" data-accept { "Accept the run" } }
        }
    };
    let at = format!("/rigs/{}", rig.id);
    let mut frame = Frame::new("Upload a run", Section::Rigs, visitor)
        .below(&[("/".into(), "Rigs"), (at, rig.name.as_str())]);
    frame.scripts = &["forms.js", "upload.js"];
    frame.page(&main)
}
