//! Objects that were found corrupt or missing, and the rows that refer to them.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::database::sql;
use super::rows::parsed;
use super::{Store, StoreError};
use crate::domain::{DiagnosisId, EvaluationId, RigId, RunId};

/// Names of objects that could not be read as they were stored.
#[derive(Debug, Clone, Default)]
pub(super) struct CorruptObjects(Arc<Mutex<BTreeSet<String>>>);

impl CorruptObjects {
    fn names(&self) -> MutexGuard<'_, BTreeSet<String>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether an object was found corrupt.
    pub(super) fn has(&self, digest: &str) -> bool {
        self.names().contains(digest)
    }

    /// Notes that an object was found corrupt, or intact.
    pub(super) fn note(&self, digest: &str, damaged: bool) {
        let mut names = self.names();
        if damaged {
            names.insert(digest.to_owned());
        } else {
            names.remove(digest);
        }
    }
}

/// The row that a corrupt object belongs to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum CorruptObject {
    /// Samples of a run.
    Run(RunId),
    /// Weights of a model version.
    Model(u32),
    /// Findings of a diagnosis.
    Diagnosis(DiagnosisId),
    /// Report of an evaluation.
    Evaluation(EvaluationId),
}

impl Store {
    /// Objects that were found corrupt since the start and are still referred to, by rig.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn corrupt_objects(&self) -> Result<Vec<(RigId, CorruptObject)>, StoreError> {
        let digests: Vec<String> = self.objects().corrupt().names().iter().cloned().collect();
        let mut found = Vec::new();
        for digest in digests {
            let rows: Vec<(String, String, String)> = sql("SELECT rig, 'run', id FROM runs WHERE object = $1
                 UNION ALL SELECT rig, 'model', CAST(version AS TEXT) FROM models WHERE sha256 = $1
                 UNION ALL SELECT rig, 'diagnosis', id FROM diagnoses WHERE findings = $1
                 UNION ALL SELECT rig, 'evaluation', id FROM evaluations WHERE report = $1")
            .bind(&digest)
            .fetch_all(self.reader())
            .await?;
            for (rig, kind, id) in rows {
                let of = match kind.as_str() {
                    "run" => CorruptObject::Run(parsed("runs", &id, &id)?),
                    "model" => CorruptObject::Model(parsed("models", &id, &id)?),
                    "diagnosis" => CorruptObject::Diagnosis(parsed("diagnoses", &id, &id)?),
                    _ => CorruptObject::Evaluation(parsed("evaluations", &id, &id)?),
                };
                found.push((parsed("rigs", &rig, &rig)?, of));
            }
        }
        Ok(found)
    }

    /// Reads every object of a rig's runs and models, and notes the corrupt ones.
    ///
    /// # Errors
    /// The database's failures.
    pub async fn verify_rig(&self, rig: &RigId) -> Result<(), StoreError> {
        let digests: Vec<String> =
            sql("SELECT object FROM runs WHERE rig = $1 UNION SELECT sha256 FROM models WHERE rig = $1")
                .bind(rig.as_str())
                .fetch_all(self.reader())
                .await?;
        for digest in digests {
            if let Err(error) = self.objects().get(&digest).await {
                tracing::error!(rig.id = %rig, %error, "stored data are damaged");
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::{TestStore, draft, now};
    use super::*;

    #[tokio::test]
    async fn what_is_damaged_is_named_until_it_is_whole_or_gone() {
        let store = TestStore::open_sqlite().await;
        let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
        let run = store.upload(&rig, &[1.0]).await.run;
        let model = store.import(&rig, b"weights").await;
        let path = |digest: &str| store.data_dir().join("objects").join(&digest[..2]).join(digest);
        let whole = std::fs::read(path(&run.object)).unwrap();
        std::fs::write(path(&run.object), b"other").unwrap();
        std::fs::remove_file(path(&model.sha256)).unwrap();
        assert_eq!(store.corrupt_objects().await.unwrap(), [], "nobody has looked");
        store.verify_rig(&rig.id).await.unwrap();
        let mut found = store.corrupt_objects().await.unwrap();
        found.sort_by_key(|(_, of)| matches!(of, CorruptObject::Model(_)));
        let of = |of| (rig.id.clone(), of);
        assert_eq!(found, [of(CorruptObject::Run(run.id)), of(CorruptObject::Model(1))]);
        std::fs::write(path(&run.object), whole).unwrap();
        store.load_signal(&run).await.unwrap();
        assert_eq!(store.corrupt_objects().await.unwrap(), [of(CorruptObject::Model(1))]);
        store.delete_model(&rig.id, 1).await.unwrap();
        assert_eq!(store.corrupt_objects().await.unwrap(), []);
    }
}
