//! Messages between a server and its worker process, over the worker's standard input and output: two
//! lengths, then JSON, then bytes that are too large for JSON.

use std::io::{Error, ErrorKind};
use std::path::PathBuf;
use std::time::Duration;

use bytes::Bytes;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};

use crate::jobs::control::NewLosses;
use crate::jobs::problem::JobError;
use crate::jobs::spec::{JobOutput, JobSpec};
use crate::storage::{Checkpoint, StoreSettings};

/// From the server to the worker. An end of the stream means that the server is gone.
#[derive(Debug, Serialize, Deserialize)]
pub(super) enum Tell {
    /// The one piece of work of this process.
    Begin(Box<Begin>),
    /// Stop, store a checkpoint, and end.
    Stop,
}

/// Everything that a worker needs.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(in crate::jobs) struct Begin {
    pub data_dir: PathBuf,
    pub store: StoreSettings,
    pub spec: JobSpec,
    pub checkpoint_every: Duration,
    pub memory_bytes: u64,
}

/// From the worker to the server.
#[derive(Debug, Serialize, Deserialize)]
pub(super) enum Say {
    /// Progress, sent several times a second, changed or not, as a sign of life.
    Progress { stage: String, fraction: f64 },
    /// Errors of epochs that have ended.
    Losses(NewLosses),
    /// A checkpoint; its bytes follow.
    Keep(Checkpoint),
    /// The last message of finished work; its bytes follow.
    Output(JobOutput),
    /// The last message of work without a result.
    Ended(JobError),
}

/// Writes one message.
pub(super) async fn write<W: AsyncWrite + Unpin>(
    to: &mut W,
    message: &impl Serialize,
    bytes: &[u8],
) -> std::io::Result<()> {
    let json = serde_json::to_vec(message)?;
    to.write_u64_le(json.len() as u64).await?;
    to.write_u64_le(bytes.len() as u64).await?;
    to.write_all(&json).await?;
    to.write_all(bytes).await?;
    to.flush().await
}

/// Reads one message; `None` if the stream ends between messages. Memory follows the bytes that come,
/// not the declared length.
pub(super) async fn read<T: DeserializeOwned, R: AsyncRead + Unpin>(
    from: &mut R,
) -> std::io::Result<Option<(T, Bytes)>> {
    let json = match from.read_u64_le().await {
        Err(error) if error.kind() == ErrorKind::UnexpectedEof => return Ok(None),
        length => length?,
    };
    let bytes = from.read_u64_le().await?;
    let json = exactly(from, json).await?;
    let bytes = exactly(from, bytes).await?;
    Ok(Some((serde_json::from_slice(&json)?, bytes.into())))
}

async fn exactly<R: AsyncRead + Unpin>(from: &mut R, length: u64) -> std::io::Result<Vec<u8>> {
    let mut found = Vec::new();
    from.take(length).read_to_end(&mut found).await?;
    if found.len() as u64 == length { Ok(found) } else { Err(Error::from(ErrorKind::UnexpectedEof)) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn messages_pass_one_after_the_other_and_a_cut_one_is_an_error() {
        let mut pipe = Vec::new();
        let progress = Say::Progress { stage: "LSTM".into(), fraction: 0.1 };
        write(&mut pipe, &progress, b"weights").await.unwrap();
        write(&mut pipe, &Say::Ended(JobError::Stopped), b"").await.unwrap();
        let mut from = &pipe[..];
        let (said, bytes) = read::<Say, _>(&mut from).await.unwrap().unwrap();
        assert!(matches!(said, Say::Progress { fraction: 0.1, .. }));
        assert_eq!(bytes, b"weights"[..]);
        let (said, _) = read::<Say, _>(&mut from).await.unwrap().unwrap();
        assert!(matches!(said, Say::Ended(JobError::Stopped)));
        assert!(read::<Say, _>(&mut from).await.unwrap().is_none());
        let mut cut = &pipe[..20];
        assert!(read::<Say, _>(&mut cut).await.is_err());
        // A false length takes no memory.
        let mut lie = [&u64::MAX.to_le_bytes()[..], &[0; 8], b"{}"].concat();
        assert!(read::<Say, _>(&mut &lie[..]).await.is_err());
        lie.truncate(3);
        assert!(read::<Say, _>(&mut &lie[..]).await.unwrap().is_none(), "no message has begun");
    }
}
