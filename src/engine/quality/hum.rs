//! Mains hum: lines at 50 or 60 Hz and their harmonics that stand over the neighbouring spectrum and that no drive explains.
//!
//! A line is a tone. In the Hann-windowed spectrum of a segment its power is in three lines of the
//! spectrum, is the same in every segment, and stands over both sides. A resonance under noise is broader, and the power in its
//! middle scatters from segment to segment as the square of a Gaussian amplitude does. A line that a drive has as well
//! is the drive's. Where most of a drive's power is in lines (a sine, a short cycle), a nonlinear rig makes lines of
//! its own anywhere, and hum is not judged.

use std::io;

use serde::{Deserialize, Serialize};

use super::excerpt::spread;
use crate::Samples;
use crate::spectral::{Detrend, Welch, psd_of_parts};

/// Segments: at most so many, and no fewer than [`FEWEST`], below which constant and scattered power cannot be told apart.
const MOST: usize = 32;
/// See [`MOST`] and [`SCATTER`].
const FEWEST: usize = 16;
/// Samples of all segments of a channel; with it, high sample rates have fewer segments.
const SAMPLES: usize = 1 << 20;
/// Length of a segment: lines at most so far apart, Hz. The mains frequency wanders by 0.1 Hz.
const LINE_HZ: f64 = 0.5;
/// Harmonics looked at, the fundamental included.
const HARMONICS: usize = 10;
/// Half the lines that a tone fills, and the lines on each side that it is compared with.
const LOBE: usize = 3;
const SIDE: usize = 16;
/// A line stands over both sides by a factor of ten at least: spectra of rigs rise and fall by as much within a few hertz
/// at a resonance. The mean power of 16 segments of noise is ten times its expectation with a probability of 1e-46
/// (Chernoff), so that white noise makes no lines.
const STANDS: f64 = 10.0;
/// Mean of the squared power over the square of its mean: 1 for a tone, 2 for noise. A tone with ten times
/// the noise has 1.17. Noise passes with a probability of 5e-4 in 16 segments, besides standing as a line.
const SCATTER: f64 = 1.2;
/// Hum is not judged in a run whose drives repeat within so many seconds: its lines lie so far apart that a resonance holds
/// one alone.
const SHORT_PERIOD_S: f64 = 10.0;
/// Share of a drive's power in lines from which hum is not judged.
const TONAL: f64 = 0.5;

/// Frequencies of the mains, Hz.
const MAINS_HZ: [f64; 2] = [50.0, 60.0];

/// Mains hum of one channel.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Hum {
    /// Frequency of the fundamental, Hz; `None` without hum.
    pub mains_hz: Option<f64>,
    /// Frequencies of the lines that were found, Hz, ascending.
    pub lines_hz: Vec<f64>,
    /// RMS of all lines over the standard deviation of the channel, 0..=1.
    pub share: f64,
}

/// Spectrum of a channel.
struct Lines {
    df_hz: f64,
    /// Mean power of each line.
    mean: Vec<f64>,
    /// Mean of the squared power over the square of the mean, of each line.
    scatter: Vec<f64>,
}

impl Lines {
    fn read(samples: &mut impl Samples, channel: usize) -> io::Result<Option<Self>> {
        let rate = samples.sample_rate_hz();
        let len = ((rate / LINE_HZ).ceil().clamp(64.0, 1e9) as usize).next_power_of_two();
        let ranges = spread(samples.n_samples(), len, MOST.min(SAMPLES / len));
        if ranges.len() < FEWEST {
            return Ok(None);
        }
        let welch = Welch { segment_len: len, overlap: 0.0, detrend: Detrend::Constant };
        let (mut mean, mut square) = (vec![0.0; welch.n_lines()], vec![0.0; welch.n_lines()]);
        let mut part = Vec::with_capacity(len);
        for range in &ranges {
            part.clear();
            samples.read(channel, range.clone(), &mut part)?;
            // Values whose squares overflow have no spectrum.
            let Ok(spectrum) = psd_of_parts(&[vec![&part]], rate, &welch) else { return Ok(None) };
            for ((mean, square), power) in mean.iter_mut().zip(&mut square).zip(&spectrum.density[0]) {
                *mean += power / ranges.len() as f64;
                *square += power * power / ranges.len() as f64;
            }
        }
        let scatter =
            mean.iter().zip(&square).map(|(m, s)| if *m > 0.0 { s / (m * m) } else { 2.0 }).collect();
        Ok(Some(Self { df_hz: rate / len as f64, mean, scatter }))
    }

    /// Power in the lobe of a line over that of as many lines beside it, the higher side; and that of the line alone,
    /// unit^2. Zero where there are no lines on both sides.
    fn stands(&self, line: usize) -> (f64, f64) {
        if line < LOBE + SIDE || line + LOBE + SIDE >= self.mean.len() {
            return (0.0, 0.0);
        }
        let median = |range: std::ops::Range<usize>| super::quantile(&mut self.mean[range].to_vec(), 0.5);
        let floor =
            median(line - LOBE - SIDE..line - LOBE).max(median(line + LOBE + 1..line + LOBE + SIDE + 1));
        let power: f64 = self.mean[line - LOBE + 1..line + LOBE].iter().sum();
        let over = (power - floor * (2 * LOBE - 1) as f64).max(0.0);
        // The shoulders of a tone lie 30 dB below it; those of a resonance do not.
        let shoulders = self.mean[line - LOBE].max(self.mean[line + LOBE]);
        let ratio = self.mean[line] / floor.max(shoulders / 2.0).max(f64::MIN_POSITIVE);
        (ratio, over * self.df_hz)
    }

    /// The line of the most power within 0.2 Hz of a frequency and at least one line.
    fn near(&self, hz: f64) -> Option<usize> {
        let middle = (hz / self.df_hz).round() as usize;
        let wide = ((0.2 * hz / 50.0 / self.df_hz).ceil() as usize).min(LOBE);
        let range = middle.checked_sub(wide)?..middle + wide + 1;
        if range.end > self.mean.len() {
            return None;
        }
        range.max_by(|&a, &b| self.mean[a].total_cmp(&self.mean[b]))
    }

    /// Share of the power that stands in lines.
    fn tonal(&self) -> f64 {
        let total = self.mean.iter().sum::<f64>() * self.df_hz;
        let peak =
            |line: &usize| self.mean[*line] >= self.mean[line - 1] && self.mean[*line] > self.mean[line + 1];
        let lines = (LOBE..self.mean.len().saturating_sub(LOBE)).filter(peak);
        let power: f64 = lines
            .filter_map(|line| {
                // A low tone has few lines below it: here one side is enough.
                let above = line + LOBE + 1..(line + LOBE + SIDE + 1).min(self.mean.len());
                let below = line.saturating_sub(LOBE + SIDE)..line - LOBE;
                let median =
                    |range: std::ops::Range<usize>| super::quantile(&mut self.mean[range].to_vec(), 0.5);
                let floor = median(above).max(median(below));
                let tone = self.mean[line] > STANDS * floor && self.scatter[line] < SCATTER;
                tone.then(|| self.mean[line - LOBE + 1..line + LOBE].iter().sum::<f64>() * self.df_hz)
            })
            .sum();
        if total > 0.0 { power / total } else { 0.0 }
    }
}

/// Finds hum in the responses of a run.
pub struct MainsFinder {
    drives: Vec<Lines>,
    /// Segments are long and many enough, and the drives leave something to judge.
    judges: bool,
}

impl MainsFinder {
    /// Reads the run's drives that move. `has_drives` says whether the run has any at all: without its drives, a line of a
    /// response cannot be told from what drove it. `period_s` is the time within which the drives repeat.
    ///
    /// # Errors
    /// Those of the file that holds the samples.
    pub fn new(
        samples: &mut impl Samples,
        drives: &[usize],
        has_drives: bool,
        period_s: Option<f64>,
    ) -> io::Result<Self> {
        if !has_drives || period_s.is_some_and(|period| period < SHORT_PERIOD_S) {
            return Ok(Self { drives: Vec::new(), judges: false });
        }
        let mut found = Vec::new();
        for &drive in drives {
            match Lines::read(samples, drive)? {
                Some(lines) => found.push(lines),
                None => return Ok(Self { drives: Vec::new(), judges: false }),
            }
        }
        let judges = found.iter().all(|lines| lines.tonal() < TONAL);
        Ok(Self { drives: found, judges })
    }

    /// Hum of a response; `None` where it cannot be judged: fewer than `FEWEST` segments of 2 s (or a little more), no
    /// drive in the run, a drive of lines or of a short period.
    ///
    /// # Errors
    /// Those of the file that holds the samples.
    pub fn find(&self, samples: &mut impl Samples, response: usize) -> io::Result<Option<Hum>> {
        if !self.judges {
            return Ok(None);
        }
        let Some(lines) = Lines::read(samples, response)? else { return Ok(None) };
        let total = lines.mean.iter().sum::<f64>() * lines.df_hz;
        if !(total > 0.0 && total.is_finite()) {
            return Ok(None);
        }
        let of = |mains_hz: f64| {
            let found: Vec<(f64, f64)> = (1..=HARMONICS)
                .filter_map(|k| lines.near(k as f64 * mains_hz))
                .filter(|&line| self.is_hum(&lines, line))
                .map(|line| (line as f64 * lines.df_hz, lines.stands(line).1))
                .collect();
            (mains_hz, found)
        };
        let power = |found: &[(f64, f64)]| found.iter().map(|(_, power)| power).sum::<f64>();
        let (mains_hz, found) =
            MAINS_HZ.map(of).into_iter().max_by(|(_, a), (_, b)| power(a).total_cmp(&power(b))).expect("two");
        let share = (power(&found) / total).clamp(0.0, 1.0).sqrt();
        Ok(Some(Hum {
            mains_hz: (!found.is_empty()).then_some(mains_hz),
            lines_hz: found.iter().map(|(hz, _)| *hz).collect(),
            share: if found.is_empty() { 0.0 } else { share },
        }))
    }

    fn is_hum(&self, lines: &Lines, line: usize) -> bool {
        let drive_has_it = |drive: &Lines| {
            let near = line - 1..(line + 2).min(drive.mean.len());
            near.into_iter().any(|line| drive.stands(line).0 > STANDS.sqrt())
        };
        lines.stands(line).0 > STANDS
            && lines.scatter[line] < SCATTER
            && !self.drives.iter().any(drive_has_it)
    }
}
