//! Jobs: their list, and the page of one that goes on.

use maud::{Markup, html};

use super::frame::{Frame, Section, Visitor, csrf};
use super::rig::jobs;
use super::words::{self, duration};
use crate::domain::{Job, JobState, Problem, TokenRole};

/// The page of the newest jobs, of one rig or of all.
pub fn list(visitor: &Visitor, of: &[Job], rig: Option<&str>, next: Option<&str>) -> String {
    let title = rig.map_or_else(|| "Jobs".to_owned(), |rig| format!("Jobs of {rig}"));
    let main = html! {
        h1 { (title) }
        @if of.is_empty() {
            div.empty { p { "No job yet: a fit, a diagnosis or an iteration makes one." } p { a href="/" { "To the rigs" } } }
        } @else { (jobs(of)) }
        @if let Some(next) = next { p { a href=(next) { "Further jobs" } } }
    };
    Frame::new(&title, Section::Jobs, visitor).page(&main)
}

/// The page of one job.
pub fn page(visitor: &Visitor, job: &Job) -> String {
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
                figure.hidden data-live="figure" { div.plot { (curve()) } figcaption { "Error on the data that stop the training, standardised, since this page was opened." } }
            } @else { (outcome(job)) }
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
    frame.scripts = &["forms.js", "job.js"];
    frame.page(&main)
}

/// Axes of the curve that the page's script draws as the job goes on.
fn curve() -> Markup {
    html! {
        svg role="img" aria-label="Error over the time since this page was opened, logarithmic" viewBox="0 0 700 190" width="700" height="190" {
            g.grid { line.axis x1="60" x2="690" y1="170" y2="170" {} line x1="60" x2="690" y1="20" y2="20" {} }
            text x="54" y="24" text-anchor="end" data-live="high" {}
            text x="54" y="164" text-anchor="end" data-live="low" {}
            text.name x="2" y="12" { "Error" }
            text.name x="380" y="186" text-anchor="middle" { "Progress" }
            path class="line s0" data-live="curve" {}
        }
    }
}

fn outcome(job: &Job) -> Markup {
    html! {
        @if let Some(stage) = &job.stage { p { (stage) } }
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
                    p { (problem.detail) }
                    @for error in &problem.errors {
                        @if let Some(limit) = error.limit.as_ref().filter(|limit| !problem.detail.contains(limit.as_str())) {
                            p { @if let Some(channel) = &error.channel { bdi { (channel) } ": " } (limit) }
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
