//! The error of a model on parts of runs.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use super::fit_data::FitData;
use super::split::Section;
use super::{Preprocess, RigModel};
use crate::{EngineError, Signal};

/// Samples before a scored section that a model sees, so that it is not scored on its start: several
/// ring-downs of any rig at its usual sample rate.
pub const CONTEXT_SAMPLES: usize = 8192;

/// Sums of squares of one output over a section. Sums of several sections add up.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Squares {
    /// Of predicted minus measured, channel unit squared.
    pub error: f64,
    /// Of measured, channel unit squared.
    pub measured: f64,
}

impl Squares {
    /// Of two equally long signals.
    pub fn of(predicted: &[f64], measured: &[f64]) -> Self {
        let mut squares = Self::default();
        for (p, m) in predicted.iter().zip(measured) {
            squares.error += (p - m).powi(2);
            squares.measured += m * m;
        }
        squares
    }

    /// Both together.
    #[must_use]
    pub fn plus(self, other: Self) -> Self {
        Self { error: self.error + other.error, measured: self.measured + other.measured }
    }

    /// `sqrt(sum (y - y*)^2 / sum y*^2)` (Heindel et al., section 4); `None` where nothing was measured but
    /// zero.
    pub fn rms(self) -> Option<f64> {
        (self.measured > 0.0).then(|| (self.error / self.measured).sqrt())
    }
}

/// The error of a model on one section.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SectionScore {
    /// Against the responses behind the model's filter, per output.
    pub outputs: Vec<Squares>,
    /// Against the responses as recorded, per output; absent where the model has no filter.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub recorded: Option<Vec<Squares>>,
}

/// The section's samples with up to [`CONTEXT_SAMPLES`] before them.
pub fn with_context(samples: &Range<usize>) -> Range<usize> {
    samples.start.saturating_sub(CONTEXT_SAMPLES)..samples.end
}

/// A section as a model predicts it, with context before it.
pub(super) struct PredictedSection<'a> {
    /// The section.
    pub section: &'a Section,
    /// Inputs of the section and of its context.
    pub x: Signal,
    /// The response to them.
    pub response: Signal,
    /// Samples of context.
    pub skip: usize,
}

impl<'a> PredictedSection<'a> {
    /// Predicts a section of filtered data with a model without filter of its own.
    pub(super) fn of(
        model: &RigModel,
        filtered: &FitData,
        section: &'a Section,
    ) -> Result<Self, EngineError> {
        let known = with_context(&section.samples);
        let skip = section.samples.start - known.start;
        let x = filtered.run(section.run).x.slice(known);
        let response = model.predict(&x)?;
        Ok(Self { section, x, response, skip })
    }

    /// Predicts each of some sections.
    pub(super) fn all(
        model: &RigModel,
        filtered: &FitData,
        sections: &'a [Section],
    ) -> Result<Vec<Self>, EngineError> {
        sections.iter().map(|section| Self::of(model, filtered, section)).collect()
    }

    /// One output's response over the section, without its context.
    pub(super) fn scored(&self, output: usize) -> &[f64] {
        &self.response.channel(output)[self.skip..]
    }

    /// All outputs' responses over the section, without its context.
    pub(super) fn shown(&self) -> Signal {
        self.response.slice(self.skip..self.response.n_samples())
    }

    /// The errors; `recorded` are the data before the filter.
    pub(super) fn score(
        &self,
        filtered: &FitData,
        recorded: &FitData,
        preprocess: &Preprocess,
    ) -> SectionScore {
        let Section { run, samples } = self.section;
        let against = |measured: &Signal| -> Vec<Squares> {
            (0..measured.n_channels())
                .map(|c| Squares::of(self.scored(c), &measured.channel(c)[samples.clone()]))
                .collect()
        };
        SectionScore {
            outputs: against(&filtered.run(*run).y),
            recorded: (!preprocess.is_none()).then(|| against(&recorded.run(*run).y)),
        }
    }
}

/// Scores a model without filter of its own on filtered data; `recorded` are the same data before the
/// filter.
pub(super) fn score(
    model: &RigModel,
    filtered: &FitData,
    recorded: &FitData,
    preprocess: &Preprocess,
    sections: &[Section],
) -> Result<Vec<SectionScore>, EngineError> {
    let one =
        |section| Ok(PredictedSection::of(model, filtered, section)?.score(filtered, recorded, preprocess));
    sections.iter().map(one).collect()
}

/// Sums per output over all sections.
pub(super) fn total(scores: &[SectionScore]) -> Vec<Squares> {
    let outputs = scores.first().map_or(0, |score| score.outputs.len());
    (0..outputs)
        .map(|k| scores.iter().fold(Squares::default(), |sum, score| sum.plus(score.outputs[k])))
        .collect()
}
