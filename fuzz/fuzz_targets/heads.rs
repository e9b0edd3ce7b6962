//! Paths, queries and the headers that are parsed here: tokens, preconditions, keys, digests, types.
#![no_main]

use std::sync::LazyLock;

use arbitrary::Arbitrary;
use axum::body::Body;
use axum::http::{HeaderName, HeaderValue, Request, Uri};
use libfuzzer_sys::fuzz_target;
use rigcast_fuzz::{Service, plant};

/// Operations whose head has more than a path.
const OPERATIONS: &[(&str, &str)] = &[
    ("GET", "/v1/rigs"),
    ("GET", "/v1/rigs/bench/runs"),
    ("GET", "/v1/jobs"),
    ("POST", "/v1/rigs/bench/runs"),
    ("POST", "/v1/rigs/bench/models"),
    ("POST", "/v1/rigs/bench/predict"),
    ("PUT", "/v1/rigs/bench/active-model"),
    ("GET", "/v1/rigs/bench/models/1/weights"),
    ("GET", "/readyz"),
    ("GET", "/docs"),
    ("GET", ""),
];

const HEADERS: &[&str] = &[
    "authorization",
    "if-match",
    "idempotency-key",
    "content-digest",
    "content-type",
    "content-encoding",
    "content-length",
    "accept",
    "host",
    "origin",
    "x-request-id",
    "last-event-id",
];

#[derive(Debug, Arbitrary)]
struct Head<'a> {
    operation: u8,
    /// After the operation's path: more of the path, or a query.
    rest: &'a str,
    headers: Vec<(u8, &'a [u8])>,
}

thread_local! {
    static SERVICE: LazyLock<Service> = LazyLock::new(Service::start);
}

fuzz_target!(init: plant("heads"), |head: Head<'_>| {
    let (method, path) = OPERATIONS[usize::from(head.operation) % OPERATIONS.len()];
    let Ok(uri) = format!("{path}{}", head.rest).parse::<Uri>() else { return };
    if uri.path().is_empty() {
        return;
    }
    let mut request = Request::builder().method(method).uri(uri);
    for (name, value) in head.headers {
        let name = HeaderName::from_static(HEADERS[usize::from(name) % HEADERS.len()]);
        let Ok(value) = HeaderValue::from_bytes(value) else { continue };
        request = request.header(name, value);
    }
    if let Ok(request) = request.body(Body::from("u,y\n0.5,1\n")) {
        SERVICE.with(|service| service.ask(request));
    }
});
