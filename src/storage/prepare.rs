//! A run on its way into the store: everything that needs the processor, done beforehand.

use crate::domain::{FieldError, Quality, Rig, RunMeta};
use crate::engine::Signal;

use super::Digest;

/// A checked run with its figures and its bytes, ready to be stored.
#[derive(Debug, Clone)]
pub struct PreparedRun {
    pub(super) meta: RunMeta,
    pub(super) channels: Vec<String>,
    pub(super) units: Vec<String>,
    pub(super) samples: u64,
    pub(super) duration_s: f64,
    pub(super) sample_rate_hz: f64,
    pub(super) sha256: String,
    pub(super) quality: Quality,
    pub(super) object: Digest,
    pub(super) bytes: bytes::Bytes,
}

impl PreparedRun {
    /// Checks a parsed file against its rig. Work for the processor: call it off the async
    /// threads.
    ///
    /// `channels` name the signal's channels in order; `units`, where the file had some, must be
    /// the rig's; `sha256` is that of the uploaded file, hex.
    ///
    /// # Errors
    /// Channels that are unknown or come twice, another unit, another sample rate, no samples,
    /// and what [`RunMeta::check`] finds.
    pub fn new(
        _rig: &Rig,
        _meta: RunMeta,
        _channels: Vec<String>,
        _units: Option<Vec<String>>,
        _signal: &Signal,
        _sha256: String,
    ) -> Result<Self, Vec<FieldError>> {
        todo!()
    }
}
