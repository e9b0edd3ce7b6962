//! Computes a prediction and writes the answer, off the async threads.

use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::sync::Arc;

use serde::Serialize;

use super::NPY;
use super::inputs::{Drive, Target};
use super::request::Include;
use super::stages::Stages;
use crate::compute::Class;
use crate::domain::{Base, Rig};
use crate::engine::fatigue::{
    DamageChannel, DamageGroup, DamageReport, DamageSettings, Omission, OmittedGroup, damage_report,
};
use crate::engine::metrics::{self, ChannelErrors, ErrorSettings};
use crate::engine::model::{Predictor, Preprocess, RigModel, TrustSpan, VersionKind};
use crate::engine::{EngineError, Progress, Signal, rounded};
use crate::formats;
use crate::http::body::signals::write_json;
use crate::http::deadline::{self, Deadline};
use crate::http::problem::{Answer, FieldError, Problem};
use crate::http::{codes, errors, json};
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
}

/// An answer, but for its headers.
#[derive(Debug)]
pub struct Computed {
    /// The body.
    pub bytes: Vec<u8>,
    /// Its media type.
    pub media_type: &'static str,
    /// Samples predicted, all outputs together.
    pub samples: u64,
    /// Share of samples at which every input is inside the range that the model was fitted on, if that
    /// range is known.
    pub inside: Option<f64>,
}

/// Trust; unknown for imported weights without a range.
#[derive(Debug, Serialize)]
struct TrustAnswer {
    inside: Option<f64>,
    spans: Vec<TrustSpan>,
}

/// Errors by channel name.
#[derive(Debug, Serialize)]
struct ErrorReport {
    settings: ComparisonSettings,
    channels: BTreeMap<String, ChannelErrors>,
}

/// How a prediction was compared with its target.
#[derive(Debug, Serialize)]
struct ComparisonSettings {
    #[serde(flatten)]
    errors: ErrorSettings,
    /// The model's filter, which the target has passed before the comparison.
    preprocess: Preprocess,
}

/// Damage, and the filter that the target has passed, if there are both.
#[derive(Debug, Serialize)]
struct DamageAnswer {
    #[serde(flatten)]
    report: DamageReport,
    #[serde(skip_serializing_if = "Preprocess::is_none")]
    preprocess: Preprocess,
}

#[derive(Debug, Serialize)]
struct ModelAnswer<'a> {
    version: u32,
    kind: VersionKind,
    #[serde(skip_serializing_if = "Option::is_none")]
    base: Option<&'a Base>,
    sha256: &'a str,
}

impl PredictionTask {
    /// A prediction whose drive came as NPY: no target, no settings.
    pub fn of_npy(rig: Rig, model: Arc<LoadedModel>, drive: Drive, media_type: &'static str) -> Self {
        let include = Include { response: true, damage: false, errors: false, trust: true };
        Self { rig, model, drive, target: None, include, damage: DamageSettings::default(), media_type }
    }

    /// The kind of model, as a metric's label.
    pub fn kind(&self) -> &'static str {
        self.model.model().version_kind().as_str()
    }

    /// Short or long work, by the size of drive and network.
    pub fn class(&self) -> Class {
        let inputs = self.model.model().inputs.len();
        class(&self.model.predictor, self.drive.n_samples(inputs))
    }

    /// Predicts, compares, counts, writes.
    ///
    /// # Errors
    /// Another sample rate than the model's, a target of another length, settings outside their
    /// limits, a result that is not finite; the deadline.
    pub fn run(self, deadline: &Deadline, stages: &mut Stages) -> Answer<Computed> {
        let Self { rig, model: loaded, drive, target, include, damage, media_type } = self;
        let (model, predictor) = (loaded.model(), &loaded.predictor);
        check_rate(model, drive.sample_rate_hz(), "/drive/sample_rate_hz")?;
        let drive = parsed(drive, &model.inputs)?;
        stages.end("parse");
        if let Some(target) = &target {
            check_rate(model, target.signal.sample_rate_hz(), "/target/sample_rate_hz")?;
            check_length(&drive, &target.signal)?;
        }
        let outputs = &model.outputs;
        let target = match target {
            Some(target) if include.damage || include.errors => Some(filtered(target, &model.preprocess)?),
            _ => None,
        };
        let refuse = |error: EngineError| errors::engine(&error, outputs, "/drive/channels");
        let mut prediction = predictor
            .begin(drive)
            .map_err(|error| errors::engine(&error, &model.inputs, "/drive/channels"))?;
        let trust = predictor.trust(&prediction);
        let known = !model.range.is_empty();
        let trust = TrustAnswer { inside: known.then_some(trust.inside), spans: trust.spans };
        let n = prediction.n_samples();
        let samples = (n * outputs.len()) as u64;
        let inside = trust.inside;
        if media_type == NPY {
            // Each piece is written and dropped, so that an hour of response is in memory once.
            let mut npy = formats::npy::Writer::new(n, outputs.len());
            while let Some(piece) = predictor.next(&mut prediction).map_err(refuse)? {
                npy.write(piece.channels()).map_err(|error| errors::format(&error, outputs))?;
                deadline.check()?;
            }
            stages.end("simulate");
            return Ok(Computed { bytes: npy.finish(), media_type, samples, inside });
        }
        let watch = |_: Progress<'_>| {
            if deadline.check().is_ok() { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
        };
        let response = match predictor.rest(&mut prediction, &watch) {
            Err(EngineError::Cancelled) => return Err(deadline::over()),
            response => response.map_err(refuse)?,
        };
        drop(prediction);
        stages.end("simulate");
        let name = ModelAnswer {
            version: loaded.version,
            kind: model.version_kind(),
            base: loaded.base.as_ref(),
            sha256: &loaded.sha256,
        };
        let mut answer = json::Object::new();
        answer.add("model", &name)?;
        if include.response {
            write_json(answer.field("response"), outputs, &response);
        }
        if include.damage {
            let report = damages(&rig, outputs, &response, target.as_ref(), &damage)?;
            let preprocess = if target.is_some() { model.preprocess } else { Preprocess::default() };
            answer.add("damage", &DamageAnswer { report, preprocess })?;
        }
        if let Some(target) = target.as_ref().filter(|_| include.errors) {
            answer.add("errors", &distances(outputs, &response, target, model.preprocess)?)?;
        }
        if include.trust {
            answer.add("trust", &trust)?;
        }
        stages.end("report");
        Ok(Computed { bytes: answer.finish(), media_type: json::MEDIA_TYPE, samples, inside })
    }
}

fn class(predictor: &Predictor, samples: usize) -> Class {
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

fn check_rate(model: &RigModel, found_hz: f64, at: &str) -> Answer<()> {
    let expected_hz = model.sample_rate_hz;
    if Signal::same_rate(found_hz, expected_hz) {
        return Ok(());
    }
    let limit = format!("{} Hz", rounded(expected_hz, 10));
    let detail = format!("{at} is {} Hz; the model was fitted at {limit}.", rounded(found_hz, 10));
    Err(Problem::new(codes::PREDICT_SAMPLE_RATE, detail).with(FieldError::new(at, limit)))
}

fn check_length(drive: &Signal, target: &Signal) -> Answer<()> {
    if drive.n_samples() == target.n_samples() {
        return Ok(());
    }
    let limit = format!("{} samples, as many as the drive", drive.n_samples());
    let detail = format!("The target has {} samples; it must have {limit}.", target.n_samples());
    Err(Problem::new(codes::PREDICT_UNEQUAL_LENGTHS, detail).with(FieldError::new("/target/channels", limit)))
}

/// The target behind the model's filter, as in its fit: the model predicts nothing else.
fn filtered(target: Target, preprocess: &Preprocess) -> Answer<Target> {
    let Target { names, signal } = target;
    let signal =
        preprocess.apply_to(signal).map_err(|error| errors::engine(&error, &names, "/target/channels"))?;
    Ok(Target { names, signal })
}

/// Damage of every output, and Multi-Rain of every group of the rig whose channels are outputs.
fn damages(
    rig: &Rig,
    outputs: &[String],
    response: &Signal,
    target: Option<&Target>,
    settings: &DamageSettings,
) -> Answer<DamageReport> {
    let wanted = |name: &String| {
        let target = target?;
        let place = target.names.iter().position(|n| n == name)?;
        Some(target.signal.channel(place))
    };
    let channels: Vec<DamageChannel<'_>> = outputs
        .iter()
        .zip(response.channels())
        .map(|(name, predicted)| DamageChannel { name, predicted, target: wanted(name) })
        .collect();
    let (groups, omitted) = groups(rig, outputs);
    let mut report =
        damage_report(&channels, &groups, settings).map_err(|error| errors::engine(&error, outputs, ""))?;
    report.omitted.extend(omitted);
    Ok(report)
}

/// Groups with the places of their channels among the outputs, in the rig's order; and those of which
/// only a part is among them.
fn groups<'a>(rig: &'a Rig, outputs: &[String]) -> (Vec<DamageGroup<'a>>, Vec<OmittedGroup>) {
    let mut members: Vec<(&str, Vec<&str>)> = Vec::new();
    for channel in &rig.channels {
        let Some(group) = channel.group.as_deref() else { continue };
        match members.iter_mut().find(|(name, _)| *name == group) {
            Some((_, names)) => names.push(&channel.name),
            None => members.push((group, vec![&channel.name])),
        }
    }
    let (mut whole, mut partial) = (Vec::new(), Vec::new());
    for (name, members) in members {
        let place = |member: &&str| outputs.iter().position(|output| output == member);
        let places: Vec<usize> = members.iter().filter_map(place).collect();
        if let Ok(channels) = <[usize; 3]>::try_from(&places[..]) {
            whole.push(DamageGroup { name, channels });
        } else if !places.is_empty() {
            let missing = members.iter().filter(|member| place(member).is_none());
            let channels = missing.map(|member| (*member).to_owned()).collect();
            partial.push(OmittedGroup { group: name.to_owned(), channels, reason: Omission::NotPredicted });
        }
    }
    (whole, partial)
}

/// Errors of the outputs that have a target.
fn distances(
    outputs: &[String],
    response: &Signal,
    target: &Target,
    preprocess: Preprocess,
) -> Answer<ErrorReport> {
    let places: Vec<usize> =
        target.names.iter().filter_map(|name| outputs.iter().position(|output| output == name)).collect();
    let found = metrics::errors(&target.signal, &response.select(&places))
        .map_err(|error| errors::engine(&error, &target.names, "/target/channels"))?;
    let channels = target.names.iter().cloned().zip(found.channels).collect();
    Ok(ErrorReport { settings: ComparisonSettings { errors: found.settings, preprocess }, channels })
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
