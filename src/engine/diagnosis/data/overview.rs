//! What is known of each response before any candidate, and the verdicts that need none.

use super::disturbance;
use super::locate::{self, Power};
use super::prepare::Prepared;
use super::problem::{Problem, Stretch};
use crate::diagnosis::effects::effect::Effect;
use crate::diagnosis::input::Input;
use crate::diagnosis::numerics::linear::{dot, rms};
use crate::diagnosis::report::{Verdict, VerdictKind};

/// Below this many noise floors squared there is nothing that a drive causes.
pub const NOISE_ONLY: f64 = 1.3;
/// Probability that there is no material gap where nothing systematic is seen, and where something is that
/// would have to be a few times larger: what acts seldom may be so elsewhere.
const NOTHING: [f64; 2] = [0.97, 0.7];
/// Share of the gap from which on a sim that differs from the core has a bend of its own.
const BENDS: f64 = 0.01;

/// What is known of each response before any candidate.
pub struct Overview {
    pub chi2_select: Vec<f64>,
    pub chi2_test: Vec<f64>,
    pub power: Vec<Power>,
    pub line: Option<(usize, disturbance::Line)>,
    pub raised: Option<(usize, f64)>,
    pub quantised: Option<(usize, f64)>,
    /// Whether the sim says what the core does, but for little of the gap.
    pub sim_is_core: bool,
    /// Responses with a systematic gap.
    pub seen: Vec<usize>,
    /// Those of them whose gap is large enough to matter.
    pub material: Vec<usize>,
}

pub fn gaps(problem: &Problem, stretches: &[Stretch]) -> Vec<Vec<f64>> {
    stretches.iter().map(|s| s.gap(problem.response)).collect()
}

/// Mean square in noise floors of the difference of sim and core on the select stretches.
fn own_bend(problem: &Problem) -> f64 {
    let rows = problem.rows(&problem.select, |s| {
        s.simulated[problem.response].iter().zip(s.core.iter()).map(|(s, c)| s - c).collect()
    });
    dot(&rows, &rows) / rows.len().max(1) as f64
}

impl Overview {
    pub fn new(input: &Input, prepared: &Prepared) -> Self {
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
        let sim_is_core = problems.iter().zip(&chi2_select).all(|(p, none)| own_bend(p) < BENDS * none);
        let mut this = Self {
            chi2_select,
            chi2_test,
            power,
            line: None,
            raised: None,
            quantised: None,
            sim_is_core,
            seen: Vec::new(),
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
            if this.chi2_select[r] >= NOISE_ONLY {
                this.seen.push(r);
                if this.systematic(r) >= input.material_gap {
                    this.material.push(r);
                }
            }
        }
        this
    }

    /// Mean over the responses with a gap of something that each has.
    pub fn mean_of_seen(&self, of: &[f64]) -> f64 {
        self.seen.iter().map(|&r| of[r]).sum::<f64>() / self.seen.len().max(1) as f64
    }

    /// Systematic RMS relative to the response's.
    pub fn systematic(&self, r: usize) -> f64 {
        let p = &self.power[r];
        p.systematic.max(0.0).sqrt() / p.level()
    }

    pub fn noise(&self, r: usize) -> f64 {
        let p = &self.power[r];
        p.noise.sqrt() / p.level()
    }

    /// The largest error of a response relative to it, noise included.
    pub fn whole(&self) -> f64 {
        self.power.iter().map(|p| p.rms_error / p.level()).fold(0.0, f64::max)
    }

    pub fn worst(&self) -> usize {
        (0..self.power.len()).max_by(|&a, &b| self.systematic(a).total_cmp(&self.systematic(b))).unwrap_or(0)
    }

    /// The verdict where no candidate is needed.
    pub fn without_candidates(&self, input: &Input) -> Option<Verdict> {
        let named = |kind, effect: Option<Effect>, r: usize, because: String| Verdict {
            kind,
            effect,
            family: effect.map(Effect::family),
            axis: input.responses[r].axis.clone(),
            at: effect.map(|_| input.responses[r].name.clone()),
            between: None,
            in_words: String::new(),
            channel: Some(input.responses[r].name.clone()),
            probability: 0.95,
            equivalence_set: effect.into_iter().collect(),
            effects: Vec::new(),
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
        let probability = if self.seen.is_empty() { NOTHING[0] } else { NOTHING[1] };
        let nothing = named(VerdictKind::NoMaterialGap, None, r, because);
        Some(Verdict { axis: None, channel: None, probability, ..nothing })
    }
}
