//! Transforms of real signals.

use std::sync::Arc;

pub use realfft::{ComplexToReal, RealToComplex};

/// Plans of transforms of real `f64` signals; one length is planned once.
#[derive(Default)]
pub struct RealFftPlanner(realfft::RealFftPlanner<f64>);

impl RealFftPlanner {
    /// A planner without plans.
    pub fn new() -> Self {
        Self(realfft::RealFftPlanner::new())
    }

    /// The transform of `len` real samples into `len / 2 + 1` lines, not scaled.
    pub fn plan_fft_forward(&mut self, len: usize) -> Arc<dyn RealToComplex<f64>> {
        self.0.plan_fft_forward(len)
    }

    /// The transform of `len / 2 + 1` lines into `len` real samples, not scaled.
    pub fn plan_fft_inverse(&mut self, len: usize) -> Arc<dyn ComplexToReal<f64>> {
        self.0.plan_fft_inverse(len)
    }
}
