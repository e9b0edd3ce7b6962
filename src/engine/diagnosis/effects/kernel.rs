//! The one forward kernel: the core's states with forces that depend on the response they shape.
//!
//! `x+ = A x + sum_q E_q phi_q(y_mid, v_mid, z_q, t, other)`, `y = ext + C x`, where `ext` is all that
//! does not depend on the response. Midpoint rule with two passes: the first predicts the next
//! sample, the second evaluates midway to it (one explicit pass diverges for quadratic damping).
//! Midway a law sees the cubic through the last three samples and the next: a straight line between
//! two would err by some percent at a tenth of the sample rate.

use serde::{Deserialize, Serialize};

use super::law::{Instant, Law, Memory};
use crate::diagnosis::core::modes::Modes;

/// Beyond this many times the response's RMS a run has diverged.
const RUNAWAY: f64 = 1e4;

/// The last three samples and the next, oldest first, about the working point.
pub type Window = [f64; 4];

/// Their weights in the value midway to the next,
pub const MIDWAY: Window = [1.0 / 16.0, -5.0 / 16.0, 15.0 / 16.0, 5.0 / 16.0];
/// in the change per sample there,
const SLOPE: Window = [1.0 / 24.0, -3.0 / 24.0, -21.0 / 24.0, 23.0 / 24.0];
/// and in the change since the last sample: changes that a memory adds up to a displacement.
const STEP: Window = [0.0, 0.0, -1.0, 1.0];

/// The same weights where samples on both sides are known: two before, two after.
const BETWEEN: Window = [-1.0 / 16.0, 9.0 / 16.0, 9.0 / 16.0, -1.0 / 16.0];
const SLOPE_BETWEEN: Window = [1.0 / 24.0, -27.0 / 24.0, 27.0 / 24.0, -1.0 / 24.0];
const STEP_BETWEEN: Window = [0.0, -1.0, 1.0, 0.0];

/// Weights of the change that a law sees.
pub fn change(law: &Law) -> &'static Window {
    if law.memories() > 0 { &STEP } else { &SLOPE }
}

/// Sum of the samples with their weights.
#[inline]
pub fn weigh(weights: &Window, window: &Window) -> f64 {
    weights.iter().zip(window).map(|(w, y)| w * y).sum()
}

/// The first guess of the next sample: the parabola through the last three.
#[inline]
pub fn extrapolate([earlier, before, now]: [f64; 3]) -> f64 {
    3.0 * (now - before) + earlier
}

/// One force with its strength and path.
pub struct Force<'a> {
    pub law: &'a Law,
    pub shape: &'a [f64],
    /// `E`, response unit, one entry a state.
    pub path: &'a [f64],
    /// The signal that the law calls other, per sample; empty if it needs none.
    pub other: &'a [f64],
}

/// Units of a law's arguments on one channel.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Scales {
    /// Working point of the response.
    pub y_mean: f64,
    /// RMS of the response about it.
    pub y: f64,
    /// RMS of its change per sample.
    pub dy: f64,
}

impl Scales {
    /// What a law sees of a response `y` about the working point that changes by `change` a sample.
    #[inline]
    pub fn instant(&self, y: f64, change: f64, t: f64, aux: f64) -> Instant {
        Instant { y: y / self.y, dy: change / self.y, v: change / self.dy, t, aux }
    }
}

/// Time of a run in units of the programme.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Clock {
    /// At the first sample.
    pub start: f64,
    /// Per sample.
    pub step: f64,
}

/// Free run of the forces on top of `ext`; `None` if it runs away.
pub fn run(
    modes: &Modes,
    forces: &[Force<'_>],
    ext: &[f64],
    scales: Scales,
    clock: Clock,
) -> Option<Vec<f64>> {
    trace(modes, forces, ext, scales, clock).map(|run| run.0)
}

/// The same with the next samples, about the working point, that the forces saw.
pub fn trace(
    modes: &Modes,
    forces: &[Force<'_>],
    ext: &[f64],
    scales: Scales,
    clock: Clock,
) -> Option<(Vec<f64>, Vec<f64>)> {
    let n = modes.order();
    let mut x = vec![0.0; n];
    let mut memories: Vec<Memory> = vec![Memory::default(); forces.len()];
    let reach: Vec<f64> = forces.iter().map(|f| modes.read(f.path)).collect();
    let mut values = vec![0.0; forces.len()];
    let mut out = Vec::with_capacity(ext.len());
    let mut guesses = Vec::with_capacity(ext.len());
    let limit = RUNAWAY * scales.y;
    let mut past = [ext.first()? - scales.y_mean; 3];
    for (k, e) in ext.iter().enumerate() {
        let y = e - scales.y_mean + modes.read(&x);
        if y.is_nan() || y.abs() >= limit {
            return None;
        }
        out.push(y + scales.y_mean);
        let Some(next_ext) = ext.get(k + 1) else { break };
        modes.turn(&mut x);
        let free = next_ext - scales.y_mean + modes.read(&x);
        let t = clock.start + clock.step * (k as f64 + 0.5);
        past = [past[1], past[2], y];
        let mut next = extrapolate(past);
        for pass in 0..2 {
            if pass == 1 {
                guesses.push(next);
            }
            let mut predicted = free;
            let window = [past[0], past[1], past[2], next];
            for (q, force) in forces.iter().enumerate() {
                let mut memory = memories[q];
                let instant = scales.instant(
                    weigh(&MIDWAY, &window),
                    weigh(change(force.law), &window),
                    t,
                    midway(force.other, k),
                );
                let value = force.law.at(force.shape, instant, &mut memory);
                predicted += reach[q] * value;
                if pass == 1 {
                    values[q] = value;
                    memories[q] = memory;
                }
            }
            next = predicted;
        }
        for (force, value) in forces.iter().zip(&values) {
            for (x, e) in x.iter_mut().zip(force.path) {
                *x += e * value;
            }
        }
    }
    Some((out, guesses))
}

/// Values of a law along a given response, midway between samples: what a regression uses.
pub fn along(
    law: &Law,
    shape: &[f64],
    response: &[f64],
    other: &[f64],
    scales: Scales,
    clock: Clock,
) -> Vec<f64> {
    let mut memory = Memory::default();
    let slope = if law.memories() > 0 { &STEP_BETWEEN } else { &SLOPE_BETWEEN };
    (0..response.len())
        .map(|k| {
            let window = around(response, k).map(|y| y - scales.y_mean);
            let t = clock.start + clock.step * (k as f64 + 0.5);
            let instant =
                scales.instant(weigh(&BETWEEN, &window), weigh(slope, &window), t, midway(other, k));
            law.at(shape, instant, &mut memory)
        })
        .collect()
}

/// Two samples up to `k` and two from the next on; those beyond an end are the end's.
#[inline]
fn around(signal: &[f64], k: usize) -> Window {
    let last = signal.len() - 1;
    [signal[k.saturating_sub(1)], signal[k], signal[(k + 1).min(last)], signal[(k + 2).min(last)]]
}

/// A signal midway from sample `k` to the next; 0 if it is empty.
#[inline]
pub fn midway(signal: &[f64], k: usize) -> f64 {
    if signal.is_empty() { 0.0 } else { weigh(&BETWEEN, &around(signal, k)) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use realfft::num_complex::Complex64;

    const UNIT: Scales = Scales { y_mean: 0.0, y: 1.0, dy: 1.0 };
    const CLOCK: Clock = Clock { start: 0.0, step: 0.0 };

    fn oscillator() -> Modes {
        let z = Complex64::from_polar(0.99, 0.1);
        Modes::of_values(&[z, z.conj()])
    }

    #[test]
    fn a_linear_force_moves_the_poles_as_feedback_does() {
        let modes = oscillator();
        let path = [0.0, 2e-3];
        let ext: Vec<f64> = (0..3000).map(|k| (0.09 * f64::from(k)).sin()).collect();
        let y = run(
            &modes,
            &[Force { law: &Law::Linear, shape: &[], path: &path, other: &[] }],
            &ext,
            UNIT,
            CLOCK,
        )
        .unwrap();
        // The loop's own equation, solved at once: y_(k+1) enters its own midpoint, C E = 0 here.
        let mut x = [0.0, 0.0];
        let mut past = [ext[0]; 3];
        for k in 0..2999 {
            let now = ext[k] + x[0];
            assert!((y[k] - now).abs() < 1e-9, "sample {k}");
            past = [past[1], past[2], now];
            modes.turn(&mut x);
            let window = [past[0], past[1], past[2], ext[k + 1] + x[0]];
            x[1] += path[1] * weigh(&MIDWAY, &window);
        }
    }

    #[test]
    fn midway_a_law_sees_what_a_sine_does_there() {
        let w = 0.4_f64;
        let at = |k: f64| (w * k + 0.3).sin();
        let (value, slope) = (at(0.5), w * (w * 0.5 + 0.3).cos());
        let past = [at(-2.0), at(-1.0), at(0.0), at(1.0)];
        assert!((weigh(&MIDWAY, &past) - value).abs() < 2e-3);
        assert!((weigh(change(&Law::Coulomb), &past) - slope).abs() < 4e-3);
        let around = [at(-1.0), at(0.0), at(1.0), at(2.0)];
        assert!((weigh(&BETWEEN, &around) - value).abs() < 1e-3);
        assert!((weigh(&SLOPE_BETWEEN, &around) - slope).abs() < 1e-3);
        assert!((extrapolate([at(-2.0), at(-1.0), at(0.0)]) - at(1.0)).abs() < 0.07);
    }

    #[test]
    fn a_force_that_feeds_itself_runs_away_and_says_so() {
        let modes = oscillator();
        let ext = vec![1.0; 5000];
        let force = Force { law: &Law::Cubic, shape: &[0.0], path: &[0.5, 0.0], other: &[] };
        assert!(run(&modes, &[force], &ext, UNIT, CLOCK).is_none());
    }

    #[test]
    fn a_force_along_its_own_free_run_gives_that_run_again() {
        let modes = oscillator();
        let path = [1e-3, -4e-3];
        let ext: Vec<f64> = (0..2000).map(|k| 1.5 * (0.07 * f64::from(k)).sin()).collect();
        let law = Law::Coulomb;
        let shape = [0.02_f64.ln()];
        let scales = Scales { y_mean: 0.0, y: 1.0, dy: 0.1 };
        let y =
            run(&modes, &[Force { law: &law, shape: &shape, path: &path, other: &[] }], &ext, scales, CLOCK)
                .unwrap();
        let values = along(&law, &shape, &y, &[], scales, CLOCK);
        let again = modes.filter(&path, &values);
        for (k, (y, (e, f))) in y.iter().zip(ext.iter().zip(&again)).enumerate() {
            assert!((y - e - f).abs() < 2e-3, "sample {k}: {y} {}", e + f);
        }
    }
}
