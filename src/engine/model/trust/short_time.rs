//! Spectra of all inputs over half-overlapping windows of one length.

use std::ops::Range;
use std::sync::Arc;

use rayon::prelude::*;
use realfft::num_complex::Complex64;
use rigcast_numerics::fft::{RealFftPlanner, RealToComplex};

use crate::spectral::hann;

/// Windows that are looked at together at most: an FRF of many channels is then read once for all of them.
const AT_ONCE: usize = 16;

/// Hann windows of one length and their transform.
#[derive(Clone)]
pub(super) struct ShortTime {
    window: Vec<f64>,
    fft: Arc<dyn RealToComplex<f64>>,
    /// Mean square of a signal over the sum of its one-sided lines' squares.
    scale: f64,
}

/// All inputs over one window.
pub(super) struct WindowOfInputs<'a> {
    /// Lines of each input about its mean, windowed.
    pub lines: &'a [Vec<Complex64>],
    /// Mean of each input.
    pub means: &'a [f64],
    scale: f64,
}

impl WindowOfInputs<'_> {
    /// Mean square of lines whose squares have this sum.
    pub fn mean_square(&self, squares: f64) -> f64 {
        self.scale * squares
    }
}

impl ShortTime {
    /// With windows of so many samples, at least two.
    pub fn new(len: usize) -> Self {
        let window = hann(len);
        let scale = 2.0 / (len as f64 * window.iter().map(|w| w * w).sum::<f64>());
        Self { window, fft: RealFftPlanner::new().plan_fft_forward(len), scale }
    }

    /// Windows that fit into so many samples, at least two, where these do not.
    pub fn shortened(&self, n: usize) -> Option<Self> {
        (n < self.len()).then(|| Self::new(1 << n.ilog2()))
    }

    /// Samples of a window.
    pub fn len(&self) -> usize {
        self.window.len()
    }

    /// Lines of a window, those at zero and at half the sample rate included.
    pub fn n_lines(&self) -> usize {
        self.len() / 2 + 1
    }

    /// What `of` finds in each window of the inputs, equally long, with the samples that the window speaks for: its
    /// middle half, and at either end all. None where the inputs are shorter than a window.
    #[cfg(test)]
    pub fn each<T: Send>(
        &self,
        inputs: &[&[f64]],
        of: impl Fn(&WindowOfInputs<'_>) -> T + Sync,
    ) -> Vec<(Range<usize>, T)> {
        self.each_batch(inputs, |windows| windows.iter().map(&of).collect())
    }

    /// The same where `of` looks at neighbouring windows together, and finds one thing in each. How many there are
    /// depends on the number of threads.
    pub fn each_batch<T: Send>(
        &self,
        inputs: &[&[f64]],
        of: impl Fn(&[WindowOfInputs<'_>]) -> Vec<T> + Sync,
    ) -> Vec<(Range<usize>, T)> {
        let (n, len) = (inputs.first().map_or(0, |input| input.len()), self.len());
        if n < len {
            return Vec::new();
        }
        let starts: Vec<usize> = (0..n - len).step_by(len / 2).chain([n - len]).collect();
        let at_once = AT_ONCE.min(starts.len().div_ceil(rayon::current_num_threads())).max(1);
        let scratch = || {
            let lines = vec![vec![self.fft.make_output_vec(); inputs.len()]; at_once];
            let means = vec![vec![0.0; inputs.len()]; at_once];
            (self.fft.make_input_vec(), lines, means, self.fft.make_scratch_vec())
        };
        let ends: Vec<usize> = starts[1..].iter().map(|next| next + len / 4).chain([n]).collect();
        let found: Vec<Vec<(Range<usize>, T)>> = starts
            .par_chunks(at_once)
            .zip(ends.par_chunks(at_once))
            .map_init(scratch, |(time, lines, means, scratch), (starts, ends)| {
                for ((&start, lines), means) in starts.iter().zip(&mut *lines).zip(&mut *means) {
                    for ((input, lines), mean) in inputs.iter().zip(lines).zip(means) {
                        let segment = &input[start..start + len];
                        *mean = segment.iter().sum::<f64>() / len as f64;
                        for ((t, v), w) in time.iter_mut().zip(segment).zip(&self.window) {
                            *t = (v - *mean) * w;
                        }
                        self.fft
                            .process_with_scratch(time, lines, scratch)
                            .expect("buffers are the plan's own");
                    }
                }
                let window = |(lines, means)| WindowOfInputs { lines, means, scale: self.scale };
                let windows: Vec<WindowOfInputs<'_>> = lines
                    .iter()
                    .map(Vec::as_slice)
                    .zip(means.iter().map(Vec::as_slice))
                    .map(window)
                    .collect();
                let from = |start: usize| if start == 0 { 0 } else { start + len / 4 };
                let spans = starts.iter().zip(ends).map(|(start, end)| from(*start)..*end);
                spans.zip(of(&windows[..starts.len()])).collect()
            })
            .collect();
        found.into_iter().flatten().collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn windows_share_all_samples_and_measure_mean_and_power() {
        let tone = |t: usize| 3.0 + 2.0 * (std::f64::consts::TAU * t as f64 / 16.0).sin();
        for n in [256, 257, 1000] {
            let x: Vec<f64> = (0..n).map(tone).collect();
            let found = ShortTime::new(256).each(&[&x], |window| {
                let squares = window.lines[0][1..].iter().map(Complex64::norm_sqr).sum();
                (window.means[0], window.mean_square(squares))
            });
            assert_eq!((found[0].0.start, found.last().unwrap().0.end), (0, n));
            assert!(found.windows(2).all(|pair| pair[0].0.end == pair[1].0.start), "{n}");
            for (_, (mean, square)) in found {
                assert!((mean - 3.0).abs() < 0.02 && (square - 2.0).abs() < 0.02, "{mean} {square}");
            }
        }
        assert!(ShortTime::new(256).each(&[&[0.0; 255]], |_| ()).is_empty());
    }
}
