//! The closure of the gap on a run that no fit and no choice has used.

use maud::{Markup, html};

use super::location::spectral;
use super::sentence::held;
use super::{figure, heading};
use crate::engine::diagnosis::views::UnseenRun;
use crate::engine::diagnosis::{Hypothesis, Report, Views};
use crate::ui::plot::{Axis, Figure, Key, Mark, Scale, Style, WhiskerRow, whiskers};
use crate::ui::text::{number, percent, with_unit};

/// The section; empty where there is no such run.
pub fn section(report: &Report, views: &Views) -> Markup {
    let Some(unseen) = &views.unseen else { return html! {} };
    let best = report.hypotheses.first().filter(|_| unseen.with_effect.is_some());
    html! {
        (heading("how-far", if best.is_some() { "How far does it close?" } else { "Model and rig on an unseen run" }))
        @if let Some(best) = best {
            p { (in_words(best, unseen)) }
            @if best.responses.len() > 1 { (by_response(best)) }
        }
        (figure(&signals(unseen, best).svg(), &html! {
            b { (unseen.channel) " in " (unseen.run) ", " } "a run that was neither fitted nor chosen on, where the gap is largest."
        }))
        (figure(&errors(unseen, best).svg(), &html! {
            b { "Errors. " } "Measured minus simulated over the same time; the grey band holds 95 % of the noise."
        }))
        (figure(&spectra(unseen, views).svg(), &html! {
            b { "Errors by frequency. " } "Over all unseen spans. Where the error is at the noise floor, nothing is left to explain."
        }))
    }
}

/// The plots of the section.
pub fn figures(report: &Report, views: &Views) -> Vec<Figure> {
    let Some(unseen) = &views.unseen else { return Vec::new() };
    let best = report.hypotheses.first().filter(|_| unseen.with_effect.is_some());
    vec![signals(unseen, best), errors(unseen, best), spectra(unseen, views)]
}

/// The RMS in words.
fn in_words(best: &Hypothesis, unseen: &UnseenRun) -> String {
    let h = &best.held_out;
    let unit = &unseen.unit;
    let times = h.rms_after / h.noise_rms;
    let rest = if !times.is_finite() {
        String::new()
    } else if times < 1.2 {
        "; that is the noise".to_owned()
    } else {
        format!("; that is {} times the noise", number(times))
    };
    let damage = match (h.damage_ratio_before, h.damage_ratio_after) {
        (Some(before), Some(after)) => format!(
            " Predicted damage over measured damage goes from {} to {}; 1 would be right.",
            number(before),
            number(after)
        ),
        _ => String::new(),
    };
    format!(
        "With {} simulated, the RMS error on unseen runs goes from {} to {}{rest} ({}). In terms of RMS {} of the gap is closed.{damage}",
        held(best),
        with_unit(h.rms_before, unit),
        with_unit(h.rms_after, unit),
        with_unit(h.noise_rms, unit),
        percent(h.closure_rms)
    )
}

/// The closure of each response that the effect acts on.
fn by_response(best: &Hypothesis) -> Markup {
    let rows: Vec<WhiskerRow> = best
        .responses
        .iter()
        .map(|r| WhiskerRow {
            name: r.channel.clone(),
            value: r.held_out.closure,
            interval: r.held_out.closure_ci90,
            probability: None,
            chosen: true,
        })
        .collect();
    let description = format!("One row per response that {} acts on.", held(best));
    figure(
        &whiskers("by-response", "Closure by response", &description, &rows),
        &html! { b { "By response. " } "One effect, simulated where it acts, with its influence on every other response." },
    )
}

fn effect(best: Option<&Hypothesis>) -> String {
    best.map_or_else(|| "the effect".into(), held)
}

fn time(unseen: &UnseenRun) -> Vec<f64> {
    (0..unseen.measured.len()).map(|k| unseen.from_s + unseen.step_s * k as f64).collect()
}

fn time_axis(time: &[f64]) -> (Axis, String) {
    let ends = (time.first().copied().unwrap_or(0.0), time.last().copied().unwrap_or(1.0));
    (Axis::exact(Scale::Linear, ends.0, ends.1), "Time in the run in s".into())
}

fn signals(unseen: &UnseenRun, best: Option<&Hypothesis>) -> Figure {
    let time = time(unseen);
    let line = |y: &[f64], style, name: &str| Mark::Line {
        x: time.clone(),
        y: y.to_vec(),
        style,
        name: name.into(),
    };
    let mut marks = vec![
        line(&unseen.measured, Style::Measured, "measured"),
        line(&unseen.simulated, Style::Before, "model"),
    ];
    marks.extend(
        unseen.with_effect.iter().map(|y| line(y, Style::After, &format!("model with {}", effect(best)))),
    );
    let all = unseen.measured.iter().chain(&unseen.simulated).chain(unseen.with_effect.iter().flatten());
    Figure {
        id: "signals".into(),
        title: format!("{} on an unseen run: measured and simulated", unseen.channel),
        description:
            "Time series of the measured response, of the model's and of the model's with the effect.".into(),
        size: (720.0, 270.0),
        x: time_axis(&time),
        y: (Axis::around(Scale::Linear, all.copied()), format!("{} in {}", unseen.channel, unseen.unit)),
        key: Key::Above,
        marks,
    }
}

fn errors(unseen: &UnseenRun, best: Option<&Hypothesis>) -> Figure {
    let time = time(unseen);
    let error = |simulated: &[f64]| -> Vec<f64> {
        unseen.measured.iter().zip(simulated).map(|(m, s)| m - s).collect()
    };
    let before = error(&unseen.simulated);
    let after = unseen.with_effect.as_ref().map(|y| error(y));
    let noise = 1.96 * unseen.noise_rms;
    let all: Vec<f64> = before.iter().chain(after.iter().flatten()).copied().chain([noise, -noise]).collect();
    let mut marks = vec![
        Mark::Span { from: -noise, to: noise, upright: false, name: "noise".into() },
        Mark::Line { x: time.clone(), y: before, style: Style::Before, name: "error of the model".into() },
    ];
    marks.extend(after.map(|y| Mark::Line {
        x: time.clone(),
        y,
        style: Style::After,
        name: format!("error with {}", effect(best)),
    }));
    Figure {
        id: "errors".into(),
        title: "Errors before and after".into(),
        description: "Measured minus simulated, without and with the effect, and the range of the noise."
            .into(),
        size: (720.0, 220.0),
        x: time_axis(&time),
        y: (Axis::around(Scale::Linear, all), format!("Error in {}", unseen.unit)),
        key: Key::Above,
        marks,
    }
}

fn spectra(unseen: &UnseenRun, views: &Views) -> Figure {
    let s = &unseen.spectra;
    let mut lines = vec![
        (s.measured.clone(), Style::Measured, "measured"),
        (s.noise.clone(), Style::Noise, "noise floor"),
        (s.before.clone(), Style::Before, "error before"),
    ];
    lines.extend(s.after.iter().map(|y| (y.clone(), Style::After, "error after")));
    Figure {
        id: "unseen-spectra".into(),
        title: "Errors by frequency on unseen runs".into(),
        description: "Power spectral densities of the measured response, of the error before and after, and of the noise floor.".into(),
        size: (720.0, 280.0),
        ..spectral(views.band_hz, &s.frequency_hz, &unseen.unit, lines, None)
    }
}
