//! Requests as bytes, for those that no client library would send.

use std::io::{Read, Write};
use std::net::{Shutdown, SocketAddr, TcpStream};
use std::time::Duration;

/// Sends bytes, closes the sending half, and returns the whole answer.
pub fn exchange(address: SocketAddr, request: &[u8]) -> String {
    let mut stream = TcpStream::connect(address).expect("a connection");
    stream.set_read_timeout(Some(Duration::from_secs(10))).expect("a timeout");
    stream.write_all(request).expect("sent");
    match stream.shutdown(Shutdown::Write) {
        // A service that refuses a head may have closed the connection by now.
        Err(error) if error.kind() == std::io::ErrorKind::NotConnected => {}
        closed => closed.expect("half closed"),
    }
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).expect("an answer");
    String::from_utf8(answer).expect("text")
}

/// All bytes until the other end closes the connection, which it must within half a minute.
pub fn read_all(mut stream: TcpStream) -> String {
    stream.set_read_timeout(Some(Duration::from_secs(30))).expect("a timeout");
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).expect("an end");
    String::from_utf8(answer).expect("text")
}
