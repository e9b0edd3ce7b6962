//! From what laws leave elsewhere to a verdict.

use super::evidence::Evidence;
use super::hypotheses::Listed;
use super::words;
use crate::engine::diagnosis::effect::{Effect, Family};
use crate::engine::diagnosis::input::Input;
use crate::engine::diagnosis::report::{Verdict, VerdictKind};
use crate::engine::diagnosis::screen::{Screening, Standing, Transfer};

/// What a law leaves of the linear part's error at which it is as likely as not that any law is there: on linear rigs
/// and on noise no law was seen to leave less than 0.81, true laws left 0.28 to 0.76.
const EVEN: f64 = 0.79;
/// How steeply that grows with the logarithm of what is left.
const STEEP: f64 = 12.0;
/// How much less likely a family is that leaves more than another: the exponent of what is left. A tenth more is half
/// as likely.
const RIVAL: f64 = 7.0;
/// Nothing is stated surer.
const SUREST: f64 = 0.97;
/// Share of the families' probability from which on one of them is named.
const NAMED: f64 = 0.6;
/// Below this share a rival is none.
const NO_RIVAL: f64 = 0.12;
/// Effects of one family whose errors differ by less are told apart by nothing.
const ALIKE: f64 = 1.03;
/// Share of the gap's power that an identified effect leaves at most in every group.
const LEFT: f64 = 0.1;

/// The foremost law of a family with its share of the probability that any law is there.
pub(super) struct Ranked<'a> {
    pub standing: &'a Standing,
    /// What it leaves of the linear part's error.
    pub left: f64,
    pub share: f64,
}

/// Families by what they leave.
pub(super) fn ranked(screening: &Screening) -> Vec<Ranked<'_>> {
    // What runs away when it is simulated forward is no cause.
    let law = |standing: &&Standing| !super::linear(standing.effect) && standing.free.is_some();
    let mut all: Vec<Ranked<'_>> = screening
        .foremost()
        .into_iter()
        .filter(law)
        .map(|standing| Ranked { standing, left: left(standing), share: 0.0 })
        .collect();
    all.sort_by(|a, b| a.left.total_cmp(&b.left));
    let weight = |r: &Ranked<'_>| r.left.max(1e-6).powf(-RIVAL);
    let total: f64 = all.iter().map(weight).sum();
    all.iter_mut().for_each(|r| r.share = weight(r) / total);
    all
}

/// What a law leaves: the geometric mean of regression and free run. The regression ranks laws that the free run, with
/// its steps in time, makes poorly (dry friction); the free run takes away what a measured argument gives away.
fn left(standing: &Standing) -> f64 {
    standing.free.as_ref().map_or(1.0, |free| (free.ratio * standing.ratio).sqrt())
}

/// Probability that a law is there at all.
pub(super) fn any(left: f64) -> f64 {
    1.0 / (1.0 + (left / EVEN).powf(STEEP))
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
        because,
    };
    let mut because = vec![words::size(input, evidence)];
    let verdict = if evidence.whole(r) < input.material_gap {
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
    } else if evidence.linear(r) < input.material_gap {
        because.push(format!(
            "a linear part fitted to these runs leaves {:.2} % of runs that it has not seen: the model errs, no law is \
             missing; fit it again with these runs",
            100.0 * evidence.linear(r)
        ));
        bare(VerdictKind::NoneOfCatalogue, 0.9, because)
    } else {
        named(input, screening, ranked, listed, because, bare)
    };
    Verdict { in_words: words::sentence(&verdict, listed.first().map(|l| &l.hypothesis)), ..verdict }
}

fn named(
    input: &Input,
    screening: &Screening,
    ranked: &[Ranked<'_>],
    listed: &[Listed],
    mut because: Vec<String>,
    bare: impl Fn(VerdictKind, f64, Vec<String>) -> Verdict,
) -> Verdict {
    let Some(best) = ranked.first() else {
        because.push("no law predicts anything of it on runs that it has not seen".into());
        return bare(VerdictKind::Undecided, 0.8, because);
    };
    because.extend(ranked.iter().take(3).map(|r| words::left(input, r)));
    let there = any(best.left);
    // The sim with the law in it has to be better than the sim.
    let helps = listed.first().is_some_and(|l| l.hypothesis.remaining_share < 1.0);
    if there < 0.5 || !helps {
        because.push(
            "nothing predicts enough of it on runs that it has not seen to tell a cause from noise; the same drive \
             again would tell the noise"
                .into(),
        );
        let p = if helps { 1.0 - there } else { 0.7 };
        return bare(VerdictKind::Undecided, p.min(0.9), because);
    }
    let rivals: Vec<&Ranked<'_>> = ranked.iter().filter(|r| r.share > NO_RIVAL * best.share).collect();
    let among = |family: Family| -> Vec<Effect> {
        let least =
            screening.standings.iter().filter(|s| s.family == family).map(|s| s.ratio).fold(1.0, f64::min);
        let mut effects: Vec<Effect> = Vec::new();
        for standing in screening.standings.iter().filter(|s| s.family == family && s.ratio < ALIKE * least) {
            if !effects.contains(&standing.effect) {
                effects.push(standing.effect);
            }
        }
        effects
    };
    let standing = best.standing;
    let (at, between) = words::place(input, standing.place);
    let free = standing.free.as_ref();
    let everywhere = free.is_some_and(|f| f.worst * f.worst < LEFT);
    let clear = best.share >= NAMED;
    let kind = match (clear, everywhere) {
        (false, _) => VerdictKind::NotDistinguishable,
        (true, true) => VerdictKind::Identified,
        (true, false) => VerdictKind::Partial,
    };
    let mut set = vec![standing.effect];
    let others =
        if clear { among(standing.family) } else { rivals.iter().map(|r| r.standing.effect).collect() };
    others.into_iter().for_each(|effect| {
        if !set.contains(&effect) {
            set.push(effect);
        }
    });
    if clear && !everywhere {
        because.push(format!(
            "it leaves {:.0} % of the linear part's error where it does worst: a part of the answer",
            100.0 * free.map_or(standing.worst, |f| f.worst)
        ));
    }
    let p = if clear { there * best.share } else { there };
    Verdict {
        effect: clear.then_some(standing.effect),
        family: clear.then_some(standing.family),
        axis: words::axis(input, standing),
        at,
        between,
        channel: Some(input.responses[standing.response].name.clone()),
        equivalence_set: set,
        ..bare(kind, p.min(SUREST), because)
    }
}
