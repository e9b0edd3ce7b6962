//! Sentences of a verdict.

use super::decide::Ranked;
use super::evidence::Evidence;
use crate::diagnosis::effects::effect::Effect;
use crate::diagnosis::input::Input;
use crate::diagnosis::report::{Hypothesis, Verdict, VerdictKind};
use crate::diagnosis::screen::{Place, Standing};

/// Where a law acts, as the report has it: at a channel, or between two.
pub(super) fn place(input: &Input, place: Place) -> (Option<String>, Option<[String; 2]>) {
    let response = |r: usize| input.responses[r].name.clone();
    match place {
        // A controller is its drive's.
        Place::Drive(d) | Place::Error(d, _) => (Some(input.drives[d].name.clone()), None),
        Place::Response(r) | Place::Output(r) => (Some(response(r)), None),
        Place::Between(a, b) => {
            let (a, b) = if a < b { (a, b) } else { (b, a) };
            (None, Some([response(a), response(b)]))
        }
        Place::OnTable(d, r) => (None, Some([input.drives[d].name.clone(), response(r)])),
    }
}

/// What a law is a function of.
pub(super) fn argument(input: &Input, at: Place) -> String {
    let less = |a: &str, b: &str| format!("{a} - {b}");
    match (at, place(input, at)) {
        (Place::Error(d, r), _) => less(&input.drives[d].name, &input.responses[r].name),
        (_, (_, Some([a, b]))) => less(&a, &b),
        (_, (at, None)) => at.unwrap_or_default(),
    }
}

/// The axis of a law: its place's.
pub(super) fn axis(input: &Input, standing: &Standing) -> Option<String> {
    match standing.place {
        Place::Drive(d) | Place::Error(d, _) | Place::OnTable(d, _) => input.drives[d].axis.clone(),
        Place::Response(r) | Place::Output(r) => input.responses[r].axis.clone(),
        Place::Between(a, b) => {
            let (a, b) = (&input.responses[a].axis, &input.responses[b].axis);
            if a == b { a.clone() } else { None }
        }
    }
}

/// That nothing of the rig is the cause.
pub(in crate::diagnosis) const MODEL_ERRS: &str =
    "No effect of the catalogue: the model itself errs on these runs.";

/// How large the gap is.
pub(super) fn size(input: &Input, evidence: &Evidence) -> String {
    let r = evidence.worst();
    let noise = if evidence.repeats() {
        format!("noise of {:.2} % by repeats that the runs hold", 100.0 * evidence.noise(r))
    } else {
        format!("noise of at most {:.2} %, by what the best predictor leaves", 100.0 * evidence.noise(r))
    };
    format!(
        "the model leaves {:.2} % of {}: {:.2} to {:.2} % of it systematic, {noise}",
        100.0 * evidence.whole(r),
        input.responses[r].name,
        100.0 * evidence.at_least(r),
        100.0 * evidence.at_most(r),
    )
}

fn named_place((at, between): (Option<String>, Option<[String; 2]>)) -> String {
    match (at, between) {
        (Some(at), _) => format!("at {at}"),
        (None, Some([a, b])) => format!("between {a} and {b}"),
        (None, None) => String::new(),
    }
}

/// What a law leaves.
pub(super) fn left(input: &Input, ranked: &Ranked<'_>) -> String {
    let standing = ranked.standing;
    let refitted = ranked.refitted.map_or(String::new(), |left| {
        format!(", its family {:.0} % fitted together with the linear part", 100.0 * left)
    });
    format!(
        "{} {} leaves {:.0} % of the linear part's error on runs that it was not fitted to, {:.0} % when simulated \
         forward{refitted}: probability {:.2}",
        standing.effect.name(),
        named_place(place(input, standing.place)),
        100.0 * standing.ratio,
        100.0 * ranked.free.ratio,
        ranked.probability,
    )
}

/// An effect's name as it is spoken.
fn words(effect: Effect) -> String {
    effect.name().replace('_', " ")
}

/// The verdict in an engineer's words.
pub(in crate::diagnosis) fn sentence(verdict: &Verdict, first: Option<&Hypothesis>) -> String {
    let place = named_place((verdict.at.clone(), verdict.between.clone()));
    let strength = first.and_then(|h| h.strength.as_ref());
    let strength = strength
        .map_or(String::new(), |s| format!(", about {} {} in terms of {}", short(s.rms), s.unit, s.as_drive));
    let together = verdict.effects.len() > 1;
    let explains = first.map_or(String::new(), |h| {
        let closed = 100.0 * h.held_out.closure_rms.clamp(0.0, 1.0);
        let who = if together { "together they explain" } else { "it explains" };
        format!("; {who} {closed:.0} % of the gap on runs not used before")
    });
    let effect = |v: &Verdict| v.effect.map_or_else(|| "an effect".into(), words);
    let text = match verdict.kind {
        VerdictKind::Identified | VerdictKind::Partial if together => {
            let all = verdict.effects.iter();
            let all = all.map(|e| words(e.effect) + " " + &named_place((e.at.clone(), e.between.clone())));
            format!("{}{explains}.", all.collect::<Vec<_>>().join(" and "))
        }
        VerdictKind::Identified => format!("{} {place}{strength}{explains}.", effect(verdict)),
        VerdictKind::Partial => format!("In part {} {place}{strength}{explains}.", effect(verdict)),
        VerdictKind::FamilyOnly | VerdictKind::NotDistinguishable => {
            let all: Vec<String> = verdict.equivalence_set.iter().map(|e| words(*e)).collect();
            format!("One of these {place}, which the runs do not tell apart: {}{explains}.", all.join(", "))
        }
        VerdictKind::Undecided => {
            "The runs do not tell whether what the model leaves has a cause or is noise; the next experiment would."
                .into()
        }
        VerdictKind::NoneOfCatalogue => "No effect of the catalogue alone explains what the model leaves.".into(),
        VerdictKind::NoMaterialGap => "The model follows the rig within the material gap.".into(),
        VerdictKind::NoiseOrUnmeasuredDisturbance => "Noise, or a disturbance that no drive explains.".into(),
    };
    let text = text
        .split_whitespace()
        .collect::<Vec<_>>()
        .join(" ")
        .replace(" ,", ",")
        .replace(" ;", ";")
        .replace(" .", ".");
    let mut letters = text.chars();
    letters.next().map_or(String::new(), |first| first.to_uppercase().chain(letters).collect())
}

/// Three digits.
fn short(x: f64) -> String {
    if x == 0.0 || !x.is_finite() {
        return "0".into();
    }
    let digits = (2 - x.abs().log10().floor() as i32).max(0) as usize;
    format!("{x:.digits$}")
}
