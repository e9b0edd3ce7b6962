//! Predictions over HTTP: the release program on a loopback port, and a client on the same machine.
//!
//! `cargo bench --bench http` times 60 s of drive (3 drives, 6 responses, 1 kHz, a hybrid 2 of the
//! paper's size) in NPY and in JSON. The other measurements run by name and print one JSON line each:
//!
//! - `cargo bench --bench http -- p50`: median of 60 s and 10 s requests, as a client sees them;
//! - `scripts/on_cluster.sh cargo bench --bench http -- shared`: the medians through PostgreSQL and a storage of S3's
//!   protocol over those through SQLite and files, in turns;
//! - `cargo bench --bench http -- whole`: 20 s in JSON with six targets, errors, damage and Multi-Rain of two groups;
//! - `cargo bench --bench http -- hour`: peak resident memory of the service for 1 h of drive;
//! - `cargo bench --bench http -- beside`: 10 s of drive, alone and while 1 h is predicted;
//! - `cargo bench --bench http -- upload`: 1 h of nine channels as RPC III, from the request to the stored run, and the
//!   peak resident memory above that of the idle service;
//! - `cargo bench --bench http -- fit`: peak resident memory of a fit on 2 h of runs;
//! - `cargo bench --bench http -- load` (`fair`, `departed`, `slow`, `soak`): overload, and hours of load.

mod load;
mod rig;
mod service;

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use criterion::{Criterion, criterion_group};
use rigcast::engine::Signal;
use rigcast::engine::lstm::Recombine;
use rigcast::formats::npy::{Dtype, Order, write};
use rigcast::formats::rpc3::Rpc3Pieces;
use serde_json::json;

use rig::{
    DRIVES, RATE_HZ, RESPONSES, activate, create, create_grouped, json_request, json_request_with_targets,
    noise, npy_request,
};
use service::{Connection, Service};

const MINUTE: usize = 60_000;
const HOUR: usize = 60 * MINUTE;

fn ready(recombine: Recombine, low_pass_hz: Option<f64>) -> Service {
    ready_on(Service::start(), recombine, low_pass_hz)
}

fn ready_on(service: Service, recombine: Recombine, low_pass_hz: Option<f64>) -> Service {
    create(&service);
    activate(&service, recombine, low_pass_hz);
    service
}

fn predict_60s(criterion: &mut Criterion) {
    let service = ready(Recombine::Welch, None);
    let mut connection = service.connect();
    let mut group = criterion.benchmark_group("http_60s");
    let requests = [("npy", npy_request(MINUTE, Dtype::F4)), ("json", json_request(MINUTE))];
    for (name, (head, body)) in &requests {
        group.bench_function(*name, |b| b.iter(|| connection.call(head, body, 200).len()));
    }
    group.finish();
}

criterion_group!(benches, predict_60s);

fn main() {
    // Cargo's own arguments begin with dashes.
    let named = std::env::args().skip(1).find(|argument| !argument.starts_with('-'));
    match named.as_deref() {
        Some("p50") => p50(),
        Some("shared") => shared(),
        Some("whole") => whole(),
        Some("hour") => hour(),
        Some("beside") => beside(),
        Some("upload") => upload(),
        Some("fit") => fit(),
        Some("load") => load::load().end(),
        Some("fair") => load::fair().end(),
        Some("slow") => load::slow().end(),
        Some("departed") => load::departed().end(),
        Some("soak") => load::soak().end(),
        _ => {
            benches();
            Criterion::default().configure_from_args().final_summary();
        }
    }
}

/// One figure, in the form of `examples/speed.rs`.
fn tell(work: &str, unit: &str, mut values: Vec<f64>) {
    values.sort_by(f64::total_cmp);
    let (min, max) = (values[0], values[values.len() - 1]);
    let line = json!({
        "work": work, "unit": unit, "median": values[values.len() / 2],
        "min": min, "max": max, "reps": values.len(),
    });
    println!("{line}");
}

/// Seconds of one request.
fn timed(connection: &mut Connection, (head, body): &(String, Vec<u8>)) -> f64 {
    let started = Instant::now();
    connection.call(head, body, 200);
    started.elapsed().as_secs_f64()
}

fn p50() {
    let service = ready(Recombine::Welch, None);
    let mut connection = service.connect();
    let works = [
        ("http_npy_60s", npy_request(MINUTE, Dtype::F4)),
        ("http_npy_f8_60s", npy_request(MINUTE, Dtype::F8)),
        ("http_json_60s", json_request(MINUTE)),
        ("http_npy_10s", npy_request(MINUTE / 6, Dtype::F4)),
        ("http_json_10s", json_request(MINUTE / 6)),
    ];
    for (work, request) in &works {
        (0..5).for_each(|_| _ = timed(&mut connection, request));
        tell(work, "s", (0..101).map(|_| timed(&mut connection, request)).collect());
    }
}

/// The same predictions by a service of its own and by one that shares its registry, in turns.
fn shared() {
    if std::env::var_os("RIGCAST_DATABASE").is_none() {
        println!("skipped: RIGCAST_DATABASE names no PostgreSQL (scripts/on_cluster.sh)");
        return;
    }
    let services = [false, true].map(|shared| ready_on(Service::start_where(shared), Recombine::Welch, None));
    let mut connections = services.each_ref().map(Service::connect);
    let works = [
        ("10s", npy_request(MINUTE / 6, Dtype::F4)),
        ("json_10s", json_request(MINUTE / 6)),
        ("60s", npy_request(MINUTE, Dtype::F4)),
    ];
    for (work, request) in &works {
        let mut times = [Vec::new(), Vec::new()];
        for k in 0..211 {
            for (connection, times) in connections.iter_mut().zip(&mut times) {
                let time = timed(connection, request);
                if k >= 10 {
                    times.push(time);
                }
            }
        }
        for times in &mut times {
            times.sort_by(f64::total_cmp);
        }
        let [alone, shared] = times.map(|times| times[times.len() / 2]);
        let figures = json!({"alone_s": alone, "shared_s": shared, "ratio": shared / alone});
        println!("{}", json!({"work": format!("shared_{work}"), "figures": figures}));
    }
}

/// Everything that an answer has by default, of a rig with groups; and the same drive without a target.
fn whole() {
    let service = Service::start();
    create_grouped(&service);
    activate(&service, Recombine::Welch, None);
    let mut connection = service.connect();
    let works = [
        ("http_json_20s_targets", json_request_with_targets(MINUTE / 3)),
        ("http_json_20s_no_target", json_request(MINUTE / 3)),
    ];
    for (work, request) in &works {
        (0..5).for_each(|_| _ = timed(&mut connection, request));
        tell(work, "s", (0..51).map(|_| timed(&mut connection, request)).collect());
    }
}

/// One service per measurement, so that each peak is its own.
fn hour() {
    for (name, recombine, low_pass_hz) in [
        ("windows", Recombine::Welch, None),
        ("stream", Recombine::Stream, None),
        ("low_pass", Recombine::Welch, Some(80.0)),
    ] {
        for (dtype, descr) in [(Dtype::F4, "f4"), (Dtype::F8, "f8")] {
            let request = npy_request(HOUR, dtype);
            let service = ready(recombine, low_pass_hz);
            let seconds = timed(&mut service.connect(), &request);
            tell(&format!("http_1h_{name}_{descr}_time"), "s", vec![seconds]);
            tell(&format!("http_1h_{name}_{descr}_resident"), "bytes", vec![service.peak_resident() as f64]);
        }
    }
}

fn beside() {
    let (long, short) = (npy_request(HOUR, Dtype::F4), npy_request(MINUTE / 6, Dtype::F4));
    for (name, recombine) in [("windows", Recombine::Welch), ("stream", Recombine::Stream)] {
        let service = ready(recombine, None);
        let mut connection = service.connect();
        (0..5).for_each(|_| _ = timed(&mut connection, &short));
        tell(
            &format!("http_10s_{name}_alone"),
            "s",
            (0..51).map(|_| timed(&mut connection, &short)).collect(),
        );
        for hours in [1, 2] {
            let ended = AtomicBool::new(false);
            let mut beside = Vec::new();
            std::thread::scope(|scope| {
                for first in 0..hours {
                    let (service, long, ended) = (&service, &long, &ended);
                    scope.spawn(move || {
                        let mut connection = service.connect();
                        (0..3).for_each(|_| _ = timed(&mut connection, long));
                        ended.fetch_or(first == 0, Ordering::Relaxed);
                    });
                }
                while !ended.load(Ordering::Relaxed) {
                    beside.push(timed(&mut connection, &short));
                    std::thread::sleep(Duration::from_millis(3));
                }
            });
            tell(&format!("http_10s_{name}_beside_{hours}x1h"), "s", beside);
        }
    }
}

/// Drives, and responses that follow from them with a nonlinearity.
fn measured(samples: usize, seed: u64) -> Vec<Vec<f64>> {
    let x = noise(samples, DRIVES.len(), seed);
    let y = (0..RESPONSES.len()).map(|o| {
        let (a, b) = (&x[o % 3], &x[(o + 1) % 3]);
        a.iter().zip(b).map(|(a, b)| 0.7 * a + 0.2 * b + 0.05 * a * a * a).collect()
    });
    x.iter().cloned().chain(y).collect()
}

/// One service per repetition, so that each peak is its own.
fn upload() {
    let names: Vec<String> = DRIVES.iter().chain(&RESPONSES).map(|name| (*name).to_owned()).collect();
    let units = vec!["kN".to_owned(); names.len()];
    let signal = Signal::new(RATE_HZ, measured(HOUR, 300)).expect("a run");
    let pieces: Result<Vec<Vec<u8>>, _> = Rpc3Pieces::new(names, units, false, signal).collect();
    let file = pieces.expect("samples in memory").concat();
    let head = "POST /v1/rigs/bench/runs?kind=noise HTTP/1.1\r\nContent-Type: application/x-rpc3";
    let (mut seconds, mut resident) = (Vec::new(), Vec::new());
    for _ in 0..5 {
        let service = Service::start();
        create(&service);
        let (idle, mut connection) = (service.resident(), service.connect());
        let started = Instant::now();
        connection.call(head, &file, 201);
        seconds.push(started.elapsed().as_secs_f64());
        resident.push(service.peak_resident().saturating_sub(idle) as f64);
    }
    tell("http_upload_1h_rpc3_time", "s", seconds);
    tell("http_upload_1h_rpc3_resident_above_idle", "bytes", resident);
}

/// Two hours in eight runs, the service's default settings but for the number of epochs, which
/// takes time and no memory.
fn fit() {
    let service = Service::start();
    create(&service);
    let mut connection = service.connect();
    let names = [&DRIVES[..], &RESPONSES[..]].concat().join(",");
    for run in 0..8 {
        let channels = measured(HOUR / 4, 100 + run);
        let head = format!(
            "POST /v1/rigs/bench/runs?name=run-{run}&kind=noise&channels={names}&sample_rate_hz={RATE_HZ} HTTP/1.1\r\n\
             Content-Type: application/x-npy"
        );
        connection.call(&head, &write(&channels, Dtype::F4, Order::C).expect("a run"), 201);
    }
    tell("http_fit_2h_uploads_resident", "bytes", vec![service.peak_resident() as f64]);
    let fit = json!({"kind": "hybrid2", "lstm": {"epochs": 2}});
    let started = Instant::now();
    let job = connection.json("POST /v1/rigs/bench/fits", "", &fit, 202);
    let path = format!("/v1/jobs/{}", job["id"].as_str().expect("an id"));
    loop {
        let job = connection.get(&path);
        match job["state"].as_str() {
            Some("succeeded") => break,
            Some("failed" | "cancelled") => panic!("{job}"),
            _ => std::thread::sleep(Duration::from_millis(200)),
        }
    }
    tell("http_fit_2h_time", "s", vec![started.elapsed().as_secs_f64()]);
    tell("http_fit_2h_resident", "bytes", vec![service.peak_resident() as f64]);
}
