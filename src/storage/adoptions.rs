//! Adopted effects of rows that were written before a model version's row named them.

use crate::domain::{Adoption, Model};
use crate::engine::model::from_safetensors;

use super::database::sql;
use super::objects::off_thread;
use super::rows::{ModelRow, UNREAD, all, json};
use super::{Store, StoreError};

impl Store {
    /// Asks the weight files of unread rows which effects they hold, each once. A file that cannot be read
    /// leaves its row as it is: damage of one model must not keep the others from starting.
    ///
    /// # Errors
    /// The database's failures.
    pub(super) async fn read_adoptions(&self) -> Result<(), StoreError> {
        let rows: Vec<ModelRow> =
            sql("SELECT models.*, 0 AS active FROM models WHERE adoption = $1 ORDER BY rig, version")
                .bind(UNREAD)
                .fetch_all(self.reader())
                .await?;
        for model in all::<_, Model>(rows)? {
            match self.adoption_of(&model).await {
                Ok(adoption) => {
                    let mut tx = self.write().await?;
                    sql("UPDATE models SET adoption = $3 WHERE rig = $1 AND version = $2")
                        .bind(model.rig.as_str())
                        .bind(model.version)
                        .bind(adoption.as_ref().map(json))
                        .execute(&mut *tx)
                        .await?;
                    tx.commit().await?;
                }
                Err(error) => {
                    tracing::error!(
                        rig.id = %model.rig, model.version = model.version, %error,
                        "a weight file cannot say which effects it holds"
                    );
                }
            }
        }
        Ok(())
    }

    /// What the weight file of a row says of its effects; the base's digest while that version is there.
    async fn adoption_of(
        &self,
        model: &Model,
    ) -> Result<Option<Adoption>, Box<dyn std::error::Error + Send + Sync>> {
        let bytes = self.weights(model).await?;
        let read = off_thread(move || Ok(from_safetensors(&bytes))).await??;
        let version = model.lineage.diagnoses.first().map(|adopted| adopted.version);
        let base = match version {
            Some(version) => self.model(&model.rig, version).await?.map(|base| base.sha256),
            None => None,
        };
        Ok(Adoption::of(&read, version, base))
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;
    use sqlx::SqlitePool;
    use sqlx::sqlite::SqliteConnectOptions;

    use super::*;
    use crate::domain::{AdoptedEffect, Base, PageRequest};
    use crate::engine::diagnosis::{Effect, Family};
    use crate::engine::model::{ModelKind, VersionKind, to_safetensors};
    use crate::storage::{Digest, Objects, migrations};

    /// An FRF from `u` to `y` with a cubic stiffness on top, as programs of before the kind `adopted` wrote it.
    const WEIGHTS: &[u8] = include_bytes!("../../tests/vectors/effect_of_kind_frf.safetensors");
    /// The last schema of before.
    const SCHEMA: i64 = 5;

    /// A directory as programs of before left it: an FRF, the same with an effect adopted and with one
    /// more, the weights of it imported, an import without effects, and an adopted version whose weights
    /// are lost.
    async fn directory_of_before() -> tempfile::TempDir {
        let dir = tempfile::tempdir().unwrap();
        let mut bare = from_safetensors(WEIGHTS).unwrap();
        bare.effects.clear();
        std::fs::create_dir(dir.path().join("objects")).unwrap();
        let objects = Objects::open(&dir.path().join("objects"), None).unwrap();
        let (effect, bare) = (Bytes::from_static(WEIGHTS), Bytes::from(to_safetensors(&bare)));
        let digests = [Digest::of(&bare), Digest::of(&effect), Digest::of(b"lost")];
        objects.put(&digests[0], bare).await.unwrap();
        objects.put(&digests[1], effect).await.unwrap();
        let database = SqliteConnectOptions::new().filename(dir.path().join("rigcast.db"));
        let pool = SqlitePool::connect_with(database.create_if_missing(true)).await.unwrap();
        migrations::up_to(SCHEMA).run(&pool).await.unwrap();
        sqlx::query(
            "INSERT INTO rigs (id, name, sample_rate_hz, channels, created_us, updated_us, revision,
                               active_version, active_revision, next_version)
             VALUES ('bench', 'Bench', 128, '[]', 1, 1, 1, NULL, 1, 7)",
        )
        .execute(&pool)
        .await
        .unwrap();
        let of = |version: u32| {
            format!(
                r#"{{"id": "0197f1a0-0000-7000-8000-000000000000", "hypothesis": 0, "version": {version}, "fit": [], "select": []}}"#
            )
        };
        let (one, two) = (of(1), format!("{}, {}", of(1), of(2)));
        for (version, digest, origin, diagnoses) in [
            (1, 0, "fit", ""),
            (2, 1, "diagnosis", &*one),
            (3, 1, "diagnosis", &*two),
            (4, 1, "import", ""),
            (5, 0, "import", ""),
            (6, 2, "diagnosis", &*one),
        ] {
            let lineage =
                format!(r#"{{"training": [], "frf": [], "validation": [], "diagnoses": [{diagnoses}]}}"#);
            sqlx::query(
                "INSERT INTO models (rig, version, kind, inputs, outputs, sample_rate_hz, sha256, size_bytes,
                                     origin, lineage, code_version, instruction_set, created_us)
                 VALUES ('bench', $1, 'frf', '[\"u\"]', '[\"y\"]', 128, $2, 5, $3, $4, '0', 'portable', 9)",
            )
            .bind(version)
            .bind(digests[digest].as_str())
            .bind(origin)
            .bind(lineage)
            .execute(&pool)
            .await
            .unwrap();
        }
        pool.close().await;
        dir
    }

    #[tokio::test]
    async fn rows_of_before_the_kind_adopted_are_told_by_their_weight_files() {
        let dir = directory_of_before().await;
        let models = async |store: &Store| {
            store.models(&"bench".parse().unwrap(), &PageRequest::default()).await.unwrap().unwrap().items
        };
        let store = Store::open(dir.path()).await.unwrap();
        let found = models(&store).await;
        let base = |version, sha256: Option<&String>| Base {
            version,
            kind: ModelKind::Frf,
            sha256: sha256.cloned(),
        };
        let effect = AdoptedEffect {
            effect: Effect::CubicStiffness,
            family: Family::Stiffness,
            channel: "disp".into(),
        };
        let effects = vec![effect];
        let first = Some(&found[0].sha256);
        let expected = [
            None,
            Some(Adoption { base: base(Some(1), first), effects: effects.clone() }),
            Some(Adoption { base: base(Some(1), first), effects: effects.clone() }),
            Some(Adoption { base: base(None, None), effects }),
            None,
            Some(Adoption { base: base(Some(1), None), effects: Vec::new() }),
        ];
        for (model, expected) in found.iter().zip(expected) {
            let kind = if expected.is_some() { VersionKind::Adopted } else { VersionKind::Frf };
            assert_eq!((model.kind, &model.adoption), (kind, &expected), "version {}", model.version);
        }
        store.close().await;
        drop(store);
        let again = Store::open(dir.path()).await.unwrap();
        assert_eq!(models(&again).await, found, "once is enough");
        let unread: i64 = sql("SELECT count(*) FROM models WHERE adoption = $1")
            .bind(UNREAD)
            .fetch_one(again.reader())
            .await
            .unwrap();
        assert_eq!(unread, 1, "only the lost one is asked again");
    }
}
