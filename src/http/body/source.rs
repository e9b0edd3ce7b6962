//! Signals of a request, or a run of the rig that holds them.

use serde::Deserialize;

use super::signals::Channels;
use crate::domain::RunId;
use crate::engine::{EngineError, Signal};
use crate::http::problem::{Answer, FieldError, Problem};
use crate::http::{codes, errors};

/// Signals, or a run that holds them. One flat object, so that errors point at a field and no sample is
/// buffered twice.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Source {
    /// The run.
    #[serde(default)]
    pub run: Option<RunId>,
    /// Sample rate of the signals.
    #[serde(default)]
    pub sample_rate_hz: Option<f64>,
    /// The signals.
    #[serde(default)]
    pub channels: Option<Channels>,
}

/// A source that is one of both.
#[derive(Debug)]
pub enum Given {
    /// A run.
    Run(RunId),
    /// Sample rate and channels.
    Signals(f64, Channels),
}

impl Source {
    /// A run.
    pub fn run(id: RunId) -> Self {
        Self { run: Some(id), sample_rate_hz: None, channels: None }
    }

    /// The one that is given.
    ///
    /// # Errors
    /// A source that is neither or both.
    pub fn given(self, at: &str) -> Answer<Given> {
        match self {
            Self { run: Some(id), sample_rate_hz: None, channels: None } => Ok(Given::Run(id)),
            Self { run: None, sample_rate_hz: Some(rate), channels: Some(channels) } => {
                Ok(Given::Signals(rate, channels))
            }
            Self { run: Some(_), .. } => {
                let limit = "either a run, or sample_rate_hz and channels";
                Err(Problem::new(codes::BODY_INVALID_VALUE, format!("{at} must be {limit}."))
                    .with(FieldError::new(at, limit)))
            }
            Self { run: None, sample_rate_hz, .. } => {
                let field = if sample_rate_hz.is_none() { "sample_rate_hz" } else { "channels" };
                Err(Problem::new(codes::BODY_MISSING_FIELD, format!("{at} lacks {field} (or a run)."))
                    .with(FieldError::new(format!("{at}/{field}"), "required unless a run is named")))
            }
        }
    }
}

/// The signal of these samples, one list a name.
///
/// # Errors
/// A sample rate that is none, unequal lengths, no samples.
pub fn signal(rate: f64, samples: Vec<Vec<f64>>, names: &[String], at: &str) -> Answer<Signal> {
    let signal = Signal::new(rate, samples).map_err(|error| match error {
        // The engine does not know the field that the setting came from.
        EngineError::Setting { limit, .. } => {
            let detail = format!("{at}/sample_rate_hz is {rate}; it must be {limit}.");
            Problem::new(codes::BODY_INVALID_VALUE, detail)
                .with(FieldError::new(format!("{at}/sample_rate_hz"), limit))
        }
        error => errors::engine(&error, names, &format!("{at}/channels")),
    })?;
    if signal.n_samples() == 0 {
        return Err(Problem::new(codes::SIGNAL_EMPTY, format!("{at} has no samples."))
            .with(FieldError::new(format!("{at}/channels"), "at least one sample")));
    }
    Ok(signal)
}
