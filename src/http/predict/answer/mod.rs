//! Computes a prediction and writes the answer, off the async threads: one file a format.

mod comparison;
mod file;
mod json;
mod npy;

use std::sync::Arc;

pub(super) use comparison::{damages, distances};

use super::inputs::{Drive, Target};
use super::memory::Share;
use super::request::Include;
use super::stages::Stages;
use crate::compute::Class;
use crate::domain::Rig;
use crate::engine::fatigue::DamageSettings;
use crate::engine::model::{Prediction, Predictor, Preprocess, RigModel, Trust};
use crate::engine::{EngineError, Signal, rounded};
use crate::formats;
use crate::http::body::pieces::Written;
use crate::http::deadline::{self, Deadline};
use crate::http::negotiate::{CSV, MAT, NPY, RPC3};
use crate::http::problem::{Answer, FieldError, Problem};
use crate::http::{codes, errors};
use crate::models::LoadedModel;

/// Largest number of a network's multiplications and additions that count as short work: some 50 ms on
/// two cores, about four minutes of signal for a network of the paper's size.
const SHORT_WORK: f64 = 8e9;

/// All inputs of a prediction, in memory.
#[derive(Debug)]
pub struct PredictionTask {
    /// The rig.
    pub rig: Rig,
    /// The model.
    pub model: Arc<LoadedModel>,
    /// Its inputs.
    pub drive: Drive,
    /// The target.
    pub target: Option<Target>,
    /// Parts of the answer.
    pub include: Include,
    /// Settings of the damage.
    pub damage: DamageSettings,
    /// Media type of the answer.
    pub media_type: &'static str,
    /// The memory that the prediction may take.
    pub memory: Share,
}

/// An answer, but for its headers.
#[derive(Debug)]
pub struct Computed {
    /// The body.
    pub written: Written,
    /// Its size, where it is known before all of it is written.
    pub size: Option<u64>,
    /// Its media type.
    pub media_type: &'static str,
    /// Samples predicted, all outputs together.
    pub samples: u64,
    /// Share of samples at which every input is inside the range that the model was fitted on, if that
    /// range is known.
    pub inside: Option<f64>,
}

/// A prediction whose inputs were checked.
struct Begun<'a> {
    rig: &'a Rig,
    loaded: &'a LoadedModel,
    prediction: Prediction,
    trust: Trust,
    /// Behind the model's filter; none where the answer does not need it.
    target: Option<Target>,
    include: Include,
    damage: DamageSettings,
    memory: Share,
    deadline: &'a Deadline,
}

impl PredictionTask {
    /// A prediction whose drive came as a file: no target, no settings.
    pub fn of_file(
        rig: Rig,
        model: Arc<LoadedModel>,
        drive: Drive,
        media_type: &'static str,
        memory: Share,
    ) -> Self {
        let include = Include { response: true, damage: false, errors: false, trust: true };
        let damage = DamageSettings::default();
        Self { rig, model, drive, target: None, include, damage, media_type, memory }
    }

    /// Short or long work, by the size of drive and network.
    pub fn class(&self) -> Class {
        let inputs = self.model.model().inputs.len();
        class(&self.model.predictor, self.drive.n_samples(inputs))
    }

    /// Predicts, compares, counts, and writes the beginning of the answer.
    ///
    /// # Errors
    /// Another sample rate than the model's, a target of another length, settings outside their
    /// limits, a result that is not finite; the deadline.
    pub fn run(self, deadline: &Deadline, stages: &mut Stages) -> Answer<Computed> {
        let Self { rig, model: loaded, drive, target, include, damage, media_type, memory } = self;
        let (model, predictor) = (loaded.model(), &loaded.predictor);
        check_rate(model, drive.sample_rate_hz(), "/drive/sample_rate_hz")?;
        let drive = parsed(drive, &model.inputs)?;
        stages.end("parse");
        if let Some(target) = &target {
            check_rate(model, target.signal.sample_rate_hz(), "/target/sample_rate_hz")?;
            check_length(&drive, &target.signal)?;
        }
        let target = match target {
            Some(target) if include.damage || include.errors => Some(filtered(target, &model.preprocess)?),
            _ => None,
        };
        let prediction = predictor
            .begin(drive)
            .map_err(|error| errors::engine(&error, &model.inputs, "/drive/channels"))?;
        let trust = predictor.trust(&prediction);
        let samples = (prediction.n_samples() * model.outputs.len()) as u64;
        let inside = (!model.range.is_empty()).then_some(trust.inside);
        let (rig, loaded) = (&rig, loaded.as_ref());
        let begun = Begun { rig, loaded, prediction, trust, target, include, damage, memory, deadline };
        let (written, size) = match media_type {
            NPY => npy::write(begun, stages).map(|(written, size)| (written, Some(size)))?,
            CSV | RPC3 | MAT => file::write(begun, media_type, stages)?,
            _ => (json::write(begun, stages)?, None),
        };
        Ok(Computed { written, size, media_type, samples, inside })
    }
}

/// The refusal of a prediction that ended in an error of the engine.
pub(in crate::http::predict) fn refusal(error: &EngineError, outputs: &[String]) -> Problem {
    match error {
        EngineError::Cancelled => deadline::over(),
        error => errors::engine(error, outputs, "/drive/channels"),
    }
}

/// Short or long work, by the size of the drive and of the network.
pub fn class(predictor: &Predictor, samples: usize) -> Class {
    if predictor.network_work(samples) > SHORT_WORK {
        return Class::Long;
    }
    let model = predictor.model();
    Class::of_values(samples.saturating_mul(model.inputs.len() + model.outputs.len()))
}

/// The drive as a signal; an NPY body has the model's inputs as columns.
fn parsed(drive: Drive, inputs: &[String]) -> Answer<Signal> {
    let (bytes, sample_rate_hz) = match drive {
        Drive::Signal(signal) => return Ok(signal),
        Drive::Npy { bytes, sample_rate_hz } => (bytes, sample_rate_hz),
    };
    let refuse = |error| {
        let problem = errors::format(&error, inputs);
        errors::count_unreadable("npy", &problem);
        problem
    };
    let columns = formats::npy::header(&bytes).map_err(refuse)?.channels;
    if columns != inputs.len() {
        let limit = format!("{} columns: {}", inputs.len(), inputs.join(", "));
        let detail = format!("The array has {columns} columns; the model takes {limit}.");
        return Err(Problem::new(codes::SIGNAL_CHANNEL_COUNT, detail).with(FieldError::new("", limit)));
    }
    let run = formats::npy::read(&bytes).map_err(refuse)?;
    Signal::new(sample_rate_hz, run.channels).map_err(|error| errors::engine(&error, inputs, ""))
}

/// Refuses another sample rate than the model's.
///
/// # Errors
/// `predict.sample_rate`, which points at `at`.
pub fn check_rate(model: &RigModel, found_hz: f64, at: &str) -> Answer<()> {
    let expected_hz = model.sample_rate_hz;
    if Signal::same_rate(found_hz, expected_hz) {
        return Ok(());
    }
    let limit = format!("{} Hz", rounded(expected_hz, 10));
    let detail = format!("{at} is {} Hz; the model was fitted at {limit}.", rounded(found_hz, 10));
    Err(Problem::new(codes::PREDICT_SAMPLE_RATE, detail).with(FieldError::new(at, limit)))
}

pub(in crate::http::predict) fn check_length(drive: &Signal, target: &Signal) -> Answer<()> {
    if drive.n_samples() == target.n_samples() {
        return Ok(());
    }
    let limit = format!("{} samples, as many as the drive", drive.n_samples());
    let detail = format!("The target has {} samples; it must have {limit}.", target.n_samples());
    Err(Problem::new(codes::PREDICT_UNEQUAL_LENGTHS, detail).with(FieldError::new("/target/channels", limit)))
}

/// The target behind the model's filter, as in its fit: the model predicts nothing else.
pub(in crate::http::predict) fn filtered(target: Target, preprocess: &Preprocess) -> Answer<Target> {
    let Target { names, signal } = target;
    let signal =
        preprocess.apply_to(signal).map_err(|error| errors::engine(&error, &names, "/target/channels"))?;
    Ok(Target { names, signal })
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::engine::lstm::{LstmNet, Recombine};
    use crate::engine::model::{LstmPart, ModelKind, Preprocess, Scaler};

    /// A network of three inputs and six outputs at 1 kHz, windows of 256.
    fn network(cells: usize, hop: usize) -> Predictor {
        let names = |n: usize| (0..n).map(|i| format!("c{i}")).collect();
        let scaler = |n: usize| Scaler { mean: vec![0.0; n], std: vec![1.0; n] };
        let net = LstmNet::init(3, &[cells], 6, 1.0, &mut ChaCha8Rng::seed_from_u64(1));
        let part =
            LstmPart { net, x: scaler(3), y: scaler(6), window_len: 256, hop, recombine: Recombine::Welch };
        Predictor::new(RigModel {
            kind: ModelKind::Lstm,
            inputs: names(3),
            outputs: names(6),
            sample_rate_hz: 1000.0,
            preprocess: Preprocess::default(),
            frf: None,
            frf_quality: None,
            lstm: Some(part),
            range: Vec::new(),
            effects: Vec::new(),
        })
        .expect("a model")
    }

    #[test]
    fn an_hour_is_long_and_so_is_a_minute_of_a_large_network() {
        assert_eq!(class(&network(39, 128), 60_000), Class::Predict);
        assert_eq!(class(&network(39, 128), 3_600_000), Class::Long);
        assert_eq!(class(&network(39, 1), 60_000), Class::Long, "a window a sample");
        assert_eq!(class(&network(200, 128), 60_000), Class::Long);
        assert_eq!(class(&network(200, 128), 1000), Class::Predict);
    }
}
