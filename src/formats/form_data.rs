//! `multipart/form-data` (RFC 7578), read piece by piece as a body comes in: it takes the memory of one piece and of one
//! part's head, however long the body is.

use bytes::{Buf, Bytes, BytesMut};
use memchr::memmem::{self, Finder};
use percent_encoding::percent_decode_str;

/// Longest head of a part, bytes.
pub const MAX_HEAD_BYTES: usize = 8 << 10;

/// Longest boundary (RFC 2046), characters.
const MAX_BOUNDARY_CHARS: usize = 70;

/// Longest run of blanks behind a boundary, bytes.
const MAX_PADDING_BYTES: usize = 256;

const LINE_END: &[u8] = b"\r\n";

const HEAD_END: &[u8] = b"\r\n\r\n";

/// Why a form cannot be read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum FormFault {
    /// `Content-Type` has no usable boundary.
    #[error("Content-Type has no boundary of 1 to {MAX_BOUNDARY_CHARS} characters")]
    Boundary,
    /// A line that begins like a boundary goes on.
    #[error("a boundary is not followed by the end of its line")]
    BoundaryLine,
    /// The head of a part is too long.
    #[error("the head of a part is longer than {MAX_HEAD_BYTES} bytes")]
    HeadTooLong,
    /// A line of a head that is no header.
    #[error("the head of a part has a line that is no header")]
    Head,
    /// A part without a name.
    #[error("a part has no Content-Disposition of the kind form-data with a name")]
    NoName,
    /// A part in another encoding than its bytes.
    #[error("a part has a Content-Transfer-Encoding, which forms do not use")]
    Encoding,
    /// The body ends before the closing boundary.
    #[error("it ends before its closing boundary")]
    Truncated,
}

/// The head of a part.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Part {
    /// Name of the field.
    pub name: String,
    /// Name of the file; only files have one.
    pub file_name: Option<String>,
    /// Media type, in lower case and without parameters.
    pub media_type: Option<String>,
}

/// The next thing in a form.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Event {
    /// A part begins, and the one before it ends.
    Part(Part),
    /// Bytes of the part.
    Data(Bytes),
    /// More bytes of the body are needed.
    More,
    /// The closing boundary was read; all that follows is passed over.
    End,
}

/// A form while its body comes in.
#[derive(Debug)]
pub struct FormReader {
    buffer: BytesMut,
    /// Line end, two hyphens and the boundary.
    delimiter: Finder<'static>,
    state: State,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum State {
    Preamble,
    BehindBoundary,
    Head,
    Data,
    End,
}

impl FormReader {
    /// A form whose `Content-Type` is this.
    ///
    /// # Errors
    /// [`FormFault::Boundary`].
    pub fn new(content_type: &str) -> Result<Self, FormFault> {
        let boundary = parameter(content_type, "boundary").ok_or(FormFault::Boundary)?;
        if !(1..=MAX_BOUNDARY_CHARS).contains(&boundary.len()) {
            return Err(FormFault::Boundary);
        }
        let delimiter = Finder::new(&format!("\r\n--{boundary}")).into_owned();
        // The first boundary may stand at the very beginning.
        Ok(Self { buffer: LINE_END.into(), delimiter, state: State::Preamble })
    }

    /// Adds bytes of the body.
    pub fn push(&mut self, bytes: &[u8]) {
        if self.state != State::End {
            self.buffer.extend_from_slice(bytes);
        }
    }

    /// What comes next.
    ///
    /// # Errors
    /// See [`FormFault`].
    pub fn next_event(&mut self) -> Result<Event, FormFault> {
        loop {
            let event = match self.state {
                State::Preamble => self.preamble(),
                State::BehindBoundary => self.behind_boundary()?,
                State::Head => Some(self.head()?),
                State::Data => self.data(),
                State::End => Some(Event::End),
            };
            if let Some(event) = event {
                return Ok(event);
            }
        }
    }

    /// Ends the form at the end of its body.
    ///
    /// # Errors
    /// [`FormFault::Truncated`] where its closing boundary has not come.
    pub fn finish(self) -> Result<(), FormFault> {
        if self.state == State::End { Ok(()) } else { Err(FormFault::Truncated) }
    }

    /// Passes over the bytes before the first boundary. Without an event, the state has changed.
    fn preamble(&mut self) -> Option<Event> {
        if let Some(at) = self.delimiter.find(&self.buffer) {
            self.pass_delimiter(at);
            return None;
        }
        self.buffer.advance(self.buffer.len() - self.open_end());
        Some(Event::More)
    }

    fn behind_boundary(&mut self) -> Result<Option<Event>, FormFault> {
        if self.buffer.starts_with(b"--") {
            self.state = State::End;
            self.buffer = BytesMut::new();
            return Ok(None);
        }
        let line_end = memmem::find(&self.buffer, LINE_END);
        let padding = &self.buffer[..line_end.unwrap_or(self.buffer.len())];
        let may_go_on = matches!(padding, [] | b"-" | b"\r");
        let is_blank = padding.iter().all(|byte| matches!(byte, b' ' | b'\t' | b'\r'));
        if padding.len() > MAX_PADDING_BYTES || !(is_blank || may_go_on && line_end.is_none()) {
            return Err(FormFault::BoundaryLine);
        }
        let Some(at) = line_end else { return Ok(Some(Event::More)) };
        // The line end stays: it is the end of the head where there are no headers.
        self.buffer.advance(at);
        self.state = State::Head;
        Ok(None)
    }

    fn head(&mut self) -> Result<Event, FormFault> {
        let end = memmem::find(&self.buffer, HEAD_END);
        if end.unwrap_or(self.buffer.len()) > MAX_HEAD_BYTES {
            return Err(FormFault::HeadTooLong);
        }
        let Some(end) = end else { return Ok(Event::More) };
        let part = part(&String::from_utf8_lossy(&self.buffer[..end]))?;
        self.buffer.advance(end + HEAD_END.len());
        // Without data, the next boundary follows at once.
        self.state = State::Data;
        Ok(Event::Part(part))
    }

    fn data(&mut self) -> Option<Event> {
        match self.delimiter.find(&self.buffer) {
            Some(0) => {
                self.pass_delimiter(0);
                None
            }
            Some(at) => Some(Event::Data(self.buffer.split_to(at).freeze())),
            None if self.buffer.len() > self.open_end() => {
                let known = self.buffer.len() - self.open_end();
                Some(Event::Data(self.buffer.split_to(known).freeze()))
            }
            None => Some(Event::More),
        }
    }

    /// Bytes at the end of the buffer that may be the beginning of a boundary.
    fn open_end(&self) -> usize {
        self.buffer.len().min(self.delimiter.needle().len() - 1)
    }

    fn pass_delimiter(&mut self, at: usize) {
        self.buffer.advance(at + self.delimiter.needle().len());
        self.state = State::BehindBoundary;
    }
}

/// The part that a head announces.
fn part(head: &str) -> Result<Part, FormFault> {
    let (mut disposition, mut media_type) = (None, None);
    for line in head.split("\r\n").filter(|line| !line.is_empty()) {
        let (name, value) = line.split_once(':').ok_or(FormFault::Head)?;
        match name.trim_end().to_ascii_lowercase().as_str() {
            "content-disposition" => disposition = Some(value.trim()),
            "content-type" => {
                let of = value.split(';').next().unwrap_or_default();
                media_type = Some(of.trim().to_ascii_lowercase());
            }
            "content-transfer-encoding" => {
                let encoding = value.trim().to_ascii_lowercase();
                if !["7bit", "8bit", "binary"].contains(&encoding.as_str()) {
                    return Err(FormFault::Encoding);
                }
            }
            _ => {}
        }
    }
    let disposition = disposition.ok_or(FormFault::NoName)?;
    let kind = disposition.split(';').next().unwrap_or_default();
    if !kind.trim().eq_ignore_ascii_case("form-data") {
        return Err(FormFault::NoName);
    }
    let name = parameter(disposition, "name").ok_or(FormFault::NoName)?;
    // Some programs send names beyond ASCII in the form of RFC 5987.
    let extended = || {
        let value = parameter(disposition, "filename*")?;
        let encoded = value.splitn(3, '\'').nth(2)?;
        Some(percent_decode_str(encoded).decode_utf8_lossy().into_owned())
    };
    let file_name = parameter(disposition, "filename").or_else(extended);
    Ok(Part { name, file_name, media_type })
}

/// A parameter of a header such as `form-data; name="a"`.
fn parameter(header: &str, name: &str) -> Option<String> {
    let mut rest = header.split_once(';')?.1;
    loop {
        rest = rest.trim_start_matches([' ', '\t', ';']);
        let (key, after) = rest.split_once('=')?;
        let (value, after) = match after.trim_start().strip_prefix('"') {
            Some(quoted) => unquoted(quoted)?,
            None => {
                let end = after.find(';').unwrap_or(after.len());
                (after[..end].trim().to_owned(), &after[end..])
            }
        };
        if key.trim().eq_ignore_ascii_case(name) {
            return Some(value);
        }
        rest = after;
    }
}

/// The text up to the closing quote, and what follows. A backslash escapes a quote only: names with the folders of a PC
/// have others.
fn unquoted(text: &str) -> Option<(String, &str)> {
    let mut value = String::new();
    let mut chars = text.char_indices().peekable();
    while let Some((at, char)) = chars.next() {
        match char {
            '"' => return Some((value, &text[at + 1..])),
            '\\' if matches!(chars.peek(), Some((_, '"'))) => {
                value.push('"');
                chars.next();
            }
            other => value.push(other),
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    const TYPE: &str = "multipart/form-data; boundary=\"x y\"";

    /// Parts with their data, of a body that comes in pieces of this size.
    fn read_in(body: &[u8], size: usize) -> Result<Vec<(Part, Vec<u8>)>, FormFault> {
        let mut reader = FormReader::new(TYPE)?;
        let mut parts: Vec<(Part, Vec<u8>)> = Vec::new();
        for piece in body.chunks(size) {
            reader.push(piece);
            loop {
                match reader.next_event()? {
                    Event::Part(part) => parts.push((part, Vec::new())),
                    Event::Data(bytes) => parts.last_mut().expect("a part").1.extend_from_slice(&bytes),
                    Event::More | Event::End => break,
                }
            }
            assert!(reader.buffer.len() <= size + MAX_HEAD_BYTES);
        }
        reader.finish().map(|()| parts)
    }

    fn read(body: &str) -> Result<Vec<(Part, Vec<u8>)>, FormFault> {
        read_in(body.as_bytes(), body.len().max(1))
    }

    fn part(name: &str, file_name: Option<&str>, media_type: Option<&str>) -> Part {
        let [file_name, media_type] = [file_name, media_type].map(|text| text.map(str::to_owned));
        Part { name: name.to_owned(), file_name, media_type }
    }

    #[test]
    fn a_form_reads_alike_however_it_is_cut() {
        let body = b"before\r\n--x y \t\r\nContent-Disposition: form-data; name=\"kind\"\r\n\r\nnoise\r\n--x y\r\n\
            content-disposition:form-data; filename=\"C:\\a;b\\\"c.csv\"; name=file\r\nContent-Type: Text/CSV; a=b\r\n\r\n\
            u,y\r\n--x \r\n\r\n--x\r\n\r\r\n--x y\r\nContent-Disposition: form-data; name=\"\"\r\n\r\n\r\n--x y--\r\nafter--x y";
        let expected = [
            (part("kind", None, None), b"noise".to_vec()),
            (
                part("file", Some("C:\\a;b\"c.csv"), Some("text/csv")),
                b"u,y\r\n--x \r\n\r\n--x\r\n\r".to_vec(),
            ),
            (part("", None, None), Vec::new()),
        ];
        for size in 1..=body.len() {
            assert_eq!(read_in(body, size).as_deref(), Ok(&expected[..]), "pieces of {size}");
        }
        for end in 0..body.len() - "--\r\nafter--x y".len() + 2 {
            assert_eq!(read_in(&body[..end], 7), Err(FormFault::Truncated), "{end} bytes");
        }
    }

    #[test]
    fn a_form_without_parts_holds_nothing() {
        assert_eq!(read("--x y--"), Ok(vec![]));
        assert_eq!(read(""), Err(FormFault::Truncated));
    }

    #[test]
    fn a_file_name_beyond_ascii_comes_in_either_form() {
        let named = |disposition: &str| {
            let body = format!(
                "--x y\r\nContent-Disposition: form-data; name=\"f\"; {disposition}\r\n\r\n\r\n--x y--"
            );
            read(&body).expect("a form")[0].0.file_name.clone()
        };
        assert_eq!(named("filename=\"Prüfung.csv\"").as_deref(), Some("Prüfung.csv"));
        assert_eq!(named("filename*=utf-8''Pr%C3%BCfung.csv").as_deref(), Some("Prüfung.csv"));
        assert_eq!(named("filename*=broken"), None);
    }

    #[test]
    fn each_fault_is_told_apart() {
        let head = |head: &str| read(&format!("--x y\r\n{head}\r\n\r\n\r\n--x y--"));
        let named = "Content-Disposition: form-data; name=a";
        assert!(head(named).is_ok());
        for (lines, fault) in [
            ("", FormFault::NoName),
            ("Content-Type: text/csv", FormFault::NoName),
            ("Content-Disposition: form-data", FormFault::NoName),
            ("Content-Disposition: form-data; name=\"open", FormFault::NoName),
            ("Content-Disposition: attachment; name=a", FormFault::NoName),
            ("no header", FormFault::Head),
            (
                "Content-Disposition: form-data; name=a\r\nContent-Transfer-Encoding: base64",
                FormFault::Encoding,
            ),
        ] {
            assert_eq!(head(lines), Err(fault), "{lines}");
        }
        let long = format!("{named}\r\nX: {}", "x".repeat(MAX_HEAD_BYTES));
        assert_eq!(head(&long), Err(FormFault::HeadTooLong));
        assert_eq!(read_in(format!("--x y\r\n{long}").as_bytes(), 64), Err(FormFault::HeadTooLong));
        assert_eq!(read("--x yz\r\n"), Err(FormFault::BoundaryLine));
        assert_eq!(read(&format!("--x y{}", " ".repeat(300))), Err(FormFault::BoundaryLine));
        let long = format!("multipart/form-data; boundary={}", "x".repeat(71));
        for content_type in ["multipart/form-data", "multipart/form-data; boundary=", &long] {
            assert_eq!(FormReader::new(content_type).err(), Some(FormFault::Boundary), "{content_type}");
        }
    }
}
