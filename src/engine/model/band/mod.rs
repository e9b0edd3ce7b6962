//! A band around a prediction that holds the measured response at 90 % of the samples.
//!
//! The band is calibrated on data that the model was neither trained nor stopped on (split conformal prediction; Lei et
//! al., "Distribution-free predictive inference for regression", 2018, section 5.2: locally weighted residuals). A residual
//! is divided by a local scale that is known at prediction, so that residuals of loud and quiet, of slow and fast, of nearly
//! linear and of strongly nonlinear times can be held against each other:
//!
//!     scale(t)^2 = floor^2 + level^2 L(t) + correction^2 C(t) + sum over b of level_b^2 L_b(t) + correction_b^2 C_b(t)
//!
//! L is the mean square of the predicted response about the mean in the data of the fit, so that an offset counts, and C that
//! of what a hybrid's network changes of its FRF or core; both over a window about t. L_b and C_b are those of their parts
//! in frequency band b: what a model gets wrong of a frequency lies there as a rule, and service loads have other spectra
//! than noise. The scale is fitted to the residuals of the data that trained and stopped the model and of those that compare
//! it, of each frequency band by itself. The half width is the scale times the 90 % quantile of |residual| / scale in the
//! data that compare, which is taken apart for small and large scales (Mondrian conformal prediction; Vovk, Gammerman,
//! Shafer, "Algorithmic Learning in a Random World", 2005, section 4.5): residuals of a rig grow faster than in proportion,
//! and other loads have other shares of quiet and loud. Above the loudest class the quantile grows on as over the louder
//! half of them.

mod cycles;
mod frequencies;
mod moving;
mod output;
mod scale;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use self::cycles::Cycles;
use self::frequencies::BANDS;
use self::output::{Known, OutputBand, Rows};

use super::fit_data::FitData;
use super::score::PredictedSection;
use super::split::{Section, Sections};
use super::{ModelKind, RigModel};
use crate::{EngineError, Signal};

/// Share of the samples at which a band holds the response.
pub const COVERAGE: f64 = 0.9;

/// Samples of the window about a sample, for models without a network; with one its own window.
const WINDOW: usize = 256;

/// Longest window that is read from a file.
const MAX_WINDOW: usize = 65_536;

/// Most samples of the training that are looked at, in pieces of so many windows from all over it.
const MOST_TRAINING: usize = 1 << 19;
const WINDOWS_PER_PIECE: usize = 2 * cycles::WINDOWS;

/// The calibration of a model's band.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Band {
    /// Samples of the window about a sample.
    window: usize,
    /// Of each output, in order.
    outputs: Vec<OutputBand>,
}

impl Band {
    /// Calibrates the band of a model without filter of its own: the scale on all sections of filtered data that it was made
    /// with, the rate on those that compare it, as it predicts them.
    ///
    /// # Errors
    /// Those of the prediction.
    pub(super) fn calibrate(
        model: &RigModel,
        filtered: &FitData,
        sections: &Sections,
        predicted: &[PredictedSection<'_>],
    ) -> Result<Self, EngineError> {
        let window = model.lstm.as_ref().map_or(WINDOW, |part| part.window_len);
        let training: Vec<&Section> = sections.training.iter().chain(&sections.stopping).collect();
        let means: Vec<f64> =
            (0..model.outputs.len()).map(|k| mean(filtered, &training, predicted, k)).collect();
        let pieces = pieces(&training, WINDOWS_PER_PIECE * window, MOST_TRAINING);
        let training = Training { model, filtered, pieces: &pieces };
        let rows: Vec<Vec<Rows>> = training.each(&|k, known| known.rows(means[k], window))?;
        let parts: Vec<Part<'_>> = predicted
            .iter()
            .map(|found| Part::of(model, filtered, found))
            .collect::<Result<_, EngineError>>()?;
        let scaled = |(k, mean): (usize, &f64)| {
            let known: Vec<Known<'_>> = parts.iter().map(|part| part.known(k)).collect();
            OutputBand::of(*mean, rows.iter().map(|rows| &rows[k]), &known, window)
        };
        let scaled: Vec<OutputBand> = means.par_iter().enumerate().map(scaled).collect();
        drop(rows);
        // Predicted once more rather than kept: an hour of many channels is too much for that.
        let cycles: Vec<Vec<Cycles>> = training.each(&|k, known| scaled[k].cycles(known, window))?;
        let output = |(k, band): (usize, &OutputBand)| {
            let compared: Vec<Cycles> =
                parts.iter().map(|part| band.cycles(&part.known(k), window)).collect();
            band.clone().with_cycles(cycles.iter().map(|cycles| &cycles[k]), &compared)
        };
        Ok(Self { window, outputs: scaled.par_iter().enumerate().map(output).collect() })
    }

    /// Half width of each output about a whole response, `[output, sample]`. `linear` is the response of the FRF or core
    /// of a hybrid.
    pub(super) fn half_width(
        &self,
        response: &Signal,
        linear: Option<&Signal>,
    ) -> Result<Signal, EngineError> {
        let of = |(k, output): (usize, &OutputBand)| {
            output.half_widths(response.channel(k), linear.map(|linear| linear.channel(k)), self.window)
        };
        Signal::new(response.sample_rate_hz(), self.outputs.iter().enumerate().map(of).collect())
    }

    /// Factor on each output's half width for the damage that follows from the band.
    pub(super) fn of_cycles(&self) -> Vec<f64> {
        self.outputs.iter().map(OutputBand::of_cycles).collect()
    }

    /// Whether it is one of a model with so many outputs.
    ///
    /// # Errors
    /// What is wrong with a band from a file.
    pub(super) fn check(&self, outputs: usize) -> Result<(), EngineError> {
        let wrong = |what: String| Err(EngineError::Weights(format!("band: {what}")));
        if self.outputs.len() != outputs {
            return wrong(format!("{} entries for {outputs} outputs", self.outputs.len()));
        }
        if !(1..=MAX_WINDOW).contains(&self.window) {
            return wrong(format!("window {}: 1 to {MAX_WINDOW} samples are needed", self.window));
        }
        self.outputs.iter().position(|output| !output.is_one()).map_or(Ok(()), |k| {
            wrong(format!(
                "outputs[{k}]: numbers from 0 to 1e15 are needed, and none or {BANDS} frequency bands"
            ))
        })
    }
}

/// Whether a network changes the response of an FRF.
pub(super) fn corrected(model: &RigModel) -> bool {
    matches!(model.kind, ModelKind::Hybrid1 | ModelKind::Hybrid2)
}

/// A section as a model predicts it, beside what was measured.
struct Part<'a> {
    response: &'a Signal,
    /// Of the FRF or core that a network corrects.
    linear: Option<Signal>,
    measured: &'a Signal,
    section: &'a Section,
}

impl<'a> Part<'a> {
    fn of(
        model: &RigModel,
        filtered: &'a FitData,
        found: &'a PredictedSection<'_>,
    ) -> Result<Self, EngineError> {
        let linear = corrected(model).then(|| model.linear(&found.x)).transpose()?.flatten();
        let measured = &filtered.run(found.section.run).y;
        Ok(Self { response: &found.response, linear, measured, section: found.section })
    }

    fn known(&self, output: usize) -> Known<'_> {
        Known {
            response: self.response.channel(output),
            linear: self.linear.as_ref().map(|linear| linear.channel(output)),
            measured: &self.measured.channel(output)[self.section.samples.clone()],
        }
    }
}

/// Pieces of the data that made a model.
struct Training<'a> {
    model: &'a RigModel,
    filtered: &'a FitData,
    pieces: &'a [Section],
}

impl Training<'_> {
    /// What `of` finds of each output, by its place, in each piece.
    fn each<T: Send>(
        &self,
        of: &(dyn Fn(usize, &Known<'_>) -> T + Sync),
    ) -> Result<Vec<Vec<T>>, EngineError> {
        let Self { model, filtered, pieces } = *self;
        let piece = |piece: &Section| {
            let found = PredictedSection::of(model, filtered, piece)?;
            let part = Part::of(model, filtered, &found)?;
            Ok((0..model.outputs.len()).map(|k| of(k, &part.known(k))).collect())
        };
        pieces.par_iter().map(piece).collect()
    }
}

/// Mean of an output in the data of a fit.
fn mean(filtered: &FitData, training: &[&Section], predicted: &[PredictedSection<'_>], output: usize) -> f64 {
    let all = training.iter().copied().chain(predicted.iter().map(|found| found.section));
    let samples = |section: &Section| &filtered.run(section.run).y.channel(output)[section.samples.clone()];
    let (sum, n) = all.fold((0.0, 0), |(sum, n), section| {
        let samples = samples(section);
        (sum + samples.iter().sum::<f64>(), n + samples.len())
    });
    sum / n.max(1) as f64
}

/// Pieces of sections, at most so long and at most so many samples together, evenly from all of them.
fn pieces(sections: &[&Section], len: usize, most: usize) -> Vec<Section> {
    let all: Vec<Section> = sections
        .iter()
        .flat_map(|section| {
            let piece = |start| {
                let samples = start..section.samples.end.min(start + len);
                Section { run: section.run, samples }
            };
            section.samples.clone().step_by(len).map(piece)
        })
        .collect();
    let total: usize = all.iter().map(|piece| piece.samples.len()).sum();
    all.into_iter().step_by(total.div_ceil(most).max(1)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pieces_are_all_of_the_training_or_evenly_chosen_from_it() {
        let section = |run, samples| Section { run, samples };
        let (a, b) = (section(0, 0..1000), section(3, 200..450));
        let all = pieces(&[&a, &b], 400, 10_000);
        let expected = [(0, 0..400), (0, 400..800), (0, 800..1000), (3, 200..450)];
        assert_eq!(all, expected.map(|(run, samples)| section(run, samples)));
        let long = section(0, 0..1_000_000);
        let some = pieces(&[&long], 1000, 300_000);
        assert_eq!((some.len(), some.last().unwrap().samples.start), (250, 996_000));
        assert!(pieces(&[], 400, 10).is_empty());
    }

    #[test]
    fn a_band_of_other_outputs_windows_or_numbers_is_refused() {
        let of = |floor: f64| {
            let text =
                format!(r#"{{"mean": 0, "floor": {floor}, "level": 0, "correction": 0, "quantile": 1.6}}"#);
            serde_json::from_str::<OutputBand>(&text).unwrap()
        };
        let band = Band { window: 256, outputs: vec![of(0.1)] };
        band.check(1).unwrap();
        let refused = |band: Band, outputs| band.check(outputs).unwrap_err().to_string();
        assert!(refused(band.clone(), 2).contains("1 entries for 2 outputs"));
        assert!(refused(Band { window: 0, ..band.clone() }, 1).contains("window 0"));
        let two = vec![of(0.1), of(-0.1)];
        assert!(refused(Band { outputs: two, ..band }, 2).contains("outputs[1]"));
    }
}
