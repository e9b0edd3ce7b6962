//! Reads a measurement file as channels of a rig: format, names, units and sample rate, all checked against the rig.

use std::io::Read;
use std::path::Path;

use super::upload::{self, Upload};
use crate::domain::Rig;
use crate::domain::columns::{Column, ColumnFault, assign, left_out};
use crate::engine::resample::{ResampleError, resample_pieces};
use crate::engine::{Samples, Signal, rounded};
use crate::formats::rpc3::Reading;
use crate::formats::{self, ChannelAt, Format, FormatError, ParsedRun, ReadError, Spool, SpooledSamples};
use crate::http::jobs::word;
use crate::http::negotiate::{CSV, HDF5, MAT, NPY, NPZ, RPC3, UFF58};
use crate::http::params::{Params, invalid};
use crate::http::problem::{Answer, FieldError, Problem};
use crate::http::{body, codes, errors, json};

/// Media types that say nothing of a file: those of unknown bytes, of any text, of CSV on a PC with a spreadsheet
/// program, and of curl's `--data-binary`.
const GENERAL: [&str; 5] = [
    "application/octet-stream",
    "text/plain",
    "text/tab-separated-values",
    "application/vnd.ms-excel",
    "application/x-www-form-urlencoded",
];

/// Media types of the formats that are read.
pub const OFFERED: [&str; 8] = [CSV, NPY, NPZ, RPC3, MAT, HDF5, UFF58, json::MEDIA_TYPE];

/// The format by media type; `None` for one that any file may have, as programs send it that know no better.
///
/// # Errors
/// `content_type.unsupported`.
pub fn format(media_type: Option<&str>) -> Answer<Option<Format>> {
    match media_type {
        Some(CSV) => Ok(Some(Format::Csv)),
        Some(NPY) => Ok(Some(Format::Npy)),
        Some(RPC3) => Ok(Some(Format::Rpc3)),
        Some(NPZ) => Ok(Some(Format::Npz)),
        Some(MAT) => Ok(Some(Format::Mat)),
        Some(HDF5) => Ok(Some(Format::Hdf5)),
        Some(UFF58) => Ok(Some(Format::Uff58)),
        Some(json::MEDIA_TYPE) => Ok(Some(Format::Json)),
        None => Ok(None),
        Some(general) if GENERAL.contains(&general) => Ok(None),
        other => Err(body::unsupported(other, &OFFERED)),
    }
}

/// The format by the first bytes of a file.
///
/// # Errors
/// `content_type.unsupported` for formats that are known and not read.
fn detect(upload: &Upload) -> Answer<Format> {
    let mut start = Vec::new();
    let read = upload.open().and_then(|file| file.take(Format::START as u64).read_to_end(&mut start));
    read.map_err(upload::disk)?;
    Format::detect(&start).map_err(|name| {
        let offered = OFFERED.join(", ");
        let detail = format!("The file is {name}. Export it as CSV; {offered} are read.");
        Problem::new(codes::CONTENT_TYPE_UNSUPPORTED, detail).with(FieldError::new("", offered))
    })
}

/// Reads piece by piece into a spool in `scratch`, so that a file of any size takes the same memory.
fn parse(
    format: Format,
    upload: &Upload,
    scratch: &Path,
    rpc3: Reading,
) -> Result<ParsedRun<Spool>, ReadError> {
    let (file, spool) = (upload.open()?, Spool::in_file(scratch));
    match format {
        Format::Csv => formats::csv::read_from(file, spool),
        Format::Npy => formats::npy::read_from(file, upload.size() as u64, spool),
        Format::Rpc3 => formats::rpc3::read_from(file, upload.size() as u64, spool, rpc3),
        Format::Npz => formats::npz::read_from(file, upload.size() as u64, spool),
        Format::Mat => formats::mat::read_from(file, upload.size() as u64, spool),
        Format::Hdf5 => formats::hdf5::read_from(file, upload.size() as u64, spool),
        Format::Uff58 => formats::uff58::read_from(file, spool),
        Format::Json => formats::json::read_from(file, spool),
    }
}

/// The query parameters about the file.
#[derive(Debug)]
pub struct FileQuery {
    channels: Option<Vec<String>>,
    sample_rate_hz: Option<f64>,
    resample: bool,
    ignore: Vec<String>,
    rpc3: Reading,
}

/// A file as channels of a rig.
#[derive(Debug)]
pub struct Measurement {
    /// Its format.
    pub format: Format,
    /// Sample rate of the file.
    pub sample_rate_hz: f64,
    /// What each of its columns is taken for.
    pub columns: Vec<Column>,
    /// The rig's channels among them, in their order.
    pub names: Vec<String>,
    /// Their samples, in the rig's units and at its rate.
    pub samples: SpooledSamples,
    /// What they have otherwise than the file, and what the file leaves open, a sentence each.
    pub changes: Vec<String>,
    /// Digest of the file.
    pub sha256: String,
}

impl FileQuery {
    /// Takes `channels`, `sample_rate_hz`, `resample`, `ignore`, `padding` and `scale`.
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
        let ignore = params.all("ignore");
        let ignore =
            ignore.iter().flat_map(|text| text.split(',')).map(|name| name.trim().to_owned()).collect();
        Ok(Self { channels, sample_rate_hz, resample: params.flag("resample")?, ignore, rpc3 })
    }

    /// Reads the file as channels of `rig` at its rate, by way of files in `scratch`. Takes processor time: call it
    /// off the async threads.
    ///
    /// # Errors
    /// Errors of the format's reader; channels, sample rate or units that are not the rig's.
    pub fn read(
        self,
        rig: &Rig,
        format: Option<Format>,
        upload: Upload,
        scratch: &Path,
    ) -> Answer<Measurement> {
        // Errors of the query are reported before the file is parsed.
        self.check_channels(rig)?;
        self.rate(None, 0.0, rig)?;
        let format = match format {
            // Version 7.3 is another format under the same media type.
            Some(Format::Mat) if matches!(detect(&upload), Ok(Format::Hdf5)) => Format::Hdf5,
            Some(format) => format,
            None => detect(&upload)?,
        };
        let rig_names: Vec<String> = rig.channels.iter().map(|c| c.name.clone()).collect();
        let named = self.channels.as_ref().unwrap_or(&rig_names);
        let parsed = parse(format, &upload, scratch, self.rpc3).map_err(|error| match error {
            ReadError::Io(error) => upload::disk(error),
            ReadError::Format(error) => {
                let problem = errors::format(&error, named);
                errors::count_unreadable(format.as_str(), &problem);
                problem
            }
        })?;
        let time = self.time_column(&parsed, rig)?;
        let ParsedRun {
            mut sample_rate_hz, mut sample_rate_error, names, units, channels, mut notes, ..
        } = parsed;
        let named_columns = channels.n_columns() - usize::from(time.is_some());
        let names = self.names(format, names, named_columns, rig_names)?;
        let mut columns = assign(&names, units.as_deref(), rig, &self.ignore).map_err(unassigned)?;
        notes.extend(left_out(&columns));
        if let Some(time) = time {
            if let (None, Some((rate, error))) = (sample_rate_hz, time.rate) {
                (sample_rate_hz, sample_rate_error) = (Some(rate), error);
            }
            notes.push(time.note());
            columns.insert(0, time.column());
        }
        let taken = taken(&columns, &channels)?;
        let rate = self.rate(sample_rate_hz, sample_rate_error, rig)?;
        let sha256 = upload.sha256();
        // Its room on the disk is free for the copies.
        drop(upload);
        let names: Vec<String> = columns.iter().filter_map(|column| column.channel.clone()).collect();
        let mut samples = channels.at_rate(rate).of_columns(taken);
        let is_resampled = !Signal::same_rate(rate, rig.sample_rate_hz);
        if is_resampled {
            samples = resampled(samples, rig.sample_rate_hz, scratch).map_err(|error| match error {
                ResampleError::Engine(error) => errors::engine(&error, &names, ""),
                ResampleError::Io(error) => upload::disk(error),
            })?;
        }
        let changes = changes(&columns, rig, is_resampled.then_some(rate), notes, sample_rate_error);
        Ok(Measurement { format, sample_rate_hz: rate, columns, names, samples, changes, sha256 })
    }

    /// Checks that the names of the query are channels of the rig or columns to leave out.
    fn check_channels(&self, rig: &Rig) -> Answer<()> {
        let names = self.channels.as_deref().unwrap_or_default();
        assign(names, None, rig, &self.ignore).map(drop).or_else(|fault| match fault {
            ColumnFault::Unknown(_) => Err(unassigned(fault)),
            // The file's own faults come first.
            ColumnFault::Unsuitable(_) => Ok(()),
        })
    }

    /// The first column of a file that names none, where it is one column more than there are names for and rises in even
    /// steps. Its unit is the one that gives the sample rate wanted, else s; steps of 1 that give none count samples.
    fn time_column(&self, parsed: &ParsedRun<Spool>, rig: &Rig) -> Answer<Option<TimeColumn>> {
        let names = self.channels.as_ref().map_or(rig.channels.len(), Vec::len);
        if parsed.names.is_some() || parsed.channels.n_columns() != names + 1 {
            return Ok(None);
        }
        let Some((per_unit, error)) = parsed.even_first_column().map_err(upload::disk)? else {
            return Ok(None);
        };
        let wanted = parsed.sample_rate_hz.or(self.sample_rate_hz).unwrap_or(rig.sample_rate_hz);
        let is_wanted = |rate: f64| (rate - wanted).abs() <= error.max(1e-6) * wanted;
        let (unit, rate) = if is_wanted(per_unit) {
            ("s", Some(per_unit))
        } else if is_wanted(1e3 * per_unit) {
            ("ms", Some(1e3 * per_unit))
        } else if per_unit == 1.0 {
            ("samples", None)
        } else {
            ("s", Some(per_unit))
        };
        Ok(Some(TimeColumn { unit, rate: rate.map(|rate| (rate, error)) }))
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
    /// only with `resample`. The file's own may be off by the share `error`.
    fn rate(&self, own: Option<f64>, error: f64, rig: &Rig) -> Answer<f64> {
        let refuse = |found: f64, expected: f64| {
            let limit = format!("{} Hz", rounded(expected, 10));
            let detail = format!(
                "The run has a sample rate of {} Hz; {limit} is expected (or resample=true to convert it).",
                rounded(found, 10)
            );
            Problem::new(codes::RUN_SAMPLE_RATE, detail).with(FieldError::new("", limit))
        };
        let exact = self.sample_rate_hz.unwrap_or(rig.sample_rate_hz);
        let own = own.map(|own| if (own - exact).abs() <= error * exact { exact } else { own });
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

/// The first column of a file without names, taken for the time.
struct TimeColumn {
    unit: &'static str,
    /// Sample rate and its largest relative error; none of a number of the sample.
    rate: Option<(f64, f64)>,
}

impl TimeColumn {
    /// As a column that is no channel.
    fn column(&self) -> Column {
        Column { name: "time".to_owned(), unit: Some(self.unit.to_owned()), channel: None, factor: 1.0 }
    }

    fn note(&self) -> String {
        let taken = match self.rate {
            Some(_) => format!("the time in {}", self.unit),
            None => "the number of the sample".to_owned(),
        };
        format!("The first of the columns without names rises in even steps and was taken for {taken}.")
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

/// Index and factor of the columns that are channels.
fn taken(columns: &[Column], samples: &Spool) -> Answer<Vec<(usize, f64)>> {
    let mut taken = Vec::new();
    for (index, column) in columns.iter().enumerate().filter(|(_, column)| column.channel.is_some()) {
        if column.factor != 1.0
            && let Some(sample) = samples.first_overflow(index, column.factor).map_err(upload::disk)?
        {
            let channel = ChannelAt { index, name: Some(column.name.clone()) };
            let error = FormatError::NonFinite { channel, sample, row: None, column: None };
            return Err(errors::format(&error, &[]));
        }
        taken.push((index, column.factor));
    }
    if taken.is_empty() {
        return Err(errors::format(&FormatError::NoChannels, &[]));
    }
    Ok(taken)
}

/// What the run has otherwise than its file, and what the file leaves open, a sentence each.
fn changes(
    columns: &[Column],
    rig: &Rig,
    resampled_from: Option<f64>,
    notes: Vec<String>,
    sample_rate_error: f64,
) -> Vec<String> {
    let of_columns = columns.iter().filter_map(|column| column.conversion(rig));
    let of_rate = resampled_from.map(|rate| {
        format!("Resampled from {} Hz to {} Hz.", rounded(rate, 10), rounded(rig.sample_rate_hz, 10))
    });
    let of_times = (sample_rate_error > 0.0).then(|| {
        let share = rounded(100.0 * sample_rate_error, 2);
        format!("The times in the file are rounded: they give its sample rate within {share} %.")
    });
    of_columns.chain(of_rate).chain(notes).chain(of_times).collect()
}

fn unassigned(fault: ColumnFault) -> Problem {
    match fault {
        ColumnFault::Unknown(found) => {
            let names: Vec<String> =
                found.iter().filter_map(|e| e.channel.as_ref()).map(|name| format!("{name:?}")).collect();
            let detail = match &names[..] {
                [one] => format!("The rig has no channel {one}."),
                _ => format!("The rig has no channels {}.", names.join(", ")),
            };
            Problem::new(codes::RUN_UNKNOWN_CHANNEL, detail).with_all(found)
        }
        ColumnFault::Unsuitable(found) => unsuitable(found),
    }
}

/// The problem of a run that does not suit its rig.
pub fn unsuitable(found: Vec<FieldError>) -> Problem {
    Problem::new(codes::RUN_INVALID, errors::summary("The run does not suit the rig", &found)).with_all(found)
}
