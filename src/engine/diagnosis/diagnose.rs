//! The diagnosis from request to report.

use rayon::prelude::*;

use super::augmented::Augmented;
use super::input::{Input, Mode, Role};
use super::report::{
    DataSplit, Fingerprints, Gap, Hypothesis, NoiseSource, Remaining, Report, RunPart, SecondEffect, Verdict,
    VerdictKind,
};
use super::transfer::{Found, by_transfer};
use super::verdict::judge;
use super::views::Views;
use crate::EngineError;
use crate::diagnosis::data::concerned::{concerned, too_many};
use crate::diagnosis::data::locate;
use crate::diagnosis::data::means::drift;
use crate::diagnosis::data::overview::{Overview, gaps};
use crate::diagnosis::data::prepare::{Prepared, prepare};
use crate::diagnosis::effects::effect::{Effect, Tier};
use crate::diagnosis::findings::fingerprint;
use crate::diagnosis::findings::held_out::Place;
use crate::diagnosis::findings::hypothesis::{Explanation, closes_most, hypothesis};
use crate::diagnosis::findings::next::next_experiment;
use crate::diagnosis::findings::refit::fitted_again;
use crate::diagnosis::findings::second::second_effect;
use crate::diagnosis::findings::whereabouts::location;
use crate::diagnosis::search::contest::{Outcome, contest};
use crate::diagnosis::search::decide::Ranked;
use crate::progress::{Progress, Watch, report};

/// Share of the linear cores in the whole.
const PREPARED: f64 = 0.1;
/// Share of a diagnosis of some responses in that of all, which seldom follows.
const OF_FEW: f64 = 0.7;
/// Share of the gap that a cause leaves at most where no other responses are asked.
const ANSWERED: f64 = 0.1;
/// Hypotheses in the report.
const LISTED: usize = 8;

/// A report and, in the order of its hypotheses, the sims with the effect in them.
#[derive(Debug, Clone)]
pub struct Diagnosis {
    /// The report.
    pub report: Report,
    /// What its page draws.
    pub views: Views,
    /// One a hypothesis.
    pub augmented: Vec<Augmented>,
}

impl Diagnosis {
    /// A diagnosis of some responses of a rig as one of all `count` of them; `kept` says which they were.
    fn among(mut self, kept: &[usize], count: usize) -> Self {
        self.report.warnings.push(format!("responses_left_out: {}", count - kept.len()));
        self.augmented = self.augmented.into_iter().map(|found| found.among(kept, count)).collect();
        self
    }
}

/// Says where sim and rig disagree, which effect causes it and how far simulating it helps.
///
/// Deterministic for an input, whatever the number of threads.
///
/// # Errors
/// [`Input::check`]'s; a baseline whose drives or responses do not move; runs too short for the
/// core or for the split; [`EngineError::Cancelled`].
pub fn diagnose(input: &Input, watch: Watch<'_>) -> Result<Diagnosis, EngineError> {
    input.check()?;
    let kept = concerned(input);
    let mut begun = 0.0;
    if kept.len() < input.responses.len() {
        if let Some(found) = among(input, &kept, &|p: Progress<'_>| watch(p.within(&(0.0..OF_FEW))))? {
            return Ok(found);
        }
        begun = OF_FEW;
    }
    let all = |p: Progress<'_>| watch(p.within(&(begun..1.0)));
    let prepared = prepare(input, &|p: Progress<'_>| all(p.within(&(0.0..PREPARED))))?;
    explained(input, &prepared, &all)
}

/// The diagnosis at some responses, where it is an answer, or where all are [too many](too_many): without repeats that are
/// alike transfer between runs is asked, of all responses, and a cause that is not found may act by the motion of one that was
/// left out.
fn among(input: &Input, kept: &[usize], watch: Watch<'_>) -> Result<Option<Diagnosis>, EngineError> {
    let of_few = input.of_responses(kept);
    let named = |error: EngineError| match error {
        EngineError::DeadChannel { what, channel } if what.starts_with("response") => {
            EngineError::DeadChannel { what, channel: kept[channel] }
        }
        other => other,
    };
    let prepared = prepare(&of_few, &|p: Progress<'_>| watch(p.within(&(0.0..PREPARED)))).map_err(named)?;
    if !prepared.from_repeats && !too_many(input) {
        return Ok(None);
    }
    let found = explained(&of_few, &prepared, watch)?;
    let closes = found.report.hypotheses.first().is_some_and(|best| best.remaining_share < ANSWERED);
    let answers = match found.report.verdict.kind {
        VerdictKind::NoMaterialGap | VerdictKind::NoiseOrUnmeasuredDisturbance => true,
        VerdictKind::Identified | VerdictKind::Partial => closes,
        _ => false,
    };
    Ok((answers || too_many(input)).then(|| found.among(kept, input.responses.len())))
}

/// The diagnosis of a request that is made ready.
fn explained(input: &Input, prepared: &Prepared, watch: Watch<'_>) -> Result<Diagnosis, EngineError> {
    let overview = Overview::new(input, prepared);
    report(watch, "where", PREPARED)?;
    let without = || overview.without_candidates(input);
    let again = |h: &Hypothesis, watch: Watch<'_>| fitted_again(input, h, watch);
    // A model that was fitted on the rig has taken in what is linear of the effect: a cause is what holds beside a
    // linear part of its own on runs that it was not fitted to. Repeats tell what is noise.
    if input.mode == Mode::InSitu {
        if let Some(verdict) = prepared.from_repeats.then(without).flatten() {
            return finish(input, prepared, &overview, verdict, None, watch);
        }
        let mut drifts = drifting(input, prepared, &overview, watch)?;
        if let Some(Drifting { verdict, outcome, .. }) = drifts.take_if(|d| d.left < input.material_gap) {
            return finish(input, prepared, &overview, verdict, Some(outcome), watch);
        }
        let half = if prepared.from_repeats { 0.5 } else { 0.0 };
        let first = |p: Progress<'_>| watch(p.within(&(0.0..half)));
        let second = |p: Progress<'_>| watch(p.within(&(half..1.0)));
        let mut by_repeats = None;
        if prepared.from_repeats {
            let outcome = contest(input, &input.catalogue, prepared, &overview, &first)?;
            let verdict = judge(input, prepared, &overview, &outcome);
            // Whatever transfer says, that stands.
            if verdict.kind == VerdictKind::Identified && !verdict.bends() {
                return finish(input, prepared, &overview, verdict, Some(outcome), &second);
            }
            by_repeats = Some((verdict, outcome));
        }
        let found = by_transfer(input, &overview, &again, &second)?;
        if let Some((verdict, outcome)) = by_repeats {
            let fitted = outcome.ranked.first().map_or(1.0, |best| best.scored.remaining);
            let carried = found.hypotheses.first().map_or(1.0, |(best, _)| best.remaining_share);
            if let Some(verdict) = verdict.beside(&found.verdict, [fitted, carried]) {
                return finish(input, prepared, &overview, verdict, Some(outcome), &second);
            }
        }
        if !found.verdict.kind.blames()
            && let Some(Drifting { verdict, outcome, .. }) = drifts
        {
            return finish(input, prepared, &overview, verdict, Some(outcome), watch);
        }
        return from_transfer(input, prepared, &overview, found, watch);
    }
    let (verdict, outcome) = match without() {
        Some(verdict) => (verdict, None),
        None => {
            let outcome = contest(input, &input.catalogue, prepared, &overview, watch)?;
            (judge(input, prepared, &overview, &outcome), Some(outcome))
        }
    };
    let unexplained = matches!(verdict.kind, VerdictKind::NoMaterialGap | VerdictKind::NoneOfCatalogue);
    if !prepared.from_repeats && unexplained && overview.whole() >= input.material_gap {
        let found = by_transfer(input, &overview, &again, watch)?;
        if verdict.kind == VerdictKind::NoMaterialGap || found.verdict.kind.blames() {
            return from_transfer(input, prepared, &overview, found, watch);
        }
    }
    let verdict = verdict
        .of_a_sim_stood_for(input, prepared)
        .of_a_sim_that_stays(input, prepared, &overview)
        .of_a_sim_that_left_much(input, prepared, &overview)
        .of_a_sim_that_lacked_more(input, prepared);
    finish(input, prepared, &overview, verdict, outcome, watch)
}

/// An offset that drifts.
struct Drifting<'p> {
    verdict: Verdict,
    outcome: Outcome<'p>,
    /// RMS of what it leaves, relative to the response.
    left: f64,
}

/// An offset that drifts, which transfer between runs does not see; `None` where none does. Repeats tell it with all
/// else that they do.
fn drifting<'p>(
    input: &Input,
    prepared: &'p Prepared,
    overview: &Overview,
    watch: Watch<'_>,
) -> Result<Option<Drifting<'p>>, EngineError> {
    let drifts = |&r: &usize| drift(&prepared.problems[r], input.material_gap);
    let sought = !prepared.from_repeats && input.catalogue.contains(&Effect::OffsetDrift);
    if !sought || !overview.seen.iter().any(drifts) {
        return Ok(None);
    }
    let outcome = contest(input, &[Effect::OffsetDrift], prepared, overview, watch)?;
    let verdict = judge(input, prepared, overview, &outcome);
    let left = outcome.ranked.first().map_or(1.0, |best| best.scored.remaining.max(0.0).sqrt());
    let found = Drifting { verdict, outcome, left: left * overview.whole() };
    Ok(Some(found).filter(|found| found.verdict.kind.blames()))
}

/// The report of what follows from transfer between runs.
fn from_transfer(
    input: &Input,
    prepared: &Prepared,
    overview: &Overview,
    found: Found,
    watch: Watch<'_>,
) -> Result<Diagnosis, EngineError> {
    let rate = input.sample_rate_hz();
    let names: Vec<String> = input.runs.iter().map(|run| run.name.clone()).collect();
    let problem = &prepared.problems[overview.worst()];
    let (hypotheses, augmented): (Vec<Hypothesis>, Vec<Augmented>) = found.hypotheses.into_iter().unzip();
    // Repeats that were refused are repeats all the same here.
    let used = prepared.warnings.iter().filter(|w| !w.starts_with("repeat_drive_differs"));
    let warnings = used.cloned().chain(found.warnings).collect();
    let left = hypotheses.first().map_or(1.0, |h| h.remaining_share);
    let report_of_all = Report {
        schema: "gap-diagnosis/1".into(),
        mode: input.mode,
        noise_floor_source: found.noise,
        verdict: found.verdict.naming(hypotheses.first()),
        remaining: Remaining {
            chi2: left * found.gap.chi2_select,
            ..remaining_after(input, prepared, overview, None, None)
        },
        gap: found.gap,
        location: location(input, prepared, overview, &names, rate),
        fingerprints: Fingerprints {
            odd_share: fingerprint::odd_share(problem),
            gap_level_exponent: fingerprint::level_exponent(problem),
            linear_refit_closure: Some(found.linear_closure),
            line_hz: overview.line.map(|(_, line)| line.frequency_hz),
        },
        hypotheses,
        next_experiment: found.next,
        data_split: data_split(prepared, &names, rate),
        warnings,
    };
    report(watch, "report", 1.0)?;
    let views = Views::new(input, prepared, (problem, None), None);
    Ok(Diagnosis { report: report_of_all, views, augmented })
}

fn finish(
    input: &Input,
    prepared: &Prepared,
    overview: &Overview,
    mut verdict: Verdict,
    outcome: Option<Outcome<'_>>,
    watch: Watch<'_>,
) -> Result<Diagnosis, EngineError> {
    report(watch, "held-out closure", 0.8)?;
    // What names an effect that does not bend to whatever it meets stands; else two effects together may.
    let nothing = verdict.kind == VerdictKind::NoneOfCatalogue;
    let named = verdict.effect.filter(|effect| effect.tier() != Tier::Free);
    let two = match &outcome {
        Some(outcome) => second_effect(input, prepared, overview, outcome, named, watch)?,
        None => None,
    };
    let two = two.filter(|two| nothing || two.first == 0 || two.answers());
    let mut ranked = outcome.map_or_else(Vec::new, |o| o.ranked);
    let gap_matters = verdict.kind != VerdictKind::NoMaterialGap;
    let open = named.is_none() && gap_matters;
    if let Some(two) = two.as_ref().filter(|_| open) {
        ranked[..=two.first].rotate_right(1);
    }
    report(watch, "second effect", 0.88)?;
    let listed: Vec<&Ranked> = ranked.iter().take(LISTED).collect();
    let mut made: Vec<(Hypothesis, Augmented)> = listed
        .par_iter()
        .filter_map(|Ranked { scored, probability, .. }| {
            hypothesis(input, prepared, overview, &Explanation::of(prepared, scored), *probability)
        })
        .collect();
    verdict = verdict.on_test(made.first().map(|(hypothesis, _)| hypothesis));
    let alone = listed.first().map(|best| Explanation::of(prepared, &best.scored));
    let mut best = alone.as_ref();
    if let (Some(two), Some(alone)) = (&two, made.first_mut()) {
        let first = two.explanation.held[0].part.effect;
        let sure = two.answers();
        // Where something is blamed, the best hypothesis holds all that is surely there.
        let together = (sure && gap_matters && (open || two.first == 0))
            .then(|| hypothesis(input, prepared, overview, &two.explanation, alone.0.probability))
            .flatten()
            .filter(|(together, _)| together.helps_beyond(&alone.0));
        // Beside the others the first may be another law than it was alone.
        let renamed = together.is_some() && verdict.effect != Some(first);
        if renamed || open && (!sure || alone.0.effect == first) {
            verdict = verdict.or_two(input, overview, two);
        }
        if let Some(together) = together {
            *alone = together;
            best = Some(&two.explanation);
        }
    }
    let (hypotheses, augmented): (Vec<_>, Vec<_>) = made.into_iter().unzip();
    verdict = verdict.naming(hypotheses.first());
    report(watch, "next experiment", 0.95)?;
    let next_experiment = next_experiment(input, prepared, &ranked, &verdict);
    let best = best.map(|best| closes_most(&best.places(), overview));
    let problem = best.map_or(&prepared.problems[overview.worst()], |b| &b.problem);
    let rate = input.sample_rate_hz();
    let names: Vec<String> = input.runs.iter().map(|run| run.name.clone()).collect();
    let fingerprints = Fingerprints {
        odd_share: fingerprint::odd_share(problem),
        gap_level_exponent: fingerprint::level_exponent(problem),
        linear_refit_closure: ranked
            .iter()
            .find(|b| b.scored.effect() == Effect::LinearChange)
            .map(|b| 1.0 - b.scored.remaining),
        line_hz: overview.line.map(|(_, line)| line.frequency_hz),
    };
    let mut warnings = prepared.warnings.clone();
    if !prepared.from_repeats {
        warnings.push("noise_floor_assumed".into());
    }
    let gap = gap(overview);
    let report_of_all = Report {
        schema: "gap-diagnosis/1".into(),
        mode: input.mode,
        noise_floor_source: if prepared.from_repeats { NoiseSource::Repeats } else { NoiseSource::Assumed },
        verdict,
        gap,
        location: location(input, prepared, overview, &names, rate),
        fingerprints,
        hypotheses,
        remaining: remaining_after(
            input,
            prepared,
            overview,
            best,
            two.as_ref().map(|two| two.second.clone()),
        ),
        next_experiment,
        data_split: data_split(prepared, &names, rate),
        warnings,
    };
    report(watch, "report", 1.0)?;
    let host = listed.first().map(|b| (&prepared.problems[b.scored.problem], &b.scored.fitted));
    let views = Views::new(input, prepared, (problem, best.map(|b| &b.fitted)), host);
    Ok(Diagnosis { report: report_of_all, views, augmented })
}

/// Size of the gap at the response where it is largest.
fn gap(overview: &Overview) -> Gap {
    let r = overview.worst();
    Gap {
        systematic_rms_rel: overview.systematic(r),
        systematic_at_least: overview.systematic(r),
        systematic_at_most: overview.systematic(r),
        noise_rms_rel: overview.noise(r),
        chi2_select: overview.chi2_select[r],
        chi2_test: overview.chi2_test[r],
    }
}

/// What is left of the response on which the best hypothesis closes most, or without any of the one
/// with the largest gap.
fn remaining_after(
    input: &Input,
    prepared: &Prepared,
    overview: &Overview,
    best: Option<&Place>,
    second_effect: Option<SecondEffect>,
) -> Remaining {
    let problem = best.map_or(&prepared.problems[overview.worst()], |b| &b.problem);
    let predictions =
        best.and_then(|b| b.fitted.candidate.predictions(problem, &problem.select, &b.fitted.p));
    let errors = match &predictions {
        Some(predictions) => problem.select.iter().zip(predictions).map(|(s, p)| s.residual(p)).collect(),
        None => gaps(problem, &problem.select),
    };
    let channel = &input.responses[problem.response].name;
    let noise = &prepared.noises[problem.response];
    Remaining {
        chi2: best.map_or_else(|| problem.chi2_none(&problem.select), |b| b.chi2),
        bands: locate::bands(channel, &problem.select, &errors, noise, prepared.band, input.sample_rate_hz()),
        second_effect,
    }
}

fn data_split(prepared: &Prepared, names: &[String], rate: f64) -> DataSplit {
    let of = |role: Role| {
        prepared
            .pieces
            .iter()
            .filter(|p| p.role == role)
            .map(|p| RunPart {
                run: names[p.run].clone(),
                from_s: p.from as f64 / rate,
                to_s: p.to as f64 / rate,
            })
            .collect()
    };
    DataSplit { fit: of(Role::Fit), select: of(Role::Select), test: of(Role::Test) }
}
