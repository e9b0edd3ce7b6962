//! The data of a fit: whole runs and how they are divided.

use std::borrow::Cow;

use super::split::{FitSplit, RunLengths, Section, Sections, own_frf_sections};
use super::{FitSettings, InputRange, ModelKind, Preprocess};
use crate::{EngineError, Signal};

/// One run, split into the model's inputs and outputs; equally long, one sample rate.
#[derive(Debug, Clone, PartialEq)]
pub struct Pair {
    /// Inputs, in the order of the settings.
    pub x: Signal,
    /// Outputs, in the order of the settings.
    pub y: Signal,
}

impl Pair {
    /// Keeps the first `n` samples.
    fn cut(&mut self, n: usize) {
        (self.x, self.y) = (self.x.slice(0..n), self.y.slice(0..n));
    }
}

/// The runs of a fit, whole. A run's place counts the training runs first, then the validation runs,
/// then further runs of the FRF part.
#[derive(Debug, Clone, PartialEq)]
pub struct FitData {
    /// Training runs of the LSTM or, without one, of the FRF.
    pub training: Vec<Pair>,
    /// Validation runs.
    pub validation: Vec<Pair>,
    /// Runs of the FRF part that are neither training nor validation runs.
    pub frf_only: Vec<Pair>,
    /// Places of the runs of the FRF part, where they are not the training runs.
    pub frf: Option<Vec<usize>>,
    /// How the samples are divided.
    pub split: FitSplit,
}

impl FitData {
    /// Training runs divided by themselves: one run by the last tenths, the last of several left out.
    ///
    /// The service chooses more carefully which runs it leaves out; this is for a program that calls the
    /// engine itself.
    pub fn of_training(training: Vec<Pair>) -> Self {
        let split = if training.len() > 1 {
            FitSplit::LeftOut { comparison: vec![training.len() - 1], stopping: Vec::new() }
        } else {
            FitSplit::LastTenths
        };
        Self { training, validation: Vec::new(), frf_only: Vec::new(), frf: None, split }
    }

    /// Training runs with validation runs of their own.
    pub fn with_validation(training: Vec<Pair>, validation: Vec<Pair>, split: FitSplit) -> Self {
        Self { training, validation, frf_only: Vec::new(), frf: None, split }
    }

    /// The same with runs of its own for the FRF part.
    #[must_use]
    pub fn with_frf_runs(mut self, runs: Vec<Pair>) -> Self {
        let first = self.training.len() + self.validation.len();
        self.frf = Some((first..first + runs.len()).collect());
        self.frf_only = runs;
        self
    }

    /// The data less those that compare, divided by the same rule: what a choice among settings may see. Of runs that
    /// compare with a part the other part is left; whole runs that are left out are for the caller to leave out.
    #[must_use]
    pub fn without_comparison(mut self) -> Self {
        match self.split {
            FitSplit::ValidationHalves => {
                self.validation.iter_mut().for_each(|pair| pair.cut(pair.x.n_samples() / 2));
            }
            FitSplit::LastTenths => {
                self.training
                    .iter_mut()
                    .for_each(|pair| pair.cut(pair.x.n_samples() - pair.x.n_samples() / 10));
            }
            FitSplit::ValidationStops | FitSplit::LeftOut { .. } => {}
        }
        self
    }

    /// The run at a place.
    ///
    /// # Panics
    /// If there is no such run.
    pub fn run(&self, place: usize) -> &Pair {
        self.all().nth(place).expect("a section names a run of the fit")
    }

    /// All runs, by place.
    pub(super) fn all(&self) -> impl Iterator<Item = &Pair> {
        self.training.iter().chain(&self.validation).chain(&self.frf_only)
    }

    /// The split carried out.
    pub fn sections(&self, kind: ModelKind, window_len: usize) -> Sections {
        let lengths = |runs: &[Pair]| runs.iter().map(|run| run.x.n_samples()).collect::<Vec<_>>();
        let (training, validation) = (lengths(&self.training), lengths(&self.validation));
        let lengths = RunLengths { training: &training, validation: &validation };
        Sections::of(&self.split, kind, lengths, window_len)
    }

    /// All training runs, whole.
    pub(super) fn whole_training(&self) -> Vec<Section> {
        let whole = |(run, pair): (usize, &Pair)| Section { run, samples: 0..pair.x.n_samples() };
        self.training.iter().enumerate().map(whole).collect()
    }

    /// Data of the FRF part when the network is trained on `training`: the same data, or those of its own runs
    /// that are neither left out nor held out.
    pub(super) fn frf_sections(&self, training: &[Section]) -> Vec<Section> {
        let length = |run| self.run(run).x.n_samples();
        match &self.frf {
            Some(own) => own_frf_sections(own, training, self.training.len(), length),
            None => training.to_vec(),
        }
    }

    /// Every run has the settings' channels, one sample rate and equally long halves.
    pub(super) fn check(&self, settings: &FitSettings) -> Result<(), EngineError> {
        let Some(first) = self.training.first() else {
            return Err(EngineError::TooShort { what: "training runs", needed: 1, found: 0 });
        };
        let rate = first.x.sample_rate_hz();
        for pair in self.all() {
            for (what, signal, names) in
                [("inputs", &pair.x, &settings.inputs), ("outputs", &pair.y, &settings.outputs)]
            {
                if signal.n_channels() != names.len() {
                    return Err(EngineError::ChannelCount {
                        what,
                        expected: names.len(),
                        found: signal.n_channels(),
                    });
                }
                if !Signal::same_rate(signal.sample_rate_hz(), rate) {
                    return Err(EngineError::SampleRate {
                        what,
                        expected_hz: rate,
                        found_hz: signal.sample_rate_hz(),
                    });
                }
            }
            if pair.x.n_samples() != pair.y.n_samples() {
                return Err(EngineError::UnequalLength {
                    what: "outputs",
                    channel: 0,
                    expected: pair.x.n_samples(),
                    found: pair.y.n_samples(),
                });
            }
        }
        settings.preprocess.check(rate)
    }

    /// All runs behind the filter.
    pub(super) fn filtered(&self, preprocess: &Preprocess) -> Result<Cow<'_, Self>, EngineError> {
        // Hours of data are not copied for nothing.
        if preprocess.is_none() {
            return Ok(Cow::Borrowed(self));
        }
        let all = |pairs: &[Pair]| {
            let filtered =
                |pair: &Pair| Ok(Pair { x: preprocess.apply(&pair.x)?, y: preprocess.apply(&pair.y)? });
            pairs.iter().map(filtered).collect::<Result<_, EngineError>>()
        };
        Ok(Cow::Owned(Self {
            training: all(&self.training)?,
            validation: all(&self.validation)?,
            frf_only: all(&self.frf_only)?,
            frf: self.frf.clone(),
            split: self.split.clone(),
        }))
    }

    /// A fit needs power in every channel, in at least one of the sections.
    pub(super) fn refuse_dead_channels(&self, sections: &[Section]) -> Result<(), EngineError> {
        let moves = |samples: &[f64]| {
            let size = samples.iter().fold(0.0_f64, |a, v| a.max(v.abs()));
            samples.iter().any(|v| (v - samples[0]).abs() > 1e-12 * size)
        };
        let dead = |of: fn(&Pair) -> &Signal| {
            let moves_in = |section: &Section, c: usize| {
                moves(&of(self.run(section.run)).channel(c)[section.samples.clone()])
            };
            let n = of(&self.training[0]).n_channels();
            (0..n).find(|&c| !sections.iter().any(|section| moves_in(section, c)))
        };
        if let Some(channel) = dead(|pair| &pair.x) {
            return Err(EngineError::DeadChannel { what: "inputs", channel });
        }
        match dead(|pair| &pair.y) {
            Some(channel) => Err(EngineError::DeadChannel { what: "outputs", channel }),
            None => Ok(()),
        }
    }

    /// Values, rates and band of each input over the sections.
    pub(super) fn input_ranges(&self, sections: &[Section]) -> Result<Vec<InputRange>, EngineError> {
        InputRange::of_training(&self.inputs(sections), self.training[0].x.sample_rate_hz())
    }

    /// The inputs of sections, `[section][input]`.
    pub(super) fn inputs(&self, sections: &[Section]) -> Vec<Vec<&[f64]>> {
        let inputs = |section: &Section| -> Vec<&[f64]> {
            let channels = self.run(section.run).x.channels().iter();
            channels.map(|channel| &channel[section.samples.clone()]).collect()
        };
        sections.iter().map(inputs).collect()
    }

    /// Seconds of the sections.
    pub(super) fn seconds(&self, sections: &[Section]) -> f64 {
        let samples: usize = sections.iter().map(|section| section.samples.len()).sum();
        samples as f64 / self.training[0].x.sample_rate_hz()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(n: usize) -> Pair {
        let signal = || Signal::new(100.0, vec![(0..n).map(|t| t as f64).collect()]).unwrap();
        Pair { x: signal(), y: signal() }
    }

    #[test]
    fn what_a_choice_may_see_holds_no_sample_that_compares() {
        for (data, run_place) in [
            (FitData::of_training(vec![run(1000)]), 0),
            (FitData::with_validation(vec![run(500)], vec![run(801)], FitSplit::ValidationHalves), 1),
        ] {
            let compares = data.sections(ModelKind::Lstm, 64).comparison[0].clone();
            assert_eq!(compares.run, run_place);
            let cut = data.without_comparison();
            assert_eq!(cut.run(run_place).x.n_samples(), compares.samples.start);
            assert_eq!(cut.run(run_place).y.n_samples(), compares.samples.start);
            assert!(!cut.sections(ModelKind::Lstm, 64).comparison.is_empty(), "and can be divided again");
        }
    }
}
