//! Quality figures of a run: levels of its channels, faults of its measurement, and warnings in words that say what
//! each means for a fit.

#[cfg(test)]
mod false_alarms;
#[cfg(test)]
mod faults;
mod of_runs;
mod sentences;

use std::collections::HashMap;
use std::io;

use serde::{Deserialize, Serialize};

pub use of_runs::faults_of_runs;

use super::rig::Role;
use crate::engine::quality::{self, Dropouts, Excerpts, Hum, MainsFinder, Quantisation, Scan, Spikes};
use crate::engine::samples::{Samples, are_equal, each_block};

/// A channel counts as clipped when it stays this many samples or more at one of its extremes.
pub const CLIPPED_FROM_SAMPLES: u64 = 3;

/// An offset is told when the mean is further than this many standard deviations from zero.
pub const OFFSET_FROM_DEVIATIONS: f64 = 3.0;

/// Figures of one channel, in its unit. Those that may be `None` are `None` too for runs that were stored before they
/// were found, for constant channels and for runs that are too short.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct ChannelQuality {
    /// Name.
    pub channel: String,
    /// Smallest value.
    pub min: f64,
    /// Largest value.
    pub max: f64,
    /// Mean.
    pub mean: f64,
    /// Standard deviation (of the samples, divided by their number).
    pub std: f64,
    /// Root mean square.
    pub rms: f64,
    /// Largest absolute value / RMS; `None` for a channel of zeros.
    pub peak_to_rms: Option<f64>,
    /// Whether every sample has the same value.
    pub dead: bool,
    /// Samples of the longest span at the smallest or largest value.
    pub longest_at_extreme: u64,
    /// Share of all samples in such spans of [`CLIPPED_FROM_SAMPLES`] or more, 0..=1.
    pub clipped_share: f64,
    /// Spikes.
    #[serde(default)]
    pub spikes: Option<Spikes>,
    /// Drop-outs of a response. A drive may hold its value by command, and has none.
    #[serde(default)]
    pub dropouts: Option<Dropouts>,
    /// Mains hum of a response; `None` where it cannot be judged ([`MainsFinder::find`]).
    #[serde(default)]
    pub hum: Option<Hum>,
    /// Steps of its values; `None` if they are on no common steps ([`Quantisation::of`]).
    #[serde(default)]
    pub quantisation: Option<Quantisation>,
    /// Delay of a response; `None` where no drive is coherent with it.
    #[serde(default)]
    pub delay: Option<ResponseDelay>,
}

/// Delay of a response to the drive that it follows most ([`quality::Delay`]).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ResponseDelay {
    /// Name of that drive.
    pub drive: String,
    /// Delay, ms; negative where the response is ahead of the drive.
    pub delay_ms: f64,
    /// Resolution, ms.
    pub resolution_ms: f64,
    /// Coherence with that drive, averaged over the band.
    pub coherence: f64,
}

/// Repeats of a cyclic drive ([`quality::Repeats`]).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DriveRepeats {
    /// Length of a period, s.
    pub period_s: f64,
    /// The same in samples.
    pub period_samples: u64,
    /// Whole periods in the run, at least two.
    pub count: u64,
    /// RMS by which a period of the drives differs from the next / sqrt(2) / standard deviation: the worst drive.
    pub drives_differ: f64,
    /// The same of each response that moves: its noise over its signal, a floor of the error of any model.
    pub responses: Vec<ResponseNoise>,
}

/// Noise of a response between repeats of its drives.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ResponseNoise {
    /// Name.
    pub channel: String,
    /// Noise over signal, RMS.
    pub noise_share: f64,
}

/// Figures of a run.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Quality {
    /// One entry a channel, in the run's order.
    pub channels: Vec<ChannelQuality>,
    /// Constant channels.
    pub dead_channels: Vec<String>,
    /// Channels that look clipped.
    pub clipped_channels: Vec<String>,
    /// Repeats of the drives; `None` if they do not repeat.
    #[serde(default)]
    pub repeats: Option<DriveRepeats>,
    /// Warnings, a sentence each: constant channels, clipping
    /// ([`CLIPPED_FROM_SAMPLES`]), offsets ([`OFFSET_FROM_DEVIATIONS`]), channels that repeat another one, spikes,
    /// drop-outs, hum, coarse steps, delays, and responses that do not repeat with their drives.
    /// Empty too for runs that were stored before there were warnings.
    #[serde(default)]
    pub warnings: Vec<String>,
    /// Facts that are no faults but matter for a fit, a sentence each: repeats of the drives.
    #[serde(default)]
    pub notes: Vec<String>,
}

impl Quality {
    /// The figures of every channel of `samples`; `names` and `roles` in their order. Every channel is read four times,
    /// and excerpts of it that do not grow with the run.
    ///
    /// # Errors
    /// Those of the file that holds the samples.
    pub fn assess(names: &[String], roles: &[Role], samples: &mut impl Samples) -> io::Result<Self> {
        let assessed: Vec<(ChannelQuality, Clipping)> = names
            .iter()
            .enumerate()
            .map(|(channel, name)| ChannelQuality::assess(name, samples, channel))
            .collect::<io::Result<_>>()?;
        let mut warnings: Vec<String> =
            assessed.iter().flat_map(|(q, clipping)| q.warnings(clipping)).collect();
        let mut channels: Vec<ChannelQuality> = assessed.into_iter().map(|(quality, _)| quality).collect();
        warnings.extend(repeats(&channels, samples)?);
        let repeats = drive_repeats(&channels, roles, samples)?;
        find_faults(&mut channels, roles, repeats.as_ref().map(|r| r.period_s), samples)?;
        let rate = samples.sample_rate_hz();
        warnings.extend(channels.iter().zip(roles).flat_map(|(c, role)| sentences::warnings(c, *role, rate)));
        warnings.extend(repeats.iter().flat_map(sentences::noise_warnings));
        let notes = repeats.iter().map(sentences::note).collect();
        let of = |wanted: fn(&ChannelQuality) -> bool| {
            channels.iter().filter(|c| wanted(c)).map(|c| c.channel.clone()).collect()
        };
        Ok(Self {
            dead_channels: of(|c| c.dead),
            clipped_channels: of(|c| c.clipped_share > 0.0),
            channels,
            repeats,
            warnings,
            notes,
        })
    }
}

/// Indices of the channels of a role that move.
fn moving(channels: &[ChannelQuality], roles: &[Role], role: Role) -> Vec<usize> {
    let is = |at: &usize| roles[*at] == role && !channels[*at].dead;
    (0..channels.len()).filter(is).collect()
}

/// Fills in what the excerpts and one more pass say of the channels that move.
fn find_faults(
    channels: &mut [ChannelQuality],
    roles: &[Role],
    period_s: Option<f64>,
    samples: &mut impl Samples,
) -> io::Result<()> {
    let (drives, responses) = (moving(channels, roles, Role::Drive), moving(channels, roles, Role::Response));
    for &at in drives.iter().chain(&responses) {
        let channel = &mut channels[at];
        let excerpts = Excerpts::read(samples, at)?;
        channel.quantisation = Quantisation::of(&excerpts, channel.min, channel.max, channel.std);
        let step = channel.quantisation.map_or(0.0, |q| q.step);
        let others: Vec<usize> =
            drives.iter().chain(&responses).copied().filter(|other| *other != at).collect();
        let found =
            quality::scan(samples, at, &others, &excerpts, [channel.min, channel.max, channel.std, step])?;
        if let Some(Scan { spikes, dropouts }) = found {
            channel.spikes = Some(spikes);
            channel.dropouts = (roles[at] == Role::Response).then_some(dropouts);
        }
    }
    let mains = MainsFinder::new(samples, &drives, roles.contains(&Role::Drive), period_s)?;
    for &at in &responses {
        channels[at].hum = mains.find(samples, at)?;
    }
    let ms = 1e3 / samples.sample_rate_hz();
    for (&at, delay) in responses.iter().zip(quality::delays(samples, &drives, &responses)?) {
        channels[at].delay = delay.map(|delay| ResponseDelay {
            drive: channels[delay.drive].channel.clone(),
            delay_ms: ms * delay.samples,
            resolution_ms: ms * delay.resolution,
            coherence: delay.coherence,
        });
    }
    Ok(())
}

fn drive_repeats(
    channels: &[ChannelQuality],
    roles: &[Role],
    samples: &mut impl Samples,
) -> io::Result<Option<DriveRepeats>> {
    let (drives, responses) = (moving(channels, roles, Role::Drive), moving(channels, roles, Role::Response));
    let rate = samples.sample_rate_hz();
    let found = quality::repeats(samples, &drives, &responses)?;
    Ok(found.map(|found| DriveRepeats {
        period_s: found.period_samples as f64 / rate,
        period_samples: found.period_samples,
        count: found.count,
        drives_differ: found.drives_differ,
        responses: responses
            .iter()
            .zip(found.noise)
            .map(|(&at, noise_share)| ResponseNoise { channel: channels[at].channel.clone(), noise_share })
            .collect(),
    }))
}

/// A warning for each channel that has, sample by sample, the values of an earlier one: a cable or a
/// column that was taken twice. Equal samples give equal figures, so few channels are compared.
fn repeats(channels: &[ChannelQuality], samples: &mut impl Samples) -> io::Result<Vec<String>> {
    let figures = |c: &ChannelQuality| [c.min, c.max, c.mean, c.std].map(f64::to_bits);
    let mut first: HashMap<[u64; 4], Vec<usize>> = HashMap::new();
    let mut warnings = Vec::new();
    for (at, channel) in channels.iter().enumerate().filter(|(_, c)| !c.dead) {
        let alike = first.entry(figures(channel)).or_default();
        let mut repeated = None;
        for &other in alike.iter() {
            if are_equal(samples, other, at)? {
                repeated = Some(other);
                break;
            }
        }
        match repeated {
            Some(other) => {
                warnings.push(repeats_sentence(&channel.channel, &channels[other].channel));
            }
            None => alike.push(at),
        }
    }
    Ok(warnings)
}

/// The warning that a channel has the values of another.
fn repeats_sentence(channel: &str, other: &str) -> String {
    format!("{channel} repeats {other}")
}

impl ChannelQuality {
    fn assess(name: &str, samples: &mut impl Samples, channel: usize) -> io::Result<(Self, Clipping)> {
        let (mut min, mut max) = (f64::INFINITY, f64::NEG_INFINITY);
        each_block(samples, channel, |block| {
            (min, max) =
                (block.iter().copied().fold(min, f64::min), block.iter().copied().fold(max, f64::max));
            Ok(())
        })?;
        let peak = min.abs().max(max.abs());
        let dead = min == max;
        let mut quality = Self {
            channel: name.to_owned(),
            min,
            max,
            mean: min,
            std: 0.0,
            rms: peak,
            peak_to_rms: (peak > 0.0).then_some(1.0),
            dead,
            longest_at_extreme: samples.n_samples() as u64,
            clipped_share: 0.0,
            ..Self::default()
        };
        if dead || samples.n_samples() == 0 {
            return Ok((quality, Clipping::default()));
        }
        // Relative to the peak, so that the squares of no finite value overflow or vanish.
        let n = samples.n_samples() as f64;
        let (mut sum, mut sum_of_squares) = (0.0, 0.0);
        let mut spans = Spans::between(min, max);
        each_block(samples, channel, |block| {
            sum = block.iter().fold(sum, |sum, v| sum + v / peak);
            sum_of_squares = block.iter().fold(sum_of_squares, |sum, v| sum + (v / peak).powi(2));
            block.iter().for_each(|v| spans.take(*v));
            Ok(())
        })?;
        let (mean, mean_square) = (sum / n, sum_of_squares / n);
        let mut sum_of_deviations = 0.0;
        each_block(samples, channel, |block| {
            let squared = |sum: f64, v: &f64| sum + (v / peak - mean).powi(2);
            sum_of_deviations = block.iter().fold(sum_of_deviations, squared);
            Ok(())
        })?;
        let variance: f64 = sum_of_deviations / n;
        quality.mean = mean * peak;
        quality.rms = mean_square.sqrt() * peak;
        quality.std = variance.sqrt() * peak;
        quality.peak_to_rms = Some(1.0 / mean_square.sqrt());
        let clipping = spans.end();
        quality.longest_at_extreme = clipping.longest;
        quality.clipped_share = (clipping.at_min + clipping.at_max) as f64 / n;
        Ok((quality, clipping))
    }

    /// Warnings about the channel by itself.
    fn warnings(&self, clipping: &Clipping) -> Vec<String> {
        let name = &self.channel;
        if self.dead {
            return vec![format!("{name} is constant at {}", shown(self.min))];
        }
        let mut warnings = Vec::new();
        let sides = [("largest", clipping.at_max, self.max), ("smallest", clipping.at_min, self.min)];
        let clipped: Vec<String> = sides
            .into_iter()
            .filter(|&(_, samples, _)| samples > 0)
            .map(|(side, samples, value)| format!("{samples} samples at its {side} value {}", shown(value)))
            .collect();
        if !clipped.is_empty() {
            warnings.push(format!("{name}: {}: probably clipped", clipped.join(", ")));
        }
        let deviations = (self.mean / self.std).abs();
        if deviations.is_finite() && deviations > OFFSET_FROM_DEVIATIONS {
            warnings.push(format!("{name}: its mean is {} times its standard deviation", tenths(deviations)));
        }
        warnings
    }
}

/// At most six significant digits: a value as people write it, not as its last bit was rounded.
fn shown(value: f64) -> String {
    let rounded = format!("{value:.5e}").parse().unwrap_or(value);
    if rounded == 0.0 || (1e-4..1e9).contains(&rounded.abs()) {
        rounded.to_string()
    } else {
        format!("{rounded:e}")
    }
}

/// One digit after the point, without pretending to more of a large number.
fn tenths(ratio: f64) -> String {
    if ratio < 1e6 { format!("{ratio:.1}") } else { format!("{ratio:.0e}") }
}

/// Samples in spans of [`CLIPPED_FROM_SAMPLES`] or more at an extreme.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
struct Clipping {
    /// Samples of the longest span at either extreme, however short.
    longest: u64,
    at_min: u64,
    at_max: u64,
}

/// Finds spans of equal samples at an extreme, sample by sample.
#[derive(Debug)]
struct Spans {
    min: f64,
    max: f64,
    /// The last sample, and how many like it came in a row.
    span: (f64, u64),
    found: Clipping,
}

impl Spans {
    fn between(min: f64, max: f64) -> Self {
        Self { min, max, span: (min, 0), found: Clipping::default() }
    }

    fn take(&mut self, sample: f64) {
        if sample != self.span.0 {
            self.close();
            self.span = (sample, 0);
        }
        self.span.1 += 1;
    }

    fn close(&mut self) {
        let (value, len) = self.span;
        if value != self.min && value != self.max {
            return;
        }
        self.found.longest = self.found.longest.max(len);
        if len >= CLIPPED_FROM_SAMPLES {
            *(if value == self.max { &mut self.found.at_max } else { &mut self.found.at_min }) += len;
        }
    }

    fn end(mut self) -> Clipping {
        self.close();
        self.found
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::Signal;

    fn assess(samples: &[f64]) -> ChannelQuality {
        let mut signal = Signal::new(100.0, vec![samples.to_vec()]).unwrap();
        ChannelQuality::assess("a", &mut signal, 0).unwrap().0
    }

    fn warnings(channels: &[(&str, &[f64])]) -> Vec<String> {
        let names: Vec<String> = channels.iter().map(|(name, _)| (*name).to_owned()).collect();
        let samples = channels.iter().map(|(_, samples)| samples.to_vec()).collect();
        let roles = vec![Role::Response; names.len()];
        Quality::assess(&names, &roles, &mut Signal::new(100.0, samples).unwrap()).unwrap().warnings
    }

    #[test]
    fn levels_are_those_of_the_samples() {
        let q = assess(&[1.0, -1.0, 3.0, 1.0]);
        assert_eq!((q.min, q.max, q.mean), (-1.0, 3.0, 1.0));
        assert!((q.rms - 3.0f64.sqrt()).abs() < 1e-15);
        assert!((q.std - 2.0f64.sqrt()).abs() < 1e-15);
        assert!((q.peak_to_rms.unwrap() - 3.0 / 3.0f64.sqrt()).abs() < 1e-15);
        assert!(!q.dead);
        assert_eq!((q.longest_at_extreme, q.clipped_share), (1, 0.0));
    }

    #[test]
    fn a_long_channel_that_is_read_in_blocks_has_the_figures_of_the_whole_bit_for_bit() {
        // A flat top lies across the end of a block, and a flat bottom at the end of the channel.
        let n = 100_000;
        let flat = |i: usize| if (65_530..65_545).contains(&i) { 3.0 } else { -2.75 };
        let sample = |i: usize| {
            let free = !(65_530..65_545).contains(&i) && i < n - 4;
            if free { 0.25 + 2.5 * (i as f64 * 0.37).sin() } else { flat(i) }
        };
        let samples: Vec<f64> = (0..n).map(sample).collect();
        let q = assess(&samples);
        let (peak, len) = (3.0, n as f64);
        let mean = samples.iter().map(|v| v / peak).sum::<f64>() / len;
        let mean_square = samples.iter().map(|v| (v / peak).powi(2)).sum::<f64>() / len;
        let variance = samples.iter().map(|v| (v / peak - mean).powi(2)).sum::<f64>() / len;
        assert_eq!((q.min, q.max, q.mean), (-2.75, 3.0, mean * peak));
        assert_eq!((q.rms, q.std), (mean_square.sqrt() * peak, variance.sqrt() * peak));
        assert_eq!(q.peak_to_rms, Some(1.0 / mean_square.sqrt()));
        assert_eq!((q.longest_at_extreme, q.clipped_share), (15, 19.0 / len));
        let mut late = samples.clone();
        late[n - 10] += 1e-9;
        let found = warnings(&[("a", &samples), ("b", &late), ("c", &samples)]);
        assert_eq!(found.iter().filter(|w| w.contains("repeats")).collect::<Vec<_>>(), ["c repeats a"]);
    }

    #[test]
    fn a_flat_top_is_clipping_and_a_flat_middle_is_not() {
        let q = assess(&[0.0, 1.0, 1.0, 1.0, 0.5, 0.5, 0.5, 0.5, -1.0, 0.0]);
        assert_eq!(q.longest_at_extreme, 3);
        assert!((q.clipped_share - 0.3).abs() < 1e-15);
    }

    #[test]
    fn a_constant_channel_is_dead_and_its_figures_are_finite() {
        let q = assess(&[2.0; 5]);
        assert!(q.dead);
        assert_eq!((q.mean, q.std, q.rms, q.peak_to_rms), (2.0, 0.0, 2.0, Some(1.0)));
        assert_eq!(assess(&[0.0; 5]).peak_to_rms, None);
    }

    #[test]
    fn the_largest_numbers_do_not_overflow_the_figures() {
        let q = assess(&[f64::MAX, -f64::MAX, f64::MAX, f64::MIN_POSITIVE]);
        for figure in [q.mean, q.std, q.rms, q.peak_to_rms.unwrap()] {
            assert!(figure.is_finite(), "{figure}");
        }
    }

    #[test]
    fn a_sound_channel_gives_no_warning() {
        assert_eq!(warnings(&[("a", &[1.0, -1.0, 0.5, 0.5]), ("b", &[1.0, -1.0, 0.5, 0.25])]), [""; 0]);
    }

    #[test]
    fn clipping_tells_side_count_and_value_as_it_was_written() {
        let top = f64::from(4.998_f32);
        let half = [0.0, top, top, top, 0.5, -9.0, -9.0, top, top, top, top];
        let found = warnings(&[("disp_x", &half)]);
        assert_eq!(found, ["disp_x: 7 samples at its largest value 4.998: probably clipped"]);
        let both = [1e-9, 1e-9, 1e-9, 0.0, -2.5e-7, -2.5e-7, -2.5e-7, -2.5e-7];
        let found = warnings(&[("a", &both)]);
        let expected = "a: 3 samples at its largest value 1e-9, 4 samples at its smallest value -2.5e-7: probably clipped";
        assert_eq!(found, [expected]);
    }

    #[test]
    fn a_constant_channel_is_told_once_and_repeats_nothing() {
        let found = warnings(&[("drive_y", &[0.0; 9]), ("drive_z", &[0.0; 9])]);
        assert_eq!(found, ["drive_y is constant at 0", "drive_z is constant at 0"]);
    }

    #[test]
    fn a_channel_that_repeats_another_is_told_and_one_with_the_same_figures_is_not() {
        let (x, reordered) = ([1.0, 2.0, -3.0, 4.0], [4.0, -3.0, 2.0, 1.0]);
        let found = warnings(&[("force_x", &x), ("b", &reordered), ("force_y", &x), ("force_z", &x)]);
        assert_eq!(found, ["force_y repeats force_x", "force_z repeats force_x"]);
    }

    #[test]
    fn an_offset_is_told_from_three_deviations_on() {
        let about = |mean: f64| [mean - 1.0, mean + 1.0, mean - 1.0, mean + 1.0];
        assert_eq!(warnings(&[("a", &about(3.0))]), [""; 0]);
        let found = warnings(&[("force_z", &about(-3.2))]);
        assert_eq!(found, ["force_z: its mean is 3.2 times its standard deviation"]);
    }

    #[test]
    fn the_warnings_of_the_largest_and_smallest_numbers_are_finite() {
        let tiny = f64::from_bits(1);
        let found = warnings(&[
            ("a", &[f64::MAX, f64::MAX, f64::MAX, 0.0]),
            ("b", &[1.0, 1.0 + 1e-16, 1.0, 1.0]),
            ("c", &[tiny, tiny, tiny, 0.0]),
        ]);
        assert!(found.iter().all(|w| !w.contains("inf") && !w.contains("NaN")), "{found:?}");
        let stored = r#"{"channels": [], "dead_channels": [], "clipped_channels": []}"#;
        assert_eq!(serde_json::from_str::<Quality>(stored).unwrap().warnings, [""; 0], "an older run");
    }
}
