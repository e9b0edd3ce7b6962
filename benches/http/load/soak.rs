//! Hours at 0.6 C: predictions beside runs that come and go and a fit a minute, and what the service takes.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use super::bars::Bars;
use super::{Lab, accepted, quantile, tell};
use crate::rig::noise;
use crate::service::{Connection, Service};

/// Two hours, or as many seconds as the environment says.
fn length() -> Duration {
    let seconds = std::env::var("RIGCAST_SOAK_S").ok().and_then(|s| s.parse().ok()).unwrap_or(7200);
    Duration::from_secs(seconds)
}

/// Time between two looks at the process.
const ROUND: Duration = Duration::from_secs(30);

/// Handles and threads are counted while requests come and go: a tenth more or less is none that leaks.
const FLAT: f64 = 1.1;

/// What the service holds at one time.
struct Held {
    resident: u64,
    handles: usize,
    threads: usize,
    log: u64,
}

impl Held {
    fn now(service: &Service) -> Self {
        let count = |what: &str| {
            let path = format!("/proc/{}/{what}", service.pid());
            std::fs::read_dir(path).expect("Linux tells about a process").count()
        };
        let log = std::fs::metadata(service.data_dir().join("rigcast.db-wal")).map_or(0, |file| file.len());
        Self { resident: service.resident(), handles: count("fd"), threads: count("task"), log }
    }
}

/// Files below a directory.
fn files(directory: &Path) -> usize {
    std::fs::read_dir(directory).map_or(0, Iterator::count)
}

/// Sends a request again until it is not refused for load, as clients do.
fn patiently(connection: &mut Connection, head: &str, body: &[u8], expected: u16) -> Vec<u8> {
    loop {
        let (status, answer) = connection.exchange(head, body);
        if status != 503 {
            assert_eq!(status, expected, "{}", String::from_utf8_lossy(answer));
            return answer.to_vec();
        }
        std::thread::sleep(Duration::from_secs(1));
    }
}

/// Makes, reads and deletes a run every two seconds, and fits one every minute, until it is told to stop.
fn beside(service: &Service, stop: &AtomicBool) -> (usize, usize) {
    let mut connection = service.connect();
    let channels = noise(10_000, 2, 3);
    let rows: String = channels[0].iter().zip(&channels[1]).map(|(u, y)| format!("{u},{y}\n")).collect();
    let body = format!("drive_x,force_x\n{rows}").into_bytes();
    let upload = "POST /v1/rigs/bench/runs?kind=other HTTP/1.1\r\nContent-Type: text/csv";
    let kept: Value = serde_json::from_slice(&patiently(&mut connection, upload, &body, 201)).expect("JSON");
    let kept = &kept["id"];
    let fit = json!({"kind": "frf", "inputs": ["drive_x"], "outputs": ["force_x"], "runs": [kept]});
    let (mut runs, mut fits, mut next_fit) = (0, 0, Instant::now());
    while !stop.load(Ordering::Relaxed) {
        let run: Value =
            serde_json::from_slice(&patiently(&mut connection, upload, &body, 201)).expect("JSON");
        let path = format!("/v1/rigs/bench/runs/{}", run["id"].as_str().expect("an id"));
        let read = format!("GET {path}/data HTTP/1.1\r\nAccept: application/x-npy");
        patiently(&mut connection, &read, b"", 200);
        patiently(&mut connection, &format!("DELETE {path} HTTP/1.1"), b"", 204);
        runs += 1;
        if Instant::now() >= next_fit {
            let head = "POST /v1/rigs/bench/fits HTTP/1.1\r\nContent-Type: application/json";
            patiently(&mut connection, head, fit.to_string().as_bytes(), 202);
            fits += 1;
            next_fit += Duration::from_secs(60);
        }
        std::thread::sleep(Duration::from_secs(2));
    }
    (runs, fits)
}

/// Predictions at 0.6 C for hours.
pub fn soak() -> Bars {
    let lab = Lab::start();
    let per_s = 0.6 * lab.capacity();
    let length = length();
    let stop = AtomicBool::new(false);
    let (mut held, mut asked, mut answered, mut slowest) = (Vec::new(), 0, 0, Vec::new());
    let (runs, fits) = std::thread::scope(|scope| {
        let other = scope.spawn(|| beside(&lab.service, &stop));
        let began = Instant::now();
        while began.elapsed() < length {
            let outcomes = lab.predict(per_s, ROUND.min(length), None);
            asked += outcomes.len();
            answered += accepted(&outcomes).len();
            slowest.push(quantile(&outcomes, 0.99));
            held.push(Held::now(&lab.service));
        }
        stop.store(true, Ordering::Relaxed);
        other.join().expect("no panic")
    });
    slowest.sort_by(f64::total_cmp);
    let (first, last) = held.split_at(held.len() / 2);
    let most = |part: &[Held], what: fn(&Held) -> u64| part.iter().map(what).max().unwrap_or_default();
    // Idle connections and what was made in the last round are gone by then.
    std::thread::sleep(Duration::from_secs(30));
    let scratch = files(&lab.service.data_dir().join("scratch"));
    tell(
        "soak",
        &json!({
            "length_s": length.as_secs(), "per_s": per_s, "asked": asked, "answered": answered,
            "runs_made_and_deleted": runs, "fits": fits, "median_p99_s": slowest[slowest.len() / 2],
            "resident_bytes_first_half": most(first, |held| held.resident),
            "resident_bytes_second_half": most(last, |held| held.resident),
            "handles": [most(first, |held| held.handles as u64), most(last, |held| held.handles as u64)],
            "threads": [most(first, |held| held.threads as u64), most(last, |held| held.threads as u64)],
            "wal_bytes": most(&held, |held| held.log),
            "scratch_files_at_the_end": scratch,
        }),
    );
    let grown = |what: fn(&Held) -> u64| most(last, what) as f64 / (most(first, what).max(1)) as f64;
    let mut bars = Bars::default();
    bars.at_most("resident memory, second half of the first", grown(|held| held.resident), 1.05);
    bars.at_most("handles, second half of the first", grown(|held| held.handles as u64), FLAT);
    bars.at_most("threads, second half of the first", grown(|held| held.threads as u64), FLAT);
    bars.at_most("write-ahead log, MiB", most(&held, |held| held.log) as f64 / f64::from(1 << 20), 64.0);
    bars.at_most("files in scratch at the end", scratch as f64, 0.0);
    bars
}
