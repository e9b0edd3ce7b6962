//! Quality figures of a run: levels of its channels, and warnings in words about constant channels,
//! clipping, repeats and offsets.

use std::collections::HashMap;

use serde::{Deserialize, Serialize};

use crate::engine::Signal;

/// A channel counts as clipped when it stays this many samples or more at one of its extremes.
pub const CLIPPED_FROM_SAMPLES: u64 = 3;

/// An offset is told when the mean is further than this many standard deviations from zero.
pub const OFFSET_FROM_DEVIATIONS: f64 = 3.0;

/// Figures of one channel, in its unit.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
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
}

/// Figures of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Quality {
    /// One entry a channel, in the run's order.
    pub channels: Vec<ChannelQuality>,
    /// Constant channels.
    pub dead_channels: Vec<String>,
    /// Channels that look clipped.
    pub clipped_channels: Vec<String>,
    /// Warnings, a sentence each: constant channels, clipping
    /// ([`CLIPPED_FROM_SAMPLES`]), offsets ([`OFFSET_FROM_DEVIATIONS`]), channels that repeat another one.
    /// Empty too for runs that were stored before there were warnings.
    #[serde(default)]
    pub warnings: Vec<String>,
}

impl Quality {
    /// The figures of every channel of `signal`; `names` in the signal's order.
    pub fn assess(names: &[String], signal: &Signal) -> Self {
        let assessed: Vec<(ChannelQuality, Clipping)> = names
            .iter()
            .zip(signal.channels())
            .map(|(name, samples)| ChannelQuality::assess(name, samples))
            .collect();
        let mut warnings: Vec<String> =
            assessed.iter().flat_map(|(q, clipping)| q.warnings(clipping)).collect();
        let channels: Vec<ChannelQuality> = assessed.into_iter().map(|(quality, _)| quality).collect();
        warnings.extend(repeats(&channels, signal));
        let of = |wanted: fn(&ChannelQuality) -> bool| {
            channels.iter().filter(|c| wanted(c)).map(|c| c.channel.clone()).collect()
        };
        Self {
            dead_channels: of(|c| c.dead),
            clipped_channels: of(|c| c.clipped_share > 0.0),
            channels,
            warnings,
        }
    }
}

/// A warning for each channel that has, sample by sample, the values of an earlier one: a cable or a
/// column that was taken twice. Equal samples give equal figures, so few channels are compared.
fn repeats(channels: &[ChannelQuality], signal: &Signal) -> Vec<String> {
    let figures = |c: &ChannelQuality| [c.min, c.max, c.mean, c.std].map(f64::to_bits);
    let mut first: HashMap<[u64; 4], Vec<usize>> = HashMap::new();
    let mut warnings = Vec::new();
    for (at, channel) in channels.iter().enumerate().filter(|(_, c)| !c.dead) {
        let alike = first.entry(figures(channel)).or_default();
        match alike.iter().find(|&&other| signal.channel(other) == signal.channel(at)) {
            Some(&other) => {
                warnings.push(format!("{} repeats {}", channel.channel, channels[other].channel));
            }
            None => alike.push(at),
        }
    }
    warnings
}

impl ChannelQuality {
    fn assess(name: &str, samples: &[f64]) -> (Self, Clipping) {
        let min = samples.iter().copied().fold(f64::INFINITY, f64::min);
        let max = samples.iter().copied().fold(f64::NEG_INFINITY, f64::max);
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
            longest_at_extreme: samples.len() as u64,
            clipped_share: 0.0,
        };
        if dead || samples.is_empty() {
            return (quality, Clipping::default());
        }
        // Relative to the peak, so that the squares of no finite value overflow or vanish.
        let n = samples.len() as f64;
        let mean = samples.iter().map(|v| v / peak).sum::<f64>() / n;
        let mean_square = samples.iter().map(|v| (v / peak).powi(2)).sum::<f64>() / n;
        let variance = samples.iter().map(|v| (v / peak - mean).powi(2)).sum::<f64>() / n;
        quality.mean = mean * peak;
        quality.rms = mean_square.sqrt() * peak;
        quality.std = variance.sqrt() * peak;
        quality.peak_to_rms = Some(1.0 / mean_square.sqrt());
        let clipping = Clipping::of(samples, min, max);
        quality.longest_at_extreme = clipping.longest;
        quality.clipped_share = (clipping.at_min + clipping.at_max) as f64 / n;
        (quality, clipping)
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

impl Clipping {
    fn of(samples: &[f64], min: f64, max: f64) -> Self {
        let mut found = Self::default();
        for stretch in samples.chunk_by(|a, b| a == b).filter(|s| s[0] == min || s[0] == max) {
            let len = stretch.len() as u64;
            found.longest = found.longest.max(len);
            if len >= CLIPPED_FROM_SAMPLES {
                *(if stretch[0] == max { &mut found.at_max } else { &mut found.at_min }) += len;
            }
        }
        found
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn assess(samples: &[f64]) -> ChannelQuality {
        ChannelQuality::assess("a", samples).0
    }

    fn warnings(channels: &[(&str, &[f64])]) -> Vec<String> {
        let names: Vec<String> = channels.iter().map(|(name, _)| (*name).to_owned()).collect();
        let samples = channels.iter().map(|(_, samples)| samples.to_vec()).collect();
        Quality::assess(&names, &Signal::new(100.0, samples).unwrap()).warnings
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
