//! A program whose memory is watched while it answers.

use std::path::Path;

use rigcast::http::codes;
use serde_json::json;
use tempfile::TempDir;

use super::corpus::Case;
use crate::support::{Contract, Program, Reply, SAFETENSORS, bench, gain_weights};

/// Memory that a single request may take besides a multiple of its bytes.
const ALLOWED: u64 = 64 << 20;

/// The multiple: memory per byte that was received, read or sent.
const TIMES: u64 = 4;

/// Longest answer to a bad request, which must not repeat the request.
const MAX_ANSWER: usize = 32 << 10;

/// The program on a directory with a rig `bench` and its model.
pub struct Meter {
    program: Program,
    http: reqwest::Client,
    /// Resident memory before the first bad request.
    idle: u64,
}

/// The outcome of a request.
#[derive(Debug)]
pub struct Measured {
    pub status: u16,
    /// Empty for a success.
    pub code: String,
    /// Peak above what the program held before the request, bytes.
    pub peak: u64,
    /// The allowed peak.
    pub allowed: u64,
}

impl Meter {
    /// Makes rig and model.
    pub async fn furnish(directory: &TempDir) {
        let meter = Self::start(directory.path()).await;
        let client = rigcast::client::Client::new(meter.program.base(), None).expect("a client");
        client.post("/v1/rigs", &bench()).await.expect("a rig");
        client.import("bench", gain_weights(&["u"], &["y"], 2.0)).await.expect("a model");
        let active = Case::json("PUT", "/v1/rigs/bench/active-model", json!({"version": 1}).to_string());
        assert_eq!(meter.send(&active).await.status, 200);
    }

    /// Starts the program on the directory of [`Meter::furnish`] and warms it up, so that memory taken once,
    /// at the first request of a kind, does not count for later ones.
    pub async fn start(directory: &Path) -> Self {
        let program = Program::start_on(directory, &[]);
        let meter = Self { program, http: reqwest::Client::new(), idle: 0 };
        for path in ["/v1/rigs/bench", "/v1/rigs/bench/active-model", "/metrics"] {
            meter.send(&Case::new("GET", path)).await;
        }
        let drive = json!({"drive": {"sample_rate_hz": 100.0, "channels": {"u": [0.0, 0.5]}}}).to_string();
        meter.send(&Case::json("POST", "/v1/rigs/bench/predict", drive)).await;
        let refused = Case::file("POST", "/v1/rigs/bench/runs", "text/csv", "u,y\n0,x\n");
        meter.send(&refused).await;
        let idle = meter.program.memory("VmRSS");
        Self { idle, ..meter }
    }

    /// Sends a request without checks.
    pub async fn send(&self, case: &Case) -> Reply {
        let url = format!("{}{}", self.program.base(), case.path);
        let mut request = self.http.request(case.method.parse().expect("a method"), url);
        for (name, value) in &case.headers {
            request = request.header(name, value);
        }
        let response = request.body(case.body.clone()).send().await;
        let response = response.unwrap_or_else(|e| panic!("{}: no answer: {e}", case.name));
        let (status, headers) = (response.status().as_u16(), response.headers().clone());
        let bytes = response.bytes().await.expect("a whole answer").to_vec();
        Reply { status, headers, bytes }
    }

    /// Sends a request, and checks its answer and its memory.
    pub async fn measure(&self, case: &Case) -> Measured {
        self.program.count_peak();
        // What earlier requests left has a bar of its own, the growth.
        let before = self.program.memory("VmRSS").max(self.idle);
        let reply = self.send(case).await;
        let peak = self.program.memory("VmHWM").saturating_sub(before);
        assert!(
            reply.status < 500,
            "{}: {} {}",
            case.name,
            reply.status,
            String::from_utf8_lossy(&reply.bytes)
        );
        Contract::get().check(&case.method, &case.path, None, &reply);
        let code = if reply.status < 400 {
            String::new()
        } else {
            assert!(
                reply.bytes.len() <= MAX_ANSWER,
                "{}: an answer of {} bytes",
                case.name,
                reply.bytes.len()
            );
            let code = reply.json()["code"].as_str().expect("a code").to_owned();
            assert!(codes::find(&code).is_some(), "{}: {code}", case.name);
            code
        };
        let bytes = case.size() + case.stored + reply.bytes.len() as u64;
        Measured { status: reply.status, code, peak, allowed: ALLOWED + TIMES * bytes }
    }

    /// Growth of resident memory since the start.
    pub fn growth(&self) -> u64 {
        self.program.memory("VmRSS").saturating_sub(self.idle)
    }

    /// The program's address, for requests as bytes.
    pub fn address(&self) -> std::net::SocketAddr {
        self.program.base().strip_prefix("http://").and_then(|at| at.parse().ok()).expect("an address")
    }
}

impl Measured {
    /// Prints it in one line; returns whether it is beyond the allowance.
    pub fn print(&self, case: &Case) -> bool {
        let mib = |bytes: u64| bytes as f64 / (1 << 20) as f64;
        let (size, peak, allowed) = (mib(case.size()), mib(self.peak), mib(self.allowed));
        let what = format!("{} {}", self.status, self.code);
        println!("{:<45} {what:<32} {size:7.2} MiB sent, peak {peak:7.1} of {allowed:7.1}", case.name);
        self.peak > self.allowed
    }
}

/// The media type of weights, where cases need it.
pub const WEIGHTS: &str = SAFETENSORS;
