//! What signals did to an argument before now, sample by sample, while they are made.
//!
//! An impulse response of thousands of taps, read whole at every sample, is most of a free run's time. Here only what
//! happened in the present block is read tap by tap; what all blocks before it do in the present one is had at once, by
//! the products of their spectra with those of the taps, block by block (uniformly partitioned overlap-save, Kulp 1988).

use std::collections::VecDeque;

use realfft::num_complex::Complex64;

use super::correlate::{plans, spectrum};
use crate::diagnosis::numerics::linear::dot;

/// Samples of a block.
const BLOCK: usize = 128;

/// The past of an argument.
pub(super) struct Past {
    signals: Vec<OfSignal>,
    /// What the blocks before do in the present one.
    before: Vec<f64>,
    /// First sample of the present block.
    from: usize,
}

/// One signal's share of it.
struct OfSignal {
    /// Taps of lag 1 on that reach into a block, the oldest first.
    near: Vec<f64>,
    /// Spectra of a block of taps each, from lag 0 on, which is none.
    taps: Vec<Vec<Complex64>>,
    /// Spectra of two blocks of the signal that follow on each other, the last ones first.
    seen: VecDeque<Vec<Complex64>>,
}

impl Past {
    /// `taps[signal]` from lag 1 on.
    pub fn new(taps: impl Iterator<Item = Vec<f64>>) -> Self {
        Self { signals: taps.map(|taps| OfSignal::new(&taps)).collect(), before: vec![0.0; BLOCK], from: 0 }
    }

    /// What the signals up to sample `t` do there; `t` goes up by one from call to call.
    pub fn at(&mut self, t: usize, signals: &[Vec<f64>]) -> f64 {
        if t == self.from + BLOCK {
            self.turn(signals);
        }
        let now = |(of, signal): (&OfSignal, &Vec<f64>)| {
            let n = of.near.len().min(t - self.from);
            dot(&of.near[of.near.len() - n..], &signal[t - n..t])
        };
        self.before[t - self.from] + self.signals.iter().zip(signals).map(now).sum::<f64>()
    }

    /// Goes on to the next block.
    fn turn(&mut self, signals: &[Vec<f64>]) {
        let (forward, inverse) = plans(2 * BLOCK);
        let mut sum = vec![Complex64::default(); BLOCK + 1];
        for (of, signal) in self.signals.iter_mut().zip(signals).filter(|(of, _)| !of.taps.is_empty()) {
            // The block that has ended with the one to come, of which nothing is known yet.
            let ended = spectrum(&signal[self.from..self.from + BLOCK], 2 * BLOCK, &*forward);
            add(&mut sum, &ended, &of.taps[0]);
            // And with the one before it.
            let two: Vec<f64> = match self.from.checked_sub(BLOCK) {
                Some(start) => signal[start..self.from + BLOCK].to_vec(),
                None => vec![0.0; BLOCK].into_iter().chain(signal[..BLOCK].iter().copied()).collect(),
            };
            of.seen.push_front(spectrum(&two, 2 * BLOCK, &*forward));
            of.seen.truncate(of.taps.len() - 1);
            of.taps[1..].iter().zip(&of.seen).for_each(|(taps, seen)| add(&mut sum, seen, taps));
        }
        (sum[0].im, sum[BLOCK].im) = (0.0, 0.0);
        let mut out = inverse.make_output_vec();
        inverse.process(&mut sum, &mut out).expect("buffers are the plan's own");
        self.before.iter_mut().zip(&out[BLOCK..]).for_each(|(y, x)| *y = x / (2 * BLOCK) as f64);
        self.from += BLOCK;
    }
}

impl OfSignal {
    fn new(taps: &[f64]) -> Self {
        let (forward, _) = plans(2 * BLOCK);
        let from_lag_0: Vec<f64> = std::iter::once(0.0).chain(taps.iter().copied()).collect();
        let blocks = if taps.is_empty() { &[] } else { from_lag_0.as_slice() }.chunks(BLOCK);
        Self {
            near: taps.iter().take(BLOCK - 1).rev().copied().collect(),
            taps: blocks.map(|block| spectrum(block, 2 * BLOCK, &*forward)).collect(),
            seen: VecDeque::new(),
        }
    }
}

fn add(sum: &mut [Complex64], x: &[Complex64], h: &[Complex64]) {
    sum.iter_mut().zip(x).zip(h).for_each(|((sum, x), h)| *sum += x * h);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_past_by_blocks_is_that_of_all_taps() {
        let noise = |k: usize, seed: usize| ((k * 7919 + seed * 104_729) % 1009) as f64 / 504.0 - 1.0;
        let n = 5 * BLOCK + 17;
        let signals: Vec<Vec<f64>> = (0..4).map(|i| (0..n).map(|k| noise(k, i)).collect()).collect();
        // None, a few, a block, and more than all samples.
        let lengths = [0, 3, BLOCK, n + 40];
        let taps: Vec<Vec<f64>> = lengths
            .iter()
            .enumerate()
            .map(|(i, length)| (0..*length).map(|k| noise(k, 10 + i) * 0.99_f64.powi(k as i32)).collect())
            .collect();
        let mut past = Past::new(taps.iter().cloned());
        for t in 0..n {
            let lags = |(taps, signal): (&Vec<f64>, &Vec<f64>)| -> f64 {
                taps.iter().take(t).enumerate().map(|(k, h)| h * signal[t - 1 - k]).sum()
            };
            let expected: f64 = taps.iter().zip(&signals).map(lags).sum();
            let found = past.at(t, &signals);
            assert!((found - expected).abs() < 1e-11 * (1.0 + expected.abs()), "{t}: {found} {expected}");
        }
    }
}
