//! Computes a prediction and writes the answer, off the async threads: one file a form.

mod band;
mod batch;
mod comparison;
mod figures;
mod file;
mod json;
mod multipart;
mod npy;
mod shares;

use std::sync::Arc;

pub(super) use band::{damages_within, reason as no_band};
pub(super) use comparison::{damages, distances, groups};

use super::conversion::{Conversion, ConvertedFrom, Part};
use super::form::Form;
use super::inputs::{Drive, Drives, Target};
use super::memory::Share;
use super::request::Include;
use super::stages::Stages;
use crate::compute::Class;
use crate::domain::Rig;
use crate::engine::fatigue::DamageSettings;
use crate::engine::model::{FallbackUse, Prediction, Predictor, Preprocess, Trust};
use crate::engine::{EngineError, Progress, Signal};
use crate::http::body::pieces::Written;
use crate::http::deadline::{self, Deadline};
use crate::http::negotiate::{CSV, MAT, NPY, RPC3, RPC3_FLOATS};
use crate::http::problem::{Answer, FieldError, Problem};
use crate::http::{codes, errors};
use crate::models::LoadedModel;
use shares::Shares;

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
    /// Whether the model's FRF answers where the drive is outside.
    pub fallback: bool,
    /// Form of the answer.
    pub form: Form,
    /// Conversion of drive and target to the model's rate.
    pub conversion: Conversion,
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
    /// Its `Content-Type`.
    pub content_type: String,
    /// Samples predicted, all outputs together.
    pub samples: u64,
    /// Share of samples at which every input is inside the range that the model was fitted on, if that
    /// range is known; of a batch the least of its drives.
    pub inside: Option<f64>,
    /// Share of the answer that is the FRF's, if it may be; of a batch the greatest of its drives.
    pub fallback_share: Option<f64>,
}

/// The beginning of an answer's body, and the size of all of it where that is known.
type Body = (Written, Option<u64>);

/// Holds for every drive of a request.
struct Setting<'a> {
    rig: &'a Rig,
    loaded: &'a LoadedModel,
    /// Behind the model's filter; none where the answer does not need it.
    target: Option<Target>,
    include: Include,
    damage: DamageSettings,
    fallback: bool,
    converted_from: ConvertedFrom,
    deadline: &'a Deadline,
}

/// A prediction whose inputs were checked.
struct Begun {
    prediction: Prediction,
    trust: Trust,
    /// Where the FRF answers, if it may.
    fallback: Option<FallbackUse>,
}

/// A response with everything that its figures are made from.
struct Predicted {
    response: Signal,
    /// Of the band, if it is asked for and the model has one.
    half_width: Option<Signal>,
    trust: Trust,
    fallback: Option<FallbackUse>,
}

impl PredictionTask {
    /// Short or long work, by the size of drive and network.
    pub fn class(&self) -> Class {
        let inputs = self.model.model().inputs.len();
        let samples = self.drive.n_samples(inputs);
        // A drive of a few samples may become a long one.
        let samples = samples.max(self.conversion.converted(samples, self.drive.sample_rate_hz()));
        class(&self.model.predictor, samples, self.drive.n_drives())
    }

    /// Predicts, compares, counts, and writes the beginning of the answer.
    ///
    /// # Errors
    /// Another sample rate than the model's, a target of another length, settings outside their
    /// limits, a batch that the form has no room for, a result that is not finite; the deadline.
    pub fn run(self, deadline: &Deadline, stages: &mut Stages) -> Answer<Computed> {
        let Self { rig, model: loaded, drive, target, include, damage, fallback, .. } = self;
        let (form, mut conversion, memory) = (self.form, self.conversion, self.memory);
        let model = loaded.model();
        let Drives { mut signals, is_batch } = drive.parse(&model.inputs)?;
        if is_batch {
            form.check_batch()?;
        }
        stages.end("parse");
        let mut convert = |signal| {
            deadline.check()?;
            conversion.apply(signal, &model.inputs, Part::Drive)
        };
        signals = signals.into_iter().map(&mut convert).collect::<Answer<_>>()?;
        let target = match target {
            Some(target) => Some(matching(target, signals[0].n_samples(), &mut conversion)?),
            None => None,
        };
        let target = match target {
            Some(target) if include.damage || include.errors => Some(filtered(target, &model.preprocess)?),
            _ => None,
        };
        let samples = (signals.iter().map(Signal::n_samples).sum::<usize>() * model.outputs.len()) as u64;
        if include.band {
            band::check(samples)?;
        }
        let converted_from = conversion.made();
        let (rig, loaded) = (&rig, &*loaded);
        let setting = Setting { rig, loaded, target, include, damage, fallback, converted_from, deadline };
        let (body, content_type, shares);
        if is_batch {
            (body, content_type, shares) = batch::write(&setting, signals, form, memory, stages)?;
        } else {
            let begun = setting.begin(signals.swap_remove(0), "/drive/channels")?;
            shares = Shares::of(&begun);
            (body, content_type) = write(&setting, begun, form, memory, stages)?;
        }
        let inside = (!model.range.is_empty()).then_some(shares.inside);
        let fallback_share = shares.fallback;
        Ok(Computed { written: body.0, size: body.1, content_type, samples, inside, fallback_share })
    }
}

/// The answer to one drive, and its `Content-Type`.
fn write(
    setting: &Setting<'_>,
    begun: Begun,
    form: Form,
    memory: Share,
    stages: &mut Stages,
) -> Answer<(Body, String)> {
    let media_type = form.media_type;
    if form.with_figures {
        return multipart::write(setting, begun, media_type, memory, stages);
    }
    let body = match media_type {
        NPY => npy::write(setting, begun.prediction, memory, stages)?,
        CSV | RPC3 | RPC3_FLOATS | MAT => file::write(setting, begun.prediction, media_type, memory, stages)?,
        _ => (json::write(setting, begun, memory, stages)?, None),
    };
    Ok((body, media_type.to_owned()))
}

impl Setting<'_> {
    /// Begins the prediction for a drive that was sent at `pointer`.
    ///
    /// # Errors
    /// A result of the model's filter that is not finite.
    fn begin(&self, drive: Signal, pointer: &str) -> Answer<Begun> {
        let (model, predictor) = (self.loaded.model(), &self.loaded.predictor);
        let mut prediction =
            predictor.begin(drive).map_err(|error| errors::engine(&error, &model.inputs, pointer))?;
        let trust = predictor.trust(&prediction);
        let fallback = if self.fallback { predictor.fall_back(&mut prediction, &trust) } else { None };
        Ok(Begun { prediction, trust, fallback })
    }

    /// The whole response to the drive at `pointer`, with its band if that is asked for.
    ///
    /// # Errors
    /// A result that is not finite; the deadline.
    fn predicted(&self, begun: Begun, pointer: &str) -> Answer<Predicted> {
        let Begun { mut prediction, trust, fallback } = begun;
        let response = self.response(&mut prediction, pointer)?;
        let mut half_width = None;
        if self.include.band {
            let found = self.loaded.predictor.half_width(&prediction, &response);
            half_width = found.map_err(|error| self.refusal(&error, pointer))?;
        }
        Ok(Predicted { response, half_width, trust, fallback })
    }

    /// The whole response to the drive at `pointer`.
    ///
    /// # Errors
    /// A result that is not finite; the deadline.
    fn response(&self, prediction: &mut Prediction, pointer: &str) -> Answer<Signal> {
        let watch = |progress: Progress<'_>| self.deadline.watch(progress);
        let response = self.loaded.predictor.rest(prediction, &watch);
        response.map_err(|error| self.refusal(&error, pointer))
    }

    /// The refusal of a prediction that ended in an error of the engine.
    fn refusal(&self, error: &EngineError, pointer: &str) -> Problem {
        refusal(error, &self.loaded.model().outputs, pointer)
    }
}

/// The refusal of a prediction for the drive at `pointer` that ended in an error of the engine.
pub(in crate::http::predict) fn refusal(error: &EngineError, outputs: &[String], pointer: &str) -> Problem {
    match error {
        EngineError::Cancelled => deadline::over(),
        error => errors::engine(error, outputs, pointer),
    }
}

/// Short or long work, by the samples of the drives together, their number, and the size of the network.
pub fn class(predictor: &Predictor, samples: usize, drives: usize) -> Class {
    let of_each = predictor.network_work(samples / drives.max(1));
    if of_each * drives as f64 > SHORT_WORK {
        return Class::Long;
    }
    let model = predictor.model();
    Class::of_values(samples.saturating_mul(model.inputs.len() + model.outputs.len()))
}

/// The target at the model's rate, as long as a drive of `samples`.
fn matching(target: Target, samples: usize, conversion: &mut Conversion) -> Answer<Target> {
    let Target { names, signal } = target;
    // Before it may become many times as long.
    let converted = conversion.converted(signal.n_samples(), signal.sample_rate_hz());
    if converted.abs_diff(samples) > 1 {
        conversion.check(&signal, Part::Target)?;
        check_length(samples, converted)?;
    }
    let signal = conversion.apply(signal, &names, Part::Target)?;
    check_length(samples, signal.n_samples())?;
    Ok(Target { names, signal })
}

/// Refuses a target of another length than the drive's `expected` samples.
pub(in crate::http::predict) fn check_length(expected: usize, found: usize) -> Answer<()> {
    if expected == found {
        return Ok(());
    }
    let limit = format!("{expected} samples, as many as the drive");
    let detail = format!("The target has {found} samples; it must have {limit}.");
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
    use crate::engine::model::{LstmPart, ModelKind, Preprocess, RigModel, Scaler};

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
            core: Vec::new(),
            lstm: Some(part),
            joint_range: None,
            window_range: Vec::new(),
            range: Vec::new(),
            band: None,
            effects: Vec::new(),
        })
        .expect("a model")
    }

    #[test]
    fn an_hour_is_long_and_so_is_a_minute_of_a_large_network() {
        assert_eq!(class(&network(39, 128), 60_000, 1), Class::Predict);
        assert_eq!(class(&network(39, 128), 3_600_000, 1), Class::Long);
        assert_eq!(class(&network(39, 1), 60_000, 1), Class::Long, "a window a sample");
        assert_eq!(class(&network(200, 128), 60_000, 1), Class::Long);
        assert_eq!(class(&network(200, 128), 1000, 1), Class::Predict);
        // Each drive of a batch has windows that reach beyond its ends.
        assert_eq!(class(&network(39, 128), 60_000, 60), Class::Predict);
        assert_eq!(class(&network(39, 128), 60_000, 60_000), Class::Long);
    }
}
