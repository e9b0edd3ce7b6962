//! Requests that are done once, however often they come: the answer is stored in the transaction that
//! makes what was asked for.

use jiff::{Timestamp, ToSpan};
use sqlx::SqliteConnection;

use super::rows::us;
use super::{Digest, Store, StoreError};
use crate::domain::Created;

/// Hours for which a key is kept; the contract promises a day.
const KEPT_HOURS: i64 = 48;

/// A request under a key.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Once {
    /// Who chose the key.
    pub owner: String,
    /// The key.
    pub key: String,
    /// Digest of the request.
    pub fingerprint: Digest,
}

/// What came of a request under this key before.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Before {
    /// Digest of that request.
    pub fingerprint: String,
    /// Its answer.
    pub answer: Created,
}

/// Makes sure that the request was not done before. The caller holds the write transaction in which
/// it will be done.
pub(super) async fn begin(connection: &mut SqliteConnection, once: Option<&Once>) -> Result<(), StoreError> {
    let Some(once) = once else { return Ok(()) };
    let found: i64 =
        sqlx::query_scalar("SELECT EXISTS (SELECT 1 FROM idempotency_keys WHERE owner = ? AND key = ?)")
            .bind(&once.owner)
            .bind(&once.key)
            .fetch_one(connection)
            .await?;
    if found == 0 { Ok(()) } else { Err(StoreError::Repeated) }
}

/// Notes the answer of the request, in the transaction in which it was done, and forgets old ones.
pub(super) async fn end(
    connection: &mut SqliteConnection,
    once: Option<&Once>,
    answer: impl FnOnce() -> Created,
    now: Timestamp,
) -> Result<(), StoreError> {
    let Some(once) = once else { return Ok(()) };
    let answer = answer();
    let oldest = now.checked_sub(KEPT_HOURS.hours()).unwrap_or(Timestamp::MIN);
    sqlx::query("DELETE FROM idempotency_keys WHERE created_us < ?")
        .bind(us(oldest))
        .execute(&mut *connection)
        .await?;
    sqlx::query(
        "INSERT INTO idempotency_keys (owner, key, fingerprint, status, location, etag, body, created_us)
         VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
    )
    .bind(&once.owner)
    .bind(&once.key)
    .bind(once.fingerprint.as_str())
    .bind(i64::from(answer.status))
    .bind(&answer.location)
    .bind(&answer.etag)
    .bind(&answer.body)
    .bind(us(now))
    .execute(connection)
    .await?;
    Ok(())
}

impl Store {
    /// What came of a request under this key before, if there was one.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn before(&self, owner: &str, key: &str) -> Result<Option<Before>, StoreError> {
        let row: Option<(String, u16, String, Option<String>, String)> = sqlx::query_as(
            "SELECT fingerprint, status, location, etag, body FROM idempotency_keys
             WHERE owner = ? AND key = ?",
        )
        .bind(owner)
        .bind(key)
        .fetch_optional(self.reader())
        .await?;
        Ok(row.map(|(fingerprint, status, location, etag, body)| Before {
            fingerprint,
            answer: Created { status, location, etag, body },
        }))
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::{TestStore, draft, now};
    use super::*;

    fn once(key: &str) -> Once {
        Once { owner: String::new(), key: key.into(), fingerprint: Digest::of(b"request") }
    }

    #[tokio::test]
    async fn a_request_is_done_once_and_its_answer_is_kept_for_a_day_at_least() {
        let store = TestStore::open().await;
        let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
        let request = serde_json::from_value(serde_json::json!({"kind": "frf"})).unwrap();
        let fit = async |key: &str, now| store.insert_fit_job(&rig.id, &request, Some(&once(key)), now).await;
        let job = fit("a", now()).await.unwrap().unwrap();
        assert!(matches!(fit("a", now()).await, Err(StoreError::Repeated)));
        let before = store.before("", "a").await.unwrap().unwrap();
        assert_eq!(
            (before.fingerprint.as_str(), &before.answer),
            (Digest::of(b"request").as_str(), &Created::job(&job))
        );
        assert_eq!(store.before("somebody else", "a").await.unwrap(), None);
        fit("b", now() + 25.hours()).await.unwrap();
        assert!(store.before("", "a").await.unwrap().is_some());
        fit("c", now() + 49.hours()).await.unwrap();
        assert_eq!(store.before("", "a").await.unwrap(), None);
        assert!(store.before("", "b").await.unwrap().is_some());
        // What failed was not done.
        let gone = "gone".parse().unwrap();
        assert_eq!(store.insert_fit_job(&gone, &request, Some(&once("d")), now()).await.unwrap(), None);
        assert_eq!(store.before("", "d").await.unwrap(), None);
    }
}
