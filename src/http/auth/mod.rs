//! Authentication and authorisation: the caller, its right to the operation, and its right to the rig.
//!
//! Every route of the table is wrapped in [`guard`] with its right, so that only the head of a request
//! is read before its rights are checked. A rig beyond a token's scope is refused without a query to the
//! store, so that the answer does not reveal whether the rig exists.

mod caller;
mod loopback;
mod right;
mod token_cache;

use axum::extract::{FromRequestParts, RawPathParams, Request, State};
use axum::http::header::{AUTHORIZATION, WWW_AUTHENTICATE};
use axum::http::request::Parts;
use axum::http::{HeaderMap, HeaderValue};
use axum::middleware::Next;
use axum::response::Response;
use jiff::Timestamp;

use super::paths::no_rig;
use super::problem::{Answer, Problem};
use super::{Shared, codes};
use crate::domain::{Clock, SecretDigest};
use crate::storage::Store;

pub use caller::Caller;
pub use right::Right;
use token_cache::TokenCache;

/// Longest text that may be a secret; real ones are shorter.
const MAX_SECRET_LEN: usize = 256;

/// Authenticates requests.
#[derive(Debug)]
pub struct Auth {
    token_cache: TokenCache,
    /// Whether the service listens on loopback only. Elsewhere it always requires a token.
    on_loopback: bool,
}

/// The credentials of a request.
enum Credentials {
    Absent,
    Secret(SecretDigest),
    /// Credentials that cannot be a token of this service.
    Malformed,
}

impl Auth {
    /// Authentication by the tokens in `store`, for a service that listens on loopback or beyond.
    pub fn new(store: Store, on_loopback: bool) -> Self {
        Self { token_cache: TokenCache::new(store), on_loopback }
    }

    /// Drops the cached tokens, because tokens have changed.
    pub fn changed(&self) {
        self.token_cache.forget();
    }

    /// Identifies the caller.
    ///
    /// # Errors
    /// `token.missing`, `token.invalid`; while there is no token `host.foreign` and `origin.foreign`.
    async fn identify(&self, parts: &Parts, now: Timestamp) -> Answer<Caller> {
        let snapshot = self.token_cache.current().await?;
        match credentials(&parts.headers) {
            Credentials::Secret(digest) => {
                // The log names a refused token too, to show whose program still sends it.
                if let Some(token) = snapshot.identify(&digest) {
                    let span = tracing::Span::current();
                    span.record("token.id", tracing::field::display(token.id));
                    span.record("token.name", &*token.name);
                }
                snapshot.find(&digest, now).map(Caller::Token).ok_or_else(invalid)
            }
            Credentials::Malformed => Err(invalid()),
            Credentials::Absent if snapshot.any || !self.on_loopback => Err(missing()),
            Credentials::Absent => {
                loopback::check(parts)?;
                Ok(Caller::Everybody)
            }
        }
    }

    /// Returns within a second after the caller's token was revoked or expired or, for a caller without
    /// one, after the first token was made.
    pub async fn until_revoked(&self, caller: &Caller, clock: Clock) {
        loop {
            tokio::time::sleep(token_cache::MAX_AGE / 2).await;
            // Without the store no token counts as valid.
            let Ok(snapshot) = self.token_cache.current().await else { return };
            let open = caller.token().map_or(!snapshot.any, |token| snapshot.holds(token, clock()));
            if !open {
                return;
            }
        }
    }
}

/// Passes on a request whose caller has the right to the operation, and tells the handler the caller.
pub async fn guard(
    State((http, right)): State<(Shared, Right)>,
    request: Request,
    next: Next,
) -> Answer<Response> {
    if right == Right::Public {
        return Ok(next.run(request).await);
    }
    let (mut parts, body) = request.into_parts();
    let caller = http.auth.identify(&parts, http.now()).await?;
    right.check(&caller)?;
    in_reach(&mut parts, &caller).await?;
    // No handler needs the secret, so none can leak it.
    parts.headers.remove(AUTHORIZATION);
    parts.extensions.insert(caller);
    Ok(next.run(Request::from_parts(parts, body)).await)
}

/// Refuses a path into a rig beyond the token's scope as if the rig did not exist.
async fn in_reach(parts: &mut Parts, caller: &Caller) -> Answer<()> {
    if caller.scope().is_none() {
        return Ok(());
    }
    // A path that is not UTF-8 names no rig; its handler says so.
    let Ok(params) = RawPathParams::from_request_parts(parts, &()).await else { return Ok(()) };
    match params.iter().find(|(name, _)| *name == "rig") {
        Some((_, rig)) if !rig.parse().is_ok_and(|id| caller.reaches(&id)) => Err(no_rig(rig)),
        _ => Ok(()),
    }
}

/// Reads `Authorization: Bearer <secret>` (RFC 6750, section 2.1).
fn credentials(headers: &HeaderMap) -> Credentials {
    let mut values = headers.get_all(AUTHORIZATION).iter();
    let Some(value) = values.next() else { return Credentials::Absent };
    let secret = value.to_str().ok().and_then(|text| {
        let (scheme, secret) = text.split_once(' ')?;
        scheme.eq_ignore_ascii_case("bearer").then(|| secret.trim_matches(' '))
    });
    match secret {
        Some(secret) if values.next().is_none() && (1..=MAX_SECRET_LEN).contains(&secret.len()) => {
            Credentials::Secret(SecretDigest::of(secret.as_bytes()))
        }
        _ => Credentials::Malformed,
    }
}

fn missing() -> Problem {
    let detail = "This operation needs a token: Authorization: Bearer <token>.";
    Problem::new(codes::TOKEN_MISSING, detail)
        .with_header(WWW_AUTHENTICATE, HeaderValue::from_static("Bearer realm=\"rigcast\""))
}

/// The refusal of a token that never existed, was revoked or has expired.
fn invalid() -> Problem {
    let detail = "Authorization holds no token that is in force: it is unknown, was revoked or has expired.";
    let challenge = HeaderValue::from_static("Bearer realm=\"rigcast\", error=\"invalid_token\"");
    Problem::new(codes::TOKEN_INVALID, detail).with_header(WWW_AUTHENTICATE, challenge)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn headers(values: &[&str]) -> HeaderMap {
        let mut headers = HeaderMap::new();
        for value in values {
            headers.append(AUTHORIZATION, HeaderValue::from_bytes(value.as_bytes()).unwrap());
        }
        headers
    }

    #[test]
    fn a_bearer_is_read_in_any_case_and_anything_else_is_nonsense() {
        for text in ["Bearer abc", "bearer abc", "BEARER  abc "] {
            let Credentials::Secret(found) = credentials(&headers(&[text])) else { panic!("{text}") };
            assert!(found.matches(&SecretDigest::of(b"abc")), "{text}");
        }
        let long = format!("Bearer {}", "x".repeat(MAX_SECRET_LEN + 1));
        for text in ["", "Bearer", "Bearer ", "Bearerabc", "Basic YTpi", "abc", "Bearer \u{f6}", &long] {
            assert!(matches!(credentials(&headers(&[text])), Credentials::Malformed), "{text:?}");
        }
        assert!(
            matches!(credentials(&headers(&["Bearer a", "Bearer b"])), Credentials::Malformed),
            "one of two"
        );
        assert!(matches!(credentials(&HeaderMap::new()), Credentials::Absent));
    }
}
