//! From which frequency on an acceleration or a velocity is integrated.
//!
//! An integral makes the noise at low frequencies large, whatever its colour, and so what its unknown beginning and end
//! leave of it. What a displacement does there follows from the drives as from a spring, alike over a band of some lines.
//! In the lowest band in which such a spring explains more than half of what was measured, its integral is cut where what
//! it leaves no longer leads.

use rayon::prelude::*;
use realfft::num_complex::Complex64;

use super::input::Recording;
use super::motion::Limits;
use crate::Quantity;
use crate::diagnosis::numerics::hann::Hann;
use crate::diagnosis::numerics::linear::{dot, least_squares};

/// Lines of all records in a band, beside as many a drive: with fewer, noise would look explained by chance.
const LINES: usize = 8;
/// Share of the measured power that has to be explained.
const EXPLAINED: f64 = 0.5;
/// How often more is cut.
const ROUNDS: usize = 5;

/// What drives do at each frequency, to say what of a response follows from them.
pub(super) struct Drives<'a> {
    recording: &'a Recording,
    /// Of the records that are long enough.
    records: Vec<Lines>,
    /// Highest frequency that is looked at, Hz.
    highest: f64,
    /// Width of a band, Hz.
    width: f64,
}

/// Lines of a record's drives.
struct Lines {
    record: usize,
    /// Samples of it that count.
    samples: usize,
    line_hz: f64,
    /// `[drive][line]`.
    drives: Vec<Vec<Complex64>>,
}

impl<'a> Drives<'a> {
    /// Of each record the first `used` samples count.
    pub fn new(recording: &'a Recording, used: &[usize], high_hz: f64) -> Self {
        let rate = recording.sample_rate_hz();
        let highest = high_hz.min(0.5 * rate);
        let long = recording.records.iter().zip(used).enumerate().filter(|(_, (_, used))| **used > 2 * LINES);
        let records: Vec<Lines> = long
            .map(|(record, (of, &used))| {
                let samples = used - used % 2;
                let line_hz = rate / samples as f64;
                let drives =
                    of.drive.channels().par_iter().map(|u| lines(&u[..samples], line_hz, highest)).collect();
                Lines { record, samples, line_hz, drives }
            })
            .collect();
        let seconds: f64 = records.iter().map(|of| 1.0 / of.line_hz).sum();
        let width = (LINES * (recording.drives.len() + 1)) as f64 / seconds.max(f64::MIN_POSITIVE);
        Self { recording, records, highest, width }
    }

    /// Frequency from which on a displacement that is integrated from a quantity is the drives' doing, Hz: no lower than
    /// that of `limits`, which stands where they explain no band of it. `displacement` says it of a record inside limits.
    pub fn explain_from(
        &self,
        quantity: Quantity,
        limits: Limits,
        displacement: impl Fn(usize, Limits) -> Vec<f64>,
    ) -> f64 {
        let mut low_hz = limits.low_hz;
        // What is cut takes its ends with it, and the next band may be explained no more.
        for _ in 0..ROUNDS {
            let inside = Limits { low_hz, ..limits };
            let next = self.explained_from(quantity, inside, |record| displacement(record, inside));
            if next <= low_hz {
                break;
            }
            low_hz = next;
        }
        low_hz
    }

    /// The same, by the integral inside the limits as they are.
    fn explained_from(
        &self,
        quantity: Quantity,
        limits: Limits,
        displacement: impl Fn(usize) -> Vec<f64>,
    ) -> f64 {
        let integrals = quantity.integrals() as i32;
        let of_record = |of: &Lines| lines(&displacement(of.record)[..of.samples], of.line_hz, self.highest);
        let responses: Vec<Vec<Complex64>> = self.records.iter().map(of_record).collect();
        let (drives, width) = (self.recording.drives.len(), self.width);
        // Bands overlap by a half. What a window makes of a mean and of a slope is in the first two lines.
        let lowest = self.records.iter().map(|of| 2.0 * of.line_hz).fold(limits.low_hz, f64::max);
        let mut bands =
            (0..).map(|i| lowest + 0.5 * width * f64::from(i)).take_while(|low| low + width <= self.highest);
        let follows = bands.find_map(|low| {
            let band = self.split(&responses, integrals, [low, low + width]);
            let rows = band.len() as f64;
            let left: f64 = band.iter().map(|l| l.left).sum();
            let all: f64 = band.iter().map(|l| l.measured).sum();
            // Noise is explained too, by one number a drive.
            let left = left * rows / (rows - drives as f64).max(1.0);
            (left < (1.0 - EXPLAINED) * all).then_some(band)
        });
        follows.map_or(limits.low_hz, |band| cut(band, integrals))
    }

    /// The lines of a band, of which each drive explains what it can by one number for the integral.
    fn split(&self, responses: &[Vec<Complex64>], integrals: i32, [low, high]: [f64; 2]) -> Vec<Line> {
        let mut at = Vec::new();
        let mut measured = Vec::new();
        let mut columns = vec![Vec::new(); 2 * self.recording.drives.len()];
        for (of, response) in self.records.iter().zip(responses) {
            let first = (low / of.line_hz).ceil() as usize;
            let last = ((high / of.line_hz).ceil() as usize).min(response.len());
            for line in first..last {
                let hz = line as f64 * of.line_hz;
                at.push(hz);
                // (2 pi i f)^n of the integral is what was measured.
                let gain = Complex64::new(0.0, hz).powi(integrals);
                let y = response[line] * gain;
                measured.extend([y.re, y.im]);
                for (d, drive) in of.drives.iter().enumerate() {
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
}

/// Lines of a signal up to a frequency.
fn lines(x: &[f64], line_hz: f64, highest: f64) -> Vec<Complex64> {
    let mut lines = Hann::new(x.len()).lines(x);
    lines.truncate((highest / line_hz) as usize + 1);
    lines.shrink_to_fit();
    lines
}

/// A line of a record: its power, and what drives leave of it.
struct Line {
    hz: f64,
    measured: f64,
    left: f64,
}

/// Where to cut so that least of the integral is lost of what drives explain and kept of what they do not, Hz.
fn cut(mut lines: Vec<Line>, integrals: i32) -> f64 {
    lines.sort_by(|a, b| a.hz.total_cmp(&b.hz));
    let of = |line: &Line| {
        let integral = line.hz.powi(-2 * integrals);
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

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::StandardNormal;

    use super::*;
    use crate::Signal;
    use crate::diagnosis::screen::input::{Channel, Record};
    use crate::diagnosis::screen::motion::displacement;

    const RATE: f64 = 200.0;
    const LOW_HZ: f64 = 2.0 * RATE / 6000.0;

    /// An oscillator of 8 Hz under a noise drive, its acceleration with white or with slow noise.
    fn recording(white: f64, slow: f64, seed: u64) -> Recording {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
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
        let channel = |quantity| Channel { name: "c".into(), quantity, size: None };
        let signal = |x| Signal::new(RATE, vec![x]).unwrap();
        let record = Record { drive: signal(u), response: signal(y), added: None, started_s: 0.0 };
        Recording {
            drives: vec![channel(Quantity::Force)],
            responses: vec![channel(Quantity::Acceleration)],
            records: vec![record],
        }
    }

    fn from(of: &Recording, high_hz: f64) -> f64 {
        let limits = Limits { low_hz: LOW_HZ, high_hz: 100.0 };
        let quantity = of.responses[0].quantity;
        let integral = |record: usize, limits| {
            displacement(of.records[record].response.channel(0), quantity, RATE, limits)
        };
        Drives::new(of, &[6000], high_hz).explain_from(quantity, limits, integral)
    }

    fn of(white: f64, slow: f64, quantity: Quantity) -> f64 {
        let mut recording = recording(white, slow, 3);
        recording.responses[0].quantity = quantity;
        from(&recording, 60.0)
    }

    #[test]
    fn an_acceleration_is_integrated_from_where_its_noise_no_longer_leads() {
        // In the little noise the unknown ends lead; the drives do as much as the much noise at 5 Hz.
        let [little, much] = [0.003, 1.0].map(|white| of(white, 0.0, Quantity::Acceleration));
        assert!(little > LOW_HZ && little < 2.0, "{little}");
        assert!(much > 2.0 && much < 8.0, "{much}");
        assert!(of(0.1, 0.0, Quantity::Velocity) < 6.0, "a velocity is integrated once");
    }

    #[test]
    fn noise_of_any_colour_is_left_out() {
        let slow = of(0.0, 0.02, Quantity::Acceleration);
        assert!(slow > 0.8 && slow < 6.0, "{slow}");
    }

    #[test]
    fn drives_that_explain_nothing_set_no_limit() {
        let mut other = recording(0.0, 0.0, 3);
        other.records[0].drive = recording(0.0, 0.0, 4).records[0].drive.clone();
        assert_eq!(from(&other, 60.0), LOW_HZ);
        assert_eq!(from(&other, 2.0 * RATE), LOW_HZ, "nor beyond half of the rate");
        other.records[0].response = Signal::new(RATE, vec![vec![0.0; 6000]]).unwrap();
        assert_eq!(from(&other, 60.0), LOW_HZ, "nor where nothing moves");
    }
}
