//! Lines of the journal: the state of one row after one change, with a checksum.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::storage::Digest;

/// Hex digits of the SHA-256 that each line begins with.
const CHECKSUM: usize = 32;

/// A value of a column.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub(in crate::storage) enum Cell {
    /// SQL's NULL.
    Null,
    /// An integer.
    Int(i64),
    /// A number that is finite, as all numbers of the registry are.
    Real(f64),
    /// A text.
    Text(String),
    /// Bytes, as hex.
    Blob {
        /// The hex digits.
        blob: String,
    },
}

/// A row: column names and their values, in the order of the names.
pub(in crate::storage) type Image = BTreeMap<String, Cell>;

/// A row's table and primary key.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub(in crate::storage) struct RowName {
    /// Its table.
    pub table: String,
    /// JSON: its primary key, an array.
    pub key: String,
}

impl std::fmt::Display for RowName {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let parts: Vec<String> = match serde_json::from_str::<Vec<Cell>>(&self.key) {
            Ok(parts) => parts
                .iter()
                .map(|part| match part {
                    Cell::Text(text) => text.clone(),
                    other => serde_json::to_string(other).unwrap_or_default(),
                })
                .collect(),
            Err(_) => vec![self.key.clone()],
        };
        write!(f, "{} {}", self.table, parts.join("/"))
    }
}

/// The first line.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(in crate::storage) struct Header {
    /// Version of the journal's form.
    pub journal: u32,
    /// Schema of the database that the rows are from.
    pub schema: i64,
    /// Digest of the definitions of its tables, indices and triggers.
    pub layout: String,
    /// Number of the last change that the rows below hold when they were copied together.
    pub seq: i64,
}

/// The state of a row after a change.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(in crate::storage) struct Entry {
    /// Number of the change.
    pub seq: i64,
    /// The row.
    #[serde(flatten)]
    pub name: RowName,
    /// Its columns; `None` once it is deleted.
    pub row: Option<Image>,
}

/// A line: checksum, blank, JSON, line end.
pub(super) fn line(value: &impl Serialize) -> String {
    let json = serde_json::to_string(value).expect("rows are text and finite numbers");
    format!("{} {json}\n", &Digest::of(json.as_bytes()).as_str()[..CHECKSUM])
}

/// The JSON of a line (without its end) whose checksum holds.
pub(super) fn checked(line: &[u8]) -> Option<&[u8]> {
    let (checksum, json) = line.split_at_checked(CHECKSUM)?;
    let json = json.strip_prefix(b" ")?;
    (Digest::of(json).as_str().as_bytes()[..CHECKSUM] == *checksum).then_some(json)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entry() -> Entry {
        let cells = [
            ("a", Cell::Null),
            ("b", Cell::Int(-(1 << 60))),
            ("c", Cell::Real(0.1)),
            ("d", Cell::Real(5.0)),
            ("e", Cell::Real(-1.0e300)),
            ("f", Cell::Text("line\nend \u{2028} \"{}\" ü".into())),
            ("g", Cell::Blob { blob: "00ff".into() }),
        ];
        let row = cells.into_iter().map(|(name, cell)| (name.to_owned(), cell)).collect();
        let name = RowName { table: "runs".into(), key: r#"["x",3]"#.into() };
        Entry { seq: 7, name, row: Some(row) }
    }

    #[test]
    fn a_line_comes_back_as_it_was_written() {
        let entry = entry();
        let line = line(&entry);
        assert_eq!(line.find('\n'), Some(line.len() - 1), "one line");
        let json = checked(line.trim_end().as_bytes()).unwrap();
        assert_eq!(serde_json::from_slice::<Entry>(json).unwrap(), entry);
        assert_eq!(entry.name.to_string(), "runs x/3");
    }

    #[test]
    fn every_flipped_bit_of_a_line_is_found() {
        let line = line(&entry());
        let whole = line.trim_end().as_bytes();
        for i in 0..8 * whole.len() {
            let mut flipped = whole.to_vec();
            flipped[i / 8] ^= 1 << (i % 8);
            assert_eq!(checked(&flipped), None, "bit {i}");
        }
        for n in 0..whole.len() {
            assert_eq!(checked(&whole[..n]), None, "cut at {n}");
        }
    }
}
