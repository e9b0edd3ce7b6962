//! From scores to a verdict: parsimony, probabilities, abstention.

use super::score::{EQUAL, Scored, may_be_equal};
use crate::diagnosis::effects::candidate::Part;
use crate::diagnosis::effects::effect::{Effect, Tier};

/// Numbers of the decision, set by hand on some two hundred blind rigs.
struct Calibration {
    /// Smallest remaining share that is told apart,
    floor: f64,
    /// and smallest difference of chi2: what the core's own uncertainty leaves at full level.
    core: f64,
    /// Charge of each tier on the logarithm of the remaining share.
    complexity_penalty: [f64; 4],
    /// Charge of another drive's path alone, which a linear change of all paths contains.
    path: f64,
    /// Charge of each shape number beyond the first, so that a law that contains another does not
    /// win by a hair.
    shape: f64,
    /// Charge of a sandwich beyond that of its tier: it holds every map of its drive.
    sandwich: f64,
    /// Charge of two effects beyond those of each.
    pair: f64,
    /// Charge of each unit of log-likelihood behind the best where that leaves nothing but noise, and the
    /// most that this may come to,
    behind: [f64; 2],
    /// and what the best may leave there, in noise floors squared.
    settled: f64,
    /// Charge of a free shape that nothing needs.
    overflexible: f64,
    /// Charge of a force that works nowhere as one at the response's own place would.
    passive: f64,
    /// Charge of the less usual of two names for one law.
    alias_preferred: f64,
    /// Charge on the logarithm of what a law leaves beside a linear change, over the least that one leaves, and the
    /// most that this may come to.
    beside: [f64; 2],
    /// Sharpness of the probabilities over charged logarithms.
    sharpness: f64,
    /// What the right law may leave in noise floors, beside a share of the gap.
    leaves: f64,
    /// Slope of the logistic of "the catalogue holds it" over the logarithm of what is left in units
    /// of what the right law leaves.
    slope: f64,
}

const CALIBRATION: Calibration = Calibration {
    floor: 0.0003,
    core: 0.08,
    complexity_penalty: [0.0, 0.9, 0.8, 1.4],
    path: 0.6,
    shape: 0.25,
    sandwich: 0.6,
    pair: 0.5,
    behind: [0.03, 1.0],
    settled: 1.15,
    overflexible: 3.0,
    passive: 1.0,
    alias_preferred: 0.7,
    beside: [1.0, 2.0],
    sharpness: 3.0,
    leaves: 0.3,
    slope: 2.5,
};

/// What is stated of a probability `p`: `1 / (1 + exp(-(a + b logit p)))`, `[a, b]` for each kind of
/// ruling. `[0, 1]` states `p` as it is; `scripts/calibrate_diagnosis.py` fitted these to 417 verdicts on blind
/// cases of calibration seeds; sets, of which there were none, are as 70 verdicts before gave them.
struct Stated {
    named: [f64; 2],
    family: [f64; 2],
    set: [f64; 2],
    none: [f64; 2],
}

const STATED: Stated =
    Stated { named: [1.17, 1.30], family: [0.18, 1.27], set: [-0.31, 0.38], none: [0.37, 1.34] };

/// No verdict is stated surer: a few of some hundred blind ones were wrong, and none said why beforehand.
const SUREST: f64 = 0.99;
/// Share of the gap that the right law leaves at most where nothing but the core errs.
const PLAIN: f64 = 0.01;
/// The same for two effects at one place, which bend to more.
const OF_TWO: f64 = 0.001;
/// Part of what a law may leave, beside the noise, that a change of all poles and zeros may, and a free shape: they
/// bend to what a law's own equation errs by.
const BENT: [f64; 2] = [0.3, 0.5];
/// Above this share left the catalogue does not hold the effect.
pub const ABSTAIN: f64 = 0.10;
/// Above this share left a named effect is only part of the answer,
pub const PARTIAL: f64 = 0.02;
/// and above this mean square, 1.2 times the RMS of the noise.
pub const NOISE_LEFT: f64 = 1.44;
/// Share of what the winner leaves, below which a free shape that nothing needs speaks against it.
const PLAINER: f64 = 0.5;
/// Probability of an effect that may not be named.
const UNNAMED: f64 = 0.1;
/// Below this share of the winner's probability an effect is none of those that may be meant: 2 % of a
/// large gap are many noise floors.
const RIVAL: f64 = 0.02;
/// Squared noise floors behind one that leaves nothing but noise from which on an effect is told apart from
/// it: e^6 times less likely, and a share of the gap for what its own equation errs by.
const APART: [f64; 2] = [12.0, 0.0005];
/// Squared noise floors that further numbers must gain to be more than chance, beside the same share.
const GAINS: f64 = 10.0;
/// Below this probability of the effect only the family, or nothing, is stated.
const SURE: f64 = 0.5;
/// Below this probability, whatever its rivals', none is blamed by name: nearly even odds, as of two that
/// nothing tells apart.
const NAMED: f64 = 0.45;

/// Share of the probability that is stated of a set, which its members have at least.
const COVERED: f64 = 0.8;

/// A scored candidate with its probability.
#[derive(Debug, Clone)]
pub struct Ranked {
    pub scored: Scored,
    pub probability: f64,
    charged: f64,
}

/// What the ranking says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ruling {
    Identified,
    Partial,
    FamilyOnly,
    NotDistinguishable,
    NoneOfCatalogue,
}

impl Scored {
    /// Its first part.
    pub fn part(&self) -> &Part {
        &self.fitted.candidate.parts[0]
    }

    /// The effect of its first part.
    pub fn effect(&self) -> Effect {
        self.part().effect
    }

    /// Whether it may not be named however well it fits: it is no more than a linear change or a map
    /// of the drive, or a force that works as none at its place does.
    pub fn unnamed(&self) -> bool {
        self.overflexible || self.not_collocated
    }

    /// Squared noise floors by which another is behind, on all rows that both were fitted to or scored on:
    /// `rows` of them were scored.
    fn ahead_of(&self, other: &Self, rows: f64) -> f64 {
        (other.chi2 - self.chi2) * rows + self.fits_better_than(other)
    }

    /// The same on the rows of the fit alone; 0 where they are of two responses.
    fn fits_better_than(&self, other: &Self) -> f64 {
        let both = self.problem == other.problem;
        if both { (other.fitted.chi2_fit - self.fitted.chi2_fit) * self.fit_rows } else { 0.0 }
    }
}

/// Mean square in noise floors by which a law's own equation may err: a share of the gap.
fn model_error(chi2_none: f64) -> f64 {
    APART[1] * (chi2_none - 1.0)
}

/// Squared noise floors over so many rows by which an effect is behind one to be told apart from it, which itself
/// leaves the mean square `left`: where that is more than noise, squares tell less by as much.
pub fn apart(chi2_none: f64, rows: f64, left: f64) -> f64 {
    APART[0] * left.max(1.0) + model_error(chi2_none) * rows
}

/// Spread of chi2 that noise alone gives, for so many rows.
fn spread(rows: f64) -> f64 {
    (2.0 / rows.max(1.0)).sqrt()
}

/// Probability that what leaves so much is right, or that nothing of the catalogue is.
fn catalogue_probability(tier: Tier, remaining: f64, chi2_none: f64, rows: f64, share: f64) -> f64 {
    let c = &CALIBRATION;
    let gap = (chi2_none - 1.0).max(1e-6);
    let left = (remaining * gap - 1.5 * spread(rows)).max(0.0);
    let bent = match tier {
        Tier::Linear => BENT[0],
        Tier::Free => BENT[1],
        Tier::Scalar | Tier::Law => 1.0,
    };
    let units = left / (bent * (c.leaves + share * gap));
    1.0 / (1.0 + units.max(0.02).powf(c.slope))
}

/// Share of the gap that the right law may leave, since its other equation and the core's error grow
/// with it. Where more errs than the core (a sim that bends
/// by itself, a retune, paths to other responses) a law has to leave less than [`ABSTAIN`].
pub fn allowed(plain: bool) -> f64 {
    if plain { PLAIN } else { ABSTAIN }
}

/// Probability that several effects which together leave so much are what the sim lacks. Two at one place bend to more
/// than each does; `apart`, each at a place of its own, none helps another to bend.
pub fn of_several(remaining: f64, chi2_none: f64, rows: f64, apart: bool) -> f64 {
    let share = if apart { allowed(false) } else { OF_TWO };
    Ruling::Partial.stated(catalogue_probability(Tier::Law, remaining, chi2_none, rows, share))
}

/// Charge of one effect's tier and shape on the logarithm of the remaining share.
fn complexity_penalty(part: &Part) -> f64 {
    let c = &CALIBRATION;
    match part.effect.tier() {
        Tier::Scalar => c.complexity_penalty[0],
        Tier::Linear if part.effect == Effect::CrossAxisLinear => c.path,
        Tier::Linear => c.complexity_penalty[1],
        Tier::Law => c.complexity_penalty[2] + c.shape * part.shapes().saturating_sub(1) as f64,
        Tier::Free => c.complexity_penalty[3] + if part.sandwich { c.sandwich } else { 0.0 },
    }
}

/// Smallest remaining share that is told apart from nothing.
fn floor(chi2_none: f64, rows: f64) -> f64 {
    CALIBRATION.floor + (CALIBRATION.core + 1.5 * spread(rows)) / (chi2_none - 1.0).max(0.1)
}

/// Logarithm of what one effect or two leave of the gap, charged for how much they may bend to.
pub fn charged(parts: &[Part], remaining: f64, chi2_none: f64, rows: f64) -> f64 {
    let further = CALIBRATION.pair * parts.len().saturating_sub(1) as f64;
    (remaining + floor(chi2_none, rows)).ln() + parts.iter().map(complexity_penalty).sum::<f64>() + further
}

/// Ranks candidates, the most believable first; `share` is what the right one may leave of the gap.
pub fn rank(scored: Vec<Scored>, chi2_none: f64, rows: f64, share: f64) -> Vec<Ranked> {
    let c = &CALIBRATION;
    // Free shapes take in what the core and a law's own equation err by: they are no measure for laws.
    let firm: Vec<&Scored> = scored.iter().filter(|s| s.effect().tier() != Tier::Free).collect();
    let best = firm.iter().map(|f| f.chi2).fold(f64::INFINITY, f64::min);
    // Where something is left the likelihood is that of what errs, not of the noise.
    let per_square = (best < c.settled).then_some(0.5 * c.behind[0]);
    let model_error = model_error(chi2_none);
    // What holds a law as a special case has to gain more than that law's own equation errs by.
    let behind = |scored: &Scored| {
        let of = firm.iter().map(|other| {
            let erring = if other.effect().contains(scored.effect()) { model_error } else { 0.0 };
            other.ahead_of(scored, rows) - erring * (rows + other.fit_rows)
        });
        of.fold(0.0, f64::max)
    };
    let further = |scored: &Scored| {
        let overflexible = if scored.overflexible { c.overflexible } else { 0.0 };
        let alias_preferred = if scored.alias_preferred { c.alias_preferred } else { 0.0 };
        let behind = per_square.map_or(0.0, |p| (p * behind(scored)).clamp(0.0, c.behind[1]));
        overflexible + alias_preferred + behind + c.passive * (1.0 - scored.passivity)
    };
    let floor = floor(chi2_none, rows);
    let least = scored.iter().filter_map(|s| s.beside).fold(f64::INFINITY, f64::min);
    let lacks = |beside: f64| (c.beside[0] * ((beside + floor) / (least + floor)).ln()).min(c.beside[1]);
    // Those that were not asked are behind those that were.
    let most = scored.iter().filter_map(|s| s.beside.map(lacks)).fold(0.0, f64::max);
    let charges: Vec<f64> = scored
        .iter()
        .map(|s| {
            charged(&s.fitted.candidate.parts[..1], s.remaining, chi2_none, rows)
                + further(s)
                + s.beside.map_or(most, lacks)
        })
        .collect();
    let mut ranked: Vec<Ranked> = scored
        .into_iter()
        .zip(charges)
        .filter(|(s, _)| s.remaining.is_finite())
        .map(|(scored, charged)| Ranked { scored, probability: 0.0, charged })
        .collect();
    ranked.sort_by(|a, b| a.charged.total_cmp(&b.charged));
    let Some(least) = ranked.first().map(|r| r.charged) else { return ranked };
    let best = &ranked[0].scored;
    // What a straightened free shape closes and the winner does not, is linear and not the winner's.
    let plainer = best.remaining > PARTIAL
        && ranked.iter().any(|r| {
            r.scored.overflexible && r.scored.remaining + floor < PLAINER * (best.remaining + floor)
        });
    let tier = best.effect().tier();
    // What a linear change takes of the rest is half explained.
    let left = (best.remaining * best.beside.unwrap_or(best.remaining)).sqrt();
    let catalogue_probability = if best.unnamed() || plainer {
        UNNAMED
    } else {
        catalogue_probability(tier, left, chi2_none, rows, share)
    };
    let total: f64 = ranked.iter().map(|r| (-c.sharpness * (r.charged - least)).exp()).sum();
    for r in &mut ranked {
        r.probability = catalogue_probability * (-c.sharpness * (r.charged - least)).exp() / total;
    }
    ranked
}

impl Ruling {
    /// Its probability as blind cases have borne it out.
    fn stated(self, p: f64) -> f64 {
        let [a, b] = match self {
            Self::Identified | Self::Partial => STATED.named,
            Self::FamilyOnly => STATED.family,
            Self::NotDistinguishable => STATED.set,
            Self::NoneOfCatalogue => STATED.none,
        };
        let p = p.clamp(1e-3, 1.0 - 1e-3);
        (1.0 / (1.0 + (-(a + b * (p / (1.0 - p)).ln())).exp())).min(SUREST)
    }
}

/// The ruling, its probability, and the effects that these runs cannot tell apart.
pub fn rule(ranked: &[Ranked], chi2_none: f64, rows: f64, seed: u64) -> (Ruling, f64, Vec<Effect>) {
    let (ruling, p, set) = ruling(ranked, chi2_none, rows, seed);
    (ruling, ruling.stated(p), set)
}

fn ruling(ranked: &[Ranked], chi2_none: f64, rows: f64, seed: u64) -> (Ruling, f64, Vec<Effect>) {
    let Some(best) = ranked.first() else { return (Ruling::NoneOfCatalogue, 1.0, Vec::new()) };
    let margin = 1.5 * spread(rows);
    let left = best.scored.remaining - margin / (chi2_none - 1.0).max(1e-6);
    let mut set = vec![best.scored.effect()];
    let model_error = model_error(chi2_none);
    let best_left = best.scored.chi2.max(best.scored.fitted.chi2_fit);
    let enough = apart(chi2_none, rows + best.scored.fit_rows, best_left);
    let gains = GAINS + model_error * best.scored.fit_rows;
    for other in &ranked[1..] {
        let effect = other.scored.effect();
        let chance = may_be_equal(&best.scored.blocks, &other.scored.blocks, seed);
        // Where the winner leaves nothing but noise, squares count as likelihood does; else what it errs by lasts
        // longer than a row, and each block has its say.
        let settled = best.scored.chi2 < CALIBRATION.settled;
        let behind = best.scored.ahead_of(&other.scored, rows) > enough && (settled || !chance);
        let far = behind || other.probability < RIVAL * best.probability;
        // What is more flexible than the winner explains as well by construction, and what holds it as a
        // special case is no other unless its further numbers gain something.
        let flexible = effect.tier() > set[0].tier()
            || (effect.contains(set[0]) && other.scored.fits_better_than(&best.scored) < gains);
        if far || flexible || set.contains(&effect) {
            continue;
        }
        let close = other.scored.remaining - best.scored.remaining < EQUAL;
        if close || chance {
            set.push(effect);
        }
    }
    let catalogue_probability: f64 = ranked.iter().map(|r| r.probability).sum();
    if left > ABSTAIN || catalogue_probability < SURE || best.scored.unnamed() {
        return (Ruling::NoneOfCatalogue, 1.0 - catalogue_probability, set);
    }
    let of_effect: f64 = ranked.iter().filter(|r| r.scored.effect() == set[0]).map(|r| r.probability).sum();
    let of_family: f64 =
        ranked.iter().filter(|r| r.scored.effect().family() == set[0].family()).map(|r| r.probability).sum();
    if of_effect >= NAMED.max(SURE * catalogue_probability) && !set[0].nameless() {
        let all = left <= PARTIAL && best.scored.chi2 - margin <= NOISE_LEFT;
        (if all { Ruling::Identified } else { Ruling::Partial }, of_effect, set)
    } else if of_family >= NAMED.max(COVERED * catalogue_probability) {
        (Ruling::FamilyOnly, of_family, set)
    } else {
        (Ruling::NotDistinguishable, catalogue_probability, covering(set, ranked, catalogue_probability))
    }
}

/// Effects that are not told apart, with the next until the probability of all that is stated is theirs.
fn covering(mut set: Vec<Effect>, ranked: &[Ranked], all: f64) -> Vec<Effect> {
    let of = |set: &[Effect]| -> f64 {
        ranked.iter().filter(|r| set.contains(&r.scored.effect())).map(|r| r.probability).sum()
    };
    for next in ranked {
        if of(&set) >= COVERED * all {
            break;
        }
        if !set.contains(&next.scored.effect()) {
            set.push(next.scored.effect());
        }
    }
    set
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diagnosis::effects::law::Law;

    const GAP: f64 = 1000.0;
    const ROWS: f64 = 10_000.0;

    fn scored(effect: Effect, law: Law, chi2: f64) -> Scored {
        Scored::leaving(Part::force(effect, vec![law], None), chi2, GAP, ROWS)
    }

    #[test]
    fn a_law_that_holds_another_has_to_gain_more_than_the_others_equation_errs_by() {
        let first = |coulomb: f64| {
            let both = vec![
                scored(Effect::CoulombFriction, Law::Coulomb, coulomb),
                scored(Effect::StribeckFriction, Law::Stribeck, 0.98),
            ];
            rank(both, GAP, ROWS, PLAIN)[0].scored.effect()
        };
        assert_eq!(first(0.98 + 0.1 * model_error(GAP)), Effect::CoulombFriction);
        assert_eq!(first(0.98 + 1.5 * model_error(GAP)), Effect::StribeckFriction);
        // Neither of these holds the other: squares count.
        let two = vec![
            scored(Effect::CubicStiffness, Law::Cubic, 0.98 + 0.1 * model_error(GAP)),
            scored(Effect::BumpStop, Law::BumpStop, 0.98),
        ];
        assert_eq!(rank(two, GAP, ROWS, PLAIN)[0].scored.effect(), Effect::BumpStop);
    }

    #[test]
    fn a_set_holds_most_of_the_probability_that_is_stated_of_it() {
        let of = |effect, probability| Ranked {
            scored: scored(effect, Law::Cubic, 1.0),
            probability,
            charged: 0.0,
        };
        let ranked = [
            of(Effect::BumpStop, 0.3),
            of(Effect::BumpStop, 0.05),
            of(Effect::OneSidedStop, 0.15),
            of(Effect::CubicStiffness, 0.05),
        ];
        let set = |members: &[Effect]| covering(members.to_vec(), &ranked, 0.55);
        assert_eq!(set(&[Effect::BumpStop]), [Effect::BumpStop, Effect::OneSidedStop]);
        assert_eq!(set(&[Effect::BumpStop, Effect::OneSidedStop]).len(), 2);
    }

    #[test]
    fn squares_of_the_fit_count_as_those_of_the_selection_do() {
        let mut better = scored(Effect::CubicStiffness, Law::Cubic, 0.98);
        let mut worse = scored(Effect::BumpStop, Law::BumpStop, 0.98);
        (better.fitted.chi2_fit, worse.fitted.chi2_fit) = (0.98, 0.99);
        let first = |both: Vec<Scored>| rank(both, GAP, ROWS, PLAIN)[0].scored.effect();
        assert_eq!(first(vec![worse.clone(), better.clone()]), Effect::CubicStiffness);
        (better.fitted.chi2_fit, worse.fitted.chi2_fit) = (0.99, 0.98);
        assert_eq!(first(vec![better, worse]), Effect::BumpStop);
    }

    #[test]
    fn a_law_that_lacks_a_linear_part_alone_goes_before_one_that_has_bent() {
        let mut both = vec![
            scored(Effect::BumpStop, Law::BumpStop, 9.0),
            scored(Effect::ValveFlow, Law::Valve, 18.0),
            scored(Effect::CoulombFriction, Law::Coulomb, 12.0),
        ];
        let first = |both: &[Scored]| {
            let ranked = rank(both.to_vec(), GAP, ROWS, PLAIN);
            (ranked[0].scored.effect(), ranked[0].probability)
        };
        assert_eq!(first(&both).0, Effect::BumpStop);
        (both[0].beside, both[1].beside) = (Some(0.006), Some(0.0));
        let (effect, p) = first(&both);
        assert_eq!(effect, Effect::ValveFlow);
        both[1].beside = Some(0.005);
        assert_eq!(first(&both).0, Effect::BumpStop, "both lack more than that");
        // Alone it would leave too much to be believed.
        let alone = first(&both[1..2]).1;
        assert!(p > 1.5 * alone, "{p} {alone}");
    }

    #[test]
    fn where_the_winner_leaves_more_than_noise_squares_tell_less() {
        let set = |behind: f64| {
            let left = 1.5;
            let both = vec![
                scored(Effect::CubicStiffness, Law::Cubic, left),
                scored(Effect::BumpStop, Law::BumpStop, left + behind),
            ];
            ruling(&rank(both, GAP, ROWS, PLAIN), GAP, ROWS, 1).2
        };
        let enough = apart(GAP, 2.0 * ROWS, 1.5);
        assert!(enough > apart(GAP, 2.0 * ROWS, 1.0));
        // Both remain within 2 % of the gap.
        assert_eq!(set(0.9 * enough / (2.0 * ROWS)), [Effect::CubicStiffness, Effect::BumpStop]);
        assert_eq!(set(1.1 * enough / (2.0 * ROWS)), [Effect::CubicStiffness]);
    }
}
