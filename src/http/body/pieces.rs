//! Answers that are written piece by piece, each when the client has room for it. An answer of any size
//! takes the memory of a few pieces besides the samples that it is made of, and it ends when its client
//! leaves.

use std::fmt;
use std::io;

use axum::body::Body;
use bytes::Bytes;
use futures::stream;

use crate::compute::Compute;

/// Answers up to this size are written before they begin to go out, with their length in the head.
const WHOLE_BYTES: usize = 512 << 10;

/// The pieces of an answer, in order.
pub type Pieces = Box<dyn Iterator<Item = io::Result<Vec<u8>>> + Send>;

/// The body of an answer as far as it is written when its head goes out.
pub enum Written {
    /// All of it.
    Whole(Vec<u8>),
    /// The beginning, and what follows.
    Begun(Vec<u8>, Pieces),
}

impl Written {
    /// Writes the beginning, or all of a short answer.
    ///
    /// # Errors
    /// The error of a piece.
    pub fn begin(mut pieces: Pieces) -> io::Result<Self> {
        let mut beginning = Vec::new();
        for piece in &mut pieces {
            beginning.extend_from_slice(&piece?);
            if beginning.len() > WHOLE_BYTES {
                return Ok(Self::Begun(beginning, pieces));
            }
        }
        Ok(Self::Whole(beginning))
    }

    /// The body. A piece that cannot be read ends the connection, so that the client does not take a part
    /// for the whole.
    pub fn into_body(self, compute: &Compute) -> Body {
        let (beginning, pieces) = match self {
            Self::Whole(bytes) => return bytes.into(),
            Self::Begun(beginning, pieces) => (Bytes::from(beginning), pieces),
        };
        let compute = compute.clone();
        Body::from_stream(stream::try_unfold((Some(beginning), pieces), move |(beginning, mut pieces)| {
            let compute = compute.clone();
            async move {
                if let Some(beginning) = beginning {
                    return Ok(Some((beginning, (None, pieces))));
                }
                let write = move || (pieces.next().transpose(), pieces);
                let (piece, pieces) = compute.piece(write).await.map_err(io::Error::other)?;
                let piece = piece.inspect_err(|error| tracing::error!(%error, "an answer was cut short"));
                Ok::<_, io::Error>(piece?.map(|piece| (piece.into(), (None, pieces))))
            }
        }))
    }
}

impl fmt::Debug for Written {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Whole(bytes) => write!(f, "{} bytes", bytes.len()),
            Self::Begun(beginning, _) => write!(f, "{} bytes and more", beginning.len()),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicUsize, Ordering};

    use axum::body::HttpBody;
    use futures::StreamExt;

    use super::*;
    use crate::compute::ComputeSettings;

    /// Pieces of a quarter MiB, which are counted as they are written.
    fn counted(n: usize, written: &Arc<AtomicUsize>) -> Pieces {
        let written = Arc::clone(written);
        Box::new((0..n).map(move |i| {
            written.fetch_add(1, Ordering::Relaxed);
            Ok(vec![i as u8; 256 << 10])
        }))
    }

    #[tokio::test]
    async fn pieces_are_written_when_they_are_read_and_no_sooner() {
        let compute = Compute::new(&ComputeSettings::default()).expect("threads");
        let written = Arc::default();
        let begun = Written::begin(counted(1000, &written)).expect("pieces");
        assert!(matches!(begun, Written::Begun(..)));
        assert_eq!(written.load(Ordering::Relaxed), 3, "one more than the longest answer in one go");
        let mut body = begun.into_body(&compute).into_data_stream();
        let mut read = body.next().await.expect("a piece").expect("bytes").to_vec();
        assert_eq!(written.load(Ordering::Relaxed), 3);
        for i in 3..1000 {
            let piece = body.next().await.expect("a piece").expect("bytes");
            assert!(piece.iter().all(|byte| *byte == i as u8));
            read.extend_from_slice(&piece);
            assert_eq!(written.load(Ordering::Relaxed), i + 1);
        }
        assert!(body.next().await.is_none());
        assert_eq!(read.len(), 1000 << 18);
    }

    #[tokio::test]
    async fn a_short_answer_has_its_length_and_a_piece_that_fails_ends_a_long_one() {
        let compute = Compute::new(&ComputeSettings::default()).expect("threads");
        let short = Written::begin(counted(2, &Arc::default())).expect("pieces").into_body(&compute);
        assert_eq!(short.size_hint().exact(), Some(512 << 10));
        let failing = || std::iter::once(Err(io::Error::other("the disk")));
        assert!(Written::begin(Box::new(failing())).is_err());
        let long = Box::new(counted(4, &Arc::default()).chain(failing()));
        let mut body = Written::begin(long).expect("pieces").into_body(&compute).into_data_stream();
        let mut last = None;
        while let Some(piece) = body.next().await {
            last = Some(piece.is_err());
        }
        assert_eq!(last, Some(true));
    }
}
