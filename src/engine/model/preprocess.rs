//! The filter stored with a model: the same for fit and prediction.

use std::sync::Arc;

use rayon::prelude::*;
use rigcast_numerics::fft::{ComplexToReal, RealFftPlanner, RealToComplex};
use serde::{Deserialize, Serialize};

use crate::{EngineError, Signal, first_not_finite, rounded};

/// Zero-phase filters over a whole signal, by FFT. Both may be set.
///
/// A pass band ends in half a cosine over its last 5 % of frequency, inside the band: nothing passes at
/// and beyond the limit, and the ends of a signal ring less than with a rectangular gain.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Preprocess {
    /// Everything above is removed (the paper's 80 Hz).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub low_pass_hz: Option<f64>,
    /// Everything outside is removed, the mean too.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub band_pass_hz: Option<[f64; 2]>,
}

/// Share of a limit over which the gain falls.
const SLOPE: f64 = 0.05;

impl Preprocess {
    /// Whether signals pass unchanged.
    pub fn is_none(&self) -> bool {
        self.low_pass_hz.is_none() && self.band_pass_hz.is_none()
    }

    /// Checks the limits for signals of one sample rate, hertz.
    ///
    /// # Errors
    /// [`EngineError::Setting`] unless each frequency lies above 0 and below half the sample rate,
    /// and a band's first below its second.
    pub fn check(&self, sample_rate_hz: f64) -> Result<(), EngineError> {
        let nyquist = sample_rate_hz / 2.0;
        let inside = |hz: f64| hz > 0.0 && hz < nyquist;
        if let Some(hz) = self.low_pass_hz
            && !inside(hz)
        {
            return Err(EngineError::Setting {
                setting: "preprocess.low_pass_hz",
                found: hz.to_string(),
                limit: format!("above 0 and below half the sample rate, {} Hz", rounded(nyquist, 10)),
            });
        }
        if let Some([low, high]) = self.band_pass_hz
            && !(inside(low) && inside(high) && low < high)
        {
            return Err(EngineError::Setting {
                setting: "preprocess.band_pass_hz",
                found: format!("[{low}, {high}]"),
                limit: format!(
                    "two rising frequencies above 0 and below half the sample rate, {} Hz",
                    rounded(nyquist, 10)
                ),
            });
        }
        Ok(())
    }

    /// The filtered signal, as long as `x`.
    ///
    /// Before the transform both ends are continued by their point reflection, which fades into a smooth
    /// bridge from the last value to the first, so that neither end influences the other.
    ///
    /// # Errors
    /// Those of [`Preprocess::check`], no samples, a result that is not finite.
    pub fn apply(&self, x: &Signal) -> Result<Signal, EngineError> {
        self.apply_to(x.clone())
    }

    /// [`Preprocess::apply`] in the signal's own memory.
    ///
    /// # Errors
    /// As [`Preprocess::apply`].
    pub fn apply_to(&self, x: Signal) -> Result<Signal, EngineError> {
        let Some(lines) = self.lines_for(&x)? else { return Ok(x) };
        let (sample_rate_hz, n) = (x.sample_rate_hz(), x.n_samples());
        let mut channels = x.into_channels();
        channels.par_iter_mut().for_each(|samples| {
            let mut time = vec![0.0; lines.total];
            extend(samples, lines.pad, &mut time);
            lines.pass(&mut time);
            samples.copy_from_slice(&time[..n]);
        });
        finite(sample_rate_hz, channels)
    }

    /// `J^T w`, as long as `w`, where `J` is the derivative of the filtered signal by the signal: exactly that of
    /// [`Preprocess::apply`], the continuations beyond either end included.
    ///
    /// # Errors
    /// As [`Preprocess::apply`].
    pub fn adjoint(&self, w: Signal) -> Result<Signal, EngineError> {
        let Some(lines) = self.lines_for(&w)? else { return Ok(w) };
        let (sample_rate_hz, n) = (w.sample_rate_hz(), w.n_samples());
        let mut channels = w.into_channels();
        channels.par_iter_mut().for_each(|samples| {
            let mut time = vec![0.0; lines.total];
            time[..n].copy_from_slice(samples);
            // Gains are real and the same on either side of zero: their filter is its own adjoint.
            lines.pass(&mut time);
            fold_back(&time, lines.pad, samples);
        });
        finite(sample_rate_hz, channels)
    }

    /// The filter for signals like this one; none where nothing is filtered.
    fn lines_for(&self, signal: &Signal) -> Result<Option<Lines>, EngineError> {
        self.check(signal.sample_rate_hz())?;
        if self.is_none() {
            return Ok(None);
        }
        if signal.n_samples() == 0 {
            return Err(EngineError::TooShort { what: "signal to filter", needed: 1, found: 0 });
        }
        Ok(Some(Lines::new(self, signal.n_samples(), signal.sample_rate_hz())))
    }

    /// Share of a frequency that passes, 0..=1.
    fn gain(&self, hz: f64) -> f64 {
        let below = |limit: f64| fade((limit - hz) / (SLOPE * limit));
        let above = |limit: f64| fade((hz - limit) / (SLOPE * limit));
        let low_pass = self.low_pass_hz.map_or(1.0, below);
        low_pass * self.band_pass_hz.map_or(1.0, |[low, high]| above(low) * below(high))
    }
}

/// A filter made ready for signals of one length.
struct Lines {
    /// Samples of the continuation that reflect an end.
    pad: usize,
    /// Samples of the transform.
    total: usize,
    forward: Arc<dyn RealToComplex<f64>>,
    inverse: Arc<dyn ComplexToReal<f64>>,
    /// Gain of each line, `1 / total` included.
    gains: Vec<f64>,
}

impl Lines {
    fn new(filter: &Preprocess, n: usize, sample_rate_hz: f64) -> Self {
        let edges = filter.low_pass_hz.into_iter().chain(filter.band_pass_hz.map(|band| band[0]));
        // Several periods of the slowest edge, but never more than the signal itself.
        let ring_down = (4.0 / SLOPE * sample_rate_hz / edges.fold(f64::MAX, f64::min)).ceil();
        let pad = if ring_down < n as f64 { ring_down as usize } else { n };
        let total = (n + 2 * pad).next_power_of_two();
        let mut planner = RealFftPlanner::new();
        let gains = (0..=total / 2)
            .map(|line| filter.gain(line as f64 * sample_rate_hz / total as f64) / total as f64)
            .collect();
        let (forward, inverse) = (planner.plan_fft_forward(total), planner.plan_fft_inverse(total));
        Self { pad, total, forward, inverse, gains }
    }

    /// Filters a period of a periodic signal.
    fn pass(&self, time: &mut [f64]) {
        let mut lines = self.forward.make_output_vec();
        self.forward.process(time, &mut lines).expect("buffers are the plan's own");
        for (line, gain) in lines.iter_mut().zip(&self.gains) {
            *line *= gain;
        }
        // Rounding leaves a trace in what is real by symmetry; the inverse refuses it.
        lines[0].im = 0.0;
        lines[self.total / 2].im = 0.0;
        self.inverse.process(&mut lines, time).expect("buffers are the plan's own");
    }
}

fn finite(sample_rate_hz: f64, channels: Vec<Vec<f64>>) -> Result<Signal, EngineError> {
    for (channel, samples) in channels.iter().enumerate() {
        if let Some(sample) = first_not_finite(samples) {
            return Err(EngineError::NonFiniteResult { what: "filtered signal", channel, sample });
        }
    }
    Signal::new(sample_rate_hz, channels)
}

/// Half a cosine from 0 (at `0`) to 1 (at `1`).
fn fade(at: f64) -> f64 {
    0.5 - 0.5 * (std::f64::consts::PI * at.clamp(0.0, 1.0)).cos()
}

/// The signal at the front of `out`, the rest a smooth way from its end back to its start, `pad`
/// samples of reflection at either side.
fn extend(samples: &[f64], pad: usize, out: &mut [f64]) {
    let (n, gap) = (samples.len(), out.len() - samples.len());
    let (first, last) = (samples[0], samples[n - 1]);
    out[..n].copy_from_slice(samples);
    for (k, v) in out[n..].iter_mut().enumerate() {
        let from_last = k + 1;
        let from_first = gap - k;
        let bridge = last + (first - last) * fade(from_last as f64 / (gap + 1) as f64);
        let after = if from_last < n { last - samples[n - 1 - from_last] } else { 0.0 };
        let before = if from_first < n { first - samples[from_first] } else { 0.0 };
        *v = bridge
            + after * fade(1.0 - from_last as f64 / (pad + 1) as f64)
            + before * fade(1.0 - from_first as f64 / (pad + 1) as f64);
    }
}

/// The adjoint of [`extend`]: adds to the samples what the continuation took from them.
fn fold_back(time: &[f64], pad: usize, samples: &mut [f64]) {
    let (n, gap) = (samples.len(), time.len() - samples.len());
    samples.copy_from_slice(&time[..n]);
    for (k, v) in time[n..].iter().enumerate() {
        let from_last = k + 1;
        let from_first = gap - k;
        let to_first = fade(from_last as f64 / (gap + 1) as f64);
        samples[n - 1] += (1.0 - to_first) * v;
        samples[0] += to_first * v;
        if from_last < n {
            let share = fade(1.0 - from_last as f64 / (pad + 1) as f64);
            samples[n - 1] += share * v;
            samples[n - 1 - from_last] -= share * v;
        }
        if from_first < n {
            let share = fade(1.0 - from_first as f64 / (pad + 1) as f64);
            samples[0] += share * v;
            samples[from_first] -= share * v;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sine(fs: f64, hz: f64, n: usize) -> Vec<f64> {
        (0..n).map(|t| (std::f64::consts::TAU * hz * t as f64 / fs + 0.7).sin()).collect()
    }

    fn low_pass(hz: f64) -> Preprocess {
        Preprocess { low_pass_hz: Some(hz), ..Preprocess::default() }
    }

    fn band_pass(low: f64, high: f64) -> Preprocess {
        Preprocess { band_pass_hz: Some([low, high]), ..Preprocess::default() }
    }

    fn apply(filter: Preprocess, fs: f64, x: Vec<f64>) -> Vec<f64> {
        let n = x.len();
        let y = filter.apply(&Signal::new(fs, vec![x]).unwrap()).unwrap();
        assert_eq!((y.n_channels(), y.n_samples()), (1, n));
        y.channel(0).to_vec()
    }

    fn largest(x: &[f64]) -> f64 {
        x.iter().fold(0.0, |m, v| m.max(v.abs()))
    }

    #[test]
    fn a_low_pass_keeps_what_is_below_in_phase_and_removes_what_is_above() {
        let fs = 1000.0;
        for n in [3000, 5000] {
            let (slow, fast) = (sine(fs, 30.0, n), sine(fs, 120.0, n));
            let mix = slow.iter().zip(&fast).map(|(s, f)| 5.0 + s + 0.2 * f).collect();
            let y = apply(low_pass(80.0), fs, mix);
            let error: Vec<f64> = y.iter().zip(&slow).map(|(y, s)| y - 5.0 - s).collect();
            // At the ends the removed part is cut off in mid-wave and cannot be told from a level.
            assert!(largest(&error) < 0.2, "{}", largest(&error));
            assert!(largest(&error[300..n - 300]) < 1e-3, "{}", largest(&error[300..n - 300]));
        }
    }

    #[test]
    fn what_passes_is_untouched_up_to_the_ends() {
        // Slow and smooth against the 80 Hz limit: nothing to remove.
        let x = sine(1000.0, 3.0, 2000);
        let y = apply(low_pass(80.0), 1000.0, x.clone());
        let error: Vec<f64> = y.iter().zip(&x).map(|(y, x)| y - x).collect();
        assert!(largest(&error) < 1e-3, "{}", largest(&error));
    }

    #[test]
    fn the_limit_itself_is_removed_and_95_percent_of_it_pass() {
        let filter = low_pass(80.0);
        assert_eq!(
            (filter.gain(0.0), filter.gain(76.0), filter.gain(80.0), filter.gain(400.0)),
            (1.0, 1.0, 0.0, 0.0)
        );
        assert!((filter.gain(78.0) - 0.5).abs() < 1e-12);
        let filter = band_pass(10.0, 100.0);
        assert_eq!((filter.gain(10.0), filter.gain(100.0)), (0.0, 0.0));
        assert_eq!((filter.gain(10.5), filter.gain(95.0)), (1.0, 1.0));
        let both = Preprocess { low_pass_hz: Some(50.0), ..filter };
        assert_eq!((both.gain(0.0), both.gain(30.0), both.gain(60.0)), (0.0, 1.0, 0.0));
    }

    #[test]
    fn a_band_pass_removes_mean_and_both_sides() {
        let (fs, n) = (1000.0, 8000);
        let inside = sine(fs, 40.0, n);
        let (slow, fast) = (sine(fs, 4.0, n), sine(fs, 300.0, n));
        let mix = (0..n).map(|t| 100.0 + inside[t] + slow[t] + fast[t]).collect();
        let y = apply(band_pass(12.0, 200.0), fs, mix);
        let error: Vec<f64> = y.iter().zip(&inside).map(|(y, x)| y - x).collect();
        assert!(largest(&error[1500..n - 1500]) < 5e-3, "{}", largest(&error[1500..n - 1500]));
        let constant = apply(band_pass(12.0, 200.0), fs, vec![7.0; 500]);
        assert!(largest(&constant) < 1e-12);
    }

    #[test]
    fn one_end_does_not_reach_the_other() {
        // A step's two levels: wrapped around, the end would ring at the start.
        let x: Vec<f64> = (0..4000).map(|t| if t < 3000 { 0.0 } else { 10.0 }).collect();
        let y = apply(low_pass(80.0), 1000.0, x);
        assert!(largest(&y[..1000]) < 1e-3, "{}", largest(&y[..1000]));
        assert!(y[3900..].iter().all(|v| (v - 10.0).abs() < 0.01));
    }

    #[test]
    fn every_length_has_an_answer_and_a_constant_stays() {
        for n in [1, 2, 3, 10, 127] {
            let y = apply(low_pass(80.0), 1000.0, vec![3.0; n]);
            assert!(y.iter().all(|v| (v - 3.0).abs() < 1e-12), "{n} samples: {y:?}");
        }
        // The slowest limit asks for no more memory than the signal has.
        assert_eq!(apply(low_pass(1e-300), 1000.0, vec![3.0; 10]).len(), 10);
        let none = Signal::new(1000.0, vec![vec![]]).unwrap();
        assert!(matches!(low_pass(80.0).apply(&none), Err(EngineError::TooShort { .. })));
        assert_eq!(Preprocess::default().apply(&none).unwrap(), none);
    }

    #[test]
    fn limits_are_named() {
        let nan = f64::NAN;
        for hz in [0.0, -1.0, 500.0, 1e9, nan, f64::INFINITY] {
            match low_pass(hz).check(1000.0) {
                Err(EngineError::Setting { setting, .. }) => assert_eq!(setting, "preprocess.low_pass_hz"),
                other => panic!("{hz}: {other:?}"),
            }
        }
        for (low, high) in [(0.0, 10.0), (10.0, 10.0), (20.0, 10.0), (10.0, 500.0), (nan, 10.0), (10.0, nan)]
        {
            match band_pass(low, high).check(1000.0) {
                Err(EngineError::Setting { setting, .. }) => assert_eq!(setting, "preprocess.band_pass_hz"),
                other => panic!("{low}, {high}: {other:?}"),
            }
        }
        low_pass(499.9).check(1000.0).unwrap();
        band_pass(12.0, 1250.0).check(4096.0).unwrap();
        let huge = Signal::new(1000.0, vec![vec![1e308; 100]]).unwrap();
        assert!(matches!(low_pass(80.0).apply(&huge), Err(EngineError::NonFiniteResult { channel: 0, .. })));
    }
}
