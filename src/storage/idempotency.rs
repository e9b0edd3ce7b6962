//! Idempotency keys: the answer to a creating request is stored in the transaction that creates, so that
//! a repeat of the request gets the same answer.

use jiff::{Timestamp, ToSpan};

use super::database::{Session, sql};
use super::rows::us;
use super::{Digest, Store, StoreError};
use crate::domain::Created;

/// Hours for which a key is kept; the contract promises a day.
const KEPT_HOURS: i64 = 48;

/// The idempotency key of a request, and a digest of the request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct IdempotencyKey {
    /// The token that sent the key, or `""` while there is none.
    pub owner: String,
    /// The key.
    pub key: String,
    /// Digest of the request.
    pub fingerprint: Digest,
}

/// The stored answer to an earlier request under a key.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StoredAnswer {
    /// Digest of that request.
    pub fingerprint: String,
    /// Its answer.
    pub answer: Created,
}

/// Checks that no request was done under this key. The caller holds the write transaction in which this
/// one will be done.
pub(super) async fn check_unused(
    connection: &mut Session,
    key: Option<&IdempotencyKey>,
) -> Result<(), StoreError> {
    let Some(key) = key else { return Ok(()) };
    let found: bool = sql("SELECT EXISTS (SELECT 1 FROM idempotency_keys WHERE owner = $1 AND key = $2)")
        .bind(&key.owner)
        .bind(&key.key)
        .fetch_one(connection)
        .await?;
    if found { Err(StoreError::Repeated) } else { Ok(()) }
}

/// Records the answer in the transaction in which the request was done, and deletes old ones.
pub(super) async fn record(
    connection: &mut Session,
    key: Option<&IdempotencyKey>,
    answer: impl FnOnce() -> Created,
    now: Timestamp,
) -> Result<(), StoreError> {
    let Some(key) = key else { return Ok(()) };
    let answer = answer();
    let oldest = now.checked_sub(KEPT_HOURS.hours()).unwrap_or(Timestamp::MIN);
    sql("DELETE FROM idempotency_keys WHERE created_us < $1")
        .bind(us(oldest))
        .execute(&mut *connection)
        .await?;
    sql("INSERT INTO idempotency_keys (owner, key, fingerprint, status, location, etag, body, created_us)
         VALUES ($1, $2, $3, $4, $5, $6, $7, $8)")
    .bind(&key.owner)
    .bind(&key.key)
    .bind(key.fingerprint.as_str())
    .bind(i64::from(answer.status))
    .bind(&answer.location)
    .bind(answer.etag.as_deref())
    .bind(&answer.body)
    .bind(us(now))
    .execute(connection)
    .await?;
    Ok(())
}

impl Store {
    /// Whether what an answer's `Location` names is still there.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn is_still_there(&self, location: &str) -> Result<bool, StoreError> {
        let parts: Vec<&str> = location.trim_matches('/').split('/').collect();
        let (asked, keys): (&'static str, &[&str]) = match parts.as_slice() {
            ["v1", "rigs", rig] => ("SELECT EXISTS (SELECT 1 FROM rigs WHERE id = $1)", &[rig]),
            ["v1", "jobs", job] => ("SELECT EXISTS (SELECT 1 FROM jobs WHERE id = $1)", &[job]),
            ["v1", "rigs", rig, "runs", run] => {
                ("SELECT EXISTS (SELECT 1 FROM runs WHERE rig = $1 AND id = $2)", &[rig, run])
            }
            ["v1", "rigs", rig, "models", version] => (
                "SELECT EXISTS (SELECT 1 FROM models WHERE rig = $1 AND version = CAST($2 AS BIGINT))",
                &[rig, version],
            ),
            ["v1", "tokens", token] => {
                ("SELECT EXISTS (SELECT 1 FROM tokens WHERE id = $1 AND revoked_us IS NULL)", &[token])
            }
            _ => return Ok(true),
        };
        let mut query = sql(asked);
        for key in keys {
            query = query.bind(*key);
        }
        Ok(query.fetch_one(self.reader()).await?)
    }

    /// The stored answer to an earlier request under this key, if there was one.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn answer_under_key(&self, owner: &str, key: &str) -> Result<Option<StoredAnswer>, StoreError> {
        let row: Option<(String, u16, String, Option<String>, String)> =
            sql("SELECT fingerprint, status, location, etag, body FROM idempotency_keys
             WHERE owner = $1 AND key = $2")
            .bind(owner)
            .bind(key)
            .fetch_optional(self.reader())
            .await?;
        Ok(row.map(|(fingerprint, status, location, etag, body)| StoredAnswer {
            fingerprint,
            answer: Created { status, location, etag, body },
        }))
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::{TestStore, draft, now};
    use super::super::{Asker, JobInsert};
    use super::*;
    use crate::domain::fits::FitRequest;

    fn keyed(key: &str) -> IdempotencyKey {
        IdempotencyKey { owner: String::new(), key: key.into(), fingerprint: Digest::of(b"request") }
    }

    #[tokio::test]
    async fn a_request_is_done_once_and_its_answer_is_kept_for_a_day_at_least() {
        let store = TestStore::open().await;
        let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
        let request: FitRequest = serde_json::from_value(serde_json::json!({"kind": "frf"})).unwrap();
        let asker = Asker { token: None, max_waiting: 10 };
        let fit =
            async |key: &str, now| store.insert_job(&rig.id, &request, asker, Some(&keyed(key)), now).await;
        let JobInsert::Queued(job) = fit("a", now()).await.unwrap() else { panic!("it is the first") };
        assert!(matches!(fit("a", now()).await, Err(StoreError::Repeated)));
        let before = store.answer_under_key("", "a").await.unwrap().unwrap();
        assert_eq!(
            (before.fingerprint.as_str(), &before.answer),
            (Digest::of(b"request").as_str(), &Created::job(&job))
        );
        assert_eq!(store.answer_under_key("somebody else", "a").await.unwrap(), None);
        fit("b", now() + 25.hours()).await.unwrap();
        assert!(store.answer_under_key("", "a").await.unwrap().is_some());
        fit("c", now() + 49.hours()).await.unwrap();
        assert_eq!(store.answer_under_key("", "a").await.unwrap(), None);
        assert!(store.answer_under_key("", "b").await.unwrap().is_some());
        // A failed request does not use up its key.
        let gone = "gone".parse().unwrap();
        let refused = store.insert_job(&gone, &request, asker, Some(&keyed("d")), now()).await.unwrap();
        assert_eq!(refused, JobInsert::MissingRig);
        assert_eq!(store.answer_under_key("", "d").await.unwrap(), None);
    }
}
