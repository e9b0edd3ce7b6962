//! The named arrays of a file (MAT, NPZ, HDF5), and the run that they are.
//!
//! An array of `[samples]` is a channel of its name, one of `[samples, channels]` several. A vector with a name of
//! times gives the sample rate, and so does a number with a name such as `fs` or `dt`. Text named `names` and `units`
//! labels the channels in their order.

use super::error::excerpt;
use super::times::{Even, Rounding, rate};
use super::{FormatError, ParsedRun, ReadError, Spool, check_channel_count, check_name, step, times};
use crate::engine::rounded;

/// Names, in lower case, of a number that is the sample rate in hertz.
const RATES: [&str; 9] = [
    "fs",
    "f_s",
    "sample_rate",
    "sample_rate_hz",
    "samplerate",
    "sampling_rate",
    "sampling_rate_hz",
    "samplingrate",
    "sampling_frequency",
];

/// Names, in lower case, of a number that is the time between two samples in seconds.
const STEPS: [&str; 5] = ["dt", "delta_t", "deltat", "ts", "sample_interval"];

/// Names, in lower case, of text that names the channels.
const NAMES: [&str; 4] = ["names", "channels", "channel_names", "labels"];

/// Names, in lower case, of text that gives their units.
const UNITS: [&str; 2] = ["units", "unit"];

/// Share by which the sample rate of a time vector may differ from that of a number beside it.
const SAME_RATE: f64 = 1e-3;

/// Share by which a time between two samples is off, as programs compute it.
const STEP_DIGITS: f64 = 1e-12;

/// Most names or units of a file that are kept.
const MAX_TEXTS: usize = super::MAX_CHANNELS;

/// Most bytes of text that labels channels, and of the names of a struct's fields.
pub(super) const MAX_TEXT_BYTES: usize = 1 << 20;

/// Most structs or groups that are inside of one another.
pub(super) const MAX_DEPTH: usize = 8;

/// Most notes about arrays that were left out.
const MAX_NOTES: usize = 20;

/// Arrays of a file so far.
#[derive(Debug)]
pub(super) struct Variables {
    channels: Spool,
    arrays: Vec<Array>,
    times: Option<Times>,
    rate: Option<Rate>,
    names: Option<(String, Vec<String>)>,
    units: Option<(String, Vec<String>)>,
    notes: Vec<String>,
}

/// An array that is one or more channels.
#[derive(Debug)]
struct Array {
    /// Its path in the file, steps parted by dots.
    path: String,
    columns: usize,
    unit: String,
}

/// The vector of times.
#[derive(Debug)]
struct Times {
    path: String,
    /// Seconds a unit.
    scale: f64,
    values: Spool,
}

/// A number that gives the sample rate.
#[derive(Debug)]
struct Rate {
    path: String,
    hz: f64,
}

/// The use of an array, by its name and shape.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Use {
    /// It has no numbers, or none that a run has.
    Nothing,
    /// `rows` numbers for each of `columns` channels, the first of them the spool's column `first`.
    Channels {
        first: usize,
        rows: usize,
        columns: usize,
    },
    /// As many times.
    Times {
        rows: usize,
    },
    /// One number: the sample rate, or the time between two samples.
    Rate,
    Step,
}

impl Variables {
    /// No arrays yet; samples go to this empty spool.
    pub(super) fn new(channels: Spool) -> Self {
        Self {
            channels,
            arrays: Vec::new(),
            times: None,
            rate: None,
            names: None,
            units: None,
            notes: Vec::new(),
        }
    }

    /// Takes an array of numbers of this shape, samples first; dimensions of one are no dimensions. Its numbers are
    /// given to [`Self::extend`] afterwards.
    ///
    /// # Errors
    /// `variables.unsupported` for more than two dimensions or a second vector of times; `run.too_many_channels`.
    pub(super) fn begin(&mut self, path: &str, shape: &[u64]) -> Result<Use, FormatError> {
        check_name(path)?;
        let sizes: Vec<u64> = shape.iter().copied().filter(|&n| n != 1).collect();
        if sizes.contains(&0) {
            self.note(format!("{:?} is empty and was left out.", excerpt(path)));
            return Ok(Use::Nothing);
        }
        let (rows, columns) = match sizes[..] {
            [] => return Ok(self.number(path)),
            [rows] => (rows, 1),
            [rows, columns] => (rows, columns),
            _ => {
                let reason = format!("has the shape {shape:?}: [samples] and [samples, channels] are read");
                return Err(unsupported(path, reason));
            }
        };
        check_channel_count(columns.saturating_add(self.channels.n_columns() as u64))?;
        let too_long = |_| unsupported(path, format!("declares {rows} samples, more than can be addressed"));
        let rows = usize::try_from(rows).map_err(too_long)?;
        // It was compared with the most channels.
        let columns = columns as usize;
        if columns == 1
            && let Some(scale) = times::seconds_by_name(leaf(path))
        {
            if let Some(first) = &self.times {
                return Err(unsupported(
                    path,
                    format!("is a second vector of times beside {:?}", first.path),
                ));
            }
            let mut values = self.channels.another();
            values.add_columns(1);
            self.times = Some(Times { path: path.to_owned(), scale, values });
            return Ok(Use::Times { rows });
        }
        let first = self.channels.n_columns();
        self.channels.add_columns(columns);
        self.arrays.push(Array { path: path.to_owned(), columns, unit: String::new() });
        Ok(Use::Channels { first, rows, columns })
    }

    /// The use of a single number.
    fn number(&mut self, path: &str) -> Use {
        rate_use(path).unwrap_or_else(|| {
            self.note(format!("{:?} is a single number and was left out.", excerpt(path)));
            Use::Nothing
        })
    }

    /// Adds numbers of a column of an array.
    ///
    /// # Errors
    /// Those of the file of the spool; `run.sample_rate`; `variables.unsupported` for a second sample rate that
    /// differs.
    pub(super) fn extend(
        &mut self,
        path: &str,
        at: Use,
        column: usize,
        values: impl IntoIterator<Item = f64>,
    ) -> Result<(), ReadError> {
        match at {
            Use::Nothing => {}
            Use::Channels { first, .. } => self.channels.extend(first + column, values)?,
            Use::Times { .. } => {
                self.times.as_mut().expect("it has begun").values.extend(0, values)?;
            }
            Use::Rate | Use::Step => {
                for value in values {
                    let hz = if at == Use::Rate { value } else { step::rate(value, STEP_DIGITS)? };
                    self.sample_rate(path, hz)?;
                }
            }
        }
        Ok(())
    }

    /// Takes a sample rate that the file gives as a number.
    ///
    /// # Errors
    /// `run.sample_rate`; `variables.unsupported` for one that differs from the first.
    pub(super) fn sample_rate(&mut self, path: &str, hz: f64) -> Result<(), FormatError> {
        if !(hz.is_finite() && hz > 0.0) {
            return Err(FormatError::SampleRate { found: hz });
        }
        match &self.rate {
            Some(first) => first.agrees(path, hz),
            None => {
                self.rate = Some(Rate { path: path.to_owned(), hz });
                Ok(())
            }
        }
    }

    /// Takes a number that is an attribute of a file or array; one that is no sample rate says nothing of the run.
    ///
    /// # Errors
    /// Those of a sample rate.
    pub(super) fn attribute(&mut self, path: &str, value: f64) -> Result<(), ReadError> {
        match rate_use(path) {
            Some(at) => self.extend(path, at, 0, [value]),
            None => Ok(()),
        }
    }

    /// Takes the unit of the last array.
    pub(super) fn unit(&mut self, unit: String) {
        if let Some(array) = self.arrays.last_mut() {
            array.unit = unit;
        }
    }

    /// Takes text: names or units of the channels by its own name, else it says nothing of them.
    pub(super) fn text(&mut self, path: &str, mut texts: Vec<String>) {
        texts.truncate(MAX_TEXTS + 1);
        let texts = texts.into_iter().map(|text| text.trim().to_owned()).collect();
        let name = leaf(path).to_lowercase();
        if NAMES.contains(&name.as_str()) {
            self.names = Some((path.to_owned(), texts));
        } else if UNITS.contains(&name.as_str()) {
            self.units = Some((path.to_owned(), texts));
        }
    }

    /// Whether text of this name labels the channels.
    pub(super) fn is_label(path: &str) -> bool {
        let name = leaf(path).to_lowercase();
        NAMES.contains(&name.as_str()) || UNITS.contains(&name.as_str())
    }

    fn note(&mut self, note: String) {
        // A file may have any number of them.
        if self.notes.len() < MAX_NOTES {
            self.notes.push(note);
        }
    }

    /// The run of these arrays.
    ///
    /// # Errors
    /// The `run.*` codes; `variables.uneven_time`; `variables.unsupported` where labels and channels differ in number or
    /// two sample rates disagree. Errors of the file system.
    pub(super) fn finish(self) -> Result<ParsedRun<Spool>, ReadError> {
        let n = self.channels.n_columns();
        let (rate, error) = self.rate_of_times(self.arrays.is_empty())?;
        let names = match self.names {
            Some((path, names)) => Some(one_each(&path, names, n)?),
            None => names(&self.arrays),
        };
        let units = match self.units {
            Some((path, units)) => Some(one_each(&path, units, n)?),
            None => self.arrays.iter().any(|a| !a.unit.is_empty()).then(|| {
                let units = self.arrays.iter();
                units.flat_map(|a| std::iter::repeat_n(a.unit.clone(), a.columns)).collect()
            }),
        };
        names.iter().flatten().try_for_each(|name| check_name(name))?;
        let run = ParsedRun {
            sample_rate_hz: rate,
            sample_rate_error: error,
            names,
            units,
            notes: self.notes,
            ..ParsedRun::of(self.channels)
        };
        Ok(run.check()?)
    }

    /// The sample rate and its largest relative error.
    fn rate_of_times(&self, is_empty: bool) -> Result<(Option<f64>, f64), ReadError> {
        let given = self.rate.as_ref().map(|rate| rate.hz);
        let Some(times) = self.times.as_ref().filter(|_| !is_empty) else { return Ok((given, 0.0)) };
        let n = times.values.len(0);
        if n != self.channels.len(0) {
            let reason = format!("has {n} times for {} samples", self.channels.len(0));
            return Err(unsupported(&times.path, reason).into());
        }
        match rate(&times.values, Rounding::NONE, times.scale)? {
            Even::Single => Ok((given, 0.0)),
            Even::Rate { rate_hz, error } => match &self.rate {
                Some(rate) => rate.agrees(&times.path, rate_hz).map(|()| (given, 0.0)).map_err(Into::into),
                None => Ok((Some(rate_hz), error)),
            },
            Even::Not { sample, usual_s, found_s } => Err(FormatError::VariableUnevenTime {
                variable: times.path.clone(),
                sample,
                step_s: usual_s,
                found_s,
            }
            .into()),
        }
    }
}

impl Rate {
    fn agrees(&self, path: &str, hz: f64) -> Result<(), FormatError> {
        if (hz - self.hz).abs() <= SAME_RATE * self.hz {
            return Ok(());
        }
        let [found, first] = [hz, self.hz].map(|hz| rounded(hz, 6));
        Err(unsupported(path, format!("gives {found} Hz, and {:?} gives {first} Hz", self.path)))
    }
}

/// Names of the channels: those of the arrays, with a number for each column of several. None for a single array of
/// several channels and for NumPy's `arr_0`, `arr_1`, ..., which say nothing of them.
fn names(arrays: &[Array]) -> Option<Vec<String>> {
    let is_numbered =
        |array: &Array| array.path.strip_prefix("arr_").is_some_and(|n| n.parse::<u32>().is_ok());
    if matches!(arrays, [array] if array.columns > 1) || arrays.iter().all(is_numbered) {
        return None;
    }
    let each = |name: fn(&str) -> &str| -> Vec<String> {
        let columns = |array: &Array| -> Vec<String> {
            let name = name(&array.path);
            match array.columns {
                1 => vec![name.to_owned()],
                n => (1..=n).map(|column| format!("{name}_{column}")).collect(),
            }
        };
        arrays.iter().flat_map(columns).collect()
    };
    let short = each(leaf);
    let mut sorted: Vec<&String> = short.iter().collect();
    sorted.sort_unstable();
    let are_distinct = sorted.is_sorted_by(|a, b| a < b);
    Some(if are_distinct { short } else { each(|path| path) })
}

/// Labels, of which there must be one a channel.
fn one_each(path: &str, labels: Vec<String>, channels: usize) -> Result<Vec<String>, FormatError> {
    if labels.len() != channels {
        let reason = format!("holds {} labels for {channels} channels", labels.len());
        return Err(unsupported(path, reason));
    }
    Ok(labels)
}

/// The use of a number whose name says that it is the sample rate or the time between two samples.
fn rate_use(path: &str) -> Option<Use> {
    let name = leaf(path).to_lowercase();
    let name = name.as_str();
    if RATES.contains(&name) { Some(Use::Rate) } else { STEPS.contains(&name).then_some(Use::Step) }
}

/// The last step of a path.
fn leaf(path: &str) -> &str {
    path.rsplit('.').next().unwrap_or(path)
}

/// The error of a variable that is not read.
pub(super) fn unsupported(variable: &str, reason: impl Into<String>) -> FormatError {
    FormatError::Variable { name: excerpt(variable), reason: reason.into() }
}
