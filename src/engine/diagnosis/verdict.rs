//! From the contest's outcome to the stated verdict.

use super::input::{Input, Mode};
use super::report::{HeldOut, Hypothesis, Verdict, VerdictKind};
use crate::diagnosis::data::overview::Overview;
use crate::diagnosis::data::prepare::Prepared;
use crate::diagnosis::data::settled::Left;
use crate::diagnosis::effects::effect::{Effect, Tier};
use crate::diagnosis::findings::hypothesis::{Held, axis, closed_most, closes_most, place};
use crate::diagnosis::findings::second::Two;
use crate::diagnosis::search::contest::Outcome;
use crate::diagnosis::search::decide::{NOISE_LEFT, PARTIAL, Ranked, Ruling, rule};
use crate::diagnosis::transfer::{MODEL_ERRS, sentence};

/// What an equation is believed at most that leaves more than the noise and that transfer does not name.
const BESIDE_TRANSFER: f64 = 0.8;
/// What it is believed at most that the catalogue lacks the cause, where the gap holds more than a change: even odds.
const LACKED_MORE: f64 = 0.5;
/// Share of what a further effect closes that all leave at most where it is named for however little it closes.
const SETTLED: f64 = 0.1;
/// What an identified effect closes at least on the test runs.
const CLOSES: f64 = 0.95;
/// How sure it is at least that none of the catalogue is the cause where what was chosen is blamed no more.
const NOTHING_CARRIED: f64 = 0.5;
/// Share of the gap, by power, that a model's own error makes up where nothing else is blamed for it.
const OWN: f64 = 0.5;
/// Why a model errs alone that a change adds nothing to.
const NOTHING_BEYOND: &str = "nothing beyond that error is left: fit the model again";

impl Verdict {
    /// Where nothing of the catalogue alone is the answer, or several effects together say that the first is another:
    /// the first of them as part of it, if they are believed; that it is none is less believable for all that they close.
    pub(super) fn or_two(self, input: &Input, overview: &Overview, two: &Two) -> Self {
        if !two.answers() {
            let none = self.kind == VerdictKind::NoneOfCatalogue;
            let left = if none { 1.0 - two.probability } else { 1.0 };
            return Self { probability: self.probability * left, ..self };
        }
        let Held { response, part, .. } = &two.explanation.held[0];
        let mut because = self.because;
        because.push(format!(
            "{} and {} together leave {:.2} noise floors squared",
            part.effect.name(),
            two.second.effect.name(),
            two.second.chi2
        ));
        let channel = closes_most(&two.explanation.places(), overview).problem.response;
        Self {
            kind: VerdictKind::Partial,
            effect: Some(part.effect),
            family: Some(part.effect.family()),
            axis: axis(input, *response, part),
            at: place(input, *response, part),
            between: None,
            in_words: String::new(),
            channel: Some(input.responses[channel].name.clone()),
            probability: two.probability,
            equivalence_set: vec![part.effect],
            effects: Vec::new(),
            because,
        }
    }
}

impl Verdict {
    /// What free runs fitted down to the noise of repeats say beside a verdict by transfer between runs; `None` where
    /// that stands. An equation that leaves no more than repeats differ by is the law, or so near to it that nothing
    /// measured tells them apart; one that leaves more is believed only where transfer names nothing, or names its
    /// family and leaves more still. What [bends](Self::bends) is no equation: it gives way to a law that transfer identifies.
    /// `left` are the shares of the gap that both leave, that by transfer last.
    pub(super) fn beside(mut self, transfer: &Self, left: [f64; 2]) -> Option<Self> {
        let identified = self.kind == VerdictKind::Identified;
        let of_family = identified || matches!(self.kind, VerdictKind::Partial | VerdictKind::FamilyOnly);
        let one = of_family && self.family == transfer.family && left[0] < left[1];
        let family = |effect: &Effect| Some(effect.family()) == self.family;
        let open = match transfer.kind {
            VerdictKind::NotDistinguishable => transfer.equivalence_set.iter().any(family),
            kind => !kind.blames(),
        };
        if one || identified && !(self.bends() && transfer.kind == VerdictKind::Identified) {
            return Some(self);
        }
        if self.kind != VerdictKind::Partial || !open || self.bends() {
            return None;
        }
        self.probability = self.probability.min(BESIDE_TRANSFER);
        self.because.extend(transfer.because.iter().cloned());
        Some(self)
    }

    /// Whether it names what bends to whatever it meets, and leaves little of any law: a nonlinearity between two filters, a
    /// free shape, or nothing.
    pub(super) fn bends(&self) -> bool {
        self.effect.is_none_or(|effect| effect == Effect::Sandwich || effect.tier() == Tier::Free)
    }

    /// Where the linear core stands for a sim that errs by itself and nothing else is left: that the sim errs.
    pub(super) fn of_a_sim_stood_for(mut self, input: &Input, prepared: &Prepared) -> Self {
        let stood_for = told(&prepared.sim_errs).filter(|(r, _)| prepared.stands[*r]);
        let Some((r, errs)) = worst(stood_for) else { return self };
        let hence = ", where a linear part fitted to them does not: that part stands for it here";
        self.because.push(of_baseline(input, r, errs, hence));
        let alone = self.kind == VerdictKind::NoMaterialGap && errs >= input.material_gap;
        if alone { self.errs_alone(NOTHING_BEYOND) } else { self }
    }

    /// Where a sim that errs by itself bends with the rig and stays, and most of what it leaves is what it erred by before:
    /// that the sim errs.
    pub(super) fn of_a_sim_that_stays(
        mut self,
        input: &Input,
        prepared: &Prepared,
        overview: &Overview,
    ) -> Self {
        let errs = || told(&prepared.sim_errs).filter(|(r, _)| !prepared.stands[*r]);
        let of_most = errs().find(|(r, _)| *r == overview.worst());
        let Some((r, errs)) = of_most.or_else(|| worst(errs())) else { return self };
        let hence = "; it follows these runs far better than their linear part, so it stays, and what it leaves of them holds \
                     that error";
        self.because.push(of_baseline(input, r, errs, hence));
        let gap = overview.systematic(r);
        if self.kind == VerdictKind::NoMaterialGap {
            return if gap >= input.material_gap { self.errs_alone(NOTHING_BEYOND) } else { self };
        }
        let most = of_most.is_some() && errs * errs > OWN * gap * gap;
        let told = self.kind.blames() || self.kind == VerdictKind::NoneOfCatalogue;
        if !(most && told) {
            return self;
        }
        let this = if self.kind.blames() { self.withdrawn() } else { self };
        this.errs_alone("that error is most of it: fit the model again")
    }

    /// The same, as a lack of the sim that no change of the rig has part in.
    fn errs_alone(mut self, because: &str) -> Self {
        self.because.push(because.into());
        Self { kind: VerdictKind::NoneOfCatalogue, in_words: MODEL_ERRS.into(), ..self }
    }

    /// Where nothing explains what a sim leaves that left most of it before the change already: that the catalogue lacks the
    /// cause is not sure, since a change of its own size may hide in what the sim has always left.
    pub(super) fn of_a_sim_that_left_much(
        mut self,
        input: &Input,
        prepared: &Prepared,
        overview: &Overview,
    ) -> Self {
        let r = overview.worst();
        let lacked = self.kind == VerdictKind::NoneOfCatalogue && self.probability > LACKED_MORE;
        // In situ the baseline holds what is sought.
        if !lacked || input.mode == Mode::InSitu || prepared.stands[r] {
            return self;
        }
        let much = |left: &f64| *left >= input.material_gap && *left > OWN.sqrt() * overview.systematic(r);
        if let Some(left) = Left::of(&input.baseline, r).map(|sim| sim.relative()).filter(much) {
            self.probability = LACKED_MORE;
            self.because.push(format!(
                "the model left {:.1} % of {} on the baseline runs already, before any change: fit a better model first",
                100.0 * left,
                input.responses[r].name
            ));
        }
        self
    }

    /// The same with nothing blamed.
    fn withdrawn(self) -> Self {
        let probability = (1.0 - self.probability).max(NOTHING_CARRIED);
        let kind = VerdictKind::NoneOfCatalogue;
        Self { kind, effect: None, family: None, axis: None, at: None, probability, ..self }
    }

    /// Where a linear sim and the linear part of the baseline part ways on the runs and nothing explains what is left:
    /// the sim was estimated poorly, or at another level of a rig that bends by itself. The gap then holds what the sim
    /// lacked before the change too, which may be any effects of the catalogue together.
    pub(super) fn of_a_sim_that_lacked_more(mut self, input: &Input, prepared: &Prepared) -> Self {
        let lacked = self.kind == VerdictKind::NoneOfCatalogue;
        let Some((r, by)) = worst(told(&prepared.sim_differs)).filter(|_| lacked) else { return self };
        self.probability = self.probability.min(LACKED_MORE);
        self.because.push(format!(
            "on these runs the model differs by {:.1} % of {} from the linear part of the baseline runs: the rig bends by \
             itself at their level, or the model errs, and what it lacked before the change is part of this gap; fit a \
             model that follows the rig at this level",
            100.0 * by,
            input.responses[r].name
        ));
        self
    }

    /// Names the effects of the first hypothesis, if it is the effect that is blamed, and says it in a sentence. A further
    /// effect that closes no more than the equation of the first may err by helps to predict, and is no cause; unless
    /// next to nothing is left with it, which is more than chance does for such an error.
    pub(super) fn naming(mut self, first: Option<&Hypothesis>) -> Self {
        if let Some(first) = first.filter(|first| self.kind.blames() && self.effect == Some(first.effect)) {
            let closes = |share: f64| share > PARTIAL || first.remaining_share < SETTLED * share;
            let causes = first.effects.iter().enumerate().filter(|(k, e)| *k == 0 || closes(e.share_of_gap));
            self.effects = causes.map(|(_, effect)| effect.clone()).collect();
        }
        if self.in_words.is_empty() {
            self.in_words = sentence(&self, first);
        }
        self
    }

    /// What was chosen on the select runs is only part of the answer if the test runs hold a good deal
    /// that it does not close: a rare effect may be missing from the others. It is none if it closes nothing of them.
    pub(super) fn on_test(mut self, chosen: Option<&Hypothesis>) -> Self {
        let meant = |h: &&Hypothesis| self.kind.blames() && self.equivalence_set.first() == Some(&h.effect);
        let Some(chosen) = chosen.filter(meant) else { return self };
        let HeldOut { closure, chi2_after, .. } = chosen.held_out;
        if chi2_after <= NOISE_LEFT {
            return self;
        }
        if closure <= 0.0 {
            self.because.push(format!("on the test runs {} closes nothing", chosen.effect.name()));
            return self.withdrawn();
        }
        if closure < CLOSES && self.kind == VerdictKind::Identified {
            self.kind = VerdictKind::Partial;
            self.because.push(format!("on the test runs it closes only {:.0} %", 100.0 * closure));
        }
        self
    }
}

/// What is told of some responses, with their indices.
fn told(of: &[Option<f64>]) -> impl Iterator<Item = (usize, f64)> {
    of.iter().enumerate().filter_map(|(r, of)| Some((r, (*of)?)))
}

fn worst(errs: impl Iterator<Item = (usize, f64)>) -> Option<(usize, f64)> {
    errs.max_by(|a, b| a.1.total_cmp(&b.1))
}

/// That a model errs by `errs` of a response on the baseline runs, and what follows.
fn of_baseline(input: &Input, response: usize, errs: f64, hence: &str) -> String {
    let name = &input.responses[response].name;
    format!("the model itself errs by {:.1} % of {name} on the baseline runs{hence}", 100.0 * errs)
}

/// Rules on the outcome and says why.
pub(super) fn judge(
    input: &Input,
    prepared: &Prepared,
    overview: &Overview,
    outcome: &Outcome<'_>,
) -> Verdict {
    let ranked = &outcome.ranked;
    let (ruling, probability, set) = rule(ranked, outcome.chi2_none, outcome.rows, input.seed);
    let channel = match ranked.first() {
        Some(best) => closed_most(prepared, overview, &best.scored),
        None => overview.worst(),
    };
    let best = ranked.first();
    let effect = best.map(|b| b.scored.effect());
    let mut because = Vec::new();
    if let Some(best) = best {
        because.push(format!(
            "{} leaves {:.1} % of the gap on the select runs ({:.2} noise floors squared of {:.1})",
            best.scored.effect().name(),
            100.0 * best.scored.remaining,
            best.scored.chi2,
            outcome.chi2_none
        ));
    }
    if let Some(rival) = ranked.iter().find(|x| Some(x.scored.effect()) != effect) {
        because.push(format!(
            "next best {} leaves {:.1} %",
            rival.scored.effect().name(),
            100.0 * rival.scored.remaining
        ));
    }
    let beside = |ranked: &Ranked| {
        let left = 100.0 * ranked.scored.beside?;
        Some(format!("{} {left:.1} %", ranked.scored.effect().name()))
    };
    let beside: Vec<String> = ranked.iter().filter_map(beside).collect();
    if !beside.is_empty() {
        because.push(format!("what a law leaves beside a linear change: {}", beside.join(", ")));
    }
    if input.mode == Mode::InSitu && [Effect::BumpStop, Effect::Clearance].iter().all(|e| set.contains(e)) {
        because.push(
            "with the linear part free a bump stop and a clearance are one law, called by how often its gap is left"
                .into(),
        );
    }
    let mut kind = match ruling {
        Ruling::Identified => VerdictKind::Identified,
        Ruling::Partial => VerdictKind::Partial,
        Ruling::FamilyOnly => VerdictKind::FamilyOnly,
        Ruling::NotDistinguishable => VerdictKind::NotDistinguishable,
        Ruling::NoneOfCatalogue => VerdictKind::NoneOfCatalogue,
    };
    let blames = matches!(kind, VerdictKind::Identified | VerdictKind::Partial);
    if blames && input.mode == Mode::InSitu && effect == Some(Effect::LinearChange) {
        kind = VerdictKind::NoMaterialGap;
        because.push("a linear retune of the sim closes the gap".into());
    }
    if kind == VerdictKind::Identified && !prepared.from_repeats {
        kind = VerdictKind::Partial;
        because.push("without repeats the noise floor is assumed".into());
    }
    if kind == VerdictKind::Identified && prepared.pooled {
        kind = VerdictKind::Partial;
        because.push("it acts so seldom that it was chosen on what it was fitted to".into());
    }
    let names_effect = matches!(kind, VerdictKind::Identified | VerdictKind::Partial);
    let names_family = names_effect || kind == VerdictKind::FamilyOnly;
    Verdict {
        kind,
        effect: effect.filter(|_| names_effect),
        family: effect.filter(|_| names_family).map(Effect::family),
        axis: best
            .filter(|_| names_family)
            .and_then(|b| axis(input, b.scored.problem, &b.scored.fitted.candidate.parts[0])),
        at: best
            .filter(|_| names_family)
            .and_then(|b| place(input, b.scored.problem, &b.scored.fitted.candidate.parts[0])),
        between: None,
        in_words: String::new(),
        channel: Some(input.responses[channel].name.clone()),
        probability: probability.clamp(0.0, 1.0),
        equivalence_set: set,
        effects: Vec::new(),
        because,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diagnosis::diagnose;
    use crate::diagnosis::tests::rig::{few, friction, request};
    use crate::progress::unwatched;

    #[test]
    fn an_effect_that_does_not_close_the_test_runs_is_identified_no_more() {
        let report =
            diagnose(&Input { catalogue: few(), ..request(friction, 0.01) }, &unwatched).unwrap().report;
        let mut first = report.hypotheses[0].clone();
        let verdict = Verdict {
            kind: VerdictKind::Identified,
            effect: Some(first.effect),
            because: Vec::new(),
            ..report.verdict
        };
        assert_eq!(verdict.clone().on_test(Some(&first)), verdict);
        (first.held_out.closure, first.held_out.chi2_after) = (0.47, 91.0);
        let found = verdict.clone().on_test(Some(&first));
        assert_eq!((found.kind, found.effect), (VerdictKind::Partial, verdict.effect));
        assert!(found.because[0].contains("47 %"), "{:?}", found.because);
        first.held_out.closure = -0.1;
        let withdrawn = verdict.clone().on_test(Some(&first));
        assert_eq!(
            (withdrawn.kind, withdrawn.effect, withdrawn.at.clone()),
            (VerdictKind::NoneOfCatalogue, None, None)
        );
        assert!(
            withdrawn.probability < 1.0 && withdrawn.because[0].contains("closes nothing"),
            "{withdrawn:?}"
        );
        first.held_out.chi2_after = 1.1;
        assert_eq!(verdict.clone().on_test(Some(&first)), verdict, "nothing is left above the noise");
    }

    #[test]
    fn a_further_effect_is_named_where_it_closes_more_than_an_equation_errs_by() {
        let report =
            diagnose(&Input { catalogue: few(), ..request(friction, 0.01) }, &unwatched).unwrap().report;
        let bare = Verdict { effects: Vec::new(), in_words: String::new(), ..report.verdict };
        let mut first = report.hypotheses[0].clone();
        first.effects.push(first.effects[0].clone());
        for (share, left, named) in [(0.01, 0.005, 1), (0.05, 0.005, 2), (0.01, 0.0005, 2)] {
            (first.effects[1].share_of_gap, first.remaining_share) = (share, left);
            let verdict = bare.clone().naming(Some(&first));
            assert_eq!(verdict.effects, first.effects[..named]);
            assert_eq!(verdict.in_words.contains("together they explain"), named > 1, "{}", verdict.in_words);
        }
        let other = Verdict { effect: Some(Effect::Gain), ..bare };
        assert_eq!(other.naming(Some(&first)).effects, [], "the first hypothesis is not what is blamed");
    }

    #[test]
    fn an_equation_stands_beside_transfer_where_it_leaves_only_noise_or_where_transfer_names_nothing() {
        let report =
            diagnose(&Input { catalogue: few(), ..request(friction, 0.01) }, &unwatched).unwrap().report;
        let of = |kind, effect: Option<Effect>, set: &[Effect]| Verdict {
            kind,
            effect,
            family: effect.map(Effect::family),
            probability: 0.9,
            equivalence_set: set.to_vec(),
            ..report.verdict.clone()
        };
        let friction = Some(Effect::CoulombFriction);
        let stated = |kind, effect| of(kind, effect, &[]);
        let named = stated(VerdictKind::Partial, Some(Effect::CubicStiffness));
        assert!(stated(VerdictKind::Identified, friction).beside(&named, [0.1, 0.05]).is_some());
        assert_eq!(stated(VerdictKind::Partial, friction).beside(&named, [0.01, 0.05]), None);
        let same = stated(VerdictKind::Partial, Some(Effect::FreeStiffness));
        assert!(same.clone().beside(&named, [0.01, 0.05]).is_some());
        assert_eq!(same.beside(&named, [0.1, 0.05]), None);
        let open = stated(VerdictKind::Undecided, None);
        let beside = stated(VerdictKind::Partial, friction).beside(&open, [0.1, 0.2]).unwrap();
        assert_eq!(beside.probability, BESIDE_TRANSFER);
        assert_eq!(stated(VerdictKind::Partial, Some(Effect::Sandwich)).beside(&open, [0.1, 0.2]), None);
        let sandwich = stated(VerdictKind::Identified, Some(Effect::Sandwich));
        assert_eq!(sandwich.clone().beside(&open, [0.1, 0.2]), Some(sandwich.clone()));
        assert_eq!(
            sandwich.clone().beside(&named, [0.01, 0.1]),
            Some(sandwich.clone()),
            "the law is a part only"
        );
        let law = stated(VerdictKind::Identified, Some(Effect::QuadraticDamping));
        assert_eq!(sandwich.beside(&law, [0.01, 0.05]), None, "it bends to whatever it meets");
        assert!(stated(VerdictKind::Identified, friction).beside(&law, [0.01, 0.05]).is_some());
        assert_eq!(stated(VerdictKind::NoneOfCatalogue, None).beside(&open, [0.1, 0.2]), None);
        let several = |set: &[Effect]| of(VerdictKind::NotDistinguishable, None, set);
        let partial = || stated(VerdictKind::Partial, friction);
        assert!(
            partial().beside(&several(&[Effect::Clearance, Effect::StribeckFriction]), [0.1, 0.2]).is_some()
        );
        assert_eq!(partial().beside(&several(&[Effect::Clearance, Effect::DeadZone]), [0.1, 0.2]), None);
    }
}
