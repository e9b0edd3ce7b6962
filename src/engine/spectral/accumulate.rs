//! The one loop that all averaged spectra share.

use rayon::prelude::*;
use realfft::RealFftPlanner;

use super::{Detrend, Welch, hann};
use crate::engine::EngineError;

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

    let job = Job { runs, offsets, welch, pairs, window: &hann(len) };
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
                    for ((re, im), z) in re[at..].iter_mut().zip(&mut im[at..]).zip(&output) {
                        (*re, *im) = (z.re, z.im);
                    }
                }
            }
            for from in (0..lines).step_by(TILE) {
                let tile = from..lines.min(from + TILE);
                for (p, &(a, b)) in self.pairs.iter().enumerate() {
                    for k in 0..batch.len() {
                        let at = |c: usize| {
                            let first = (k * channels + c) * lines;
                            first + tile.start..first + tile.end
                        };
                        let (sum_re, sum_im) = (&mut part.re[p][tile.clone()], &mut part.im[p][tile.clone()]);
                        if a == b {
                            add_power(sum_re, &re[at(a)], &im[at(a)]);
                        } else {
                            add_product(sum_re, sum_im, (&re[at(a)], &im[at(a)]), (&re[at(b)], &im[at(b)]));
                        }
                    }
                }
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
        for ((out, v), w) in out.iter_mut().zip(samples).zip(self.window) {
            *out = (v - mean) * w;
        }
    }
}

/// `sum += |A|^2`
fn add_power(sum: &mut [f64], re: &[f64], im: &[f64]) {
    for ((sum, re), im) in sum.iter_mut().zip(re).zip(im) {
        *sum += re * re + im * im;
    }
}

/// `sum += A * conj(B)`
fn add_product(sum_re: &mut [f64], sum_im: &mut [f64], a: (&[f64], &[f64]), b: (&[f64], &[f64])) {
    let n = sum_re.len();
    let (sum_im, ar, ai, br, bi) = (&mut sum_im[..n], &a.0[..n], &a.1[..n], &b.0[..n], &b.1[..n]);
    for i in 0..n {
        sum_re[i] += ar[i] * br[i] + ai[i] * bi[i];
        sum_im[i] += ai[i] * br[i] - ar[i] * bi[i];
    }
}

fn add(total: &mut [Vec<f64>], part: &[Vec<f64>]) {
    for (total, part) in total.iter_mut().flatten().zip(part.iter().flatten()) {
        *total += part;
    }
}
