//! A delay that is too long for the segments of the usual estimate.
//!
//! One long excerpt of a drive and a response is transformed, and only the phase of their cross spectrum is kept (the
//! phase transform of Knapp and Carter 1976). Back in time, its envelope has a peak at the delay. Of two signals with
//! nothing in common all phases are random: the square of the envelope is then exponential with a mean of the number of
//! lines, which gives the limit that a peak must exceed. The peak is a coarse lag; the usual estimate on the response
//! shifted by it says whether the two are coherent there, and where exactly.

use std::io;
use std::ops::Range;

use realfft::num_complex::Complex64;
use rigcast_numerics::fft::RealFftPlanner;

use super::FALSE_ALARM;
use super::delay::envelope;
use crate::Samples;
use crate::spectral::hann;

/// Longest excerpt, samples; the delay is sought up to a quarter of it.
const EXCERPT: usize = 1 << 17;
/// Samples of all pairs of channels together: bounds the time.
const ALL_PAIRS: usize = 1 << 26;
/// Drives whose spectra are held at once: bounds the memory.
const DRIVES: usize = 4;
/// Of a drive that repeats, every period has a peak: the shortest lag whose peak is this share of the highest counts.
const ALIKE: f64 = 0.8;

/// Where a response follows a drive from far.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Far {
    /// Index of the drive, a channel of the run.
    pub(super) drive: usize,
    /// Lag, samples, to within the length of the impulse response; negative where the response is ahead.
    pub(super) lag: isize,
    /// Height of the peak over its limit, above 1.
    height: f64,
}

/// The drive that each response follows from farthest above chance, in their order; `None` where there is none.
///
/// # Errors
/// Those of the file that holds the samples.
pub(super) fn far(
    samples: &mut impl Samples,
    drives: &[usize],
    responses: &[usize],
) -> io::Result<Vec<Option<Far>>> {
    let mut best: Vec<Option<Far>> = vec![None; responses.len()];
    let (n, pairs) = (samples.n_samples(), drives.len() * responses.len());
    let most = n.min(EXCERPT).min(ALL_PAIRS / pairs.max(1));
    if most < 2 || pairs == 0 {
        return Ok(best);
    }
    let len = 1 << most.ilog2();
    let from = (n - len) / 2;
    let window = hann(len);
    for drives in drives.chunks(DRIVES) {
        let drives: Vec<(usize, Vec<Complex64>)> = drives
            .iter()
            .map(|&drive| Ok((drive, spectrum(samples, drive, from..from + len, &window)?)))
            .collect::<io::Result<_>>()?;
        for (best, &response) in best.iter_mut().zip(responses) {
            let response = spectrum(samples, response, from..from + len, &window)?;
            for (drive, spectrum) in &drives {
                let found =
                    peak(spectrum, &response, pairs).map(|(lag, height)| Far { drive: *drive, lag, height });
                if let Some(found) = found
                    && best.is_none_or(|best| found.height > best.height)
                {
                    *best = Some(found);
                }
            }
        }
    }
    Ok(best)
}

/// Spectrum of a windowed stretch of a channel, without its mean.
fn spectrum(
    samples: &mut impl Samples,
    channel: usize,
    range: Range<usize>,
    window: &[f64],
) -> io::Result<Vec<Complex64>> {
    let mut part = Vec::with_capacity(range.len());
    samples.read(channel, range, &mut part)?;
    let mean = part.iter().sum::<f64>() / part.len() as f64;
    part.iter_mut().zip(window).for_each(|(v, w)| *v = (*v - mean) * w);
    let forward = RealFftPlanner::new().plan_fft_forward(part.len());
    let mut spectrum = forward.make_output_vec();
    forward.process(&mut part, &mut spectrum).expect("buffers have the plan's size");
    Ok(spectrum)
}

/// The lag of the highest peak, and its height over its limit; `None` below the limit or at the end of the lags.
fn peak(x: &[Complex64], y: &[Complex64], pairs: usize) -> Option<(isize, f64)> {
    let (last, len) = (x.len() - 1, 2 * (x.len() - 1));
    let mut phases = vec![Complex64::default(); x.len()];
    let mut lines = 0.0;
    // DC and Nyquist have no phase; nor have lines without a value.
    for line in 1..last {
        let cross = y[line] * x[line].conj();
        let size = cross.norm();
        if size.is_normal() {
            phases[line] = cross / size;
            lines += 1.0;
        }
    }
    let envelope = envelope(&phases, len);
    let at = |lag: isize| envelope[lag.rem_euclid(len as isize) as usize];
    let reach = (len / 4) as isize;
    let highest = (-reach..=reach).map(at).fold(0.0, f64::max);
    let is_alike = |lag: &isize| at(*lag) >= ALIKE * highest;
    let lag = (0..=reach).flat_map(|lag| [lag, -lag]).find(is_alike)?;
    // A real signal's lines and their mirror images: twice a sum of unit phasors.
    let limit = 2.0 * (lines * ((len * pairs) as f64 / FALSE_ALARM).ln()).sqrt();
    (lag.abs() < reach && highest > limit && highest.is_finite()).then_some((lag, highest / limit))
}
