//! A run as a form: one part is the file, the others are the parameters of the query in another place.

use std::path::PathBuf;

use axum::body::Body;
use axum::http::HeaderMap;
use axum::http::header::CONTENT_TYPE;
use sha2::{Digest, Sha256};

use crate::formats::Format;
use crate::formats::form_data::{Event, FormFault, FormReader, MAX_HEAD_BYTES, Part};
use crate::http::body::Limited;
use crate::http::problem::{Answer, FieldError, Problem};
use crate::http::upload::{self, Upload, UploadFile};
use crate::http::{Http, codes, measurement};

/// Media type of forms.
pub const MEDIA_TYPE: &str = "multipart/form-data";

/// Name of the part with the file, for programs that send no file name.
const FILE: &str = "file";

/// Most parts beside the file.
const MAX_FIELDS: usize = 100;

/// Longest name of a field, bytes.
const MAX_NAME_BYTES: usize = 64;

/// Longest value of a field, bytes: the names of a thousand channels.
const MAX_VALUE_BYTES: usize = 64 << 10;

/// A form that has come whole.
#[derive(Debug)]
pub struct Form {
    /// Names and values of the fields, in the order of the form, without those that are empty.
    pub fields: Vec<(String, String)>,
    /// The file.
    pub upload: Upload,
    /// Its format, where its media type or its name tells.
    pub format: Option<Format>,
}

/// Receives a form, its file into a temporary file.
///
/// # Errors
/// `form.malformed`, `form.invalid`, and those of [`upload::receive`].
pub async fn receive(http: &Http, headers: &HeaderMap, body: Body) -> Answer<Form> {
    let wanted = upload::content_digest(headers)?;
    let content_type = headers.get(CONTENT_TYPE).and_then(|value| value.to_str().ok()).unwrap_or_default();
    let mut reader = FormReader::new(content_type).map_err(malformed)?;
    let mut body = Limited::new(headers, body, http.limits.upload_bytes, http.limits.pace)?;
    let mut hash = wanted.map(|_| Sha256::new());
    let mut parts = Parts::new(http.store.scratch_dir());
    while let Some(chunk) = body.next().await? {
        if let Some(hash) = &mut hash {
            hash.update(&chunk);
        }
        reader.push(&chunk);
        loop {
            match reader.next_event().map_err(malformed)? {
                Event::Part(part) => parts.begin(part)?,
                Event::Data(bytes) => parts.extend(&bytes).await?,
                Event::More | Event::End => break,
            }
        }
    }
    reader.finish().map_err(malformed)?;
    if let Some(hash) = hash {
        upload::check_digest(wanted, hash.finalize().into())?;
    }
    parts.finish().await
}

/// The part that is coming in.
enum Open {
    File,
    Field { name: String, value: Vec<u8> },
}

/// The parts that have come.
struct Parts {
    scratch: PathBuf,
    open: Option<Open>,
    fields: Vec<(String, String)>,
    file: Option<(UploadFile, Option<Format>)>,
}

impl Parts {
    fn new(scratch: PathBuf) -> Self {
        Self { scratch, open: None, fields: Vec::new(), file: None }
    }

    fn begin(&mut self, part: Part) -> Answer<()> {
        self.close()?;
        if part.file_name.is_some() || part.name == FILE {
            if self.file.is_some() {
                return Err(invalid("The form has more than one file.", "", "one file"));
            }
            self.file = Some((UploadFile::new(&self.scratch)?, format(&part)));
            self.open = Some(Open::File);
            return Ok(());
        }
        if part.name.len() > MAX_NAME_BYTES {
            let limit = format!("at most {MAX_NAME_BYTES} bytes");
            return Err(invalid("A field of the form has too long a name.", "", &limit));
        }
        if self.fields.len() == MAX_FIELDS {
            let limit = format!("at most {MAX_FIELDS} fields");
            return Err(invalid("The form has too many fields.", "", &limit));
        }
        self.open = Some(Open::Field { name: part.name, value: Vec::new() });
        Ok(())
    }

    async fn extend(&mut self, bytes: &[u8]) -> Answer<()> {
        match (&mut self.open, &mut self.file) {
            (Some(Open::File), Some((file, _))) => file.write(bytes).await,
            (Some(Open::Field { name, value }), _) => {
                value.extend_from_slice(bytes);
                if value.len() <= MAX_VALUE_BYTES {
                    return Ok(());
                }
                let detail = format!("Field {name} of the form is too long.");
                Err(invalid(&detail, name, &format!("at most {MAX_VALUE_BYTES} bytes")))
            }
            // Data follows the head of a part.
            _ => Ok(()),
        }
    }

    /// Ends the part that is coming in. An empty field counts as left out: pages send those that nobody has filled in.
    fn close(&mut self) -> Answer<()> {
        let Some(Open::Field { name, value }) = self.open.take() else { return Ok(()) };
        let value = String::from_utf8(value).map_err(|_| {
            invalid(&format!("Field {name} of the form is no UTF-8 text."), &name, "UTF-8 text")
        })?;
        if !value.is_empty() {
            self.fields.push((name, value));
        }
        Ok(())
    }

    async fn finish(mut self) -> Answer<Form> {
        self.close()?;
        let limit = format!("one part with a file name, or named {FILE}");
        let file = self.file.ok_or_else(|| invalid("The form has no file.", "", &limit));
        let (file, format) = file?;
        Ok(Form { fields: self.fields, upload: file.finish().await?, format })
    }
}

/// The format by the media type of a part, or else by the name of its file. Programs take both from lists of their own,
/// so that a type that means nothing here is no fault: the first bytes tell then.
fn format(part: &Part) -> Option<Format> {
    let by_type = measurement::format(part.media_type.as_deref()).ok().flatten();
    by_type.or_else(|| Format::of_name(part.file_name.as_deref()?))
}

fn malformed(fault: FormFault) -> Problem {
    let limit = match fault {
        FormFault::HeadTooLong => format!("{MAX_HEAD_BYTES} bytes a head"),
        _ => "a form of RFC 7578".to_owned(),
    };
    Problem::new(codes::FORM_MALFORMED, format!("The form cannot be read: {fault}."))
        .with(FieldError::new("", limit))
}

/// A form that does not make sense; `name` is that of a field, if it is about one.
fn invalid(detail: &str, name: &str, limit: &str) -> Problem {
    let pointer = if name.is_empty() { String::new() } else { format!("?{name}") };
    Problem::new(codes::FORM_INVALID, detail).with(FieldError::new(pointer, limit))
}
