//! HDF5, and with it MAT of version 7.3: datasets by name, in groups or not.
//!
//! A dataset of numbers is an array of `[samples]` or `[samples, channels]`; MATLAB turns the dimensions round. The
//! attribute `unit` of a dataset is its channels' unit, and an attribute such as `fs` of a group or dataset the
//! sample rate. The structure is read by the crate hdf5-pure. What it would have to hold in memory at once (a row, a
//! chunk, the content by declared size) is bounded here before it is read.

mod metered;

use std::collections::HashMap;
use std::fs::File;
use std::io::{Cursor, Read, Seek};

use hdf5_pure::{AttrValue, DType, Dataset, Error, Group, Object, ReadSeekSource};

use super::error::excerpt;
use super::unpacked::limit;
use super::variables::{MAX_DEPTH, MAX_TEXT_BYTES, Use, Variables, unsupported};
use super::{FormatError, MAX_CHANNELS, ParsedRun, ReadError, Spool};
use metered::{Meter, Metered};

/// Most bytes of a row of a dataset, and of a chunk, as they are stored and as f64.
const MAX_BYTES_AT_ONCE: u64 = 80 << 20;

/// Most chunks of a dataset: their places are kept in memory.
const MAX_CHUNKS: u64 = 1 << 20;

/// Bytes of the rows that are read at once, where a row holds a number of each channel.
const ROWS_BYTES: u64 = 4 << 20;

/// Most groups and datasets of a file: links may form cycles.
const MAX_OBJECTS: usize = 4096;

/// Reads a file from memory.
///
/// # Errors
/// As [`read_from`], without those of the file system.
pub fn read(file: &[u8]) -> Result<ParsedRun, FormatError> {
    let read = read_source(Cursor::new(file.to_vec()), file.len() as u64, Spool::in_memory());
    read.map(ParsedRun::into_memory).map_err(ReadError::of_bytes)
}

/// Reads a file of `len` bytes; its samples go to an empty spool.
///
/// # Errors
/// `hdf5.invalid` for a file whose structure cannot be read, `variables.*` for datasets that are no run (complex
/// numbers, cells, objects, records), `file.unpacked_size`, the `run.*` codes; errors of the file system.
pub fn read_from(file: File, len: u64, spool: Spool) -> Result<ParsedRun<Spool>, ReadError> {
    read_source(file, len, spool)
}

fn read_source(
    file: impl Read + Seek + Send + 'static,
    len: u64,
    spool: Spool,
) -> Result<ParsedRun<Spool>, ReadError> {
    let meter = Meter::new();
    let source = ReadSeekSource::new(file).map_err(|error| invalid(error.into()))?;
    let file = hdf5_pure::File::from_source(Metered::new(source, meter.clone())).map_err(invalid)?;
    let (limit, variables) = (limit(len), Variables::new(spool));
    let mut reader = Reader { variables, limit, left: limit, objects: 0, meter };
    let root = file.root();
    reader.group(&root, root.attrs().map_err(invalid)?, "", 0)?;
    reader.variables.finish()
}

/// Attributes by name.
type Attributes = HashMap<String, AttrValue>;

struct Reader {
    variables: Variables,
    /// Bytes that the datasets may be of together, and those that are left of them.
    limit: u64,
    left: u64,
    objects: usize,
    meter: Meter,
}

impl Reader {
    /// Reads a group with these attributes.
    fn group(
        &mut self,
        group: &Group,
        attributes: Attributes,
        path: &str,
        depth: usize,
    ) -> Result<(), ReadError> {
        if depth > MAX_DEPTH {
            return Err(unsupported(path, format!("is more than {MAX_DEPTH} groups deep")).into());
        }
        self.attributes(path, attributes)?;
        for (name, dataset) in group.iter_datasets().map_err(invalid)? {
            self.count()?;
            self.dataset(&dataset, &below(path, &name))?;
        }
        for (name, inner) in group.iter_groups().map_err(invalid)? {
            self.count()?;
            // MATLAB keeps there what cells and objects refer to.
            if name.starts_with('#') {
                continue;
            }
            let path = below(path, &name);
            let attributes = inner.attrs().map_err(invalid)?;
            if attributes.contains_key("MATLAB_sparse") {
                return Err(unsupported(&path, "is a sparse matrix: save full(...) of it").into());
            }
            match matlab_class(&attributes) {
                Some("struct") | None => self.group(&inner, attributes, &path, depth + 1)?,
                Some(class) => return Err(refused(&path, class).into()),
            }
        }
        Ok(())
    }

    fn count(&mut self) -> Result<(), FormatError> {
        self.objects += 1;
        if self.objects > MAX_OBJECTS {
            return Err(FormatError::Hdf5(format!("more than {MAX_OBJECTS} groups and datasets")));
        }
        Ok(())
    }

    /// Takes the sample rate and labels that are attributes.
    fn attributes(&mut self, path: &str, attributes: Attributes) -> Result<(), ReadError> {
        // In their order by name, so that errors do not depend on chance.
        let mut attributes: Vec<_> = attributes.into_iter().collect();
        attributes.sort_by(|a, b| a.0.cmp(&b.0));
        for (name, value) in attributes {
            let path = below(path, &name);
            if let Some(number) = number(&value) {
                self.variables.attribute(&path, number)?;
            } else if Variables::is_label(&path)
                && let Some(texts) = texts(value)
            {
                self.variables.text(&path, texts);
            }
        }
        Ok(())
    }

    fn dataset(&mut self, dataset: &Dataset, path: &str) -> Result<(), ReadError> {
        let attributes = dataset.attrs().map_err(invalid)?;
        let class = matlab_class(&attributes);
        if attributes.contains_key("MATLAB_empty") {
            return Ok(());
        }
        let kind = dataset.dtype().map_err(invalid)?;
        match (class, &kind) {
            (Some("char"), _) if Variables::is_label(path) => {
                let texts = self.characters(dataset, path)?;
                self.variables.text(path, texts);
                return Ok(());
            }
            (Some("char"), _) => return Ok(()),
            (Some("cell"), _) if Variables::is_label(path) => {
                let texts = self.cells(dataset, path)?;
                self.variables.text(path, texts);
                return Ok(());
            }
            (Some(class @ ("cell" | "function_handle" | "struct" | "string")), _) => {
                return Err(refused(path, class).into());
            }
            _ if attributes.contains_key("MATLAB_object_decode") => {
                return Err(refused(path, "object").into());
            }
            (_, DType::String | DType::VariableLengthString) => {
                if Variables::is_label(path) {
                    let texts = self.strings(dataset, path)?;
                    self.variables.text(path, texts);
                }
                return Ok(());
            }
            _ => {}
        }
        match kind {
            DType::Compound(_) => {
                let reason = "holds complex numbers or records: save real numbers, a dataset each";
                Err(unsupported(path, reason).into())
            }
            DType::F32
            | DType::F64
            | DType::I8
            | DType::I16
            | DType::I32
            | DType::I64
            | DType::U8
            | DType::U16
            | DType::U32
            | DType::U64
            | DType::Enum(_) => {
                self.numbers(dataset, path, class.is_some())?;
                let unit = ["unit", "units", "Unit", "Units"].iter().find_map(|&name| attributes.get(name));
                if let Some([unit]) = unit.cloned().and_then(texts).as_deref() {
                    self.variables.unit(unit.clone());
                }
                let rates = attributes.into_iter().filter(|(name, _)| !Variables::is_label(name));
                self.attributes(path, rates.collect())
            }
            kind => {
                let kind = excerpt(&kind.to_string());
                Err(unsupported(path, format!("is of type {kind}: integers and floats are read")).into())
            }
        }
    }

    /// Reads a dataset of numbers; MATLAB's have their dimensions turned round.
    fn numbers(&mut self, dataset: &Dataset, path: &str, is_matlab: bool) -> Result<(), ReadError> {
        let stored = dataset.shape().map_err(invalid)?;
        let row = self.check_size(dataset, &stored, path)?;
        let mut shape = stored.clone();
        if is_matlab {
            shape.reverse();
        }
        let at = self.variables.begin(path, &shape)?;
        let (samples, columns) = match at {
            Use::Nothing => return Ok(()),
            Use::Channels { rows, columns, .. } => (rows, columns),
            Use::Times { rows } => (rows, 1),
            Use::Rate | Use::Step => (1, 1),
        };
        // Rows of the file are whole channels, or hold a number of each. Chunks may hold parts of several channels and
        // are unpacked for each reading, so that as many of these as may be are read at once.
        let is_by_channel = columns > 1 && is_matlab;
        let bytes_at_once = if is_by_channel { MAX_BYTES_AT_ONCE } else { ROWS_BYTES };
        let at_once = (bytes_at_once / row.max(1)).max(1);
        let rows = stored.first().copied().unwrap_or(1);
        let mut from = 0;
        while from < rows {
            let values = self.meter.uncounted(|| dataset.read_f64_rows(from, at_once)).map_err(invalid)?;
            if is_by_channel {
                for (values, column) in values.chunks(samples).zip(from as usize..columns) {
                    self.variables.extend(path, at, column, values.iter().copied())?;
                }
            } else {
                for column in 0..columns {
                    let values = values[column.min(values.len())..].iter().copied().step_by(columns);
                    self.variables.extend(path, at, column, values)?;
                }
            }
            from += at_once;
        }
        Ok(())
    }

    /// Compares what reading a dataset takes with the limits. The bytes of a row, as f64.
    fn check_size(&mut self, dataset: &Dataset, stored: &[u64], path: &str) -> Result<u64, ReadError> {
        let size = dataset.element_size().map_err(invalid)?.max(8);
        let bytes = |sizes: &[u64]| sizes.iter().try_fold(size, |bytes, &n| bytes.checked_mul(n));
        let total = bytes(stored).and_then(|bytes| self.left.checked_sub(bytes));
        self.left = total.ok_or(FormatError::Unpacked { limit: self.limit })?;
        let row = bytes(stored.get(1..).unwrap_or_default()).unwrap_or(u64::MAX);
        let mut chunk = 0;
        if let Some(shape) = dataset.chunk_shape().map_err(invalid)? {
            let along = stored.iter().zip(&shape).map(|(size, chunk)| size.div_ceil((*chunk).max(1)));
            let chunks = along.fold(1_u64, u64::saturating_mul);
            if chunks > MAX_CHUNKS {
                let reason =
                    format!("has {chunks} chunks, at most {MAX_CHUNKS} are read: save it in larger ones");
                return Err(unsupported(path, reason).into());
            }
            chunk = bytes(&shape).unwrap_or(u64::MAX);
        }
        for (what, bytes) in [("rows", row), ("chunks", chunk)] {
            if bytes > MAX_BYTES_AT_ONCE {
                let reason = format!(
                    "has {what} of {bytes} bytes, at most {MAX_BYTES_AT_ONCE} are read: save shorter parts, or as {}",
                    "version 7 of MAT"
                );
                return Err(unsupported(path, reason).into());
            }
        }
        Ok(row)
    }

    /// Text of MATLAB: numbers of 16 bits, turned round, one text a row.
    fn characters(&mut self, dataset: &Dataset, path: &str) -> Result<Vec<String>, ReadError> {
        let stored = dataset.shape().map_err(invalid)?;
        let &[columns, rows] = &stored[..] else {
            return Err(unsupported(path, "is text of other than two dimensions").into());
        };
        self.check_text(dataset, path)?;
        let units = dataset.read_u16().map_err(invalid)?;
        let row = |row: u64| -> String {
            let units = units.iter().skip(row as usize).step_by(rows as usize).copied();
            char::decode_utf16(units).map(|c| c.unwrap_or(char::REPLACEMENT_CHARACTER)).collect()
        };
        Ok(if columns == 0 { Vec::new() } else { (0..rows).map(row).collect() })
    }

    fn cells(&mut self, dataset: &Dataset, path: &str) -> Result<Vec<String>, ReadError> {
        self.check_text(dataset, path)?;
        let mut texts = Vec::new();
        for object in dataset.dereference().map_err(invalid)? {
            let Object::Dataset(cell) = object else {
                return Err(unsupported(path, "has a cell that is no text").into());
            };
            let attributes = cell.attrs().map_err(invalid)?;
            if matlab_class(&attributes) != Some("char") {
                return Err(unsupported(path, "has a cell that is no text").into());
            }
            let is_empty = attributes.contains_key("MATLAB_empty");
            let text = if is_empty { Vec::new() } else { self.characters(&cell, path)? };
            texts.push(text.into_iter().next().unwrap_or_default());
        }
        Ok(texts)
    }

    fn strings(&mut self, dataset: &Dataset, path: &str) -> Result<Vec<String>, ReadError> {
        self.check_text(dataset, path)?;
        if matches!(dataset.dtype().map_err(invalid)?, DType::VariableLengthString)
            && dataset.vlen_string_payload_size().map_err(invalid)? > MAX_TEXT_BYTES as u64
        {
            return Err(long_text(path).into());
        }
        Ok(dataset.read_string().map_err(invalid)?)
    }

    /// Compares the size of text, or of references to it, with the limits.
    fn check_text(&mut self, dataset: &Dataset, path: &str) -> Result<(), ReadError> {
        let stored = dataset.shape().map_err(invalid)?;
        self.check_size(dataset, &stored, path)?;
        let elements = stored.iter().try_fold(1_u64, |n, &size| n.checked_mul(size));
        let size = dataset.element_size().map_err(invalid)?;
        let bytes = elements.and_then(|n| n.checked_mul(size)).unwrap_or(u64::MAX);
        if bytes > MAX_TEXT_BYTES as u64 {
            return Err(long_text(path).into());
        }
        Ok(())
    }
}

/// The path of a member of a group.
fn below(path: &str, name: &str) -> String {
    if path.is_empty() { name.to_owned() } else { format!("{path}.{name}") }
}

/// MATLAB's class of a variable; none in files of other programs.
fn matlab_class(attributes: &Attributes) -> Option<&str> {
    match attributes.get("MATLAB_class")? {
        AttrValue::String(class)
        | AttrValue::AsciiString(class)
        | AttrValue::VarLenString(class)
        | AttrValue::VarLenAsciiString(class)
        | AttrValue::StringSized { value: class, .. }
        | AttrValue::AsciiStringSized { value: class, .. } => Some(class),
        _ => None,
    }
}

fn refused(path: &str, class: &str) -> FormatError {
    unsupported(
        path,
        format!("is of MATLAB's class {}: save arrays of numbers, and text as char", excerpt(class)),
    )
}

fn long_text(path: &str) -> FormatError {
    unsupported(path, format!("is text of more than {MAX_TEXT_BYTES} bytes"))
}

/// The number of an attribute that holds one.
fn number(value: &AttrValue) -> Option<f64> {
    match value {
        AttrValue::F32(v) => Some(f64::from(*v)),
        AttrValue::F64(v) => Some(*v),
        AttrValue::I8(v) => Some(f64::from(*v)),
        AttrValue::I16(v) => Some(f64::from(*v)),
        AttrValue::I32(v) => Some(f64::from(*v)),
        AttrValue::I64(v) => Some(*v as f64),
        AttrValue::U8(v) => Some(f64::from(*v)),
        AttrValue::U16(v) => Some(f64::from(*v)),
        AttrValue::U32(v) => Some(f64::from(*v)),
        AttrValue::U64(v) => Some(*v as f64),
        AttrValue::F64Array(v) if v.len() == 1 => Some(v[0]),
        AttrValue::F32Array(v) if v.len() == 1 => Some(f64::from(v[0])),
        AttrValue::I64Array(v) if v.len() == 1 => Some(v[0] as f64),
        AttrValue::I32Array(v) if v.len() == 1 => Some(f64::from(v[0])),
        _ => None,
    }
}

/// The texts of an attribute that holds text.
fn texts(value: AttrValue) -> Option<Vec<String>> {
    let texts = match value {
        AttrValue::String(text)
        | AttrValue::AsciiString(text)
        | AttrValue::VarLenString(text)
        | AttrValue::VarLenAsciiString(text)
        | AttrValue::StringSized { value: text, .. }
        | AttrValue::AsciiStringSized { value: text, .. } => vec![text],
        AttrValue::StringArray(texts)
        | AttrValue::AsciiStringArray(texts)
        | AttrValue::VarLenStringArray(texts)
        | AttrValue::VarLenAsciiStringArray(texts)
        | AttrValue::StringArraySized { values: texts, .. }
        | AttrValue::AsciiStringArraySized { values: texts, .. } => texts,
        _ => return None,
    };
    Some(texts.into_iter().take(MAX_CHANNELS + 1).collect())
}

/// The error of a file that hdf5-pure cannot read.
fn invalid(error: Error) -> FormatError {
    FormatError::Hdf5(excerpt_of(&error.to_string()))
}

/// The first line of a message, not too long.
fn excerpt_of(message: &str) -> String {
    message.lines().next().unwrap_or_default().chars().take(200).collect()
}

#[cfg(test)]
mod tests;
