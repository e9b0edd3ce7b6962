//! The delay between a response and the drive that it follows most.
//!
//! The cross spectrum of a drive and a response, each of its lines weighted by its coherence alone (the maximum
//! likelihood weight `g^2 / (1 - g^2)` of Hannan and Thomson, on the phase), is transformed back to time. Its
//! envelope has its maximum at the delay. The envelope does not change with a constant phase: a velocity or an
//! acceleration, or a sign, is no delay. A response without such a maximum is sought further away ([`far`]), shifted by
//! what was found there, and estimated again.

use std::io;
use std::ops::Range;

use realfft::num_complex::Complex64;
use rigcast_numerics::fft::RealFftPlanner;

use super::FALSE_ALARM;
use super::excerpt::spread;
use super::long_delay::{Far, far};
use crate::Samples;
use crate::spectral::{Detrend, Means, Record, Welch, cross_spectra};

/// Longest segment of the spectra; a delay of more than a quarter of it is hidden by the window.
const SEGMENT: usize = 4096;
/// Shortest segment.
const SHORTEST: usize = 128;
/// Excerpts of two segments each, half overlapped.
const EXCERPTS: usize = 32;
/// Excerpts of a run of so many pairs of channels that the time would grow: at most this many over all pairs.
const PAIRED_EXCERPTS: usize = 4096;
/// Excerpts read at once.
const AT_ONCE: usize = 2;
/// Drives, and responses, whose spectra are summed at once: bounds the memory.
const DRIVES: usize = 2;
const RESPONSES: usize = 4;
/// Fewest excerpts of a response that is shifted far: the coherence of fewer is high by chance.
const FEWEST_FAR: usize = 3;
/// Share of the highest maximum, at any lag, below which the one within reach is no delay. Of a drive that repeats, every
/// period has a maximum that is nearly as high.
const TAIL: f64 = 0.5;
/// Segments over their resolution below which a longer delay is sought too.
const COARSE: f64 = 50.0;
/// How much more of a response must be coherent with the drive at a longer delay.
const FARTHER: f64 = 1.2;
/// Highest coherence that a line counts with: one line of an exact copy would outweigh all others.
const HIGHEST: f64 = 0.999;

/// Delay of one response.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Delay {
    /// Index of the drive that it follows most (the highest mean coherence), a channel of the run.
    pub drive: usize,
    /// Delay, samples; negative where the response is ahead of the drive.
    pub samples: f64,
    /// Resolution, samples: the inverse of the band over which drive and response are coherent. No system of
    /// a few modes is ahead of its drive by as much, since that would be a lead of a whole turn over the band.
    pub resolution: f64,
    /// Coherence with that drive, averaged over the band.
    pub coherence: f64,
}

/// The delay of each response, in their order; `None` where no drive is coherent with it. `drives` and `responses`
/// are channels of the run that move.
///
/// # Errors
/// Those of the file that holds the samples.
pub fn delays(
    samples: &mut impl Samples,
    drives: &[usize],
    responses: &[usize],
) -> io::Result<Vec<Option<Delay>>> {
    let mut best: Vec<Option<(f64, Delay)>> = vec![None; responses.len()];
    let n = samples.n_samples();
    // Eight segments at least, since the coherence of few is high by chance.
    let len = if n < 8 * SHORTEST { 0 } else { SEGMENT.min(1 << (n / 8).ilog2()) };
    if len == 0 || drives.is_empty() || responses.is_empty() {
        return Ok(vec![None; responses.len()]);
    }
    let most = EXCERPTS.min((PAIRED_EXCERPTS / (drives.len() * responses.len())).max(4));
    let ranges = spread(n, 2 * len, most);
    let welch = Welch { segment_len: len, overlap: 0.5, detrend: Detrend::Constant };
    for drives in drives.chunks(DRIVES) {
        for (group, responses) in responses.chunks(RESPONSES).enumerate() {
            let Some(sums) = summed(samples, drives, responses, &ranges, &welch, 0)? else { continue };
            for o in 0..responses.len() {
                for (i, &drive) in drives.iter().enumerate() {
                    let found = sums.delay(i, o, drive);
                    let best = &mut best[group * RESPONSES + o];
                    if let Some(found) = found
                        && best.is_none_or(|best| found.0 > best.0)
                    {
                        *best = Some(found);
                    }
                }
            }
        }
    }
    let open: Vec<usize> = (0..responses.len()).filter(|o| is_open(best[*o], len)).collect();
    let open_channels: Vec<usize> = open.iter().map(|o| responses[*o]).collect();
    for (&o, far) in open.iter().zip(far(samples, drives, &open_channels)?) {
        let Some(Far { drive, lag, .. }) = far else { continue };
        let ranges = spread(n - lag.unsigned_abs().min(n), 2 * len, EXCERPTS);
        if ranges.len() < FEWEST_FAR {
            continue;
        }
        let Some(sums) = summed(samples, &[drive], &[responses[o]], &ranges, &welch, lag)? else { continue };
        if let Some((share, delay)) = sums.delay(0, 0, drive)
            && best[o].is_none_or(|(near, _)| share > FARTHER * near)
        {
            best[o] = Some((share, Delay { samples: delay.samples + lag as f64, ..delay }));
        }
    }
    Ok(best.into_iter().map(|found| found.map(|(_, delay)| delay)).collect())
}

/// Whether a delay may be longer than what segments of `len` show: few lines are coherent, or none.
fn is_open(found: Option<(f64, Delay)>, len: usize) -> bool {
    found.is_none_or(|(_, delay)| delay.resolution > len as f64 / COARSE)
}

/// Spectra of some drives and responses over all excerpts, sums.
struct Sums {
    n_lines: usize,
    n_drives: usize,
    averages: f64,
    sxx: Vec<f64>,
    syx: Vec<Complex64>,
    syy: Vec<f64>,
}

/// Sums over excerpts of the drives at `ranges`, and of the responses `lag` samples later. Negative lags are those of the
/// drives, so that all of it lies in the run where the ranges leave out as many samples at its end.
fn summed(
    samples: &mut impl Samples,
    drives: &[usize],
    responses: &[usize],
    ranges: &[Range<usize>],
    welch: &Welch,
    lag: isize,
) -> io::Result<Option<Sums>> {
    let (lines, nx, ny) = (welch.n_lines(), drives.len(), responses.len());
    let mut sums = Sums {
        n_lines: lines,
        n_drives: nx,
        averages: 0.0,
        sxx: vec![0.0; lines * nx],
        syx: vec![Complex64::default(); lines * ny * nx],
        syy: vec![0.0; lines * ny],
    };
    let means = Means { x: vec![0.0; nx], y: vec![0.0; ny] };
    for ranges in ranges.chunks(AT_ONCE) {
        let mut parts: Vec<Vec<Vec<f64>>> = Vec::new();
        for range in ranges {
            let mut read = |channel: usize, later: isize| -> io::Result<Vec<f64>> {
                let mut part = Vec::with_capacity(range.len());
                let later = usize::try_from(later).unwrap_or(0);
                samples.read(channel, range.start + later..range.end + later, &mut part)?;
                Ok(part)
            };
            let mut part = Vec::with_capacity(nx + ny);
            for &drive in drives {
                part.push(read(drive, -lag)?);
            }
            for &response in responses {
                part.push(read(response, lag)?);
            }
            parts.push(part);
        }
        let records: Vec<Record<'_>> = parts
            .iter()
            .map(|part| {
                let (x, y) = part.split_at(nx);
                Record { x: x.iter().map(Vec::as_slice).collect(), y: y.iter().map(Vec::as_slice).collect() }
            })
            .collect();
        // Values whose squares overflow have no spectrum.
        let Ok(found) = cross_spectra(&records, &means, welch, samples.sample_rate_hz()) else {
            return Ok(None);
        };
        let weight = found.n_averages as f64;
        sums.averages += found.effective_averages;
        for line in 0..lines {
            for i in 0..nx {
                sums.sxx[line * nx + i] += weight * found.sxx[(line * nx + i) * nx + i].re;
            }
        }
        sums.syx.iter_mut().zip(&found.syx).for_each(|(sum, z)| *sum += z * weight);
        sums.syy.iter_mut().zip(&found.syy).for_each(|(sum, p)| *sum += p * weight);
    }
    Ok(Some(sums))
}

impl Sums {
    /// The delay of response `o` to drive `i`, and its weight among the drives: the coherent power.
    fn delay(&self, i: usize, o: usize, drive: usize) -> Option<(f64, Delay)> {
        let (lines, n_outputs) = (self.n_lines, self.syy.len() / self.n_lines);
        // Coherence that noise exceeds in one line with the false alarm probability: P(g^2 > c) = (1 - c)^(averages - 1).
        let by_chance = 1.0 - (FALSE_ALARM / lines as f64).powf(1.0 / (self.averages - 1.0).max(1.0));
        let len = 2 * (lines - 1);
        let mut spectrum = vec![Complex64::default(); lines];
        let (mut weights, mut squares, mut coherent_power, mut power, mut coherence, mut count) =
            (0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
        // DC and Nyquist have no phase.
        for (line, z) in spectrum.iter_mut().enumerate().take(lines - 1).skip(1) {
            let sxx = self.sxx[line * self.n_drives + i];
            let syy = self.syy[line * n_outputs + o];
            let syx = self.syx[(line * n_outputs + o) * self.n_drives + i];
            let squared = syx.norm_sqr() / (sxx * syy);
            power += syy;
            if !(squared.is_finite() && squared > by_chance) {
                continue;
            }
            let weight = squared.min(HIGHEST) / (1.0 - squared.min(HIGHEST));
            // Lines of no power have a coherence of rounding errors alone.
            let weight = weight.min(1.0 / (1.0 - HIGHEST));
            coherent_power += squared * syy;
            coherence += squared;
            count += 1.0;
            weights += weight;
            squares += weight * weight;
            *z = syx / syx.norm() * weight;
        }
        if count < 3.0 || power <= 0.0 {
            return None;
        }
        let bandwidth = weights * weights / squares;
        let envelope = envelope(&spectrum, len);
        let at = |lag: isize| envelope[lag.rem_euclid(len as isize) as usize];
        let reach = (len / 4) as isize;
        // Of equal lags the shortest.
        let lag = (-reach..=reach).min_by(|a, b| at(*b).total_cmp(&at(*a)).then(a.abs().cmp(&b.abs())))?;
        // A higher maximum beyond the reach: the delay is longer, and what is found here is its tail.
        let is_tail = envelope.iter().any(|far| *far > at(lag) / TAIL);
        if lag.abs() == reach || is_tail {
            return None;
        }
        let [before, top, after] = [at(lag - 1), at(lag), at(lag + 1)];
        let curve = before - 2.0 * top + after;
        let between = if curve < 0.0 { (0.5 * (before - after) / curve).clamp(-0.5, 0.5) } else { 0.0 };
        let found = lag as f64 + between;
        let delay =
            Delay { drive, samples: found, resolution: len as f64 / bandwidth, coherence: coherence / count };
        let finite = delay.samples.is_finite() && delay.resolution.is_finite();
        finite.then_some((coherent_power / power, delay))
    }
}

/// Magnitude of the analytic signal, `len` samples, whose spectrum above DC and below Nyquist is given.
pub(super) fn envelope(spectrum: &[Complex64], len: usize) -> Vec<f64> {
    let inverse = RealFftPlanner::new().plan_fft_inverse(len);
    let turned = |by: Complex64| -> Vec<f64> {
        let mut input: Vec<Complex64> = spectrum.iter().map(|z| z * by).collect();
        let mut output = inverse.make_output_vec();
        inverse
            .process(&mut input, &mut output)
            .expect("DC and Nyquist are zero, and buffers have the plan's size");
        output
    };
    let (real, imaginary) = (turned(Complex64::new(1.0, 0.0)), turned(Complex64::new(0.0, -1.0)));
    real.iter().zip(&imaginary).map(|(re, im)| re.hypot(*im)).collect()
}
