//! A client that sends prepared bytes and discards answers, so that it takes little of the machine that it
//! shares with the service.

use std::io;
use std::net::SocketAddr;
use std::sync::Mutex;

use tokio::io::{AsyncRead, AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

/// A service and the idle connections to it.
pub struct Target {
    address: SocketAddr,
    idle: Mutex<Vec<TcpStream>>,
}

/// Head and body of a request, ready to be sent.
pub fn request(head: &str, token: Option<&str>, body: &[u8]) -> Vec<u8> {
    let token = token.map(|token| format!("\r\nAuthorization: Bearer {token}")).unwrap_or_default();
    let length = body.len();
    let head = format!("{head}{token}\r\nHost: localhost\r\nContent-Length: {length}\r\n\r\n");
    [head.as_bytes(), body].concat()
}

impl Target {
    /// A client without a connection.
    pub fn new(address: SocketAddr) -> Self {
        Self { address, idle: Mutex::default() }
    }

    /// Sends a request on an idle or a new connection; returns the status of its answer.
    pub async fn send(&self, request: &[u8]) -> io::Result<u16> {
        let kept = self.idle.lock().expect("nobody panics with it").pop();
        if let Some(stream) = kept {
            match self.exchange(stream, request).await {
                // It was closed while it was idle.
                Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => {}
                answered => return answered,
            }
        }
        let stream = TcpStream::connect(self.address).await?;
        stream.set_nodelay(true)?;
        self.exchange(stream, request).await
    }

    async fn exchange(&self, mut stream: TcpStream, request: &[u8]) -> io::Result<u16> {
        let (mut reader, mut writer) = stream.split();
        // A refusal may arrive before the whole request is sent.
        let (sent, answered) = tokio::join!(writer.write_all(request), answer(&mut reader));
        let (status, keeps) = match (sent, answered) {
            (_, Ok(answered)) => answered,
            (Err(error), _) if error.kind() == io::ErrorKind::BrokenPipe => {
                return Err(io::ErrorKind::UnexpectedEof.into());
            }
            (_, Err(error)) => return Err(error),
        };
        if keeps {
            self.idle.lock().expect("nobody panics with it").push(stream);
        }
        Ok(status)
    }
}

/// Reads an answer to its end; returns its status, and whether the connection stays open.
async fn answer(reader: &mut (impl AsyncRead + Unpin)) -> io::Result<(u16, bool)> {
    let mut buffer = vec![0; 64 << 10];
    let mut filled = 0;
    let end = loop {
        let n = reader.read(&mut buffer[filled..]).await?;
        if n == 0 {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        filled += n;
        if let Some(end) = buffer[..filled].windows(4).position(|four| four == b"\r\n\r\n") {
            break end + 4;
        }
    };
    let head = String::from_utf8_lossy(&buffer[..end]).to_ascii_lowercase();
    let malformed = || io::Error::from(io::ErrorKind::InvalidData);
    let status = head.split(' ').nth(1).and_then(|status| status.parse().ok()).ok_or_else(malformed)?;
    let field = |name: &str| head.lines().find_map(|line| line.strip_prefix(name)).map(str::trim);
    let length: usize = field("content-length:").and_then(|length| length.parse().ok()).unwrap_or_default();
    let mut left = length.saturating_sub(filled - end);
    while left > 0 {
        let most = buffer.len().min(left);
        let n = reader.read(&mut buffer[..most]).await?;
        if n == 0 {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        left -= n;
    }
    Ok((status, field("connection:") != Some("close")))
}
