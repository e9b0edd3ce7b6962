//! A way to a server that fails when a test wants it to.

use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// What becomes of requests.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Weather {
    /// They reach the server.
    Fair = 0,
    /// They are answered with 500.
    Failing = 1,
    /// They are not answered.
    Silent = 2,
    /// What is sent gets lost, on connections that are open too, and nobody is told; what is sent again later arrives.
    Lost = 3,
}

/// Passes connections on to a server, while the weather is fair.
pub struct Way {
    address: SocketAddr,
    weather: Arc<AtomicU8>,
    /// Connections that were made in fair weather.
    open: Arc<Mutex<Vec<TcpStream>>>,
}

impl Way {
    /// A way to a server on loopback.
    pub fn to(server: SocketAddr) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
        let address = listener.local_addr().expect("an address");
        let (weather, open) = (Arc::new(AtomicU8::new(0)), Arc::new(Mutex::new(Vec::new())));
        let (seen, kept) = (weather.clone(), open.clone());
        std::thread::spawn(move || {
            for client in listener.incoming().map_while(Result::ok) {
                let (seen, kept) = (seen.clone(), kept.clone());
                std::thread::spawn(move || pass(client, server, &seen, &kept));
            }
        });
        Self { address, weather, open }
    }

    /// Where it begins.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Changes the weather, for connections that are open too: these end, if nothing gets lost on them.
    pub fn set(&self, weather: Weather) {
        let before = self.weather.swap(weather as u8, Ordering::SeqCst);
        if is_lost(before) || is_lost(weather as u8) {
            return;
        }
        for connection in self.open.lock().expect("whole").drain(..) {
            // It may have ended.
            let _ = connection.shutdown(std::net::Shutdown::Both);
        }
    }
}

fn is_lost(weather: u8) -> bool {
    weather == Weather::Lost as u8
}

fn wait_while_lost(weather: &AtomicU8) {
    while is_lost(weather.load(Ordering::SeqCst)) {
        std::thread::sleep(Duration::from_millis(10));
    }
}

fn pass(mut client: TcpStream, server: SocketAddr, weather: &Arc<AtomicU8>, open: &Mutex<Vec<TcpStream>>) {
    wait_while_lost(weather);
    match weather.load(Ordering::SeqCst) {
        0 => {
            let Ok(server) = TcpStream::connect(server) else { return };
            let copies = [client.try_clone(), server.try_clone(), client.try_clone(), server.try_clone()];
            let [Ok(from), Ok(to), Ok(kept), Ok(other)] = copies else { return };
            open.lock().expect("whole").extend([kept, other]);
            let seen = weather.clone();
            let back = std::thread::spawn(move || copy(server, client, &seen));
            copy(from, to, weather);
            let _ = back.join();
        }
        1 => {
            let _ = client.set_read_timeout(Some(Duration::from_millis(200)));
            let mut request = [0; 1 << 16];
            // As much of the request as comes at once.
            let _ = client.read(&mut request);
            let answer =
                "HTTP/1.1 500 Internal Server Error\r\nContent-Length: 0\r\nConnection: close\r\n\r\n";
            let _ = client.write_all(answer.as_bytes());
        }
        _ => {
            let mut request = [0; 1 << 16];
            // Until the client gives up.
            while !matches!(client.read(&mut request), Ok(0) | Err(_)) {}
        }
    }
}

fn copy(mut from: TcpStream, mut to: TcpStream, weather: &AtomicU8) {
    let mut bytes = vec![0; 1 << 16];
    loop {
        let read = from.read(&mut bytes);
        wait_while_lost(weather);
        match read {
            Ok(0) => break,
            Err(error) if error.kind() == ErrorKind::Interrupted => {}
            Err(_) => break,
            Ok(n) if to.write_all(&bytes[..n]).is_err() => break,
            Ok(_) => {}
        }
    }
    let _ = to.shutdown(std::net::Shutdown::Write);
}
