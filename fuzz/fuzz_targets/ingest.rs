//! A valid file with faults, through the whole upload of a run or of weights.
#![no_main]

use std::sync::LazyLock;

use arbitrary::Arbitrary;
use libfuzzer_sys::fuzz_target;
use rigcast::engine::model::ModelKind;
use rigcast_fuzz::{Service, fixtures, plant};

/// The operation that receives the file.
#[derive(Debug, Clone, Copy, Arbitrary)]
enum Door {
    Csv,
    Npy,
    Json,
    Weights,
    Drive,
}

/// A fault in the file.
#[derive(Debug, Arbitrary)]
enum Fault<'a> {
    /// A byte becomes another one.
    Flip { at: u16, with: u8 },
    /// The file ends early.
    Cut { at: u16 },
    /// Bytes are inserted.
    Insert { at: u16, bytes: &'a [u8] },
    /// Bytes are replaced: a wrong size, a NaN.
    Overwrite { at: u16, bytes: &'a [u8] },
    /// A part is repeated.
    Repeat { from: u16, len: u8 },
    /// A part is removed.
    Remove { from: u16, len: u8 },
}

#[derive(Debug, Arbitrary)]
struct Case<'a> {
    door: Door,
    /// Samples of the file before its faults.
    samples: u8,
    query: Option<&'a str>,
    faults: Vec<Fault<'a>>,
}

fn at(place: u16, file: &[u8]) -> usize {
    if file.is_empty() { 0 } else { usize::from(place) % file.len() }
}

fn apply(fault: &Fault<'_>, file: &mut Vec<u8>) {
    match fault {
        Fault::Flip { at: place, with } => {
            let place = at(*place, file);
            if let Some(byte) = file.get_mut(place) {
                *byte ^= with;
            }
        }
        Fault::Cut { at: place } => file.truncate(at(*place, file)),
        Fault::Insert { at: place, bytes } => {
            let place = at(*place, file);
            file.splice(place..place, bytes.iter().copied());
        }
        Fault::Overwrite { at: place, bytes } => {
            let place = at(*place, file);
            let end = file.len().min(place + bytes.len());
            file[place..end].copy_from_slice(&bytes[..end - place]);
        }
        Fault::Repeat { from, len } => {
            let from = at(*from, file);
            let end = file.len().min(from + usize::from(*len));
            let part = file[from..end].to_vec();
            file.splice(from..from, part);
        }
        Fault::Remove { from, len } => {
            let from = at(*from, file);
            let end = file.len().min(from + usize::from(*len));
            file.drain(from..end);
        }
    }
}

/// Characters that a query may hold.
fn encoded(text: &str) -> String {
    text.bytes()
        .map(|b| {
            if b.is_ascii_alphanumeric() || b"=&._-,%+".contains(&b) {
                char::from(b).into()
            } else {
                format!("%{b:02X}")
            }
        })
        .collect()
}

thread_local! {
    static SERVICE: LazyLock<Service> = LazyLock::new(Service::start);
}

fuzz_target!(init: plant("ingest"), |case: Case<'_>| {
    let samples = usize::from(case.samples) + 1;
    let kinds = [ModelKind::Frf, ModelKind::Lstm, ModelKind::Hybrid1, ModelKind::Hybrid2];
    let kind = kinds[usize::from(case.samples) % kinds.len()];
    let (path, media_type, mut file) = match case.door {
        Door::Csv => ("/v1/rigs/bench/runs?kind=noise", "text/csv", fixtures::csv(samples)),
        Door::Npy => ("/v1/rigs/bench/runs?kind=noise", "application/x-npy", fixtures::npy(samples, 2)),
        Door::Json => ("/v1/rigs/bench/runs?kind=noise", "application/json", fixtures::json(samples)),
        Door::Weights => ("/v1/rigs/bench/models?", "application/x-safetensors", fixtures::weights(kind)),
        Door::Drive => (
            "/v1/rigs/bench/predict?sample_rate_hz=100",
            "application/x-npy",
            fixtures::npy(samples, 1),
        ),
    };
    for fault in &case.faults {
        apply(fault, &mut file);
    }
    let query = case.query.map(|query| format!("&{}", encoded(query))).unwrap_or_default();
    SERVICE.with(|service| service.send("POST", &format!("{path}{query}"), media_type, file));
});
