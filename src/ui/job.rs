//! Jobs: their list, and the page of one that goes on.

use maud::{Markup, html};

use super::figures::{Drawing, address, saves};
use super::frame::{Frame, Section, Visitor, csrf};
use super::plot::{Axis, Figure, Key, Mark, Scale, Style};
use super::rig::jobs;
use super::words::{self, clamped, count, duration, sentence};
use crate::domain::{Job, JobKind, JobLosses, JobState, Problem, TokenRole};

/// The page of the newest jobs, of one rig or of all.
pub fn list(visitor: &Visitor, of: &[Job], rig: Option<&str>, next: Option<&str>) -> String {
    let title = rig.map_or_else(|| "Jobs".to_owned(), |rig| format!("Jobs of {rig}"));
    let main = html! {
        h1 { (title) }
        @if of.is_empty() {
            div.empty { p { "No job yet: a fit, a diagnosis or an iteration makes one." } p { a href="/" { "To the rigs" } } }
        } @else {
            p.soft { "Fits, evaluations, diagnoses, iterations and studies, the newest first." }
            (jobs(of, true))
        }
        @if let Some(next) = next { p { a href=(next) { "Further jobs" } } }
    };
    Frame::new(&title, Section::Jobs, visitor).page(&main)
}

/// The page of one job; `has_losses` tells whether an epoch of its training has ended.
pub fn page(visitor: &Visitor, job: &Job, has_losses: bool) -> String {
    let title = format!("{} of {}", capital(job.kind.as_str()), job.rig);
    let over = job.state.is_terminal();
    let main = html! {
        div data-job=(job.id) data-over[over] {
            div.head {
                div { h1 { (title) } p { (words::state(job.state)) } }
                @if !over && visitor.may(TokenRole::Operator) {
                    form.actions data-api={ "POST /v1/jobs/" (job.id) "/cancel" } data-empty data-confirm="Cancel this job? What it has done so far is lost." {
                        (csrf(visitor))
                        button.grave type="submit" disabled[job.cancel_requested] { (if job.cancel_requested { "Being cancelled" } else { "Cancel" }) }
                    }
                }
            }
            @if !over {
                p { span data-live="stage" aria-live="polite" { (job.stage.as_deref().unwrap_or("Waits for a worker.")) } }
                progress max="1" value=(job.progress) aria-label="Share that is done" {}
                dl {
                    dt { "Done" } dd data-live="share" { (format!("{:.0} %", 100.0 * job.progress)) }
                    dt { "Time left" } dd data-live="eta" { (job.eta_s.map_or_else(|| "not known yet".into(), |s| format!("about {}", duration(s)))) }
                }
                p.bad data-live="line" role="status" {}
            } @else { (outcome(job)) }
            @if has_losses || (!over && trains(job.kind)) { (curve(job, has_losses)) }
            dl {
                dt { "Rig" } dd { a href={ "/rigs/" (job.rig) } { (job.rig) } }
                dt { "Queued" } dd { (words::minute(&job.created_at)) " UTC" }
                @if let Some(at) = &job.started_at { dt { "Started" } dd { (words::minute(at)) " UTC" } }
                @if let (Some(from), Some(to)) = (&job.started_at, &job.finished_at) { dt { "Took" } dd { (duration(to.duration_since(*from).as_secs_f64())) } }
                dt { "Attempts" } dd { (job.attempt) }
                dt { "Id" } dd { code { (job.id) } }
            }
        }
    };
    let rig = format!("/rigs/{}", job.rig);
    let mut frame = Frame::new(&title, Section::Jobs, visitor)
        .below(&[("/jobs".into(), "Jobs"), (rig, job.rig.as_str())]);
    frame.scripts = &["forms.js", "figures.js", "job.js"];
    frame.page(&main)
}

/// Whether jobs of a kind may train a network.
fn trains(kind: JobKind) -> bool {
    matches!(kind, JobKind::Fit | JobKind::Study)
}

/// The loss curve, which the page's script draws anew as epochs end. It is hidden before the first one.
fn curve(job: &Job, has_losses: bool) -> Markup {
    let at = address(&format!("/jobs/{}", job.id), "losses");
    html! {
        div.hidden[!has_losses] data-live="losses" {
            h2 { "Loss" }
            figure {
                div.loading[has_losses] data-figure=(at) data-late[has_losses] { @if has_losses { "Being drawn …" } }
                figcaption {
                    "Mean squared error, standardised, at the end of each epoch: on the training data, and on the data that stop the training."
                    @if job.kind == JobKind::Study { " The curves are those of the study's latest fit." }
                }
                (saves(&at))
            }
        }
    }
}

/// The loss curve of a job's training so far.
pub fn losses(of: &JobLosses, width: f64) -> Drawing {
    let mut marks = Vec::new();
    for (place, curve) in of.curves.iter().enumerate() {
        let line = |values: &[f64], name: String, style| Mark::Line {
            x: curve.epochs.iter().map(|epoch| *epoch as f64).collect(),
            y: values.to_vec(),
            style: Style::Series(style),
            name,
        };
        let seed = curve.seed;
        match &curve.stopping {
            Some(stopping) => {
                marks.push(line(&curve.training, format!("seed {seed} training"), 2 * place));
                marks.push(line(stopping, format!("seed {seed} stopping"), 2 * place + 1));
            }
            None => marks.push(line(&curve.training, format!("seed {seed}, all runs"), 2 * place)),
        }
    }
    if marks.is_empty() {
        return Drawing::Nothing("No epoch has ended yet.".into());
    }
    let last = of.curves.iter().flat_map(|curve| &curve.epochs).max().copied().unwrap_or(1);
    let values =
        of.curves.iter().flat_map(|curve| curve.training.iter().chain(curve.stopping.iter().flatten()));
    Figure {
        id: "losses".into(),
        title: "Loss by epoch".into(),
        description: format!("{} of up to {last} epochs.", count(of.curves.len(), "training", "trainings")),
        size: (width, 280.0),
        x: (Axis::exact(Scale::Count, 0.0, last as f64), "Epoch".into()),
        y: (Axis::around(Scale::Log, values.copied()), "Mean squared error".into()),
        key: Key::Above,
        marks,
    }
    .into()
}

fn outcome(job: &Job) -> Markup {
    html! {
        @if let Some(stage) = &job.stage { p { (sentence(stage)) } }
        @match job.state {
            JobState::Succeeded => {
                @if let Some(result) = &job.result {
                    p { a.button.main href=(page_of(&result.href)) { "To the " (result.kind) } }
                }
            }
            JobState::Failed => (failure(job.problem.as_ref())),
            _ => p { "It was cancelled. What it was to make does not exist." },
        }
    }
}

fn failure(problem: Option<&Problem>) -> Markup {
    html! {
        div.refused role="alert" {
            @match problem {
                Some(problem) => {
                    p { (sentence(&problem.detail)) }
                    @for error in &problem.errors {
                        @if let Some(limit) = error.limit.as_ref().filter(|limit| !problem.detail.contains(limit.as_str())) {
                            p { @if let Some(channel) = &error.channel { (clamped(channel)) ": " } (limit) }
                        }
                    }
                    p.soft { (problem.title) " (" (problem.code) ")" }
                }
                None => p { "It failed without saying why; the log of the service has more." },
            }
        }
    }
}

/// Address of the page of what the API has at a path.
pub(super) fn page_of(href: &str) -> String {
    href.strip_prefix("/v1").unwrap_or(href).to_owned()
}

fn capital(word: &str) -> String {
    let mut chars = word.chars();
    chars.next().map(|first| first.to_uppercase().chain(chars).collect()).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{JobId, LossCurve};

    fn drawn(curves: Vec<LossCurve>) -> Drawing {
        losses(&JobLosses { job: JobId::from_u128(1), curves }, 900.0)
    }

    #[test]
    fn each_training_has_its_lines_and_before_the_first_epoch_there_are_none() {
        let curve = |seed, stopping: Option<Vec<f64>>| LossCurve {
            seed,
            epochs: vec![1, 2],
            training: vec![0.5, 0.25],
            stopping,
        };
        let curves = vec![curve(1, Some(vec![0.6, 0.0])), curve(7, None)];
        let csv = drawn(curves.clone()).csv();
        assert_eq!(
            csv,
            "Epoch,seed 1 training,seed 1 stopping,\"seed 7, all runs\"\r\n1,0.5,0.6,0.5\r\n2,0.25,0,0.25\r\n"
        );
        let svg = drawn(curves).svg();
        assert!(
            svg.contains(">Epoch<") && svg.contains(">Mean squared error<") && !svg.contains("NaN"),
            "{svg}"
        );
        assert!(matches!(drawn(Vec::new()), Drawing::Nothing(_)));
    }
}
