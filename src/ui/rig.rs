//! The page of one rig: what was measured, what was fitted, what goes on, and what to do next.

use maud::{Markup, html};

use super::frame::{Frame, Section, Visitor, csrf};
use super::text::{number, percent};
use super::words::{self, clamped, count, duration, sentence};
use crate::domain::evaluation::EvaluationSummary;
use crate::domain::study::StudySummary;
use crate::domain::{DiagnosisSummary, IterationSummary, Job, Model, Rig, Role, Run, TokenRole};

/// Everything that the page shows.
#[derive(Debug, Clone, PartialEq)]
pub struct RigView {
    /// The rig.
    pub rig: Rig,
    /// Its runs, the newest first.
    pub runs: Vec<Run>,
    /// Whether there are older ones.
    pub more_runs: bool,
    /// Its models, the newest first.
    pub models: Vec<Model>,
    /// Its last jobs, the newest first.
    pub jobs: Vec<Job>,
    /// Its diagnoses, the newest first.
    pub diagnoses: Vec<DiagnosisSummary>,
    /// Its evaluations, the newest first.
    pub evaluations: Vec<EvaluationSummary>,
    /// Its iterations, the newest first.
    pub iterations: Vec<IterationSummary>,
    /// Its studies, the newest first.
    pub studies: Vec<StudySummary>,
    /// `ETag` of the active model.
    pub active_tag: String,
}

/// The page.
pub fn page(visitor: &Visitor, of: &RigView) -> String {
    let rig = &of.rig;
    let at = format!("/rigs/{}", rig.id);
    let active = of.models.iter().find(|model| model.active);
    let operator = visitor.may(TokenRole::Operator);
    let main = html! {
        div.head {
            div {
                h1 { (clamped(&rig.name)) }
                p.soft { (rig.id) " · " (number(rig.sample_rate_hz)) " Hz · "
                    (count(rig.drives().count(), "drive", "drives")) ", " (count(rig.responses().count(), "response", "responses")) }
            }
            div.actions {
                @if operator { a.button.main[of.runs.is_empty()] href={ (at) "/upload" } { "Upload a run" } }
                @if operator && !of.runs.is_empty() { a.button.main[active.is_none()] href={ (at) "/fit" } { "Fit a model" } }
                @if active.is_some() {
                    a.button.main href={ (at) "/predict" } { "Predict and compare" }
                    a.button href={ (at) "/drift" } { "Drift" }
                }
                @if operator && active.is_some() {
                    a.button href={ (at) "/diagnose" } { "Diagnose" }
                    a.button href={ (at) "/iterate" } { "Find a drive" }
                }
                @if operator && !of.models.is_empty() && !of.runs.is_empty() { a.button href={ (at) "/evaluate" } { "Evaluate" } }
                @if operator && !of.runs.is_empty() { a.button href={ (at) "/study" } { "Study" } }
            }
        }
        (next(of, &at, operator))
        div.cards {
            section.card aria-labelledby="active" {
                h2 #active { "Active model" }
                @match active {
                    Some(model) => (active_model(model, &at)),
                    None => p.soft { "None: predictions under “active” are refused." },
                }
            }
            section.card aria-labelledby="work" {
                h2 #work { "Work" }
                (jobs(&of.jobs, false))
                @if !of.jobs.is_empty() { p { a href={ "/jobs?rig=" (rig.id) } { "All jobs of this rig" } } }
            }
        }
        h2 #runs { "Runs" }
        (runs(of, &at))
        h2 #models { "Models" }
        (models(of, &at, visitor))
        (reports(of, &at))
        h2 #channels { "Channels" }
        (channels(rig))
        (policy(rig, visitor))
        @if visitor.may(TokenRole::Admin) { (removal(rig, visitor)) }
    };
    let frame = Frame::new(&rig.name, Section::Rigs, visitor).below(&[("/".into(), "Rigs")]);
    frame.page(&main)
}

/// The next step of a rig that is not ready to predict.
fn next(of: &RigView, at: &str, operator: bool) -> Markup {
    let working = of.jobs.iter().any(|job| !job.state.is_terminal());
    let step = match (of.runs.is_empty(), of.models.is_empty()) {
        _ if !operator => return html! {},
        (true, _) => {
            html! { "Upload two noise runs of a minute or more: a model needs them, and two of them make its error honest. " a href={ (at) "/upload" } { "Upload a run" } "." }
        }
        (false, true) if !working => {
            html! { "There are runs, but no model yet. " a href={ (at) "/fit" } { "Fit a model" } "." }
        }
        _ => return html! {},
    };
    html! { div.empty { p { b { "Next: " } (step) } } }
}

fn active_model(model: &Model, at: &str) -> Markup {
    let rms: Vec<f64> =
        model.report.iter().flat_map(|report| &report.validation_rms).flatten().copied().collect();
    html! {
        p { a href={ (at) "/models/" (model.version) } { "Version " (model.version) } " (" (model.kind_in_words()) ")" }
        @if !rms.is_empty() {
            p.figure-of { (percent(rms.iter().sum::<f64>() / rms.len() as f64)) }
            p.soft { "RMS error on validation data, mean over the responses" }
        }
    }
}

/// Jobs as a short table; `of_all` for those of all rigs.
pub(super) fn jobs(jobs: &[Job], of_all: bool) -> Markup {
    html! {
        @if jobs.is_empty() { p.soft { "Nothing waits or runs." } }
        @else {
            div.wide { table.full {
                thead { tr { th { "Job" } @if of_all { th { "Rig" } } th { "State" } th { "Stage" } th { "Queued" } @if of_all { th.number { "Took" } } } }
                tbody { @for job in jobs {
                    tr {
                        td { a href={ "/jobs/" (job.id) } { (job.kind.as_str()) } }
                        @if of_all { td { a href={ "/rigs/" (job.rig) } { (job.rig) } } }
                        td { (words::state(job.state)) }
                        td { (sentence(job.stage.as_deref().unwrap_or_default())) @if !job.state.is_terminal() && job.progress > 0.0 { " " span.soft { (percent(job.progress)) } } }
                        td.soft { (words::minute(&job.created_at)) }
                        @if of_all { td.number { (took(job)) } }
                    }
                } }
            } }
        }
    }
}

/// How long the last attempt of a job took.
fn took(job: &Job) -> String {
    match (&job.started_at, &job.finished_at) {
        (Some(from), Some(to)) => duration(to.duration_since(*from).as_secs_f64()),
        _ => "–".into(),
    }
}

fn runs(of: &RigView, at: &str) -> Markup {
    if of.runs.is_empty() {
        return html! { p.soft { "None yet." } };
    }
    html! {
        div.wide { table.full {
            thead { tr { th { "Run" } th { "Kind" } th { "Split" } th.number { "Length" } th { "Channels" } th { "Quality" } th { "Accepted" } } }
            tbody { @for run in &of.runs {
                tr {
                    td { a href={ (at) "/runs/" (run.id) } { (clamped(&name_of(run))) } @for tag in &run.tags { " " span.tag { (clamped(tag)) } } }
                    td { (run.kind.as_str()) }
                    td { (run.split.as_str()) }
                    td.number { (duration(run.duration_s)) }
                    td { (run.channels.len()) }
                    td { @match run.quality.warnings.len() { 0 => span.soft { "no warning" }, n => span.tag { (count(n, "warning", "warnings")) } } }
                    td.soft { (words::minute(&run.created_at)) }
                }
            } }
        } }
        @if of.more_runs { p.soft { "Older runs are not shown here; " code { "GET /v1/rigs/" (of.rig.id) "/runs" } " lists all." } }
    }
}

/// A run's name, or where it has none the end of its id.
pub(super) fn name_of(run: &Run) -> String {
    if run.name.trim().is_empty() {
        let id = run.id.to_string();
        return format!("run …{}", &id[id.len() - 6..]);
    }
    run.name.clone()
}

fn models(of: &RigView, at: &str, visitor: &Visitor) -> Markup {
    if of.models.is_empty() {
        return html! { p.soft { "None yet." } };
    }
    html! {
        div.wide { table.full {
            thead { tr { th { "Version" } th { "Kind" } th { "Origin" } th.number { "Error on validation data" } th { "Made" } th { "" } } }
            tbody { @for model in &of.models {
                tr {
                    td { a href={ (at) "/models/" (model.version) } { "Version " (model.version) } @if model.active { " " span.tag.good { "active" } } }
                    td { (model.kind_in_words()) }
                    td { (model.origin.as_str()) }
                    td.number { @match super::model::mean_error(model) { Some(rms) => (percent(rms)), None => span.soft { "–" } } }
                    td.soft { (words::minute(&model.created_at)) }
                    td { @if !model.active && model.is_forward(&of.rig) && visitor.may(TokenRole::Operator) { (super::model::activation(model, &of.active_tag, visitor, "Activate")) } }
                }
            } }
        } }
    }
}

fn reports(of: &RigView, at: &str) -> Markup {
    html! {
        @if !of.evaluations.is_empty() {
            h2 { "Evaluations" }
            div.wide { table.full {
                thead { tr { th { "Evaluation" } th { "Models" } } }
                tbody { @for evaluation in &of.evaluations { tr {
                    td { a href={ (at) "/evaluations/" (evaluation.id) } { (words::minute(&evaluation.created_at)) } }
                    td { (evaluation.outline.models.iter().map(|version| format!("version {version}")).collect::<Vec<_>>().join(", ")) }
                } } }
            } }
        }
        @if !of.diagnoses.is_empty() {
            h2 { "Diagnoses" }
            div.wide { table.full {
                thead { tr { th { "Diagnosis" } th { "Model" } th { "Verdict" } } }
                tbody { @for diagnosis in &of.diagnoses { tr {
                    td { a href={ (at) "/diagnoses/" (diagnosis.id) } { (words::minute(&diagnosis.created_at)) } }
                    td { @match &diagnosis.model { Some(model) => { "Version " (model.version) } None => "outside simulation" } }
                    td { (super::diagnosis::kind_in_words(diagnosis.verdict.kind)) }
                } } }
            } }
        }
        @if !of.iterations.is_empty() {
            h2 { "Iterations" }
            div.wide { table.full {
                thead { tr { th { "Iteration" } th { "Model" } th.number { "Error left" } } }
                tbody { @for iteration in &of.iterations { tr {
                    td { a href={ (at) "/iterations/" (iteration.id) } { (words::minute(&iteration.created_at)) } }
                    td { "Version " (iteration.model.version) }
                    td.number { (percent(iteration.total_error)) }
                } } }
            } }
        }
        @if !of.studies.is_empty() {
            h2 { "Studies" }
            div.wide { table.full {
                thead { tr { th { "Study" } th { "What" } th { "State" } } }
                tbody { @for study in &of.studies { tr {
                    td { a href={ (at) "/studies/" (study.id) } { (words::minute(&study.created_at)) } }
                    td { (super::study::title(study.kind)) }
                    td { (words::state(study.state)) }
                } } }
            } }
        }
    }
}

fn channels(rig: &Rig) -> Markup {
    html! {
        div.wide { table.full {
            thead { tr { th { "Name" } th { "Role" } th { "Unit" } th { "Quantity" } th { "Axis" } th { "Group" } th { "Names in files" } } }
            tbody { @for channel in &rig.channels { tr {
                td { (clamped(&channel.name)) }
                td { (match channel.role { Role::Drive => "drive", Role::Response => "response" }) }
                td { (clamped(&channel.unit)) }
                td { (words::word(channel.quantity)) }
                td { (clamped(channel.axis.as_deref().unwrap_or("–"))) }
                td { (clamped(channel.group.as_deref().unwrap_or("–"))) }
                td { (clamped(&channel.aliases.join(", "))) }
            } } }
        } }
    }
}

fn policy(rig: &Rig, visitor: &Visitor) -> Markup {
    let policy = rig.fit_policy.as_ref();
    html! {
        h2 #policy { "Fits of arriving runs" }
        @match policy {
            Some(policy) => p {
                "Once training runs of the kind " (policy.kinds.iter().map(|kind| kind.as_str()).collect::<Vec<_>>().join(", "))
                " last " (duration(policy.min_total_s)) " together, each new one queues: "
                (policy.fits.iter().map(|fit| fit.kind.as_str()).collect::<Vec<_>>().join(", ")) "."
            },
            None => p.soft { "Nothing is fitted by itself: runs wait until somebody starts a fit." },
        }
        @if visitor.may(TokenRole::Operator) {
            details {
                summary { "Change the name or the fits" }
                form.fields data-api={ "PATCH /v1/rigs/" (rig.id) } data-if-match=(rig.etag()) data-type="application/merge-patch+json" {
                    (csrf(visitor))
                    label { "Name" input name="name" value=(rig.name); }
                    label { "Fits, as JSON"
                        textarea name="fit_policy" data-as="json" rows="4" spellcheck="false" {
                            (policy.map_or_else(
                                || r#"{"kinds": ["noise"], "min_total_s": 60, "fits": [{"kind": "frf"}, {"kind": "hybrid2"}]}"#.to_owned(),
                                |policy| serde_json::to_string(policy).unwrap_or_default(),
                            ))
                        }
                        span.soft { "Fitted one after the other, whenever new training runs of these kinds have come." }
                    }
                    div { button type="submit" { "Change" } }
                }
            }
        }
    }
}

fn removal(rig: &Rig, visitor: &Visitor) -> Markup {
    html! {
        details {
            summary { "Delete this rig" }
            form data-api={ "DELETE /v1/rigs/" (rig.id) } data-then="/"
                data-confirm={ "Delete the rig " (rig.id) " with all its runs, models and reports? There is no way back." } {
                (csrf(visitor))
                p { "Its runs, models and reports go with it." }
                button.grave type="submit" { "Delete the rig" }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ui::testing::{hostile_rig, visitor};

    #[test]
    fn a_new_rig_says_what_to_do_next_and_its_names_are_text() {
        let view = RigView {
            rig: hostile_rig(),
            runs: Vec::new(),
            more_runs: false,
            models: Vec::new(),
            jobs: Vec::new(),
            diagnoses: Vec::new(),
            evaluations: Vec::new(),
            iterations: Vec::new(),
            studies: Vec::new(),
            active_tag: "\"a0\"".into(),
        };
        let html = page(&visitor(TokenRole::Operator), &view);
        assert!(html.contains("Upload two noise runs") && html.contains("/rigs/bench/upload"), "{html}");
        assert!(!html.contains("<img") && !html.contains("<script>alert") && !html.contains("<i>"), "{html}");
        assert!(!html.contains("DELETE /v1/rigs"), "only an admin deletes");
        assert!(page(&visitor(TokenRole::Admin), &view).contains("DELETE /v1/rigs/bench"));
    }
}
