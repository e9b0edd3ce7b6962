//! The elements of a MAT file: a tag of type and bytes, and data of as many bytes.

use std::io::{self, Read};

use super::{fault, invalid};
use crate::formats::{FormatError, PIECE, ReadError};

/// Types of elements that are not numbers.
pub(super) const MATRIX: u32 = 14;
pub(super) const COMPRESSED: u32 = 15;

/// Elements that follow one another in a part of a file.
pub(super) struct Elements<'a> {
    from: &'a mut dyn Read,
    /// Bytes up to the end of the part.
    left: u64,
    pub(super) big_endian: bool,
}

/// The head of an element.
#[derive(Debug, Clone, Copy)]
pub(super) struct Tag {
    pub(super) kind: u32,
    /// Bytes of its data, which are in the file unless the tag holds them.
    pub(super) bytes: u64,
    /// The data of a small element.
    small: Option<[u8; 4]>,
}

impl<'a> Elements<'a> {
    /// The elements in `left` bytes of `from`.
    pub(super) fn new(from: &'a mut dyn Read, left: u64) -> Self {
        Self { from, left, big_endian: false }
    }

    pub(super) fn is_at_end(&self) -> bool {
        self.left == 0
    }

    /// Reads so many bytes.
    pub(super) fn fill(&mut self, to: &mut [u8]) -> Result<(), ReadError> {
        self.take(to.len() as u64)?;
        self.from.read_exact(to).map_err(fault)
    }

    /// Counts bytes that are read next.
    fn take(&mut self, bytes: u64) -> Result<(), FormatError> {
        self.left = self
            .left
            .checked_sub(bytes)
            .ok_or_else(|| invalid(format!("an element of {bytes} bytes has {} up to its end", self.left)))?;
        Ok(())
    }

    /// A whole number in the byte order of the file.
    pub(super) fn word(&self, bytes: [u8; 4]) -> u32 {
        if self.big_endian { u32::from_be_bytes(bytes) } else { u32::from_le_bytes(bytes) }
    }

    /// Reads the next tag.
    pub(super) fn tag(&mut self) -> Result<Tag, ReadError> {
        let mut head = [0; 8];
        self.fill(&mut head)?;
        let (words, _) = head.as_chunks::<4>();
        let [first, second] = [words[0], words[1]];
        let kind = self.word(first);
        match kind >> 16 {
            0 => Ok(Tag { kind, bytes: u64::from(self.word(second)), small: None }),
            bytes @ 1..=4 => Ok(Tag { kind: kind & 0xFFFF, bytes: u64::from(bytes), small: Some(second) }),
            bytes => Err(invalid(format!("a small element declares {bytes} bytes")).into()),
        }
    }

    /// The elements in the next `bytes` of this part. They are read to their end before the next one here.
    pub(super) fn inside(&mut self, bytes: u64) -> Result<Elements<'_>, FormatError> {
        self.take(bytes)?;
        Ok(Elements { from: &mut *self.from, left: bytes, big_endian: self.big_endian })
    }

    /// Reads the data of an element in pieces of at most [`PIECE`] bytes, which numbers do not cross.
    pub(super) fn pieces(
        &mut self,
        tag: Tag,
        mut each: impl FnMut(&[u8]) -> Result<(), ReadError>,
    ) -> Result<(), ReadError> {
        if let Some(small) = tag.small {
            return each(&small[..tag.bytes as usize]);
        }
        let mut data = self.inside(tag.bytes)?;
        let mut piece = vec![0; PIECE.min(usize::try_from(tag.bytes).unwrap_or(PIECE))];
        while data.left > 0 {
            let n = piece.len().min(usize::try_from(data.left).unwrap_or(PIECE));
            data.fill(&mut piece[..n])?;
            each(&piece[..n])?;
        }
        self.skip_padding(tag.bytes)
    }

    /// The data of an element of at most `most` bytes.
    pub(super) fn data(&mut self, tag: Tag, most: usize) -> Result<Vec<u8>, ReadError> {
        if tag.bytes > most as u64 {
            return Err(
                invalid(format!("an element has {} bytes, at most {most} are read", tag.bytes)).into()
            );
        }
        let mut data = Vec::new();
        self.pieces(tag, |piece| {
            data.extend_from_slice(piece);
            Ok(())
        })?;
        Ok(data)
    }

    /// Skips the data of an element.
    pub(super) fn skip(&mut self, tag: Tag) -> Result<(), ReadError> {
        if tag.small.is_some() {
            return Ok(());
        }
        self.inside(tag.bytes)?.skip_rest()?;
        self.skip_padding(tag.bytes)
    }

    /// Skips the bytes after data of so many, up to a multiple of 8. The last ones of a part may lack.
    pub(super) fn skip_padding(&mut self, bytes: u64) -> Result<(), ReadError> {
        let padding = (bytes.next_multiple_of(8) - bytes).min(self.left);
        self.inside(padding)?.skip_rest()
    }

    /// Skips what is left.
    pub(super) fn skip_rest(&mut self) -> Result<(), ReadError> {
        let skipped = io::copy(&mut (&mut *self.from).take(self.left), &mut io::sink()).map_err(fault)?;
        if skipped < self.left {
            return Err(fault(io::ErrorKind::UnexpectedEof.into()));
        }
        self.left = 0;
        Ok(())
    }
}

/// What is left of the part, as plain bytes.
impl Read for Elements<'_> {
    fn read(&mut self, to: &mut [u8]) -> io::Result<usize> {
        let n = self.from.take(self.left).read(to)?;
        self.left -= n as u64;
        Ok(n)
    }
}
