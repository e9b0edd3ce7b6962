//! Spectral lines of signals under Hann's window.

use std::f64::consts::TAU;
use std::ops::Range;
use std::sync::Arc;

use realfft::num_complex::Complex64;
use rigcast_numerics::fft::{RealFftPlanner, RealToComplex};

/// Hann's window over signals of one length, and their transform.
pub struct Hann {
    window: Vec<f64>,
    fft: Arc<dyn RealToComplex<f64>>,
}

impl Hann {
    /// For signals of `n` samples.
    pub fn new(n: usize) -> Self {
        let at = |k: usize| 0.5 - 0.5 * (TAU * (k as f64 + 0.5) / n as f64).cos();
        Self { window: (0..n).map(at).collect(), fft: RealFftPlanner::new().plan_fft_forward(n) }
    }

    /// Where the window lies in a signal of so many samples, each place half over the one before it.
    pub fn segments(&self, samples: usize) -> impl Iterator<Item = Range<usize>> + use<> {
        let n = self.window.len();
        (0..).step_by(n / 2).map(move |start| start..start + n).take_while(move |rows| rows.end <= samples)
    }

    /// Lines of `n` samples about their mean, from 0 to half of the sample rate, not scaled.
    ///
    /// # Panics
    /// With another number of samples.
    pub fn lines(&self, x: &[f64]) -> Vec<Complex64> {
        let mean = x.iter().sum::<f64>() / x.len() as f64;
        let mut samples: Vec<f64> = x.iter().zip(&self.window).map(|(x, w)| (x - mean) * w).collect();
        let mut lines = self.fft.make_output_vec();
        self.fft.process(&mut samples, &mut lines).expect("a signal of the window's length");
        lines
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn windows_lie_half_over_each_other_and_inside_the_signal() {
        let all: Vec<Range<usize>> = Hann::new(8).segments(17).collect();
        assert_eq!(all, [0..8, 4..12, 8..16]);
        assert_eq!(Hann::new(8).segments(7).count(), 0);
    }

    #[test]
    fn a_sine_on_a_line_is_in_three_lines_and_a_mean_in_none() {
        let n = 512;
        let x: Vec<f64> = (0..n).map(|k| 7.0 + (TAU * 20.0 * k as f64 / n as f64).sin()).collect();
        let lines = Hann::new(n).lines(&x);
        assert_eq!(lines.len(), n / 2 + 1);
        // Half of the window's mean, and a quarter of it beside.
        assert!((lines[20].norm() - 0.25 * n as f64).abs() < 1e-9, "{}", lines[20]);
        assert!([19, 21].iter().all(|&k| (lines[k].norm() - 0.125 * n as f64).abs() < 1e-9));
        let others = (0..lines.len()).filter(|line| line.abs_diff(20) > 1);
        assert!(others.map(|line| lines[line].norm()).all(|left| left < 1e-9));
    }
}
