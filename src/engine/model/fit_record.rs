//! What a fit knows about its data and keeps with the model: the residual on data that the model has not seen, and
//! the coverage of its inputs by the training data.

use std::collections::BTreeMap;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::InputRange;
use super::fit_data::FitData;
use super::split::Section;
use crate::evaluation::{MeanSpectra, Spectra};
use crate::metrics::ErrorSettings;
use crate::spectral::psd;
use crate::{Signal, rounded};

/// Most lags of an autocorrelation.
const LAGS: usize = 64;

/// Classes of a coverage: equal parts of an input's range.
const CLASSES: usize = 10;

/// Digits of a figure that a record keeps.
const DIGITS: usize = 4;

/// White noise stays within this many of its standard deviations with a probability of 95 %.
const BOUND_95: f64 = 1.96;

/// Facts about a fit's data, stored with its model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FitRecord {
    /// The residual; `None` where its squares exceed the range of numbers.
    pub residual: Option<Residual>,
    /// Coverage of each input, in the order of the inputs, behind the model's filter.
    pub coverage: Vec<InputCoverage>,
}

/// The data that a residual is of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ResidualOf {
    /// Those that compare models: the model has not seen them.
    Comparison,
    /// Those that stopped the training, where nothing compares.
    Stopping,
}

/// Measured minus predicted, behind the model's filter.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Residual {
    /// Its data.
    pub of: ResidualOf,
    /// Seconds of them.
    pub duration_s: f64,
    /// Its spectrum beside that of the measured outputs; `None` where no stretch of data has two samples.
    pub spectra: Option<ResidualSpectra>,
    /// Its autocorrelation.
    pub autocorrelation: Autocorrelation,
}

/// One-sided densities, unit^2/Hz, over the same lines.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ResidualSpectra {
    /// Samples of a segment of the estimate.
    pub segment_len: usize,
    /// Frequency of each line, Hz: the mean of those that were averaged.
    pub freq_hz: Vec<f64>,
    /// By the name of the output.
    pub channels: BTreeMap<String, ResidualSpectrum>,
}

/// Spectra of one output, `[line]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ResidualSpectrum {
    /// Of the residual.
    pub residual: Vec<f64>,
    /// Of the measured output.
    pub measured: Vec<f64>,
}

/// Autocorrelation of the residual about its mean. White noise has none: beyond `bound` at low lags the residual
/// follows a pattern that the model lacks.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Autocorrelation {
    /// Distance of lags, s. The first value is that of one sample.
    pub lag_s: f64,
    /// White noise of this length stays within `-bound..=bound` at a lag with a probability of 95 %.
    pub bound: f64,
    /// By the name of the output, `[lag]`, -1..=1; `None` where the residual does not move.
    pub channels: BTreeMap<String, Option<Vec<f64>>>,
}

/// Coverage of one input by the training data.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct InputCoverage {
    /// Smallest value, channel unit.
    pub min: f64,
    /// Largest value, channel unit.
    pub max: f64,
    /// Mean, channel unit.
    pub mean: f64,
    /// Root of the mean square, channel unit.
    pub rms: f64,
    /// Smallest and largest rate of change, channel unit per second.
    pub rate: [f64; 2],
    /// First and last frequency that it excited; `None` where it did not move.
    pub band_hz: Option<[f64; 2]>,
    /// Share of the training in each of ten equal parts of the range from `min` to `max`.
    pub shares: Vec<f64>,
}

/// Collects the residual, one stretch of data after the other.
#[derive(Debug, Default)]
pub(super) struct ResidualSums {
    spectra: MeanSpectra,
    samples: usize,
    /// Sums of products, `[output][lag]` from lag 0.
    products: Vec<Vec<f64>>,
    overflow: bool,
}

impl ResidualSums {
    /// Adds a stretch of data: outputs measured and predicted, behind the filter, equally long.
    pub(super) fn add(&mut self, names: &[String], measured: &Signal, predicted: &Signal) {
        let minus = |(m, p): (&Vec<f64>, &Vec<f64>)| m.iter().zip(p).map(|(m, p)| m - p).collect();
        let residual: Vec<Vec<f64>> =
            measured.channels().iter().zip(predicted.channels()).map(minus).collect();
        let found: Vec<Vec<f64>> = residual.par_iter().map(|channel| products(channel)).collect();
        self.products.resize(found.len(), vec![0.0; LAGS + 1]);
        for (sums, products) in self.products.iter_mut().zip(found) {
            sums.iter_mut().zip(products).for_each(|(sum, product)| *sum += product);
        }
        self.samples += measured.n_samples();
        let welch = ErrorSettings::for_length(measured.n_samples()).psd;
        let residual = Signal::new(measured.sample_rate_hz(), residual);
        match (psd(&[measured], &welch), residual.and_then(|residual| psd(&[&residual], &welch))) {
            (Ok(of_measured), Ok(of_residual)) => {
                self.spectra.add(names, welch.segment_len, &of_measured, &of_residual);
            }
            _ => self.overflow = true,
        }
    }

    /// The residual; `None` where a figure exceeds the range of numbers.
    pub(super) fn finish(self, names: &[String], of: ResidualOf, sample_rate_hz: f64) -> Option<Residual> {
        let finite = self.products.iter().flatten().all(|sum| sum.is_finite());
        if self.overflow || !finite || self.samples == 0 {
            return None;
        }
        let lags = LAGS.min(self.samples - 1);
        let normed = |sums: &Vec<f64>| -> Option<Vec<f64>> {
            let of_lag = |sum: &f64| rounded(sum / sums[0], DIGITS);
            (sums[0] > 0.0).then(|| sums[1..=lags].iter().map(of_lag).collect())
        };
        Some(Residual {
            of,
            duration_s: self.samples as f64 / sample_rate_hz,
            spectra: self.spectra.finish().map(ResidualSpectra::from),
            autocorrelation: Autocorrelation {
                lag_s: 1.0 / sample_rate_hz,
                bound: rounded(BOUND_95 / (self.samples as f64).sqrt(), DIGITS),
                channels: names.iter().cloned().zip(self.products.iter().map(normed)).collect(),
            },
        })
    }
}

impl From<Spectra> for ResidualSpectra {
    fn from(spectra: Spectra) -> Self {
        let Spectra { segment_len, freq_hz, channels } = spectra;
        let named = |spectrum: crate::evaluation::ChannelSpectrum| ResidualSpectrum {
            residual: spectrum.predicted,
            measured: spectrum.target,
        };
        Self {
            segment_len,
            freq_hz,
            channels: channels.into_iter().map(|(name, spectrum)| (name, named(spectrum))).collect(),
        }
    }
}

/// Sums of products of a signal about its mean with itself, by lag from 0.
fn products(samples: &[f64]) -> Vec<f64> {
    let mean = samples.iter().sum::<f64>() / samples.len().max(1) as f64;
    let about: Vec<f64> = samples.iter().map(|v| v - mean).collect();
    let of_lag = |lag: usize| about.iter().zip(about.iter().skip(lag)).map(|(a, b)| a * b).sum();
    (0..=LAGS).map(of_lag).collect()
}

/// The coverage of each input by the sections, whose ranges are known.
pub(super) fn coverage(data: &FitData, sections: &[Section], ranges: &[InputRange]) -> Vec<InputCoverage> {
    let of_input = |(input, range): (usize, &InputRange)| {
        let stretches =
            sections.iter().map(|section| &data.run(section.run).x.channel(input)[section.samples.clone()]);
        one_coverage(stretches, range, data.training[0].x.sample_rate_hz())
    };
    ranges.par_iter().enumerate().map(of_input).collect()
}

fn one_coverage<'a>(
    stretches: impl Iterator<Item = &'a [f64]>,
    range: &InputRange,
    sample_rate_hz: f64,
) -> InputCoverage {
    let InputRange { min, max, band_hz, .. } = *range;
    let (mut n, mut sum, mut squares) = (0_usize, 0.0, 0.0);
    let (mut rate, mut counts) = ([0.0_f64; 2], [0_usize; CLASSES]);
    let width = (max - min) / CLASSES as f64;
    for samples in stretches {
        for &v in samples {
            (n, sum, squares) = (n + 1, sum + v, squares + v * v);
            let class = if width > 0.0 { ((v - min) / width) as usize } else { 0 };
            counts[class.min(CLASSES - 1)] += 1;
        }
        for pair in samples.windows(2) {
            let change = (pair[1] - pair[0]) * sample_rate_hz;
            rate = [rate[0].min(change), rate[1].max(change)];
        }
    }
    let n = n.max(1) as f64;
    InputCoverage {
        min,
        max,
        mean: rounded(sum / n, 10),
        rms: rounded((squares / n).sqrt(), 10),
        rate,
        band_hz,
        shares: counts.map(|count| rounded(count as f64 / n, DIGITS)).to_vec(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn signal(channels: Vec<Vec<f64>>) -> Signal {
        Signal::new(100.0, channels).unwrap()
    }

    /// Uniform in -1..1, from a linear congruential generator.
    fn noise(n: usize) -> Vec<f64> {
        let mut state = 1_u64;
        let mut next = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
        };
        (0..n).map(|_| next()).collect()
    }

    #[test]
    fn white_residuals_stay_within_the_bound_and_a_forgotten_tone_does_not() {
        let names = ["white".to_owned(), "tone".to_owned(), "none".to_owned()];
        let n = 8192;
        let tone: Vec<f64> = (0..n).map(|t| 3.0 + (t as f64 * 0.4).sin()).collect();
        let measured = signal(vec![noise(n), tone.clone(), tone.clone()]);
        let predicted = signal(vec![vec![0.0; n], vec![0.0; n], tone]);
        let mut sums = ResidualSums::default();
        sums.add(&names, &measured, &predicted);
        sums.add(&names, &measured, &predicted);
        let found = sums.finish(&names, ResidualOf::Comparison, 100.0).unwrap();
        assert_eq!((found.duration_s, found.autocorrelation.lag_s), (163.84, 0.01));
        let of = |name: &str| found.autocorrelation.channels[name].clone();
        let (white, bound) = (of("white").unwrap(), found.autocorrelation.bound);
        // The same stretch twice has the spread of a single one.
        let outside = white.iter().filter(|r| r.abs() > bound * 2.0_f64.sqrt()).count();
        assert!(white.len() == 64 && outside < 8, "{outside} of {bound}: {white:?}");
        let tone = of("tone").unwrap();
        assert!((tone[0] - 0.4_f64.cos()).abs() < 0.01, "{tone:?}");
        assert_eq!(of("none"), None);
        let spectra = found.spectra.unwrap();
        let tone = &spectra.channels["tone"];
        assert_eq!(tone.residual, tone.measured);
        assert!(spectra.channels["none"].residual.iter().all(|d| *d == 0.0));
    }

    #[test]
    fn what_exceeds_the_range_of_numbers_gives_no_residual() {
        let names = ["y".to_owned()];
        let mut sums = ResidualSums::default();
        let (zero, huge) =
            (signal(vec![vec![0.0; 64]]), signal(vec![noise(64).iter().map(|v| v * 1e200).collect()]));
        sums.add(&names, &zero, &huge);
        assert_eq!(sums.finish(&names, ResidualOf::Stopping, 100.0), None);
        assert_eq!(ResidualSums::default().finish(&names, ResidualOf::Stopping, 100.0), None);
    }

    #[test]
    fn coverage_counts_each_sample_in_the_class_of_its_value() {
        let range = InputRange { min: -1.0, max: 1.0, max_rate: 0.0, band_hz: Some([0.0, 4.0]), local: None };
        let found = one_coverage([&[-1.0, 1.0, 0.75][..], &[0.05, 0.0]].into_iter(), &range, 10.0);
        assert_eq!(found.shares, [0.2, 0.0, 0.0, 0.0, 0.0, 0.4, 0.0, 0.0, 0.2, 0.2]);
        assert_eq!((found.rate, found.band_hz), ([-2.5, 20.0], Some([0.0, 4.0])));
        assert_eq!(found.mean, 0.16);
        let still = InputRange { min: 2.0, max: 2.0, max_rate: 0.0, band_hz: None, local: None };
        let found = one_coverage([&[2.0, 2.0][..]].into_iter(), &still, 10.0);
        assert_eq!((found.rms, found.shares[0], found.band_hz), (2.0, 1.0, None));
    }
}
