//! The diagnosis from request to report.

use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use super::augmented::Augmented;
use super::candidate::Candidate;
use super::catalogue::{FreeRanges, parts};
use super::decide::{Ranked, Ruling, rank, rule};
use super::disturbance;
use super::effect::{Effect, Tier};
use super::fingerprint;
use super::fitting::{Effort, Fitted, fit};
use super::input::{Input, Mode, Role};
use super::linear::rms;
use super::locate::{self, Power};
use super::next;
use super::parameters;
use super::prepare::{Prepared, prepare};
use super::problem::{Problem, Stretch};
use super::report::{
    ChannelShare, DataSplit, Fingerprints, Gap, HeldOut, Hypothesis, NextExperiment, NoiseSource, Remaining,
    Report, RunPart, SecondEffect, TimeVariance, Verdict, VerdictKind, Where,
};
use super::score::{Scored, blocks, closure_interval, remaining, score};
use super::start::Regression;
use super::views::Views;
use crate::engine::EngineError;
use crate::engine::progress::{Watch, report};

/// Below this many noise floors squared there is nothing that a drive causes.
const NOISE_ONLY: f64 = 1.3;
/// Above this a second effect is tried.
const SECOND: f64 = 1.6;
/// Hypotheses in the report.
const LISTED: usize = 8;
/// Candidates for a second effect that are fitted after a regression has sorted them.
const SECOND_FITTED: usize = 6;
/// Share of the first hypothesis' rest that a second effect must close.
const SECOND_CLOSES: f64 = 0.5;

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

/// Says where sim and rig disagree, which effect causes it and how far simulating it helps.
///
/// Deterministic for an input, whatever the number of threads.
///
/// # Errors
/// [`Input::check`]'s; a baseline whose drives or responses do not move; runs too short for the
/// core or for the split; [`EngineError::Cancelled`].
pub fn diagnose(input: &Input, watch: Watch<'_>) -> Result<Diagnosis, EngineError> {
    report(watch, "linear core", 0.0)?;
    let prepared = prepare(input)?;
    let overview = Overview::new(input, &prepared);
    report(watch, "where", 0.1)?;
    let mut answer = Answer::new(&prepared, &overview);
    if let Some(verdict) = overview.without_candidates(input) {
        answer.verdict = verdict;
        return answer.finish(input, &prepared, &overview, watch);
    }
    let ranked = rank_all(input, &prepared, &overview, watch)?;
    answer.judge(input, &prepared, &overview, ranked);
    answer.finish(input, &prepared, &overview, watch)
}

/// What is known of each response before any candidate.
struct Overview {
    chi2_select: Vec<f64>,
    chi2_test: Vec<f64>,
    power: Vec<Power>,
    line: Option<(usize, disturbance::Line)>,
    raised: Option<(usize, f64)>,
    quantised: Option<(usize, f64)>,
    /// Responses whose gap is both systematic and large enough to matter.
    material: Vec<usize>,
}

fn gaps(problem: &Problem, stretches: &[Stretch]) -> Vec<Vec<f64>> {
    stretches.iter().map(|s| s.gap(problem.response)).collect()
}

fn scored_rows(stretches: &[Stretch]) -> f64 {
    stretches.iter().map(|s| s.rows.len()).sum::<usize>() as f64
}

impl Overview {
    fn new(input: &Input, prepared: &Prepared) -> Self {
        let rate = input.sample_rate_hz();
        let problems = &prepared.problems;
        let chi2_select: Vec<f64> = problems.iter().map(|p| p.chi2_none(&p.select)).collect();
        let chi2_test: Vec<f64> = problems.iter().map(|p| p.chi2_none(&p.test)).collect();
        let power: Vec<Power> = problems
            .iter()
            .zip(&prepared.noises)
            .map(|(p, noise)| {
                let power = locate::power(p, &p.select, &gaps(p, &p.select), noise, prepared.band);
                // A rig that changed between its repeats: their product misses what the change did.
                let systematic = power.rms_error * power.rms_error - power.noise;
                Power { systematic: power.systematic.max(systematic), ..power }
            })
            .collect();
        let mut this = Self {
            chi2_select,
            chi2_test,
            power,
            line: None,
            raised: None,
            quantised: None,
            material: Vec::new(),
        };
        for (r, problem) in problems.iter().enumerate() {
            let errors = gaps(problem, &problem.fit);
            let scored: Vec<&[f64]> = errors.iter().zip(&problem.fit).map(|(e, s)| &e[s.lead..]).collect();
            let level = rms(&scored.concat());
            let twins: Vec<[&[f64]; 2]> = (0..scored.len())
                .filter_map(|i| {
                    let j = (i + 1..scored.len()).find(|&j| problem.fit[j].group == problem.fit[i].group)?;
                    Some([scored[i], scored[j]])
                })
                .collect();
            let line = disturbance::line(&scored, rate);
            if let Some(line) = line.filter(|line| disturbance::undriven(*line, &twins, rate)) {
                this.line = this.line.or(Some((r, line)));
            }
            let raised = disturbance::raised(&prepared.noises[r].ar, &prepared.baseline_noise[r]);
            if let Some(ratio) = raised.filter(|_| prepared.from_repeats) {
                this.raised = this.raised.or(Some((r, ratio)));
            }
            let measured: Vec<f64> = problem.fit.iter().flat_map(|s| s.measured.iter().copied()).collect();
            // The error of rounding has an RMS of q / sqrt 12; it must be most of what is left.
            let quantum = disturbance::quantum(&measured).filter(|q| q / 12.0_f64.sqrt() > 0.6 * level);
            this.quantised = this.quantised.or(quantum.map(|q| (r, q)));
            if this.chi2_select[r] >= NOISE_ONLY && this.systematic(r) >= input.material_gap {
                this.material.push(r);
            }
        }
        this
    }

    /// Systematic RMS relative to the response's.
    fn systematic(&self, r: usize) -> f64 {
        let p = &self.power[r];
        (p.systematic.max(0.0) / p.response.max(f64::MIN_POSITIVE)).sqrt()
    }

    fn noise(&self, r: usize) -> f64 {
        let p = &self.power[r];
        (p.noise / p.response.max(f64::MIN_POSITIVE)).sqrt()
    }

    fn worst(&self) -> usize {
        (0..self.power.len()).max_by(|&a, &b| self.systematic(a).total_cmp(&self.systematic(b))).unwrap_or(0)
    }

    /// The verdict where no candidate is needed.
    fn without_candidates(&self, input: &Input) -> Option<Verdict> {
        let named = |kind, effect: Option<Effect>, r: usize, because: String| Verdict {
            kind,
            effect,
            family: effect.map(Effect::family),
            axis: input.responses[r].axis.clone(),
            channel: Some(input.responses[r].name.clone()),
            probability: 0.95,
            equivalence_set: effect.into_iter().collect(),
            because: vec![because],
        };
        let may = |effect: Effect| input.catalogue.contains(&effect);
        if let Some((r, q)) = self.quantised.filter(|_| may(Effect::Quantisation)) {
            let because = format!("the samples lie on a lattice of step {q:.4e}, which makes up the gap");
            return Some(named(VerdictKind::Identified, Some(Effect::Quantisation), r, because));
        }
        if !self.material.is_empty() {
            return None;
        }
        let noise = VerdictKind::NoiseOrUnmeasuredDisturbance;
        if let Some((r, line)) = self.line.filter(|_| may(Effect::PeriodicDisturbance)) {
            let because = format!(
                "a line at {:.2} Hz, {:.0} % of what is left, that no drive explains",
                line.frequency_hz,
                100.0 * line.share
            );
            return Some(named(noise, Some(Effect::PeriodicDisturbance), r, because));
        }
        if let Some((r, ratio)) = self.raised.filter(|_| may(Effect::RaisedNoise)) {
            let because =
                format!("noise of {ratio:.1} times the baseline's power, none of it from the drives");
            return Some(named(noise, Some(Effect::RaisedNoise), r, because));
        }
        let r = self.worst();
        let because = format!(
            "systematic error {:.2} % of the response, {:.2} noise floors squared",
            100.0 * self.systematic(r),
            self.chi2_select[r]
        );
        Some(Verdict { axis: None, channel: None, ..named(VerdictKind::NoMaterialGap, None, r, because) })
    }
}

/// Candidates of every response with a material gap, fitted, scored and ranked.
fn rank_all(
    input: &Input,
    prepared: &Prepared,
    overview: &Overview,
    watch: Watch<'_>,
) -> Result<Vec<(usize, Vec<Ranked>)>, EngineError> {
    let in_situ = input.mode == Mode::InSitu;
    let rate = input.sample_rate_hz();
    let regressions: Vec<(Regression<'_>, Regression<'_>)> = overview
        .material
        .par_iter()
        .map(|&r| {
            let problem = &prepared.problems[r];
            (Regression::new(problem, in_situ), Regression::new(problem, true))
        })
        .collect();
    let mut tasks = Vec::new();
    for (k, &r) in overview.material.iter().enumerate() {
        let problem = &prepared.problems[r];
        let ranges = FreeRanges::of(problem, &regressions[k].0.smooth);
        for part in parts(problem, &input.catalogue, in_situ, ranges) {
            tasks.push((k, r, Candidate::of(part, in_situ)));
        }
    }
    let done = AtomicUsize::new(0);
    let scored: Vec<Option<Scored>> = tasks
        .par_iter()
        .map(|(k, r, candidate)| {
            let share = done.load(Ordering::Relaxed) as f64 / tasks.len() as f64;
            report(watch, &candidate.parts[0].effect.name(), 0.1 + 0.7 * share)?;
            let problem = &prepared.problems[*r];
            let regression = if candidate.retune { &regressions[*k].1 } else { &regressions[*k].0 };
            let fitted = fit(problem, regression, candidate, &[], Effort { rounds: 40 });
            done.fetch_add(1, Ordering::Relaxed);
            Ok(fitted.and_then(|f| score(*r, problem, f, overview.chi2_select[*r], rate)))
        })
        .collect::<Result<_, EngineError>>()?;
    let mut by_response = Vec::new();
    for &r in &overview.material {
        let own: Vec<Scored> = scored.iter().flatten().filter(|s| s.problem == r).cloned().collect();
        let rows = scored_rows(&prepared.problems[r].select);
        by_response.push((r, rank(own, overview.chi2_select[r], rows)));
    }
    Ok(by_response)
}

/// The report in the making.
struct Answer {
    verdict: Verdict,
    gap: Gap,
    /// Response of the verdict and its ranking.
    ranked: Option<(usize, Vec<Ranked>)>,
    warnings: Vec<String>,
}

impl Answer {
    fn new(prepared: &Prepared, overview: &Overview) -> Self {
        let r = overview.worst();
        let gap = Gap {
            systematic_rms_rel: overview.systematic(r),
            noise_rms_rel: overview.noise(r),
            chi2_select: overview.chi2_select[r],
            chi2_test: overview.chi2_test[r],
        };
        let mut warnings = prepared.warnings.clone();
        if !prepared.from_repeats {
            warnings.push("noise_floor_assumed".into());
        }
        let verdict = Verdict {
            kind: VerdictKind::NoneOfCatalogue,
            effect: None,
            family: None,
            axis: None,
            channel: None,
            probability: 0.5,
            equivalence_set: Vec::new(),
            because: Vec::new(),
        };
        Self { verdict, gap, ranked: None, warnings }
    }

    /// Picks the response and rules on it.
    fn judge(
        &mut self,
        input: &Input,
        prepared: &Prepared,
        overview: &Overview,
        all: Vec<(usize, Vec<Ranked>)>,
    ) {
        // Where the best candidate closes most, in noise floors: elsewhere the effect is an echo.
        let closes = |(r, ranked): &(usize, Vec<Ranked>)| {
            ranked
                .first()
                .map_or(0.0, |b| (1.0 - b.scored.remaining).max(0.0) * overview.chi2_select[*r].ln().max(0.0))
        };
        let Some((r, ranked)) = all.into_iter().max_by(|a, b| closes(a).total_cmp(&closes(b))) else {
            return;
        };
        let rows = scored_rows(&prepared.problems[r].select);
        let (ruling, probability, set) = rule(&ranked, overview.chi2_select[r], rows, input.seed);
        let best = ranked.first();
        let effect = best.map(|b| b.scored.effect());
        let mut because = Vec::new();
        if let Some(best) = best {
            because.push(format!(
                "{} leaves {:.1} % of the gap on the select runs ({:.2} noise floors squared of {:.1})",
                best.scored.effect().name(),
                100.0 * best.scored.remaining,
                best.scored.chi2,
                overview.chi2_select[r]
            ));
        }
        if let Some(rival) = ranked.iter().find(|x| Some(x.scored.effect()) != effect) {
            because.push(format!(
                "next best {} leaves {:.1} %",
                rival.scored.effect().name(),
                100.0 * rival.scored.remaining
            ));
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
        let names_effect = matches!(kind, VerdictKind::Identified | VerdictKind::Partial);
        let names_family = names_effect || kind == VerdictKind::FamilyOnly;
        self.verdict = Verdict {
            kind,
            effect: effect.filter(|_| names_effect),
            family: effect.filter(|_| names_family).map(Effect::family),
            axis: best.filter(|_| names_family).and_then(|b| axis(input, r, &b.scored.fitted)),
            channel: Some(input.responses[r].name.clone()),
            probability: probability.clamp(0.0, 1.0),
            equivalence_set: set,
            because,
        };
        self.ranked = Some((r, ranked));
    }

    fn finish(
        self,
        input: &Input,
        prepared: &Prepared,
        overview: &Overview,
        watch: Watch<'_>,
    ) -> Result<Diagnosis, EngineError> {
        report(watch, "held-out closure", 0.8)?;
        let worst = overview.worst();
        let (r, ranked) = self.ranked.unwrap_or((worst, Vec::new()));
        let problem = &prepared.problems[r];
        let listed: Vec<&Ranked> = ranked.iter().take(LISTED).collect();
        let made: Vec<(Hypothesis, Augmented)> =
            listed.par_iter().filter_map(|ranked| hypothesis(input, prepared, problem, ranked)).collect();
        let (hypotheses, augmented): (Vec<_>, Vec<_>) = made.into_iter().unzip();
        report(watch, "second effect", 0.88)?;
        let second = listed
            .first()
            .filter(|b| b.scored.chi2 > SECOND)
            .and_then(|b| second_effect(input, prepared, problem, &b.scored, overview));
        report(watch, "next experiment", 0.95)?;
        let next_experiment = next_experiment(input, prepared, problem, &ranked);
        let names: Vec<String> = input.runs.iter().map(|run| run.name.clone()).collect();
        let rate = input.sample_rate_hz();
        let remaining = remaining_after(input, prepared, problem, listed.first().copied(), second);
        let fingerprints = Fingerprints {
            odd_share: fingerprint::odd_share(problem),
            gap_level_exponent: fingerprint::level_exponent(problem),
            linear_refit_closure: ranked
                .iter()
                .find(|b| b.scored.effect() == Effect::LinearChange)
                .map(|b| 1.0 - b.scored.remaining),
            line_hz: overview.line.map(|(_, line)| line.frequency_hz),
        };
        report(watch, "report", 1.0)?;
        Ok(Diagnosis {
            report: Report {
                schema: "gap-diagnosis/1".into(),
                mode: input.mode,
                noise_floor_source: if prepared.from_repeats {
                    NoiseSource::Repeats
                } else {
                    NoiseSource::Assumed
                },
                verdict: self.verdict,
                gap: self.gap,
                location: location(input, prepared, overview, &names, rate),
                fingerprints,
                hypotheses,
                remaining,
                next_experiment,
                data_split: data_split(prepared, &names, rate),
                warnings: self.warnings,
            },
            views: Views::default(),
            augmented,
        })
    }
}

/// Axis of an effect: that of its drive, or that of the response whose signal it takes.
fn axis(input: &Input, response: usize, fitted: &Fitted) -> Option<String> {
    let part = &fitted.candidate.parts[0];
    if part.effect.on_drive() {
        input.drives[part.drive].axis.clone()
    } else {
        input.responses[response].axis.clone()
    }
}

fn hypothesis(
    input: &Input,
    prepared: &Prepared,
    problem: &Problem,
    ranked: &Ranked,
) -> Option<(Hypothesis, Augmented)> {
    let fitted = &ranked.scored.fitted;
    let effect = ranked.scored.effect();
    let held_out = held_out(input, prepared, problem, fitted)?;
    let units: Vec<String> = input.drives.iter().map(|d| d.unit.clone()).collect();
    let channel = &input.responses[problem.response];
    let limit = input.drive_limit.clone().unwrap_or_else(|| problem.drive_peak.clone());
    let augmented = Augmented {
        response: problem.response,
        plant: problem.plant.clone(),
        candidate: fitted.candidate.clone(),
        p: fitted.p.clone(),
        time: problem.fit.iter().chain(&problem.test).map(|s| s.clock.start).fold(0.0, f64::max),
    };
    let stable = problem.fit.iter().max_by(|a, b| {
        let level = |s: &Stretch| s.drives.iter().map(|d| rms(d)).sum::<f64>();
        level(a).total_cmp(&level(b))
    });
    let stable_over_envelope = stable.is_some_and(|s| augmented.bounded(&s.drives, &limit));
    Some((
        Hypothesis {
            effect,
            family: effect.family(),
            axis: axis(input, problem.response, fitted),
            channel: channel.name.clone(),
            probability: ranked.probability,
            remaining_share: ranked.scored.remaining,
            parameters: parameters::named(problem, fitted, (&channel.unit, &units)),
            held_out,
            stable_over_envelope,
        },
        augmented,
    ))
}

fn held_out(input: &Input, prepared: &Prepared, problem: &Problem, fitted: &Fitted) -> Option<HeldOut> {
    let rate = input.sample_rate_hz();
    let noise = &prepared.noises[problem.response];
    let predictions = fitted.candidate.predictions(problem, &problem.test, &fitted.p)?;
    let before = gaps(problem, &problem.test);
    let after: Vec<Vec<f64>> = problem.test.iter().zip(&predictions).map(|(s, p)| s.residual(p)).collect();
    let (chi2_before, chi2_after) =
        (problem.chi2_none(&problem.test), problem.chi2(&problem.test, &predictions));
    let power = |errors: &[Vec<f64>]| locate::power(problem, &problem.test, errors, noise, prepared.band);
    let (of_before, of_after) = (power(&before), power(&after));
    let floor = of_before.noise;
    let above = |rms: f64| (rms * rms - floor).max(0.0);
    let (rms_before, rms_after) = (of_before.rms_error, of_after.rms_error);
    let gap = above(rms_before);
    let mut runs: Vec<String> = problem.test.iter().map(|s| input.runs[s.run].name.clone()).collect();
    runs.dedup();
    Some(HeldOut {
        runs,
        rms_before,
        rms_after,
        noise_rms: floor.sqrt(),
        chi2_before,
        chi2_after,
        closure: 1.0 - remaining(chi2_after, chi2_before),
        closure_ci90: closure_interval(
            &blocks(&problem.test, &before, rate),
            &blocks(&problem.test, &after, rate),
            input.seed,
        ),
        closure_rms: if gap > 0.0 { 1.0 - above(rms_after) / gap } else { 0.0 },
    })
}

fn second_effect(
    input: &Input,
    prepared: &Prepared,
    problem: &Problem,
    first: &Scored,
    overview: &Overview,
) -> Option<SecondEffect> {
    let in_situ = input.mode == Mode::InSitu;
    let retuned = first.fitted.candidate.retune;
    let regression = Regression::new(problem, retuned);
    let ranges = FreeRanges::of(problem, &regression.smooth);
    let known = first.fitted.p.len() - first.fitted.candidate.retuned(problem);
    let pairs: Vec<Candidate> = parts(problem, &input.catalogue, in_situ, ranges)
        .into_iter()
        .filter(|p| p.effect.tier() != Tier::Free && p.effect != first.effect())
        .filter(|p| p.effect != Effect::LinearChange || retuned)
        .map(|part| Candidate { parts: vec![first.fitted.candidate.parts[0].clone(), part], retune: retuned })
        .collect();
    let mut sorted: Vec<(f64, &Candidate)> = pairs
        .par_iter()
        .filter_map(|c| Some((regression.starts(c, &first.fitted.p[..known]).first()?.cost, c)))
        .collect();
    sorted.sort_by(|a, b| a.0.total_cmp(&b.0));
    let rate = input.sample_rate_hz();
    let chi2_none = overview.chi2_select[problem.response];
    let fitted: Vec<Scored> = sorted
        .par_iter()
        .take(SECOND_FITTED)
        .filter_map(|(_, c)| {
            let fitted = fit(problem, &regression, c, &first.fitted.p[..known], Effort { rounds: 10 })?;
            score(problem.response, problem, fitted, chi2_none, rate)
        })
        .collect();
    let best = fitted.into_iter().min_by(|a, b| a.chi2.total_cmp(&b.chi2))?;
    if best.remaining > SECOND_CLOSES * first.remaining {
        return None;
    }
    let effect = best.fitted.candidate.parts[1].effect;
    let held = held_out(input, prepared, problem, &best.fitted)?;
    Some(SecondEffect { effect, family: effect.family(), chi2: best.chi2, closure: held.closure })
}

fn next_experiment(
    input: &Input,
    prepared: &Prepared,
    problem: &Problem,
    ranked: &[Ranked],
) -> Option<NextExperiment> {
    let leader = ranked.first()?;
    let effect = leader.scored.effect();
    // What is more flexible than the leader can follow it anywhere: no run tells them apart.
    let rival = ranked
        .iter()
        .find(|r| r.scored.effect() != effect && r.scored.effect().tier() <= effect.tier().max(Tier::Law))?;
    let noise = &prepared.noises[problem.response].ar;
    let limit = input.drive_limit.clone().unwrap_or_else(|| problem.drive_peak.clone());
    let menu = next::menu(problem, &limit, prepared.band, input.sample_rate_hz(), input.seed);
    let separated: Vec<Option<f64>> = menu
        .par_iter()
        .map(|proposal| {
            let (a, b) = (&leader.scored.fitted, &rival.scored.fitted);
            next::separation(problem, a, b, proposal, noise, prepared.band)
        })
        .collect();
    let (best, proposal) = separated
        .into_iter()
        .zip(menu)
        .filter_map(|(s, p)| Some((s?, p)))
        .max_by(|a, b| a.0.total_cmp(&b.0))?;
    Some(NextExperiment {
        drive: proposal.drive,
        separates: vec![effect, rival.scored.effect()],
        expected_separation: best,
        inseparable_in_envelope: best < next::SEPARATED,
    })
}

fn remaining_after(
    input: &Input,
    prepared: &Prepared,
    problem: &Problem,
    best: Option<&Ranked>,
    second_effect: Option<SecondEffect>,
) -> Remaining {
    let predictions = best.and_then(|b| {
        let fitted = &b.scored.fitted;
        fitted.candidate.predictions(problem, &problem.select, &fitted.p)
    });
    let errors = match &predictions {
        Some(predictions) => problem.select.iter().zip(predictions).map(|(s, p)| s.residual(p)).collect(),
        None => gaps(problem, &problem.select),
    };
    let channel = &input.responses[problem.response].name;
    let noise = &prepared.noises[problem.response];
    Remaining {
        chi2: best.map_or_else(|| problem.chi2_none(&problem.select), |b| b.scored.chi2),
        bands: locate::bands(channel, &problem.select, &errors, noise, prepared.band, input.sample_rate_hz()),
        second_effect,
    }
}

fn location(input: &Input, prepared: &Prepared, overview: &Overview, names: &[String], rate: f64) -> Where {
    let mut place = Where {
        channels: Vec::new(),
        bands: Vec::new(),
        amplitude: Vec::new(),
        velocity: Vec::new(),
        segments: Vec::new(),
        out_of_band_excitation: out_of_band(prepared),
        time_variance: TimeVariance {
            repeat_drive_coherence: prepared.noises.iter().map(|n| n.drive_coherence).fold(0.0, f64::max),
        },
    };
    let shares: Vec<f64> = (0..prepared.problems.len()).map(|r| overview.systematic(r).powi(2)).collect();
    let total: f64 = shares.iter().sum();
    for (r, problem) in prepared.problems.iter().enumerate() {
        let (channel, noise) = (&input.responses[r].name, &prepared.noises[r]);
        let errors = gaps(problem, &problem.select);
        place.channels.push(ChannelShare {
            channel: channel.clone(),
            share_of_gap: if total > 0.0 { shares[r] / total } else { 0.0 },
            rms_error: overview.power[r].rms_error,
        });
        place.bands.extend(locate::bands(channel, &problem.select, &errors, noise, prepared.band, rate));
        for (velocity, out) in [(false, &mut place.amplitude), (true, &mut place.velocity)] {
            out.extend(locate::ranges(
                channel,
                problem,
                &problem.select,
                &errors,
                noise,
                prepared.band,
                velocity,
            ));
        }
        place.segments.extend(locate::segments(channel, names, &problem.select, &errors, rate));
    }
    place
}

/// Whether the runs' drives have more than 5 % of their power outside the core's band.
fn out_of_band(prepared: &Prepared) -> bool {
    let stretches = prepared.problems[0].fit.iter();
    let drives: Vec<Vec<&[f64]>> = stretches.map(|s| s.drives.iter().map(Vec::as_slice).collect()).collect();
    super::core::drive_band(&drives).is_some_and(|band| band[1] > 1.15 * prepared.band[1])
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
