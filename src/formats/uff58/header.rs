//! The first line of a data set and the eleven records before its numbers.

use std::io::Read;
use std::ops::Range;

use crate::formats::{FormatError, ReadError, UffPlace};

use super::lines::{Line, Lines};

/// Records before the numbers.
const RECORDS: i64 = 11;

/// Function types, by number.
const FUNCTIONS: [&str; 28] = [
    "a general or unknown function",
    "a time response",
    "an auto spectrum",
    "a cross spectrum",
    "a frequency response function",
    "a transmissibility",
    "a coherence",
    "an auto correlation",
    "a cross correlation",
    "a power spectral density",
    "an energy spectral density",
    "a probability density function",
    "a spectrum",
    "a cumulative frequency distribution",
    "a peaks-valley function",
    "a stress-cycles function",
    "a strain-cycles function",
    "an orbit",
    "a mode indicator function",
    "a force pattern",
    "a partial power",
    "a partial coherence",
    "an eigenvalue",
    "an eigenvector",
    "a shock response spectrum",
    "a finite impulse response filter",
    "a multiple coherence",
    "an order function",
];

/// The number of the function type that is read.
const TIME_RESPONSE: i64 = 1;

/// Data types of an abscissa of time: unknown, general, time.
const TIME_TYPES: [i64; 3] = [0, 1, 17];

/// Labels of a time that is not in seconds. Other labels are text for people.
const OTHER_TIMES: [&str; 8] = ["ms", "msec", "us", "usec", "µs", "μs", "min", "h"];

/// Directions of a node by the magnitude of their number, from 1.
const DIRECTIONS: [&str; 6] = ["X", "Y", "Z", "RX", "RY", "RZ"];

/// How the numbers of a data set are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Encoding {
    /// As text in fixed columns (58).
    Text,
    /// As IEEE floats (58b).
    Binary(Binary),
}

/// The form of binary numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Binary {
    /// Whether the most significant byte comes first.
    pub(super) big_endian: bool,
    /// Bytes of the numbers, as the first line declares them.
    pub(super) bytes: u64,
}

impl Encoding {
    /// By the first line of a data set; none for a data set other than 58.
    ///
    /// # Errors
    /// `uff58.header`, `uff58.unsupported`.
    pub(super) fn of(line: &Line<'_>) -> Result<Option<Self>, FormatError> {
        let start = line.bytes.trim_ascii_start();
        let (digits, form) = start.split_at(start.iter().take_while(|b| b.is_ascii_digit()).count());
        if !(1..=6).contains(&digits.len())
            || form.first().is_some_and(|b| !b.is_ascii_alphabetic() && *b != b' ')
        {
            let found = line.excerpt();
            return Err(line.refuse(format!("the line is {found:?}, and not the number of a data set")));
        }
        if digits != b"58" {
            return Ok(None);
        }
        match form.first() {
            None | Some(b' ') => Ok(Some(Self::Text)),
            Some(b'b' | b'B') => Binary::of(line).map(|form| Some(Self::Binary(form))),
            Some(_) => {
                let found = format!("the data set is {:?}", line.excerpt());
                Err(unsupported(line.at, found, "data set 58 or 58b"))
            }
        }
    }
}

impl Binary {
    /// By the first line of a data set 58b.
    fn of(line: &Line<'_>) -> Result<Self, FormatError> {
        let big_endian = match line.whole(7..13, "the byte order")? {
            1 => false,
            2 => true,
            other => {
                return Err(
                    line.refuse(format!("the byte order is {other}, and not 1 (little) or 2 (big endian)"))
                );
            }
        };
        let float = match line.whole(13..19, "the format of floats")? {
            2 => None,
            1 => Some("DEC VMS floats (format 1)".to_owned()),
            3 => Some("IBM floats (format 3)".to_owned()),
            other => Some(format!("floats of format {other}")),
        };
        if let Some(float) = float {
            return Err(unsupported(line.at, format!("the numbers are {float}"), "IEEE 754 (format 2)"));
        }
        let records = line.whole(19..31, "the number of records")?;
        if records != RECORDS {
            return Err(line.refuse(format!("the numbers begin after {records} records, and not {RECORDS}")));
        }
        let bytes = line.whole(31..43, "the number of bytes")?;
        let bytes =
            u64::try_from(bytes).map_err(|_| line.refuse(format!("the number of bytes is {bytes}")))?;
        Ok(Self { big_endian, bytes })
    }
}

/// The content of a header of a time response in even steps.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Header {
    /// How the numbers are written.
    pub(super) encoding: Encoding,
    /// Whether the numbers have double precision.
    pub(super) double: bool,
    /// Numbers of the data set, at least one, as the header declares them.
    pub(super) numbers: u64,
    /// Time of the first sample.
    pub(super) start_s: f64,
    /// Time between samples.
    pub(super) step_s: f64,
    /// Half a unit of the last digit of the step.
    pub(super) step_half_unit_s: f64,
    /// ID line 1 (empty: none).
    pub(super) id: String,
    /// Name, node and direction of the response (empty: none).
    pub(super) node: String,
    /// Unit of the numbers (empty: none).
    pub(super) unit: String,
}

impl Header {
    /// Reads the records after the first line of a data set; leaves `lines` at the first number.
    ///
    /// # Errors
    /// `uff58.header`, `uff58.unsupported`, `run.empty`.
    pub(super) fn read(lines: &mut Lines<impl Read>, encoding: Encoding) -> Result<Self, ReadError> {
        let id = record(lines)?.text(0..usize::MAX);
        for _ in 2..=5 {
            record(lines)?;
        }
        let line = record(lines)?;
        let function = line.whole(0..5, "the function type")?;
        if function != TIME_RESPONSE {
            let name = usize::try_from(function).ok().and_then(|at| FUNCTIONS.get(at));
            let found =
                format!("it is {} (function type {function})", name.unwrap_or(&"an unknown function"));
            return Err(unsupported(line.at, found, "a time response (function type 1)").into());
        }
        let node = node(&line)?;
        let line = record(lines)?;
        let double = match line.whole(0..10, "the ordinate data type")? {
            2 => false,
            4 => true,
            kind @ (5 | 6) => {
                let found = format!("the numbers are complex (ordinate data type {kind})");
                return Err(unsupported(line.at, found, "real (2 or 4)").into());
            }
            other => return Err(line.refuse(format!("the ordinate data type is {other}")).into()),
        };
        let numbers = line.whole(10..20, "the number of values")?;
        let numbers =
            u64::try_from(numbers).map_err(|_| line.refuse(format!("the number of values is {numbers}")))?;
        match line.whole(20..30, "the abscissa spacing")? {
            1 => {}
            0 => {
                let found = "the abscissa is uneven (spacing 0)".to_owned();
                return Err(unsupported(line.at, found, "an even abscissa (1)").into());
            }
            other => return Err(line.refuse(format!("the abscissa spacing is {other}")).into()),
        }
        let (start_s, _) = line.real(30..43, "the first abscissa")?;
        let (step_s, step_half_unit_s) = line.real(43..56, "the abscissa increment")?;
        check_abscissa(&record(lines)?)?;
        let unit = record(lines)?.text(UNIT);
        // The ordinate's denominator and the z axis say nothing about a time response.
        record(lines)?;
        record(lines)?;
        if numbers == 0 {
            return Err(FormatError::Empty.into());
        }
        Ok(Self { encoding, double, numbers, start_s, step_s, step_half_unit_s, id, node, unit })
    }

    /// What the channel may be called before all are known.
    pub(super) fn label(&self) -> Option<&str> {
        [&self.id, &self.node].into_iter().map(String::as_str).find(|label| !label.is_empty())
    }
}

/// Columns of the unit of an axis.
const UNIT: Range<usize> = 47..67;

/// Refuses an abscissa that is no time in seconds.
fn check_abscissa(line: &Line<'_>) -> Result<(), FormatError> {
    let kind = line.whole(0..10, "the abscissa's data type")?;
    if !TIME_TYPES.contains(&kind) {
        return Err(unsupported(line.at, format!("the abscissa has data type {kind}"), "time (17)"));
    }
    let unit = line.text(UNIT);
    if OTHER_TIMES.contains(&unit.as_str()) {
        return Err(unsupported(line.at, format!("the abscissa is in {unit}"), "an abscissa in s"));
    }
    Ok(())
}

/// The response of record 6 as `name:node:direction`, without the parts that say nothing: `12:+Z`, `hub:12:-RX`, `mic`.
fn node(line: &Line<'_>) -> Result<String, FormatError> {
    let name = line.text(31..41);
    let node = line.whole(41..51, "the response node")?;
    let direction = line.whole(51..55, "the response direction")?;
    let axis = match usize::try_from(direction.unsigned_abs()) {
        Ok(0) => String::new(),
        Ok(n) if n <= DIRECTIONS.len() => {
            format!("{}{}", if direction < 0 { '-' } else { '+' }, DIRECTIONS[n - 1])
        }
        _ => return Err(line.refuse(format!("the response direction is {direction}, and not -6 to 6"))),
    };
    let node = if node == 0 && axis.is_empty() { String::new() } else { node.to_string() };
    Ok([name, node, axis].into_iter().filter(|part| !part.is_empty()).collect::<Vec<_>>().join(":"))
}

/// The next record of a header.
fn record<R: Read>(lines: &mut Lines<R>) -> Result<Line<'_>, ReadError> {
    let end = lines.ends_early("the header");
    let Some(line) = lines.next()? else { return Err(end.into()) };
    if line.is_delimiter() {
        return Err(line.refuse("the data set ends inside its header").into());
    }
    Ok(line)
}

fn unsupported(at: UffPlace, found: String, expected: &'static str) -> FormatError {
    FormatError::Uff58Unsupported { at, found, expected }
}
