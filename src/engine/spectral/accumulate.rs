//! The one loop that all averaged spectra share.

use std::ops::Range;

use rayon::prelude::*;
use realfft::RealFftPlanner;
use realfft::num_complex::Complex64;

use super::{Detrend, Welch, hann};
use crate::engine::EngineError;
use crate::engine::simd::{Isa, Kernel, Simd, dispatch};

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

/// Segments transformed before their products are added: keeps the sums in cache.
const BATCH: usize = 4;
/// Lines whose products are added at a time.
const TILE: usize = 256;
/// Parts that are summed independently; a constant, so that no bit depends on the thread count.
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

    let job = Job { isa: Isa::of_process()?, runs, offsets, welch, pairs, window: &hann(len) };
    let bytes = 16 * pairs.len() * welch.n_lines();
    let parts = PARTS.min(PART_BYTES / bytes.max(1)).clamp(1, segments.len());
    let bound = |part: usize| part * segments.len() / parts;
    let sums: Vec<Part> =
        (0..parts).into_par_iter().map(|p| job.sum(&segments[bound(p)..bound(p + 1)])).collect();

    let mut sums = sums.into_iter();
    let mut total = sums.next().expect("at least one part");
    for part in sums {
        add(&mut total.re, &part.re);
        add(&mut total.im, &part.im);
    }
    let power: f64 = job.window.iter().map(|w| w * w).sum();
    let scale = 1.0 / (sample_rate_hz * power * segments.len() as f64);
    for (pair, (re, im)) in total.re.iter_mut().zip(&mut total.im).enumerate() {
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
    Ok(Sums {
        re: total.re,
        im: total.im,
        df_hz: sample_rate_hz / len as f64,
        n_averages: segments.len(),
        effective_averages,
    })
}

struct Job<'a> {
    isa: Isa,
    runs: &'a [Source<'a>],
    offsets: &'a [f64],
    welch: &'a Welch,
    pairs: &'a [(usize, usize)],
    window: &'a [f64],
}

/// Sums of one part, `[pair][line]`.
struct Part {
    re: Vec<Vec<f64>>,
    im: Vec<Vec<f64>>,
}

impl Job<'_> {
    fn sum(&self, segments: &[(usize, usize)]) -> Part {
        let (lines, channels) = (self.welch.n_lines(), self.offsets.len());
        let fft = RealFftPlanner::<f64>::new().plan_fft_forward(self.welch.segment_len);
        let (mut input, mut output) = (fft.make_input_vec(), fft.make_output_vec());
        let mut scratch = fft.make_scratch_vec();
        // Real and imaginary parts lie apart so that the products vectorise; [in batch, channel, line].
        let mut re = vec![0.0; BATCH * channels * lines];
        let mut im = re.clone();
        let mut part = Part {
            re: vec![vec![0.0; lines]; self.pairs.len()],
            im: vec![vec![0.0; lines]; self.pairs.len()],
        };
        for batch in segments.chunks(BATCH) {
            for (b, &(run, start)) in batch.iter().enumerate() {
                for (c, samples) in self.runs[run].iter().enumerate() {
                    self.window_segment(&samples[start..start + input.len()], self.offsets[c], &mut input);
                    fft.process_with_scratch(&mut input, &mut output, &mut scratch)
                        .expect("buffers are the plan's own");
                    let at = (b * channels + c) * lines;
                    let (re, im) = (&mut re[at..at + lines], &mut im[at..at + lines]);
                    dispatch(self.isa, Split { spectrum: &output, re, im });
                }
            }
            for from in (0..lines).step_by(TILE) {
                let tile = from..lines.min(from + TILE);
                let spectra = Spectra { re: &re, im: &im, channels, lines, n_segments: batch.len() };
                dispatch(self.isa, AddProducts { spectra, pairs: self.pairs, tile, sums: &mut part });
            }
        }
        part
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

/// Real and imaginary parts apart.
struct Split<'a> {
    spectrum: &'a [Complex64],
    re: &'a mut [f64],
    im: &'a mut [f64],
}

impl Kernel for Split<'_> {
    type Out = ();
    const WIDE: bool = false;

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        for ((re, im), z) in self.re.iter_mut().zip(self.im).zip(self.spectrum) {
            (*re, *im) = (z.re, z.im);
        }
    }
}

/// Spectra of a batch, parts apart, `[segment, channel, line]`.
#[derive(Clone, Copy)]
struct Spectra<'a> {
    re: &'a [f64],
    im: &'a [f64],
    channels: usize,
    lines: usize,
    n_segments: usize,
}

impl<'a> Spectra<'a> {
    /// Lines `tile` of one segment and channel: real parts, imaginary parts.
    #[inline(always)]
    fn lines(&self, segment: usize, channel: usize, tile: &Range<usize>) -> (&'a [f64], &'a [f64]) {
        let first = (segment * self.channels + channel) * self.lines;
        let lines = first + tile.start..first + tile.end;
        (&self.re[lines.clone()], &self.im[lines])
    }
}

/// Adds the products of all pairs over the segments of a batch, for the lines of `tile`.
struct AddProducts<'a> {
    spectra: Spectra<'a>,
    pairs: &'a [(usize, usize)],
    tile: Range<usize>,
    sums: &'a mut Part,
}

impl Kernel for AddProducts<'_> {
    type Out = ();
    const WIDE: bool = false;

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let Self { spectra, pairs, tile, sums } = self;
        for (pair, &channels) in pairs.iter().enumerate() {
            let sum = (&mut sums.re[pair][tile.clone()], &mut sums.im[pair][tile.clone()]);
            if spectra.n_segments == BATCH {
                add_products::<BATCH>(sum, spectra, 0, channels, &tile);
            } else {
                for segment in 0..spectra.n_segments {
                    let sum = (&mut *sum.0, &mut *sum.1);
                    add_products::<1>(sum, spectra, segment, channels, &tile);
                }
            }
        }
    }
}

/// `sum += A * conj(B)` over `N` segments, one after another, with the sum in a register.
#[inline(always)]
fn add_products<const N: usize>(
    (sum_re, sum_im): (&mut [f64], &mut [f64]),
    spectra: Spectra<'_>,
    first_segment: usize,
    (a, b): (usize, usize),
    tile: &Range<usize>,
) {
    let n = sum_re.len();
    let cut = |channel: usize, k: usize| {
        let (re, im) = spectra.lines(first_segment + k, channel, tile);
        (&re[..n], &im[..n])
    };
    let first: [_; N] = std::array::from_fn(|k| cut(a, k));
    if a == b {
        for i in 0..n {
            let mut re = sum_re[i];
            for (ar, ai) in first {
                re += ar[i] * ar[i] + ai[i] * ai[i];
            }
            sum_re[i] = re;
        }
        return;
    }
    let second: [_; N] = std::array::from_fn(|k| cut(b, k));
    let sum_im = &mut sum_im[..n];
    for i in 0..n {
        let (mut re, mut im) = (sum_re[i], sum_im[i]);
        for k in 0..N {
            let ((ar, ai), (br, bi)) = (first[k], second[k]);
            re += ar[i] * br[i] + ai[i] * bi[i];
            im += ai[i] * br[i] - ar[i] * bi[i];
        }
        (sum_re[i], sum_im[i]) = (re, im);
    }
}

fn add(total: &mut [Vec<f64>], part: &[Vec<f64>]) {
    for (total, part) in total.iter_mut().flatten().zip(part.iter().flatten()) {
        *total += part;
    }
}
