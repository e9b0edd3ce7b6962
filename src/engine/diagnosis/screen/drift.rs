//! From which frequency on an acceleration or a velocity is integrated.
//!
//! An integral makes the noise at low frequencies large, whatever its colour. What a displacement does there follows from
//! the drives as from a spring, alike over a band of some lines. In the lowest band in which such a spring explains more
//! than half of what was measured, its integral is cut where what it leaves no longer leads.

use std::f64::consts::TAU;

use realfft::num_complex::Complex64;
use rigcast_numerics::fft::RealFftPlanner;

use super::input::{Record, Recording};
use crate::diagnosis::numerics::linear::{dot, least_squares};

/// Lines of all records in a band, beside as many a drive: with fewer, noise would look explained by chance.
const LINES: usize = 8;
/// Share of the measured power that has to be explained.
const EXPLAINED: f64 = 0.5;

/// Frequency below which a response's integral, taken so many times, is not the drives' doing, Hz; of each record the
/// first `used` samples count. 0 where the drives explain no band up to `high_hz`.
pub(super) fn drifts_below(
    recording: &Recording,
    used: &[usize],
    response: usize,
    integrals: usize,
    high_hz: f64,
) -> f64 {
    let rate = recording.sample_rate_hz();
    let spectra: Vec<Spectra> = recording
        .records
        .iter()
        .zip(used)
        .filter(|(_, used)| **used > 2 * LINES)
        .map(|(record, &used)| Spectra::new(record, used, response, rate))
        .collect();
    let seconds: f64 = spectra.iter().map(|s| 1.0 / s.line_hz).sum();
    let drives = recording.drives.len();
    let lines = LINES * (drives + 1);
    let width = lines as f64 / seconds.max(f64::MIN_POSITIVE);
    // Bands overlap by a half. What a window makes of a mean and of a slope is in the first two lines.
    let lowest = spectra.iter().map(|s| 2.0 * s.line_hz).fold(0.0, f64::max);
    let mut bands =
        (0..).map(|i| lowest + 0.5 * width * f64::from(i)).take_while(|low| low + width <= high_hz);
    let follows = bands.find_map(|low| {
        let lines = split(&spectra, drives, integrals, [low, low + width]);
        let rows = lines.len() as f64;
        let left: f64 = lines.iter().map(|l| l.left).sum();
        let all: f64 = lines.iter().map(|l| l.measured).sum();
        // Noise is explained too, by one number a drive.
        let share = left / all.max(f64::MIN_POSITIVE) * rows / (rows - drives as f64).max(1.0);
        (1.0 - share > EXPLAINED).then_some(lines)
    });
    follows.map_or(0.0, |lines| cut(lines, integrals))
}

/// A line of a record: its power, and what drives leave of it.
struct Line {
    hz: f64,
    measured: f64,
    left: f64,
}

/// Where to cut so that least of the integral is lost of what drives explain and kept of what they do not, Hz.
fn cut(mut lines: Vec<Line>, integrals: usize) -> f64 {
    lines.sort_by(|a, b| a.hz.total_cmp(&b.hz));
    let of = |line: &Line| {
        let integral = line.hz.powi(-2 * integrals as i32);
        [(line.measured - line.left).max(0.0) * integral, line.left * integral]
    };
    let mut costs: f64 = lines.iter().map(|line| of(line)[1]).sum();
    let mut least = (costs, lines[0].hz);
    for (line, next) in lines.iter().zip(&lines[1..]) {
        let [explained, left] = of(line);
        costs += explained - left;
        if costs < least.0 {
            least = (costs, next.hz);
        }
    }
    least.1
}

/// Lines of a record's drives and response.
struct Spectra {
    line_hz: f64,
    drives: Vec<Vec<Complex64>>,
    response: Vec<Complex64>,
}

impl Spectra {
    fn new(record: &Record, used: usize, response: usize, rate_hz: f64) -> Self {
        let n = used - used % 2;
        let fft = RealFftPlanner::new().plan_fft_forward(n);
        let of = |x: &[f64]| -> Vec<Complex64> {
            let mean = x[..n].iter().sum::<f64>() / n as f64;
            let hann = |k: usize| 0.5 - 0.5 * (TAU * (k as f64 + 0.5) / n as f64).cos();
            let mut samples: Vec<f64> = (0..n).map(|k| (x[k] - mean) * hann(k)).collect();
            let mut lines = fft.make_output_vec();
            fft.process(&mut samples, &mut lines).expect("buffers are the plan's own");
            lines
        };
        Self {
            line_hz: rate_hz / n as f64,
            drives: record.drive.channels().iter().map(|u| of(u)).collect(),
            response: of(record.response.channel(response)),
        }
    }
}

/// The lines of a band, of which each drive explains what it can by one number for the integral.
fn split(spectra: &[Spectra], drives: usize, integrals: usize, [low, high]: [f64; 2]) -> Vec<Line> {
    let mut at = Vec::new();
    let mut measured = Vec::new();
    let mut columns = vec![Vec::new(); 2 * drives];
    for s in spectra {
        let first = (low / s.line_hz).ceil() as usize;
        let last = ((high / s.line_hz).ceil() as usize).min(s.response.len());
        for line in first..last {
            let hz = line as f64 * s.line_hz;
            at.push(hz);
            measured.extend([s.response[line].re, s.response[line].im]);
            // (2 pi i f)^n of the integral is what was measured.
            let gain = Complex64::new(0.0, hz).powi(integrals as i32);
            for (d, drive) in s.drives.iter().enumerate() {
                let u = drive[line] * gain;
                columns[2 * d].extend([u.re, u.im]);
                columns[2 * d + 1].extend([-u.im, u.re]);
            }
        }
    }
    let of: Vec<&[f64]> = columns.iter().map(Vec::as_slice).collect();
    let gains = least_squares(&of, &measured);
    let mut left = measured.clone();
    for (column, gain) in columns.iter().zip(gains) {
        left.iter_mut().zip(column).for_each(|(left, x)| *left -= gain * x);
    }
    let power = |of: &[f64]| dot(of, of);
    at.into_iter()
        .zip(measured.chunks(2).zip(left.chunks(2)))
        .map(|(hz, (measured, left))| Line { hz, measured: power(measured), left: power(left) })
        .collect()
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::StandardNormal;

    use super::*;
    use crate::diagnosis::screen::input::Channel;
    use crate::{Quantity, Signal};

    const RATE: f64 = 200.0;

    /// An oscillator of 8 Hz under a noise drive, its acceleration with white or with slow noise.
    fn recording(white: f64, slow: f64) -> Recording {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let mut noise = || -> f64 { rng.sample(StandardNormal) };
        let n = 6000;
        let (mut u, mut y, mut wander) = (Vec::new(), Vec::new(), 0.0);
        let (mut d, mut v, mut drive) = (0.0, 0.0, 0.0);
        let (w, h) = (TAU * 8.0, 1.0 / (10.0 * RATE));
        for _ in 0..n {
            drive = 0.6 * drive + noise();
            let mut a = 0.0;
            for _ in 0..10 {
                a = w * w * (drive - d) - 0.1 * w * v;
                v += h * a;
                d += h * v;
            }
            wander = 0.99 * wander + noise();
            u.push(drive);
            y.push(a / (w * w) + white * noise() + slow * wander);
        }
        let channel = |quantity| Channel { name: "c".into(), quantity };
        let signal = |x| Signal::new(RATE, vec![x]).unwrap();
        let record = Record { drive: signal(u), response: signal(y), added: None, started_s: 0.0 };
        Recording {
            drives: vec![channel(Quantity::Force)],
            responses: vec![channel(Quantity::Acceleration)],
            records: vec![record],
        }
    }

    fn below(white: f64, slow: f64, integrals: usize) -> f64 {
        drifts_below(&recording(white, slow), &[6000], 0, integrals, 60.0)
    }

    #[test]
    fn an_acceleration_is_integrated_from_where_its_noise_no_longer_leads() {
        let [quiet, loud] = [below(0.003, 0.0, 2), below(0.1, 0.0, 2)];
        assert!(quiet < loud && loud > 1.0 && loud < 6.0, "{quiet} {loud}");
        assert!(below(0.0, 0.0, 2) < 0.2, "nothing is cut without noise");
        assert!(below(0.1, 0.0, 1) < 6.0, "a velocity is integrated once");
    }

    #[test]
    fn noise_of_any_colour_is_left_out() {
        let slow = below(0.0, 0.02, 2);
        assert!(slow > 0.8 && slow < 6.0, "{slow}");
    }

    #[test]
    fn drives_that_explain_nothing_set_no_limit() {
        let mut other = recording(0.0, 0.0);
        other.records[0].drive = recording(0.0, 1.0).records[0].drive.slice(100..6000);
        other.records[0].response = other.records[0].response.slice(0..5900);
        assert_eq!(drifts_below(&other, &[5900], 0, 2, 60.0), 0.0);
    }
}
