//! Memory of single bad requests: at most 64 MiB and four times the bytes received, read and sent.
//!
//! `RIGCAST_TEST_BODY_MIB=48 cargo test --test api peaks -- --nocapture` sends larger ones.

use serde_json::json;
use tempfile::TempDir;

use super::corpus::{Case, MODELS, PREDICT, large};
use super::lies::{diverging, lies};
use super::meter::{Meter, WEIGHTS};
use crate::support::{exchange, setting};

/// Bytes of large bodies.
fn size() -> usize {
    setting("RIGCAST_TEST_BODY_MIB", 16_usize) << 20
}

#[tokio::test]
async fn large_bodies_that_are_wrong_take_no_more_than_four_times_their_size() {
    let directory = TempDir::new().expect("a directory");
    Meter::furnish(&directory).await;
    let (mut wrong, mut most) = (Vec::new(), 0.0_f64);
    for case in large(size()) {
        // One program per request: memory left by another request would hide the peak of this one.
        let meter = Meter::start(directory.path()).await;
        let found = meter.measure(&case).await;
        assert!(found.status >= 400, "{}: {found:?}", case.name);
        assert!(case.code.is_empty() || case.code == found.code, "{}: {found:?}", case.name);
        most = most.max(found.peak as f64 / found.allowed as f64);
        if found.print(&case) {
            wrong.push(case.name);
        }
    }
    println!("large bodies of {} MiB: {:.0} % of what is allowed at most", size() >> 20, 100.0 * most);
    assert!(wrong.is_empty(), "{wrong:?} take more than they may");
}

#[tokio::test]
async fn small_requests_that_claim_to_be_large_are_refused_at_their_size() {
    let directory = TempDir::new().expect("a directory");
    Meter::furnish(&directory).await;
    let meter = Meter::start(directory.path()).await;
    let cases = lies();
    let mut most = 0;
    for case in &cases {
        let found = meter.measure(case).await;
        assert!(found.status >= 400, "{}: {found:?}", case.name);
        assert!(case.code.is_empty() || case.code == found.code, "{}: {found:?}", case.name);
        assert!(!found.print(case), "{}: {found:?}", case.name);
        most = most.max(found.peak);
    }
    println!("{} requests that lie: {:.1} MiB at most", cases.len(), most as f64 / f64::from(1 << 20));
    // A declared length that no body has, and chunks that never come.
    for head in [
        "content-length: 18446744073709551615",
        "content-length: 99999999999999999999",
        "content-length: -1",
        "transfer-encoding: chunked\r\n\r\nffffffffffffffff\r\nu,y",
        "transfer-encoding: chunked\r\n\r\nfffffffffffffffff\r\nu,y",
    ] {
        let start = "POST /v1/rigs/bench/runs HTTP/1.1\r\nhost: localhost\r\ncontent-type: text/csv";
        let answer = exchange(meter.address(), format!("{start}\r\n{head}\r\n\r\n").as_bytes());
        assert!(answer.starts_with("HTTP/1.1 4"), "{head}: {answer}");
        assert!(answer.contains("content-type: application/problem+json"), "{head}: {answer}");
    }
    meter.measure(&Case::new("GET", "/v1/rigs")).await;
}

#[tokio::test]
async fn a_model_that_diverges_says_so() {
    let directory = TempDir::new().expect("a directory");
    Meter::furnish(&directory).await;
    let meter = Meter::start(directory.path()).await;
    for weights in diverging() {
        let import = Case::file("POST", MODELS, WEIGHTS, weights);
        let model = meter.send(&import).await.expect(201).json();
        let drive = json!({"sample_rate_hz": 100.0, "channels": {"u": [1e10, -1e10, 1e10]}});
        let body = json!({"model": model["version"], "drive": drive}).to_string();
        let case = Case { stored: 1 << 20, ..Case::json("POST", PREDICT, body) };
        let found = meter.measure(&case).await;
        assert_eq!((found.status, found.code.as_str()), (422, "result.non_finite"), "{model}");
        assert!(!found.print(&case), "{found:?}");
    }
}
