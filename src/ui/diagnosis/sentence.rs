//! The verdict in one plain sentence.

use super::labels::{family, words};
use crate::engine::diagnosis::{Effect, EffectShare, Hypothesis, Report, Verdict, VerdictKind};
use crate::ui::text::{listed, number, percent, share};

/// The answer in one sentence.
pub fn verdict(report: &Report) -> String {
    let v = &report.verdict;
    let sure = certainty(v.probability);
    match (v.kind, v.effect) {
        (VerdictKind::Identified | VerdictKind::Partial, Some(Effect::Quantisation)) => format!(
            "{sure}, the samples{} are rounded to coarse steps, and that rounding makes up the gap.",
            v.channel.as_ref().map_or_else(String::new, |c| format!(" of {c}")),
        ),
        (VerdictKind::Identified | VerdictKind::Partial, Some(_)) if v.effects.len() > 1 => {
            let all: Vec<String> =
                v.effects.iter().map(|e| format!("{}{}", words(e.effect).noun, place(e.into()))).collect();
            let closes = best(report).map_or_else(String::new, |best| {
                format!(": together they close {} of the gap on unseen runs", closure(best))
            });
            format!("{sure}, the rig has {}, which the model lacks{closes}.", listed(&all, "and"))
        }
        (VerdictKind::Identified | VerdictKind::Partial, Some(effect)) => {
            format!("{sure}, {}{}", has(v, effect), closes(report, effect))
        }
        (VerdictKind::FamilyOnly, _) => {
            let kind = v.family.map_or("kind not known", family);
            format!(
                "{sure}, the model lacks an effect of the kind “{kind}”{}, but these runs cannot tell which{}.",
                place(v.into()),
                among(v)
            )
        }
        (VerdictKind::NotDistinguishable, _) => {
            let names = names(&v.equivalence_set);
            format!(
                "{sure}, the model lacks one of these: {}; these runs cannot tell them apart.",
                listed(&names, "or")
            )
        }
        (VerdictKind::NoiseOrUnmeasuredDisturbance, Some(Effect::PeriodicDisturbance)) => format!(
            "{sure}, the model is not at fault: its error{} is a hum{} that no drive causes.",
            v.channel.as_ref().map_or_else(String::new, |c| format!(" of {c}")),
            report.fingerprints.line_hz.map_or_else(String::new, |f| format!(" at {} Hz", number(f))),
        ),
        (VerdictKind::NoiseOrUnmeasuredDisturbance, _) => format!(
            "{sure}, the model is not at fault: {} noisier than in the baseline runs, and no drive causes it.",
            v.channel.as_ref().map_or_else(|| "the responses are".to_owned(), |c| format!("{c} is")),
        ),
        (VerdictKind::NoMaterialGap, _) => {
            let size = percent(report.gap.systematic_rms_rel);
            match best(report) {
                None => format!(
                    "{sure}, model and rig agree: they differ by {size} of the response, too little to matter."
                ),
                Some(_) => format!(
                    "{sure}, the model lacks no effect: the gap is {size} of the response, and adjusting the model's linear part closes it."
                ),
            }
        }
        (VerdictKind::Undecided, _) => format!(
            "{sure}, these runs do not tell: the model leaves {} of the response, and nothing predicts enough of that on runs that it has not seen; it may be noise, or a cause that the next experiment would show.",
            percent(report.gap.systematic_at_most)
        ),
        _ => none(report, &sure),
    }
}

fn none(report: &Report, sure: &str) -> String {
    let size = percent(report.gap.systematic_rms_rel);
    let nearest = best(report).map_or_else(String::new, |b| {
        format!("; the nearest, {}, closes {} of it", words(b.effect).name, percent(b.held_out.closure))
    });
    format!(
        "{sure}, the gap of {size} of the response is real, but no effect of the catalogue explains it{nearest}."
    )
}

fn has(v: &Verdict, effect: Effect) -> String {
    let words = words(effect);
    if words.other {
        format!("the rig has {}{} than the model", words.noun, place(v.into()))
    } else {
        format!("the rig has {}{} that the model lacks", words.noun, place(v.into()))
    }
}

/// Where something acts.
struct Acts<'a> {
    between: Option<&'a [String; 2]>,
    axis: Option<&'a String>,
    channel: Option<&'a String>,
}

impl<'a> From<&'a Verdict> for Acts<'a> {
    fn from(v: &'a Verdict) -> Self {
        let channel = v.at.as_ref().or(v.channel.as_ref());
        Self { between: v.between.as_ref(), axis: v.axis.as_ref(), channel }
    }
}

impl<'a> From<&'a EffectShare> for Acts<'a> {
    fn from(e: &'a EffectShare) -> Self {
        Self { between: e.between.as_ref(), axis: e.axis.as_ref(), channel: e.at.as_ref() }
    }
}

fn place(acts: Acts<'_>) -> String {
    match (acts.between, acts.axis, acts.channel) {
        (Some([a, b]), ..) => format!(" between {a} and {b}"),
        (None, Some(axis), _) => format!(" on axis {axis}"),
        (None, None, Some(channel)) => format!(" at {channel}"),
        (None, None, None) => String::new(),
    }
}

fn closes(report: &Report, effect: Effect) -> String {
    let Some(h) = report.hypotheses.iter().find(|h| h.effect == effect) else { return ".".into() };
    let but = match report.verdict.kind {
        VerdictKind::Partial if h.held_out.chi2_after > 1.5 => ", so this is a part of the answer",
        VerdictKind::Partial => ", as far as runs without repeats can tell",
        _ => "",
    };
    format!(": adding it closes {} of the gap on unseen runs{but}.", closure(h))
}

/// A closure with its 90 % interval.
pub fn closure(h: &Hypothesis) -> String {
    let [low, high] = h.held_out.closure_ci90.map(share);
    format!("{}\u{a0}% ({low}–{high}\u{a0}%)", share(h.held_out.closure))
}

fn among(v: &Verdict) -> String {
    match v.equivalence_set.as_slice() {
        [] | [_] => String::new(),
        several => format!(": {}", listed(&names(several), "or")),
    }
}

fn names(effects: &[Effect]) -> Vec<String> {
    effects.iter().map(|e| words(*e).name.to_owned()).collect()
}

/// The effects of a hypothesis in a list.
pub fn held(hypothesis: &Hypothesis) -> String {
    let all: Vec<Effect> = hypothesis.effects.iter().map(|e| e.effect).collect();
    listed(&names(if all.is_empty() { std::slice::from_ref(&hypothesis.effect) } else { &all }), "and")
}

/// The first hypothesis.
pub fn best(report: &Report) -> Option<&Hypothesis> {
    report.hypotheses.first()
}

/// A probability in words and as a number, to begin a sentence.
fn certainty(probability: f64) -> String {
    let word = match probability {
        p if p >= 0.95 => "Almost certainly",
        p if p >= 0.8 => "Very likely",
        p if p >= 0.6 => "Probably",
        p if p >= 0.4 => "Possibly",
        _ => "With little certainty",
    };
    format!("{word} ({})", percent(probability))
}

/// The next experiment and the reason for it.
pub fn next(report: &Report) -> Option<String> {
    let next = report.next_experiment.as_ref()?;
    if report.verdict.kind == VerdictKind::Undecided {
        return Some(match next.drive.kind.as_str() {
            "same_drive_again" => "Run one of these drives again, the loudest first: what two runs with one drive share is no noise.".into(),
            _ => format!("Run {}, with another realisation of the drive than these runs have: a law is believed where it holds on a drive that it was not fitted to.", drive(report)),
        });
    }
    let pair = listed(&names(&next.separates), "and");
    if next.inseparable_in_envelope {
        return Some(format!(
            "No run within the allowed drive levels is expected to tell {pair} apart: after the best of them, {}, the wrong one of the two, fitted to all runs as well as it can, would miss them by {}. Allow a higher level, or measure a further signal.",
            drive(report),
            floors(next.expected_separation)
        ));
    }
    Some(format!(
        "Run {}. It is expected to tell {pair} apart: the wrong one of the two, fitted to all runs as well as it can, would still miss them by {}, more than chance does.",
        drive(report),
        floors(next.expected_separation)
    ))
}

/// A mean square in noise floors as a ratio of amplitudes.
fn floors(squared: f64) -> String {
    match squared.max(0.0).sqrt() {
        d if d < 0.1 => "less than a tenth of the noise floor".into(),
        d => format!("{} times the noise floor", number(d)),
    }
}

fn drive(report: &Report) -> String {
    let Some(next) = &report.next_experiment else { return String::new() };
    let d = &next.drive;
    let at = d.frequency_hz.map_or_else(String::new, |f| format!(" at {} Hz", number(f)));
    let kind = match d.kind.as_str() {
        "same_drive_again" => "the same drive again".to_owned(),
        "noise" => "noise over the same band".to_owned(),
        "slow_sine" => format!("a slow sine{at}"),
        "resonance_sine" => format!("a sine at the resonance{}", at.replace(" at ", ", ")),
        "sweep" => "a sine sweep through the band".to_owned(),
        "offset_noise" => "noise about an offset of half the peak".to_owned(),
        other => format!("{}{at}", other.replace('_', " ")),
    };
    let level = match d.level_rel {
        l if (l - 1.0).abs() < 1e-9 => "the peak level of these runs".to_owned(),
        l => format!("{} times the peak level of these runs", number(l)),
    };
    format!("{kind}, at {level}")
}

/// A warning in plain words.
pub fn warning(warning: &str) -> String {
    let (code, about) = warning.split_once(": ").unwrap_or((warning, ""));
    match code {
        "noise_floor_assumed" => "There are no runs with the same drive. The noise floor is therefore assumed to be the error of the linear core on the baseline runs. A gap that looks systematic may be noise, and the reverse; the verdict is at most a partial one. Run one drive twice to measure the noise.".into(),
        "one_drive" => "All runs share one drive. Whatever fits it cannot be checked on another, so no law is named.".into(),
        "rig_changed" => "The runs that the model was fitted to show another rig than the runs that are asked about: no law that shows in the latter explains both. They were left out. Fit the model again, or ask in external mode if they are of before a change.".into(),
        "acts_seldom" => "The gap occurs only in the runs that effects are fitted to, or only in those that they are chosen on: its cause acts only a few times. All of these runs were therefore used for both, and the verdict is at most a partial one. Longer runs, or runs at a higher level, would show more.".into(),
        "core_stands_for_sim" => format!("At “{about}” the FRF says something else than the linear core of the baseline runs, which stands for the FRF while effects are sought and the gap is located: an FRF errs a little by its estimate, and that is no effect. In situ, what an effect closes is counted from the FRF itself; in external mode from the core."),
        "responses_left_out" => format!("The responses at which the model errs no more than on the baseline runs, or least more of many, were left out: {about}. The report is about the others."),
        "repeat_drive_differs" => format!("“{about}” was named as a repeat, but its drive differs from the first run's. It was used as a run of its own."),
        _ if about.is_empty() => code.replace('_', " "),
        _ => format!("{}: {about}", code.replace('_', " ")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn certainty_is_said_in_words_and_as_a_number() {
        assert_eq!(certainty(0.97), "Almost certainly (97\u{a0}%)");
        assert_eq!(certainty(0.7), "Probably (70\u{a0}%)");
        assert_eq!(certainty(0.1), "With little certainty (10\u{a0}%)");
    }

    #[test]
    fn warnings_are_explained_and_unknown_ones_kept() {
        assert!(warning("noise_floor_assumed").contains("Run one drive twice"));
        assert!(warning("acts_seldom").contains("Longer runs"));
        assert!(warning("rig_changed").contains("external mode"));
        assert!(warning("core_stands_for_sim: x").contains("At “x” the FRF"));
        assert!(warning("responses_left_out: 24").contains("were left out: 24."));
        assert!(warning("repeat_drive_differs: run 7").contains("“run 7” was named"));
        assert_eq!(warning("some_new_thing: here"), "some new thing: here");
    }
}
