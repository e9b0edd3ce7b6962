//! The error of a network on validation data while it is trained: fast, not recombined.

use rayon::prelude::*;

use super::forward::{Packed, State};
use super::predict::run_windows;
use super::settings::LstmSettings;
use super::train::Segment;
use crate::EngineError;
use crate::simd::Isa;
use crate::simd::LANES;

/// Windows that score each sample of the validation data once, after a burn-in of context.
pub(super) struct Scored<'a> {
    segments: &'a [Segment],
    windows: Vec<Window>,
    len: usize,
    /// Samples that are scored, over all segments.
    samples: usize,
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct Window {
    segment: usize,
    /// First sample; before the segment begins, its first value is held.
    start: isize,
    /// First scored time in the window, and one past the last.
    scored: (usize, usize),
}

impl<'a> Scored<'a> {
    /// Lays windows over the scored parts of `segments`.
    ///
    /// A segment that is scored from its start has no context. Its first burn-in is then left out of the
    /// score, if that leaves at least half of the segment.
    ///
    /// # Errors
    /// [`EngineError::TooShort`] when no sample is scored.
    pub(super) fn new(segments: &'a [Segment], settings: &LstmSettings) -> Result<Self, EngineError> {
        let (len, burn_in) = (settings.window_len, settings.burn_in_samples());
        let mut windows = Vec::new();
        let mut samples = 0;
        for (index, segment) in segments.iter().enumerate() {
            let n = segment.x[0].len();
            let from = if n >= 2 * burn_in { segment.score_from.max(burn_in) } else { segment.score_from };
            samples += n.saturating_sub(from);
            for first in (from..n).step_by(len - burn_in) {
                windows.push(Window {
                    segment: index,
                    start: first as isize - burn_in as isize,
                    scored: (burn_in, len.min(burn_in + n - first)),
                });
            }
        }
        if samples == 0 {
            return Err(EngineError::TooShort { what: "validation data", needed: 1, found: 0 });
        }
        Ok(Self { segments, windows, len, samples })
    }

    /// Mean squared error over the scored samples and all outputs, standardised.
    pub(super) fn mse<const R: usize>(&self, isa: Isa, weights: &Packed<R>) -> f64 {
        let outputs = weights.shape.outputs;
        let sums: Vec<f64> = self
            .windows
            .par_chunks(LANES)
            .map_init(
                || State::<1>::new(&weights.shape),
                |state, windows| {
                    let mut sum = 0.0;
                    run_windows::<R, 1>(
                        isa,
                        weights,
                        state,
                        self.len,
                        windows.len(),
                        |lane| (&self.segments[windows[lane].segment].x[..], windows[lane].start),
                        |steps, y| {
                            for (lane, window) in windows.iter().enumerate() {
                                let (from, to) = window.scored;
                                let wanted = &self.segments[window.segment].y;
                                for t in steps.start.max(from)..steps.end.min(to) {
                                    let at = (window.start + t as isize) as usize;
                                    let y = &y[(t - steps.start) * outputs..][..outputs];
                                    for (y, wanted) in y.iter().zip(wanted) {
                                        let e = f64::from(y[0].0[lane]) - f64::from(wanted[at]);
                                        sum += e * e;
                                    }
                                }
                            }
                        },
                    );
                    sum
                },
            )
            .collect();
        sums.iter().sum::<f64>() / (self.samples * outputs) as f64
    }
}
