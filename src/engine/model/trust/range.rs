//! The ranges of a model's inputs in its training data.

use serde::{Deserialize, Serialize};

use super::LocalRange;
use crate::EngineError;
use crate::spectral::{Detrend, Welch, psd_of_parts};

/// Range of one input channel in the training data, after the model's filter.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct InputRange {
    /// Smallest value, channel unit.
    pub min: f64,
    /// Largest value, channel unit.
    pub max: f64,
    /// Largest absolute rate of change, channel unit per second.
    pub max_rate: f64,
    /// First and last frequency that it excited; `None` when unknown.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub band_hz: Option<[f64; 2]>,
    /// Means and levels over windows; `None` when unknown.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub local: Option<LocalRange>,
}

/// Samples of a segment of the spectra that tell the band.
const SEGMENT_LEN: usize = 4096;

/// A line is excited when its density is above this share of the largest, as for an FRF's usable band.
const EXCITED: f64 = 1e-6;

/// Width of the Hann window's main lobe in lines: below, a line cannot be told from the mean.
const MAIN_LOBE: usize = 4;

impl InputRange {
    /// The ranges of all inputs over the parts of runs that were trained on, `[part][input]`, at least
    /// one part.
    ///
    /// # Errors
    /// No samples, values whose square overflows.
    pub(in crate::model) fn of_training(
        parts: &[Vec<&[f64]>],
        sample_rate_hz: f64,
    ) -> Result<Vec<Self>, EngineError> {
        let longest = parts.iter().map(|part| part[0].len()).max().unwrap_or(0);
        let segment_len = longest.clamp(1, SEGMENT_LEN);
        let welch = Welch { segment_len, overlap: 0.5, detrend: Detrend::Constant };
        let spectrum = psd_of_parts(parts, sample_rate_hz, &welch)?;
        let range = |(channel, density): (usize, &Vec<f64>)| {
            let band_hz = excited(density, spectrum.df_hz, sample_rate_hz);
            let stretches = || parts.iter().map(|part| part[channel]);
            let local =
                LocalRange::of(stretches(), band_hz.unwrap_or([0.0, sample_rate_hz / 2.0]), sample_rate_hz);
            Self { band_hz, local, ..Self::of(stretches(), sample_rate_hz) }
        };
        Ok(spectrum.density.iter().enumerate().map(range).collect())
    }

    /// Values and rates over several signals of one channel.
    pub(super) fn of<'a>(stretches: impl Iterator<Item = &'a [f64]>, sample_rate_hz: f64) -> Self {
        let mut range =
            Self { min: f64::INFINITY, max: f64::NEG_INFINITY, max_rate: 0.0, band_hz: None, local: None };
        for samples in stretches {
            for &v in samples {
                range.min = range.min.min(v);
                range.max = range.max.max(v);
            }
            for pair in samples.windows(2) {
                range.max_rate = range.max_rate.max((pair[1] - pair[0]).abs() * sample_rate_hz);
            }
        }
        range
    }
}

/// First and last frequency whose density is excited; none when there is no power. What begins within
/// the main lobe of the mean, which is removed, begins at zero; what ends at the last line ends at half
/// the sample rate.
fn excited(density: &[f64], df_hz: f64, sample_rate_hz: f64) -> Option<[f64; 2]> {
    // Beside the mean, which is removed from each segment, lies what its removal leaves.
    let skip = 2.min(density.len() - 1);
    let largest = density[skip..].iter().copied().fold(0.0, f64::max);
    let live = |d: &f64| *d > EXCITED * largest;
    let first = skip + density[skip..].iter().position(live)?;
    let last = skip + density[skip..].iter().rposition(live)?;
    let from_hz = if first <= MAIN_LOBE { 0.0 } else { first as f64 * df_hz };
    let to_hz = if last + 1 == density.len() { sample_rate_hz / 2.0 } else { last as f64 * df_hz };
    Some([from_hz, to_hz])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_range_spans_all_stretches_but_no_step_between_them() {
        let runs = [&[0.0, 1.0, 2.0][..], &[-1.0, -1.0]];
        let found = InputRange::of(runs.into_iter(), 10.0);
        assert_eq!(found, InputRange { min: -1.0, max: 2.0, max_rate: 10.0, band_hz: None, local: None });
    }

    fn tones(n: usize, hz: std::ops::Range<u32>) -> Vec<f64> {
        let tone = |t: usize, hz: u32| {
            (std::f64::consts::TAU * (t as f64 / 1000.0 + f64::from(hz * hz) * 0.1) * f64::from(hz)).sin()
        };
        (0..n).map(|t| hz.clone().map(|hz| tone(t, hz)).sum()).collect()
    }

    #[test]
    fn the_band_is_that_of_each_input_over_all_runs() {
        let (short, long, high) = (tones(20_000, 1..20), tones(20_000, 1..40), tones(20_000, 30..60));
        let parts = [vec![&short[..], &high], vec![&long[..10_000], &high[..10_000]]];
        let found = InputRange::of_training(&parts, 1000.0).unwrap();
        let [low, high] = [found[0].band_hz.unwrap(), found[1].band_hz.unwrap()];
        assert!(low[0] == 0.0 && (39.0..43.0).contains(&low[1]), "{low:?}");
        assert!((26.0..30.0).contains(&high[0]) && (59.0..63.0).contains(&high[1]), "{high:?}");
    }

    #[test]
    fn white_and_short_and_still_inputs_have_a_band_that_says_so() {
        let white: Vec<f64> = (0..9000_u64).map(|i| ((i * i * 7919) % 1013) as f64).collect();
        let of = |samples: &[f64]| InputRange::of_training(&[vec![samples]], 500.0).unwrap()[0].band_hz;
        assert_eq!(of(&white), Some([0.0, 250.0]));
        assert_eq!(of(&white[..10]), Some([0.0, 250.0]));
        assert_eq!(of(&[3.0; 5000]), None);
        assert_eq!(of(&[3.0]), None);
    }
}
