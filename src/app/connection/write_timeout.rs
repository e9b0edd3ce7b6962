//! A connection that ends when its client does not read the answer, and that remembers whether the client
//! has begun a request.

use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll, ready};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::time::Sleep;

use super::lingering_close::LingeringClose;
use crate::telemetry::names;

/// A stream whose writes fail when nothing could be written for `timeout`.
#[derive(Debug)]
pub(in crate::app) struct WriteTimeout<S> {
    stream: S,
    timeout: Duration,
    /// Runs while something waits to be written.
    timer: Option<Pin<Box<Sleep>>>,
    begun: Arc<AtomicBool>,
    closing: LingeringClose,
}

impl<S> WriteTimeout<S> {
    pub(in crate::app) fn new(stream: S, timeout: Duration) -> Self {
        Self { stream, timeout, timer: None, begun: Arc::default(), closing: LingeringClose::default() }
    }

    /// Whether bytes have come since the last answer.
    pub(in crate::app) fn begun(&self) -> Arc<AtomicBool> {
        Arc::clone(&self.begun)
    }

    fn limited<T>(&mut self, cx: &mut Context<'_>, written: Poll<io::Result<T>>) -> Poll<io::Result<T>> {
        if written.is_ready() {
            self.timer = None;
            self.begun.store(false, Ordering::Relaxed);
            return written;
        }
        let timeout = self.timeout;
        let timer = self.timer.get_or_insert_with(|| Box::pin(tokio::time::sleep(timeout)));
        ready!(timer.as_mut().poll(cx));
        metrics::counter!(names::CONNECTIONS_ENDED, "slow_in" => "answer").increment(1);
        Poll::Ready(Err(io::ErrorKind::TimedOut.into()))
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for WriteTimeout<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let before = buffer.filled().len();
        let read = Pin::new(&mut self.stream).poll_read(cx, buffer);
        if buffer.filled().len() > before {
            self.begun.store(true, Ordering::Relaxed);
        }
        read
    }
}

impl<S: AsyncRead + AsyncWrite + Unpin> AsyncWrite for WriteTimeout<S> {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write(cx, bytes);
        self.limited(cx, written)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write_vectored(cx, slices);
        self.limited(cx, written)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        let Self { stream, closing, .. } = &mut *self;
        closing.poll(stream, cx)
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt, AsyncWriteExt, duplex};

    use super::*;

    #[tokio::test]
    async fn a_client_that_reads_now_and_then_is_served_and_one_that_stops_is_not() {
        let (ours, mut theirs) = duplex(4);
        let mut ours = WriteTimeout::new(ours, Duration::from_secs(1));
        let begun = ours.begun();
        theirs.write_all(b"?").await.unwrap();
        ours.read_u8().await.unwrap();
        assert!(begun.load(Ordering::Relaxed));
        let reader = tokio::spawn(async move {
            let mut read = [0; 4];
            for _ in 0..2 {
                tokio::time::sleep(Duration::from_millis(30)).await;
                theirs.read_exact(&mut read).await.unwrap();
            }
            theirs
        });
        ours.write_all(b"0123456789ab").await.expect("a little now and then");
        assert!(!begun.load(Ordering::Relaxed));
        let _theirs = reader.await.unwrap();
        let started = tokio::time::Instant::now();
        let error = ours.write_all(b"more").await.unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::TimedOut);
        assert!(started.elapsed() >= Duration::from_secs(1));
    }
}
