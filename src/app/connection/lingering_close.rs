//! A lingering close, for a connection whose client may still be sending. Closing a socket with unread
//! bytes resets it, and the client loses the answer that it has not read yet. The server therefore shuts
//! down its writing half and discards the rest of the input for a while.

use std::io;
use std::pin::Pin;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::time::{Instant, Sleep, sleep_until};

/// How long the server waits for a client that sends nothing.
const SILENCE: Duration = Duration::from_millis(500);

/// How long the server reads from a client that goes on sending.
const PATIENCE: Duration = Duration::from_secs(5);

/// A lingering close in progress.
#[derive(Debug)]
pub(super) struct LingeringClose {
    silence: Duration,
    patience: Duration,
    /// Set once the writing half is shut down.
    waiting: Option<Waiting>,
}

#[derive(Debug)]
struct Waiting {
    until: Instant,
    timer: Pin<Box<Sleep>>,
}

impl Default for LingeringClose {
    fn default() -> Self {
        Self { silence: SILENCE, patience: PATIENCE, waiting: None }
    }
}

impl LingeringClose {
    /// Shuts down the writing half; ready once the client has done the same, or after the longest wait.
    ///
    /// # Errors
    /// The error of shutting down the writing half; those of the client's half are ignored.
    pub(super) fn poll<S>(&mut self, stream: &mut S, cx: &mut Context<'_>) -> Poll<io::Result<()>>
    where
        S: AsyncRead + AsyncWrite + Unpin,
    {
        if self.waiting.is_none() {
            ready!(Pin::new(&mut *stream).poll_shutdown(cx))?;
            let now = Instant::now();
            let timer = Box::pin(sleep_until(now + self.silence));
            self.waiting = Some(Waiting { until: now + self.patience, timer });
        }
        let Some(Waiting { until, timer }) = &mut self.waiting else { return Poll::Ready(Ok(())) };
        let mut space = [0; 8192];
        // The timer comes first: a client that never stops sending must not outlast it.
        while timer.as_mut().poll(cx).is_pending() {
            let mut discarded = ReadBuf::new(&mut space);
            match ready!(Pin::new(&mut *stream).poll_read(cx, &mut discarded)) {
                Ok(()) if !discarded.filled().is_empty() => {
                    timer.as_mut().reset((Instant::now() + self.silence).min(*until));
                }
                _ => break,
            }
        }
        Poll::Ready(Ok(()))
    }
}

#[cfg(test)]
mod tests {
    use std::future::poll_fn;

    use tokio::io::{AsyncReadExt, AsyncWriteExt, DuplexStream, duplex};

    use super::*;

    const SHORT: Duration = Duration::from_millis(100);

    async fn end(mut stream: DuplexStream, silence: Duration, patience: Duration) -> Duration {
        let begin = Instant::now();
        let mut closing = LingeringClose { silence, patience, waiting: None };
        poll_fn(|cx| closing.poll(&mut stream, cx)).await.unwrap();
        begin.elapsed()
    }

    #[tokio::test]
    async fn a_client_that_reads_after_it_has_sent_all_reads_the_answer() {
        let (mut ours, mut theirs) = duplex(64);
        ours.write_all(b"no").await.unwrap();
        let ended = tokio::spawn(end(ours, 100 * PATIENCE, 100 * PATIENCE));
        theirs.write_all(&[0; 100_000]).await.expect("all of it is taken");
        let mut answer = String::new();
        theirs.read_to_string(&mut answer).await.unwrap();
        assert_eq!(answer, "no");
        drop(theirs);
        ended.await.expect("nobody is waited for who has gone");
    }

    #[tokio::test]
    async fn a_silent_client_is_not_waited_for_long_and_an_endless_one_not_for_ever() {
        let (ours, _theirs) = duplex(64);
        assert!(end(ours, SHORT, 100 * PATIENCE).await >= SHORT);
        let (ours, mut theirs) = duplex(64);
        let sending = tokio::spawn(async move { while theirs.write_all(&[0; 64]).await.is_ok() {} });
        assert!(end(ours, 100 * PATIENCE, SHORT).await >= SHORT);
        sending.await.unwrap();
    }
}
