//! The doors: who asks, whether the operation is theirs, whether the rig is.
//!
//! Every route of the table is wrapped in [`guard`] with its right, so that nothing of a request but
//! its head is looked at before the answer to that is known. A rig beyond a token's scope is refused
//! without a look at the store: whether it is there makes no difference that could be seen.

mod caller;
mod keyring;
mod loopback;

use axum::extract::{FromRequestParts, RawPathParams, Request, State};
use axum::http::header::{AUTHORIZATION, WWW_AUTHENTICATE};
use axum::http::request::Parts;
use axum::http::{HeaderMap, HeaderValue};
use axum::middleware::Next;
use axum::response::Response;
use jiff::Timestamp;

use super::paths::no_rig;
use super::problem::{Answer, Problem};
use super::rights::Right;
use super::{Shared, codes};
use crate::domain::{Clock, SecretDigest};
use crate::storage::Store;

pub use caller::Caller;
use keyring::Keyring;

/// Longest text that is taken for a secret; ours are shorter.
const MAX_SECRET_LEN: usize = 256;

/// What decides who comes in.
#[derive(Debug)]
pub struct Doors {
    keyring: Keyring,
    /// Whether the service listens on loopback only: the one place where it may be open.
    on_loopback: bool,
}

/// What a request shows at the door.
enum Shown {
    Nothing,
    Secret(SecretDigest),
    /// Credentials that can be no token of ours.
    Nonsense,
}

impl Doors {
    /// Doors whose tokens are in `store`, of a service that listens on loopback or beyond.
    pub fn new(store: Store, on_loopback: bool) -> Self {
        Self { keyring: Keyring::new(store), on_loopback }
    }

    /// Forgets what was read of the tokens: they have changed.
    pub fn changed(&self) {
        self.keyring.forget();
    }

    /// Who asks.
    ///
    /// # Errors
    /// `token.missing`, `token.invalid`; while there is no token `host.foreign` and `origin.foreign`.
    async fn identify(&self, parts: &Parts, now: Timestamp) -> Answer<Caller> {
        let keys = self.keyring.current().await?;
        match shown(&parts.headers) {
            Shown::Secret(digest) => keys.find(&digest, now).map(Caller::Token).ok_or_else(invalid),
            Shown::Nonsense => Err(invalid()),
            Shown::Nothing if keys.any || !self.on_loopback => Err(missing()),
            Shown::Nothing => {
                loopback::check(parts)?;
                Ok(Caller::Everybody)
            }
        }
    }

    /// Waits until what let a caller in does so no more, and no second longer.
    pub async fn shut(&self, caller: &Caller, clock: Clock) {
        loop {
            tokio::time::sleep(keyring::MAX_AGE / 2).await;
            // A store that cannot be asked vouches for nobody.
            let Ok(keys) = self.keyring.current().await else { return };
            let open = caller.token().map_or(!keys.any, |token| keys.holds(token, clock()));
            if !open {
                return;
            }
        }
    }
}

/// Lets a request pass that has the right to an operation, and tells the handler who asks.
pub async fn guard(
    State((http, right)): State<(Shared, Right)>,
    request: Request,
    next: Next,
) -> Answer<Response> {
    if right == Right::Public {
        return Ok(next.run(request).await);
    }
    let (mut parts, body) = request.into_parts();
    let caller = http.doors.identify(&parts, http.now()).await?;
    if let Some(token) = caller.token() {
        tracing::Span::current().record("token.id", tracing::field::display(token.id));
    }
    right.check(&caller)?;
    in_reach(&mut parts, &caller).await?;
    // Nothing behind the door needs it, so nothing can let it out.
    parts.headers.remove(AUTHORIZATION);
    parts.extensions.insert(caller);
    Ok(next.run(Request::from_parts(parts, body)).await)
}

/// Refuses a path into a rig beyond the token's scope as if there were no such rig.
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
fn shown(headers: &HeaderMap) -> Shown {
    let mut values = headers.get_all(AUTHORIZATION).iter();
    let Some(value) = values.next() else { return Shown::Nothing };
    let secret = value.to_str().ok().and_then(|text| {
        let (scheme, secret) = text.split_once(' ')?;
        scheme.eq_ignore_ascii_case("bearer").then(|| secret.trim_matches(' '))
    });
    match secret {
        Some(secret) if values.next().is_none() && (1..=MAX_SECRET_LEN).contains(&secret.len()) => {
            Shown::Secret(SecretDigest::of(secret.as_bytes()))
        }
        _ => Shown::Nonsense,
    }
}

fn missing() -> Problem {
    let detail = "This operation needs a token: Authorization: Bearer <token>.";
    Problem::new(codes::TOKEN_MISSING, detail)
        .with_header(WWW_AUTHENTICATE, HeaderValue::from_static("Bearer realm=\"rigcast\""))
}

/// The same for what never was a token, was revoked or has expired.
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
            let Shown::Secret(found) = shown(&headers(&[text])) else { panic!("{text}") };
            assert!(found.matches(&SecretDigest::of(b"abc")), "{text}");
        }
        let long = format!("Bearer {}", "x".repeat(MAX_SECRET_LEN + 1));
        for text in ["", "Bearer", "Bearer ", "Bearerabc", "Basic YTpi", "abc", "Bearer \u{f6}", &long] {
            assert!(matches!(shown(&headers(&[text])), Shown::Nonsense), "{text:?}");
        }
        assert!(matches!(shown(&headers(&["Bearer a", "Bearer b"])), Shown::Nonsense), "one of two");
        assert!(matches!(shown(&HeaderMap::new()), Shown::Nothing));
    }
}
