//! A whole service in this process, without a socket: the router, a store on a directory of its own.

use std::path::Path;

use axum::Router;
use axum::body::Body;
use axum::http::{HeaderValue, Request, Response};
use clap::Parser;
use http_body_util::BodyExt;
use rigcast::app::App;
use rigcast::config::{Cli, Command};
use rigcast::engine::model::ModelKind;
use rigcast::http::codes;
use serde_json::{Value, json};
use tempfile::TempDir;
use tokio::runtime::{Builder, Runtime};
use tower::ServiceExt;

use crate::fixtures;

/// A directory in memory, so that data directories do not wear out a disk.
const MEMORY: &str = "/dev/shm";

/// A service with a rig `bench` (drive `u`, response `y`, 100 Hz) that has an active model.
pub struct Service {
    runtime: Runtime,
    router: Router,
    // They live as long as the service does.
    _app: App,
    _directory: TempDir,
}

/// Status, headers and body of an answer.
pub struct Answer {
    /// Status.
    pub status: u16,
    /// `Location`, if there is one.
    pub location: Option<String>,
    /// The body.
    pub bytes: Vec<u8>,
}

impl Service {
    /// Starts it.
    pub fn start() -> Self {
        let runtime = Builder::new_current_thread().enable_all().build().expect("a runtime");
        let directory = if Path::new(MEMORY).is_dir() { TempDir::new_in(MEMORY) } else { TempDir::new() };
        let directory = directory.expect("a directory");
        let path = directory.path().to_str().expect("UTF-8");
        let Command::Serve(settings) = Cli::parse_from(["rigcast", "serve", "--data-dir", path]).command
        else {
            unreachable!("serve is serve")
        };
        let config = settings.check().expect("the defaults are settings");
        let app = runtime.block_on(App::build(&config)).expect("a service");
        let service = Self { runtime, router: app.router(), _app: app, _directory: directory };
        service.furnish();
        service
    }

    fn furnish(&self) {
        let rig = fixtures::rig("bench");
        let made = |path: &str, media_type: &str, body: Vec<u8>| {
            let request = request("POST", path).header("content-type", media_type);
            let answer = self.exchange(request.body(Body::from(body)).expect("a request"));
            assert_eq!(answer.status, 201, "{}", String::from_utf8_lossy(&answer.bytes));
        };
        made("/v1/rigs", "application/json", rig.to_string().into());
        made("/v1/rigs/bench/models", "application/x-safetensors", fixtures::weights(ModelKind::Frf));
        let active = request("PUT", "/v1/rigs/bench/active-model").header("if-match", "*");
        let active = active.header("content-type", "application/json");
        let body = json!({"version": 1}).to_string();
        assert_eq!(self.ask(active.body(Body::from(body)).expect("a request")).status, 200);
    }

    /// Sends a body.
    pub fn send(&self, method: &str, path: &str, media_type: &str, body: Vec<u8>) -> Answer {
        let request = request(method, path).header("content-type", media_type).header("if-match", "*");
        self.ask(request.body(Body::from(body)).expect("a request"))
    }

    /// Sends a request, checks its answer, and deletes the resource that it made, unless it is a model.
    pub fn ask(&self, request: Request<Body>) -> Answer {
        let answer = self.exchange(request);
        let made = answer.location.as_deref().filter(|at| answer.status == 201 && !at.contains("/models/"));
        if let Some(location) = made {
            let delete = self::request("DELETE", location).body(Body::empty()).expect("a request");
            assert_eq!(self.exchange(delete).status, 204, "{location} can be deleted");
        }
        answer
    }

    fn exchange(&self, request: Request<Body>) -> Answer {
        self.runtime.block_on(async {
            let response = self.router.clone().oneshot(request).await.expect("the router always answers");
            reply(response).await
        })
    }
}

fn request(method: &str, path: &str) -> axum::http::request::Builder {
    Request::builder().method(method).uri(path).header("host", "localhost")
}

/// Reads and checks an answer: no internal error, and a problem document for every refusal.
pub async fn reply(response: Response<Body>) -> Answer {
    let (head, body) = response.into_parts();
    let bytes = body.collect().await.expect("a whole answer").to_bytes().to_vec();
    let status = head.status.as_u16();
    let text = || String::from_utf8_lossy(&bytes[..bytes.len().min(500)]).into_owned();
    assert!(status < 500, "{status}: {}", text());
    assert!(head.headers.contains_key("x-request-id"));
    if status >= 400 {
        let media_type = HeaderValue::from_static("application/problem+json");
        assert_eq!(head.headers.get("content-type"), Some(&media_type), "{status}: {}", text());
        let problem: Value = serde_json::from_slice(&bytes).expect("JSON");
        let code = problem["code"].as_str().and_then(codes::find).expect("a documented code");
        assert_eq!(code.status, status);
    }
    let location = head.headers.get("location").and_then(|at| Some(at.to_str().ok()?.to_owned()));
    Answer { status, location, bytes }
}
