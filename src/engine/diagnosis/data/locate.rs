//! Where the gap lies: by response, band, amplitude, velocity and time.
//!
//! Power is the product of two repeats' errors, not a square: noise, which differs between
//! repeats, then cancels on average instead of passing for gap. Without repeats the noise's power
//! is taken off.

use realfft::num_complex::Complex64;
use rigcast_numerics::fft::RealFftPlanner;

use super::noise::Noise;
use super::problem::{Problem, Stretch};
use crate::diagnosis::numerics::linear::{dot, rms};
use crate::diagnosis::report::{BandShare, RangeShare, SegmentChi2};

/// Ranges of amplitude and of velocity.
const RANGES: usize = 5;
/// Level of what is not there, dB.
const LOWEST_DB: f64 = -120.0;
/// Bands per response, even in the logarithm of frequency.
const BANDS: usize = 8;

/// Two errors whose product counts, or one with its noise to be taken off.
struct Pair<'a> {
    stretch: &'a Stretch,
    a: Vec<f64>,
    b: Option<Vec<f64>>,
}

/// Systematic and noise power of one response.
pub struct Power {
    /// Mean systematic power in band, unit^2; may be slightly negative where there is no gap.
    pub systematic: f64,
    /// Noise power in band, unit^2.
    pub noise: f64,
    /// Power of the measured response in band, unit^2.
    pub response: f64,
    /// RMS of what the sim leaves, in band.
    pub rms_error: f64,
}

impl Power {
    /// RMS of the measured response in band, never 0: errors are relative to it.
    pub fn level(&self) -> f64 {
        self.response.max(f64::MIN_POSITIVE).sqrt()
    }
}

/// Errors of a prediction on each stretch, paired with those of its repeat.
fn pairs<'a>(stretches: &'a [Stretch], errors: &[Vec<f64>]) -> Vec<Pair<'a>> {
    let mut used = vec![false; stretches.len()];
    let mut out = Vec::new();
    for i in 0..stretches.len() {
        if used[i] {
            continue;
        }
        let twin = (i + 1..stretches.len()).find(|&j| {
            !used[j] && stretches[j].group == stretches[i].group && errors[j].len() == errors[i].len()
        });
        if let Some(j) = twin {
            used[j] = true;
        }
        let lead = stretches[i].lead;
        out.push(Pair {
            stretch: &stretches[i],
            a: errors[i][lead..].to_vec(),
            b: twin.map(|j| errors[j][lead..].to_vec()),
        });
    }
    out
}

/// Power in band of what is left, `[stretch][sample]`.
pub fn power(
    problem: &Problem,
    stretches: &[Stretch],
    errors: &[Vec<f64>],
    noise: &Noise,
    band: [f64; 2],
) -> Power {
    let floor = noise.ar.mean_power(band) * 2.0 * (band[1] - band[0]);
    let (mut systematic, mut response, mut error, mut total) = (0.0, 0.0, 0.0, 0.0);
    for pair in pairs(stretches, errors) {
        let rows = &pair.stretch.rows;
        let n = rows.samples() as f64 * rows.taper_power();
        let a = rows.in_band(&pair.a);
        let own = dot(&a, &a);
        // A rig that changes in time leaves more of the one repeat than of the other.
        let (product, square) = match pair.b.as_ref().map(|b| rows.in_band(b)) {
            Some(b) => (dot(&a, &b), 0.5 * (own + dot(&b, &b))),
            None => (own - floor * n, own),
        };
        let moved: Vec<f64> =
            pair.stretch.measured[pair.stretch.lead..].iter().map(|y| y - problem.scales.y_mean).collect();
        let y = rows.in_band(&moved);
        systematic += product;
        response += dot(&y, &y);
        error += square;
        total += n;
    }
    Power {
        systematic: systematic / total,
        noise: floor,
        response: response / total,
        rms_error: (error / total).sqrt(),
    }
}

/// Shares by band.
pub fn bands(
    channel: &str,
    stretches: &[Stretch],
    errors: &[Vec<f64>],
    noise: &Noise,
    band: [f64; 2],
    rate_hz: f64,
) -> Vec<BandShare> {
    let low = band[0].max(band[1] / 64.0);
    let mut edges: Vec<f64> =
        (0..=BANDS).map(|k| low * (band[1] / low).powf(k as f64 / BANDS as f64)).collect();
    edges[0] = band[0];
    let (mut systematic, mut response, mut samples) = (vec![0.0; BANDS], vec![0.0; BANDS], 0.0);
    for pair in pairs(stretches, errors) {
        let n = pair.stretch.rows.samples();
        let (a, y) = (spectrum(&pair.a, n), spectrum(&pair.stretch.measured[pair.stretch.lead..], n));
        let b = pair.b.as_ref().map(|b| spectrum(b, n));
        samples += n as f64;
        for (line, (a, y)) in a.iter().zip(&y).enumerate() {
            let f = line as f64 / n as f64;
            let Some(k) = (0..BANDS).find(|&k| f >= edges[k] && f < edges[k + 1]) else { continue };
            let floor = noise.ar.power(f) * 2.0;
            systematic[k] += b.as_ref().map_or(a.norm_sqr() - floor, |b| (a * b[line].conj()).re);
            response[k] += y.norm_sqr();
        }
    }
    let total: f64 = systematic.iter().map(|s| s.max(0.0)).sum();
    // A band without spectral lines, or without a response, has neither gap nor noise.
    let db = |power: f64, of: f64| if of > 0.0 { 10.0 * (power / of).max(1e-12).log10() } else { LOWEST_DB };
    (0..BANDS)
        .map(|k| {
            let width = edges[k + 1] - edges[k];
            let noise = noise.ar.mean_power([edges[k], edges[k + 1]]) * 2.0 * width * samples;
            BandShare {
                channel: channel.to_owned(),
                from_hz: edges[k] * rate_hz,
                to_hz: edges[k + 1] * rate_hz,
                share_of_gap: if total > 0.0 { systematic[k].max(0.0) / total } else { 0.0 },
                systematic_db: db(systematic[k].max(0.0), response[k]),
                noise_db: db(noise, response[k]),
            }
        })
        .collect()
}

/// Hann-windowed one-sided lines whose squares add up to the power of `n` samples.
fn spectrum(x: &[f64], n: usize) -> Vec<Complex64> {
    let fft = RealFftPlanner::new().plan_fft_forward(n);
    let mean = x[..n].iter().sum::<f64>() / n as f64;
    let mut input: Vec<f64> = x[..n]
        .iter()
        .enumerate()
        .map(|(i, x)| (x - mean) * (1.0 - (std::f64::consts::TAU * (i as f64 + 0.5) / n as f64).cos()))
        .collect();
    let mut lines = fft.make_output_vec();
    fft.process(&mut input, &mut lines).expect("buffers are the plan's own");
    // The window's mean square is 1.5; each line stands for its conjugate too.
    let scale = (2.0 / (1.5 * n as f64)).sqrt();
    lines.iter_mut().for_each(|z| *z *= scale);
    lines
}

/// Shares by magnitude of the sim's response, or of its change per sample.
pub fn ranges(
    channel: &str,
    problem: &Problem,
    stretches: &[Stretch],
    errors: &[Vec<f64>],
    noise: &Noise,
    band: [f64; 2],
    velocity: bool,
) -> Vec<RangeShare> {
    let floor = noise.ar.mean_power(band) * 2.0 * (band[1] - band[0]);
    let mut points: Vec<(f64, f64)> = Vec::new();
    for pair in pairs(stretches, errors) {
        let rows = &pair.stretch.rows;
        let a = rows.in_band(&pair.a);
        let b = pair.b.as_ref().map(|b| rows.in_band(b));
        let simulated = &pair.stretch.simulated[problem.response][pair.stretch.lead..];
        for k in 1..a.len() {
            let size =
                if velocity { simulated[k] - simulated[k - 1] } else { simulated[k] - problem.scales.y_mean };
            points.push((size.abs(), b.as_ref().map_or(a[k] * a[k] - floor, |b| a[k] * b[k])));
        }
    }
    let largest = points.iter().map(|p| p.0).fold(0.0, f64::max).max(f64::MIN_POSITIVE);
    let mut sums = [0.0; RANGES];
    for (size, power) in points {
        sums[((size / largest * RANGES as f64) as usize).min(RANGES - 1)] += power;
    }
    let total: f64 = sums.iter().map(|s| s.max(0.0)).sum();
    (0..RANGES)
        .map(|k| RangeShare {
            channel: channel.to_owned(),
            from: k as f64 / RANGES as f64,
            to: (k + 1) as f64 / RANGES as f64,
            share_of_gap: if total > 0.0 { sums[k].max(0.0) / total } else { 0.0 },
        })
        .collect()
}

/// Error by second.
pub fn segments(
    channel: &str,
    names: &[String],
    stretches: &[Stretch],
    errors: &[Vec<f64>],
    rate_hz: f64,
) -> Vec<SegmentChi2> {
    let mut out = Vec::new();
    for (stretch, error) in stretches.iter().zip(errors) {
        let white = stretch.rows.whitened(&error[stretch.lead..]);
        let per_sample = stretch.rows.len() as f64 / white.len() as f64;
        let len = (rate_hz as usize).clamp(1, white.len());
        for (k, part) in white.chunks(len).enumerate() {
            let from = (stretch.from + stretch.lead + k * len) as f64 / rate_hz;
            out.push(SegmentChi2 {
                run: names[stretch.run].clone(),
                channel: channel.to_owned(),
                from_s: from,
                to_s: from + part.len() as f64 / rate_hz,
                chi2: rms(part).powi(2) / per_sample,
            });
        }
    }
    out
}
