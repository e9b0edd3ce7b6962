//! The socket of a client, and whether somebody still reads from it.
//!
//! A client that closes its connection and one that closes only its sending half both send FIN, and look
//! alike until something is sent to them: the system of the first answers with RST, the second reads on.
//! So after a FIN, and while a request is being answered, the first bytes of the answer are sent ahead one
//! by one. They are known before the answer is: every answer begins with `HTTP/1.`. The client reads the
//! same bytes either way, and the service need not compute an answer that nobody will read.

use std::convert::Infallible;
use std::io::{self, IoSlice};
use std::net::Shutdown;
use std::os::fd::AsFd;
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, ready};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::TcpStream;

/// The bytes that every answer begins with, of either version.
const BEGINNING: &[u8] = b"HTTP/1.";

/// How long after a FIN the first byte is sent ahead. Answers that need no computation are there by then.
const FIRST: Duration = Duration::from_millis(10);

/// Time from the first byte to the second. It doubles with each byte, so that they last for a minute.
const SECOND: Duration = Duration::from_secs(1);

/// A client's socket, shared by the stream and by the look at whether the client has gone.
#[derive(Debug)]
pub(in crate::app) struct Client {
    socket: TcpStream,
    progress: Mutex<Progress>,
}

#[derive(Debug, Default)]
struct Progress {
    /// Whether a request is with its handler.
    answering: bool,
    /// Whether bytes of an earlier answer may still be waiting.
    unwritten: bool,
    /// Bytes of the next answer that were sent ahead.
    ahead: usize,
}

/// A request that is with its handler, until it is dropped.
#[derive(Debug)]
pub(in crate::app) struct Answering(Arc<Client>);

/// The bytes from and to a client.
#[derive(Debug)]
pub(in crate::app) struct ClientStream(Arc<Client>);

impl Client {
    pub(in crate::app) fn new(socket: TcpStream) -> Arc<Self> {
        Arc::new(Self { socket, progress: Mutex::default() })
    }

    /// The bytes from and to this client, for one connection.
    pub(in crate::app) fn stream(self: &Arc<Self>) -> ClientStream {
        ClientStream(Arc::clone(self))
    }

    /// Notes that a handler has a request of this client.
    pub(in crate::app) fn answering(self: &Arc<Self>) -> Answering {
        self.progress().answering = true;
        Answering(Arc::clone(self))
    }

    /// Ends once nobody can read an answer any more.
    #[cfg(target_os = "linux")]
    pub(in crate::app) async fn gone(&self) {
        use tokio::io::Interest;
        // Interest in urgent data, which no client of HTTP sends, is also met by a FIN, and by nothing else.
        let ended = self.socket.ready(Interest::PRIORITY | Interest::ERROR).await;
        if ended.is_ok_and(|ended| !ended.is_error()) {
            tokio::select! {
                _ = self.socket.ready(Interest::ERROR) => {}
                never = self.send_ahead() => match never {},
            }
        }
    }

    /// On other systems the end of a connection is seen when an answer is written.
    #[cfg(not(target_os = "linux"))]
    pub(in crate::app) async fn gone(&self) {
        std::future::pending::<()>().await;
    }

    /// Sends the beginning of each answer ahead, byte by byte.
    async fn send_ahead(&self) -> Infallible {
        loop {
            let sent = self.progress().ahead;
            let pause = sent.checked_sub(1).map_or(FIRST, |doubled| SECOND * (1 << doubled));
            tokio::time::sleep(pause).await;
            self.send_one_ahead();
        }
    }

    fn send_one_ahead(&self) {
        let mut progress = self.progress();
        if let Some(next) = BEGINNING.get(progress.ahead..=progress.ahead)
            && progress.answering
            && !progress.unwritten
        {
            // A full socket takes it later, and an error is seen by whoever waits for one.
            progress.ahead += self.socket.try_write(next).unwrap_or_default();
        }
    }

    fn poll_try(
        &self,
        cx: &mut Context<'_>,
        write: impl Fn(&TcpStream) -> io::Result<usize>,
    ) -> Poll<io::Result<usize>> {
        loop {
            ready!(self.socket.poll_write_ready(cx))?;
            match write(&self.socket) {
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                written => return Poll::Ready(written),
            }
        }
    }

    fn progress(&self) -> MutexGuard<'_, Progress> {
        self.progress.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for Answering {
    fn drop(&mut self) {
        self.0.progress().answering = false;
    }
}

impl AsyncRead for ClientStream {
    fn poll_read(
        self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let socket = &self.0.socket;
        loop {
            ready!(socket.poll_read_ready(cx))?;
            match socket.try_read_buf(buffer) {
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                read => return Poll::Ready(read.map(drop)),
            }
        }
    }
}

impl AsyncWrite for ClientStream {
    fn poll_write(self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let ahead = {
            let mut progress = self.0.progress();
            progress.unwritten = true;
            progress.ahead.min(bytes.len())
        };
        debug_assert!(BEGINNING.starts_with(&bytes[..ahead]), "an answer begins with {BEGINNING:?}");
        let rest = &bytes[ahead..];
        let written =
            if rest.is_empty() { 0 } else { ready!(self.0.poll_try(cx, |socket| socket.try_write(rest)))? };
        self.0.progress().ahead -= ahead;
        Poll::Ready(Ok(ahead + written))
    }

    fn poll_write_vectored(
        self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        slices: &[IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let ahead = {
            let mut progress = self.0.progress();
            progress.unwritten = true;
            progress.ahead
        };
        if ahead > 0 {
            let first = slices.iter().find(|slice| !slice.is_empty());
            return self.poll_write(cx, first.map_or(&[], |first| &first[..]));
        }
        self.0.poll_try(cx, |socket| socket.try_write_vectored(slices))
    }

    fn is_write_vectored(&self) -> bool {
        true
    }

    /// The server flushes when it has handed over all that it has to write.
    fn poll_flush(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.0.progress().unwritten = false;
        Poll::Ready(Ok(()))
    }

    fn poll_shutdown(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        // Tokio shuts down only sockets that nobody shares; a second handle of the same socket serves too.
        let socket = self.0.socket.as_fd().try_clone_to_owned()?;
        Poll::Ready(std::net::TcpStream::from(socket).shutdown(Shutdown::Write))
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    use tokio::net::TcpListener;

    use super::*;

    /// Long enough for two bytes to be sent ahead.
    const LONG: Duration = Duration::from_millis(1500);

    async fn pair() -> (Arc<Client>, TcpStream) {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let theirs = TcpStream::connect(listener.local_addr().unwrap());
        let (ours, theirs) = tokio::join!(listener.accept(), theirs);
        (Client::new(ours.unwrap().0), theirs.unwrap())
    }

    async fn stays(client: &Client) -> bool {
        tokio::time::timeout(LONG, client.gone()).await.is_err()
    }

    #[tokio::test]
    async fn a_client_that_closes_is_gone_with_and_without_a_reset() {
        let (client, theirs) = pair().await;
        let _answering = client.answering();
        drop(theirs);
        tokio::time::timeout(20 * LONG, client.gone()).await.expect("the end of the other side is seen");
        let (client, theirs) = pair().await;
        theirs.set_zero_linger().unwrap();
        drop(theirs);
        tokio::time::timeout(20 * LONG, client.gone()).await.expect("a reset needs no request");
    }

    #[tokio::test]
    async fn a_client_that_only_stops_sending_reads_each_answer_once() {
        let (client, mut theirs) = pair().await;
        let mut stream = client.stream();
        theirs.write_all(b"?").await.unwrap();
        theirs.shutdown().await.unwrap();
        let mut sent = [0; 8];
        assert_eq!(stream.read(&mut sent).await.unwrap(), 1);
        let first = client.answering();
        assert!(stays(&client).await, "it may still read");
        let ahead = client.progress().ahead;
        assert!(ahead >= 2, "{ahead} bytes were sent ahead");
        drop(first);
        let slices = [IoSlice::new(b""), IoSlice::new(b"HTTP/1.1 200 OK\r\n\r\n"), IoSlice::new(b"body")];
        let mut written =
            std::future::poll_fn(|cx| Pin::new(&mut stream).poll_write_vectored(cx, &slices)).await.unwrap();
        assert_eq!(written, slices[1].len());
        let second = client.answering();
        assert!(stays(&client).await);
        assert_eq!(client.progress().ahead, 0, "a part of the first answer is still to come");
        written = stream.write(b"body").await.unwrap();
        assert_eq!(written, 4);
        stream.flush().await.unwrap();
        assert!(stays(&client).await);
        assert!(client.progress().ahead > 0);
        drop(second);
        for part in [&b"HT"[..], b"TP/1.", b"0 404 Not Found\r\n\r\n"] {
            stream.write_all(part).await.unwrap();
        }
        stream.shutdown().await.unwrap();
        let mut read = String::new();
        theirs.read_to_string(&mut read).await.unwrap();
        assert_eq!(read, "HTTP/1.1 200 OK\r\n\r\nbodyHTTP/1.0 404 Not Found\r\n\r\n");
    }
}
