//! Drives: band-limited noise for the programme, and the kinds of run that a next experiment may ask for.

use rand::Rng;
use rand_distr::{Distribution, StandardNormal};

use super::rig::{RATE, rms};

/// A run that a report proposes, with levels relative to the peaks of the runs so far.
#[derive(Debug, Clone)]
pub struct Wish {
    /// `noise`, `slow_sine`, `resonance_sine`, `sweep` or `offset_noise`.
    pub kind: String,
    pub level_rel: f64,
    /// Frequency of a sine; left out: one that suits the rig.
    pub frequency_hz: Option<f64>,
}

/// Length of a run that was proposed.
const WISHED_S: f64 = 12.0;

/// Noise up to `high_hz` without an offset, RMS 1.
pub fn noise(seconds: f64, high_hz: f64, rng: &mut impl Rng) -> Vec<f64> {
    let n = (seconds * RATE) as usize;
    let share = 1.0 - (-std::f64::consts::TAU * high_hz / RATE).exp();
    let mut stages = [0.0; 6];
    let mut slow = 0.0;
    let mut out: Vec<f64> = (0..n + 500)
        .map(|_| {
            let mut x: f64 = StandardNormal.sample(rng);
            for s in &mut stages {
                *s += share * (x - *s);
                x = *s;
            }
            slow += 0.003 * (x - slow);
            x - slow
        })
        .skip(500)
        .collect();
    let level = rms(&out);
    out.iter_mut().for_each(|x| *x /= level);
    out
}

/// The drives `[drive][sample]` of a run that was asked for; `peaks` are those of the runs so far and
/// `resonance_hz` the rig's own, for sines without a frequency.
///
/// # Errors
/// A kind that is not on the menu.
pub fn wished(
    wish: &Wish,
    peaks: &[f64],
    high_hz: f64,
    resonance_hz: f64,
    rng: &mut impl Rng,
) -> Result<Vec<Vec<f64>>, String> {
    let n = (WISHED_S * RATE) as usize;
    let tau = std::f64::consts::TAU;
    let sine = |hz: f64| -> Vec<f64> { (0..n).map(|k| (tau * hz * k as f64 / RATE).sin()).collect() };
    let slow = (0.05 * resonance_hz).max(2.0 / WISHED_S);
    let shape = |rng: &mut _| match wish.kind.as_str() {
        "noise" => Ok(of_peak(noise(WISHED_S, high_hz, rng))),
        "offset_noise" => Ok(of_peak(noise(WISHED_S, high_hz, rng)).iter().map(|u| 0.5 * u + 0.5).collect()),
        "slow_sine" => Ok(sine(wish.frequency_hz.unwrap_or(slow))),
        "resonance_sine" => Ok(sine(wish.frequency_hz.unwrap_or(resonance_hz))),
        "sweep" => {
            let (low, high) = (0.05 * high_hz, 0.9 * high_hz);
            let rate = (high / low).ln() / WISHED_S;
            let phase = |k: usize| tau * low * ((rate * k as f64 / RATE).exp() - 1.0) / rate;
            Ok((0..n).map(|k| phase(k).sin()).collect())
        }
        other => Err(format!("no run of kind {other}")),
    };
    let scaled = |x: Vec<f64>, peak: f64| x.iter().map(|u| u * peak * wish.level_rel).collect();
    peaks.iter().map(|&peak| Ok(scaled(shape(rng)?, peak))).collect()
}

fn of_peak(mut x: Vec<f64>) -> Vec<f64> {
    let largest = peak(&x).max(f64::MIN_POSITIVE);
    x.iter_mut().for_each(|x| *x /= largest);
    x
}

/// Largest magnitude.
pub fn peak(x: &[f64]) -> f64 {
    x.iter().fold(0.0, |m, x| m.max(x.abs()))
}
