//! An FRF as a filter for signals of any length: overlap-save, no wrap-around.

use std::sync::Arc;

use rayon::prelude::*;
use realfft::num_complex::Complex64;
use rigcast_numerics::fft::{ComplexToReal, RealFftPlanner, RealToComplex};

use super::Frf;
use crate::simd::{Isa, Kernel, Simd, dispatch};
use crate::{EngineError, Signal, first_not_finite};

/// An FRF prepared for repeated use.
///
/// The impulse response has `segment_len` taps from `-segment_len / 2` to `segment_len / 2 - 1`
/// samples: it may look ahead, since FRFs between sensors need not be causal. Before its start a
/// signal is held at its first value, after its end at its last.
#[derive(Clone)]
pub struct FrfFilter {
    isa: Isa,
    sample_rate_hz: f64,
    x_mean: Vec<f64>,
    y_mean: Vec<f64>,
    taps: usize,
    /// Samples per transform.
    block: usize,
    /// Spectra of the impulse responses, `1 / block` included, `[output, input, bin]`.
    spectra: Vec<Complex64>,
    forward: Arc<dyn RealToComplex<f64>>,
    inverse: Arc<dyn ComplexToReal<f64>>,
}

impl std::fmt::Debug for FrfFilter {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("FrfFilter")
            .field("inputs", &self.x_mean.len())
            .field("outputs", &self.y_mean.len())
            .field("taps", &self.taps)
            .field("block", &self.block)
            .finish_non_exhaustive()
    }
}

impl Frf {
    /// Response to `x`, `[output, sample]`, as long as `x`; see [`FrfFilter::apply`]. Whoever
    /// applies one FRF often keeps its [`Frf::filter`].
    ///
    /// # Errors
    /// Those of [`Frf::filter`] and [`FrfFilter::apply`].
    pub fn apply(&self, x: &Signal) -> Result<Signal, EngineError> {
        self.filter()?.apply(x)
    }

    /// Transforms the impulse responses once.
    ///
    /// # Errors
    /// An FRF whose fields do not belong together ([`Frf::check`]); see [`Isa::of_process`].
    pub fn filter(&self) -> Result<FrfFilter, EngineError> {
        self.check()?;
        let taps = self.segment_len;
        // Four times the taps: a block's useful part is then three quarters of its transforms.
        let block = (4 * taps).next_power_of_two();
        let mut planner = RealFftPlanner::new();
        let to_taps = planner.plan_fft_inverse(taps);
        let (forward, inverse) = (planner.plan_fft_forward(block), planner.plan_fft_inverse(block));
        let scale = 1.0 / (taps as f64 * block as f64);
        let pairs: Vec<(usize, usize)> =
            (0..self.n_outputs).flat_map(|o| (0..self.n_inputs).map(move |i| (o, i))).collect();
        let spectra = pairs
            .par_iter()
            .flat_map_iter(|&(o, i)| {
                let mut lines: Vec<Complex64> =
                    (0..self.n_lines()).map(|line| self.at(line, o, i) * scale).collect();
                // A real impulse response has real lines at DC and Nyquist.
                lines[0].im = 0.0;
                lines[taps / 2].im = 0.0;
                let mut circular = to_taps.make_output_vec();
                to_taps.process(&mut lines, &mut circular).expect("buffers are the plan's own");
                let mut response = forward.make_input_vec();
                response[..taps / 2].copy_from_slice(&circular[taps / 2..]);
                response[taps / 2..taps].copy_from_slice(&circular[..taps / 2]);
                let mut spectrum = forward.make_output_vec();
                forward.process(&mut response, &mut spectrum).expect("buffers are the plan's own");
                spectrum
            })
            .collect();
        Ok(FrfFilter {
            isa: Isa::of_process()?,
            sample_rate_hz: self.sample_rate_hz,
            x_mean: self.x_mean.clone(),
            y_mean: self.y_mean.clone(),
            taps,
            block,
            spectra,
            forward,
            inverse,
        })
    }
}

/// Buffers of one thread.
struct Scratch {
    real: Vec<f64>,
    x: Vec<Complex64>,
    y: Vec<Complex64>,
    forward: Vec<Complex64>,
    inverse: Vec<Complex64>,
}

impl FrfFilter {
    /// Taps of the impulse response: an output depends on half of them before and after it.
    pub fn taps(&self) -> usize {
        self.taps
    }

    /// `y = y_mean + h * (x - x_mean)`, `[output, sample]`, as long as `x` (at least one sample).
    ///
    /// # Errors
    /// Another channel count or sample rate, no samples, a result that is not finite.
    pub fn apply(&self, x: &Signal) -> Result<Signal, EngineError> {
        const WHAT: &str = "input of the FRF";
        let (nx, n) = (self.x_mean.len(), x.n_samples());
        if x.n_channels() != nx {
            return Err(EngineError::ChannelCount { what: WHAT, expected: nx, found: x.n_channels() });
        }
        if !Signal::same_rate(self.sample_rate_hz, x.sample_rate_hz()) {
            let (expected_hz, found_hz) = (self.sample_rate_hz, x.sample_rate_hz());
            return Err(EngineError::SampleRate { what: WHAT, expected_hz, found_hz });
        }
        if n == 0 {
            return Err(EngineError::TooShort { what: WHAT, needed: 1, found: 0 });
        }
        let step = self.block - self.taps + 1;
        let mut y = vec![vec![0.0; n]; self.y_mean.len()];
        let mut blocks: Vec<Vec<&mut [f64]>> = (0..n.div_ceil(step)).map(|_| Vec::new()).collect();
        for channel in &mut y {
            for (block, part) in blocks.iter_mut().zip(channel.chunks_mut(step)) {
                block.push(part);
            }
        }
        // Of all values that are not finite, the first sample of the first channel is reported.
        let not_finite = blocks
            .par_iter_mut()
            .enumerate()
            .map_init(
                || self.scratch(),
                |scratch, (b, outputs)| {
                    let (channel, sample) = self.block(x, b * step, outputs, scratch)?;
                    Some((channel, b * step + sample))
                },
            )
            .flatten()
            .min();
        drop(blocks);
        if let Some((channel, sample)) = not_finite {
            return Err(EngineError::NonFiniteResult { what: "response of the FRF", channel, sample });
        }
        Ok(Signal::of_checked(x.sample_rate_hz(), y))
    }

    /// Response to all inputs from sample `from` on, as long as the parts of `outputs`; answers the
    /// first channel and place where it is not finite.
    fn block(
        &self,
        x: &Signal,
        from: usize,
        outputs: &mut [&mut [f64]],
        s: &mut Scratch,
    ) -> Option<(usize, usize)> {
        let bins = self.block / 2 + 1;
        for (i, mean) in self.x_mean.iter().enumerate() {
            // The first output needs the samples from `taps / 2 - 1` before it on.
            fill(&mut s.real, x.channel(i), from as isize + 1 - (self.taps / 2) as isize, *mean);
            self.forward
                .process_with_scratch(&mut s.real, &mut s.x[i * bins..(i + 1) * bins], &mut s.forward)
                .expect("buffers are the plan's own");
        }
        for (o, output) in outputs.iter_mut().enumerate() {
            let h = &self.spectra[o * s.x.len()..(o + 1) * s.x.len()];
            dispatch(self.isa, Multiply { h, x: &s.x, y: &mut s.y });
            // Rounding leaves a trace in what is real by symmetry; the inverse refuses it.
            s.y[0].im = 0.0;
            s.y[bins - 1].im = 0.0;
            self.inverse
                .process_with_scratch(&mut s.y, &mut s.real, &mut s.inverse)
                .expect("buffers are the plan's own");
            for (y, v) in output.iter_mut().zip(&s.real[self.taps - 1..]) {
                *y = self.y_mean[o] + v;
            }
        }
        // Checked now, while the values are in the caches.
        outputs.iter().enumerate().find_map(|(o, output)| Some((o, first_not_finite(output)?)))
    }

    fn scratch(&self) -> Scratch {
        let bins = self.block / 2 + 1;
        Scratch {
            real: self.forward.make_input_vec(),
            x: vec![Complex64::default(); bins * self.x_mean.len()],
            y: self.inverse.make_input_vec(),
            forward: self.forward.make_scratch_vec(),
            inverse: self.inverse.make_scratch_vec(),
        }
    }
}

/// Lines whose sums stay in the first-level cache.
const TILE: usize = 512;

/// `y = sum_i h_i * x_i` per line, `h` and `x` as `[input, line]`.
struct Multiply<'a> {
    h: &'a [Complex64],
    x: &'a [Complex64],
    y: &'a mut [Complex64],
}

impl Kernel for Multiply<'_> {
    type Out = ();
    const WIDE: bool = false;

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let bins = self.y.len();
        for (first, y) in (0..).step_by(TILE).zip(self.y.chunks_mut(TILE)) {
            y.fill(Complex64::default());
            for (h, x) in self.h.chunks_exact(bins).zip(self.x.chunks_exact(bins)) {
                for ((y, h), x) in y.iter_mut().zip(&h[first..]).zip(&x[first..]) {
                    *y += h * x;
                }
            }
        }
    }
}

/// Copies `samples[from..]` less `mean`; before the start the first, after the end the last value.
fn fill(out: &mut [f64], samples: &[f64], from: isize, mean: f64) {
    let before = from.min(0).unsigned_abs().min(out.len());
    let start = from.max(0).unsigned_abs().min(samples.len());
    let inside = (samples.len() - start).min(out.len() - before);
    out[..before].fill(samples[0] - mean);
    for (out, v) in out[before..].iter_mut().zip(&samples[start..start + inside]) {
        *out = v - mean;
    }
    out[before + inside..].fill(samples[samples.len() - 1] - mean);
}
