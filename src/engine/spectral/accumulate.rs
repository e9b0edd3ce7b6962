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
/// Segments whose products are added at a time, their sum in registers: of few channels so many that their tiles stay in the
/// first-level cache.
const AT_ONCE: usize = 4;
/// The same of many channels, whose tiles stay in the second-level cache: each reading of a sum then serves more segments.
const AT_ONCE_OF_MANY: usize = 16;
/// Channels above this are many.
const FEW: usize = 16;
/// Segments transformed before their products are added: the sums pass through the caches once per
/// batch.
const BATCH: usize = 16;
/// Memory that the spectra of a batch may take; beyond it a batch has fewer segments.
const BATCH_BYTES: usize = 1 << 23;
/// The same where all threads share one batch.
const SHARED_BATCH_BYTES: usize = 1 << 28;
/// Parts that are summed independently; a constant, so that the result is the same for any thread count.
pub(crate) const PARTS: usize = 8;
/// Memory that the parts' sums may take; beyond it there are fewer parts.
pub(crate) const PART_BYTES: usize = 1 << 28;

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
    let part = |p: usize| &segments[bound(p)..bound(p + 1)];
    // Sums too large for each part to have its own: all threads work on one part after the other.
    let total = if PARTS.saturating_mul(bytes) > PART_BYTES {
        let mut sums = (0..parts).map(|p| averaging.sum(part(p), Threads::All));
        let first = sums.next().expect("at least one part");
        sums.fold(first, added)
    } else {
        let sums: Vec<Vec<Tile>> =
            (0..parts).into_par_iter().map(|p| averaging.sum(part(p), Threads::One)).collect();
        sums.into_iter().reduce(added).expect("at least one part")
    };
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

/// The sums of both, number by number.
fn added(mut total: Vec<Tile>, part: Vec<Tile>) -> Vec<Tile> {
    let part = part.as_flattened().as_flattened();
    for (total, part) in total.as_flattened_mut().as_flattened_mut().iter_mut().zip(part) {
        *total += part;
    }
    total
}

/// The threads that work on one part.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Threads {
    One,
    All,
}

/// Spectra of a batch, by segment `[tile, channel]`.
type Batch = Vec<Vec<Tile>>;

struct Averaging<'a> {
    isa: Isa,
    /// Memory of finished parts, reused by the next ones: the kernel takes as long to provide new memory as
    /// the sums take.
    spare: Mutex<Vec<Batch>>,
    runs: &'a [Source<'a>],
    offsets: &'a [f64],
    welch: &'a Welch,
    pairs: &'a [(usize, usize)],
    window: &'a [f64],
    fft: Arc<dyn RealToComplex<f64>>,
}

/// Input, output and scratch of a transform.
type Buffers = (Vec<f64>, Vec<Complex64>, Vec<Complex64>);

/// Real and imaginary parts of some lines; beyond the last line anything finite.
type Tile = [[f64; TILE]; 2];

impl Averaging<'_> {
    /// Sums over `segments`, `[tile, pair]`. Segments are added one after another, whatever the batch and the threads.
    fn sum(&self, segments: &[(usize, usize)], threads: Threads) -> Vec<Tile> {
        let (tiles, channels) = (self.welch.n_lines().div_ceil(TILE), self.offsets.len());
        let per_segment = tiles * channels * size_of::<Tile>();
        let bytes = if threads == Threads::All { SHARED_BATCH_BYTES } else { BATCH_BYTES };
        let batch_len = BATCH.min(bytes / per_segment.max(1)).clamp(1, segments.len());
        // The values of the last part are overwritten.
        let mut spectra = self.spare.lock().unwrap_or_else(PoisonError::into_inner).pop().unwrap_or_default();
        spectra.resize(batch_len, Vec::new());
        spectra.iter_mut().for_each(|spectra| spectra.resize(tiles * channels, [[0.0; TILE]; 2]));
        let mut sums = vec![[[0.0; TILE]; 2]; tiles * self.pairs.len()];
        let mut buffers = self.buffers();
        for batch in segments.chunks(batch_len) {
            let spectra = &mut spectra[..batch.len()];
            match threads {
                Threads::One => {
                    spectra
                        .iter_mut()
                        .zip(batch)
                        .for_each(|(s, segment)| self.transform(segment, s, &mut buffers));
                }
                Threads::All => spectra.par_iter_mut().zip(batch).for_each_init(
                    || self.buffers(),
                    |buffers, (spectra, segment)| self.transform(segment, spectra, buffers),
                ),
            }
            let spectra = &*spectra;
            let add = |(tile, sums): (usize, &mut [Tile])| {
                let products = AddProducts { spectra, channels, tile, pairs: self.pairs, sums };
                dispatch(self.isa, products);
            };
            let n = self.pairs.len();
            match threads {
                Threads::One => sums.chunks_mut(n).enumerate().for_each(add),
                Threads::All => sums.par_chunks_mut(n).enumerate().for_each(add),
            }
        }
        self.spare.lock().unwrap_or_else(PoisonError::into_inner).push(spectra);
        sums
    }

    fn buffers(&self) -> Buffers {
        let fft = &self.fft;
        (fft.make_input_vec(), fft.make_output_vec(), fft.make_scratch_vec())
    }

    /// The spectra of all channels over one segment.
    fn transform(
        &self,
        &(run, start): &(usize, usize),
        spectra: &mut [Tile],
        (input, output, scratch): &mut Buffers,
    ) {
        let channels = self.offsets.len();
        for (c, samples) in self.runs[run].iter().enumerate() {
            self.window_segment(&samples[start..start + input.len()], self.offsets[c], input);
            self.fft.process_with_scratch(input, output, scratch).expect("buffers are the plan's own");
            let tiles = spectra.iter_mut().skip(c).step_by(channels);
            dispatch(self.isa, Halves { spectrum: output, tiles });
        }
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
    spectra: &'a [Vec<Tile>],
    channels: usize,
    /// Place of the tile in the spectra of each segment.
    tile: usize,
    pairs: &'a [(usize, usize)],
    /// `[pair]`
    sums: &'a mut [Tile],
}

impl Kernel for AddProducts<'_> {
    type Out = ();
    const WIDE: bool = false;

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let Self { mut spectra, channels, tile, pairs, sums } = self;
        let first = tile * channels;
        // As many segments at once as there are; the rest with ever fewer.
        if channels > FEW {
            spectra = add_all::<AT_ONCE_OF_MANY>(spectra, first, pairs, sums);
        }
        spectra = add_all::<AT_ONCE>(spectra, first, pairs, sums);
        add_all::<1>(spectra, first, pairs, sums);
    }
}

/// Adds the products of all pairs over whole groups of `N` segments; answers the other segments.
#[inline(always)]
fn add_all<'a, const N: usize>(
    spectra: &'a [Vec<Tile>],
    first: usize,
    pairs: &[(usize, usize)],
    sums: &mut [Tile],
) -> &'a [Vec<Tile>] {
    let (groups, rest) = spectra.as_chunks::<N>();
    for segments in groups {
        for (sum, &(a, b)) in sums.iter_mut().zip(pairs) {
            let tile = |c: usize| std::array::from_fn(|k| &segments[k][first + c]);
            add_products::<N>(sum, tile(a), tile(b));
        }
    }
    rest
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

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    fn noise(seed: u64, n: usize) -> Vec<f64> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        (0..n).map(|_| rng.random_range(-0.5..0.5)).collect()
    }

    #[test]
    fn sums_are_bit_equal_to_products_added_one_after_another_whatever_the_batch_and_the_threads() {
        let welch = Welch { segment_len: 300, overlap: 0.5, detrend: Detrend::None };
        for (channels, n_segments) in [(3, 7), (9, 37), (20, 3), (20, 37)] {
            let samples: Vec<Vec<f64>> =
                (0..channels as u64).map(|c| noise(c, 150 * (n_segments + 1))).collect();
            let runs = [samples.iter().map(Vec::as_slice).collect()];
            let offsets: Vec<f64> = (0..channels).map(|c| 0.01 * c as f64).collect();
            let pairs: Vec<(usize, usize)> =
                (0..channels).flat_map(|a| (a..channels).map(move |b| (b, a))).collect();
            let segments: Vec<(usize, usize)> = (0..n_segments).map(|k| (0, 150 * k)).collect();
            for isa in Isa::ALL.into_iter().filter(|isa| isa.is_available()) {
                let averaging = Averaging {
                    isa,
                    spare: Mutex::new(Vec::new()),
                    runs: &runs,
                    offsets: &offsets,
                    welch: &welch,
                    pairs: &pairs,
                    window: &hann(300),
                    fft: RealFftPlanner::new().plan_fft_forward(300),
                };
                let tiles = welch.n_lines().div_ceil(TILE);
                let mut expected = vec![[[0.0; TILE]; 2]; tiles * pairs.len()];
                let mut spectra = vec![[[0.0; TILE]; 2]; tiles * channels];
                for segment in &segments {
                    averaging.transform(segment, &mut spectra, &mut averaging.buffers());
                    for (place, [re, im]) in expected.iter_mut().enumerate() {
                        let (a, b) = pairs[place % pairs.len()];
                        let tile = |c: usize| &spectra[place / pairs.len() * channels + c];
                        let ([ar, ai], [br, bi]) = (tile(a), tile(b));
                        for i in 0..TILE {
                            re[i] += ar[i] * br[i] + ai[i] * bi[i];
                            im[i] += ai[i] * br[i] - ar[i] * bi[i];
                        }
                    }
                }
                for threads in [Threads::One, Threads::All] {
                    let found = averaging.sum(&segments, threads);
                    assert!(found == expected, "{channels} channels, {n_segments} segments, {threads:?}");
                }
            }
        }
    }
}
