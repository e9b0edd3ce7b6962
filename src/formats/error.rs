//! Errors of measurement files, with the place in the file.

use super::MAX_NAME_BYTES;
use crate::engine::rounded;

/// A channel of a file: by name where the file names it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ChannelAt {
    /// Index among the file's channels, from 0, without a time column.
    pub index: usize,
    /// Name in the file.
    pub name: Option<String>,
}

impl std::fmt::Display for ChannelAt {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match &self.name {
            Some(name) => write!(f, "{name:?}"),
            None => write!(f, "{} (counted from 0)", self.index),
        }
    }
}

/// A place in a UFF file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct UffPlace {
    /// The data set 58, counted from 1 among those of the file; none outside of them.
    pub set: Option<usize>,
    /// Line of the file, from 1; none behind binary numbers, which have no lines.
    pub line: Option<u64>,
    /// Bytes of the file before the place.
    pub byte: u64,
}

impl std::fmt::Display for UffPlace {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        if let Some(set) = self.set {
            write!(f, "data set 58 number {set}, ")?;
        }
        match self.line {
            Some(line) => write!(f, "line {line}"),
            None => write!(f, "after {} bytes", self.byte),
        }
    }
}

/// The reason why a file was not read: its content is wrong, or the file system failed.
#[derive(Debug, thiserror::Error)]
pub enum ReadError {
    /// The content is wrong.
    #[error(transparent)]
    Format(#[from] FormatError),
    /// The file system failed.
    #[error(transparent)]
    Io(#[from] std::io::Error),
}

impl ReadError {
    /// The error of a file in memory.
    pub(crate) fn of_bytes(self) -> FormatError {
        match self {
            Self::Format(error) => error,
            Self::Io(error) => unreachable!("bytes in memory can be read ({error}): this is a bug"),
        }
    }
}

/// The reason why a file was refused. Rows and columns count from 1, as editors show them: a row is a line of
/// the file, a column a cell (CSV) or a byte (JSON, UFF). Samples count from 0.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum FormatError {
    /// No samples at all.
    #[error("the file holds no samples")]
    Empty,
    /// No channel, or only a time column.
    #[error("the file holds no channels")]
    NoChannels,
    /// More channels than [`MAX_CHANNELS`](super::MAX_CHANNELS).
    #[error("the file has {found} channels, at most {limit} are read; arrays are [samples, channels]")]
    TooManyChannels {
        /// Channels found.
        found: u64,
        /// Most channels.
        limit: usize,
    },
    /// Two channels of one name.
    #[error("two channels are named {name:?}")]
    DuplicateChannel {
        /// The name.
        name: String,
    },
    /// A name longer than any channel's.
    #[error("the channel name that begins {start:?} is longer than {MAX_NAME_BYTES} bytes")]
    LongName {
        /// Its first 40 characters.
        start: String,
    },
    /// Channels differ in length.
    #[error("channel {channel} has {found} samples, the first channel has {expected}")]
    UnequalLengths {
        /// The channel that differs from the first.
        channel: ChannelAt,
        /// Samples of the first channel.
        expected: usize,
        /// Samples of this channel.
        found: usize,
    },
    /// NaN, infinity, or a number beyond the range of the file's type.
    #[error("channel {channel} is not finite at sample {sample}")]
    NonFinite {
        /// The channel.
        channel: ChannelAt,
        /// Sample, from 0.
        sample: usize,
        /// Line of the file, where it has lines.
        row: Option<u64>,
        /// Cell of the line, where it has cells.
        column: Option<usize>,
    },
    /// NaN or infinity in one of the signals of a batch.
    #[error("channel {channel} of signal {signal} is not finite at sample {sample}")]
    NonFiniteInBatch {
        /// The signal, from 0.
        signal: usize,
        /// Its channel.
        channel: ChannelAt,
        /// Its sample, from 0.
        sample: usize,
    },
    /// A sample rate that is not a positive, finite number.
    #[error("sample_rate_hz is {}, it must be positive and finite", short(*found))]
    SampleRate {
        /// The rate.
        found: f64,
    },
    /// A first row that is not a header.
    #[error("row {row}, column {column}: {reason}")]
    CsvHeader {
        /// Line of the file.
        row: u64,
        /// Cell of the line.
        column: usize,
        /// What is wrong.
        reason: &'static str,
    },
    /// A cell that is no number.
    #[error("row {row}, column {column}: {found:?} is not a number")]
    CsvNotANumber {
        /// Line of the file.
        row: u64,
        /// Cell of the line.
        column: usize,
        /// Name of the column.
        name: Option<String>,
        /// The cell, cut after 40 characters.
        found: String,
    },
    /// A cell that is one number where its mark begins the decimals, and another where it groups thousands.
    #[error(
        "row {row}, column {column}: {found:?} may have decimals or thousands, as other cells of the file show; \
         export it without marks between thousands"
    )]
    CsvAmbiguousNumber {
        /// Line of the file.
        row: u64,
        /// Cell of the line.
        column: usize,
        /// Name of the column.
        name: Option<String>,
        /// The cell, cut after 40 characters.
        found: String,
    },
    /// A row with more or fewer cells than the first; an empty line between rows has none.
    #[error("row {row} has {found} cells, the first row has {expected}")]
    CsvRagged {
        /// Line of the file.
        row: u64,
        /// Cells of the first row.
        expected: usize,
        /// Cells of this row.
        found: usize,
    },
    /// A row that is too long to be kept.
    #[error("row {row} is longer than {limit} bytes")]
    CsvLongRow {
        /// Line of the file.
        row: u64,
        /// Most bytes.
        limit: usize,
    },
    /// A time column that does not rise in even steps.
    #[error(
        "row {row}: the time step is {} s, and not the {} s of most rows (within 0.1 %)",
        short(*found_s),
        short(*step_s)
    )]
    CsvUnevenTime {
        /// Line of the file.
        row: u64,
        /// Cell of the line.
        column: usize,
        /// The step of most rows.
        step_s: f64,
        /// The step from the row before.
        found_s: f64,
    },
    /// A time column in a unit other than s and ms, or more than one time column.
    #[error("row {row}, column {column}: {reason}")]
    CsvTime {
        /// Line of the file.
        row: u64,
        /// Cell of the line.
        column: usize,
        /// What is wrong.
        reason: &'static str,
    },
    /// Not an NPY file, or a header that does not follow its format.
    #[error("NPY header: {0}")]
    NpyHeader(&'static str),
    /// A dtype that is not read: object, structured, text, complex, other widths.
    #[error("NPY dtype {found}: float32, float64, int16 and int32 are read")]
    NpyDtype {
        /// Text of the header, cut after 40 characters.
        found: String,
    },
    /// A shape that is neither `[samples, channels]` nor `[samples]`.
    #[error("NPY shape {found:?}: expected [samples, channels] or [samples]")]
    NpyShape {
        /// Text of the header.
        found: Vec<u64>,
    },
    /// The header declares more data than there is.
    #[error("the NPY header declares {expected} bytes of data, the file has {found}")]
    NpyTruncated {
        /// Bytes that dtype and shape ask for.
        expected: u64,
        /// Bytes behind the header.
        found: u64,
    },
    /// There is more data than the header declares.
    #[error("the NPY header declares {expected} bytes of data, the file has {found}")]
    NpyTrailing {
        /// Bytes that dtype and shape ask for.
        expected: u64,
        /// Bytes behind the header.
        found: u64,
    },
    /// Not an RPC III file, or a header that does not follow its format.
    #[error("RPC III header: {0}")]
    Rpc3Header(String),
    /// A kind of RPC III file that is not read.
    #[error("RPC III header: {key} is {found:?}; {expected} is read")]
    Rpc3Unsupported {
        /// The key word.
        key: &'static str,
        /// Its value, cut after 40 characters.
        found: String,
        /// The values that are read.
        expected: &'static str,
    },
    /// Channels, frames and groups of the header ask for another number of bytes than there are.
    #[error(
        "the RPC III header declares {} bytes of data, the file has {found}",
        expected.map_or_else(|| "more than 2^64".to_owned(), |n| n.to_string())
    )]
    Rpc3Size {
        /// Bytes that the header asks for, where they can be counted.
        expected: Option<u64>,
        /// Bytes behind the header.
        found: u64,
    },
    /// Not a UFF file, or a record that does not follow its format.
    #[error("UFF {at}: {reason}")]
    Uff58Header {
        /// The record.
        at: UffPlace,
        /// What is wrong.
        reason: String,
    },
    /// A kind of UFF data that is not read.
    #[error("UFF {at}: {found}; {expected} is read")]
    Uff58Unsupported {
        /// The record that says so.
        at: UffPlace,
        /// The kind.
        found: String,
        /// The kinds that are read.
        expected: &'static str,
    },
    /// A channel of another start or sample interval than the first.
    #[error(
        "channel {channel} has a {what} of {} s, the first channel one of {} s; channels of one time axis are read",
        short(*found_s),
        short(*expected_s)
    )]
    Uff58Unlike {
        /// The channel that differs from the first.
        channel: ChannelAt,
        /// The quantity that differs.
        what: &'static str,
        /// Value of the first channel.
        expected_s: f64,
        /// Value of this channel.
        found_s: f64,
    },
    /// More or fewer numbers than the header of a data set declares.
    #[error("UFF {at}: the header declares {declared}, {found}")]
    Uff58Size {
        /// Where the numbers end.
        at: UffPlace,
        /// Numbers or bytes that the header asks for.
        declared: String,
        /// What came instead, a clause.
        found: String,
    },
    /// Columns of a data set 58 that hold no number.
    #[error("UFF {at}, column {column}: {found:?} is not a number")]
    Uff58NotANumber {
        /// The line.
        at: UffPlace,
        /// First column, from 1.
        column: usize,
        /// The text, cut after 40 characters.
        found: String,
    },
    /// Not JSON, or JSON of another form.
    #[error("row {row}, column {column}: {detail}")]
    Json {
        /// Line of the file.
        row: u64,
        /// Byte of the line.
        column: usize,
        /// What is wrong.
        detail: String,
    },
    /// A field that is not part of the format.
    #[error("unknown field {key:?}")]
    JsonUnknownKey {
        /// The field.
        key: String,
    },
    /// A field that comes twice.
    #[error("field {key:?} comes twice")]
    JsonDuplicateKey {
        /// The field.
        key: String,
    },
    /// A field that is needed.
    #[error("field {key:?} is missing")]
    JsonMissingKey {
        /// The field.
        key: &'static str,
    },
    /// An array element that is no number; `null` is what many programs write for NaN.
    #[error("channel {channel} has no number at sample {sample}")]
    JsonNotANumber {
        /// The channel.
        channel: ChannelAt,
        /// Sample, from 0.
        sample: usize,
        /// Line of the file.
        row: u64,
        /// Byte of the line.
        column: usize,
    },
    /// A file whose structure is not that of MAT, version 5.
    #[error("MAT file: {0}")]
    Mat(String),
    /// An archive that is not one of NumPy's.
    #[error("NPZ archive: {0}")]
    Npz(String),
    /// A file whose structure is not that of HDF5.
    #[error("HDF5 file: {0}")]
    Hdf5(String),
    /// A variable (an array of a MAT, NPZ or HDF5 file) that is not read.
    #[error("variable {name:?} {reason}")]
    Variable {
        /// First 40 characters of its name.
        name: String,
        /// What is wrong, and what to do.
        reason: String,
    },
    /// A vector of times whose steps are not even.
    #[error(
        "the times of variable {variable:?} are not even: {} s before sample {sample}, {} s elsewhere",
        short(*found_s), short(*step_s)
    )]
    VariableUnevenTime {
        /// Its name.
        variable: String,
        /// The sample after the step.
        sample: usize,
        /// The step of most samples.
        step_s: f64,
        /// The step found.
        found_s: f64,
    },
    /// A compressed file that becomes too large.
    #[error("unpacked, the file is larger than {limit} bytes, the most for one of its size")]
    Unpacked {
        /// The most bytes.
        limit: u64,
    },
}

impl FormatError {
    /// Stable name for programs, `<format>.<what>`.
    pub fn code(&self) -> &'static str {
        match self {
            Self::Empty => "run.empty",
            Self::NoChannels => "run.no_channels",
            Self::TooManyChannels { .. } => "run.too_many_channels",
            Self::DuplicateChannel { .. } => "run.duplicate_channel",
            Self::LongName { .. } => "run.unknown_channel",
            Self::UnequalLengths { .. } => "run.unequal_lengths",
            Self::NonFinite { .. } | Self::NonFiniteInBatch { .. } => "run.non_finite",
            Self::SampleRate { .. } => "run.sample_rate",
            Self::CsvHeader { .. } => "csv.header",
            Self::CsvNotANumber { .. } => "csv.not_a_number",
            Self::CsvAmbiguousNumber { .. } => "csv.ambiguous_number",
            Self::CsvRagged { .. } => "csv.ragged_row",
            Self::CsvLongRow { .. } => "csv.long_row",
            Self::CsvUnevenTime { .. } => "csv.uneven_time",
            Self::CsvTime { .. } => "csv.time_column",
            Self::NpyHeader(_) => "npy.header",
            Self::NpyDtype { .. } => "npy.dtype",
            Self::NpyShape { .. } => "npy.shape",
            Self::NpyTruncated { .. } => "npy.truncated",
            Self::NpyTrailing { .. } => "npy.trailing_bytes",
            Self::Rpc3Header(_) => "rpc3.header",
            Self::Rpc3Unsupported { .. } => "rpc3.unsupported",
            Self::Rpc3Size { .. } => "rpc3.size",
            Self::Uff58Header { .. } => "uff58.header",
            Self::Uff58Unsupported { .. } | Self::Uff58Unlike { .. } => "uff58.unsupported",
            Self::Uff58Size { .. } => "uff58.size",
            Self::Uff58NotANumber { .. } => "uff58.not_a_number",
            Self::Mat(_) => "mat.invalid",
            Self::Npz(_) => "npz.invalid",
            Self::Hdf5(_) => "hdf5.invalid",
            Self::Variable { .. } => "variables.unsupported",
            Self::VariableUnevenTime { .. } => "variables.uneven_time",
            Self::Unpacked { .. } => "file.unpacked_size",
            Self::Json { .. } => "json.invalid",
            Self::JsonUnknownKey { .. } => "json.unknown_field",
            Self::JsonDuplicateKey { .. } => "json.duplicate_field",
            Self::JsonMissingKey { .. } => "json.missing_field",
            Self::JsonNotANumber { .. } => "json.not_a_number",
        }
    }

    /// Line of the file, from 1.
    pub fn row(&self) -> Option<u64> {
        match self {
            Self::NonFinite { row, .. } => *row,
            Self::Uff58Header { at, .. }
            | Self::Uff58Unsupported { at, .. }
            | Self::Uff58Size { at, .. }
            | Self::Uff58NotANumber { at, .. } => at.line,
            Self::CsvHeader { row, .. }
            | Self::CsvNotANumber { row, .. }
            | Self::CsvAmbiguousNumber { row, .. }
            | Self::CsvRagged { row, .. }
            | Self::CsvLongRow { row, .. }
            | Self::CsvUnevenTime { row, .. }
            | Self::CsvTime { row, .. }
            | Self::Json { row, .. }
            | Self::JsonNotANumber { row, .. } => Some(*row),
            _ => None,
        }
    }

    /// Cell of the line (CSV) or byte of the line (JSON, UFF), from 1.
    pub fn column(&self) -> Option<usize> {
        match self {
            Self::NonFinite { column, .. } => *column,
            Self::CsvHeader { column, .. }
            | Self::CsvNotANumber { column, .. }
            | Self::CsvAmbiguousNumber { column, .. }
            | Self::CsvUnevenTime { column, .. }
            | Self::CsvTime { column, .. }
            | Self::Uff58NotANumber { column, .. }
            | Self::Json { column, .. }
            | Self::JsonNotANumber { column, .. } => Some(*column),
            _ => None,
        }
    }

    /// JSON pointer of the part of the file, where it has parts.
    pub fn pointer(&self) -> String {
        match self {
            Self::NonFiniteInBatch { signal, .. } => format!("/{signal}"),
            _ => String::new(),
        }
    }

    fn channel_at(&self) -> Option<&ChannelAt> {
        match self {
            Self::UnequalLengths { channel, .. }
            | Self::NonFinite { channel, .. }
            | Self::NonFiniteInBatch { channel, .. }
            | Self::Uff58Unlike { channel, .. }
            | Self::JsonNotANumber { channel, .. } => Some(channel),
            _ => None,
        }
    }

    /// Name of the channel, where the file names it.
    pub fn channel(&self) -> Option<&str> {
        match self {
            Self::DuplicateChannel { name } | Self::Variable { name, .. } => Some(name),
            Self::VariableUnevenTime { variable, .. } => Some(variable),
            Self::CsvNotANumber { name, .. } | Self::CsvAmbiguousNumber { name, .. } => name.as_deref(),
            _ => self.channel_at().and_then(|c| c.name.as_deref()),
        }
    }

    /// Index of the channel in the file, from 0.
    pub fn channel_index(&self) -> Option<usize> {
        self.channel_at().map(|c| c.index)
    }

    /// Sample, from 0.
    pub fn sample(&self) -> Option<usize> {
        match self {
            Self::NonFinite { sample, .. }
            | Self::NonFiniteInBatch { sample, .. }
            | Self::JsonNotANumber { sample, .. }
            | Self::VariableUnevenTime { sample, .. } => Some(*sample),
            _ => None,
        }
    }

    /// The limit that was broken, in words.
    pub fn limit(&self) -> Option<String> {
        match self {
            Self::TooManyChannels { limit, .. } => Some(format!("at most {limit} channels")),
            Self::LongName { .. } => Some(format!("at most {MAX_NAME_BYTES} bytes")),
            Self::UnequalLengths { expected, .. } => Some(format!("{expected} samples")),
            Self::SampleRate { .. } => Some("a positive, finite number of hertz".into()),
            Self::CsvRagged { expected, .. } => Some(format!("{expected} cells")),
            Self::CsvLongRow { limit, .. } => Some(format!("at most {limit} bytes")),
            Self::Unpacked { limit } => Some(format!("{limit} bytes")),
            Self::CsvUnevenTime { step_s, .. } | Self::VariableUnevenTime { step_s, .. } => {
                Some(format!("steps of {} s within 0.1 %", short(*step_s)))
            }
            Self::NpyDtype { .. } => Some("float32, float64, int16 or int32".into()),
            Self::NpyShape { .. } => Some("[samples, channels] or [samples]".into()),
            Self::Rpc3Unsupported { expected, .. } => Some((*expected).to_owned()),
            Self::Rpc3Size { expected, .. } => expected.map(|n| format!("{n} bytes of data")),
            Self::Uff58Unsupported { expected, .. } => Some((*expected).to_owned()),
            Self::Uff58Unlike { expected_s, .. } => Some(format!("{} s", short(*expected_s))),
            Self::Uff58Size { declared, .. } => Some(declared.clone()),
            Self::NpyTruncated { expected, .. } | Self::NpyTrailing { expected, .. } => {
                Some(format!("{expected} bytes of data"))
            }
            _ => None,
        }
    }
}

/// A number as the file's writer would put it, without the digits that a difference leaves behind.
fn short(value: f64) -> f64 {
    rounded(value, 10)
}

/// Text of a file for an error message: the first 40 characters.
pub(super) fn excerpt(text: &str) -> String {
    text.chars().take(40).collect()
}
