//! From scores to a verdict: parsimony, probabilities, abstention.

use super::effect::{Effect, Tier};
use super::score::{Scored, may_be_equal};

/// Numbers of the decision, set by hand after a look at some hundred blind rigs; no fit has calibrated
/// the probabilities that come of them.
struct Calibration {
    /// Smallest remaining share that is told apart,
    floor: f64,
    /// and smallest difference of chi2: what the core's own uncertainty leaves at full level.
    core: f64,
    /// Charge of each tier on the logarithm of the remaining share.
    charge: [f64; 4],
    /// Charge of each shape number beyond the first, so that a law that contains another does not
    /// win by a hair.
    shape: f64,
    /// Sharpness of the probabilities over charged logarithms.
    sharpness: f64,
    /// Logistic of "the catalogue holds it" over the logarithm of the best remaining share:
    /// midpoint and slope.
    held: [f64; 2],
}

const CALIBRATION: Calibration = Calibration {
    floor: 0.0003,
    core: 0.08,
    charge: [0.0, 0.5, 0.6, 1.2],
    shape: 0.25,
    sharpness: 3.0,
    held: [0.10, 1.6],
};

/// Above this share left the catalogue does not hold the effect.
pub(super) const ABSTAIN: f64 = 0.10;
/// Above this share left a named effect is only part of the answer.
pub(super) const PARTIAL: f64 = 0.02;
/// Effects whose remaining shares differ by less are one set.
const EQUAL: f64 = 0.02;
/// Below this probability of the effect only the family, or nothing, is stated.
const SURE: f64 = 0.5;

/// A scored candidate with its probability.
#[derive(Debug, Clone)]
pub(super) struct Ranked {
    pub scored: Scored,
    pub probability: f64,
    charged: f64,
}

/// What the ranking says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Ruling {
    Identified,
    Partial,
    FamilyOnly,
    NotDistinguishable,
    NoneOfCatalogue,
}

impl Scored {
    /// The effect of its first part.
    pub fn effect(&self) -> Effect {
        self.fitted.candidate.parts[0].effect
    }
}

/// Spread of a remaining share that noise alone gives, for so many rows.
fn spread(chi2_none: f64, rows: f64) -> f64 {
    (2.0 / rows.max(1.0)).sqrt() / (chi2_none - 1.0).max(1e-6)
}

/// Ranks candidates of one response, the most believable first.
pub(super) fn rank(scored: Vec<Scored>, chi2_none: f64, rows: f64) -> Vec<Ranked> {
    let c = &CALIBRATION;
    let floor = c.floor + c.core / (chi2_none - 1.0).max(0.1) + 1.5 * spread(chi2_none, rows);
    let charge = |scored: &Scored| match scored.effect().tier() {
        Tier::Scalar => c.charge[0],
        Tier::Linear => c.charge[1],
        Tier::Law => {
            let shapes = scored.fitted.candidate.parts[0].shapes();
            c.charge[2] + c.shape * shapes.saturating_sub(1) as f64
        }
        Tier::Free => c.charge[3],
    };
    let mut ranked: Vec<Ranked> = scored
        .into_iter()
        .filter(|s| s.remaining.is_finite())
        .map(|scored| {
            let charged = (scored.remaining + floor).ln() + charge(&scored);
            Ranked { scored, probability: 0.0, charged }
        })
        .collect();
    ranked.sort_by(|a, b| a.charged.total_cmp(&b.charged));
    let Some(best) = ranked.first().map(|r| r.charged) else { return ranked };
    let least = ranked.iter().map(|r| r.scored.remaining).fold(f64::INFINITY, f64::min);
    let held = 1.0 / (1.0 + (c.held[1] * ((least + floor) / c.held[0]).ln()).exp());
    let total: f64 = ranked.iter().map(|r| (-c.sharpness * (r.charged - best)).exp()).sum();
    for r in &mut ranked {
        r.probability = held * (-c.sharpness * (r.charged - best)).exp() / total;
    }
    ranked
}

/// The ruling, its probability, and the effects that these runs cannot tell apart.
pub(super) fn rule(ranked: &[Ranked], chi2_none: f64, rows: f64, seed: u64) -> (Ruling, f64, Vec<Effect>) {
    let Some(best) = ranked.first() else { return (Ruling::NoneOfCatalogue, 1.0, Vec::new()) };
    let margin = 1.5 * spread(chi2_none, rows);
    let left = best.scored.remaining - margin;
    let mut set = vec![best.scored.effect()];
    for other in &ranked[1..] {
        let effect = other.scored.effect();
        // What is more flexible than the winner explains as well by construction.
        if effect.tier() > best.scored.effect().tier() || set.contains(&effect) {
            continue;
        }
        let close = other.scored.remaining - best.scored.remaining < EQUAL;
        if close || may_be_equal(&best.scored.blocks, &other.scored.blocks, seed) {
            set.push(effect);
        }
    }
    let held: f64 = ranked.iter().map(|r| r.probability).sum();
    if left > ABSTAIN {
        return (Ruling::NoneOfCatalogue, 1.0 - held, set);
    }
    let of_effect: f64 = ranked.iter().filter(|r| r.scored.effect() == set[0]).map(|r| r.probability).sum();
    let of_family: f64 =
        ranked.iter().filter(|r| r.scored.effect().family() == set[0].family()).map(|r| r.probability).sum();
    if of_effect >= SURE * held {
        (if left > PARTIAL { Ruling::Partial } else { Ruling::Identified }, of_effect, set)
    } else if of_family >= 0.8 * held {
        (Ruling::FamilyOnly, of_family, set)
    } else {
        (Ruling::NotDistinguishable, held, set)
    }
}
