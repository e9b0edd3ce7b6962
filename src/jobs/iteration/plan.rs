//! The plan of an iteration, resolved without loading a sample: model, target, start and limits.

use std::collections::BTreeMap;

use crate::domain::iteration::StartDrive;
use crate::domain::rig::Role;
use crate::domain::{FieldError, FitChannels, IterationRequest, Model, ModelRef, Rig, Run, RunId};
use crate::engine::iteration::DriveLimit;
use crate::engine::{Signal, rounded};
use crate::storage::Store;

use super::super::problem::of_setting;
use super::problem::IterationProblem;

/// Fewest samples of a target.
const MIN_SAMPLES: u64 = 64;

/// An iteration with everything resolved.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::jobs) struct IterationPlan {
    pub model: Model,
    /// Names of the target's channels, in the model's order.
    pub channels: Vec<String>,
    /// Their places among the model's outputs.
    pub outputs: Vec<usize>,
    /// The run that the search begins with, where it is one.
    pub start: Option<Run>,
    /// One a target channel.
    pub weights: Vec<f64>,
    /// One a target channel.
    pub gains: Vec<f64>,
    /// One a drive.
    pub limits: Vec<DriveLimit>,
    /// Name of the run that will hold the drive.
    pub name: String,
}

impl IterationPlan {
    /// Drives and target channels.
    pub fn channels(&self) -> FitChannels {
        FitChannels { inputs: self.model.inputs.clone(), outputs: self.channels.clone() }
    }
}

/// A target before its samples are loaded.
pub(in crate::jobs) struct TargetOutline<'a> {
    /// Name of its run, if it has one.
    pub name: &'a str,
    pub channels: &'a [String],
    /// The channels that are wanted of it; all that the model predicts, if none are named.
    pub wanted: Option<&'a [String]>,
    pub samples: u64,
    pub sample_rate_hz: f64,
    /// Whether its samples are in the request, by the name of their channel.
    pub is_sent: bool,
}

impl TargetOutline<'_> {
    /// The field that says which samples it has.
    fn samples_at(&self) -> &'static str {
        if self.is_sent { "/target/channels" } else { "/target/run" }
    }

    fn rate_at(&self) -> &'static str {
        if self.is_sent { "/target/sample_rate_hz" } else { "/target/run" }
    }

    fn channel_at(&self, index: usize, name: &str) -> String {
        if self.is_sent { pointer("target/channels", name) } else { format!("/target/channels/{index}") }
    }
}

/// Resolves a request against the rig, its models and runs, without loading a sample; gives the run of the target too.
///
/// # Errors
/// See [`IterationProblem`].
pub(in crate::jobs) async fn check(
    store: &Store,
    rig: &Rig,
    request: &IterationRequest,
) -> Result<(IterationPlan, Run), IterationProblem> {
    let target = run(store, rig, request.target.run, "/target/run").await?;
    let outline = TargetOutline {
        name: &target.name,
        channels: &target.channels,
        wanted: request.target.channels.as_deref(),
        samples: target.samples,
        sample_rate_hz: target.sample_rate_hz,
        is_sent: false,
    };
    let plan = check_for(store, rig, request, &outline).await?;
    Ok((plan, target))
}

/// [`check`] for a target that is no run yet; the request's own target is not looked at.
///
/// # Errors
/// See [`IterationProblem`].
pub(in crate::jobs) async fn check_for<T>(
    store: &Store,
    rig: &Rig,
    request: &IterationRequest<T>,
    target: &TargetOutline<'_>,
) -> Result<IterationPlan, IterationProblem> {
    request.settings().check().map_err(|error| IterationProblem::Invalid(vec![of_setting(&error)]))?;
    let version = match request.model {
        ModelRef::Version(version) => version,
        ModelRef::Active => {
            let active = store.active_model(&rig.id).await?.ok_or(IterationProblem::RigGone)?;
            active.version.ok_or(IterationProblem::NoneActive)?
        }
    };
    let model = store.model(&rig.id, version).await?.ok_or(IterationProblem::NoModel(version))?;
    forward(rig, &model)?;
    let start = match request.start {
        StartDrive::Run(id) => Some(run(store, rig, id, "/start/run").await?),
        StartDrive::Inverse | StartDrive::Zero => None,
    };
    plan(rig, request, model, target, start)
}

async fn run(store: &Store, rig: &Rig, id: RunId, pointer: &str) -> Result<Run, IterationProblem> {
    let found = store.run(&rig.id, id).await?;
    found.ok_or_else(|| {
        IterationProblem::Invalid(vec![FieldError::new(
            pointer,
            format!("a run of the rig; it has no run {id}"),
        )])
    })
}

fn forward(rig: &Rig, model: &Model) -> Result<(), IterationProblem> {
    let no_drive = |name: &&String| rig.channel(name).is_none_or(|channel| channel.role != Role::Drive);
    let inputs: Vec<&str> = model.inputs.iter().filter(no_drive).map(String::as_str).collect();
    if inputs.is_empty() {
        return Ok(());
    }
    Err(IterationProblem::NotForward { version: model.version, inputs: inputs.join(", ") })
}

fn plan<T>(
    rig: &Rig,
    request: &IterationRequest<T>,
    model: Model,
    target: &TargetOutline<'_>,
    start: Option<Run>,
) -> Result<IterationPlan, IterationProblem> {
    let mut errors = Vec::new();
    let outputs = outputs(&model, target, &mut errors);
    let channels: Vec<String> = outputs.iter().map(|&output| model.outputs[output].clone()).collect();
    if target.samples < MIN_SAMPLES {
        let limit = format!("at least {MIN_SAMPLES} samples; it has {}", target.samples);
        errors.push(FieldError::new(target.samples_at(), limit));
    }
    let start_rate = start.as_ref().map(|start| ("/start/run", start.sample_rate_hz));
    for (pointer, rate) in std::iter::once((target.rate_at(), target.sample_rate_hz)).chain(start_rate) {
        if !Signal::same_rate(rate, model.sample_rate_hz) {
            let [wanted, found] = [model.sample_rate_hz, rate].map(|hz| rounded(hz, 10));
            let limit = format!("{wanted} Hz, the model's sample rate; it has {found} Hz");
            return Err(IterationProblem::SampleRate(FieldError::new(pointer, limit)));
        }
    }
    if let Some(start) = &start {
        for drive in model.inputs.iter().filter(|drive| !start.channels.contains(drive)) {
            errors.push(FieldError::new("/start/run", "a run that holds every drive").on_channel(drive));
        }
        if start.samples != target.samples {
            let limit =
                format!("{} samples, as many as the target; it has {}", target.samples, start.samples);
            errors.push(FieldError::new("/start/run", limit));
        }
    }
    let positive = |v: f64| v.is_finite() && v > 0.0;
    let weights =
        each(&request.weights, "weights", &channels, 1.0, "a positive number", positive, &mut errors);
    let gains = each(
        &request.gains,
        "gains",
        &channels,
        1.0,
        "from 0 to 2",
        |v| (0.0..=2.0).contains(&v),
        &mut errors,
    );
    let limits = limits(request, &model, &mut errors);
    let name = name(rig, request.name.as_deref(), target.name, &mut errors);
    if !errors.is_empty() {
        return Err(IterationProblem::Invalid(errors));
    }
    Ok(IterationPlan { model, channels, outputs, start, weights, gains, limits, name })
}

/// Places of the target's channels among the model's outputs, in the model's order.
fn outputs(model: &Model, target: &TargetOutline<'_>, errors: &mut Vec<FieldError>) -> Vec<usize> {
    let has = |name: &String| target.channels.contains(name);
    let Some(wanted) = target.wanted else {
        let found: Vec<usize> =
            (0..model.outputs.len()).filter(|&output| has(&model.outputs[output])).collect();
        if found.is_empty() {
            let limit = format!("a run that holds one of {}", model.outputs.join(", "));
            errors.push(FieldError::new(target.samples_at(), limit));
        }
        return found;
    };
    if wanted.is_empty() {
        errors.push(FieldError::new("/target/channels", "at least one channel"));
    }
    for (i, name) in wanted.iter().enumerate() {
        let at = || target.channel_at(i, name);
        if !model.outputs.contains(name) {
            let limit = format!("one of {}, which the model predicts", model.outputs.join(", "));
            errors.push(FieldError::new(at(), limit).on_channel(name));
        } else if !has(name) {
            errors.push(FieldError::new(at(), "a channel of the target's run").on_channel(name));
        } else if wanted[..i].contains(name) {
            errors.push(FieldError::new(at(), "each channel once").on_channel(name));
        }
    }
    (0..model.outputs.len()).filter(|&output| wanted.contains(&model.outputs[output])).collect()
}

/// One number a channel, `otherwise` where the request gives none.
fn each(
    given: &BTreeMap<String, f64>,
    field: &str,
    channels: &[String],
    otherwise: f64,
    limit: &str,
    allowed: impl Fn(f64) -> bool,
    errors: &mut Vec<FieldError>,
) -> Vec<f64> {
    for (name, value) in given {
        let pointer = pointer(field, name);
        if !channels.contains(name) {
            let limit = format!("one of {}", channels.join(", "));
            errors.push(FieldError::new(pointer, limit).on_channel(name));
        } else if !allowed(*value) {
            errors.push(FieldError::new(pointer, limit).on_channel(name));
        }
    }
    channels.iter().map(|name| given.get(name).copied().unwrap_or(otherwise)).collect()
}

fn limits<T>(request: &IterationRequest<T>, model: &Model, errors: &mut Vec<FieldError>) -> Vec<DriveLimit> {
    for (name, limit) in &request.limits {
        let pointer = pointer("limits", name);
        if !model.inputs.contains(name) {
            let limit = format!("one of {}", model.inputs.join(", "));
            errors.push(FieldError::new(pointer, limit).on_channel(name));
        } else if let Some(fault) = limit.fault() {
            errors.push(FieldError::new(format!("{pointer}/{fault}"), "a positive number").on_channel(name));
        }
    }
    model.inputs.iter().map(|name| request.limits.get(name).copied().unwrap_or_default()).collect()
}

fn pointer(field: &str, name: &str) -> String {
    format!("/{field}/{}", name.replace('~', "~0").replace('/', "~1"))
}

/// Name of the run that will hold the drive.
fn name(rig: &Rig, asked: Option<&str>, target: &str, errors: &mut Vec<FieldError>) -> String {
    use crate::domain::text::{MAX_NAME_CHARS, check_text};
    match asked {
        Some(name) => {
            check_text(errors, "/name", name, 0);
            name.to_owned()
        }
        None => {
            let of = if target.is_empty() { rig.id.as_str() } else { target };
            format!("drive for {of}").chars().take(MAX_NAME_CHARS).collect()
        }
    }
}
