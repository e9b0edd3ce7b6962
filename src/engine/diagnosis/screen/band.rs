//! The rate at which a recording is analysed, and the limits of what its signals tell.

use std::f64::consts::TAU;

use super::input::Recording;
use crate::diagnosis::numerics::hann::Hann;
use crate::diagnosis::numerics::linear::dot;

/// Longest segment of a spectrum, samples.
const LONGEST: usize = 1 << 16;
/// Share of a drive's power inside its band.
const OF_DRIVE: f64 = 0.995;
/// Share of a response's power that stays after thinning, noise that is alike at all frequencies left aside.
const OF_RESPONSE: f64 = 0.998;
/// What is kept at most, as a multiple of the drives' upper edge. Beyond it no linear part is known, so that broad
/// drives are judged inside their band; drives of next to one frequency tell by their harmonics.
const OF_BROAD: f64 = 1.0;
const OF_NARROW: f64 = 8.0;
/// Ratio of a drive's edges from which on it is broad.
const BROAD: f64 = 4.0;
/// Samples a cycle of the highest frequency kept.
const SAMPLES_A_CYCLE: f64 = 3.2;
/// The same where laws are run that are strong: step by step they stray at fewer.
const OF_STRONG: f64 = 8.0;
/// A thinned recording keeps at least as many samples.
const FEWEST: usize = 4000;

/// Band and thinning of a recording.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Band {
    /// Below this frequency the drives have next to no power, Hz; 0 where they reach down to rest.
    pub low_hz: f64,
    /// Highest frequency that is kept, Hz.
    pub high_hz: f64,
    /// Samples of which one is kept.
    pub step: usize,
}

impl Band {
    /// Looks at the spectra of all records.
    pub fn of(recording: &Recording) -> Self {
        let rate = recording.sample_rate_hz();
        let shortest = recording.records.iter().map(|r| r.drive.n_samples()).min().unwrap_or(0);
        let total: usize = recording.records.iter().map(|r| r.drive.n_samples()).sum();
        let size = (1 << (shortest.max(16) / 2).ilog2()).min(LONGEST);
        let line = rate / size as f64;
        let (mut low, mut drive_high) = (f64::INFINITY, 0.0_f64);
        for drive in 0..recording.drives.len() {
            let power = power(recording.records.iter().map(|r| r.drive.channel(drive)), size);
            if let Some([from, to]) = edges(&power, OF_DRIVE) {
                low = low.min(from as f64 * line);
                drive_high = drive_high.max((to + 1) as f64 * line);
            }
        }
        let mut high = 0.0_f64;
        for response in 0..recording.responses.len() {
            let mut power = power(recording.records.iter().map(|r| r.response.channel(response)), size);
            let floor = floor(&power);
            power.iter_mut().for_each(|p| *p = (*p - 1.5 * floor).max(0.0));
            if let Some([_, to]) = edges(&power, OF_RESPONSE) {
                high = high.max((to + 1) as f64 * line);
            }
        }
        let most = if drive_high > BROAD * low { OF_BROAD } else { OF_NARROW };
        let high = high.min(most * drive_high).min(0.5 * rate);
        let wanted = (rate / (SAMPLES_A_CYCLE * high)).floor() as usize;
        let step = wanted.min(total / FEWEST).max(1);
        let low_hz = if low < 0.04 * drive_high { 0.0 } else { low };
        Self { low_hz, high_hz: high, step }
    }

    /// The same with more samples a cycle, for laws that are strong.
    pub fn finer(self, rate_hz: f64) -> Self {
        let step = (rate_hz / (OF_STRONG * self.high_hz)).floor() as usize;
        Self { step: step.clamp(1, self.step), ..self }
    }
}

/// What white noise adds to each line: the least that any quarter of the spectrum holds.
fn floor(power: &[f64]) -> f64 {
    let quarter = (power.len() / 4).max(1);
    power.chunks(quarter).map(median).fold(f64::INFINITY, f64::min)
}

/// Mean power of the lines of Hann segments of `size` samples, half overlapping, each about its own mean.
fn power<'a>(channels: impl Iterator<Item = &'a [f64]>, size: usize) -> Vec<f64> {
    let hann = Hann::new(size);
    let mut sum = vec![0.0; size / 2 + 1];
    for x in channels {
        for rows in hann.segments(x.len()) {
            let lines = hann.lines(&x[rows]);
            sum.iter_mut().zip(&lines).for_each(|(s, z)| *s += z.norm_sqr());
        }
    }
    sum
}

fn median(x: &[f64]) -> f64 {
    let mut sorted = x.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted[sorted.len() / 2]
}

/// First and last line between which a share of the power lies; `None` without power.
fn edges(power: &[f64], share: f64) -> Option<[usize; 2]> {
    let total: f64 = power.iter().sum();
    let outside = 0.5 * (1.0 - share) * total;
    let low = beyond(power.iter(), outside)?;
    let high = beyond(power.iter().rev(), outside)?;
    Some([low, power.len() - 1 - high])
}

/// Lines before the sum exceeds `outside`.
fn beyond<'a>(lines: impl Iterator<Item = &'a f64>, outside: f64) -> Option<usize> {
    let mut sum = 0.0;
    lines.enumerate().find_map(|(line, power)| {
        sum += power;
        (sum > outside).then_some(line)
    })
}

/// A low-pass filter (a windowed sinc of linear phase, 60 dB); beyond its ends a signal is held.
#[derive(Debug, Clone)]
pub(super) struct LowPass {
    /// The symmetric filter.
    filter: Vec<f64>,
}

impl LowPass {
    /// For a rate that is so many times lower: the stop band begins at half of that.
    pub fn new(times: f64) -> Self {
        let reach = (10.0 * times).ceil() as usize;
        let cut = 0.405 / times;
        let mut half: Vec<f64> = (0..reach)
            .map(|k| {
                let x = k as f64;
                let sinc = if k == 0 { 2.0 * cut } else { (TAU * cut * x).sin() / (0.5 * TAU * x) };
                // Blackman's window.
                let p = 0.5 * TAU * x / reach as f64;
                sinc * (0.42 + 0.5 * p.cos() + 0.08 * (2.0 * p).cos())
            })
            .collect();
        let sum: f64 = half[0] + 2.0 * half[1..].iter().sum::<f64>();
        half.iter_mut().for_each(|h| *h /= sum);
        Self { filter: half[1..].iter().rev().chain(&half).copied().collect() }
    }

    /// Some samples of a signal behind the filter.
    pub fn at(&self, x: &[f64], samples: impl Iterator<Item = usize>) -> Vec<f64> {
        let (n, reach) = (x.len(), self.filter.len() / 2);
        let held = |i: isize| x[i.clamp(0, n as isize - 1) as usize];
        samples
            .map(|at| {
                if at >= reach && at + reach < n {
                    return dot(&self.filter, &x[at - reach..=at + reach]);
                }
                let from = at as isize - reach as isize;
                self.filter.iter().zip(from..).map(|(h, i)| h * held(i)).sum()
            })
            .collect()
    }
}

/// Every `step`-th sample behind a low-pass filter.
#[derive(Debug, Clone)]
pub(super) struct Thinner {
    step: usize,
    low_pass: LowPass,
}

impl Thinner {
    pub fn new(step: usize) -> Self {
        Self { step, low_pass: LowPass::new(step as f64) }
    }

    /// `ceil(n / step)` samples, the first at the first.
    pub fn thin(&self, x: &[f64]) -> Vec<f64> {
        if self.step == 1 { x.to_vec() } else { self.low_pass.at(x, (0..x.len()).step_by(self.step)) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thinning_keeps_what_is_slow_and_removes_what_is_fast() {
        let wave = |f: f64| -> Vec<f64> { (0..4000).map(|k| (TAU * f * k as f64).sin()).collect() };
        let thinner = Thinner::new(5);
        let slow = thinner.thin(&wave(0.05));
        for (k, x) in slow.iter().enumerate().skip(20).take(700) {
            assert!((x - (TAU * 0.25 * k as f64).sin()).abs() < 2e-3, "{k}: {x}");
        }
        let fast = thinner.thin(&wave(0.17));
        let alone = |f: f64| LowPass::new(5.0).at(&wave(f), 0..4000);
        let kept = alone(0.05);
        assert!(slow.iter().zip(kept.iter().step_by(5)).all(|(thinned, kept)| thinned == kept));
        assert!(alone(0.17)[100..3900].iter().all(|x| x.abs() < 2e-3));
        assert!(fast[20..760].iter().all(|x| x.abs() < 2e-3));
        assert_eq!(Thinner::new(1).thin(&wave(0.4)), wave(0.4));
    }
}
