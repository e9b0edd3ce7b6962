//! The averaging loop of all spectra.

use std::sync::{Arc, Mutex, PoisonError};

use rayon::prelude::*;
use realfft::num_complex::Complex64;
use rigcast_numerics::fft::{RealFftPlanner, RealToComplex};

use super::{Detrend, Welch, hann};
use crate::EngineError;
use crate::simd::{Isa, Kernel, Simd, dispatch};

/// Channels of one run, equally long.
pub(super) type Source<'a> = Vec<&'a [f64]>;

/// One-sided averaged products `A * conj(B)` of channel pairs, unit^2/Hz, `[pair][line]`.
pub(super) struct Sums {
    pub re: Vec<Vec<f64>>,
    pub im: Vec<Vec<f64>>,
    pub df_hz: f64,
    pub n_averages: usize,
    pub effective_averages: f64,
}

/// Lines per tile: a tile of all channels stays in the first-level cache while all pairs are multiplied.
const TILE: usize = 64;
/// Segments whose products are added at a time, their sum in registers.
const AT_ONCE: usize = 4;
/// Segments transformed before their products are added: the sums pass through the caches once per
/// batch.
const BATCH: usize = 16;
/// Memory that the spectra of a batch may take; beyond it a batch has fewer segments.
const BATCH_BYTES: usize = 1 << 23;
/// Parts that are summed independently; a constant, so that the result is the same for any thread count.
const PARTS: usize = 8;
/// Memory that the parts' sums may take; beyond it there are fewer parts.
const PART_BYTES: usize = 1 << 28;

/// Averages the products of `pairs` over all whole segments of all runs, `offsets` (one a channel)
/// subtracted first.
pub(super) fn accumulate(
    runs: &[Source<'_>],
    offsets: &[f64],
    welch: &Welch,
    sample_rate_hz: f64,
    pairs: &[(usize, usize)],
) -> Result<Sums, EngineError> {
    let (len, hop) = (welch.segment_len, welch.hop());
    let n_samples = |run: &Source<'_>| run.first().map_or(0, |c| c.len());
    let segments: Vec<(usize, usize)> = runs
        .iter()
        .enumerate()
        .flat_map(|(run, source)| (0..welch.n_segments(n_samples(source))).map(move |k| (run, k * hop)))
        .collect();
    if segments.is_empty() {
        let found = runs.iter().map(n_samples).max().unwrap_or(0);
        return Err(EngineError::TooShort { what: "longest run, for one segment", needed: len, found });
    }
    let effective_averages =
        runs.iter().map(|run| welch.effective_averages(welch.n_segments(n_samples(run)))).sum();

    let spare = Mutex::new(Vec::new());
    let fft = RealFftPlanner::new().plan_fft_forward(len);
    let averaging =
        Averaging { isa: Isa::of_process()?, spare, runs, offsets, welch, pairs, window: &hann(len), fft };
    let tiles = welch.n_lines().div_ceil(TILE);
    let bytes = size_of::<Tile>() * pairs.len() * tiles;
    let parts = PARTS.min(PART_BYTES / bytes.max(1)).clamp(1, segments.len());
    let bound = |part: usize| part * segments.len() / parts;
    let sums: Vec<Vec<Tile>> =
        (0..parts).into_par_iter().map(|p| averaging.sum(&segments[bound(p)..bound(p + 1)])).collect();

    let mut sums = sums.into_iter();
    let mut total = sums.next().expect("at least one part");
    for part in sums {
        for (total, part) in
            total.as_flattened_mut().as_flattened_mut().iter_mut().zip(part.as_flattened().as_flattened())
        {
            *total += part;
        }
    }
    let lines = |pair: usize, part: usize| -> Vec<f64> {
        let tiles = total.iter().skip(pair).step_by(pairs.len());
        tiles.flat_map(|tile| tile[part]).take(welch.n_lines()).collect()
    };
    let mut re: Vec<Vec<f64>> = (0..pairs.len()).map(|pair| lines(pair, 0)).collect();
    let mut im: Vec<Vec<f64>> = (0..pairs.len()).map(|pair| lines(pair, 1)).collect();
    let power: f64 = averaging.window.iter().map(|w| w * w).sum();
    let scale = 1.0 / (sample_rate_hz * power * segments.len() as f64);
    for (pair, (re, im)) in re.iter_mut().zip(&mut im).enumerate() {
        for (line, (re, im)) in re.iter_mut().zip(im).enumerate() {
            let single = line == 0 || 2 * line == len;
            let scale = if single { scale } else { 2.0 * scale };
            (*re, *im) = (*re * scale, *im * scale);
            if !(re.is_finite() && im.is_finite()) {
                let channel = pairs[pair].0;
                return Err(EngineError::NonFiniteResult { what: "spectrum", channel, sample: line });
            }
        }
    }
    Ok(Sums { re, im, df_hz: sample_rate_hz / len as f64, n_averages: segments.len(), effective_averages })
}

struct Averaging<'a> {
    isa: Isa,
    /// Memory of finished parts, reused by the next ones: the kernel takes as long to provide new memory as
    /// the sums take.
    spare: Mutex<Vec<Vec<Tile>>>,
    runs: &'a [Source<'a>],
    offsets: &'a [f64],
    welch: &'a Welch,
    pairs: &'a [(usize, usize)],
    window: &'a [f64],
    fft: Arc<dyn RealToComplex<f64>>,
}

/// Real and imaginary parts of some lines; beyond the last line anything finite.
type Tile = [[f64; TILE]; 2];

impl Averaging<'_> {
    /// Sums over `segments`, `[tile, pair]`.
    fn sum(&self, segments: &[(usize, usize)]) -> Vec<Tile> {
        let (tiles, channels) = (self.welch.n_lines().div_ceil(TILE), self.offsets.len());
        let fft = &self.fft;
        let (mut input, mut output) = (fft.make_input_vec(), fft.make_output_vec());
        let mut scratch = fft.make_scratch_vec();
        let per_segment = tiles * channels * size_of::<Tile>();
        let batch_len = BATCH.min(BATCH_BYTES / per_segment.max(1)).clamp(1, segments.len());
        // [tile, segment, channel]; the values of the last part are overwritten.
        let mut spectra = self.spare.lock().unwrap_or_else(PoisonError::into_inner).pop().unwrap_or_default();
        spectra.resize(tiles * batch_len * channels, [[0.0; TILE]; 2]);
        let mut sums = vec![[[0.0; TILE]; 2]; tiles * self.pairs.len()];
        for batch in segments.chunks(batch_len) {
            for (b, &(run, start)) in batch.iter().enumerate() {
                for (c, samples) in self.runs[run].iter().enumerate() {
                    self.window_segment(&samples[start..start + input.len()], self.offsets[c], &mut input);
                    fft.process_with_scratch(&mut input, &mut output, &mut scratch)
                        .expect("buffers are the plan's own");
                    let tiles = spectra.iter_mut().skip(b * channels + c).step_by(batch_len * channels);
                    dispatch(self.isa, Halves { spectrum: &output, tiles });
                }
            }
            let tiles = spectra.chunks(batch_len * channels).zip(sums.chunks_mut(self.pairs.len()));
            for (spectra, sums) in tiles {
                let spectra = &spectra[..batch.len() * channels];
                dispatch(self.isa, AddProducts { spectra, channels, pairs: self.pairs, sums });
            }
        }
        self.spare.lock().unwrap_or_else(PoisonError::into_inner).push(spectra);
        sums
    }

    fn window_segment(&self, samples: &[f64], offset: f64, out: &mut [f64]) {
        let mean = match self.welch.detrend {
            Detrend::None => offset,
            Detrend::Constant => {
                offset + samples.iter().map(|v| v - offset).sum::<f64>() / samples.len() as f64
            }
        };
        dispatch(self.isa, WindowSegment { samples, mean, window: self.window, out });
    }
}

/// `out = (samples - mean) * window`
struct WindowSegment<'a> {
    samples: &'a [f64],
    mean: f64,
    window: &'a [f64],
    out: &'a mut [f64],
}

impl Kernel for WindowSegment<'_> {
    type Out = ();
    const WIDE: bool = false;

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        for ((out, v), w) in self.out.iter_mut().zip(self.samples).zip(self.window) {
            *out = (v - self.mean) * w;
        }
    }
}

/// Copies a spectrum to tiles, real and imaginary parts apart.
struct Halves<'a, T> {
    spectrum: &'a [Complex64],
    tiles: T,
}

impl<'a, T: Iterator<Item = &'a mut Tile>> Kernel for Halves<'_, T> {
    type Out = ();
    const WIDE: bool = false;

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        for ([re, im], lines) in self.tiles.zip(self.spectrum.chunks(TILE)) {
            for ((re, im), z) in re.iter_mut().zip(im).zip(lines) {
                (*re, *im) = (z.re, z.im);
            }
        }
    }
}

/// Adds the products of all pairs over the segments of a batch, for the lines of a tile.
struct AddProducts<'a> {
    /// `[segment, channel]`
    spectra: &'a [Tile],
    channels: usize,
    pairs: &'a [(usize, usize)],
    /// `[pair]`
    sums: &'a mut [Tile],
}

impl Kernel for AddProducts<'_> {
    type Out = ();
    const WIDE: bool = false;

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let Self { spectra, channels, pairs, sums } = self;
        let mut segments = spectra.chunks_exact(AT_ONCE * channels);
        for segments in &mut segments {
            for (sum, &(a, b)) in sums.iter_mut().zip(pairs) {
                let tile = |c: usize| std::array::from_fn(|k| &segments[k * channels + c]);
                add_products::<AT_ONCE>(sum, tile(a), tile(b));
            }
        }
        for segment in segments.remainder().chunks_exact(channels) {
            for (sum, &(a, b)) in sums.iter_mut().zip(pairs) {
                add_products(sum, [&segment[a]], [&segment[b]]);
            }
        }
    }
}

/// `sum += A * conj(B)` over `N` segments, one after another.
#[inline(always)]
fn add_products<const N: usize>([sum_re, sum_im]: &mut Tile, a: [&Tile; N], b: [&Tile; N]) {
    for i in 0..TILE {
        let (mut re, mut im) = (sum_re[i], sum_im[i]);
        for k in 0..N {
            let ([ar, ai], [br, bi]) = (a[k], b[k]);
            re += ar[i] * br[i] + ai[i] * bi[i];
            im += ai[i] * br[i] - ar[i] * bi[i];
        }
        (sum_re[i], sum_im[i]) = (re, im);
    }
}
