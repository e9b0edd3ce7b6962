//! `Idempotency-Key`: a creating request under a key is done once and answered alike each time.

use std::convert::Infallible;
use std::sync::{Arc, Mutex, PoisonError};

use axum::body::Body;
use axum::extract::{FromRequestParts, MatchedPath, Request, State};
use axum::http::header::{CONTENT_TYPE, ETAG, LOCATION};
use axum::http::request::Parts;
use axum::http::{HeaderMap, Method, StatusCode};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use futures::StreamExt;
use sha2::{Digest as _, Sha256};

use super::auth::Caller;
use super::body::{Limited, media_type};
use super::problem::{Answer, FieldError, Problem};
use super::{Http, Shared, codes, json};
use crate::domain::Created;
use crate::storage::{Digest, IdempotencyKey, StoredAnswer};

/// Operations that create something.
const CREATING: &[&str] = &[
    "/v1/rigs",
    "/v1/rigs/{rig}/runs",
    "/v1/rigs/{rig}/fits",
    "/v1/rigs/{rig}/diagnoses",
    "/v1/rigs/{rig}/iterations",
    "/v1/rigs/{rig}/evaluations",
    "/v1/rigs/{rig}/studies",
    "/v1/rigs/{rig}/diagnoses/{diagnosis}/adopt",
    "/v1/rigs/{rig}/models",
    "/v1/tokens",
];

/// Longest key.
const MAX_KEY_LEN: usize = 255;

/// Repeats the answer to a request that was done before under its key. Lets other requests pass, and
/// computes the digest of their body on the way.
pub async fn answer_once(
    State(http): State<Shared>,
    matched: Option<MatchedPath>,
    request: Request,
    next: Next,
) -> Response {
    let creates = request.method() == Method::POST
        && matched.is_some_and(|path| CREATING.contains(&path.as_str()))
        && request.headers().contains_key("idempotency-key");
    if !creates {
        return next.run(request).await;
    }
    match under_key(&http, request, next).await {
        Ok(response) => response,
        Err(problem) => problem.into_response(),
    }
}

async fn under_key(http: &Http, request: Request, next: Next) -> Answer {
    let (mut parts, body) = request.into_parts();
    let keyed = KeyedRequest {
        owner: owner(&parts),
        key: key(&parts.headers)?,
        target: format!("{} {}", parts.uri, media_type(&parts.headers).unwrap_or_default()),
        body: Arc::default(),
    };
    if let Some(before) = http.store.answer_under_key(&keyed.owner, &keyed.key).await? {
        let mut body = Limited::new(&parts.headers, body, http.limits.upload_bytes, http.limits.pace)?;
        while let Some(chunk) = body.next().await? {
            keyed.hash(&chunk);
        }
        return keyed.again(http, before).await;
    }
    let hashing = keyed.clone();
    let body = body.into_data_stream().inspect(move |chunk| {
        if let Ok(chunk) = chunk {
            hashing.hash(chunk);
        }
    });
    parts.extensions.insert(keyed.clone());
    let response = next.run(Request::from_parts(parts, Body::from_stream(body))).await;
    let repeated = response
        .extensions()
        .get::<Problem>()
        .is_some_and(|problem| problem.code() == codes::IDEMPOTENCY_KEY_IN_USE.name);
    if repeated && let Some(before) = http.store.answer_under_key(&keyed.owner, &keyed.key).await? {
        return keyed.again(http, before).await;
    }
    Ok(response)
}

/// The owner of a key: each token has keys of its own.
fn owner(parts: &Parts) -> String {
    let caller = parts.extensions.get::<Caller>();
    caller.and_then(Caller::token).map(|token| token.id.to_string()).unwrap_or_default()
}

fn key(headers: &HeaderMap) -> Answer<String> {
    let mut values = headers.get_all("idempotency-key").iter();
    let key = values.next().and_then(|value| value.to_str().ok()).unwrap_or_default();
    let fits =
        (1..=MAX_KEY_LEN).contains(&key.len()) && key.bytes().all(|b| b.is_ascii_graphic() || b == b' ');
    if fits && values.next().is_none() {
        return Ok(key.to_owned());
    }
    let limit = format!("one key of 1 to {MAX_KEY_LEN} visible ASCII characters");
    Err(Problem::new(codes::IDEMPOTENCY_KEY_MALFORMED, format!("Idempotency-Key must be {limit}."))
        .with(FieldError::new("", limit)))
}

/// A request under a key while its body comes in.
#[derive(Debug, Clone)]
struct KeyedRequest {
    owner: String,
    key: String,
    /// Path, query and media type.
    target: String,
    body: Arc<Mutex<Sha256>>,
}

impl KeyedRequest {
    fn hash(&self, chunk: &Bytes) {
        self.body.lock().unwrap_or_else(PoisonError::into_inner).update(chunk);
    }

    /// Digest of the request, its body read to the end.
    fn fingerprint(&self) -> Digest {
        let body = self.body.lock().unwrap_or_else(PoisonError::into_inner).clone().finalize();
        Digest::of(&[self.target.as_bytes(), b"\n", &body[..]].concat())
    }

    /// The answer to a request whose key was used before.
    async fn again(&self, http: &Http, before: StoredAnswer) -> Answer {
        if before.fingerprint != self.fingerprint().as_str() {
            let detail = "Another request came under this Idempotency-Key; a new request needs a new key.";
            return Err(Problem::new(codes::IDEMPOTENCY_KEY_REUSED, detail));
        }
        if !http.store.is_still_there(&before.answer.location).await? {
            let detail = format!(
                "The request was done before under this Idempotency-Key, and {} was deleted since.",
                before.answer.location
            );
            return Err(Problem::new(codes::IDEMPOTENCY_KEY_GONE, detail));
        }
        if let Some(token) = before.answer.token_id() {
            let detail = format!(
                "Token {token} was made under this Idempotency-Key. Its secret was in the first answer only: if that was \
                 lost, revoke the token and make another one under a new key."
            );
            return Err(Problem::new(codes::IDEMPOTENCY_KEY_SECRET, detail));
        }
        created(before.answer)
    }
}

/// The key of a creating request, if it came with one.
#[derive(Debug, Clone)]
pub struct RequestKey(Option<KeyedRequest>);

impl RequestKey {
    /// The key as the store takes it, once the body was read to its end.
    pub fn stored(&self) -> Option<IdempotencyKey> {
        let keyed = self.0.as_ref()?;
        let (owner, key) = (keyed.owner.clone(), keyed.key.clone());
        Some(IdempotencyKey { owner, key, fingerprint: keyed.fingerprint() })
    }
}

impl FromRequestParts<Shared> for RequestKey {
    type Rejection = Infallible;

    async fn from_request_parts(parts: &mut Parts, _: &Shared) -> Result<Self, Infallible> {
        Ok(Self(parts.extensions.get::<KeyedRequest>().cloned()))
    }
}

/// The answer to a creating request.
pub fn created(made: Created) -> Answer {
    let status = StatusCode::from_u16(made.status).map_err(Problem::internal)?;
    let mut response =
        (status, [(CONTENT_TYPE, json::MEDIA_TYPE.to_owned()), (LOCATION, made.location)], made.body)
            .into_response();
    if let Some(etag) = made.etag {
        response.headers_mut().insert(ETAG, etag.parse().map_err(Problem::internal)?);
    }
    Ok(response)
}
