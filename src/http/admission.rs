//! Who may come in now: each class of traffic has turns and a bounded queue of its own, so that no
//! crowd in one keeps another waiting.
//!
//! Predictions have their turns where they compute ([`crate::compute`]); here they are only spared the
//! reading of a body for which no turn would be left. Other requests have a turn from the end of their
//! body to the head of their answer, so that who sends slowly takes nobody's place; uploads, whose
//! bodies go to disk as they come, have it from the beginning.

use std::sync::{Arc, OnceLock};
use std::time::Duration;

use axum::body::{Body, HttpBody};
use axum::extract::{Request, State};
use axum::http::header::{CONTENT_LENGTH, EXPECT};
use axum::http::{HeaderMap, Method};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use futures::{StreamExt, stream};

use super::Shared;
use super::doors::Caller;
use super::problem::Problem;
use crate::compute::Class;
use crate::compute::turns::{Refused, Turn, TurnSettings, Turns, Who};

/// Classes of traffic.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Traffic {
    /// Health, metrics, cancelling, revoking: what is needed most when there is too much of the rest.
    Control,
    /// What is registered: reads and small changes.
    Registry,
    /// Answers that are computed.
    Predict,
    /// Files.
    Upload,
    /// What makes jobs.
    Jobs,
}

/// Turns of each class but [`Traffic::Predict`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AdmissionSettings {
    /// [`Traffic::Control`].
    pub control: TurnSettings,
    /// [`Traffic::Registry`].
    pub registry: TurnSettings,
    /// [`Traffic::Upload`].
    pub upload: TurnSettings,
    /// [`Traffic::Jobs`].
    pub jobs: TurnSettings,
}

impl Default for AdmissionSettings {
    /// Writers to the database queue for its one writer: sixteen before a cancelling request are some
    /// tens of milliseconds. One token leaves a quarter of the uploads to others.
    fn default() -> Self {
        let upload = TurnSettings::new(16, 64, Duration::from_secs(30));
        Self {
            control: TurnSettings::new(64, 256, Duration::from_secs(5)),
            registry: TurnSettings::new(16, 256, Duration::from_secs(5)),
            upload: TurnSettings { per_token: 12, ..upload },
            jobs: TurnSettings::new(4, 64, Duration::from_secs(5)),
        }
    }
}

/// The turns themselves.
#[derive(Debug)]
pub struct Admission {
    control: Arc<Turns>,
    registry: Arc<Turns>,
    upload: Arc<Turns>,
    jobs: Arc<Turns>,
}

impl Admission {
    /// Turns as the settings say.
    pub fn new(settings: AdmissionSettings) -> Self {
        Self {
            control: Turns::new("control", settings.control),
            registry: Turns::new("registry", settings.registry),
            upload: Turns::new("upload", settings.upload),
            jobs: Turns::new("jobs", settings.jobs),
        }
    }

    /// All turns, for those who look on.
    pub fn all(&self) -> [&Turns; 4] {
        [&self.control, &self.registry, &self.upload, &self.jobs]
    }

    /// None: predictions have theirs elsewhere.
    fn of(&self, traffic: Traffic) -> Option<&Arc<Turns>> {
        match traffic {
            Traffic::Control => Some(&self.control),
            Traffic::Registry => Some(&self.registry),
            Traffic::Predict => None,
            Traffic::Upload => Some(&self.upload),
            Traffic::Jobs => Some(&self.jobs),
        }
    }
}

tokio::task_local! {
    /// Whose request the task answers.
    static WHO: Who;
}

/// Whose request is being answered; nobody's outside of one.
pub fn who() -> Who {
    WHO.try_with(|who| *who).unwrap_or_default()
}

/// Lets a request in when its turn comes, or sends it away.
pub async fn admit(
    State((http, traffic)): State<(Shared, Traffic)>,
    request: Request,
    next: Next,
) -> Response {
    let who = request.extensions().get::<Caller>().and_then(Caller::token).map(|token| token.id);
    let Some(turns) = http.admission.of(traffic) else {
        let class = Class::of_bytes(declared(request.headers()).unwrap_or_default() as usize);
        return match http.compute.turns(class).check(who) {
            Ok(()) => WHO.scope(who, next.run(request)).await,
            Err(why) => send_away(request, why),
        };
    };
    if comes_first(traffic, &request) {
        if let Err(why) = turns.check(who) {
            return send_away(request, why);
        }
        let (request, _turn) = turn_after_body(request, Arc::clone(turns), who);
        return WHO.scope(who, next.run(request)).await;
    }
    match turns.take(who).await {
        Ok(_turn) => WHO.scope(who, next.run(request)).await,
        Err(why) => send_away(request, why),
    }
}

/// Whether the handler reads a body before it does anything that others could wait for.
fn comes_first(traffic: Traffic, request: &Request) -> bool {
    let has_body = matches!(*request.method(), Method::POST | Method::PUT | Method::PATCH);
    let waits = matches!(traffic, Traffic::Registry | Traffic::Jobs);
    has_body && waits && !request.body().is_end_stream()
}

/// The request with a body at whose end the turn is waited for, and the place where it then is.
fn turn_after_body(request: Request, turns: Arc<Turns>, who: Who) -> (Request, Arc<OnceLock<Turn>>) {
    let held = Arc::new(OnceLock::new());
    let place = Arc::clone(&held);
    let wait = async move {
        let turn = turns.take(who).await.map_err(axum::Error::new)?;
        // The body ends once.
        let _ = place.set(turn);
        Ok::<_, axum::Error>(Bytes::new())
    };
    let request = request.map(|body| Body::from_stream(body.into_data_stream().chain(stream::once(wait))));
    (request, held)
}

/// The answer to who gets no turn, at once, whatever is still to come of the body.
fn send_away(request: Request, why: Refused) -> Response {
    let declared = declared(request.headers());
    let (parts, body) = request.into_parts();
    // Who asks before it sends a body will not send it.
    if declared.is_some_and(|n| n <= MAX_DRAINED) && !parts.headers.contains_key(EXPECT) {
        tokio::spawn(tokio::time::timeout(MAX_DRAIN, drain(body)));
    }
    Problem::from(why).into_response()
}

/// Largest body that is read to its end for nothing: that keeps the connection for the next request.
const MAX_DRAINED: u64 = 1 << 20;

/// How long that may take.
const MAX_DRAIN: Duration = Duration::from_secs(5);

async fn drain(body: Body) {
    let mut body = body.into_data_stream();
    while let Some(Ok(_)) = body.next().await {}
}

fn declared(headers: &HeaderMap) -> Option<u64> {
    headers.get(CONTENT_LENGTH)?.to_str().ok()?.parse().ok()
}
