//! A signal at another sample rate: polyphase filtering with a Kaiser-windowed sinc.
//!
//! The pass band ends at 90 % of the lower Nyquist frequency. At the Nyquist frequency the attenuation is
//! 100 dB, so that nothing aliases. The first output sample lies at the first input sample; beyond its
//! ends the signal is held.

use std::io;
use std::ops::Range;

use rayon::prelude::*;

use super::{EngineError, Samples, Signal, first_not_finite};

/// Attenuation of the stop band, dB.
const STOP_DB: f64 = 100.0;
/// Transition band as a share of the lower Nyquist frequency; it ends there.
const TRANSITION: f64 = 0.1;
/// Largest factors by which a rate may rise and fall. They bound the size of the result, which follows from
/// rates that a client declares.
pub const MAX_GROWTH: f64 = 32.0;
const MAX_FALL: f64 = 1000.0;
/// Rates are taken as equal to a fraction within this relative error: over an hour at 1 kHz the
/// last sample is then less than a hundredth of a sample off.
const TOLERANCE: f64 = 1e-9;
/// Largest numerator or denominator of that fraction.
const MAX_TERM: u64 = 1_000_000;
/// Phases per sample of the lower rate that are tabulated. A fraction with more phases is
/// interpolated between them, linearly: the error is (pi / 4096)^2 / 8, 143 dB down.
const PHASES: f64 = 4096.0;

/// Samples of a channel, of the lower or the higher rate, that are in memory at once.
const SAMPLES_AT_ONCE: usize = 1 << 17;

/// The reason why samples were not converted.
#[derive(Debug, thiserror::Error)]
pub enum ResampleError {
    /// The rates or the samples.
    #[error(transparent)]
    Engine(#[from] EngineError),
    /// The file that holds the samples, or takes them.
    #[error(transparent)]
    Io(#[from] io::Error),
}

/// The signal at `to_hz` samples per second, `round(n * to_hz / rate)` of them and at least one.
///
/// # Errors
/// A rate more than 32 times or less than 1/1000 of the signal's, no samples, a result that is not
/// finite.
pub fn resample(x: &Signal, to_hz: f64) -> Result<Signal, EngineError> {
    let (from_hz, n) = (x.sample_rate_hz(), x.n_samples());
    let ratio = check(from_hz, to_hz, n)?;
    if Signal::same_rate(from_hz, to_hz) {
        return Signal::new(to_hz, x.channels().to_vec());
    }
    let (filter, n_out) = filter(ratio, n);
    let channels: Vec<Vec<f64>> =
        x.channels().par_iter().map(|samples| filter.apply(samples, 0, n, 0..n_out)).collect();
    for (channel, samples) in channels.iter().enumerate() {
        if let Some(sample) = first_not_finite(samples) {
            return Err(EngineError::NonFiniteResult { what: "resampled signal", channel, sample });
        }
    }
    Signal::new(to_hz, channels)
}

/// Passes on the samples of [`resample`], one channel after the other and some at a time; only those are in
/// memory.
///
/// # Errors
/// As [`resample`]; as [`Samples::read`]; those of `take`.
pub fn resample_pieces(
    x: &mut impl Samples,
    to_hz: f64,
    mut take: impl FnMut(usize, Vec<f64>) -> io::Result<()>,
) -> Result<(), ResampleError> {
    let n = x.n_samples();
    let (filter, n_out) = filter(check(x.sample_rate_hz(), to_hz, n)?, n);
    let step = (SAMPLES_AT_ONCE as u64 * filter.up.min(filter.down) / filter.down).max(1) as usize;
    let mut inside = Vec::new();
    for channel in 0..x.n_channels() {
        for from in (0..n_out).step_by(step) {
            let outputs = from..n_out.min(from + step);
            let inputs = filter.inputs(&outputs, n);
            inside.clear();
            x.read(channel, inputs.clone(), &mut inside)?;
            let piece = filter.apply(&inside, inputs.start, n, outputs);
            if let Some(at) = first_not_finite(&piece) {
                let sample = from + at;
                return Err(EngineError::NonFiniteResult { what: "resampled signal", channel, sample }.into());
            }
            take(channel, piece)?;
        }
    }
    Ok(())
}

/// The ratio of two rates that suit each other, for `n` samples.
fn check(from_hz: f64, to_hz: f64, n: usize) -> Result<f64, EngineError> {
    let ratio = to_hz / from_hz;
    if !(1.0 / MAX_FALL..=MAX_GROWTH).contains(&ratio) {
        return Err(EngineError::Setting {
            setting: "sample_rate_hz",
            found: to_hz.to_string(),
            limit: format!("from 1/{MAX_FALL} to {MAX_GROWTH} times the signal's {from_hz} Hz"),
        });
    }
    if n == 0 {
        return Err(EngineError::TooShort { what: "signal to resample", needed: 1, found: 0 });
    }
    Ok(ratio)
}

/// The filter for a ratio of rates, and the number of samples that it makes of `n`.
fn filter(ratio: f64, n: usize) -> (Polyphase, usize) {
    let (up, down) = fraction(ratio);
    let n_out = ((n as f64 * up as f64 / down as f64).round() as usize).max(1);
    (Polyphase::new(up, down), n_out)
}

/// The first convergent of a positive ratio's continued fraction within [`TOLERANCE`], or the last
/// whose terms stay below [`MAX_TERM`].
fn fraction(ratio: f64) -> (u64, u64) {
    let (mut p, mut q) = ((0_u64, 1_u64), (1_u64, 0_u64));
    let mut rest = ratio;
    loop {
        let whole = rest.floor();
        // Below 1e15 by the checks on the ratio and the terms.
        let term = whole as u64;
        let next = |(before, last): (u64, u64)| (last, term.saturating_mul(last).saturating_add(before));
        let (next_p, next_q) = (next(p), next(q));
        if q.1 > 0 && next_p.1.max(next_q.1) > MAX_TERM {
            return (p.1.max(1), q.1);
        }
        (p, q) = (next_p, next_q);
        let error = (p.1 as f64 / q.1 as f64 / ratio - 1.0).abs();
        if error <= TOLERANCE || rest == whole {
            return (p.1.max(1), q.1);
        }
        rest = 1.0 / (rest - whole);
    }
}

/// The filter's phases: output `m` lies `m * down / up` input samples after the first.
struct Polyphase {
    up: u64,
    down: u64,
    /// Taps on either side of an output.
    half: usize,
    /// Taps for outputs `phase / (phases.len() - 1)` of a sample after an input, `[phase][tap]`,
    /// each of gain 1 at DC so that a constant stays one.
    phases: Vec<Vec<f64>>,
}

impl Polyphase {
    fn new(up: u64, down: u64) -> Self {
        // Kaiser's formulas (Oppenheim and Schafer, Discrete-Time Signal Processing, section 7.6):
        // taps = (A - 8) / (2.285 * transition in rad per sample), beta = 0.1102 (A - 8.7).
        let lower = (up as f64 / down as f64).min(1.0);
        let transition = std::f64::consts::PI * TRANSITION * lower;
        let half = ((STOP_DB - 8.0) / (2.285 * transition) / 2.0).ceil() as usize;
        let beta = 0.1102 * (STOP_DB - 8.7);
        let cutoff = lower * (1.0 - TRANSITION / 2.0);
        let tap = |distance: f64| {
            let inside = 1.0 - (distance / half as f64).powi(2);
            if inside <= 0.0 { 0.0 } else { sinc(cutoff * distance) * bessel_i0(beta * inside.sqrt()) }
        };
        let steps = up.min((PHASES * lower).ceil() as u64);
        let phases = (0..=steps)
            .into_par_iter()
            .map(|phase| {
                let offset = phase as f64 / steps as f64;
                let taps: Vec<f64> =
                    (0..2 * half).map(|k| tap(k as f64 + 1.0 - half as f64 - offset)).collect();
                let gain: f64 = taps.iter().sum();
                taps.iter().map(|t| t / gain).collect()
            })
            .collect();
        Self { up, down, half, phases }
    }

    /// Input sample at or before an output.
    fn before(&self, output: usize) -> usize {
        (output as u128 * u128::from(self.down) / u128::from(self.up)) as usize
    }

    /// Input samples, of `n`, that these outputs are made of.
    fn inputs(&self, outputs: &Range<usize>, n: usize) -> Range<usize> {
        let end = self.before(outputs.end - 1) + self.half + 1;
        (self.before(outputs.start) + 1).saturating_sub(self.half)..end.min(n)
    }

    /// Outputs of a signal of `n` samples, of which `x` has those from `first` on that they are made of.
    fn apply(&self, x: &[f64], first: usize, n: usize, outputs: Range<usize>) -> Vec<f64> {
        let steps = self.phases.len() as u64 - 1;
        let at = |m: usize| {
            let position = m as u128 * u128::from(self.down);
            let before = self.before(m);
            // Below `up * steps`, at most 1e6 * 4096.
            let phase = (position % u128::from(self.up)) as u64 * steps;
            let (lower, share) = ((phase / self.up) as usize, (phase % self.up) as f64 / self.up as f64);
            let y = self.weigh(x, first, n, before, &self.phases[lower]);
            if share == 0.0 {
                return y;
            }
            y + share * (self.weigh(x, first, n, before, &self.phases[lower + 1]) - y)
        };
        outputs.into_par_iter().map(at).collect()
    }

    /// Sum over the samples `before + 1 - half ..= before + half` of `n`, held beyond the signal's ends; `x`
    /// begins with the sample `first`.
    fn weigh(&self, x: &[f64], first: usize, n: usize, before: usize, taps: &[f64]) -> f64 {
        let last = n - 1;
        match (before + 1).checked_sub(self.half) {
            Some(start) if before + self.half <= last => {
                let start = start - first;
                x[start..start + taps.len()].iter().zip(taps).map(|(x, t)| x * t).sum()
            }
            _ => {
                let held = |k: usize| x[(before + 1 + k).saturating_sub(self.half).min(last) - first];
                taps.iter().enumerate().map(|(k, t)| t * held(k)).sum()
            }
        }
    }
}

fn sinc(x: f64) -> f64 {
    let y = std::f64::consts::PI * x;
    if y == 0.0 { 1.0 } else { y.sin() / y }
}

/// Modified Bessel function of the first kind, order 0, by its power series.
fn bessel_i0(x: f64) -> f64 {
    let (mut sum, mut term) = (1.0, 1.0);
    for k in 1..100 {
        term *= (x / (2.0 * f64::from(k))).powi(2);
        sum += term;
        if term < 1e-17 * sum {
            break;
        }
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sine(fs: f64, hz: f64, n: usize) -> Vec<f64> {
        (0..n).map(|t| (std::f64::consts::TAU * hz * t as f64 / fs + 0.3).sin()).collect()
    }

    fn to(from_hz: f64, to_hz: f64, x: Vec<f64>) -> Vec<f64> {
        let x = Signal::new(from_hz, vec![x]).unwrap();
        let y = resample(&x, to_hz).unwrap();
        assert_eq!(y.sample_rate_hz(), to_hz);
        let expected = (x.n_samples() as f64 * to_hz / from_hz).round().max(1.0);
        assert_eq!(y.n_samples() as f64, expected);
        y.channel(0).to_vec()
    }

    fn largest(x: impl Iterator<Item = f64>) -> f64 {
        x.fold(0.0, |m, v| m.max(v.abs()))
    }

    const RATES: [(f64, f64); 6] = [
        (50_000.0, 4096.0),
        (1000.0, 2048.0),
        (610.351_562_5, 1000.0),
        (44_100.0, 48_000.0),
        (1000.0, 999.7),
        (1000.0, 1000.0 / std::f64::consts::PI),
    ];

    #[test]
    fn a_sine_in_the_pass_band_survives_in_phase() {
        for (from, into) in RATES {
            for share in [0.01, 0.5, 0.89] {
                let hz = share * from.min(into) / 2.0;
                let n = 20_000;
                let y = to(from, into, sine(from, hz, n));
                let expected = sine(into, hz, y.len());
                let edge = y.len() / 10;
                let inside = edge..y.len() - edge;
                let error = largest(inside.map(|t| y[t] - expected[t]));
                assert!(error < 1e-4, "{from} -> {into} Hz, {hz} Hz: {error}");
            }
        }
    }

    #[test]
    fn what_would_fold_back_is_more_than_80_db_down() {
        for (from, into) in RATES.into_iter().filter(|(from, into)| into < from) {
            for share in [1.0, 1.2, 1.9] {
                let hz = share * into / 2.0;
                if hz >= from / 2.0 {
                    continue;
                }
                let y = to(from, into, sine(from, hz, 20_000));
                let edge = y.len() / 10;
                let left = largest(y[edge..y.len() - edge].iter().copied());
                assert!(left < 1e-4, "{from} -> {into} Hz: {left} of {hz} Hz is left");
            }
        }
    }

    #[test]
    fn going_up_adds_no_image() {
        // 100 Hz at 1 kHz has its first image at 900 Hz; at 4 kHz only 100 Hz may be there.
        let y = to(1000.0, 4000.0, sine(1000.0, 100.0, 4000));
        let expected = sine(4000.0, 100.0, y.len());
        let error = largest((2000..14_000).map(|t| y[t] - expected[t]));
        assert!(error < 1e-4, "{error}");
    }

    #[test]
    fn a_constant_stays_one_at_every_length_and_rate() {
        for (from, into) in RATES {
            for n in [1, 2, 17, 300] {
                let y = to(from, into, vec![-2.5; n]);
                assert!(y.iter().all(|v| (v + 2.5).abs() < 1e-12), "{n} samples, {from} -> {into} Hz");
            }
        }
    }

    #[test]
    fn every_channel_keeps_its_place_and_equal_rates_change_nothing() {
        let x = Signal::new(1000.0, vec![vec![1.0; 100], vec![2.0; 100]]).unwrap();
        let y = resample(&x, 500.0).unwrap();
        assert_eq!((y.n_channels(), y.n_samples()), (2, 50));
        assert!((y.channel(1)[20] - 2.0).abs() < 1e-12);
        let wavy = Signal::new(1000.0, vec![sine(1000.0, 400.0, 50)]).unwrap();
        let same = resample(&wavy, 1000.0001).unwrap();
        assert_eq!((same.channels(), same.sample_rate_hz()), (wavy.channels(), 1000.0001));
    }

    #[test]
    fn pieces_are_the_whole_bit_for_bit() {
        let n = 300_000;
        for (from, into) in [(50_000.0, 4096.0), (1000.0, 2048.0), (1000.0, 1.5), (1000.0, 999.7)] {
            let channels = vec![sine(from, 0.1 * from.min(into), n), sine(from, 0.3 * from.min(into), n)];
            let mut x = Signal::new(from, channels).unwrap();
            let whole = resample(&x, into).unwrap();
            let (mut pieces, mut most) = (vec![Vec::new(); 2], 0);
            resample_pieces(&mut x, into, |channel, piece| {
                most = most.max(piece.len());
                pieces[channel].extend(piece);
                Ok(())
            })
            .unwrap();
            assert!(pieces == whole.channels(), "{from} -> {into} Hz");
            assert!(most < n && most <= SAMPLES_AT_ONCE, "{most}");
        }
        let mut huge = Signal::new(1000.0, vec![vec![0.0; n], vec![f64::MAX; n]]).unwrap();
        let refused = resample(&huge, 500.0).unwrap_err();
        let Err(ResampleError::Engine(found)) = resample_pieces(&mut huge, 500.0, |_, _| Ok(())) else {
            panic!("not finite")
        };
        assert_eq!(found, refused);
    }

    #[test]
    fn rates_become_small_fractions() {
        assert_eq!(fraction(4096.0 / 50_000.0), (256, 3125));
        assert_eq!(fraction(1000.0 / 610.351_562_5), (1024, 625));
        assert_eq!(fraction(48_000.0 / 44_100.0), (160, 147));
        assert_eq!(fraction(2.0), (2, 1));
        assert_eq!(fraction(0.001), (1, 1000));
        for ratio in [std::f64::consts::PI, 1.0 / std::f64::consts::E, 0.999_999, 999.999_999_9] {
            let (p, q) = fraction(ratio);
            assert!(p <= MAX_TERM && q <= MAX_TERM);
            assert!((p as f64 / q as f64 / ratio - 1.0).abs() < 1e-9, "{p}/{q}");
        }
    }

    #[test]
    fn senseless_rates_and_empty_signals_are_refused() {
        let x = Signal::new(1000.0, vec![vec![1.0; 10]]).unwrap();
        for rate in [0.0, -1.0, f64::NAN, f64::INFINITY, 0.9, 32_001.0] {
            assert!(matches!(resample(&x, rate), Err(EngineError::Setting { .. })), "{rate}");
        }
        let none = Signal::new(1000.0, vec![vec![]]).unwrap();
        assert!(matches!(resample(&none, 500.0), Err(EngineError::TooShort { .. })));
        let huge = Signal::new(1000.0, vec![vec![f64::MAX; 100]]).unwrap();
        assert!(matches!(resample(&huge, 500.0), Err(EngineError::NonFiniteResult { .. })));
    }
}
