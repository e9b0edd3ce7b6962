//! Authentication and authorisation: the caller, its right to the operation, and its right to the rig.
//!
//! Every route of the table is wrapped in [`guard`] with its right, so that only the head of a request
//! is read before its rights are checked. A rig beyond a token's scope is refused without a query to the
//! store, so that the answer does not reveal whether the rig exists.

mod caller;
mod loopback;
mod right;
mod sessions;
mod token_cache;

use axum::extract::{FromRequestParts, RawPathParams, Request, State};
use axum::http::header::{AUTHORIZATION, COOKIE, WWW_AUTHENTICATE};
use axum::http::request::Parts;
use axum::http::{HeaderMap, HeaderValue};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use jiff::Timestamp;

use super::paths::no_rig;
use super::problem::{Answer, Problem};
use super::{Shared, codes};
use crate::domain::{Clock, Secret, SecretDigest, Token};
use crate::storage::Store;

pub use caller::Caller;
pub use right::Right;
pub use sessions::{COOKIE_NAME, cookie};
use sessions::{Session, Sessions, X_CSRF_TOKEN};
use token_cache::TokenCache;

/// Longest text that may be a secret; real ones are shorter.
const MAX_SECRET_LEN: usize = 256;

/// Authenticates requests.
#[derive(Debug)]
pub struct Auth {
    token_cache: TokenCache,
    sessions: Sessions,
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
        Self { token_cache: TokenCache::new(store), sessions: Sessions::default(), on_loopback }
    }

    /// Begins a session of the token with this secret; returns the secret id of the session.
    ///
    /// # Errors
    /// `token.invalid` for a secret that is no token's in force.
    pub async fn sign_in(&self, secret: &str, now: Timestamp) -> Answer<Secret> {
        let snapshot = self.token_cache.current().await?;
        let known = (1..=MAX_SECRET_LEN).contains(&secret.len());
        let digest = SecretDigest::of(secret.as_bytes());
        let token = snapshot.find(&digest, now).filter(|_| known).ok_or_else(invalid)?;
        self.sessions.begin(token.id, now).map_err(Problem::internal)
    }

    /// Ends the session of a request, if it has one and repeats its CSRF token.
    ///
    /// # Errors
    /// `csrf.invalid`
    pub fn sign_out(&self, headers: &HeaderMap, csrf: &str, now: Timestamp) -> Answer<()> {
        if let Some(session) = self.sessions.find(headers, now) {
            if !session.matches(csrf) {
                return Err(foreign_form());
            }
            self.sessions.end(headers);
        }
        Ok(())
    }

    /// Drops the cached tokens, because tokens have changed.
    pub fn changed(&self) {
        self.token_cache.forget();
    }

    /// Identifies the caller.
    ///
    /// # Errors
    /// `token.missing`, `token.invalid`; while there is no token `host.foreign` and `origin.foreign`.
    pub(super) async fn identify(&self, parts: &Parts, now: Timestamp) -> Answer<Identity> {
        let snapshot = self.token_cache.current().await?;
        let sent = credentials(&parts.headers);
        if matches!(sent, Credentials::Absent)
            && let Some(session) = self.sessions.find(&parts.headers, now)
            && let Some(token) = snapshot.by_id(session.token, now)
        {
            check_form(parts, &session)?;
            note(&token);
            return Ok(Identity { caller: Caller::Token(token), csrf: session.csrf });
        }
        let caller = match sent {
            Credentials::Secret(digest) => {
                // The log names a refused token too, to show whose program still sends it.
                if let Some(token) = snapshot.identify(&digest) {
                    note(token);
                }
                Caller::Token(snapshot.find(&digest, now).ok_or_else(invalid)?)
            }
            Credentials::Malformed => return Err(invalid()),
            Credentials::Absent if snapshot.any || !self.on_loopback => return Err(missing()),
            Credentials::Absent => {
                loopback::check(parts)?;
                Caller::Everybody
            }
        };
        Ok(Identity { caller, csrf: String::new() })
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

/// The caller of a request, and the CSRF token of its session; empty without a session.
#[derive(Debug, Clone)]
pub struct Identity {
    /// The caller.
    pub caller: Caller,
    /// Text that forms repeat.
    pub csrf: String,
}

/// Adds the token of a request to its log line.
fn note(token: &Token) {
    let span = tracing::Span::current();
    span.record("token.id", tracing::field::display(token.id));
    span.record("token.name", &*token.name);
}

/// Refuses a change under a session's cookie without its CSRF token: another site may have caused it.
fn check_form(parts: &Parts, session: &Session) -> Answer<()> {
    let sent = parts.headers.get(&X_CSRF_TOKEN).and_then(|value| value.to_str().ok());
    if parts.method.is_safe() || sent.is_some_and(|sent| session.matches(sent)) {
        return Ok(());
    }
    Err(foreign_form())
}

fn foreign_form() -> Problem {
    let detail = "The form does not belong to this session: load the page again, and send it once more.";
    Problem::new(codes::CSRF_INVALID, detail)
}

/// Passes on a request whose caller has the right to the operation, and tells the handler the caller. An answer that is a
/// problem carries the caller too: its page shows who is signed in.
pub async fn guard(
    State((http, right)): State<(Shared, Right)>,
    request: Request,
    next: Next,
) -> Answer<Response> {
    if right == Right::Public {
        return Ok(next.run(request).await);
    }
    let (mut parts, body) = request.into_parts();
    let identity = http.auth.identify(&parts, http.now()).await?;
    let mut response = match allow(right, &mut parts, &identity.caller).await {
        Ok(()) => {
            // No handler needs the secrets, so none can leak them.
            parts.headers.remove(AUTHORIZATION);
            parts.headers.remove(COOKIE);
            parts.extensions.insert(identity.caller.clone());
            parts.extensions.insert(identity.clone());
            next.run(Request::from_parts(parts, body)).await
        }
        Err(problem) => problem.into_response(),
    };
    if response.extensions().get::<Problem>().is_some() {
        response.extensions_mut().insert(identity);
    }
    Ok(response)
}

/// Refuses a caller without the right, or a path beyond its token's scope.
async fn allow(right: Right, parts: &mut Parts, caller: &Caller) -> Answer<()> {
    right.check(caller)?;
    in_reach(parts, caller).await
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
