//! The variables of a MAT file: arrays of numbers, text, and structs of them.

use super::element::{Elements, MATRIX};
use super::invalid;
use crate::formats::numbers::{Kind, Numbers};
use crate::formats::variables::{MAX_DEPTH, MAX_TEXT_BYTES, Use, Variables, unsupported};
use crate::formats::{MAX_CHANNELS, MAX_NAME_BYTES, ReadError};

/// Most dimensions of an array.
const MAX_DIMENSIONS: usize = 32;

/// The flag of an array of complex numbers.
const COMPLEX: u32 = 0x0800;

/// The head of an array.
struct Array {
    class: u32,
    is_complex: bool,
    shape: Vec<u64>,
    /// Empty inside of a struct or a cell.
    name: String,
}

/// Reads the variable of a whole element.
///
/// # Errors
/// `mat.invalid`, `variables.*`; errors of the file system.
pub(super) fn read(element: &mut Elements<'_>, variables: &mut Variables) -> Result<(), ReadError> {
    let array = head(element)?;
    if array.name.is_empty() {
        // MATLAB keeps the content of objects in it, which themselves are refused.
        return Ok(());
    }
    let path = array.name.clone();
    content(element, &array, &path, 0, variables)
}

/// Reads the elements of an array before its content.
fn head(element: &mut Elements<'_>) -> Result<Array, ReadError> {
    let flags = words(element, 8)?;
    let (class, is_complex) = (flags[0] & 0xFF, flags[0] & COMPLEX != 0);
    // Objects of other kinds have no shape.
    let shape = if class == OPAQUE { Vec::new() } else { shape(element)? };
    let tag = element.tag()?;
    let name = String::from_utf8_lossy(&element.data(tag, MAX_NAME_BYTES)?).trim_end_matches('\0').to_owned();
    Ok(Array { class, is_complex, shape, name })
}

const CELL: u32 = 1;
const STRUCT: u32 = 2;
const OBJECT: u32 = 3;
const CHAR: u32 = 4;
const SPARSE: u32 = 5;
const FUNCTION: u32 = 16;
const OPAQUE: u32 = 17;

fn shape(element: &mut Elements<'_>) -> Result<Vec<u64>, ReadError> {
    let sizes = words(element, 4 * MAX_DIMENSIONS)?;
    let sizes: Option<Vec<u64>> = sizes.iter().map(|&n| i32::try_from(n).ok().map(|n| n as u64)).collect();
    Ok(sizes.filter(|sizes| !sizes.is_empty()).ok_or_else(|| invalid("the size of an array is no size"))?)
}

/// Reads an element of whole numbers of 32 bits, at least one.
fn words(element: &mut Elements<'_>, most: usize) -> Result<Vec<u32>, ReadError> {
    let tag = element.tag()?;
    let data = element.data(tag, most)?;
    let (words, rest) = data.as_chunks::<4>();
    if !matches!(tag.kind, 5 | 6) || words.is_empty() || !rest.is_empty() {
        return Err(invalid("the head of an array is damaged").into());
    }
    Ok(words.iter().map(|&word| element.word(word)).collect())
}

/// Reads what an array holds.
fn content(
    element: &mut Elements<'_>,
    array: &Array,
    path: &str,
    depth: usize,
    variables: &mut Variables,
) -> Result<(), ReadError> {
    let refuse = |reason: &str| Err(unsupported(path, reason).into());
    match array.class {
        CELL if Variables::is_label(path) => {
            let texts = cells(element, array, path)?;
            variables.text(path, texts);
            Ok(())
        }
        CELL => refuse("is a cell array: save the arrays in it as variables of their own"),
        STRUCT => fields(element, array, path, depth, variables),
        CHAR if Variables::is_label(path) => {
            let texts = text(element, array)?;
            variables.text(path, texts);
            Ok(())
        }
        // Text says nothing of the samples.
        CHAR => Ok(()),
        SPARSE => refuse("is a sparse matrix: save full(...) of it"),
        FUNCTION => refuse("is a function handle: save the channels without it"),
        OBJECT | OPAQUE => refuse(
            "is an object of MATLAB (a string, table, timetable, timeseries or datetime, for example): save its \
             columns as arrays, and text as char",
        ),
        6..=15 if array.is_complex => refuse("holds complex numbers: save its real part or its magnitude"),
        6..=15 => numbers(element, array, path, variables),
        class => {
            Err(invalid(format!("variable {path:?} is of class {class}, which version 5 has not")).into())
        }
    }
}

/// Reads an array of numbers, one channel after the other as MATLAB keeps them.
fn numbers(
    element: &mut Elements<'_>,
    array: &Array,
    path: &str,
    variables: &mut Variables,
) -> Result<(), ReadError> {
    let tag = element.tag()?;
    let numbers = type_of(tag.kind, element.big_endian);
    let numbers = numbers.ok_or_else(|| invalid(format!("variable {path:?} has no numbers")))?;
    let size = numbers.size() as u64;
    let declared = array.shape.iter().try_fold(size, |bytes, &n| bytes.checked_mul(n));
    if declared != Some(tag.bytes) {
        let found = tag.bytes / size;
        let reason = format!("variable {path:?} declares the size {:?} and has {found} numbers", array.shape);
        return Err(invalid(reason).into());
    }
    let at = variables.begin(path, &array.shape)?;
    let rows = match at {
        Use::Nothing => return element.skip(tag),
        Use::Channels { rows, .. } | Use::Times { rows } => rows,
        Use::Rate | Use::Step => 1,
    };
    let mut done = 0;
    let mut values = Vec::new();
    element.pieces(tag, |piece| {
        values.clear();
        numbers.decode(piece, &mut values);
        let mut rest = &values[..];
        while !rest.is_empty() {
            let (now, after) = rest.split_at(rest.len().min(rows - done % rows));
            variables.extend(path, at, done / rows, now.iter().copied())?;
            (done, rest) = (done + now.len(), after);
        }
        Ok(())
    })
}

/// The numbers of an element of this type.
fn type_of(kind: u32, big_endian: bool) -> Option<Numbers> {
    let (kind, size) = match kind {
        1 => (Kind::Signed, 1),
        2 => (Kind::Unsigned, 1),
        3 => (Kind::Signed, 2),
        4 => (Kind::Unsigned, 2),
        5 => (Kind::Signed, 4),
        6 => (Kind::Unsigned, 4),
        7 => (Kind::Float, 4),
        9 => (Kind::Float, 8),
        12 => (Kind::Signed, 8),
        13 => (Kind::Unsigned, 8),
        _ => return None,
    };
    Numbers::of(kind, size, big_endian)
}

/// Reads the fields of one struct.
fn fields(
    element: &mut Elements<'_>,
    array: &Array,
    path: &str,
    depth: usize,
    variables: &mut Variables,
) -> Result<(), ReadError> {
    if array.shape.iter().any(|&n| n != 1) {
        let reason = format!("is an array of structs, {:?} of them: one struct is read", array.shape);
        return Err(unsupported(path, reason).into());
    }
    if depth == MAX_DEPTH {
        let reason = format!("is more than {MAX_DEPTH} structs deep");
        return Err(unsupported(path, reason).into());
    }
    let longest = words(element, 4)?[0] as usize;
    let tag = element.tag()?;
    let names = element.data(tag, MAX_TEXT_BYTES)?;
    if !names.is_empty() && (longest == 0 || names.len() % longest != 0) {
        return Err(invalid(format!("the names of the fields of {path:?} are damaged")).into());
    }
    for name in names.chunks(longest.max(1)) {
        let name = String::from_utf8_lossy(name);
        let path = format!("{path}.{}", name.split('\0').next().unwrap_or_default());
        let tag = element.tag()?;
        if tag.kind != MATRIX {
            return Err(invalid(format!("the field {path:?} is no array")).into());
        }
        // An empty array may be an element without data.
        if tag.bytes > 0 {
            let mut field = element.inside(tag.bytes)?;
            let array = head(&mut field)?;
            content(&mut field, &array, &path, depth + 1, variables)?;
            field.skip_rest()?;
        }
        element.skip_padding(tag.bytes)?;
    }
    Ok(())
}

/// Reads a cell array of text.
fn cells(element: &mut Elements<'_>, array: &Array, path: &str) -> Result<Vec<String>, ReadError> {
    let n = array.shape.iter().try_fold(1_u64, |n, &size| n.checked_mul(size)).unwrap_or(u64::MAX);
    if n > MAX_CHANNELS as u64 {
        let reason = format!("is a cell array of {n} texts, at most {MAX_CHANNELS} are read");
        return Err(unsupported(path, reason).into());
    }
    let mut texts = Vec::new();
    for _ in 0..n {
        let tag = element.tag()?;
        if tag.kind != MATRIX {
            return Err(invalid(format!("a cell of {path:?} is no array")).into());
        }
        let mut cell = element.inside(tag.bytes)?;
        let array = head(&mut cell)?;
        if array.class != CHAR {
            return Err(unsupported(path, "has a cell that is no text").into());
        }
        texts.push(text(&mut cell, &array)?.into_iter().next().unwrap_or_default());
        cell.skip_rest()?;
        element.skip_padding(tag.bytes)?;
    }
    Ok(texts)
}

/// Reads text, one a row.
fn text(element: &mut Elements<'_>, array: &Array) -> Result<Vec<String>, ReadError> {
    let &[rows, columns] = &array.shape[..] else {
        return Err(invalid("text has two dimensions").into());
    };
    // Some programs leave the data of empty text out.
    if rows == 0 || columns == 0 {
        return Ok(vec![String::new()]);
    }
    let tag = element.tag()?;
    let big_endian = element.big_endian;
    let data = element.data(tag, MAX_TEXT_BYTES)?;
    let characters: Vec<char> = match tag.kind {
        4 | 17 => {
            let (pairs, _) = data.as_chunks::<2>();
            let unit = |&b: &[u8; 2]| if big_endian { u16::from_be_bytes(b) } else { u16::from_le_bytes(b) };
            char::decode_utf16(pairs.iter().map(unit))
                .map(|c| c.unwrap_or(char::REPLACEMENT_CHARACTER))
                .collect()
        }
        16 => String::from_utf8_lossy(&data).chars().collect(),
        1 | 2 => data.iter().copied().map(char::from).collect(),
        kind => return Err(invalid(format!("text is of type {kind}")).into()),
    };
    let rows = usize::try_from(rows).unwrap_or(usize::MAX);
    if rows > MAX_CHANNELS || characters.len() as u64 != rows as u64 * columns {
        return Err(invalid("text is not of its size").into());
    }
    // One column after the other.
    let row = |row: usize| characters[row..].iter().step_by(rows).collect();
    Ok((0..rows).map(row).collect())
}
