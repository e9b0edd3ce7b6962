//! An FRF as a filter for signals of any length: overlap-save, no wrap-around.

mod adjoint;

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

/// Spectra above this leave the caches before the next block needs them: several blocks then share each reading.
const LARGE_BYTES: usize = 1 << 24;

/// Blocks that share it.
const SHARING: usize = 4;

/// Buffers of one thread.
struct Scratch {
    real: Vec<f64>,
    /// `[block, input, bin]`
    x: Vec<Complex64>,
    /// `[block, output, bin]`, or of one output after another `[bin]`.
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
        self.check("input of the FRF", x, self.x_mean.len())?;
        let n = x.n_samples();
        let large = self.spectra.len() * size_of::<Complex64>() > LARGE_BYTES;
        let blocks = n.div_ceil(self.block - self.taps + 1);
        let at_once = if large { SHARING.min(blocks.div_ceil(rayon::current_num_threads())) } else { 1 };
        self.apply_in_blocks(x, at_once)
    }

    /// Whether a signal has so many channels, the FRF's sample rate and any samples.
    fn check(&self, what: &'static str, signal: &Signal, channels: usize) -> Result<(), EngineError> {
        if signal.n_channels() != channels {
            return Err(EngineError::ChannelCount { what, expected: channels, found: signal.n_channels() });
        }
        if !Signal::same_rate(self.sample_rate_hz, signal.sample_rate_hz()) {
            let (expected_hz, found_hz) = (self.sample_rate_hz, signal.sample_rate_hz());
            return Err(EngineError::SampleRate { what, expected_hz, found_hz });
        }
        if signal.n_samples() == 0 {
            return Err(EngineError::TooShort { what, needed: 1, found: 0 });
        }
        Ok(())
    }

    /// So many blocks share each reading of the spectra; no bit depends on how many.
    fn apply_in_blocks(&self, x: &Signal, at_once: usize) -> Result<Signal, EngineError> {
        let (n, step) = (x.n_samples(), self.block - self.taps + 1);
        let mut y = vec![vec![0.0; n]; self.y_mean.len()];
        let mut blocks: Vec<Vec<&mut [f64]>> = (0..n.div_ceil(step)).map(|_| Vec::new()).collect();
        for channel in &mut y {
            for (block, part) in blocks.iter_mut().zip(channel.chunks_mut(step)) {
                block.push(part);
            }
        }
        // Of all values that are not finite, the first sample of the first channel is reported.
        let not_finite = blocks
            .par_chunks_mut(at_once)
            .enumerate()
            .map_init(
                || self.scratch(at_once),
                |scratch, (group, blocks)| self.blocks(x, group * at_once * step, blocks, scratch),
            )
            .flatten()
            .min();
        drop(blocks);
        if let Some((channel, sample)) = not_finite {
            return Err(EngineError::NonFiniteResult { what: "response of the FRF", channel, sample });
        }
        Ok(Signal::of_checked(x.sample_rate_hz(), y))
    }

    /// Response to all inputs from sample `from` on, one block after another, each as long as the parts of its outputs;
    /// answers the first channel and sample where it is not finite.
    fn blocks(
        &self,
        x: &Signal,
        from: usize,
        blocks: &mut [Vec<&mut [f64]>],
        s: &mut Scratch,
    ) -> Option<(usize, usize)> {
        let (bins, step) = (self.block / 2 + 1, self.block - self.taps + 1);
        let (nx, ny) = (self.x_mean.len(), self.y_mean.len());
        for (b, lines) in s.x.chunks_exact_mut(nx * bins).take(blocks.len()).enumerate() {
            for ((i, mean), lines) in self.x_mean.iter().enumerate().zip(lines.chunks_exact_mut(bins)) {
                // The first output needs the samples from `taps / 2 - 1` before it on.
                let first = (from + b * step) as isize + 1 - (self.taps / 2) as isize;
                fill(&mut s.real, x.channel(i), first, *mean);
                self.forward
                    .process_with_scratch(&mut s.real, lines, &mut s.forward)
                    .expect("buffers are the plan's own");
            }
        }
        let x = |b: usize| &s.x[b * nx * bins..(b + 1) * nx * bins];
        let h = |o: usize| &self.spectra[o * nx * bins..(o + 1) * nx * bins];
        if let [outputs] = blocks {
            for (o, output) in outputs.iter_mut().enumerate() {
                for (first, y) in (0..).step_by(TILE).zip(s.y[..bins].chunks_mut(TILE)) {
                    dispatch(self.isa, Multiply { h: h(o), x: x(0), y, bins, first });
                }
                self.back(o, &mut s.y[..bins], &mut s.real, &mut s.inverse, output);
            }
        } else {
            for first in (0..bins).step_by(SHARED_TILE) {
                for o in 0..ny {
                    for b in 0..blocks.len() {
                        let place = (b * ny + o) * bins;
                        let y = &mut s.y[place + first..place + bins.min(first + SHARED_TILE)];
                        dispatch(self.isa, Multiply { h: h(o), x: x(b), y, bins, first });
                    }
                }
            }
            let spectra = s.y.chunks_exact_mut(bins);
            for ((o, output), y) in
                blocks.iter_mut().flat_map(|block| block.iter_mut().enumerate()).zip(spectra)
            {
                self.back(o, y, &mut s.real, &mut s.inverse, output);
            }
        }
        // Checked now, while the values are in the caches.
        let places = blocks.iter().enumerate().flat_map(|(b, block)| {
            let first = from + b * step;
            block
                .iter()
                .enumerate()
                .filter_map(move |(o, output)| Some((o, first + first_not_finite(output)?)))
        });
        places.min()
    }

    /// The samples of one output from its spectrum.
    fn back(
        &self,
        o: usize,
        y: &mut [Complex64],
        real: &mut [f64],
        scratch: &mut [Complex64],
        output: &mut [f64],
    ) {
        // Rounding leaves a trace in what is real by symmetry; the inverse refuses it.
        y[0].im = 0.0;
        y[y.len() - 1].im = 0.0;
        self.inverse.process_with_scratch(y, real, scratch).expect("buffers are the plan's own");
        for (y, v) in output.iter_mut().zip(&real[self.taps - 1..]) {
            *y = self.y_mean[o] + v;
        }
    }

    fn scratch(&self, blocks: usize) -> Scratch {
        let bins = self.block / 2 + 1;
        let spectra = if blocks == 1 { 1 } else { blocks * self.y_mean.len() };
        Scratch {
            real: self.forward.make_input_vec(),
            x: vec![Complex64::default(); blocks * bins * self.x_mean.len()],
            y: vec![Complex64::default(); spectra * bins],
            forward: self.forward.make_scratch_vec(),
            inverse: self.inverse.make_scratch_vec(),
        }
    }
}

/// Lines whose sums stay in the first-level cache.
const TILE: usize = 512;

/// The same where several blocks share them, with their inputs in the second-level cache.
const SHARED_TILE: usize = 128;

/// `y = sum_i h_i * x_i` on the lines from `first` on, `h` and `x` as `[input, line]` with `bins` lines.
struct Multiply<'a> {
    h: &'a [Complex64],
    x: &'a [Complex64],
    y: &'a mut [Complex64],
    bins: usize,
    first: usize,
}

impl Kernel for Multiply<'_> {
    type Out = ();
    const WIDE: bool = false;

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let Self { h, x, y, bins, first } = self;
        y.fill(Complex64::default());
        for (h, x) in h.chunks_exact(bins).zip(x.chunks_exact(bins)) {
            for ((y, h), x) in y.iter_mut().zip(&h[first..]).zip(&x[first..]) {
                *y += h * x;
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

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    fn numbers(seed: u64) -> impl FnMut() -> f64 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        move || rng.random_range(-0.5..0.5)
    }

    #[test]
    fn blocks_that_share_the_spectra_give_the_bits_of_single_blocks() {
        let (n_inputs, n_outputs, segment_len) = (5, 7, 256);
        let mut next = numbers(1);
        let frf = Frf {
            sample_rate_hz: 100.0,
            segment_len,
            n_inputs,
            n_outputs,
            h: (0..(segment_len / 2 + 1) * n_inputs * n_outputs)
                .map(|_| Complex64::new(next(), next()))
                .collect(),
            usable_hz: [0.0, 50.0],
            x_mean: vec![0.1; n_inputs],
            y_mean: vec![-0.2; n_outputs],
        };
        let filter = frf.filter().unwrap();
        for n in [1, 700, 2000, 7001] {
            let channels = (0..n_inputs).map(|_| (0..n).map(|_| next()).collect()).collect();
            let x = Signal::new(100.0, channels).unwrap();
            let single = filter.apply_in_blocks(&x, 1).unwrap();
            for at_once in 2..=4 {
                assert!(
                    filter.apply_in_blocks(&x, at_once).unwrap() == single,
                    "{n} samples, {at_once} blocks"
                );
            }
            assert!(filter.apply(&x).unwrap() == single);
        }
        // The first channel, and its first sample, wherever the blocks lie.
        let mut channels = vec![vec![0.0; 7000]; n_inputs];
        channels[2][1500..].fill(f64::MAX);
        let x = Signal::new(100.0, channels).unwrap();
        let error = filter.apply_in_blocks(&x, 1).unwrap_err();
        assert_eq!(filter.apply_in_blocks(&x, 3).unwrap_err(), error);
    }
}
