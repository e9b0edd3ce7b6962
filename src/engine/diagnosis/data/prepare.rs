//! From a request to one problem per response.

use std::sync::{Arc, Mutex, PoisonError};

use rayon::prelude::*;

use super::noise::{self, Noise, Pair};
use super::overview::NOISE_ONLY;
use super::problem::{Problem, Stretch, share};
use super::seldom::{self, PLAIN_GAP};
use super::settled::{Left, differ, size};
use super::split::{Piece, Split, in_quarters, quarter, split};
use super::tolerance::Tolerance;
use crate::diagnosis::core::{self, Core, CoreFit};
use crate::diagnosis::effects::kernel::{Clock, Scales};
use crate::diagnosis::effects::plant::{Course, Plant};
use crate::diagnosis::input::{Input, Mode, Role, Run};
use crate::diagnosis::numerics::ar::Ar;
use crate::diagnosis::numerics::linear::{dot, mean, rms, squares_about_mean};
use crate::diagnosis::numerics::rows::Rows;
use crate::diagnosis::numerics::smooth::smooth;
use crate::progress::{Watch, report, unwatched};
use crate::{EngineError, Signal};

/// Samples of all baseline runs that the cores are fitted to (of many drives fewer), of each run the beginning: a core has
/// some fifty numbers, and more samples take longer and tell them no better than the noise of the runs to explain lets
/// anyone see.
const CORE_SAMPLES: usize = 300_000;
/// Least share of its average power that each drive has in them.
const LEAST_MOVED: f64 = 0.5;
/// Share of what a core leaves of the runs to explain, by power, below which a sim that errs on the baseline bends with the rig.
const BENDS_WITH_RIG: f64 = 0.25;
/// The stage of a diagnosis.
const STAGE: &str = "linear core";
/// Samples that a run keeps at least.
const SHORTEST: usize = 1000;

/// A request made ready.
#[derive(Clone)]
pub struct Prepared {
    pub problems: Vec<Problem>,
    pub noises: Vec<Noise>,
    /// Whether repeats gave the noise; else it is the core's own residual.
    pub from_repeats: bool,
    pub pieces: Vec<Piece>,
    pub warnings: Vec<String>,
    /// Whether the effect acts so seldom that it is chosen on what it is fitted to.
    pub pooled: bool,
    /// The core's band, cycles a sample.
    pub band: [f64; 2],
    /// Whether the core stands for the sim, by response.
    pub stands: Vec<bool>,
    /// What a sim that is no linear part of the rig errs by on the baseline runs, where the core does not: relative to the
    /// response, by response. The core stands for it, unless the sim leaves far less of the runs.
    pub sim_errs: Vec<Option<f64>>,
    /// What a sim differs by on the runs from the core that stands for it, where that matters: relative to the
    /// response, by response.
    pub sim_differs: Vec<Option<f64>>,
    /// What the baseline leaves of each core: the noise before the change.
    pub baseline_noise: Vec<Ar>,
}

/// Cores, noise and stretches of every response. `watch` is told the share of the cores that are fitted.
///
/// # Errors
/// A request that does not hold together, drives that do not move, runs too short for the core;
/// [`EngineError::Cancelled`].
pub fn prepare(input: &Input, watch: Watch<'_>) -> Result<Prepared, EngineError> {
    above_noise(input, &Ar::white(1.0), |left, _| left.clone(), watch)
}

/// The same where nothing tells the noise: it is taken for white in what was measured, which the responses are the
/// `integrals`-th integrals of, with `share` of the power that the cores leave of that. So laws are told apart by what they
/// leave down to that share, whatever the noise is.
///
/// # Errors
/// Those of [`prepare`].
pub fn prepare_down_to(share: f64, integrals: usize, input: &Input) -> Result<Prepared, EngineError> {
    let noise = Ar::integrated(1.0, integrals);
    let assumed =
        |left: &Ar, band| Ar { variance: share * left.mean_power_over(&noise, band), ..noise.clone() };
    above_noise(input, &noise, assumed, &unwatched)
}

/// The band of the drives of the baseline runs, cycles a sample.
fn band(input: &Input) -> Result<[f64; 2], EngineError> {
    core::drive_band(&drives(&input.baseline))
        .ok_or(EngineError::DeadChannel { what: "drives of the baseline runs", channel: 0 })
}

/// `[run][drive]`.
fn drives(runs: &[Run]) -> Vec<Vec<&[f64]>> {
    runs.iter().map(|run| run.drive.channels().iter().map(Vec::as_slice).collect()).collect()
}

/// Of each run the beginning, so that [`CORE_SAMPLES`] are left; all of them where a drive moves later, in which case a
/// core of the beginnings would know nothing of it.
fn beginnings(runs: Vec<Vec<&[f64]>>) -> Vec<Vec<&[f64]>> {
    let whole: usize = runs.iter().map(|drives| drives[0].len()).sum();
    let most = core::samples_for(runs.first().map_or(0, Vec::len), CORE_SAMPLES);
    let share = (most as f64 / whole.max(1) as f64).min(1.0);
    let kept: Vec<Vec<&[f64]>> = runs
        .iter()
        .map(|drives| {
            let all = drives[0].len();
            let samples = ((all as f64 * share).ceil() as usize).max(SHORTEST).min(all);
            drives.iter().map(|u| &u[..samples]).collect()
        })
        .collect();
    let energy = |runs: &[Vec<&[f64]>], d: usize| -> f64 {
        runs.iter().map(|drives| squares_about_mean(drives[d])).sum()
    };
    let moves = |d: usize| energy(&kept, d) >= LEAST_MOVED * share * energy(&runs, d);
    if (0..runs.first().map_or(0, Vec::len)).all(moves) { kept } else { runs }
}

/// `supposed` is what the cores count errors in at first; `assumed` the noise where repeats tell none, by what a core
/// leaves of the baseline in its band.
fn above_noise(
    input: &Input,
    supposed: &Ar,
    assumed: impl Fn(&Ar, [f64; 2]) -> Ar,
    watch: Watch<'_>,
) -> Result<Prepared, EngineError> {
    input.check()?;
    let baseline = beginnings(drives(&input.baseline));
    let band = band(input)?;
    let Split { mut pieces, mut warnings, cut: by_drive } = split(input);
    for role in [Role::Fit, Role::Select, Role::Test] {
        if !pieces.iter().any(|p| p.role == role) {
            return Err(EngineError::TooShort {
                what: "runs of the diagnosis: fit, select and test each need one",
                needed: 1,
                found: 0,
            });
        }
    }
    let (done, responses) = (Mutex::new(0), input.responses.len());
    let fitted: Vec<CoreFit> = (0..responses)
        .into_par_iter()
        .map(|r| {
            let found = fit_core(input, &baseline, r, band, supposed)?;
            // Held while it is told, so that what is told never falls.
            let mut done = done.lock().unwrap_or_else(PoisonError::into_inner);
            *done += 1;
            report(watch, STAGE, f64::from(*done) / responses as f64)?;
            Ok(found)
        })
        .collect::<Result<_, EngineError>>()?;
    // One lead-in for all: an effect at one response is carried to the others sample by sample.
    let memory = fitted.iter().map(|f| f.core.settling(usize::MAX)).max().unwrap_or(0);
    let sim_errs: Vec<Option<f64>> =
        fitted.par_iter().enumerate().map(|(r, fit)| own_error(input, &fit.core, r)).collect();
    let stands: Vec<bool> = fitted
        .par_iter()
        .enumerate()
        .map(|(r, fit)| match sim_errs[r] {
            Some(_) => !bends_with_rig(input, &fit.core, r),
            None => input.core_stands(r),
        })
        .collect();
    let cut = Cut { input, simulated: simulate_all(input, &fitted, &stands), stands: &stands, band, memory };
    let sim_differs = other_sim(input, &cut.simulated, &stands);
    let differs = input.responses.iter().zip(&sim_differs).filter(|(_, by)| by.is_some());
    warnings.extend(differs.map(|(response, _)| format!("core_stands_for_sim: {}", response.name)));
    let mut noises = Vec::new();
    let mut from_repeats = true;
    for (r, fit) in fitted.iter().enumerate() {
        let noise = cut.repeats(&pieces, &fit.core, r);
        from_repeats &= noise.is_some();
        // A rig that changed between its repeats leaves more in their difference than the regression
        // can take out: the noise before the change is then the better floor, where it is lower.
        let noise = noise.map(|n| {
            let changed =
                n.drive_coherence > noise::COHERENT && fit.noise.mean_power(band) < n.ar.mean_power(band);
            if changed { Noise { ar: fit.noise.clone(), ..n } } else { n }
        });
        noises.push(noise.unwrap_or_else(|| Noise { ar: assumed(&fit.noise, band), drive_coherence: 0.0 }));
    }
    let floors: Vec<Noise> = noises.par_iter().enumerate().map(|(r, noise)| cut.floor(noise, r)).collect();
    // Quarters too short to be scored by themselves keep the usual roles.
    let of_quarter =
        |groups: &[Vec<usize>], q| cut.largest_gap(&quarter(input, groups, q), &fitted, &floors).ok();
    if let Some(groups) = by_drive
        && let [Some(a), Some(b), Some(c), Some(d)] = [0, 1, 2, 3].map(|q| of_quarter(&groups, q))
        && let Some(roles) = seldom::roles([a, b, c, d])
    {
        pieces = in_quarters(input, &groups, roles);
    }
    let problem = |(r, (fit, noise)): (usize, (&CoreFit, &Noise))| cut.problem(&pieces, &fit.core, r, noise);
    let mut problems: Vec<Problem> = fitted
        .par_iter()
        .zip(&floors)
        .enumerate()
        .map(problem)
        .collect::<Vec<Result<_, EngineError>>>()
        .into_iter()
        .collect::<Result<_, _>>()?;
    let pooled = pool(&mut problems);
    if pooled {
        warnings.push("acts_seldom".into());
    }
    let baseline_noise = fitted.into_iter().map(|f| f.noise).collect();
    Ok(Prepared {
        problems,
        noises,
        from_repeats,
        pieces,
        warnings,
        pooled,
        band,
        stands,
        sim_errs,
        sim_differs,
        baseline_noise,
    })
}

/// Where only the fit or only the select stretches hold a gap, both are used for both: what acts a few
/// times in a programme may do so in any of them, and neither alone could tell what it is.
fn pool(problems: &mut [Problem]) -> bool {
    let largest =
        |of: fn(&Problem) -> &[Stretch]| problems.iter().map(|p| p.chi2_none(of(p))).fold(0.0, f64::max);
    let (fit, select) = (largest(|p| &p.fit), largest(|p| &p.select));
    let pooled = fit.min(select) < NOISE_ONLY && fit.max(select) >= PLAIN_GAP;
    if pooled {
        for problem in problems {
            problem.fit.extend(problem.select.iter().cloned());
            problem.select.clone_from(&problem.fit);
        }
    }
    pooled
}

fn fit_core(
    input: &Input,
    drives: &[Vec<&[f64]>],
    response: usize,
    band: [f64; 2],
    supposed: &Ar,
) -> Result<CoreFit, EngineError> {
    let stretches: Vec<core::Stretch<'_>> = input
        .baseline
        .iter()
        .zip(drives)
        .map(|(run, drives)| core::Stretch {
            drives: drives.clone(),
            response: &run.response.channel(response)[..drives[0].len()],
        })
        .collect();
    if stretches.iter().all(|s| s.response.windows(2).all(|w| w[0] == w[1])) {
        return Err(EngineError::DeadChannel { what: "response of the baseline runs", channel: response });
    }
    // From before the change the rig is its own linear self; in situ low-level runs bend too.
    core::fit(&stretches, input.sample_rate_hz(), band, input.mode == Mode::External, supposed)
}

/// Of a sim from before the change: what it errs by on the baseline runs beyond what the core does, relative to the
/// response, where that is half of what matters or more. What such a sim leaves of later runs is its own error and the
/// change's together, which no law of the rig can tell apart.
fn own_error(input: &Input, core: &Core, response: usize) -> Option<f64> {
    if !input.sim_may_bend() {
        return None;
    }
    let sim = Left::of(&input.baseline, response)?;
    let own = ((sim.by_sim - left_by_core(&input.baseline, core, response)).max(0.0) / sim.size).sqrt();
    (own > 0.5 * input.material_gap).then_some(own)
}

/// Whether a sim leaves so much less of the runs to explain than the core that the rig bends by itself at their level, and
/// the sim with it: whatever has changed, both lack.
fn bends_with_rig(input: &Input, core: &Core, response: usize) -> bool {
    Left::of(&input.runs, response)
        .is_some_and(|sim| sim.by_sim < BENDS_WITH_RIG * left_by_core(&input.runs, core, response))
}

/// Sum of the squares of what a core leaves of a response, over runs.
fn left_by_core(runs: &[Run], core: &Core, response: usize) -> f64 {
    let left = |run: &Run| differ(run.response.channel(response), &core.simulate(run.drive.channels()));
    runs.iter().map(left).sum()
}

/// What the sim says of every run, `[run][response][sample]`.
fn simulate_all(input: &Input, fitted: &[CoreFit], stands: &[bool]) -> Vec<Arc<Vec<Vec<f64>>>> {
    input
        .runs
        .par_iter()
        .map(|run| {
            let of = |(r, fit): (usize, &CoreFit)| match &run.simulated {
                Some(simulated) if !stands[r] => simulated.channel(r).to_vec(),
                _ => free_run(&fit.core, run, r),
            };
            Arc::new(fitted.iter().enumerate().map(of).collect())
        })
        .collect()
}

/// The core's free run of a whole run, with what adopted effects of the sim add to it.
fn free_run(core: &Core, run: &Run, response: usize) -> Vec<f64> {
    let mut y = core.simulate(run.drive.channels());
    if let Some(added) = &run.added {
        y.iter_mut().zip(added.channel(response)).for_each(|(y, added)| *y += added);
    }
    y
}

/// What the sim differs by from the core that stands for it, relative to the response, by response; `None` where that is
/// less than `material_gap`.
fn other_sim(input: &Input, simulated: &[Arc<Vec<Vec<f64>>>], stands: &[bool]) -> Vec<Option<f64>> {
    let differs = |r: usize| {
        let (mut difference, mut all) = (0.0, 0.0);
        for (run, core) in input.runs.iter().zip(simulated) {
            let Some(sim) = run.simulated.as_ref().filter(|_| stands[r]) else { continue };
            difference += differ(sim.channel(r), &core[r]);
            all += size(&core[r]);
        }
        let by = (difference / all.max(f64::MIN_POSITIVE)).sqrt();
        (by > input.material_gap).then_some(by)
    };
    (0..input.responses.len()).map(differs).collect()
}

/// A request cut into its stretches.
struct Cut<'a> {
    input: &'a Input,
    /// `[run][response][sample]`
    simulated: Vec<Arc<Vec<Vec<f64>>>>,
    /// Whether the core stands for the sim, by response.
    stands: &'a [bool],
    band: [f64; 2],
    /// Samples that the slowest core remembers.
    memory: usize,
}

impl<'a> Cut<'a> {
    /// Samples at the start of a run that its unknown state before may still colour.
    fn lead(&self, samples: usize) -> usize {
        self.memory.min(samples / 5)
    }

    /// What errors of a response are counted in: its noise, with that of a sim from before the change that bends by itself.
    fn floor(&self, noise: &Noise, response: usize) -> Noise {
        let Input { baseline, runs, .. } = self.input;
        if self.stands[response] || !self.input.sim_may_bend() {
            return noise.clone();
        }
        Noise { ar: noise::with_own_error(&noise.ar, baseline, runs, response, self.band), ..*noise }
    }

    fn repeats(&self, pieces: &[Piece], core: &Core, response: usize) -> Option<Noise> {
        let mut pairs = Vec::new();
        for (i, a) in pieces.iter().enumerate() {
            let Some(b) = pieces[i + 1..].iter().find(|b| b.group == a.group) else { continue };
            let range = a.from..a.to.min(b.to);
            let (run_a, run_b) = (&self.input.runs[a.run], &self.input.runs[b.run]);
            let (ya, yb) = (run_a.response.channel(response), run_b.response.channel(response));
            pairs.push(Pair {
                difference: ya[range.clone()].iter().zip(&yb[range.clone()]).map(|(a, b)| a - b).collect(),
                drives: run_a.drive.channels().iter().map(|d| &d[range.clone()]).collect(),
                simulated: &self.simulated[a.run][response][range.clone()],
                lead: if a.from == 0 { self.lead(range.len()) } else { 0 },
            });
        }
        noise::from_repeats(&pairs, core, self.band)
    }

    /// A piece of a run as a stretch of one response.
    fn stretch(
        &self,
        piece: &Piece,
        core: &Core,
        response: usize,
        noise: &Noise,
    ) -> Result<Stretch, EngineError> {
        let (rate, runs) = (self.input.sample_rate_hz(), &self.input.runs);
        let begin = runs.iter().map(|r| r.started_s).fold(f64::INFINITY, f64::min);
        let end = runs.iter().map(|r| r.started_s + r.drive.duration_s()).fold(f64::NEG_INFINITY, f64::max);
        let span = (end - begin).max(1e-9);
        let run = &runs[piece.run];
        // A piece inside a run is simulated from before its start; at a run's start there is no before.
        let start = piece.from.saturating_sub(self.memory);
        let lead = if piece.from > 0 { piece.from - start } else { self.lead(piece.to) };
        let scored = piece.to - start - lead;
        if scored < 64 {
            return Err(EngineError::TooShort { what: "run of the diagnosis", needed: 64, found: scored });
        }
        let mut rows = Rows::new(scored, self.band, &noise.ar);
        if lead < self.memory {
            rows = rows.without(&core.modes.decays(scored));
        }
        let cut = |signal: &[Vec<f64>]| -> Vec<Vec<f64>> {
            signal.iter().map(|x| x[start..piece.to].to_vec()).collect()
        };
        Ok(Stretch {
            run: piece.run,
            from: start,
            group: piece.group,
            measured: Arc::new(run.response.channel(response)[start..piece.to].to_vec()),
            lead,
            rows: Arc::new(rows),
            course: Course {
                simulated: Arc::new(cut(&self.simulated[piece.run])),
                // With all of the run before it, as the sim has it too.
                core: Arc::new(free_run(core, run, response)[start..piece.to].to_vec()),
                clock: Clock {
                    start: (run.started_s - begin + start as f64 / rate) / span,
                    step: 1.0 / (rate * span),
                },
                carried: Arc::default(),
                drives: Arc::new(cut(run.drive.channels())),
            },
        })
    }

    /// What the sim leaves of these pieces at the response where it leaves most, in noise floors squared.
    fn largest_gap(
        &self,
        pieces: &[Piece],
        fitted: &[CoreFit],
        noises: &[Noise],
    ) -> Result<f64, EngineError> {
        let mut largest = 0.0_f64;
        for (r, (fit, noise)) in fitted.iter().zip(noises).enumerate() {
            let mut rows = Vec::new();
            for piece in pieces {
                let stretch = self.stretch(piece, &fit.core, r, noise)?;
                stretch.extend(&stretch.gap(r), &mut rows);
            }
            largest = largest.max(dot(&rows, &rows) / rows.len().max(1) as f64);
        }
        Ok(largest)
    }

    /// What the baseline runs say against a retune of the core, where that is the sim.
    fn tolerance(&self, plant: &Plant, noise: &Noise) -> Option<Tolerance> {
        let stands = self.input.sim_is_linear || self.stands[plant.response];
        let is_sim = stands || self.input.runs.iter().all(|run| run.simulated.is_none());
        if self.input.mode == Mode::InSitu || !is_sim {
            return None;
        }
        let scored = |drive: &'a Signal| {
            let n = drive.n_samples();
            let lead = self.lead(n);
            (drive.channels(), Rows::new((n - lead).max(2), self.band, &noise.ar), lead)
        };
        Tolerance::new(plant, &self.input.baseline.iter().map(|run| scored(&run.drive)).collect::<Vec<_>>())
    }

    fn problem(
        &self,
        pieces: &[Piece],
        core: &Core,
        response: usize,
        noise: &Noise,
    ) -> Result<Problem, EngineError> {
        let stretches = |role: Role| -> Result<Vec<Stretch>, EngineError> {
            let pieces = pieces.iter().filter(|p| p.role == role);
            let mut stretches: Vec<Stretch> = pieces
                .map(|piece| self.stretch(piece, core, response, noise))
                .collect::<Result<_, EngineError>>()?;
            share(&mut stretches);
            Ok(stretches)
        };
        let (fit, select, test) = (stretches(Role::Fit)?, stretches(Role::Select)?, stretches(Role::Test)?);
        let drives = Drives::of(&fit);
        if drives.peak.iter().all(|&p| p == 0.0) {
            return Err(EngineError::DeadChannel { what: "drives of the fit runs", channel: 0 });
        }
        let y_mean = core.response_mean;
        let measured: Vec<f64> = fit.iter().flat_map(|s| s.measured.iter().map(|y| y - y_mean)).collect();
        let change: Vec<f64> = fit
            .iter()
            .flat_map(|s| {
                let smooth = smooth(&s.measured, self.band[1]);
                smooth.windows(2).map(|w| w[1] - w[0]).collect::<Vec<f64>>()
            })
            .collect();
        let (y, dy) = (rms(&measured), rms(&change));
        if !(y > 0.0 && dy > 0.0) {
            return Err(EngineError::DeadChannel { what: "response of the fit runs", channel: response });
        }
        let mut other_mean = Vec::new();
        let mut other_scale = Vec::new();
        for r in 0..self.input.responses.len() {
            let samples: Vec<f64> = fit.iter().flat_map(|s| s.simulated[r].iter().copied()).collect();
            let centre = mean(&samples);
            other_mean.push(centre);
            other_scale.push(rms(&samples.iter().map(|s| s - centre).collect::<Vec<f64>>()));
        }
        let plant = Plant {
            response,
            core: core.clone(),
            scales: Scales { y_mean, y, dy },
            other_scale,
            other_mean,
            drive_peak: drives.peak,
        };
        Ok(Problem {
            tolerance: self.tolerance(&plant, noise).map(Arc::new),
            plant,
            drive_quantiles: drives.quantiles,
            drive_slope: drives.slope,
            band_end: self.band[1],
            fit,
            select,
            test,
        })
    }
}

/// Levels of each drive over the fit stretches.
struct Drives {
    peak: Vec<f64>,
    quantiles: Vec<[f64; 6]>,
    slope: Vec<f64>,
}

impl Drives {
    fn of(fit: &[Stretch]) -> Self {
        let mut out = Self { peak: Vec::new(), quantiles: Vec::new(), slope: Vec::new() };
        for d in 0..fit[0].drives.len() {
            let samples: Vec<f64> = fit.iter().flat_map(|s| s.drives[d].iter().copied()).collect();
            let peak = samples.iter().fold(0.0_f64, |m, u| m.max(u.abs()));
            let mut sorted: Vec<f64> = samples.iter().map(|u| u.abs() / peak.max(1e-300)).collect();
            sorted.sort_by(f64::total_cmp);
            let at = |q: f64| sorted[((sorted.len() - 1) as f64 * q) as usize].max(1e-6);
            out.quantiles.push([0.3, 0.6, 0.8, 0.95, 0.99, 0.998].map(at));
            let change: f64 = samples.windows(2).map(|w| (w[1] - w[0]).abs()).sum();
            out.slope.push((change / (samples.len().max(2) - 1) as f64 / peak.max(1e-300)).max(1e-9));
            out.peak.push(peak);
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_baseline_counts_by_its_beginnings_unless_a_drive_moves_later() {
        let wave = |from: usize, n: usize| -> Vec<f64> {
            (0..n).map(|k| if k < from { 0.0 } else { (0.3 * k as f64).sin() }).collect()
        };
        let n = 2 * CORE_SAMPLES;
        let (moving, late, short) = (wave(0, n), wave(n / 2, n), wave(0, SHORTEST / 2));
        let samples = |runs: Vec<Vec<&[f64]>>| -> Vec<usize> {
            beginnings(runs).iter().map(|drives| drives.iter().map(|u| u.len()).min().unwrap()).collect()
        };
        let cut = samples(vec![vec![&moving, &moving], vec![&short, &short]]);
        assert!(cut[0].abs_diff(CORE_SAMPLES) < SHORTEST && cut[1] == short.len(), "{cut:?}");
        assert_eq!(samples(vec![vec![&moving, &late]]), [n], "the second drive moves in the second half");
        assert_eq!(samples(vec![vec![&moving[..CORE_SAMPLES]]]), [CORE_SAMPLES]);
    }
}
