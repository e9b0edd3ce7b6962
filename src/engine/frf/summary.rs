//! An FRF in a few figures.

use serde::{Deserialize, Serialize};

use super::quality::median;
use super::{Frf, FrfQuality};

/// An FRF in a few figures.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FrfSummary {
    /// First and last frequency at which all inputs together have power; outside, `H` is tapered to
    /// zero.
    pub usable_hz: [f64; 2],
    /// Frequency lines, DC and Nyquist included.
    pub lines: usize,
    /// Distance of lines.
    pub df_hz: f64,
    /// Quality of the estimate; `None` where the model does not carry it.
    #[serde(flatten)]
    pub measured: Option<MeasuredSummary>,
}

/// Quality of an estimate in a few figures.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MeasuredSummary {
    /// Segments averaged.
    pub averages: usize,
    /// Independent segments that the overlapping ones are worth.
    pub effective_averages: f64,
    /// Largest condition number of `S_xx` on excited lines.
    pub condition_max: f64,
    /// Each input, in order.
    pub inputs: Vec<InputSummary>,
    /// Each output, in order.
    pub outputs: Vec<OutputSummary>,
}

/// An input of an FRF.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct InputSummary {
    /// Name.
    pub channel: String,
    /// First and last frequency at which it has power.
    pub usable_hz: [f64; 2],
}

/// An output of an FRF.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct OutputSummary {
    /// Name.
    pub channel: String,
    /// Multiple coherence on excited lines: median.
    pub coherence_median: f64,
    /// Multiple coherence on excited lines: smallest value.
    pub coherence_min: f64,
    /// Where it is smallest.
    pub coherence_min_hz: f64,
    /// See [`FrfQuality::random_error`].
    pub random_error: Option<f64>,
}

impl FrfSummary {
    /// The figures of an FRF whose channels have these names.
    pub fn of(frf: &Frf, quality: Option<&FrfQuality>, inputs: &[String], outputs: &[String]) -> Self {
        Self {
            usable_hz: frf.usable_hz,
            lines: frf.n_lines(),
            df_hz: frf.df_hz(),
            measured: quality.map(|quality| MeasuredSummary::of(frf, quality, inputs, outputs)),
        }
    }
}

impl MeasuredSummary {
    fn of(frf: &Frf, quality: &FrfQuality, inputs: &[String], outputs: &[String]) -> Self {
        let ny = frf.n_outputs;
        let errors = quality.random_error(frf);
        let output = |o: usize| {
            let at = |line: usize| quality.multiple_coherence[line * ny + o];
            let lowest = quality.judged_lines().min_by(|&a, &b| at(a).total_cmp(&at(b))).unwrap_or(0);
            let mut all: Vec<f64> = quality.judged_lines().map(at).collect();
            OutputSummary {
                channel: outputs[o].clone(),
                coherence_median: median(&mut all).unwrap_or(0.0),
                coherence_min: at(lowest),
                coherence_min_hz: lowest as f64 * frf.df_hz(),
                random_error: errors[o],
            }
        };
        let input = |(channel, band): (&String, &[f64; 2])| InputSummary {
            channel: channel.clone(),
            usable_hz: *band,
        };
        Self {
            averages: quality.averages,
            effective_averages: quality.effective_averages,
            condition_max: quality.judged_lines().map(|line| quality.condition[line]).fold(1.0, f64::max),
            inputs: inputs.iter().zip(&quality.input_hz).map(input).collect(),
            outputs: (0..ny).map(output).collect(),
        }
    }
}
