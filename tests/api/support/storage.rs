//! S3-compatible storage, which the Python package `moto` has. `scripts/python_env.sh storage` installs it.

use std::io::{BufRead, BufReader};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// A server of S3's protocol.
pub struct Storage {
    server: Child,
    endpoint: String,
}

impl Storage {
    /// Starts one with a bucket `lab`; `None` where the package is not there.
    pub fn start() -> Option<Self> {
        let Some(folder) = std::env::var_os("RIGCAST_STORAGE").filter(|folder| !folder.is_empty()) else {
            println!(
                "skipped: RIGCAST_STORAGE names no environment of Python (scripts/python_env.sh storage)"
            );
            return None;
        };
        let port =
            TcpListener::bind("127.0.0.1:0").and_then(|free| free.local_addr()).expect("a port").port();
        let mut server = Command::new(Path::new(&folder).join("bin/moto_server"))
            .args(["-H", "127.0.0.1", "-p", &port.to_string()])
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .expect("the server starts");
        let log = BufReader::new(server.stderr.take().expect("piped"));
        // A pipe that nobody reads from would block it.
        std::thread::spawn(move || log.lines().map_while(Result::ok).for_each(drop));
        let until = Instant::now() + Duration::from_secs(60);
        while TcpStream::connect(("127.0.0.1", port)).is_err() {
            assert!(Instant::now() < until, "the storage does not listen");
            std::thread::sleep(Duration::from_millis(100));
        }
        let storage = Self { server, endpoint: format!("http://127.0.0.1:{port}") };
        let made = put(port, "/lab");
        assert!(made.contains("200"), "{made}");
        Some(storage)
    }

    pub fn environment(&self) -> Vec<(&str, &str)> {
        vec![
            ("RIGCAST_OBJECTS", "s3://lab/one"),
            ("RIGCAST_S3_ENDPOINT", &self.endpoint),
            ("AWS_ACCESS_KEY_ID", "engineer"),
            ("AWS_SECRET_ACCESS_KEY", "hunter2hunter2"),
        ]
    }

    /// Its URL.
    pub fn endpoint(&self) -> &str {
        &self.endpoint
    }

    /// Its address.
    pub fn address(&self) -> SocketAddr {
        self.endpoint.trim_start_matches("http://").parse().expect("an address")
    }

    pub fn signal(&self, name: &str) {
        super::signal(name, self.server.id());
    }
}

impl Drop for Storage {
    fn drop(&mut self) {
        let _ = self.server.kill();
        let _ = self.server.wait();
    }
}

/// The status line of a PUT without a body.
fn put(port: u16, path: &str) -> String {
    let request =
        format!("PUT {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 0\r\nConnection: close\r\n\r\n");
    let answer = super::exchange(([127, 0, 0, 1], port).into(), request.as_bytes());
    answer.lines().next().unwrap_or_default().to_owned()
}
