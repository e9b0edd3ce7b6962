//! Spectral lines of signals under Hann's window.

use std::f64::consts::TAU;
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
    fn a_sine_between_two_lines_leaves_the_others_alone_and_a_mean_leaves_all() {
        let n = 512;
        let x: Vec<f64> = (0..n).map(|k| 7.0 + (TAU * 20.5 * k as f64 / n as f64).sin()).collect();
        let lines = Hann::new(n).lines(&x);
        assert_eq!(lines.len(), n / 2 + 1);
        let power = |line: usize| lines[line].norm_sqr();
        assert!((power(20) / power(21) - 1.0).abs() < 0.1, "{} {}", power(20), power(21));
        let far = (0..lines.len()).filter(|line| line.abs_diff(20) > 8).map(power).fold(0.0, f64::max);
        assert!(far < 1e-5 * power(20), "{far}");
    }
}
