//! JSON bodies, at every operation that takes one and starts no job: the first byte selects it.
#![no_main]

use std::sync::LazyLock;

use libfuzzer_sys::fuzz_target;
use rigcast_fuzz::{Service, plant};

const OPERATIONS: &[(&str, &str)] = &[
    ("POST", "/v1/rigs/bench/predict"),
    ("POST", "/v1/damage"),
    ("POST", "/v1/rigs"),
    ("PATCH", "/v1/rigs/bench"),
    ("PUT", "/v1/rigs/bench/active-model"),
    ("POST", "/v1/rigs/bench/runs"),
    ("POST", "/v1/rigs/bench/diagnoses/0197f1a0-0000-7000-8000-000000000000/adopt"),
    ("POST", "/v2/models/bench/infer"),
];

thread_local! {
    static SERVICE: LazyLock<Service> = LazyLock::new(Service::start);
}

fuzz_target!(init: plant("bodies"), |input: (u8, &[u8])| {
    let (which, body) = input;
    let (method, path) = OPERATIONS[usize::from(which) % OPERATIONS.len()];
    SERVICE.with(|service| service.send(method, path, "application/json", body.to_vec()));
});
