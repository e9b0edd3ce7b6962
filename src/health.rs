//! `rigcast health`: checks whether a service is alive, for machines without another HTTP client, such as a
//! container.

use std::io::{self, Read, Write};
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, TcpStream};
use std::time::{Duration, Instant};

/// Longest answer that is read; `GET /livez` takes some hundred bytes.
const MAX_ANSWER: u64 = 16 << 10;

/// The reason why a service does not count as alive.
#[derive(Debug, thiserror::Error)]
pub enum HealthError {
    /// No connection, or no answer in time.
    #[error("no answer from {address}: {source}")]
    Silent {
        /// Address of the request.
        address: SocketAddr,
        /// The system's error.
        source: io::Error,
    },
    /// Another status than 200, or no HTTP.
    #[error("{address} answers GET /livez with {answer:?}")]
    Unwell {
        /// Address of the request.
        address: SocketAddr,
        /// First line of its answer.
        answer: String,
    },
}

/// Requests `GET /livez` from the service that listens on `listen`, at loopback if it listens on all addresses.
///
/// # Errors
/// No answer in time, or another one than 200.
pub fn check(listen: SocketAddr, timeout: Duration) -> Result<(), HealthError> {
    let address = reachable(listen);
    let answer = ask(address, timeout).map_err(|source| HealthError::Silent { address, source })?;
    let first = answer.lines().next().unwrap_or_default();
    let mut words = first.split(' ');
    let alive = words.next().is_some_and(|word| word.starts_with("HTTP/1.")) && words.next() == Some("200");
    if alive { Ok(()) } else { Err(HealthError::Unwell { address, answer: first.to_owned() }) }
}

/// The address to connect to for an address to listen on.
fn reachable(listen: SocketAddr) -> SocketAddr {
    let ip = match listen.ip() {
        IpAddr::V4(ip) if ip.is_unspecified() => Ipv4Addr::LOCALHOST.into(),
        IpAddr::V6(ip) if ip.is_unspecified() => Ipv6Addr::LOCALHOST.into(),
        ip => ip,
    };
    SocketAddr::new(ip, listen.port())
}

/// The answer to `GET /livez`, up to the length that is read.
fn ask(address: SocketAddr, timeout: Duration) -> io::Result<String> {
    let until = Instant::now() + timeout;
    let mut stream = TcpStream::connect_timeout(&address, timeout)?;
    let request = format!("GET /livez HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n");
    stream.set_write_timeout(Some(timeout))?;
    stream.write_all(request.as_bytes())?;
    let mut answer = Vec::new();
    let mut piece = [0; 1024];
    while (answer.len() as u64) < MAX_ANSWER {
        let left = until.saturating_duration_since(Instant::now());
        if left.is_zero() {
            return Err(io::ErrorKind::TimedOut.into());
        }
        stream.set_read_timeout(Some(left))?;
        match stream.read(&mut piece) {
            Ok(0) => break,
            Ok(n) => answer.extend_from_slice(&piece[..n]),
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            // The error of a socket whose time is over.
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                return Err(io::ErrorKind::TimedOut.into());
            }
            Err(error) => return Err(error),
        }
    }
    Ok(String::from_utf8_lossy(&answer).into_owned())
}

#[cfg(test)]
mod tests {
    use std::net::TcpListener;

    use super::*;

    /// Requests from a service that sends this answer and then, if asked to, keeps the connection open.
    fn asked(answer: &'static [u8], hold: bool) -> Result<(), HealthError> {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let listen = listener.local_addr().unwrap();
        let (done, wait) = std::sync::mpsc::channel::<()>();
        let service = std::thread::spawn(move || {
            let (mut stream, _) = listener.accept().unwrap();
            let mut request = [0; 1024];
            let n = stream.read(&mut request).unwrap();
            stream.write_all(answer).unwrap();
            if hold {
                // Ends when the other side is dropped.
                let _ = wait.recv();
            }
            String::from_utf8_lossy(&request[..n]).into_owned()
        });
        let found = check(listen, Duration::from_secs(1));
        drop(done);
        let request = service.join().unwrap();
        assert!(
            request.starts_with("GET /livez HTTP/1.1\r\n") && request.contains("Host: 127.0.0.1:"),
            "{request}"
        );
        found
    }

    #[test]
    fn only_an_answer_of_200_within_the_time_is_a_sign_of_life() {
        assert!(asked(b"HTTP/1.1 200 OK\r\ncontent-length: 2\r\n\r\n{}", false).is_ok());
        let refused = asked(b"HTTP/1.1 503 Service Unavailable\r\n\r\n", false).unwrap_err().to_string();
        assert!(refused.contains("503 Service Unavailable"), "{refused}");
        assert!(matches!(asked(b"SSH-2.0-x 200\r\n", false), Err(HealthError::Unwell { .. })));
        assert!(matches!(asked(b"", false), Err(HealthError::Unwell { .. })));
        assert!(matches!(asked(b"HTTP/1.1 2", true), Err(HealthError::Silent { .. })), "it stands still");
    }

    #[test]
    fn a_service_that_listens_everywhere_is_asked_at_loopback() {
        for (listen, asked) in
            [("0.0.0.0:8080", "127.0.0.1:8080"), ("[::]:1", "[::1]:1"), ("192.168.0.7:80", "192.168.0.7:80")]
        {
            assert_eq!(reachable(listen.parse().unwrap()).to_string(), asked);
        }
    }
}
