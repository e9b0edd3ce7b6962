//! From what laws leave elsewhere to a verdict.

use super::alternatives::{Weights, alternatives, odds_of_none};
use super::evidence::Evidence;
use super::hypotheses::Listed;
use super::refit::Refits;
use super::words;
use crate::diagnosis::effects::effect::{Effect, Family};
use crate::diagnosis::input::Input;
use crate::diagnosis::numerics::linear::rms;
use crate::diagnosis::report::{Verdict, VerdictKind};
use crate::diagnosis::screen::{FreeRun, Screening, Standing, Transfer};

/// Nothing is stated surer: the rigs of the population are simulated.
const SUREST: f64 = 0.97;
/// Probability that any law is right from which on laws are named at all, and that of one from which on it is named
/// alone: to blame the wrong part costs a lab more than another run.
pub const NAMED: f64 = 0.65;
const ALONE: f64 = 0.6;
/// Below this share of the foremost a rival is none.
const NO_RIVAL: f64 = 0.12;
/// Foremost laws, that of time the first, which runs do not tell apart whose level follows the clock.
const ONE_WITH_TIME: usize = 3;
/// Effects of one family whose errors differ by less are told apart by nothing.
const ALIKE: f64 = 1.03;
/// Share of the gap's power that an identified effect leaves at most in every group.
const LEFT: f64 = 0.1;

/// Share of what a family, fitted together with the linear part, leaves at the place of its foremost law, below which it
/// acts at another.
const ELSEWHERE: f64 = 0.5;

/// The foremost law of a family with the probability that it is the right one.
#[derive(Debug, Clone)]
pub struct Ranked<'a> {
    /// The law at its place.
    pub standing: &'a Standing,
    /// Its free run.
    pub free: &'a FreeRun,
    /// What the best law of its family leaves where it is fitted together with the linear part.
    pub refitted: Option<f64>,
    /// Probability.
    pub probability: f64,
}

/// Families, the likeliest first. `noise` is the RMS of each response's noise by repeats, relative to the response.
pub fn ranked<'a>(screening: &'a Screening, refits: &Refits, noise: Option<&[f64]>) -> Vec<Ranked<'a>> {
    let alternatives = alternatives(screening, refits);
    let features: Vec<_> = alternatives.iter().map(|a| a.features).collect();
    let none = noise.map_or(1.0, |noise| {
        let left = screening.linear.errors.iter().map(|errors| rms(errors));
        let least = left.zip(noise).map(|(left, noise)| (noise / left.max(f64::MIN_POSITIVE)).powi(2));
        odds_of_none(least.fold(1.0, f64::min))
    });
    let probabilities = Weights::fitted().probabilities(&features, none);
    let mut all: Vec<Ranked<'_>> = alternatives
        .into_iter()
        .zip(probabilities)
        .map(|(a, probability)| {
            let elsewhere = elsewhere(screening, refits, a.standing);
            let (standing, free) = elsewhere.unwrap_or((a.standing, a.free));
            Ranked { standing, free, refitted: a.refitted, probability }
        })
        .collect();
    all.sort_by(|a, b| b.probability.total_cmp(&a.probability));
    all
}

/// The family's law at the place where it leaves clearly less when it is fitted together with the linear part, if it
/// ran freely there.
fn elsewhere<'a>(
    screening: &'a Screening,
    refits: &Refits,
    of: &Standing,
) -> Option<(&'a Standing, &'a FreeRun)> {
    let place = refits.elsewhere(of.family, of.place, ELSEWHERE)?;
    let there = screening.standings.iter().filter(|s| s.family == of.family && s.place == place);
    there.filter_map(|s| Some((s, s.free.as_ref()?))).min_by(|a, b| a.1.ratio.total_cmp(&b.1.ratio))
}

/// The verdict.
pub(super) fn verdict(
    input: &Input,
    screening: &Screening,
    ranked: &[Ranked<'_>],
    evidence: &Evidence,
    listed: &[Listed],
) -> Verdict {
    let r = evidence.worst();
    let bare = |kind, probability: f64, because: Vec<String>| Verdict {
        kind,
        effect: None,
        family: None,
        axis: None,
        at: None,
        between: None,
        channel: Some(input.responses[r].name.clone()),
        probability,
        in_words: String::new(),
        equivalence_set: Vec::new(),
        effects: Vec::new(),
        because,
    };
    let mut because = vec![words::size(input, evidence)];
    if input.explains_its_own_runs() {
        because.push(format!(
            "the model was fitted to these runs; a linear part leaves {:.2} % of those that it was not fitted to",
            100.0 * evidence.linear(r)
        ));
    }
    let there = of_any(ranked);
    let unseen = input.left_of_unseen(evidence.whole(r), evidence.linear(r));
    let verdict = if unseen < input.material_gap {
        bare(VerdictKind::NoMaterialGap, 0.97, because)
    } else if evidence.repeats() && evidence.at_most(r) < input.material_gap {
        because.push("repeats show that the rest is noise".into());
        bare(VerdictKind::NoMaterialGap, 0.95, because)
    } else if screening.transfer == Transfer::OneDrive {
        because.push(
            "all runs share one drive: whatever fits it cannot be checked on another, so nothing is named"
                .into(),
        );
        bare(VerdictKind::Undecided, 0.9, because)
    } else if evidence.linear(r) < input.material_gap && there < NAMED {
        because.push(format!(
            "a linear part fitted to these runs leaves {:.2} % of runs that it has not seen: the model errs, no law is \
             missing; fit it again with these runs",
            100.0 * evidence.linear(r)
        ));
        // A law that may be there all the same may have more to it than these runs show.
        let errs = bare(VerdictKind::NoneOfCatalogue, (1.0 - there).clamp(0.5, SUREST), because);
        return Verdict { in_words: words::MODEL_ERRS.into(), ..errs };
    } else {
        named(input, screening, ranked, evidence, listed, because, bare)
    };
    Verdict { in_words: words::sentence(&verdict, listed.first().map(Listed::last)), ..verdict }
}

/// The law that the runs single out, if any is likely enough.
pub(super) fn singled_out<'r, 'a>(ranked: &'r [Ranked<'a>]) -> Option<&'r Ranked<'a>> {
    let best = ranked.first().filter(|_| of_any(ranked) >= NAMED)?;
    (best.probability >= ALONE || rivals(ranked).len() == 1).then_some(best)
}

/// The laws that the foremost is not told from, that first.
fn rivals<'r, 'a>(ranked: &'r [Ranked<'a>]) -> Vec<&'r Ranked<'a>> {
    let most = ranked.first().map_or(0.0, |best| best.probability);
    ranked.iter().filter(|r| r.probability > NO_RIVAL * most).collect()
}

/// Probability that any of the laws is right.
fn of_any(ranked: &[Ranked<'_>]) -> f64 {
    ranked.iter().map(|r| r.probability).sum()
}

/// Effects of a law's family that leave nearly the same, beside the same linear part.
fn alike(screening: &Screening, law: &Standing) -> Vec<Effect> {
    let of_family = || screening.standings.iter().filter(|s| s.family == law.family && s.apart == law.apart);
    let least = of_family().map(|s| s.ratio).fold(1.0, f64::min);
    of_family().filter(|s| s.ratio < ALIKE * least).map(|s| s.effect).collect()
}

fn named(
    input: &Input,
    screening: &Screening,
    ranked: &[Ranked<'_>],
    evidence: &Evidence,
    listed: &[Listed],
    mut because: Vec<String>,
    bare: impl Fn(VerdictKind, f64, Vec<String>) -> Verdict,
) -> Verdict {
    let Some(best) = ranked.first() else {
        because.push("no law predicts anything of it on runs that it has not seen".into());
        return bare(VerdictKind::Undecided, 0.8, because);
    };
    because.extend(ranked.iter().take(3).map(|r| words::left(input, r)));
    let there = of_any(ranked);
    // The sim with the law in it has to be better than the sim.
    let own = listed.iter().map(Listed::last).find(|h| h.family == best.standing.family);
    let helps = own.is_some_and(|own| own.remaining_share < 1.0);
    if there < NAMED || !helps {
        because.push(
            "nothing predicts enough of it on runs that it has not seen to tell a cause from noise; the same drive \
             again would tell the noise"
                .into(),
        );
        // What an abstention is sure of: that the foremost law is not the cause.
        let p = if helps { 1.0 - best.probability } else { 0.7 };
        return bare(VerdictKind::Undecided, p.min(0.9), because);
    }
    let standing = best.standing;
    let family = standing.family;
    let (at, between) = words::place(input, standing.place);
    let (axis, channel) = (words::axis(input, standing), input.responses[standing.response].name.clone());
    let blamed = |kind, p: f64, set: Vec<Effect>, because| Verdict {
        axis,
        at,
        between,
        channel: Some(channel),
        equivalence_set: each_once(set),
        ..bare(kind, p.min(SUREST), because)
    };
    // One of them is right, with the probability of all of them.
    let one_of = |laws: &[&Ranked<'_>]| -> (f64, Vec<Effect>) {
        (laws.iter().map(|law| law.probability).sum(), laws.iter().map(|law| law.standing.effect).collect())
    };
    let untold = VerdictKind::NotDistinguishable;
    if family == Family::TimeVariance && evidence.level_follows_time() {
        because.push(
            "the level of the runs follows the clock: what time does and what level does are one here; one of these \
             drives again, later, would tell"
                .into(),
        );
        let (p, set) = one_of(&ranked.iter().take(ONE_WITH_TIME).collect::<Vec<_>>());
        return blamed(untold, p, set, because);
    }
    if singled_out(ranked).is_none() {
        let (p, set) = one_of(&rivals(ranked));
        return blamed(untold, p, set, because);
    }
    // What the law leaves where it does worst, or on the stretches that its last fit has not seen.
    let (worst, of_what) = match listed.iter().find_map(|l| l.again.as_ref()) {
        Some((again, _)) => {
            (again.remaining_share.sqrt(), "of the gap on stretches that its fit has not seen")
        }
        None => (best.free.worst, "of the linear part's error where it does worst"),
    };
    let everywhere = worst * worst < LEFT;
    if !everywhere {
        because.push(format!("it leaves {:.0} % {of_what}: a part of the answer", 100.0 * worst));
    }
    let kind = if everywhere { VerdictKind::Identified } else { VerdictKind::Partial };
    let effect = own.map_or(standing.effect, |own| own.effect);
    let set = std::iter::once(effect).chain(alike(screening, standing)).collect();
    let blamed = blamed(kind, best.probability, set, because);
    Verdict { effect: Some(effect), family: Some(family), ..blamed }
}

fn each_once(effects: Vec<Effect>) -> Vec<Effect> {
    let mut seen = Vec::new();
    for effect in effects {
        if !seen.contains(&effect) {
            seen.push(effect);
        }
    }
    seen
}
