//! The real program on a free loopback port, and a client that takes hardly any time.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::thread::JoinHandle;

use serde_json::Value;
use tempfile::TempDir;

/// A running `rigcast serve` with a data directory of its own; dropping it stops the program.
pub struct Service {
    child: Child,
    address: String,
    /// Reads the log to its end, so that the program never waits for a full pipe.
    log: Option<JoinHandle<()>>,
    data_dir: TempDir,
}

impl Service {
    /// Starts the program that was built with this benchmark and waits until it listens.
    pub fn start() -> Self {
        Self::start_where(false)
    }

    /// The same; with its registry and objects where the environment says, if it is shared.
    pub fn start_where(is_shared: bool) -> Self {
        let data_dir = TempDir::with_prefix("rigcast-bench-").expect("a temporary directory");
        let mut command = Command::new(env!("CARGO_BIN_EXE_rigcast"));
        if !is_shared {
            command.env_remove("RIGCAST_DATABASE").env_remove("RIGCAST_OBJECTS");
        }
        let mut child = command
            .args(["serve", "--listen", "127.0.0.1:0", "--log-format", "json", "--data-dir"])
            .arg(data_dir.path())
            .stderr(Stdio::piped())
            .spawn()
            .expect("the program starts");
        let mut lines = BufReader::new(child.stderr.take().expect("piped")).lines();
        let address = loop {
            let line = lines.next().expect("the program says where it listens").expect("text");
            let event: Value = serde_json::from_str(&line).expect("a JSON line");
            if let Some(address) = event["http.address"].as_str() {
                break address.to_owned();
            }
        };
        let log = std::thread::spawn(move || lines.for_each(drop));
        Self { child, address, log: Some(log), data_dir }
    }

    /// Its address.
    pub fn address(&self) -> &str {
        &self.address
    }

    /// A new connection.
    pub fn connect(&self) -> Connection {
        let stream = TcpStream::connect(&self.address).expect("the service accepts");
        stream.set_nodelay(true).expect("a TCP option");
        Connection { stream: BufReader::with_capacity(1 << 16, stream), body: Vec::new() }
    }

    /// Largest resident memory of the program so far, bytes.
    pub fn peak_resident(&self) -> u64 {
        self.memory("VmHWM:")
    }

    /// Resident memory of the program, bytes.
    pub fn resident(&self) -> u64 {
        self.memory("VmRSS:")
    }

    /// Its process.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Its data directory.
    pub fn data_dir(&self) -> &Path {
        self.data_dir.path()
    }

    fn memory(&self, which: &str) -> u64 {
        let path = format!("/proc/{}/status", self.child.id());
        let status = std::fs::read_to_string(path).expect("Linux tells about a process");
        let line = status.lines().find_map(|l| l.strip_prefix(which)).expect("its memory");
        let kib: u64 = line.trim().trim_end_matches(" kB").parse().expect("a number");
        kib << 10
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        // Errors are ignored here: the directory is temporary, and the figures are printed.
        let _ = self.child.kill();
        let _ = self.child.wait();
        if let Some(log) = self.log.take() {
            let _ = log.join();
        }
    }
}

/// A kept-alive HTTP/1.1 connection that sends prepared bytes and reads answers into one buffer, so that the
/// service is measured and not a client library.
pub struct Connection {
    stream: BufReader<TcpStream>,
    body: Vec<u8>,
}

impl Connection {
    /// Sends a request and reads its answer, which must have the status `expected`.
    pub fn call(&mut self, head: &str, body: &[u8], expected: u16) -> &[u8] {
        let (status, body) = self.exchange(head, body);
        assert_eq!(status, expected, "{}", String::from_utf8_lossy(&body[..body.len().min(2000)]));
        body
    }

    /// Sends a request and reads its answer: status and body.
    pub fn exchange(&mut self, head: &str, body: &[u8]) -> (u16, &[u8]) {
        let length = body.len();
        let head = format!("{head}\r\nHost: localhost\r\nContent-Length: {length}\r\n\r\n");
        let stream = self.stream.get_mut();
        stream.write_all(head.as_bytes()).expect("the service reads");
        stream.write_all(body).expect("the service reads");
        let mut line = String::new();
        self.stream.read_line(&mut line).expect("an answer");
        let status: u16 = line.split(' ').nth(1).and_then(|s| s.parse().ok()).expect("a status line");
        let mut length = 0;
        loop {
            line.clear();
            self.stream.read_line(&mut line).expect("headers");
            let Some((name, value)) = line.split_once(':') else { break };
            if name.eq_ignore_ascii_case("content-length") {
                length = value.trim().parse().expect("a length");
            }
        }
        self.body.resize(length, 0);
        self.stream.read_exact(&mut self.body).expect("the body");
        (status, &self.body)
    }

    /// Reads a JSON document.
    pub fn get(&mut self, path: &str) -> Value {
        serde_json::from_slice(self.call(&format!("GET {path} HTTP/1.1"), b"", 200)).expect("JSON")
    }

    /// Sends a JSON document, reads one.
    pub fn json(&mut self, method_and_path: &str, extra: &str, body: &Value, expected: u16) -> Value {
        let head = format!("{method_and_path} HTTP/1.1\r\nContent-Type: application/json{extra}");
        let answer = self.call(&head, body.to_string().as_bytes(), expected);
        serde_json::from_slice(answer).expect("JSON")
    }
}
