//! Rigs in the store.

use std::collections::BTreeSet;

use jiff::Timestamp;
use serde_json::Value;

use super::database::{On, sql};
use super::reserve::with_reserve;
use super::rows::{RigRow, all, json, us};
use super::{IdempotencyKey, Store, StoreError, idempotency};
use crate::domain::rig::same_but_for_aliases;
use crate::domain::{Created, FieldError, Page, PageRequest, Rig, RigDraft, RigId};

/// Outcome of a patch.
#[derive(Debug, Clone, PartialEq)]
pub enum RigUpdate {
    /// The rig as it is now.
    Updated(Rig),
    /// No such rig.
    Missing,
    /// The rig has changed since the client read it: its `ETag` now.
    Stale(String),
    /// Channels and sample rate are fixed once a run exists.
    ChannelsFixed,
    /// Fields that do not fit.
    Invalid(Vec<FieldError>),
}

/// A rig with the fields of a list for people.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RigAtAGlance {
    /// Id.
    pub id: String,
    /// Name.
    pub name: String,
    /// Version and kind of the active model.
    pub active: Option<(u32, String)>,
}

/// Whether an `If-Match` header names this `ETag`: `*`, or one of a list. Weak tags match nothing
/// (RFC 9110, section 13.1.1).
pub(super) fn if_match(header: &str, etag: &str) -> bool {
    header.split(',').map(str::trim).any(|tag| tag == "*" || tag == etag)
}

/// The rig of this id, as the transaction sees it.
pub(super) async fn rig_in<'a>(on: impl Into<On<'a>>, id: &RigId) -> Result<Option<Rig>, StoreError> {
    let row: Option<RigRow> =
        sql("SELECT * FROM rigs WHERE id = $1").bind(id.as_str()).fetch_optional(on).await?;
    row.map(Rig::try_from).transpose()
}

impl Store {
    /// Adds a rig; `None` when its id is taken. The draft must have passed its check.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn insert_rig(
        &self,
        draft: &RigDraft,
        key: Option<&IdempotencyKey>,
        now: Timestamp,
    ) -> Result<Option<Rig>, StoreError> {
        let mut tx = self.write().await?;
        idempotency::check_unused(&mut tx, key).await?;
        // Revisions start at the present time, so that a rig that is deleted and created again never
        // repeats an `ETag` that a client may still hold.
        let row: Option<RigRow> = sql("INSERT INTO rigs (id, name, sample_rate_hz, channels, fit_policy,
                               created_us, updated_us, revision, active_revision)
             VALUES ($1, $2, $3, $4, $5, $6, $6, $6, $6)
             ON CONFLICT (id) DO NOTHING RETURNING *")
        .bind(draft.id.as_str())
        .bind(if draft.name.is_empty() { draft.id.as_str() } else { &draft.name })
        .bind(draft.sample_rate_hz)
        .bind(json(&draft.channels))
        .bind(draft.fit_policy.as_ref().map(json))
        .bind(us(now))
        .fetch_optional(&mut *tx)
        .await?;
        let Some(rig) = row.map(Rig::try_from).transpose()? else { return Ok(None) };
        idempotency::record(&mut tx, key, || Created::rig(&rig), now).await?;
        tx.commit().await?;
        Ok(Some(rig))
    }

    /// The rig of this id.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn rig(&self, id: &RigId) -> Result<Option<Rig>, StoreError> {
        rig_in(self.reader(), id).await
    }

    /// Rigs by id; with `among` only those that it names.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn rigs(
        &self,
        among: Option<&BTreeSet<RigId>>,
        page: &PageRequest,
    ) -> Result<Page<Rig>, StoreError> {
        let rows: Vec<RigRow> = sql("SELECT * FROM rigs
             WHERE id > $1 AND ($2 IS NULL OR id IN (SELECT value FROM json_each($2)))
             ORDER BY id LIMIT $3")
        .bind(page.cursor.as_ref().map_or("", |cursor| cursor.as_str()))
        .bind(among.map(json))
        .bind(i64::from(page.limit) + 1)
        .fetch_all(self.reader())
        .await?;
        Ok(Page::cut(all(rows)?, page.limit, |rig: &Rig| rig.id.to_string()))
    }

    /// Ids, names and active models of rigs by id; with `among` only those that it names.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn rigs_at_a_glance(
        &self,
        among: Option<&BTreeSet<RigId>>,
        page: &PageRequest,
    ) -> Result<Page<RigAtAGlance>, StoreError> {
        let rows: Vec<(String, String, Option<u32>, Option<String>)> =
            sql("SELECT rigs.id, rigs.name, models.version, models.kind FROM rigs
             LEFT JOIN models ON models.rig = rigs.id AND models.version = rigs.active_version
             WHERE rigs.id > $1 AND ($2 IS NULL OR rigs.id IN (SELECT value FROM json_each($2)))
             ORDER BY rigs.id LIMIT $3")
            .bind(page.cursor.as_ref().map_or("", |cursor| cursor.as_str()))
            .bind(among.map(json))
            .bind(i64::from(page.limit) + 1)
            .fetch_all(self.reader())
            .await?;
        let rigs = rows.into_iter();
        let rigs = rigs.map(|(id, name, version, kind)| RigAtAGlance { id, name, active: version.zip(kind) });
        Ok(Page::cut(rigs.collect(), page.limit, |rig: &RigAtAGlance| rig.id.clone()))
    }

    /// Applies a merge patch (RFC 7396) if the rig still has the `ETag` that the client names
    /// (`*` names any).
    ///
    /// # Errors
    /// The store's failures.
    pub async fn patch_rig(
        &self,
        id: &RigId,
        if_match_header: &str,
        patch: &Value,
        now: Timestamp,
    ) -> Result<RigUpdate, StoreError> {
        let mut tx = self.write().await?;
        let Some(rig) = rig_in(&mut tx, id).await? else { return Ok(RigUpdate::Missing) };
        if !if_match(if_match_header, &rig.etag()) {
            return Ok(RigUpdate::Stale(rig.etag()));
        }
        let draft = match rig.patched(patch) {
            Ok(draft) => draft,
            Err(errors) => return Ok(RigUpdate::Invalid(errors)),
        };
        if !same_but_for_aliases(&draft.channels, &rig.channels) || draft.sample_rate_hz != rig.sample_rate_hz
        {
            // Models refer to the rig's channels as runs do.
            let used: bool = sql("SELECT EXISTS (SELECT 1 FROM runs WHERE rig = $1)
                     OR EXISTS (SELECT 1 FROM models WHERE rig = $1)")
            .bind(id.as_str())
            .fetch_one(&mut *tx)
            .await?;
            if used {
                return Ok(RigUpdate::ChannelsFixed);
            }
        }
        let row: RigRow =
            sql("UPDATE rigs SET name = $2, sample_rate_hz = $3, channels = $4, fit_policy = $5,
                             updated_us = $6, revision = revision + 1
             WHERE id = $1 RETURNING *")
            .bind(id.as_str())
            .bind(if draft.name.is_empty() { id.as_str() } else { &draft.name })
            .bind(draft.sample_rate_hz)
            .bind(json(&draft.channels))
            .bind(draft.fit_policy.as_ref().map(json))
            .bind(us(now))
            .fetch_one(&mut *tx)
            .await?;
        tx.commit().await?;
        Ok(RigUpdate::Updated(row.try_into()?))
    }

    /// Removes a rig with all that belongs to it; tells whether it was there. Unreferenced objects are removed
    /// after the rows.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn delete_rig(&self, id: &RigId) -> Result<bool, StoreError> {
        with_reserve!(self, self.delete_rig_rows(id))
    }

    async fn delete_rig_rows(&self, id: &RigId) -> Result<bool, StoreError> {
        let mut tx = self.write_with_reserve().await?;
        let objects: Vec<String> =
            sql("SELECT object FROM runs WHERE rig = $1 UNION SELECT sha256 FROM models WHERE rig = $1
             UNION SELECT findings FROM diagnoses WHERE rig = $1
             UNION SELECT report FROM evaluations WHERE rig = $1")
            .bind(id.as_str())
            .fetch_all(&mut *tx)
            .await?;
        let deleted = sql("DELETE FROM rigs WHERE id = $1").bind(id.as_str()).execute(&mut *tx).await?;
        tx.commit().await?;
        self.discard_unreferenced(objects).await;
        Ok(deleted > 0)
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::super::testing::{TestStore, draft, now};
    use super::*;

    #[tokio::test]
    async fn a_rig_comes_back_as_it_was_sent_and_its_id_is_taken() {
        let store = TestStore::open().await;
        let mut sent = draft("bench");
        sent.fit_policy = serde_json::from_value(json!({"fits": [{"kind": "frf"}]})).unwrap();
        let rig = store.insert_rig(&sent, None, now()).await.unwrap().unwrap();
        assert_eq!(rig.draft(), sent);
        assert_eq!(store.rig(&sent.id).await.unwrap().unwrap(), rig);
        assert_eq!(store.insert_rig(&sent, None, now()).await.unwrap(), None);
    }

    #[tokio::test]
    async fn rigs_are_listed_in_pages() {
        let store = TestStore::open().await;
        for id in ["c", "a", "b"] {
            store.insert_rig(&draft(id), None, now()).await.unwrap();
        }
        let first = store.rigs(None, &PageRequest { limit: 2, cursor: None }).await.unwrap();
        let ids = |page: &Page<Rig>| page.items.iter().map(|r| r.id.to_string()).collect::<Vec<_>>();
        assert_eq!((ids(&first), first.next.as_deref()), (vec!["a".into(), "b".into()], Some("b")));
        let cursor = crate::domain::Cursor::parse("b").ok();
        let second = store.rigs(None, &PageRequest { limit: 2, cursor }).await.unwrap();
        assert_eq!((ids(&second), second.next), (vec!["c".into()], None));
        let some = ["c", "b", "d"].into_iter().map(|id| id.parse().unwrap()).collect();
        let among = store.rigs(Some(&some), &PageRequest { limit: 1, cursor: None }).await.unwrap();
        assert_eq!((ids(&among), among.next.as_deref()), (vec!["b".into()], Some("b")));
    }

    #[tokio::test]
    async fn a_stale_etag_is_refused_and_a_fresh_one_patches() {
        let store = TestStore::open().await;
        let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
        let patch = json!({"name": "Bench"});
        let RigUpdate::Updated(new) = store.patch_rig(&rig.id, &rig.etag(), &patch, now()).await.unwrap()
        else {
            panic!("the etag is fresh")
        };
        assert_eq!(new.name, "Bench");
        let stale = store.patch_rig(&rig.id, &rig.etag(), &patch, now()).await.unwrap();
        assert_eq!(stale, RigUpdate::Stale(new.etag()));
        let listed = format!("\"other\", {}", new.etag());
        assert!(matches!(store.patch_rig(&rig.id, &listed, &patch, now()).await, Ok(RigUpdate::Updated(_))));
        let weak = format!("W/{}", new.etag());
        assert!(matches!(store.patch_rig(&rig.id, &weak, &patch, now()).await, Ok(RigUpdate::Stale(_))));
        let unknown = "nobody".parse().unwrap();
        assert_eq!(store.patch_rig(&unknown, "*", &patch, now()).await.unwrap(), RigUpdate::Missing);
    }

    #[tokio::test]
    async fn channels_are_fixed_once_a_run_exists() {
        let store = TestStore::open().await;
        let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
        let patch = json!({"sample_rate_hz": 200.0});
        assert!(matches!(store.patch_rig(&rig.id, "*", &patch, now()).await, Ok(RigUpdate::Updated(_))));
        let rig = store.rig(&rig.id).await.unwrap().unwrap();
        store.upload(&rig, &[1.0, 2.0]).await;
        let patch = json!({"sample_rate_hz": 300.0});
        assert_eq!(store.patch_rig(&rig.id, "*", &patch, now()).await.unwrap(), RigUpdate::ChannelsFixed);
        let patch = json!({"name": "Bench", "channels": rig.channels});
        assert!(matches!(store.patch_rig(&rig.id, "*", &patch, now()).await, Ok(RigUpdate::Updated(_))));
        // Aliases say how files are read, and nothing of the samples.
        let mut channels = rig.channels;
        channels[0].aliases.push("Kanal 1".into());
        let patch = json!({"channels": channels});
        assert!(matches!(store.patch_rig(&rig.id, "*", &patch, now()).await, Ok(RigUpdate::Updated(_))));
        channels[0].unit = "N".into();
        let patch = json!({"channels": channels});
        assert_eq!(store.patch_rig(&rig.id, "*", &patch, now()).await.unwrap(), RigUpdate::ChannelsFixed);
    }

    #[tokio::test]
    async fn a_deleted_rig_takes_everything_along_but_shared_objects() {
        let store = TestStore::open().await;
        let mut rigs = Vec::new();
        for id in ["a", "b"] {
            let rig = store.insert_rig(&draft(id), None, now()).await.unwrap().unwrap();
            let run = store.upload(&rig, &[1.0, 2.0]).await.run;
            store.upload(&rig, &[1.0, 2.0]).await;
            rigs.push((rig, run));
        }
        let (a, shared) = &rigs[0];
        let own = store.upload(a, &[3.0]).await.run;
        let model = store.import(a, b"weights").await;
        let job = store.queue_fit(a).await;
        assert!(store.delete_rig(&a.id).await.unwrap());
        assert!(!store.delete_rig(&a.id).await.unwrap());
        assert_eq!(store.rig(&a.id).await.unwrap(), None);
        assert_eq!(store.run(&a.id, own.id).await.unwrap(), None);
        assert_eq!(store.model(&a.id, model.version).await.unwrap(), None);
        assert_eq!(store.job(job.id).await.unwrap(), None);
        for gone in [&own.object, &model.sha256] {
            assert!(matches!(store.objects().get(gone).await, Err(StoreError::ObjectMissing { .. })));
        }
        let (b, run) = &rigs[1];
        assert_eq!(run.object, shared.object);
        assert_eq!(store.load_signal(run).await.unwrap().channel(0), [1.0, 2.0]);
        assert!(store.rig(&b.id).await.unwrap().is_some());
    }
}
