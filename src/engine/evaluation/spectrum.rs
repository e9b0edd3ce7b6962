//! Measured and predicted spectra of the runs of a class, in a bounded number of lines.

use std::collections::BTreeMap;
use std::ops::Range;

use serde::{Deserialize, Serialize};

use crate::rounded;
use crate::spectral::Psd;

/// Above this many lines in an octave, neighbouring lines are averaged.
const PER_OCTAVE: f64 = 24.0;

/// Digits of a density that a report keeps.
const DIGITS: usize = 4;

/// Mean spectra of a class: one-sided densities, unit^2/Hz.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Spectra {
    /// Samples of a segment of the estimate.
    pub segment_len: usize,
    /// Frequency of each line, Hz: the mean of those that were averaged. The mean of a signal has no line.
    pub freq_hz: Vec<f64>,
    /// By channel name.
    pub channels: BTreeMap<String, ChannelSpectrum>,
}

/// Spectra of one channel, `[line]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ChannelSpectrum {
    /// Of the predictions.
    pub predicted: Vec<f64>,
    /// Of the measurements.
    pub target: Vec<f64>,
}

/// Sums of densities over runs. Runs with longer segments than all before replace them: those of another length
/// have other lines.
#[derive(Debug, Clone, Default)]
pub struct MeanSpectra {
    segment_len: usize,
    df_hz: f64,
    lines: usize,
    channels: BTreeMap<String, Sums>,
}

#[derive(Debug, Clone, Default)]
struct Sums {
    averages: f64,
    predicted: Vec<f64>,
    target: Vec<f64>,
}

impl MeanSpectra {
    /// Adds the spectra of a run, whose channels have these names. Its weight is the number of its segments.
    pub fn add(&mut self, names: &[String], segment_len: usize, measured: &Psd, predicted: &Psd) {
        if segment_len < self.segment_len || names.is_empty() {
            return;
        }
        let lines = measured.density[0].len();
        if segment_len > self.segment_len {
            *self = Self { segment_len, df_hz: measured.df_hz, lines, channels: BTreeMap::new() };
        }
        let bands = bands(lines);
        let weight = measured.n_averages as f64;
        for (channel, name) in names.iter().enumerate() {
            let sums = self.channels.entry(name.clone()).or_default();
            sums.averages += weight;
            sums.predicted.resize(bands.len(), 0.0);
            sums.target.resize(bands.len(), 0.0);
            for (band, (p, t)) in bands.iter().zip(sums.predicted.iter_mut().zip(&mut sums.target)) {
                *p += weight * mean(&predicted.density[channel][band.clone()]);
                *t += weight * mean(&measured.density[channel][band.clone()]);
            }
        }
    }

    /// The means; `None` where no run has been added.
    pub fn finish(self) -> Option<Spectra> {
        let averaged = |sums: Vec<f64>, averages: f64| -> Vec<f64> {
            sums.into_iter().map(|sum| rounded(sum / averages, DIGITS)).collect()
        };
        let freq = |band: Range<usize>| self.df_hz * (band.start + band.end - 1) as f64 / 2.0;
        let freq_hz = bands(self.lines).into_iter().map(|band| rounded(freq(band), 10)).collect();
        let channels: BTreeMap<_, _> = self
            .channels
            .into_iter()
            .map(|(name, sums)| {
                let predicted = averaged(sums.predicted, sums.averages);
                (name, ChannelSpectrum { predicted, target: averaged(sums.target, sums.averages) })
            })
            .collect();
        (!channels.is_empty()).then_some(Spectra { segment_len: self.segment_len, freq_hz, channels })
    }
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// Ranges of lines that are averaged: single lines up to where neighbours are 1/24 of an octave apart, and as many
/// as fit into that above. A spectrum of 2049 lines has fewer than 250 of them.
fn bands(lines: usize) -> Vec<Range<usize>> {
    let ratio = (1.0 / PER_OCTAVE).exp2() - 1.0;
    let mut bands = Vec::new();
    let mut from = 1;
    while from < lines {
        let to = (from + ((from as f64 * ratio) as usize).max(1)).min(lines);
        bands.push(from..to);
        from = to;
    }
    bands
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_line_but_the_mean_is_in_one_band_and_bands_are_few() {
        for lines in [2, 3, 40, 2049, 32_769] {
            let bands = bands(lines);
            let all: Vec<usize> = bands.iter().cloned().flatten().collect();
            assert_eq!(all, (1..lines).collect::<Vec<_>>());
            assert!(bands.len() < 360, "{lines}: {}", bands.len());
        }
        assert!(bands(2049).len() < 250);
        assert!(bands(1).is_empty() && bands(0).is_empty());
    }

    #[test]
    fn runs_weigh_as_much_as_they_have_segments_and_short_ones_give_way() {
        let psd = |density: f64, n_averages: usize, lines: usize| Psd {
            df_hz: 0.5,
            n_averages,
            density: vec![vec![density; lines]],
        };
        let names = ["y".to_owned()];
        let mut sum = MeanSpectra::default();
        sum.add(&names, 8, &psd(100.0, 1, 5), &psd(100.0, 1, 5));
        sum.add(&names, 16, &psd(1.0, 1, 9), &psd(2.0, 1, 9));
        sum.add(&names, 16, &psd(5.0, 3, 9), &psd(6.0, 3, 9));
        sum.add(&names, 8, &psd(100.0, 9, 5), &psd(100.0, 9, 5));
        let found = sum.finish().unwrap();
        assert_eq!((found.segment_len, found.freq_hz.len()), (16, 8));
        assert_eq!((found.freq_hz[0], found.freq_hz[7]), (0.5, 4.0));
        assert_eq!(found.channels["y"].target, [4.0; 8]);
        assert_eq!(found.channels["y"].predicted, [5.0; 8]);
        assert_eq!(MeanSpectra::default().finish(), None);
    }
}
