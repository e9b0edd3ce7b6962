//! The header of an RPC III file, checked against the bytes after it.

use std::collections::HashMap;
use std::io::Read;

use crate::formats::error::excerpt;
use crate::formats::{FormatError, ReadError, check_channel_count, labels, step};

/// Bytes of a block.
pub(super) const BLOCK: usize = 512;

/// Bytes of a record: its key word and its value.
pub(super) const RECORD: usize = 128;

/// Bytes of a key word, with the zero byte that ends it.
pub(super) const KEY: usize = 32;

/// Most blocks of a header. The format allows 256; files of more than 128 channels have more.
const MAX_BLOCKS: u64 = 4096;

/// `DELTA_T` is known within this share: it has seven digits.
const RATE_ROUNDING: f64 = 1e-6;

/// Type of the numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Numbers {
    /// 16-bit counts that a channel's scale turns into engineering units.
    Integers {
        /// Whether the most significant byte comes first.
        big_endian: bool,
    },
    /// 32-bit floats in engineering units.
    Floats {
        /// Whether the most significant byte comes first.
        big_endian: bool,
    },
}

impl Numbers {
    fn size(self) -> u64 {
        match self {
            Self::Integers { .. } => 2,
            Self::Floats { .. } => 4,
        }
    }
}

/// The content of a header; its sizes agree with the bytes after it.
#[derive(Debug, Clone, PartialEq)]
pub struct Header {
    /// Type of the numbers.
    pub numbers: Numbers,
    /// Channels.
    pub channels: usize,
    /// Samples per second.
    pub sample_rate_hz: f64,
    /// Samples of a frame.
    pub frame: usize,
    /// Samples of a group.
    pub group: usize,
    /// Groups of the file.
    pub groups: usize,
    /// The first sample that is data: half frames have none.
    pub first: usize,
    /// Samples per channel, with those that fill the last frame unless [`exact`](Self::exact).
    pub samples: usize,
    /// Whether the file says how many samples it has.
    pub exact: bool,
    /// Factor of each channel.
    pub scales: Vec<f64>,
    /// Counts of the full scale.
    pub full_scale: f64,
    /// Descriptions of the channels, made distinct, where every channel has one.
    pub names: Option<Vec<String>>,
    /// Units of the channels (empty: none given).
    pub units: Option<Vec<String>>,
}

impl Header {
    /// Reads and checks the header of a file of `len` bytes; leaves `file` at the first number.
    ///
    /// # Errors
    /// The `rpc3.*` codes; `run.no_channels`, `run.too_many_channels`, `run.empty`, `run.sample_rate`.
    pub fn read(mut file: impl Read, len: u64) -> Result<Self, ReadError> {
        let mut first = Vec::new();
        (&mut file).take(BLOCK as u64).read_to_end(&mut first)?;
        let records = Records::of(&first);
        if records.text("FORMAT").is_none() || first.len() < BLOCK {
            return Err(
                header("the file does not begin with a block of records, the first of them FORMAT").into()
            );
        }
        let blocks = records.whole("NUM_HEADER_BLOCKS")?;
        if blocks == 0 || blocks > MAX_BLOCKS {
            return Err(header(format!("NUM_HEADER_BLOCKS is {blocks}, and not 1 to {MAX_BLOCKS}")).into());
        }
        if blocks * BLOCK as u64 > len {
            return Err(header("the file ends inside the header").into());
        }
        let rest = (blocks - 1) * BLOCK as u64;
        if (&mut file).take(rest).read_to_end(&mut first)? as u64 != rest {
            return Err(std::io::Error::from(std::io::ErrorKind::UnexpectedEof).into());
        }
        Ok(Self::check(&Records::of(&first), len - blocks * BLOCK as u64)?)
    }

    /// The header of these records before so many bytes of numbers.
    fn check(records: &Records, data: u64) -> Result<Self, FormatError> {
        let big_endian = match records.text("FORMAT").as_deref() {
            Some("BINARY" | "BINARY_IEEE_LITTLE_END") => false,
            Some("BINARY_IEEE_BIG_END") => true,
            found => {
                return Err(unsupported(
                    "FORMAT",
                    found,
                    "BINARY, BINARY_IEEE_LITTLE_END or BINARY_IEEE_BIG_END",
                ));
            }
        };
        match records.text("FILE_TYPE").as_deref() {
            None | Some("TIME_HISTORY") => {}
            found => return Err(unsupported("FILE_TYPE", found, "TIME_HISTORY")),
        }
        match records.text("TIME_TYPE").as_deref() {
            None | Some("DRIVE" | "RESPONSE" | "1" | "2") => {}
            found => {
                return Err(unsupported(
                    "TIME_TYPE",
                    found,
                    "DRIVE or RESPONSE, whose channels follow each other",
                ));
            }
        }
        let channels = records.whole("CHANNELS")?;
        if channels == 0 {
            return Err(FormatError::NoChannels);
        }
        check_channel_count(channels)?;
        let counts = Counts {
            channels,
            frame: records.above_zero("PTS_PER_FRAME")?,
            group: records.above_zero("PTS_PER_GROUP")?,
            frames: records.whole("FRAMES")?,
        };
        if !counts.group.is_multiple_of(counts.frame) {
            let (group, frame) = (counts.group, counts.frame);
            return Err(header(format!("PTS_PER_GROUP is {group}, no multiple of PTS_PER_FRAME, {frame}")));
        }
        let half_frames = match records.text("HALF_FRAMES").as_deref() {
            None | Some("" | "0" | "NO") => false,
            Some("1" | "YES") => true,
            found => return Err(unsupported("HALF_FRAMES", found, "0, 1, NO or YES")),
        };
        let (integers, floats) = (Numbers::Integers { big_endian }, Numbers::Floats { big_endian });
        let types: &[Numbers] = match records.text("DATA_TYPE").as_deref() {
            Some("SHORT_INTEGER") => &[integers],
            Some("FLOATING_POINT") => &[floats],
            // The size of the file decides.
            None => &[integers, floats],
            found => return Err(unsupported("DATA_TYPE", found, "SHORT_INTEGER or FLOATING_POINT")),
        };
        // With half frames a file is one frame longer than FRAMES, unless FRAMES counts that one too.
        let frames: &[Option<u64>] = if half_frames {
            &[counts.frames.checked_add(1), Some(counts.frames)]
        } else {
            &[Some(counts.frames)]
        };
        let fits = |&numbers: &Numbers| {
            let stored = frames.iter().flatten().find(|&&f| counts.bytes(f, numbers) == Some(data))?;
            Some((numbers, *stored))
        };
        let Some((numbers, stored)) = types.iter().find_map(fits) else {
            let expected = frames[0].and_then(|f| counts.bytes(f, types[0]));
            return Err(FormatError::Rpc3Size { expected, found: data });
        };
        // From here on no product is larger than the file.
        let frame = to_usize(counts.frame);
        let (first, whole) = if half_frames {
            (frame / 2, (to_usize(stored) * frame).saturating_sub(frame))
        } else {
            (0, to_usize(stored) * frame)
        };
        let said = records.optional_whole("SAMPLES")?;
        if let Some(said) = said.filter(|&n| n > whole as u64) {
            return Err(header(format!("SAMPLES is {said}, the frames have {whole}")));
        }
        let samples = said.map_or(whole, to_usize);
        if samples == 0 {
            return Err(FormatError::Empty);
        }
        let channels = to_usize(channels);
        Ok(Self {
            numbers,
            channels,
            sample_rate_hz: records.sample_rate()?,
            frame,
            group: to_usize(counts.group),
            groups: to_usize(counts.groups(stored)),
            first,
            samples,
            exact: said.is_some(),
            scales: records.scales(channels, numbers)?,
            full_scale: records.full_scale()?,
            names: records.names(channels),
            units: records.units(channels),
        })
    }
}

/// A number that is at most the size of the file, or the number of channels.
fn to_usize(n: u64) -> usize {
    usize::try_from(n).expect("a size in memory has 64 bits")
}

/// Numbers that say how long a file is.
struct Counts {
    channels: u64,
    frame: u64,
    group: u64,
    frames: u64,
}

impl Counts {
    /// Groups that hold so many frames; the last group is stored whole.
    fn groups(&self, frames: u64) -> u64 {
        frames.div_ceil(self.group / self.frame)
    }

    fn bytes(&self, frames: u64, numbers: Numbers) -> Option<u64> {
        self.channels.checked_mul(self.groups(frames))?.checked_mul(self.group)?.checked_mul(numbers.size())
    }
}

fn header(what: impl Into<String>) -> FormatError {
    FormatError::Rpc3Header(what.into())
}

fn unsupported(key: &'static str, found: Option<&str>, expected: &'static str) -> FormatError {
    FormatError::Rpc3Unsupported { key, found: excerpt(found.unwrap_or_default()), expected }
}

/// Key words and values.
struct Records(HashMap<String, String>);

impl Records {
    /// The records of whole blocks. Of two with one key word the first counts.
    fn of(blocks: &[u8]) -> Self {
        let mut found = HashMap::new();
        for record in blocks.as_chunks::<RECORD>().0 {
            let (key, value) = record.split_at(KEY);
            let key = labels::windows_1252(key);
            if !key.is_empty() {
                found.entry(key).or_insert_with(|| labels::windows_1252(value));
            }
        }
        Self(found)
    }

    fn text(&self, key: &str) -> Option<String> {
        self.0.get(key).cloned()
    }

    fn optional_whole(&self, key: &str) -> Result<Option<u64>, FormatError> {
        let Some(value) = self.0.get(key).filter(|value| !value.is_empty()) else { return Ok(None) };
        let found =
            value.parse().map_err(|_| header(format!("{key} is {:?}, no whole number", excerpt(value))))?;
        Ok(Some(found))
    }

    fn whole(&self, key: &str) -> Result<u64, FormatError> {
        self.optional_whole(key)?.ok_or_else(|| header(format!("{key} is missing")))
    }

    fn above_zero(&self, key: &str) -> Result<u64, FormatError> {
        match self.whole(key)? {
            0 => Err(header(format!("{key} is 0"))),
            n => Ok(n),
        }
    }

    fn number(&self, key: &str) -> Result<Option<f64>, FormatError> {
        let Some(value) = self.0.get(key).filter(|value| !value.is_empty()) else { return Ok(None) };
        let found = value.parse().ok().filter(|v: &f64| v.is_finite());
        found.map(Some).ok_or_else(|| header(format!("{key} is {:?}, no finite number", excerpt(value))))
    }

    /// `1 / DELTA_T`.
    fn sample_rate(&self) -> Result<f64, FormatError> {
        let step_s = self.number("DELTA_T")?.ok_or_else(|| header("DELTA_T is missing"))?;
        step::rate(step_s, RATE_ROUNDING)
    }

    fn full_scale(&self) -> Result<f64, FormatError> {
        match self.number("INT_FULL_SCALE")? {
            Some(found) if found <= 0.0 => Err(header(format!("INT_FULL_SCALE is {found}"))),
            found => Ok(found.unwrap_or(super::FULL_SCALE)),
        }
    }

    fn scales(&self, channels: usize, numbers: Numbers) -> Result<Vec<f64>, FormatError> {
        let scale = |n: usize| {
            let key = format!("SCALE.CHAN_{n}");
            match numbers {
                Numbers::Floats { .. } => Ok(1.0),
                Numbers::Integers { .. } => {
                    self.number(&key)?.ok_or_else(|| header(format!("{key} is missing")))
                }
            }
        };
        (1..=channels).map(scale).collect()
    }

    fn names(&self, channels: usize) -> Option<Vec<String>> {
        let name = |n: usize| self.text(&format!("DESC.CHAN_{n}")).filter(|text| !text.is_empty());
        Some(labels::distinct((1..=channels).map(name).collect::<Option<Vec<_>>>()?))
    }

    fn units(&self, channels: usize) -> Option<Vec<String>> {
        let unit = |n: usize| self.0.get(&format!("UNITS.CHAN_{n}")).cloned().unwrap_or_default();
        let units: Vec<String> = (1..=channels).map(unit).collect();
        units.iter().any(|unit| !unit.is_empty()).then_some(units)
    }
}
