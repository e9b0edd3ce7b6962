//! Turns the drive and target of a request into signals for the model.

use bytes::Bytes;

use crate::domain::{RigId, Run};
use crate::engine::{Samples, Signal};
use crate::formats;
use crate::formats::npy::Batch;
use crate::http::body::signals::Channels;
use crate::http::body::source::{Given, Source, signal};
use crate::http::measurement::Measurement;
use crate::http::paths::no_run;
use crate::http::problem::{Answer, FieldError, Problem};
use crate::http::{Shared, codes, errors, upload};
use crate::models::LoadedModel;

/// A model's inputs; an NPY body is parsed later, off the async threads.
#[derive(Debug)]
pub enum Drive {
    /// In the order of the model's inputs.
    Signal(Signal),
    /// Still to be parsed.
    Npy {
        /// The file.
        bytes: Bytes,
        /// Its sample rate.
        sample_rate_hz: f64,
    },
}

impl Drive {
    /// Samples of each input, all drives of a batch together; for an NPY body that cannot be read an upper bound from
    /// its bytes.
    pub fn n_samples(&self, inputs: usize) -> usize {
        match self {
            Self::Signal(signal) => signal.n_samples(),
            // The shortest type has two bytes a number.
            Self::Npy { bytes, .. } => formats::npy::batch_header(bytes)
                .map_or(bytes.len() / (2 * inputs.max(1)), |(header, _)| header.samples),
        }
    }

    /// Samples per second, as the client says.
    pub fn sample_rate_hz(&self) -> f64 {
        match self {
            Self::Signal(signal) => signal.sample_rate_hz(),
            Self::Npy { sample_rate_hz, .. } => *sample_rate_hz,
        }
    }

    /// Number of drives; of an NPY body that cannot be read, one.
    pub fn n_drives(&self) -> usize {
        match self {
            Self::Signal(_) => 1,
            Self::Npy { bytes, .. } => {
                formats::npy::batch_header(bytes).ok().and_then(|(_, batch)| batch).unwrap_or(1)
            }
        }
    }

    /// The drives as signals: the columns of an NPY body are the model's inputs.
    ///
    /// # Errors
    /// Those of the NPY format; another number of columns; more drives than a batch may have.
    pub fn parse(self, inputs: &[String]) -> Answer<Drives> {
        let (bytes, sample_rate_hz) = match self {
            Self::Signal(signal) => return Ok(Drives { signals: vec![signal], is_batch: false }),
            Self::Npy { bytes, sample_rate_hz } => (bytes, sample_rate_hz),
        };
        let refuse = |error| {
            let problem = errors::format(&error, inputs);
            errors::count_unreadable("npy", &problem);
            problem
        };
        let (header, batch) = formats::npy::batch_header(&bytes).map_err(refuse)?;
        if header.channels != inputs.len() {
            let (columns, limit) =
                (header.channels, format!("{} columns: {}", inputs.len(), inputs.join(", ")));
            let detail = format!("The array has {columns} columns; the model takes {limit}.");
            return Err(Problem::new(codes::SIGNAL_CHANNEL_COUNT, detail).with(FieldError::new("", limit)));
        }
        if let Some(drives) = batch.filter(|&drives| drives > MAX_BATCH) {
            let limit = format!("at most {MAX_BATCH} drives");
            let detail = format!("The batch has {drives} drives; it may have {limit}.");
            return Err(Problem::new(codes::PREDICT_BATCH_SIZE, detail).with(FieldError::new("", limit)));
        }
        let Batch { signals, is_batch } = formats::npy::read_batch(&bytes).map_err(refuse)?;
        drop(bytes);
        let signal = |channels| {
            Signal::new(sample_rate_hz, channels).map_err(|error| errors::engine(&error, inputs, ""))
        };
        let signals = signals.into_iter().map(signal).collect::<Answer<_>>()?;
        Ok(Drives { signals, is_batch })
    }
}

/// One drive, or a batch of drives of the same length.
#[derive(Debug)]
pub struct Drives {
    /// The drives, at least one.
    pub signals: Vec<Signal>,
    /// Whether the answer has the dimension of the batch, with one drive too.
    pub is_batch: bool,
}

/// Most drives of a batch: a generation of a search, and as many figures as an answer may hold beside its file.
const MAX_BATCH: usize = 1024;

/// Some or all of a model's outputs, in their order.
#[derive(Debug)]
pub struct Target {
    /// Names of its channels.
    pub names: Vec<String>,
    /// Its samples.
    pub signal: Signal,
}

/// The signals of a source, or the run that holds them and is not read yet.
#[derive(Debug)]
pub enum Found {
    /// A run.
    Run(Box<Run>),
    /// Sample rate and channels.
    Signals(f64, Channels),
}

impl Found {
    /// Samples of each channel; of signals whose lengths differ those of the longest.
    pub fn n_samples(&self) -> usize {
        match self {
            Self::Run(run) => usize::try_from(run.samples).unwrap_or(usize::MAX),
            Self::Signals(_, channels) => {
                channels.0.iter().map(|(_, samples)| samples.len()).max().unwrap_or_default()
            }
        }
    }

    /// Samples per second, as the client says.
    pub fn sample_rate_hz(&self) -> f64 {
        match self {
            Self::Run(run) => run.sample_rate_hz,
            Self::Signals(rate, _) => *rate,
        }
    }

    /// Sample rate, channels, and whether they are a run's; of a run only those that are `wanted`.
    async fn read(self, http: &Shared, wanted: &[String]) -> Answer<(f64, Channels, bool)> {
        let run = match self {
            Self::Signals(rate, channels) => return Ok((rate, channels, false)),
            Self::Run(run) => run,
        };
        let (columns, names): (Vec<usize>, Vec<String>) =
            run.channels.iter().cloned().enumerate().filter(|(_, name)| wanted.contains(name)).unzip();
        if columns.is_empty() {
            return Ok((run.sample_rate_hz, Channels::default(), true));
        }
        let signal = http.store.load_channels(&run, columns).await?;
        let rate = signal.sample_rate_hz();
        Ok((rate, Channels(names.into_iter().zip(signal.into_channels()).collect()), true))
    }
}

/// The drive of a JSON request.
///
/// # Errors
/// A channel that is missing or that the model does not have, unequal lengths, no samples.
pub async fn drive(http: &Shared, found: Found, model: &LoadedModel) -> Answer<Drive> {
    let wanted = &model.model().inputs;
    let (rate, mut channels, from_run) = found.read(http, wanted).await?;
    let mut samples = Vec::with_capacity(wanted.len());
    for name in wanted {
        samples.push(channels.take(name).ok_or_else(|| missing(name, "/drive"))?);
    }
    // A run may hold other channels too; in signals of the request they are a mistake.
    if !from_run && let Some((name, _)) = channels.0.first() {
        return Err(unknown(name, "/drive", "an input of the model"));
    }
    signal(rate, samples, wanted, "/drive").map(Drive::Signal)
}

/// The drive of a measurement file: the model's inputs among its channels. Other channels of the rig may be there too.
///
/// # Errors
/// A channel that is missing; those of the file of the samples.
pub fn measured(measurement: Measurement, model: &LoadedModel) -> Answer<Drive> {
    let Measurement { names, mut samples, .. } = measurement;
    let wanted = &model.model().inputs;
    let mut channels = Vec::with_capacity(wanted.len());
    for name in wanted {
        let column = names.iter().position(|n| n == name);
        // A file has no fields to point at.
        let column = column.ok_or_else(|| lacks(name, "The file", String::new()))?;
        let mut values = Vec::with_capacity(samples.n_samples());
        samples.read(column, 0..samples.n_samples(), &mut values).map_err(upload::disk)?;
        channels.push(values);
    }
    signal(samples.sample_rate_hz(), channels, wanted, "").map(Drive::Signal)
}

/// The target of a JSON request.
///
/// # Errors
/// As [`drive`]; none of the model's outputs.
pub async fn target(http: &Shared, found: Found, model: &LoadedModel) -> Answer<Target> {
    let outputs = &model.model().outputs;
    let (rate, mut channels, from_run) = found.read(http, outputs).await?;
    let (mut names, mut samples) = (Vec::new(), Vec::new());
    for name in outputs {
        if let Some(found) = channels.take(name) {
            names.push(name.clone());
            samples.push(found);
        }
    }
    if !from_run && let Some((name, _)) = channels.0.first() {
        return Err(unknown(name, "/target", "an output of the model"));
    }
    if names.is_empty() {
        return Err(missing(&outputs[0], "/target"));
    }
    let signal = signal(rate, samples, &names, "/target")?;
    Ok(Target { names, signal })
}

/// Finds the run of a source, or takes its signals.
///
/// # Errors
/// A source that is neither or both, a run that is not there.
pub async fn find(http: &Shared, rig: &RigId, source: Source, at: &str) -> Answer<Found> {
    match source.given(at)? {
        Given::Run(id) => {
            let run = http.store.run(rig, id).await?.ok_or_else(|| no_run(&id.to_string()))?;
            Ok(Found::Run(Box::new(run)))
        }
        Given::Signals(rate, channels) => Ok(Found::Signals(rate, channels)),
    }
}

fn missing(name: &str, at: &str) -> Problem {
    lacks(name, at, format!("{at}/channels"))
}

/// The problem of something, in words, that lacks a channel.
fn lacks(name: &str, what: &str, pointer: String) -> Problem {
    let detail = format!("{what} lacks the channel {name:?}.");
    let place = FieldError::new(pointer, "required by the model").on_channel(name);
    Problem::new(codes::PREDICT_MISSING_CHANNEL, detail).with(place)
}

fn unknown(name: &str, at: &str, limit: &str) -> Problem {
    let detail = format!("{at} has the channel {name:?}, which is not {limit}.");
    let place = FieldError::new(format!("{at}/channels"), limit).on_channel(name);
    Problem::new(codes::PREDICT_UNKNOWN_CHANNEL, detail).with(place)
}
