//! Admission control: each class of traffic has permits and a bounded queue of its own, so that a crowd
//! in one class does not keep another waiting.
//!
//! Predictions get their permits where they compute ([`crate::compute`]). Here a prediction is promised one, or
//! refused, before its body is read: a body is only read and parsed if it will be worked on. Other requests hold a permit from
//! the end of their body to the head of their answer, so that a slow sender holds none while it sends.
//! Uploads, whose bodies go to disk as they arrive, hold one from the beginning.

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
use super::auth::Caller;
use super::problem::Problem;
use crate::compute::Class;
use crate::compute::fair_queue::{Asker, ClientId, FairQueue, Permit, QueueSettings, Refused};

/// Classes of traffic.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Traffic {
    /// Health, metrics, cancelling, revoking: the requests that matter most under overload.
    Control,
    /// Reads and small changes of registered data.
    Registry,
    /// Answers that are computed.
    Predict,
    /// Files.
    Upload,
    /// Requests that create jobs.
    Jobs,
}

/// Permits of each class but [`Traffic::Predict`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AdmissionSettings {
    /// [`Traffic::Control`].
    pub control: QueueSettings,
    /// [`Traffic::Registry`].
    pub registry: QueueSettings,
    /// [`Traffic::Upload`].
    pub upload: QueueSettings,
    /// [`Traffic::Jobs`].
    pub jobs: QueueSettings,
}

impl Default for AdmissionSettings {
    /// Writes queue for the one writer of the database: sixteen of them delay a cancelling request by
    /// some tens of milliseconds. One token leaves a quarter of the uploads to others.
    fn default() -> Self {
        let upload = QueueSettings::new(16, 64, Duration::from_secs(30));
        Self {
            control: QueueSettings::new(64, 256, Duration::from_secs(5)),
            registry: QueueSettings::new(16, 256, Duration::from_secs(5)),
            upload: QueueSettings { per_token: 12, ..upload },
            jobs: QueueSettings::new(4, 64, Duration::from_secs(5)),
        }
    }
}

/// The queues of the classes of traffic.
#[derive(Debug)]
pub struct Admission {
    control: Arc<FairQueue>,
    registry: Arc<FairQueue>,
    upload: Arc<FairQueue>,
    jobs: Arc<FairQueue>,
}

impl Admission {
    /// Queues with these settings.
    pub fn new(settings: AdmissionSettings) -> Self {
        Self {
            control: FairQueue::new("control", settings.control),
            registry: FairQueue::new("registry", settings.registry),
            upload: FairQueue::new("upload", settings.upload),
            jobs: FairQueue::new("jobs", settings.jobs),
        }
    }

    /// All queues, for the health report.
    pub fn all(&self) -> [&Arc<FairQueue>; 4] {
        [&self.control, &self.registry, &self.upload, &self.jobs]
    }

    /// `None` for predictions, which have theirs elsewhere.
    fn of(&self, traffic: Traffic) -> Option<&Arc<FairQueue>> {
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
    /// The client whose request this task answers, with the permit that it was promised.
    static ASKER: Asker;
}

/// The client whose request is being answered, with the permit that it was promised; nobody outside of a request.
pub fn asker() -> Asker {
    ASKER.try_with(Asker::clone).unwrap_or_default()
}

/// The client whose request is being answered; `None` outside of a request.
pub fn client_id() -> ClientId {
    asker().client
}

/// Lets a request in when it gets a permit, or refuses it.
pub async fn admit(
    State((http, traffic)): State<(Shared, Traffic)>,
    request: Request,
    next: Next,
) -> Response {
    let client = request.extensions().get::<Caller>().and_then(Caller::token).map(|token| token.id);
    let Some(queue) = http.admission.of(traffic) else {
        let class = Class::of_bytes(declared(request.headers()).unwrap_or_default() as usize);
        return match http.compute.queue(class).promise(client) {
            Ok(place) => {
                let asker = Asker { client, place: Some(Arc::new(place)) };
                ASKER.scope(asker, next.run(request)).await
            }
            Err(why) => send_away(request, why),
        };
    };
    if comes_first(traffic, &request) {
        if let Err(why) = queue.check(client) {
            return send_away(request, why);
        }
        let (request, _permit) = permit_after_body(request, Arc::clone(queue), client);
        return ASKER.scope(client.into(), next.run(request)).await;
    }
    match queue.acquire(client).await {
        Ok(_permit) => ASKER.scope(client.into(), next.run(request)).await,
        Err(why) => send_away(request, why),
    }
}

/// Whether the body comes before the work of the handler, so that the permit can wait for its end.
fn comes_first(traffic: Traffic, request: &Request) -> bool {
    let has_body = matches!(*request.method(), Method::POST | Method::PUT | Method::PATCH);
    let waits = matches!(traffic, Traffic::Registry | Traffic::Jobs);
    has_body && waits && !request.body().is_end_stream()
}

/// The request with a body that ends once a permit was acquired, and the cell that then holds the permit.
fn permit_after_body(
    request: Request,
    queue: Arc<FairQueue>,
    client: ClientId,
) -> (Request, Arc<OnceLock<Permit>>) {
    let held = Arc::new(OnceLock::new());
    let place = Arc::clone(&held);
    let wait = async move {
        let permit = queue.acquire(client).await.map_err(axum::Error::new)?;
        // The body ends once.
        let _ = place.set(permit);
        Ok::<_, axum::Error>(Bytes::new())
    };
    let request = request.map(|body| Body::from_stream(body.into_data_stream().chain(stream::once(wait))));
    (request, held)
}

/// Refuses a request at once, before the rest of its body has come.
fn send_away(request: Request, why: Refused) -> Response {
    let declared = declared(request.headers());
    let (parts, body) = request.into_parts();
    // A client that asked before sending its body will not send it now.
    if declared.is_some_and(|n| n <= MAX_DRAINED) && !parts.headers.contains_key(EXPECT) {
        tokio::spawn(tokio::time::timeout(MAX_DRAIN, drain(body)));
    }
    Problem::from(why).into_response()
}

/// Largest body of a refused request that is read to its end, to keep the connection for the next
/// request.
const MAX_DRAINED: u64 = 1 << 20;

/// How long that reading may take.
const MAX_DRAIN: Duration = Duration::from_secs(5);

async fn drain(body: Body) {
    let mut body = body.into_data_stream();
    while let Some(Ok(_)) = body.next().await {}
}

fn declared(headers: &HeaderMap) -> Option<u64> {
    headers.get(CONTENT_LENGTH)?.to_str().ok()?.parse().ok()
}
