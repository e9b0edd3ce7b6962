//! The journal's file: read whole, appended to, or replaced.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufRead, BufReader, BufWriter, Write};
use std::os::unix::fs::FileExt;
use std::path::Path;

use sha2::{Digest as _, Sha256};

use super::entry::{Entry, Header, Image, RowName, checked, line};
use crate::storage::StoreError;
use crate::storage::files::{failed, sync_directory};

/// Version of the form that is written.
pub(super) const FORM: u32 = 1;

/// What a journal says; `R` is what is kept of a row.
#[derive(Debug)]
pub(super) struct Contents<R = Image> {
    /// The first line; `None` if it is damaged.
    pub header: Option<Header>,
    /// Number of the last change that a whole line has.
    pub last: i64,
    /// Damaged lines, a last line that was cut off among them.
    pub damaged: u64,
    /// Damaged lines after the last whole one.
    pub damaged_at_end: i64,
    /// Each row as its last whole line has it.
    pub rows: BTreeMap<RowName, LastLine<R>>,
    /// Lines, the damaged ones included.
    lines: usize,
}

impl<R> Default for Contents<R> {
    fn default() -> Self {
        let (header, rows) = (None, BTreeMap::new());
        Self { header, last: 0, damaged: 0, damaged_at_end: 0, rows, lines: 0 }
    }
}

/// The last whole line about a row.
#[derive(Debug)]
pub(super) struct LastLine<R> {
    /// Number of its change.
    pub seq: i64,
    /// The row; `None` once it is deleted.
    pub row: Option<R>,
}

/// Where a row's last line is, and the digest of its columns: enough to compare rows by, whatever they hold.
#[derive(Debug, Clone, Copy)]
pub(super) struct Outline {
    /// See [`Outline::digest_of`].
    pub digest: [u8; 32],
    from: u64,
    bytes: usize,
}

impl Outline {
    /// Digest of the columns of a row.
    pub(super) fn digest_of(row: &Image) -> [u8; 32] {
        Sha256::digest(serde_json::to_vec(row).expect("rows are text and finite numbers")).into()
    }

    /// The row, as its line in the journal has it now.
    ///
    /// # Errors
    /// The file system's errors, and a line that was damaged meanwhile.
    pub(super) fn read(&self, path: &Path) -> Result<Image, StoreError> {
        let mut bytes = vec![0; self.bytes];
        File::open(path).and_then(|file| file.read_exact_at(&mut bytes, self.from)).map_err(failed(path))?;
        let json = bytes.strip_suffix(b"\n").and_then(checked);
        let entry = json.and_then(|json| serde_json::from_slice::<Entry>(json).ok());
        entry.and_then(|entry| entry.row).ok_or_else(|| StoreError::Damaged {
            path: path.to_owned(),
            what: "a line changed while it was read".into(),
        })
    }
}

/// A journal is written anew at a start if it has this many lines more than four for each row.
const OLD_LINES: usize = 1000;

/// Reads a journal with all its rows; `None` if there is none.
///
/// # Errors
/// The file system's errors. Damage is none.
pub(super) fn read(path: &Path) -> Result<Option<Contents>, StoreError> {
    read_with(path, |row, _| Some(row))
}

/// Reads a journal, of which it keeps little: nothing of rows that are deleted.
///
/// # Errors
/// As of [`read`].
pub(super) fn outline(path: &Path) -> Result<Option<Contents<Outline>>, StoreError> {
    let kept = |row: Option<Image>, (from, bytes)| {
        row.map(|row| Some(Outline { digest: Outline::digest_of(&row), from, bytes }))
    };
    read_with(path, kept)
}

/// Reads a journal. `kept` says what is kept of a row, deleted or not, whose line is at this place; `None`: nothing.
fn read_with<R>(
    path: &Path,
    kept: impl Fn(Option<Image>, (u64, usize)) -> Option<Option<R>>,
) -> Result<Option<Contents<R>>, StoreError> {
    let file = match File::open(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        opened => opened.map_err(failed(path))?,
    };
    let mut contents = Contents::default();
    let mut reader = BufReader::new(file);
    let mut bytes = Vec::new();
    let mut from = 0;
    for n in 0.. {
        bytes.clear();
        if reader.read_until(b'\n', &mut bytes).map_err(failed(path))? == 0 {
            break;
        }
        let json = bytes.strip_suffix(b"\n").and_then(checked);
        let whole = match (n, json) {
            (_, None) => false,
            (0, Some(json)) => contents.begin(json),
            (_, Some(json)) => contents.add(json, |row| kept(row, (from, bytes.len()))),
        };
        from += bytes.len() as u64;
        if whole {
            contents.damaged_at_end = 0;
        } else {
            contents.damaged += 1;
            contents.damaged_at_end += 1;
        }
        contents.lines += 1;
    }
    Ok(Some(contents))
}

impl<R> Contents<R> {
    fn begin(&mut self, json: &[u8]) -> bool {
        self.header = serde_json::from_slice(json).ok().filter(|header: &Header| header.journal == FORM);
        self.last = self.header.as_ref().map_or(0, |header| header.seq);
        self.header.is_some()
    }

    /// Whether most lines are about former states of rows.
    pub(super) fn mostly_old(&self) -> bool {
        let rows = self.rows.values().filter(|line| line.row.is_some()).count();
        self.lines > 4 * rows + OLD_LINES
    }

    fn add(&mut self, json: &[u8], kept: impl FnOnce(Option<Image>) -> Option<Option<R>>) -> bool {
        let Ok(Entry { seq, name, row }) = serde_json::from_slice(json) else { return false };
        self.last = self.last.max(seq);
        match kept(row) {
            Some(row) => self.rows.insert(name, LastLine { seq, row }),
            None => self.rows.remove(&name),
        };
        true
    }
}

/// A failed append.
#[derive(Debug)]
pub(super) enum AppendError {
    /// Nothing was appended.
    Unwritten(io::Error),
    /// What is on the disk is not known.
    Unsynced(io::Error),
}

impl AppendError {
    pub(super) fn on(self, path: &Path) -> StoreError {
        let (Self::Unwritten(source) | Self::Unsynced(source)) = self;
        failed(path)(source)
    }
}

/// A journal that is appended to.
#[derive(Debug)]
pub(super) struct JournalFile {
    file: File,
    /// Bytes up to the end of the last whole line.
    len: u64,
}

impl JournalFile {
    pub(super) fn append_to(path: &Path) -> Result<Self, StoreError> {
        let file = File::options().append(true).open(path).map_err(failed(path))?;
        let len = file.metadata().map_err(failed(path))?.len();
        Ok(Self { file, len })
    }

    /// Appends the entries, durably. After a failed write the file is as it was.
    pub(super) fn append(&mut self, entries: &[Entry]) -> Result<(), AppendError> {
        let lines: String = entries.iter().map(line).collect();
        if let Err(error) = self.file.write_all(lines.as_bytes()) {
            self.file.set_len(self.len).map_err(AppendError::Unsynced)?;
            return Err(AppendError::Unwritten(error));
        }
        self.file.sync_data().map_err(AppendError::Unsynced)?;
        self.len += lines.len() as u64;
        Ok(())
    }
}

/// Writes a journal of these rows in the place of the one that is there, whole or not at all.
pub(super) fn replace(path: &Path, header: &Header, entries: &[Entry]) -> Result<(), StoreError> {
    let new = path.with_extension("journal.new");
    let write = || {
        let mut file = BufWriter::new(File::create(&new)?);
        file.write_all(line(header).as_bytes())?;
        for entry in entries {
            file.write_all(line(entry).as_bytes())?;
        }
        file.into_inner().map_err(io::IntoInnerError::into_error)?.sync_all()?;
        std::fs::rename(&new, path)
    };
    write().map_err(failed(path))?;
    sync_directory(path.parent().unwrap_or(Path::new(".")))
}
