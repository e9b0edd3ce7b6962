//! The verdict's response where it was never seen: before and after the effect, in time and by
//! frequency.

use serde::{Deserialize, Serialize};

use super::spectra::Welch;
use super::{short, shorten};
use crate::diagnosis::data::prepare::Prepared;
use crate::diagnosis::data::problem::{Problem, Stretch};
use crate::diagnosis::fit::fitting::Fitted;
use crate::diagnosis::input::Input;

/// Swings of the response that the window holds.
const SWINGS: usize = 24;
/// Samples of the window, at least and at most.
const WINDOW: [usize; 2] = [300, 2000];

/// A window of a test stretch in which the gap is largest, and spectra of all test stretches.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct UnseenRun {
    /// Run of the window.
    pub run: String,
    /// Response.
    pub channel: String,
    /// Its unit.
    pub unit: String,
    /// Start of the window in the run.
    pub from_s: f64,
    /// From one sample to the next.
    pub step_s: f64,
    /// As measured.
    pub measured: Vec<f64>,
    /// What the sim says.
    pub simulated: Vec<f64>,
    /// What sim and effect say; none without an effect.
    pub with_effect: Option<Vec<f64>>,
    /// RMS of the noise over all frequencies.
    pub noise_rms: f64,
    /// By frequency.
    pub spectra: UnseenSpectra,
}

/// One-sided densities over the test stretches, unit^2/Hz.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct UnseenSpectra {
    /// Frequencies.
    pub frequency_hz: Vec<f64>,
    /// The response as measured.
    pub measured: Vec<f64>,
    /// What the sim leaves.
    pub before: Vec<f64>,
    /// What sim and effect leave; none without an effect.
    pub after: Option<Vec<f64>>,
    /// The noise floor.
    pub noise: Vec<f64>,
}

/// The view of `problem`'s test stretches; none without any.
pub(super) fn view(
    input: &Input,
    prepared: &Prepared,
    problem: &Problem,
    best: Option<&Fitted>,
) -> Option<UnseenRun> {
    let rate = input.sample_rate_hz();
    let channel = &input.responses[problem.response];
    let noise = &prepared.noises[problem.response].ar;
    let predictions = best.and_then(|b| b.candidate.predictions(problem, &problem.test, &b.p));
    // Before any effect.
    let sim = &prepared.problems[problem.response].test;
    let gaps: Vec<Vec<f64>> = sim.iter().map(|s| s.residual(s.sim(input, problem.response))).collect();
    let (which, from, len) = worst_window(problem, &gaps)?;
    let stretch = &problem.test[which];
    let cut = |x: &[f64]| shorten(x[from..from + len].iter().copied());
    Some(UnseenRun {
        run: input.runs[stretch.run].name.clone(),
        channel: channel.name.clone(),
        unit: channel.unit.clone(),
        from_s: (stretch.from + from) as f64 / rate,
        step_s: 1.0 / rate,
        measured: cut(&stretch.measured),
        simulated: cut(sim[which].sim(input, problem.response)),
        with_effect: predictions.as_ref().map(|p| cut(&p[which])),
        noise_rms: short(noise.mean_power([0.0, 0.5]).sqrt()),
        spectra: spectra(prepared, problem, &gaps, predictions.as_deref(), rate),
    })
}

fn spectra(
    prepared: &Prepared,
    problem: &Problem,
    gaps: &[Vec<f64>],
    predictions: Option<&[Vec<f64>]>,
    rate: f64,
) -> UnseenSpectra {
    let stretches: Vec<&Stretch> = problem.test.iter().collect();
    let welch = Welch::new(&stretches, prepared.band);
    let scored = |signals: &[Vec<f64>]| -> Vec<f64> {
        let parts: Vec<&[f64]> = signals.iter().zip(&stretches).map(|(x, s)| &x[s.lead..]).collect();
        welch.auto(&parts, rate)
    };
    let measured: Vec<Vec<f64>> = stretches.iter().map(|s| s.measured.to_vec()).collect();
    let left =
        predictions.map(|p| stretches.iter().zip(p).map(|(s, p)| s.residual(p)).collect::<Vec<Vec<f64>>>());
    let after = scored(left.as_deref().unwrap_or(gaps));
    let noise = welch.noise(&prepared.noises[problem.response].ar, rate);
    let [frequency_hz, measured, before, after, noise] =
        welch.thinned(rate, [scored(&measured), scored(gaps), after, noise]);
    UnseenSpectra { frequency_hz, measured, before, after: left.map(|_| after), noise }
}

/// Stretch, first sample and length of the window with the largest gap.
fn worst_window(problem: &Problem, gaps: &[Vec<f64>]) -> Option<(usize, usize, usize)> {
    let mut worst: Option<(f64, usize, usize, usize)> = None;
    for (which, (stretch, gap)) in problem.test.iter().zip(gaps).enumerate() {
        let scored = stretch.measured.len() - stretch.lead;
        let mean = problem.scales.y_mean;
        let crossings = stretch.measured[stretch.lead..]
            .windows(2)
            .filter(|w| (w[0] < mean) != (w[1] < mean))
            .count()
            .max(1);
        let len = (2 * SWINGS * scored / crossings).clamp(WINDOW[0], WINDOW[1]).min(scored);
        let mut power: f64 = gap[stretch.lead..stretch.lead + len].iter().map(|g| g * g).sum();
        for from in stretch.lead..=gap.len() - len {
            let mean = power / len as f64;
            if worst.is_none_or(|w| mean > w.0) {
                worst = Some((mean, which, from, len));
            }
            if let Some(next) = gap.get(from + len) {
                power += next * next - gap[from] * gap[from];
            }
        }
    }
    worst.map(|(_, which, from, len)| (which, from, len))
}
