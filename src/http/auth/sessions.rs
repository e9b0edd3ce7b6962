//! Sessions of browsers: a cookie in place of the header `Authorization`.
//!
//! Signing in with a token begins a session, which lives in memory: it ends with the token, when it is signed out,
//! after [`IDLE`] without a request, and with the service. The cookie holds a random id, never the token's secret. A
//! request that changes something must also send the session's CSRF token, which only pages of the service can read.

use std::collections::HashMap;
use std::sync::{Mutex, MutexGuard, PoisonError};

use axum::http::header::COOKIE;
use axum::http::{HeaderMap, HeaderName};
use jiff::{SignedDuration, Timestamp};

use crate::domain::{Secret, SecretDigest, TokenId};

/// Name of the cookie.
pub const COOKIE_NAME: &str = "rigcast_session";

/// Header with the CSRF token of a request that changes something.
pub static X_CSRF_TOKEN: HeaderName = HeaderName::from_static("x-csrf-token");

/// Time without a request after which a session ends: a working day.
pub const IDLE: SignedDuration = SignedDuration::from_hours(12);

/// Most sessions at once; beyond it the one that was idle longest ends.
const MOST: usize = 4096;

/// Longest value of a cookie that is looked at; real ones are shorter.
const MAX_COOKIE_LEN: usize = 256;

/// A browser that is signed in.
#[derive(Debug, Clone)]
pub struct Session {
    /// The token that it was begun with.
    pub token: TokenId,
    /// Text that every change must repeat.
    pub csrf: String,
}

#[derive(Debug)]
struct Held {
    digest: SecretDigest,
    session: Session,
    used: Timestamp,
}

/// All sessions, by the first half of the digests of their ids.
#[derive(Debug, Default)]
pub struct Sessions {
    held: Mutex<HashMap<[u8; 16], Held>>,
}

impl Sessions {
    /// Begins a session of a token; returns the secret id for the cookie.
    ///
    /// # Errors
    /// A system that gives no randomness.
    pub fn begin(&self, token: TokenId, now: Timestamp) -> Result<Secret, rand::rngs::SysError> {
        let (id, csrf) = (Secret::draw()?, Secret::draw()?);
        let session = Session { token, csrf: csrf.reveal().to_owned() };
        let mut held = self.held();
        held.retain(|_, held| !is_over(held.used, now));
        if held.len() >= MOST
            && let Some(oldest) = held.iter().min_by_key(|(_, held)| held.used).map(|(half, _)| *half)
        {
            held.remove(&oldest);
        }
        held.insert(id.digest().half(), Held { digest: id.digest(), session, used: now });
        Ok(id)
    }

    /// The session of a request's cookie, if it is not over.
    pub fn find(&self, headers: &HeaderMap, now: Timestamp) -> Option<Session> {
        let digest = digest(headers)?;
        let mut held = self.held();
        let found = held.get_mut(&digest.half()).filter(|held| held.digest.matches(&digest))?;
        if is_over(found.used, now) {
            held.remove(&digest.half());
            return None;
        }
        found.used = now;
        Some(found.session.clone())
    }

    /// Ends the session of a request's cookie.
    pub fn end(&self, headers: &HeaderMap) {
        if let Some(digest) = digest(headers) {
            self.held().remove(&digest.half());
        }
    }

    fn held(&self) -> MutexGuard<'_, HashMap<[u8; 16], Held>> {
        self.held.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Session {
    /// Whether a text is the session's CSRF token, compared in constant time.
    pub fn matches(&self, csrf: &str) -> bool {
        SecretDigest::of(csrf.as_bytes()).matches(&SecretDigest::of(self.csrf.as_bytes()))
    }
}

fn is_over(used: Timestamp, now: Timestamp) -> bool {
    now.duration_since(used) >= IDLE
}

fn digest(headers: &HeaderMap) -> Option<SecretDigest> {
    cookie(headers, COOKIE_NAME).map(|id| SecretDigest::of(id.as_bytes()))
}

/// The value of a cookie that the request has exactly once.
pub fn cookie<'a>(headers: &'a HeaderMap, name: &str) -> Option<&'a str> {
    let mut values = headers
        .get_all(COOKIE)
        .iter()
        .filter_map(|value| value.to_str().ok())
        .flat_map(|value| value.split(';'))
        .filter_map(|pair| pair.trim().split_once('='))
        .filter(|(key, _)| *key == name)
        .map(|(_, value)| value);
    let value = values.next()?;
    (values.next().is_none() && (1..=MAX_COOKIE_LEN).contains(&value.len())).then_some(value)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn now() -> Timestamp {
        "2026-03-01T12:00:00Z".parse().unwrap()
    }

    fn headers(cookie: &str) -> HeaderMap {
        let mut headers = HeaderMap::new();
        headers.insert(COOKIE, cookie.parse().unwrap());
        headers
    }

    #[test]
    fn a_session_is_found_by_its_cookie_until_it_is_ended_or_idle() {
        let sessions = Sessions::default();
        let token = TokenId::from_u128(7);
        let id = sessions.begin(token, now()).unwrap();
        let sent = headers(&format!("theme=dark; {COOKIE_NAME}={}", id.reveal()));
        let found = sessions.find(&sent, now()).unwrap();
        assert_eq!(found.token, token);
        assert!(found.matches(&found.csrf) && !found.matches("") && !found.matches(id.reveal()));
        let almost = now() + IDLE - SignedDuration::from_secs(1);
        assert!(sessions.find(&sent, almost).is_some(), "each request keeps it");
        assert!(sessions.find(&sent, almost + IDLE).is_none());
        let id = sessions.begin(token, now()).unwrap();
        let sent = headers(&format!("{COOKIE_NAME}={}", id.reveal()));
        sessions.end(&sent);
        assert!(sessions.find(&sent, now()).is_none());
    }

    #[test]
    fn a_cookie_counts_only_once_and_only_whole() {
        let sessions = Sessions::default();
        let id = sessions.begin(TokenId::from_u128(7), now()).unwrap();
        let id = id.reveal();
        for sent in [
            format!("{COOKIE_NAME}={id}; {COOKIE_NAME}={id}"),
            format!("{COOKIE_NAME}={}", &id[..id.len() - 1]),
            format!("{COOKIE_NAME}={id}x"),
            format!("other={id}"),
            format!("{COOKIE_NAME}="),
        ] {
            assert!(sessions.find(&headers(&sent), now()).is_none(), "{sent}");
        }
    }

    #[test]
    fn sessions_are_bounded_and_the_one_idle_longest_goes_first() {
        let sessions = Sessions::default();
        let first = sessions.begin(TokenId::from_u128(1), now()).unwrap();
        let later = now() + SignedDuration::from_secs(1);
        for _ in 0..MOST {
            sessions.begin(TokenId::from_u128(2), later).unwrap();
        }
        assert_eq!(sessions.held().len(), MOST);
        assert!(sessions.find(&headers(&format!("{COOKIE_NAME}={}", first.reveal())), later).is_none());
    }
}
