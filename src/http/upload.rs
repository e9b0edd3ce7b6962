//! Uploads: streamed to a temporary file and hashed on the way, so that nothing is stored before the
//! whole body has come and its digest is right.

use std::path::Path;

use axum::body::Body;
use axum::http::HeaderMap;
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use sha2::{Digest, Sha256};
use tempfile::NamedTempFile;
use tokio::io::{AsyncWriteExt, BufWriter};

use crate::http::body::Limited;
use crate::http::problem::{Answer, FieldError, Problem};
use crate::http::{Http, Limits, codes};
use crate::storage::StoreError;

/// Bytes that are gathered before a write to disk.
const BUFFER_BYTES: usize = 1 << 20;

/// A complete upload; its file is deleted with this value.
#[derive(Debug)]
pub struct Upload {
    file: NamedTempFile,
    size: usize,
    sha256: [u8; 32],
}

impl Upload {
    /// SHA-256 of the bytes, hex.
    pub fn sha256(&self) -> String {
        self.sha256.iter().map(|b| format!("{b:02x}")).collect()
    }

    /// Number of bytes.
    pub fn size(&self) -> usize {
        self.size
    }

    /// The file, at its beginning.
    ///
    /// # Errors
    /// The file system's errors.
    pub fn open(&self) -> std::io::Result<std::fs::File> {
        self.file.reopen()
    }

    /// The bytes. Blocks: call it off the async threads.
    ///
    /// # Errors
    /// The file system's errors.
    pub fn read(&self) -> std::io::Result<Vec<u8>> {
        std::fs::read(self.file.path())
    }
}

/// Receives a body into a temporary file.
///
/// # Errors
/// `body.too_large`, `body.too_slow`, `body.incomplete`, `digest.malformed`, `digest.mismatch`, `store.full`.
pub async fn receive(http: &Http, headers: &HeaderMap, body: Body) -> Answer<Upload> {
    receive_at_most(http, http.limits.upload_bytes, headers, body).await
}

/// [`receive`] for a body of at most `upload_bytes`.
///
/// # Errors
/// As [`receive`].
pub async fn receive_at_most(
    http: &Http,
    upload_bytes: u64,
    headers: &HeaderMap,
    body: Body,
) -> Answer<Upload> {
    let limits = Limits { upload_bytes, ..http.limits };
    receive_into(&http.store.scratch_dir(), headers, body, limits).await
}

async fn receive_into(directory: &Path, headers: &HeaderMap, body: Body, limits: Limits) -> Answer<Upload> {
    let wanted = content_digest(headers)?;
    let mut body = Limited::new(headers, body, limits.upload_bytes, limits.pace)?;
    let mut file = UploadFile::new(directory)?;
    while let Some(chunk) = body.next().await? {
        file.write(&chunk).await?;
    }
    let upload = file.finish().await?;
    check_digest(wanted, upload.sha256)?;
    Ok(upload)
}

/// An upload on its way into its temporary file.
#[derive(Debug)]
pub struct UploadFile {
    file: NamedTempFile,
    writer: BufWriter<tokio::fs::File>,
    hash: Sha256,
    size: usize,
}

impl UploadFile {
    /// An empty file in `directory`.
    ///
    /// # Errors
    /// `store.full`.
    pub fn new(directory: &Path) -> Answer<Self> {
        let file = NamedTempFile::new_in(directory).map_err(disk)?;
        let handle = file.reopen().map_err(disk)?;
        let writer = BufWriter::with_capacity(BUFFER_BYTES, tokio::fs::File::from_std(handle));
        Ok(Self { file, writer, hash: Sha256::new(), size: 0 })
    }

    /// Adds bytes.
    ///
    /// # Errors
    /// `store.full`.
    pub async fn write(&mut self, chunk: &[u8]) -> Answer<()> {
        self.size += chunk.len();
        self.hash.update(chunk);
        self.writer.write_all(chunk).await.map_err(disk)
    }

    /// The complete upload.
    ///
    /// # Errors
    /// `store.full`.
    pub async fn finish(mut self) -> Answer<Upload> {
        self.writer.flush().await.map_err(disk)?;
        Ok(Upload { file: self.file, size: self.size, sha256: self.hash.finalize().into() })
    }
}

/// Compares the digest of a body with the one that its header promises.
///
/// # Errors
/// `digest.mismatch`.
pub fn check_digest(wanted: Option<[u8; 32]>, found: [u8; 32]) -> Answer<()> {
    match wanted {
        Some(wanted) if wanted != found => {
            let [wanted, found] = [wanted, found].map(|digest| STANDARD.encode(digest));
            let detail = format!("Content-Digest says sha-256 {wanted}, the body has {found}.");
            Err(Problem::new(codes::DIGEST_MISMATCH, detail))
        }
        _ => Ok(()),
    }
}

/// The SHA-256 that `Content-Digest` promises (RFC 9530), once or several times alike; other algorithms are ignored.
///
/// # Errors
/// `digest.malformed`.
pub fn content_digest(headers: &HeaderMap) -> Answer<Option<[u8; 32]>> {
    let mut found: Option<[u8; 32]> = None;
    for value in headers.get_all("content-digest") {
        for member in value.to_str().map_err(|_| malformed())?.split(',') {
            let Some(encoded) = member.trim().strip_prefix("sha-256=") else { continue };
            let digest = encoded
                .strip_prefix(':')
                .and_then(|e| e.strip_suffix(':'))
                .and_then(|e| STANDARD.decode(e).ok())
                .and_then(|d| d.try_into().ok())
                .ok_or_else(malformed)?;
            if found.replace(digest).is_some_and(|other| other != digest) {
                let detail = "Content-Digest names two different SHA-256 digests.";
                return Err(Problem::new(codes::DIGEST_MALFORMED, detail)
                    .with(FieldError::new("", "one sha-256 digest")));
            }
        }
    }
    Ok(found)
}

fn malformed() -> Problem {
    let limit = "sha-256=:<base64 of 32 bytes>:";
    Problem::new(codes::DIGEST_MALFORMED, format!("Content-Digest must look like {limit}."))
        .with(FieldError::new("", limit))
}

/// The problem of a disk error.
pub(super) fn disk(error: std::io::Error) -> Problem {
    StoreError::DataDir { path: "scratch".into(), source: error }.into()
}

#[cfg(test)]
mod tests {
    use super::*;
    use axum::http::HeaderValue;

    async fn received(digest: Option<&str>, limit: u64) -> (Result<String, String>, usize) {
        let directory = tempfile::tempdir().expect("a directory");
        let mut headers = HeaderMap::new();
        if let Some(digest) = digest {
            headers.insert("content-digest", HeaderValue::from_str(digest).expect("header value"));
        }
        let limits = Limits { upload_bytes: limit, ..Limits::default() };
        let outcome = receive_into(directory.path(), &headers, Body::from("abc"), limits).await;
        let outcome = outcome
            .map(|upload| {
                assert_eq!(upload.read().expect("readable"), b"abc");
                upload.sha256()
            })
            .map_err(|p| p.code().to_owned());
        (outcome, std::fs::read_dir(directory.path()).expect("readable").count())
    }

    /// FIPS 180-2, appendix B.1.
    const ABC_HEX: &str = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
    const ABC_BASE64: &str = "ungWv48Bz+pBQUDeXa4iI7ADYaOWF3qctBD/YfIAFa0=";

    #[tokio::test]
    async fn an_upload_is_hashed_and_its_file_is_gone_afterwards() {
        assert_eq!(received(None, 3).await, (Ok(ABC_HEX.into()), 0));
        let right = format!("md5=:xx:, sha-256=:{ABC_BASE64}:");
        assert_eq!(received(Some(&right), 3).await, (Ok(ABC_HEX.into()), 0));
    }

    #[tokio::test]
    async fn a_wrong_digest_or_size_leaves_nothing_behind() {
        let wrong = format!("sha-256=:{}:", ABC_BASE64.replace('u', "v"));
        assert_eq!(received(Some(&wrong), 3).await, (Err("digest.mismatch".into()), 0));
        let two = format!("sha-256=:{ABC_BASE64}:, {wrong}");
        assert_eq!(received(Some(&two), 3).await, (Err("digest.malformed".into()), 0));
        let alike = format!("sha-256=:{ABC_BASE64}:, sha-256=:{ABC_BASE64}:");
        assert_eq!(received(Some(&alike), 3).await, (Ok(ABC_HEX.into()), 0));
        assert_eq!(received(Some("sha-256=abc"), 3).await, (Err("digest.malformed".into()), 0));
        assert_eq!(received(None, 2).await, (Err("body.too_large".into()), 0));
    }
}
