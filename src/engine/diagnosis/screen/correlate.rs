//! Products of a column with all lags of all drives, block by block through the Fourier transform.

use std::cell::RefCell;
use std::sync::{Arc, OnceLock};

use faer::Mat;
use realfft::num_complex::Complex64;
use rigcast_numerics::fft::{ComplexToReal, RealFftPlanner, RealToComplex};

use super::moments::{Lags, padded};
use super::track::{Segment, Track};

thread_local! {
    /// Plans of all sizes: filters of one size are made by the thousand, and a plan costs as much as a filter's use.
    static PLANS: RefCell<RealFftPlanner> = RefCell::new(RealFftPlanner::new());
}

type Plans = (Arc<dyn RealToComplex<f64>>, Arc<dyn ComplexToReal<f64>>);

pub(super) fn plans(size: usize) -> Plans {
    PLANS.with_borrow_mut(|plans| (plans.plan_fft_forward(size), plans.plan_fft_inverse(size)))
}

/// Spectra of the drives' blocks, made once.
pub(super) struct Correlator {
    lags: Lags,
    size: usize,
    /// `[segment][drive][block]`.
    blocks: Vec<Vec<Vec<Vec<Complex64>>>>,
    forward: Arc<dyn RealToComplex<f64>>,
    inverse: Arc<dyn ComplexToReal<f64>>,
}

impl Correlator {
    pub fn new(drives: &[Track], segments: &[Segment], lags: Lags) -> Self {
        let size = (4 * lags.span).next_power_of_two().max(512);
        let (forward, inverse) = plans(size);
        let step = size + 1 - lags.span;
        let blocks = segments
            .iter()
            .map(|segment| {
                let of = |drive: &Track| {
                    let samples = padded(&drive[segment.record], segment, lags);
                    let starts = (0..segment.rows.len()).step_by(step);
                    starts.map(|at| spectrum(&samples[at..], size, &*forward)).collect()
                };
                drives.iter().map(of).collect()
            })
            .collect();
        Self { lags, size, blocks, forward, inverse }
    }

    /// Adds the products of a column of a segment, centred and weighted, with all lags of all drives to a
    /// column of `to`.
    pub fn add(&self, column: &[f64], at: usize, weight: f64, to: &mut Mat<f64>, c: usize) {
        let span = self.lags.span;
        let step = self.size + 1 - span;
        let drives = &self.blocks[at];
        let mut sums = vec![vec![Complex64::default(); self.size / 2 + 1]; drives.len()];
        for (block, rows) in column.chunks(step).enumerate() {
            let of_rows = spectrum(rows, self.size, &*self.forward);
            for (sum, blocks) in sums.iter_mut().zip(drives) {
                for ((s, x), u) in sum.iter_mut().zip(&of_rows).zip(&blocks[block]) {
                    *s += x.conj() * u;
                }
            }
        }
        let mut out = self.inverse.make_output_vec();
        for (drive, sum) in sums.iter_mut().enumerate() {
            let last = sum.len() - 1;
            sum[0].im = 0.0;
            sum[last].im = 0.0;
            self.inverse.process(sum, &mut out).expect("buffers are the plan's own");
            for k in 0..span {
                to[(drive * span + k, c)] += weight * out[span - 1 - k] / self.size as f64;
            }
        }
    }
}

/// Spectrum of the first samples, at most `size`, followed by zeros.
pub(super) fn spectrum(x: &[f64], size: usize, forward: &dyn RealToComplex<f64>) -> Vec<Complex64> {
    let mut samples = x[..x.len().min(size)].to_vec();
    samples.resize(size, 0.0);
    let mut lines = forward.make_output_vec();
    forward.process(&mut samples, &mut lines).expect("buffers are the plan's own");
    lines
}

/// A filter of finite impulse response, which goes over signals block by block (overlap and add).
pub(super) struct Filter {
    impulse: Vec<f64>,
    size: usize,
    /// Spectrum of the impulse response, made when it is first asked for.
    lines: OnceLock<Vec<Complex64>>,
}

/// A block is so many times as long as the impulse response, and has so many samples at least: transforms of that size
/// stay in the caches.
const TIMES_AS_LONG: usize = 4;
const SMALLEST: usize = 2048;

impl Filter {
    /// `impulse[k]` is the response at lag `k`; signals have at most `n` samples.
    pub fn new(impulse: Vec<f64>, n: usize) -> Self {
        let whole = (n + impulse.len()).next_power_of_two();
        let block = (TIMES_AS_LONG * impulse.len()).next_power_of_two().max(SMALLEST);
        Self { impulse, size: whole.min(block), lines: OnceLock::new() }
    }

    /// The filtered deviations from the first sample, so that nothing starts with a jump.
    pub fn apply(&self, x: &[f64]) -> Vec<f64> {
        let (forward, inverse) = plans(self.size);
        let lines = self.lines.get_or_init(|| spectrum(&self.impulse, self.size, &*forward));
        let held = x.first().copied().unwrap_or(0.0);
        let mut out = vec![0.0; x.len()];
        let mut block = inverse.make_output_vec();
        let mut of_block = forward.make_output_vec();
        let step = self.size + 1 - self.impulse.len().max(1);
        for at in (0..x.len()).step_by(step) {
            let samples = &x[at..x.len().min(at + step)];
            block.fill(0.0);
            block.iter_mut().zip(samples).for_each(|(b, x)| *b = x - held);
            forward.process(&mut block, &mut of_block).expect("buffers are the plan's own");
            of_block.iter_mut().zip(lines).for_each(|(z, h)| *z *= h);
            let last = of_block.len() - 1;
            of_block[0].im = 0.0;
            of_block[last].im = 0.0;
            inverse.process(&mut of_block, &mut block).expect("buffers are the plan's own");
            out[at..].iter_mut().zip(&block).for_each(|(y, b)| *y += b / self.size as f64);
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::super::track::delayed;
    use super::*;
    use crate::diagnosis::numerics::linear::dot;

    #[test]
    fn products_by_blocks_are_those_of_lags_written_out() {
        let track: Track = vec![(0..3000).map(|k| (0.3 * f64::from(k)).sin() + f64::from(k % 7)).collect()];
        let segment = Segment { record: 0, rows: 20..2900, group: 0, part: 0, unit: 0, weight: 2.0 };
        let lags = Lags { lead: 3, span: 40 };
        let correlator = Correlator::new(std::slice::from_ref(&track), std::slice::from_ref(&segment), lags);
        let other: Vec<f64> = (0..3000).map(|k| (0.05 * f64::from(k)).cos()).collect();
        let column = delayed(&other, &segment, 0);
        let mut found = Mat::zeros(40, 1);
        correlator.add(&column, 0, segment.weight, &mut found, 0);
        for k in 0..40 {
            let expected = dot(&column, &delayed(&track[0], &segment, k as isize - 3));
            assert!((found[(k, 0)] - expected).abs() < 1e-7, "{k}: {} for {expected}", found[(k, 0)]);
        }
    }

    #[test]
    fn a_filter_convolves_whatever_the_blocks() {
        let noise = |k: usize| ((k * 7919) % 1009) as f64 / 504.0 - 1.0;
        for (taps, n) in [(3, 6), (1, 5000), (700, 9000), (4000, 3000)] {
            let impulse: Vec<f64> = (0..taps).map(|k| noise(k + 17)).collect();
            let x: Vec<f64> = (0..n).map(|k| 2.0 + noise(k)).collect();
            let y = Filter::new(impulse.clone(), n).apply(&x);
            for t in (0..n).step_by(97).chain([n - 1]) {
                let lags = 0..taps.min(t + 1);
                let expected: f64 = lags.map(|k| impulse[k] * (x[t - k] - x[0])).sum();
                assert!((y[t] - expected).abs() < 1e-10 * taps as f64, "{taps} {t}: {} {expected}", y[t]);
            }
        }
    }
}
