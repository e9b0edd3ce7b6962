//! RPC III, the time histories of rig controllers and fatigue software (`.rsp`, `.drv`, `.tim`): a header of
//! text, then 16-bit integers or single floats, channel after channel within groups of samples.
//!
//! Layout and key words follow "RPC File Formats" (MTS). Where programs differ from it, the rule is stated where
//! it is applied.

mod header;
mod padding;
mod pieces;

use std::io::Read;

use serde::Deserialize;

use super::{FormatError, PIECE, ParsedRun, ReadError, Spool};

pub use header::{Header, Numbers};
pub use padding::Padding;
pub use pieces::Rpc3Pieces;

/// Samples of a frame in files that are written.
const FRAME: usize = 1024;

/// Samples of a group in files that are written.
const GROUP: usize = 2048;

/// Integer of the full scale where a header names none, and in files that are written.
const FULL_SCALE: f64 = 32752.0;

/// The unit of a channel's `SCALE`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ScaleConvention {
    /// Engineering units of one count, as the format's description and nCode have it.
    #[default]
    Count,
    /// Engineering units of the full scale (`INT_FULL_SCALE` counts), as some programs write it.
    FullScale,
}

/// How a file is read where programs write it in different ways.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Reading {
    /// The samples that fill the last frame.
    pub padding: Padding,
    /// The unit of a channel's `SCALE`.
    pub scale: ScaleConvention,
}

/// Reads a file.
///
/// # Errors
/// The `rpc3.*` codes; `run.*` codes.
pub fn read(file: &[u8], reading: Reading) -> Result<ParsedRun, FormatError> {
    let read = read_from(file, file.len() as u64, Spool::in_memory(), reading);
    read.map(ParsedRun::into_memory).map_err(ReadError::of_bytes)
}

/// [`read`] for a file of `len` bytes that is not in memory: only a piece of it is kept at a time, and its
/// samples go to an empty spool.
///
/// # Errors
/// As [`read`]; errors of the file system.
pub fn read_from(
    mut file: impl Read,
    len: u64,
    mut spool: Spool,
    reading: Reading,
) -> Result<ParsedRun<Spool>, ReadError> {
    let header = Header::read(&mut file, len)?;
    spool.add_columns(header.channels);
    spool.reserve(header.samples);
    let scale = |channel: usize| match (header.numbers, reading.scale) {
        (Numbers::Floats { .. }, _) => 1.0,
        (_, ScaleConvention::Count) => header.scales[channel],
        (_, ScaleConvention::FullScale) => header.scales[channel] / header.full_scale,
    };
    let to = &mut spool;
    match header.numbers {
        Numbers::Integers { big_endian: false } => {
            values(&header, file, to, |b, c| f64::from(i16::from_le_bytes(b)) * scale(c))
        }
        Numbers::Integers { big_endian: true } => {
            values(&header, file, to, |b, c| f64::from(i16::from_be_bytes(b)) * scale(c))
        }
        Numbers::Floats { big_endian: false } => {
            values(&header, file, to, |b, _| f64::from(f32::from_le_bytes(b)))
        }
        Numbers::Floats { big_endian: true } => {
            values(&header, file, to, |b, _| f64::from(f32::from_be_bytes(b)))
        }
    }?;
    let mut notes = Vec::from_iter(doubtful_scale(&header, reading.scale));
    if reading.padding == Padding::Strip && !header.exact {
        let before = spool.len(0);
        padding::strip(&mut spool, header.frame)?;
        let stripped = before - spool.len(0);
        if stripped > 0 {
            notes.push(format!(
                "The last {stripped} samples of the file were left out as padding of its last frame."
            ));
        }
    }
    let run = ParsedRun {
        sample_rate_hz: Some(header.sample_rate_hz),
        names: header.names,
        units: header.units,
        notes,
        ..ParsedRun::of(spool)
    };
    Ok(run.check()?)
}

/// A warning where no channel has a scale of its own: some programs mean the full scale by 1, others counts.
fn doubtful_scale(header: &Header, convention: ScaleConvention) -> Option<String> {
    let integers = matches!(header.numbers, Numbers::Integers { .. });
    let doubtful =
        integers && convention == ScaleConvention::Count && header.scales.iter().all(|&s| s == 1.0);
    doubtful.then(|| {
        "SCALE is 1 for every channel, so that the values are counts of the converter. If the program means the full \
         scale by it, upload the file with scale=full_scale."
            .to_owned()
    })
}

/// Numbers of `N` bytes, sorted into channels; `number` is told the channel.
fn values<const N: usize>(
    header: &Header,
    mut data: impl Read,
    spool: &mut Spool,
    number: impl Fn([u8; N], usize) -> f64,
) -> std::io::Result<()> {
    let mut piece = vec![0; header.group.saturating_mul(N).min(PIECE)];
    for group in 0..header.groups {
        for channel in 0..header.channels {
            // A group may hold the whole run, as in files of pyRPC3.
            for from in (0..header.group).step_by(PIECE / N) {
                let n = (header.group - from).min(PIECE / N);
                data.read_exact(&mut piece[..n * N])?;
                // These sizes were compared with the number of bytes, so that no sum overflows.
                let at = group * header.group + from;
                let wanted = header.first.clamp(at, at + n) - at
                    ..(header.first + header.samples).clamp(at, at + n) - at;
                let (numbers, _) = piece[..n * N].as_chunks::<N>();
                spool.extend(channel, numbers[wanted].iter().map(|&b| number(b, channel)))?;
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests;
