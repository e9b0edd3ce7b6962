//! The page of a rig's drift: the error of the active model on each run, and whether it is past its control limit.

use maud::{Markup, html};

use super::figures::Drawing;
use super::frame::{Frame, Section, Visitor, csrf};
use super::plot::{Axis, Figure, Key, Mark, Scale, Style};
use super::text::{cut, number, percent};
use super::words::{clamped, count, minute, word};
use crate::domain::drift::{Basis, ControlLimit, Drift, JudgedRun, LEAST_INSIDE, NoLimit};
use crate::domain::{Rig, TokenRole};

/// Most rows of the table; all are in the answer as JSON.
const MOST_ROWS: usize = 200;

/// The page.
pub fn page(visitor: &Visitor, rig: &Rig, drift: &Drift) -> String {
    let title = format!("Drift of {}", rig.name);
    let main = html! {
        h1 { "Drift" }
        p.soft { "The error of the active model on each run that has come since, held against its errors on runs that were held out of its fit." }
        @match &drift.model {
            None => p { "No model is active, so nothing is judged." },
            Some(model) => {
                p {
                    a href={ "/rigs/" (rig.id) "/models/" (model.version) } { "Version " (model.version) }
                    ": " (count(drift.earlier + drift.runs.len(), "run judged", "runs judged"))
                    @if drift.pending > 0 { ", " (drift.pending) " waiting" }
                    @if !drift.omitted.is_empty() { ", " (drift.omitted.len()) " left out" }
                    "."
                }
                (verdict(visitor, rig, drift))
                @if !drift.runs.is_empty() {
                    h2 #errors { "Errors by run" }
                    figure { (errors(drift, 1200.0).part()) figcaption { (caption(drift)) } }
                    (limits(drift))
                    (runs(rig, drift))
                }
            }
        }
        p.soft { a href={ "/v1/rigs/" (rig.id) "/drift" } { "For programs" } }
    };
    let way = [("/".to_owned(), "Rigs"), (format!("/rigs/{}", rig.id), rig.name.as_str())];
    Frame::new(&title, Section::Rigs, visitor).below(&way).page(&main)
}

fn verdict(visitor: &Visitor, rig: &Rig, drift: &Drift) -> Markup {
    html! {
        @if let Some(diagnosis) = &drift.diagnosis {
            div.empty {
                p { b { "Past the limit: " } "the newest run has " (number(drift.ratio.unwrap_or_default())) " times the largest error that is usual for this model. The rig has changed, or the run is unlike those that were held out. A diagnosis tells which effect is new." }
                @if visitor.may(TokenRole::Operator) {
                    form data-api={ "POST " (diagnosis.href) } data-then="follow" data-body=(serde_json::to_string(&diagnosis.body).unwrap_or_default()) {
                        (csrf(visitor)) button type="submit" { "Diagnose these " (count(diagnosis.body.runs.len(), "run", "runs")) }
                    }
                } @else {
                    p.soft { "Somebody who may operate the rig " (clamped(&rig.name)) " can start it." }
                }
            }
        } @else if let Some(ratio) = drift.ratio {
            p { "Within the limit: the newest run has " (number(ratio)) " times it." }
        }
        @if drift.no_limit == Some(NoLimit::NoHeldOutRuns) {
            p { "No data were held out of the fit of this version, so there is no limit: the errors stand alone." }
        }
    }
}

fn caption(drift: &Drift) -> &'static str {
    if shows_ratios(drift) {
        "Error over its limit, by output. Above the rule a run is past the limit."
    } else {
        "RMS error relative to the measured RMS, by output."
    }
}

fn shows_ratios(drift: &Drift) -> bool {
    drift.runs.iter().any(|run| run.judgement.ratio.is_some())
}

/// The errors of the judged runs, over their limits where there are some.
pub fn errors(drift: &Drift, width: f64) -> Drawing {
    let ratios = shows_ratios(drift);
    let value = |run: &JudgedRun, output: &str| {
        let channel = run.judgement.channels.get(output)?;
        if ratios { channel.ratio } else { channel.rms }
    };
    let mut outputs: Vec<&String> = Vec::new();
    for output in drift.runs.iter().flat_map(|run| run.judgement.channels.keys()) {
        if !outputs.contains(&output) {
            outputs.push(output);
        }
    }
    let first = drift.earlier + 1;
    let dots = |(place, output): (usize, &&String)| {
        let found = drift.runs.iter().enumerate().filter_map(|(k, run)| Some((k, value(run, output)?)));
        let (x, y) = found.map(|(k, value)| ((first + k) as f64, value)).unzip();
        Mark::Dots { x, y, style: Style::Series(place), radius: 3.0, name: (*output).clone() }
    };
    let mut marks: Vec<Mark> = outputs.iter().enumerate().map(dots).collect();
    let all = drift.runs.iter().flat_map(|run| outputs.iter().filter_map(move |output| value(run, output)));
    let all: Vec<f64> = all.filter(|value| *value > 0.0).collect();
    if all.is_empty() {
        return Drawing::Nothing("No run has an error to draw.".into());
    }
    if ratios {
        marks.push(Mark::Rule { at: 1.0, upright: false, name: "limit".into() });
    }
    let last = (first + drift.runs.len() - 1) as f64;
    let floor = if ratios { Some(1.0) } else { None };
    Figure {
        id: "drift".into(),
        title: "Errors of the active model by run".into(),
        description: format!("{} in the order of their time.", count(drift.runs.len(), "run", "runs")),
        size: (width, 300.0),
        x: (Axis::exact(Scale::Count, first as f64 - 0.5, last + 0.5), "Run in the order of time".into()),
        y: (
            Axis::around(Scale::Log, all.into_iter().chain(floor)),
            if ratios { "Error over its limit" } else { "Relative RMS error" }.into(),
        ),
        key: Key::Above,
        marks,
    }
    .into()
}

fn limits(drift: &Drift) -> Markup {
    let rests_on = |limit: &ControlLimit| {
        let held_out = count(limit.held_out, "held-out stretch of data", "held-out stretches of data");
        let of = match limit.basis {
            Basis::SameKind => format!("{held_out} of this kind"),
            Basis::OtherKinds => format!("{held_out} of other kinds, as none of this kind was held out"),
        };
        format!("{} times the largest error on {of}", number(limit.factor))
    };
    html! {
        @if !drift.limits.is_empty() {
            h2 #limits { "Limits" }
            div.wide { table.full {
                thead { tr { th { "Runs" } th { "Rests on" } th { "Limit by output" } } }
                tbody { @for limit in &drift.limits { tr {
                    td { (limit.kind.as_str()) }
                    td { (rests_on(limit)) }
                    td { (limit.channels.iter().map(|(name, limit)| format!("{} {}", cut(name), percent(*limit))).collect::<Vec<_>>().join(", ")) }
                } } }
            } }
        }
    }
}

fn runs(rig: &Rig, drift: &Drift) -> Markup {
    let hidden = drift.earlier + drift.runs.len().saturating_sub(MOST_ROWS);
    html! {
        h2 #runs { "Runs" }
        div.wide { table.full {
            thead { tr { th { "Run" } th { "Kind" } th { "Measured" } th { "Error by output" } th.number { "Over the limit" } th { "" } } }
            tbody { @for run in drift.runs.iter().rev().take(MOST_ROWS) { tr {
                td { a href={ "/rigs/" (rig.id) "/runs/" (run.run) } {
                    @if run.name.is_empty() { code { (&run.run.to_string()[24..]) } } @else { (clamped(&run.name)) }
                } }
                td { (run.kind.as_str()) }
                td.soft { (minute(&run.at)) }
                td { (run.judgement.channels.iter().map(|(name, c)| format!("{} {}", cut(name), c.rms.map_or_else(|| "–".into(), percent))).collect::<Vec<_>>().join(", ")) }
                td.number { @if let Some(ratio) = run.judgement.ratio { (number(ratio)) } }
                td {
                    @if run.judgement.past { span.tag.bad { "past the limit" } }
                    @if run.judgement.no_limit == Some(NoLimit::Outside) {
                        span.soft { "outside what the model was fitted on (" (percent(run.judgement.inside)) " inside, " (percent(LEAST_INSIDE)) " needed)" }
                    }
                }
            } } }
        } }
        @if hidden > 0 { p.soft { (count(hidden, "earlier run is", "earlier runs are")) " not shown." } }
        @if !drift.omitted.is_empty() {
            details {
                summary { "Runs that were left out" }
                ul { @for omitted in drift.omitted.iter().rev().take(MOST_ROWS) { li {
                    a href={ "/rigs/" (rig.id) "/runs/" (omitted.run) } { code { (&omitted.run.to_string()[24..]) } } ": " (word(omitted.reason))
                } } }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::drift::{Judgement, NotPredicted, OmittedFromDrift, ProposedBody, ProposedDiagnosis};
    use crate::domain::{RunId, RunKind, UsedModel};
    use crate::ui::testing::{hostile_rig, visitor};

    fn judged(number: u128, rms: f64, limit: Option<&ControlLimit>) -> JudgedRun {
        let errors = [("<y>".to_owned(), Some(rms))].into();
        JudgedRun {
            run: RunId::from_u128(number),
            name: "<b>load".into(),
            kind: RunKind::Noise,
            at: "2026-03-01T12:00:00Z".parse().unwrap(),
            judgement: Judgement::new(errors, 60.0, 1.0, limit),
        }
    }

    fn drift() -> Drift {
        let limit = ControlLimit {
            kind: RunKind::Noise,
            basis: Basis::OtherKinds,
            held_out: 2,
            factor: 3.0,
            channels: [("<y>".to_owned(), 0.1)].into(),
        };
        let runs = vec![judged(1, 0.05, Some(&limit)), judged(2, 0.3, Some(&limit))];
        let href = "/v1/rigs/bench/diagnoses".into();
        Drift {
            model: Some(UsedModel { version: 4, sha256: "ab".into() }),
            ratio: runs[1].judgement.ratio,
            past: true,
            diagnosis: Some(ProposedDiagnosis {
                href,
                body: ProposedBody { model: 4, runs: vec![runs[1].run] },
            }),
            limits: vec![limit],
            runs,
            omitted: vec![OmittedFromDrift { run: RunId::from_u128(3), reason: NotPredicted::HeldOut }],
            ..Drift::without_model("bench".parse().unwrap())
        }
    }

    #[test]
    fn the_page_says_what_is_past_the_limit_and_offers_the_diagnosis_to_those_who_may() {
        let (rig, drift) = (hostile_rig(), drift());
        let html = page(&visitor(TokenRole::Operator), &rig, &drift);
        for part in [
            "Past the limit",
            "past the limit",
            "&lt;b&gt;load",
            "data-then=\"follow\"",
            "2 held-out stretches of data of other kinds",
            "held out",
            "<svg",
        ] {
            assert!(html.contains(part), "{part} in {html}");
        }
        assert!(!html.contains("<b>load") && !html.contains("NaN"));
        assert!(!page(&visitor(TokenRole::Reader), &rig, &drift).contains("data-then"));
        let none = page(&visitor(TokenRole::Reader), &rig, &Drift::without_model("bench".parse().unwrap()));
        assert!(none.contains("No model is active"));
    }

    #[test]
    fn runs_without_limits_show_their_errors() {
        let without = Drift {
            runs: vec![judged(1, 0.05, None)],
            limits: Vec::new(),
            no_limit: Some(NoLimit::NoHeldOutRuns),
            past: false,
            ratio: None,
            diagnosis: None,
            ..drift()
        };
        let html = page(&visitor(TokenRole::Reader), &hostile_rig(), &without);
        assert!(html.contains("there is no limit") && html.contains("Relative RMS error"), "{html}");
    }
}
