//! Studies as they are requested (`POST /v1/rigs/{rig}/studies`), listed and stored.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::fits::FitRequest;
use super::ids::{RigId, StudyId};
use super::job::{JobKind, JobRequest, JobState};
use super::model_ref::ModelRef;
use super::problem::FieldError;
use crate::engine::EngineError;
use crate::engine::study::{RangeOf, Space, TrialSettings};

mod linear;

pub use linear::LinearStudy;

/// Most trials of a search.
pub const MAX_TRIALS: usize = 200;

/// Kinds of studies.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum StudyKind {
    /// Searches the settings of a fit.
    Search,
    /// Error of a fit against minutes of data.
    LearningCurve,
    /// The source paper's study of network sizes on data that an FRF makes.
    LinearStudy,
}

impl StudyKind {
    /// The word of the contract.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Search => "search",
            Self::LearningCurve => "learning_curve",
            Self::LinearStudy => "linear_study",
        }
    }
}

/// How a search goes through its trials.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SearchMethod {
    /// All trials with the full epochs.
    #[default]
    Random,
    /// All trials with few epochs, the better ones with more.
    SuccessiveHalving,
}

/// The request; every field but `kind` has a default. Fields of another kind are refused.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StudyRequest {
    /// Kind.
    pub kind: StudyKind,
    /// The fit that is studied; its settings hold wherever the study does not vary them. Left out: hybrid 2.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fit: Option<FitRequest>,
    /// Seed of everything that the study draws.
    #[serde(default = "seed")]
    pub seed: u64,
    /// How a search goes through its trials.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub method: Option<SearchMethod>,
    /// Trials of a search.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trials: Option<usize>,
    /// Successive halving: one trial in so many goes on.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reduction: Option<usize>,
    /// Settings that a search varies.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub space: Option<Space>,
    /// Seeds of each trial's networks; the fit of the best trial has the fit's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trial_seeds: Option<Vec<u64>>,
    /// Sizes of a learning curve, of which the largest is all data.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sizes: Option<usize>,
    /// Random subsets of each size.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub repeats: Option<usize>,
    /// Minutes beyond all data to which the curve is continued.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub more_min: Option<f64>,
    /// The model whose FRF makes the files of a linear study.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub model: Option<ModelRef>,
    /// Numbers of training files of a linear study, rising.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub files: Option<Vec<usize>>,
    /// Files that score it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scored_files: Option<usize>,
    /// Length of its files, s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub duration_s: Option<f64>,
    /// Its networks: cells of each block.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub nets: Option<Vec<Vec<usize>>>,
    /// Its epochs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub epochs: Option<usize>,
    /// Its learning rate.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub learning_rate: Option<f64>,
    /// Its means are drawn from within this of zero, in the unit of the input.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mean: Option<f64>,
    /// Its amplitudes (three standard deviations) are drawn from here, in the unit of the input.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub amplitude: Option<RangeOf<f64>>,
    /// End of the white part of its noise, Hz.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub white_to_hz: Option<f64>,
    /// End of its noise, Hz.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub end_hz: Option<f64>,
}

impl JobRequest for StudyRequest {
    const KIND: JobKind = JobKind::Study;
}

fn seed() -> u64 {
    1
}

/// A search, nothing left open.
#[derive(Debug, Clone, PartialEq)]
pub struct Search {
    /// How it goes through its trials.
    pub method: SearchMethod,
    /// Trials.
    pub trials: usize,
    /// One trial in so many goes on.
    pub reduction: usize,
    /// Settings that vary.
    pub space: Space,
    /// Seeds of each trial's networks.
    pub trial_seeds: Vec<u64>,
}

/// A learning curve, nothing left open.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LearningCurve {
    /// Sizes.
    pub sizes: usize,
    /// Random subsets of each.
    pub repeats: usize,
    /// Minutes beyond all data to which the curve is continued.
    pub more_min: f64,
}

impl StudyRequest {
    /// The fit that is studied.
    pub fn fit(&self) -> FitRequest {
        let default = || serde_json::from_str(r#"{"kind": "hybrid2"}"#).expect("a fit needs a kind only");
        self.fit.clone().unwrap_or_else(default)
    }

    /// The fields that are given and belong to another kind.
    fn foreign(&self) -> Vec<FieldError> {
        let fields = [
            ("method", StudyKind::Search, self.method.is_some()),
            ("trials", StudyKind::Search, self.trials.is_some()),
            ("reduction", StudyKind::Search, self.reduction.is_some()),
            ("space", StudyKind::Search, self.space.is_some()),
            ("trial_seeds", StudyKind::Search, self.trial_seeds.is_some()),
            ("sizes", StudyKind::LearningCurve, self.sizes.is_some()),
            ("repeats", StudyKind::LearningCurve, self.repeats.is_some()),
            ("more_min", StudyKind::LearningCurve, self.more_min.is_some()),
            ("model", StudyKind::LinearStudy, self.model.is_some()),
            ("files", StudyKind::LinearStudy, self.files.is_some()),
            ("scored_files", StudyKind::LinearStudy, self.scored_files.is_some()),
            ("duration_s", StudyKind::LinearStudy, self.duration_s.is_some()),
            ("nets", StudyKind::LinearStudy, self.nets.is_some()),
            ("epochs", StudyKind::LinearStudy, self.epochs.is_some()),
            ("learning_rate", StudyKind::LinearStudy, self.learning_rate.is_some()),
            ("mean", StudyKind::LinearStudy, self.mean.is_some()),
            ("amplitude", StudyKind::LinearStudy, self.amplitude.is_some()),
            ("white_to_hz", StudyKind::LinearStudy, self.white_to_hz.is_some()),
            ("end_hz", StudyKind::LinearStudy, self.end_hz.is_some()),
        ];
        let foreign = fields.into_iter().filter(|(_, kind, given)| *given && *kind != self.kind);
        foreign
            .map(|(name, kind, _)| {
                FieldError::new(format!("/{name}"), format!("a study of kind {}", kind.as_str()))
            })
            .collect()
    }

    /// The learning curve that is asked for.
    ///
    /// # Errors
    /// The fields that leave their limits or belong to another kind.
    pub fn learning_curve(&self) -> Result<LearningCurve, Vec<FieldError>> {
        let mut errors = self.foreign();
        let mut whole = |pointer: &str, given: Option<usize>, default: usize, least: usize, most: usize| {
            let value = given.unwrap_or(default);
            if !(least..=most).contains(&value) {
                errors.push(FieldError::new(pointer, format!("{least} to {most}; found {value}")));
            }
            value
        };
        let sizes = whole("/sizes", self.sizes, 5, 3, 8);
        let repeats = whole("/repeats", self.repeats, 3, 1, 8);
        let more_min = self.more_min.unwrap_or(10.0);
        // Written so that NaN would be refused.
        if !(more_min > 0.0 && more_min <= 100_000.0) {
            errors.push(FieldError::new("/more_min", format!("above 0, at most 100000; found {more_min}")));
        }
        if self.fit.as_ref().is_some_and(|fit| fit.frf.runs.is_some()) {
            let limit = "left out: the minutes of data are those of the fit's own runs";
            errors.push(FieldError::new("/fit/frf/runs", limit));
        }
        if errors.is_empty() { Ok(LearningCurve { sizes, repeats, more_min }) } else { Err(errors) }
    }

    /// The linear study that is asked for, of a model with so many inputs and outputs together at this rate.
    ///
    /// # Errors
    /// The fields that leave their limits or belong to another kind.
    pub fn linear_study(&self, channels: usize, sample_rate_hz: f64) -> Result<LinearStudy, Vec<FieldError>> {
        linear::check(self, self.foreign(), channels, sample_rate_hz)
    }

    /// The search that is asked for.
    ///
    /// # Errors
    /// The fields that leave their limits, more trials than allowed, an empty range.
    pub fn search(&self) -> Result<Search, Vec<FieldError>> {
        let mut errors = self.foreign();
        let trials = self.trials.unwrap_or(20);
        if !(1..=MAX_TRIALS).contains(&trials) {
            errors.push(FieldError::new("/trials", format!("1 to {MAX_TRIALS} trials; found {trials}")));
        }
        let reduction = self.reduction.unwrap_or(3);
        if !(2..=10).contains(&reduction) {
            errors.push(FieldError::new("/reduction", format!("2 to 10; found {reduction}")));
        }
        let method = self.method.unwrap_or_default();
        if self.reduction.is_some() && method == SearchMethod::Random {
            errors.push(FieldError::new("/reduction", "left out, unless the method is successive_halving"));
        }
        let space = self.space.clone().unwrap_or_else(Space::usual);
        match space.check() {
            Err(EngineError::Setting { setting, limit, found }) => {
                let pointer = format!("/{}", setting.replace('.', "/"));
                errors.push(FieldError::new(pointer, format!("{limit}; found {found}")));
            }
            Err(other) => errors.push(FieldError::new("/space", other.to_string())),
            Ok(()) => {}
        }
        if self.fit.as_ref().is_some_and(|fit| fit.start.is_some()) {
            for (pointer, varies) in [
                ("/space/kinds", space.kinds.is_some()),
                ("/space/blocks", space.blocks.is_some()),
                ("/space/cells", space.cells.is_some()),
            ] {
                if varies {
                    let limit = "left out: a fit that starts at a version has its kind and blocks";
                    errors.push(FieldError::new(pointer, limit));
                }
            }
        }
        let trial_seeds = self.trial_seeds.clone().unwrap_or_else(|| vec![1]);
        let most = crate::engine::lstm::MAX_SEEDS;
        if !(1..=most).contains(&trial_seeds.len()) {
            errors.push(FieldError::new("/trial_seeds", format!("1 to {most} seeds")));
        }
        let search = Search { method, trials, reduction, space, trial_seeds };
        if errors.is_empty() { Ok(search) } else { Err(errors) }
    }
}

/// A trial of a search, as one rung did it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Trial {
    /// Number, from 0: what it drew.
    pub trial: usize,
    /// Rung, from 0.
    pub rung: usize,
    /// Share of the fit's epochs that it had.
    pub share: f64,
    /// Epochs that it had; none for an FRF.
    pub epochs: Option<usize>,
    /// What it varies.
    pub settings: TrialSettings,
    /// Mean over the outputs of the RMS error on the data that choose; `null` if it failed.
    pub error: Option<f64>,
    /// RMS error of each output, in the order of the fit's outputs.
    pub rms: Vec<Option<f64>>,
    /// Why it failed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
}

/// The table of a search.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct SearchReport {
    /// Fits of trials that the search does.
    pub planned: usize,
    /// Fits of trials, in the order in which they were done.
    pub trials: Vec<Trial>,
    /// The best so far: the least error of the last rung that has one.
    pub best: Option<Box<Trial>>,
}

impl SearchReport {
    /// The trial of this number in this rung, if it is done.
    pub fn done(&self, trial: usize, rung: usize) -> Option<&Trial> {
        self.trials.iter().find(|row| (row.trial, row.rung) == (trial, rung))
    }

    /// Adds a trial.
    pub fn add(&mut self, trial: Trial) {
        // Errors of another share of the epochs are no comparison.
        let better = match (&self.best, trial.error) {
            (_, None) => false,
            (None, Some(_)) => true,
            (Some(best), Some(error)) => {
                trial.rung > best.rung || (trial.rung == best.rung && best.error.is_none_or(|e| error < e))
            }
        };
        if better {
            self.best = Some(Box::new(trial.clone()));
        }
        self.trials.push(trial);
    }

    /// The same as if the trials had been added one after the other, in whichever order they were.
    pub fn in_order(&mut self) {
        let mut trials = std::mem::take(&mut self.trials);
        trials.sort_by_key(|trial| (trial.rung, trial.trial));
        self.best = None;
        trials.into_iter().for_each(|trial| self.add(trial));
    }
}

/// A fit to a subset of the data.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SubsetFit {
    /// Number of the size, from 0, the smallest.
    pub size: usize,
    /// Number of the subset among those of its size, from 0.
    pub repeat: usize,
    /// Minutes that trained it.
    pub minutes: f64,
    /// Share of all data.
    pub share: f64,
    /// RMS error of each output, in the order of the fit's outputs; empty if the fit failed.
    pub rms: Vec<Option<f64>>,
    /// Why it failed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
}

/// An error with its 90 % interval.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ErrorAt {
    /// Minutes of data.
    pub minutes: f64,
    /// Median.
    pub error: f64,
    /// 5 % quantile.
    pub low: f64,
    /// 95 % quantile.
    pub high: f64,
}

/// The learning curve of an output.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct OutputCurve {
    /// The output.
    pub channel: String,
    /// Error with all data, by the curve.
    pub now: ErrorAt,
    /// Error with more data.
    pub then: ErrorAt,
    /// Error that no amount of data would go below, and the exponent of its fall: medians.
    pub offset: f64,
    /// See `offset`.
    pub exponent: f64,
    /// The curve from the smallest size on.
    pub curve: Vec<ErrorAt>,
    /// What more data would bring, in a sentence.
    pub sentence: String,
}

/// What a learning curve has found.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct LearningCurveReport {
    /// Fits that it does.
    pub planned: usize,
    /// Fits, in the order in which they were done.
    pub fits: Vec<SubsetFit>,
    /// One for each output that has a curve; empty until all fits are done.
    pub outputs: Vec<OutputCurve>,
}

/// A network of a linear study, trained on so many files.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LinearFit {
    /// Cells of each block.
    pub net: Vec<usize>,
    /// Its weights.
    pub parameters: usize,
    /// Training files.
    pub files: usize,
    /// Their minutes.
    pub minutes: f64,
    /// Mean over the outputs of the RMS error, averaged over the files that score; `null` if it failed.
    pub error: Option<f64>,
    /// RMS error of each output, averaged over the files that score.
    pub rms: Vec<Option<f64>>,
    /// Why it failed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
}

/// What a linear study has found.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct LinearStudyReport {
    /// Fits that it does.
    pub planned: usize,
    /// Fits, in the order in which they were done.
    pub fits: Vec<LinearFit>,
}

/// What a study has found, so far or at its end.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum StudyReport {
    /// Of a search.
    Search(SearchReport),
    /// Of a learning curve.
    LearningCurve(LearningCurveReport),
    /// Of a linear study.
    LinearStudy(LinearStudyReport),
}

/// A study in lists. Its id is that of its job.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StudySummary {
    /// Id, the same as the job's.
    pub id: StudyId,
    /// Its rig.
    pub rig: RigId,
    /// Kind.
    pub kind: StudyKind,
    /// State of its job.
    pub state: JobState,
    /// When it was asked for.
    pub created_at: Timestamp,
    /// The model version that it published; it may be gone.
    pub model: Option<u32>,
}

/// A study with its request and what it has found.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StoredStudy {
    /// As in lists.
    #[serde(flatten)]
    pub summary: StudySummary,
    /// The request, its fit resolved.
    pub request: StudyRequest,
    /// What it has found: so far while it runs, and up to its end if it was cancelled or has failed. Absent before
    /// the first result.
    #[serde(flatten)]
    pub report: Option<StudyReport>,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::model::{LstmOptions, ModelKind};

    fn request(json: &str) -> StudyRequest {
        serde_json::from_str(json).unwrap()
    }

    fn refused(json: &str) -> String {
        request(json).search().unwrap_err()[0].pointer.clone()
    }

    #[test]
    fn a_search_has_defaults_and_limits() {
        let search = request(r#"{"kind": "search", "fit": {"kind": "lstm"}}"#).search().unwrap();
        assert_eq!((search.trials, search.method, search.reduction), (20, SearchMethod::Random, 3));
        assert_eq!(search.space, Space::usual());
        let with = |more: &str| format!(r#"{{"kind": "search", "fit": {{"kind": "lstm"}}, {more}}}"#);
        assert_eq!(refused(&with(r#""trials": 201"#)), "/trials");
        assert_eq!(refused(&with(r#""trials": 0"#)), "/trials");
        assert_eq!(refused(&with(r#""reduction": 3"#)), "/reduction");
        assert_eq!(refused(&with(r#""space": {}"#)), "/space");
        assert_eq!(refused(&with(r#""space": {"cells": {"min": 9, "max": 8}}"#)), "/space/cells");
        assert_eq!(refused(&with(r#""trial_seeds": []"#)), "/trial_seeds");
        assert_eq!(refused(&with(r#""repeats": 2"#)), "/repeats");
        let started = r#"{"kind": "search", "fit": {"kind": "lstm", "start": {"version": 1}}}"#;
        assert_eq!(refused(started), "/space/blocks");
        assert!(serde_json::from_str::<StudyRequest>(&with(r#""trails": 3"#)).is_err());
    }

    #[test]
    fn a_learning_curve_has_defaults_and_limits() {
        let curve = request(r#"{"kind": "learning_curve"}"#);
        assert_eq!(curve.fit().kind, ModelKind::Hybrid2);
        let found = curve.learning_curve().unwrap();
        assert_eq!(found, LearningCurve { sizes: 5, repeats: 3, more_min: 10.0 });
        for (more, pointer) in [
            (r#""sizes": 2"#, "/sizes"),
            (r#""repeats": 0"#, "/repeats"),
            (r#""more_min": 0"#, "/more_min"),
            (r#""trials": 3"#, "/trials"),
            (r#""fit": {"kind": "frf", "frf": {"runs": {"tags": ["linear"]}}}"#, "/fit/frf/runs"),
        ] {
            let refused = request(&format!(r#"{{"kind": "learning_curve", {more}}}"#)).learning_curve();
            assert_eq!(refused.unwrap_err()[0].pointer, pointer);
        }
    }

    #[test]
    fn the_best_trial_is_that_of_the_last_rung_with_an_error() {
        let trial = |trial, rung, error| Trial {
            trial,
            rung,
            share: 1.0,
            epochs: Some(3),
            settings: TrialSettings { kind: ModelKind::Lstm, lstm: LstmOptions::default() },
            error,
            rms: Vec::new(),
            reason: None,
        };
        let mut report = SearchReport::default();
        report.add(trial(0, 0, None));
        assert_eq!(report.best, None);
        for (number, error) in [(1, 0.3), (2, 0.2), (3, 0.2)] {
            report.add(trial(number, 0, Some(error)));
        }
        assert_eq!(report.best.as_ref().map(|best| best.trial), Some(2), "of equals the first");
        report.add(trial(1, 1, Some(0.25)));
        assert_eq!(report.best.as_ref().map(|best| (best.trial, best.rung)), Some((1, 1)));
        report.add(trial(2, 1, None));
        assert_eq!(report.best.as_ref().map(|best| best.trial), Some(1));
        assert!(report.done(2, 1).is_some() && report.done(3, 1).is_none());
        let mut other = SearchReport::default();
        report.trials.iter().rev().for_each(|row| other.add(row.clone()));
        assert_ne!(other, report);
        other.in_order();
        assert_eq!(other, report, "whoever has done what, and when");
    }
}
