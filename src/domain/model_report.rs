//! The report of a model version (`GET /v1/rigs/{rig}/models/{version}/report`): how its fit went, on which data, and
//! what the model leaves of data that it has not seen.

use std::collections::{BTreeMap, HashMap};

use jiff::Timestamp;
use serde::Serialize;

use super::ids::{RigId, RunId};
use super::model::{Base, Model, ModelFrf, Origin, Span};
use super::run::Run;
use crate::engine::RunKind;
use crate::engine::model::{
    FitRecord, FitReport, InputCoverage, ModelKind, Residual, SeedReport, SplitRule, VersionKind,
};

/// Why a part of a report is absent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum NoPart {
    /// The version was imported: the service knows no fit of it.
    Imported,
    /// The version is another one with effects on top: the fit is that of its base.
    Adopted,
    /// A model of this kind has no network, so nothing was trained epoch by epoch.
    NoNetwork,
    /// A model of this kind has no FRF.
    NoFrf,
    /// An earlier program fitted the version and did not keep it.
    EarlierProgram,
    /// A figure exceeds the range of numbers.
    NotFinite,
}

/// Why the network of a seed was kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ChosenBy {
    /// It had the lowest error on the data that stop the training.
    LowestStoppingMse,
    /// There was no other seed.
    OnlySeed,
}

/// The training of a version's network.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TrainingCurves {
    /// Seed whose network was kept.
    pub best_seed: Option<u64>,
    /// Why.
    pub chosen_by: ChosenBy,
    /// Whether the network was trained again on all training runs afterwards, up to the same share of its epochs. The
    /// curves are those of the training before.
    pub refitted: bool,
    /// Each seed's curve.
    pub seeds: Vec<SeedCurve>,
}

/// The training of one seed: mean squared errors, standardised, at some of its epochs.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SeedCurve {
    /// Seed.
    pub seed: u64,
    /// Whether its network was kept.
    pub chosen: bool,
    /// Epoch whose weights were kept; 0: those that the training began with.
    pub best_epoch: usize,
    /// Its error on the data that stop the training.
    pub stopping_mse: f64,
    /// Epochs of the curve, from 1.
    pub epochs: Vec<usize>,
    /// Error on the training data at these epochs.
    pub training: Vec<f64>,
    /// Error on the data that stop the training.
    pub stopping: Vec<f64>,
}

/// An input and its coverage by the training data.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ChannelCoverage<'a> {
    /// Input.
    pub channel: &'a str,
    /// Coverage.
    #[serde(flatten)]
    pub coverage: &'a InputCoverage,
}

/// The use of data in the making of a model.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum DataUse {
    /// Set the weights.
    Training,
    /// Set the FRF, where its data are not those of the training.
    Frf,
    /// Stopped the training, and chose seed and recombination.
    Stopping,
    /// Compare the model with others.
    Comparison,
    /// Shaped or chose the version that the training began at.
    Start,
    /// Set or chose the parameters of adopted effects.
    Effects,
}

/// Data that served the making of a model.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct UsedData<'a> {
    /// What for.
    #[serde(rename = "use")]
    pub used_for: DataUse,
    /// Which.
    #[serde(flatten)]
    pub span: &'a Span,
    /// Name of the run; `None` if it is gone.
    pub name: Option<&'a str>,
    /// Kind of the run; `None` if it is gone.
    pub kind: Option<RunKind>,
    /// Length.
    pub duration_s: f64,
    /// Share of all data of this use, 0..=1.
    pub share: f64,
    /// RMS error of the model by output, of data that compare; `None` where the output is zero throughout.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rms: Option<BTreeMap<&'a str, Option<f64>>>,
}

/// The RMS error of an output.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct OutputError<'a> {
    /// Output.
    pub channel: &'a str,
    /// RMS error relative to the measured RMS; `None` where the output is zero throughout.
    pub rms: Option<f64>,
}

/// The report.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ModelReport<'a> {
    /// The version.
    pub version: u32,
    /// Its rig.
    pub rig: &'a RigId,
    /// Kind.
    pub kind: VersionKind,
    /// Where it is from.
    pub origin: Origin,
    /// When it was published.
    pub created_at: Timestamp,
    /// Of kind `adopted`: the version beneath its effects.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub base: Option<&'a Base>,
    /// How the data were divided.
    pub rule: Option<SplitRule>,
    /// The data that made it, by use.
    pub data: Vec<UsedData<'a>>,
    /// RMS error of each output on the data that compare models; where there are none, on those that stopped the
    /// training.
    pub errors: Option<Vec<OutputError<'a>>>,
    /// Loss curves.
    pub training: Option<TrainingCurves>,
    /// The FRF in a few figures.
    pub frf: Option<&'a ModelFrf>,
    /// The residual on the data of `errors`.
    pub residual: Option<&'a Residual>,
    /// Coverage of the inputs by the training data.
    pub coverage: Option<Vec<ChannelCoverage<'a>>>,
    /// Limits of the model that an engineer should know.
    pub warnings: &'a [String],
    /// Why parts are `null`, by their names.
    pub reasons: BTreeMap<&'static str, NoPart>,
}

impl<'a> ModelReport<'a> {
    /// The report of a model with what its fit has kept; `runs` are those of its rig.
    pub fn of(model: &'a Model, record: Option<&'a FitRecord>, runs: &'a [Run]) -> Self {
        let report = model.report.as_ref();
        let absent = match model.origin {
            Origin::Import => NoPart::Imported,
            Origin::Diagnosis => NoPart::Adopted,
            Origin::Fit => NoPart::EarlierProgram,
        };
        let mut reasons = BTreeMap::new();
        let mut without = |part: &'static str, missing: bool, why: NoPart| {
            if missing {
                reasons.insert(part, why);
            }
        };
        let fitted = report.filter(|report| !report.seeds.is_empty());
        let no_network = model.parts == ModelKind::Frf && report.is_some();
        without("training", fitted.is_none(), if no_network { NoPart::NoNetwork } else { absent });
        without("errors", report.is_none(), absent);
        without("rule", report.is_none_or(|report| report.comparison.is_none()), absent);
        without("frf", model.frf.is_none(), NoPart::NoFrf);
        let residual = record.and_then(|record| record.residual.as_ref());
        without("residual", residual.is_none(), if record.is_some() { NoPart::NotFinite } else { absent });
        without("coverage", record.is_none(), absent);
        Self {
            version: model.version,
            rig: &model.rig,
            kind: model.kind,
            origin: model.origin,
            created_at: model.created_at,
            base: model.adoption.as_ref().map(|adoption| &adoption.base),
            rule: report.and_then(|report| report.comparison.as_ref()).map(|comparison| comparison.rule),
            data: used_data(model, runs),
            errors: report.map(|report| errors(model, report)),
            training: fitted.map(curves),
            frf: model.frf.as_ref(),
            residual,
            coverage: record.map(|record| {
                let named = model.inputs.iter().zip(&record.coverage);
                named.map(|(channel, coverage)| ChannelCoverage { channel, coverage }).collect()
            }),
            warnings: report.map_or(&[], |report| &report.warnings),
            reasons,
        }
    }
}

fn errors<'a>(model: &'a Model, report: &FitReport) -> Vec<OutputError<'a>> {
    let named = model.outputs.iter().zip(&report.validation_rms);
    named.map(|(channel, rms)| OutputError { channel, rms: *rms }).collect()
}

fn curves(report: &FitReport) -> TrainingCurves {
    let one = |seed: &SeedReport| SeedCurve {
        seed: seed.seed,
        chosen: report.best_seed == Some(seed.seed),
        best_epoch: seed.best_epoch,
        stopping_mse: seed.validation_mse,
        epochs: seed.curve.iter().map(|point| point.0).collect(),
        training: seed.curve.iter().map(|point| point.1).collect(),
        stopping: seed.curve.iter().map(|point| point.2).collect(),
    };
    TrainingCurves {
        best_seed: report.best_seed,
        chosen_by: if report.seeds.len() > 1 { ChosenBy::LowestStoppingMse } else { ChosenBy::OnlySeed },
        refitted: report.comparison.as_ref().is_some_and(|comparison| comparison.refitted),
        seeds: report.seeds.iter().map(one).collect(),
    }
}

/// The data of the lineage by use, with the runs that they are of.
fn used_data<'a>(model: &'a Model, runs: &'a [Run]) -> Vec<UsedData<'a>> {
    let runs: HashMap<RunId, &Run> = runs.iter().map(|run| (run.id, run)).collect();
    let lineage = &model.lineage;
    let effects = lineage.diagnoses.iter().flat_map(|adopted| adopted.fit.iter().chain(&adopted.select));
    let uses: [(DataUse, Vec<&Span>); 6] = [
        (DataUse::Training, lineage.training.iter().collect()),
        (DataUse::Frf, lineage.frf.iter().collect()),
        (DataUse::Stopping, lineage.stopping.iter().flatten().collect()),
        (DataUse::Comparison, lineage.validation.iter().collect()),
        (DataUse::Start, lineage.start.iter().flat_map(|start| &start.seen).collect()),
        (DataUse::Effects, effects.collect()),
    ];
    let mut data = Vec::new();
    for (used_for, spans) in uses {
        let samples = |span: &Span| span.to_sample.saturating_sub(span.from_sample) as f64;
        let all: f64 = spans.iter().map(|span| samples(span)).sum();
        for (place, span) in spans.into_iter().enumerate() {
            let run = runs.get(&span.run);
            let compared = used_for == DataUse::Comparison;
            data.push(UsedData {
                used_for,
                span,
                name: run.map(|run| run.name.as_str()),
                kind: run.map(|run| run.kind),
                duration_s: samples(span) / model.sample_rate_hz,
                share: if all > 0.0 { samples(span) / all } else { 0.0 },
                rms: if compared { section_errors(model, place) } else { None },
            });
        }
    }
    data
}

/// The errors on one stretch of the data that compare.
fn section_errors(model: &Model, place: usize) -> Option<BTreeMap<&str, Option<f64>>> {
    let scores = &model.report.as_ref()?.comparison.as_ref()?.scores;
    let score = scores.get(place)?;
    let named = model.outputs.iter().zip(&score.outputs);
    Some(named.map(|(name, squares)| (name.as_str(), squares.rms())).collect())
}
