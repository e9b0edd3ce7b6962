//! Connections: too many, too slow, idle.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use rigcast::config::ConnectionSettings;
use rigcast::http::Pace;
use tempfile::TempDir;

use crate::support::{Program, TestApp, bench, exchange, read_all};

fn connect(app: &TestApp) -> TcpStream {
    TcpStream::connect(app.address()).expect("a connection")
}

/// Sends these bytes, and returns all bytes until the service closes the connection.
fn answered(app: &TestApp, sent: &[u8]) -> String {
    let mut stream = connect(app);
    stream.write_all(sent).expect("sent");
    read_all(stream)
}

#[tokio::test]
async fn a_head_that_does_not_come_ends_the_connection_and_so_does_idleness() {
    let app = TestApp::start_as(|mut config| {
        config.connections.head_timeout = Duration::from_millis(300);
        config
    });
    for sent in [&b""[..], b"G", b"GET /livez HTTP/1.1\r\nHost: localhost\r\nX-Slow:"] {
        assert_eq!(answered(&app, sent), "", "cut without a word");
    }
    let answer = answered(&app, b"GET /livez HTTP/1.1\r\nHost: localhost\r\n\r\n");
    assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
    assert!(!answer.contains("connection: close"), "it was kept until it was idle for too long: {answer}");
}

#[tokio::test]
async fn a_slow_body_is_a_408_and_ends_the_connection() {
    let app = TestApp::start_as(|mut config| {
        config.limits.pace = Pace { bytes_per_s: 100, window: Duration::from_millis(500) };
        config
    });
    app.rig(&bench()).await;
    for (path, media_type) in [
        ("/v1/rigs", "application/json"),
        ("/v1/rigs/bench/fits", "application/json"),
        ("/v1/rigs/bench/runs", "text/csv"),
        ("/v1/rigs/bench/predict", "application/json"),
        ("/v1/rigs/bench/predict?sample_rate_hz=100", "application/x-npy"),
    ] {
        let head = format!(
            "POST {path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: {media_type}\r\nContent-Length: 1000\r\n\r\n{{\"id\""
        );
        let answer = answered(&app, head.as_bytes());
        assert!(answer.starts_with("HTTP/1.1 408"), "{path}: {answer}");
        assert!(
            answer.contains("\"code\":\"body.too_slow\"") && answer.contains("50 bytes within 0.5 s"),
            "{answer}"
        );
    }
    assert_eq!(app.files(), [] as [std::path::PathBuf; 0], "nothing is left of the upload");
}

#[tokio::test]
async fn connections_beyond_the_limit_are_told_so_and_places_come_back() {
    let app = TestApp::start_as(|mut config| {
        config.connections = ConnectionSettings { per_address: 2, ..ConnectionSettings::default() };
        config
    });
    let get = b"GET /livez HTTP/1.1\r\nHost: localhost\r\n\r\n";
    let mut open = [connect(&app), connect(&app)];
    for stream in &mut open {
        stream.write_all(get).expect("sent");
        let mut answer = [0; 12];
        stream.read_exact(&mut answer).expect("an answer");
        assert_eq!(&answer, b"HTTP/1.1 200");
    }
    let answer = answered(&app, get);
    assert!(answer.starts_with("HTTP/1.1 503"), "{answer}");
    let answer = answer.to_ascii_lowercase();
    for part in [
        "\"code\":\"busy\"",
        "retry-after: 1\r\n",
        "content-type: application/problem+json\r\n",
        "x-request-id: ",
        "connection: close\r\n",
        "x-content-type-options: nosniff\r\n",
    ] {
        assert!(answer.contains(part), "{part} is missing: {answer}");
    }
    drop(open);
    let started = Instant::now();
    while !exchange(app.address(), get).starts_with("HTTP/1.1 200") {
        assert!(started.elapsed() < Duration::from_secs(30), "the places do not come back");
        std::thread::sleep(Duration::from_millis(20));
    }
}

#[tokio::test]
async fn who_is_refused_while_a_large_body_is_still_coming_reads_why() {
    let app = TestApp::start_as(|mut config| {
        config.limits.upload_bytes = 1000;
        config
    });
    app.rig(&bench()).await;
    // Refused by its declared length, and by the received bytes.
    for length in ["Content-Length: 16777229", "Transfer-Encoding: chunked"] {
        let head = format!(
            "POST /v1/rigs/bench/runs HTTP/1.1\r\nHost: localhost\r\nContent-Type: text/csv\r\n{length}\r\n\r\n"
        );
        let mut stream = connect(&app);
        stream.write_all(head.as_bytes()).expect("sent");
        let body = vec![b'1'; 16 << 20];
        let piece = [format!("{:x}\r\n", body.len()).as_bytes(), &body, b"\r\n"].concat();
        for part in piece.chunks(64 << 10) {
            stream.write_all(part).expect("whoever sends is not cut off");
        }
        let answer = read_all(stream);
        assert!(
            answer.starts_with("HTTP/1.1 413") && answer.contains("\"code\":\"body.too_large\""),
            "{answer}"
        );
    }
}

#[test]
fn a_stop_closes_idle_connections_at_once() {
    let directory = TempDir::new().expect("a directory");
    let program = Program::start(&directory, &[("RIGCAST_HEAD_TIMEOUT_S", "600")]);
    let address = program.base().strip_prefix("http://").expect("a URL");
    let silent = TcpStream::connect(address).expect("a connection");
    let mut idle = TcpStream::connect(address).expect("a connection");
    idle.write_all(b"GET /livez HTTP/1.1\r\nHost: localhost\r\n\r\n").expect("sent");
    let mut answer = [0; 12];
    idle.read_exact(&mut answer).expect("an answer");
    let started = Instant::now();
    program.signal("-TERM");
    assert!(read_all(idle).ends_with("}"), "the rest of the answer, and the end");
    assert_eq!(read_all(silent), "");
    assert_eq!(program.ended().0, Some(0));
    assert!(started.elapsed() < Duration::from_secs(15), "nobody was waited for");
}
