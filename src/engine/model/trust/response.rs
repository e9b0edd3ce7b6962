//! Levels of the linear response over short times. Each channel of a drive may be inside by itself, while together, or at
//! a resonance, they move the rig as the training never did.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use super::beyond::{Beyond, Way, join};
use super::levels::Level;

/// The level over a window may exceed the largest of the training by this factor: that of few windows is uncertain.
const LEVEL_SLACK: f64 = 1.1;

/// Means may leave those of the training by this share of half the range that means and level span together.
const MEAN_SLACK: f64 = 0.05;

/// The response of a model's FRF at one output, over the windows of the training data; of a model without an FRF, one input.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(from = "Stored")]
pub struct WindowRange {
    /// Samples of a window.
    pub window: usize,
    /// Smallest and largest mean, channel unit.
    pub mean: [f64; 2],
    /// Largest RMS about the mean, channel unit.
    pub max_rms: f64,
    /// Largest RMS of the rate of change, channel unit per second.
    pub max_rate: f64,
    /// Largest RMS of the rate within three adjacent lines of a window, from the fifth on, channel unit per second: a slow
    /// tone passes where the training passed. None in weights of before it was watched.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_tone_rate: Option<f64>,
}

/// As it stands in weights.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Stored {
    window: usize,
    mean: [f64; 2],
    max_rms: f64,
    max_rate: f64,
    max_tone_rate: Option<f64>,
    /// Of earlier versions: the RMS of a tone, whatever its rate.
    #[expect(dead_code, reason = "read and left")]
    max_tone: Option<f64>,
}

impl From<Stored> for WindowRange {
    fn from(stored: Stored) -> Self {
        let Stored { window, mean, max_rms, max_rate, max_tone_rate, .. } = stored;
        Self { window, mean, max_rms, max_rate, max_tone_rate }
    }
}

impl WindowRange {
    /// Those of all channels over the windows of the training, `[window][channel]`, of so many samples; none without windows.
    pub(super) fn of_windows(window: usize, windows: &[Vec<Level>]) -> Vec<Self> {
        let channels = windows.first().map_or(0, Vec::len);
        let none = [f64::INFINITY, f64::NEG_INFINITY];
        let mut found =
            vec![
                Self { window, mean: none, max_rms: 0.0, max_rate: 0.0, max_tone_rate: Some(0.0) };
                channels
            ];
        for of_channels in windows {
            for (range, [mean, rms, rate, tone]) in found.iter_mut().zip(of_channels) {
                range.mean = [range.mean[0].min(*mean), range.mean[1].max(*mean)];
                range.max_rms = range.max_rms.max(*rms);
                range.max_rate = range.max_rate.max(*rate);
                range.max_tone_rate = range.max_tone_rate.map(|most| most.max(*tone));
            }
        }
        // Squares may exceed the range of numbers: then nothing is known.
        let finite = |range: &Self| range.limits().iter().all(|(_, limit)| limit.is_finite());
        if found.iter().all(finite) { found } else { Vec::new() }
    }

    /// The limits and the ways to pass them.
    pub(super) fn limits(&self) -> [(Way, f64); 5] {
        let slack = MEAN_SLACK * ((self.mean[1] - self.mean[0]) / 2.0 + self.max_rms);
        [
            (Way::High, self.mean[1] + slack),
            (Way::Low, self.mean[0] - slack),
            (Way::Strong, LEVEL_SLACK * self.max_rms + slack),
            (Way::Fast, LEVEL_SLACK * self.max_rate),
            (Way::Tonal, LEVEL_SLACK * self.max_tone_rate.unwrap_or(f64::INFINITY)),
        ]
    }
}

/// The stretches of windows outside, with the place of their channel among the ranges.
pub(super) fn find(ranges: &[WindowRange], windows: &[(Range<usize>, Vec<Level>)]) -> Vec<(usize, Beyond)> {
    let mut found = Vec::new();
    for (channel, range) in ranges.iter().enumerate() {
        for (way, limit) in range.limits() {
            let mut stretches = Vec::new();
            for (samples, _) in windows.iter().filter(|(_, levels)| way.beyond(&levels[channel], limit)) {
                join(&mut stretches, samples, (), |(), ()| ());
            }
            found
                .extend(stretches.into_iter().map(|(samples, ())| (channel, Beyond { samples, way, limit })));
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use realfft::num_complex::Complex64;

    use super::*;
    use crate::frf::Frf;
    use crate::model::tests::made_up;
    use crate::model::trust::levels::LinearLevels;
    use crate::model::trust::short_time::ShortTime;
    use crate::model::trust::watch::of_training;
    use crate::model::{InputRange, ModelKind, RigModel};

    const RATE: f64 = 1000.0;

    /// A model whose two inputs add up to one output, tenfold about 100 Hz.
    fn adder() -> RigModel {
        let segment_len = 1000;
        let gain = |line: usize| if line.abs_diff(100) < 5 { 10.0 } else { 1.0 };
        let frf = Frf {
            sample_rate_hz: RATE,
            segment_len,
            n_inputs: 2,
            n_outputs: 1,
            h: (0..=segment_len / 2).flat_map(|line| [Complex64::from(gain(line)); 2]).collect(),
            usable_hz: [0.0, RATE / 2.0],
            x_mean: vec![0.5; 2],
            y_mean: vec![3.0],
        };
        let range =
            InputRange { min: -3.0, max: 3.0, max_rate: 1e9, band_hz: Some([0.0, 50.0]), local: None };
        let one = made_up(ModelKind::Frf);
        RigModel { frf: Some(frf), sample_rate_hz: RATE, range: vec![range; 2], ..one }
    }

    fn tone(hz: f64, amplitude: f64, mean: f64) -> Vec<f64> {
        (0..8000).map(|t| mean + amplitude * (std::f64::consts::TAU * hz * t as f64 / RATE).sin()).collect()
    }

    fn ranges(model: &RigModel, inputs: [&[f64]; 2]) -> Vec<WindowRange> {
        of_training(model, &[inputs.to_vec()]).0
    }

    /// The ways in which two inputs are outside.
    fn ways(model: &RigModel, ranges: &[WindowRange], inputs: [&[f64]; 2]) -> Vec<Way> {
        let fft = ShortTime::new(ranges[0].window);
        let levels = LinearLevels::new(model, fft.len());
        let found = find(ranges, &fft.each_batch(&inputs, |windows| levels.of(windows)));
        found.iter().map(|(_, beyond)| beyond.way).collect()
    }

    #[test]
    fn the_levels_are_those_of_the_response() {
        // Both inputs in step: twice their amplitude; means about the working point.
        let (model, x) = (adder(), tone(20.0, 1.0, 0.75));
        let [range] = ranges(&model, [&x, &x])[..] else { panic!("one output") };
        let rms = 2.0_f64.sqrt();
        assert!((range.max_rms - rms).abs() < 0.02, "{range:?}");
        let rate = rms * std::f64::consts::TAU * 20.0;
        assert!((range.max_tone_rate.unwrap() - rate).abs() < 0.05 * rate, "{range:?}");
        assert!((range.max_rate - rate).abs() < 5.0, "{range:?}");
        assert!(range.mean.iter().all(|mean| (mean - 3.5).abs() < 0.06), "{range:?}");
        let opposite: Vec<f64> = x.iter().map(|v| 1.5 - v).collect();
        let [range] = ranges(&model, [&x, &opposite])[..] else { panic!("one output") };
        assert!(range.max_rms < 1e-6, "{range:?}");
    }

    #[test]
    fn channels_together_and_a_resonance_are_outside_though_each_channel_is_inside() {
        let model = adder();
        let (a, b) = (tone(20.0, 1.0, 0.0), tone(33.0, 1.0, 0.0));
        let known = ranges(&model, [&a, &b]);
        assert_eq!(ways(&model, &known, [&a, &b]), []);
        assert_eq!(ways(&model, &known, [&b, &a]), []);
        let in_step = ways(&model, &known, [&a, &a]);
        assert!(in_step.contains(&Way::Strong), "{in_step:?}");
        let resonant = ways(&model, &known, [&tone(100.0, 0.2, 0.0), &b]);
        assert!(resonant.contains(&Way::Strong) && resonant.contains(&Way::Fast), "{resonant:?}");
        let moved = ways(&model, &known, [&tone(20.0, 1.0, 0.3), &tone(33.0, 1.0, 0.3)]);
        assert_eq!(moved, [Way::High]);
        // The power of many lines in one.
        let mut many = vec![0.0; 8000];
        for hz in [10.0, 14.0, 18.0, 22.0, 26.0, 30.0, 34.0, 38.0, 42.0, 46.0] {
            many.iter_mut().zip(tone(hz, 0.3, 0.0)).for_each(|(sum, v)| *sum += v);
        }
        let still = vec![0.0; 8000];
        let known = ranges(&model, [&many, &still]);
        assert_eq!(ways(&model, &known, [&tone(24.0, 0.9, 0.0), &still]), [Way::Tonal]);
    }

    #[test]
    fn a_slow_tone_as_strong_as_the_drives_it_is_known_from_is_inside() {
        let model = adder();
        let mut many = vec![0.0; 8000];
        for hz in [6.0, 14.0, 22.0, 30.0, 38.0, 46.0] {
            many.iter_mut().zip(tone(hz, 0.5, 0.0)).for_each(|(sum, v)| *sum += v);
        }
        let still = vec![0.0; 8000];
        let known = ranges(&model, [&many, &still]);
        assert_eq!(ways(&model, &known, [&tone(6.0, 1.2, 0.0), &still]), []);
        assert_eq!(ways(&model, &known, [&tone(46.0, 0.6, 0.0), &still]), [Way::Tonal]);
    }

    #[test]
    fn ranges_of_before_tones_had_rates_are_read_and_judge_none() {
        let old = serde_json::json!({"window": 256, "mean": [0.0, 1.0], "max_rms": 2.0, "max_rate": 3.0, "max_tone": 0.5});
        let range: WindowRange = serde_json::from_value(old).unwrap();
        assert_eq!(range.max_tone_rate, None);
        assert!(range.limits().iter().all(|(way, limit)| *way != Way::Tonal || limit.is_infinite()));
        let new = serde_json::to_value(WindowRange { max_tone_rate: Some(7.0), ..range }).unwrap();
        assert_eq!(serde_json::from_value::<WindowRange>(new.clone()).unwrap().max_tone_rate, Some(7.0));
        assert!(new.get("max_tone").is_none());
        let unknown = serde_json::json!({"window": 256, "mean": [0.0, 1.0], "max_rms": 2.0, "max_rate": 3.0, "tone": 0.5});
        assert!(serde_json::from_value::<WindowRange>(unknown).is_err());
    }

    #[test]
    fn squares_beyond_the_range_of_numbers_leave_nothing_known() {
        let model = adder();
        let huge = tone(20.0, 1e160, 0.0);
        assert_eq!(ranges(&model, [&huge, &huge]), []);
        assert_eq!(of_training(&model, &[vec![&huge, &huge]]).1, None);
    }

    #[test]
    fn without_an_frf_the_inputs_themselves_are_watched() {
        let model = RigModel { frf: None, kind: ModelKind::Lstm, ..adder() };
        let (a, b) = (tone(20.0, 1.0, 0.0), tone(33.0, 1.0, 0.0));
        let known = ranges(&model, [&a, &b]);
        assert_eq!(known.len(), 2);
        assert!((known[0].max_rms - 0.5_f64.sqrt()).abs() < 0.01, "{known:?}");
        assert_eq!(ways(&model, &known, [&a, &a]), []);
        assert_eq!(ways(&model, &known, [&tone(45.0, 0.9, 0.0), &b]), [Way::Fast, Way::Tonal]);
    }
}
