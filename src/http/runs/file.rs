//! Turns an uploaded file into a run: format, names and sample rate, all checked against the rig.

use std::path::Path;

use super::upload::{self, Upload};
use crate::domain::Rig;
use crate::domain::run::RunMeta;
use crate::engine::resample::{ResampleError, resample_pieces};
use crate::engine::{Samples, Signal, rounded};
use crate::formats::rpc3::Reading;
use crate::formats::{self, ParsedRun, ReadError, Spool, SpooledSamples};
use crate::http::jobs::word;
use crate::http::negotiate::{CSV, NPY, RPC3, UFF58};
use crate::http::params::{Params, invalid};
use crate::http::problem::{Answer, FieldError, Problem};
use crate::http::{body, codes, errors, json};
use crate::storage::{PrepareError, PreparedRun};

/// Formats of run files.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// Text with a header row.
    Csv,
    /// NumPy array.
    Npy,
    /// RPC III time history.
    Rpc3,
    /// Universal File Format, data sets 58.
    Uff58,
    /// Sample rate and channels by name.
    Json,
}

impl Format {
    /// By media type.
    ///
    /// # Errors
    /// `content_type.unsupported`.
    pub fn of(media_type: Option<&str>) -> Answer<Self> {
        match media_type {
            Some(CSV) => Ok(Self::Csv),
            Some(NPY) => Ok(Self::Npy),
            Some(RPC3) => Ok(Self::Rpc3),
            Some(UFF58) => Ok(Self::Uff58),
            Some(json::MEDIA_TYPE) => Ok(Self::Json),
            other => Err(body::unsupported(other, &[CSV, NPY, RPC3, UFF58, json::MEDIA_TYPE])),
        }
    }

    fn as_str(self) -> &'static str {
        match self {
            Self::Csv => "csv",
            Self::Npy => "npy",
            Self::Rpc3 => "rpc3",
            Self::Uff58 => "uff58",
            Self::Json => "json",
        }
    }

    /// Reads piece by piece into a spool in `scratch`, so that a file of any size takes the same memory.
    fn read(self, upload: &Upload, scratch: &Path, rpc3: Reading) -> Result<ParsedRun<Spool>, ReadError> {
        let (file, spool) = (upload.open()?, Spool::in_file(scratch));
        match self {
            Self::Csv => formats::csv::read_from(file, spool),
            Self::Npy => formats::npy::read_from(file, upload.size() as u64, spool),
            Self::Rpc3 => formats::rpc3::read_from(file, upload.size() as u64, spool, rpc3),
            Self::Uff58 => formats::uff58::read_from(file, spool),
            Self::Json => formats::json::read_from(file, spool),
        }
    }
}

/// The query parameters about the file.
#[derive(Debug)]
pub struct RunFile {
    channels: Option<Vec<String>>,
    sample_rate_hz: Option<f64>,
    resample: bool,
    rpc3: Reading,
}

impl RunFile {
    /// Takes `channels`, `sample_rate_hz`, `resample`, `padding` and `scale`.
    ///
    /// # Errors
    /// `query.invalid`.
    pub fn take(params: &mut Params) -> Answer<Self> {
        let limit = "a positive number of hertz";
        let sample_rate_hz = params.number("sample_rate_hz", limit)?;
        if let Some(rate) = sample_rate_hz.filter(|&r| r <= 0.0) {
            return Err(invalid("sample_rate_hz", format!("is {rate}"), limit));
        }
        let channels = params.one("channels")?;
        let channels = channels.map(|text| text.split(',').map(|name| name.trim().to_owned()).collect());
        let rpc3 = Reading {
            padding: word(params, "padding", "strip or keep")?.unwrap_or_default(),
            scale: word(params, "scale", "count or full_scale")?.unwrap_or_default(),
        };
        Ok(Self { channels, sample_rate_hz, resample: params.flag("resample")?, rpc3 })
    }

    /// Reads the file and makes it a run of `rig`, by way of files in `scratch`. Takes processor time: call it
    /// off the async threads.
    ///
    /// # Errors
    /// Errors of the format's reader; channels, sample rate or units that are not the rig's; `store.full`.
    pub fn prepare(
        self,
        rig: &Rig,
        meta: RunMeta,
        format: Format,
        upload: Upload,
        scratch: &Path,
    ) -> Answer<PreparedRun> {
        // Errors of the query are reported before the file is parsed.
        check_channels(self.channels.iter().flatten(), rig)?;
        self.rate(None, rig)?;
        let rig_names: Vec<String> = rig.channels.iter().map(|c| c.name.clone()).collect();
        let named = self.channels.as_ref().unwrap_or(&rig_names);
        let parsed = format.read(&upload, scratch, self.rpc3).map_err(|error| match error {
            ReadError::Io(error) => upload::disk(error),
            ReadError::Format(error) => {
                let problem = errors::format(&error, named);
                errors::count_unreadable(format.as_str(), &problem);
                problem
            }
        })?;
        let ParsedRun { sample_rate_hz, names, units, channels } = parsed;
        let names = self.names(format, names, channels.n_columns(), rig_names)?;
        check_channels(&names, rig)?;
        let rate = self.rate(sample_rate_hz, rig)?;
        let sha256 = upload.sha256();
        // Its room on the disk is free for the copies.
        drop(upload);
        let mut samples = channels.at_rate(rate);
        if !Signal::same_rate(rate, rig.sample_rate_hz) {
            samples = resampled(samples, rig.sample_rate_hz, scratch).map_err(|error| match error {
                ResampleError::Engine(error) => errors::engine(&error, &names, ""),
                ResampleError::Io(error) => upload::disk(error),
            })?;
        }
        PreparedRun::new(scratch, rig, meta, names, units, samples, sha256).map_err(|error| match error {
            PrepareError::Store(error) => error.into(),
            PrepareError::Unsuitable(found) => {
                Problem::new(codes::RUN_INVALID, errors::summary("The run does not suit the rig", &found))
                    .with_all(found)
            }
        })
    }

    /// Names of the columns: the file's own, else the query's, else the rig's. Descriptions of RPC III and UFF 58 are
    /// text for people, so that the query's names, in the order of the file, come before them.
    fn names(
        &self,
        format: Format,
        own: Option<Vec<String>>,
        columns: usize,
        rig: Vec<String>,
    ) -> Answer<Vec<String>> {
        let names = match (own, &self.channels) {
            (Some(own), None) => own,
            (Some(_), Some(asked)) if matches!(format, Format::Rpc3 | Format::Uff58) => asked.clone(),
            (Some(_), Some(_)) => {
                return Err(invalid("channels", "is given", "left out for a file that names its channels"));
            }
            (None, Some(asked)) => asked.clone(),
            (None, None) => rig,
        };
        if names.len() != columns {
            let limit = format!("{} columns: {}", names.len(), names.join(", "));
            let detail = format!("The file has {columns} columns and {} names.", names.len());
            return Err(Problem::new(codes::RUN_CHANNEL_COUNT, detail).with(FieldError::new("", limit)));
        }
        Ok(names)
    }

    /// Sample rate of the file: its own, else the query's, else the rig's. It may differ from the rig's
    /// only with `resample`.
    fn rate(&self, own: Option<f64>, rig: &Rig) -> Answer<f64> {
        let refuse = |found: f64, expected: f64| {
            let limit = format!("{} Hz", rounded(expected, 10));
            let detail = format!(
                "The run has a sample rate of {} Hz; {limit} is expected (or resample=true to convert it).",
                rounded(found, 10)
            );
            Problem::new(codes::RUN_SAMPLE_RATE, detail).with(FieldError::new("", limit))
        };
        let rate = match (own, self.sample_rate_hz) {
            (Some(own), Some(asked)) if !Signal::same_rate(own, asked) => return Err(refuse(own, asked)),
            (own, asked) => own.or(asked).unwrap_or(rig.sample_rate_hz),
        };
        if Signal::same_rate(rate, rig.sample_rate_hz) {
            return Ok(rig.sample_rate_hz);
        }
        if self.resample { Ok(rate) } else { Err(refuse(rate, rig.sample_rate_hz)) }
    }
}

/// The samples at another rate, in a spool of their own.
fn resampled(
    mut samples: SpooledSamples,
    to_hz: f64,
    scratch: &Path,
) -> Result<SpooledSamples, ResampleError> {
    let mut spool = Spool::in_file(scratch);
    spool.add_columns(samples.n_channels());
    resample_pieces(&mut samples, to_hz, |channel, piece| spool.extend(channel, piece))?;
    Ok(spool.at_rate(to_hz))
}

fn check_channels<'a>(names: impl IntoIterator<Item = &'a String>, rig: &Rig) -> Answer<()> {
    match names.into_iter().find(|name| rig.channel(name).is_none()) {
        None => Ok(()),
        Some(name) => {
            let detail = format!("The rig has no channel {name:?}.");
            Err(Problem::new(codes::RUN_UNKNOWN_CHANNEL, detail)
                .with(FieldError::new("", "a channel of the rig").on_channel(name)))
        }
    }
}
