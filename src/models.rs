//! A small cache of loaded models, whose entries are replaced whole.
//!
//! The active version is read from the registry for every prediction, by one indexed read, so that an
//! answer never comes from a model that was active a moment ago. Only the weights are cached, and those of a
//! version never change.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

use tokio::sync::OnceCell;

use crate::compute::{Class, Compute, ComputeError};
use crate::domain::{Base, DiagnosisId, EvaluationId, Model, RigId, RunId};
use crate::engine::EngineError;
use crate::engine::model::{Predictor, RigModel, from_safetensors};
use crate::storage::{CorruptObject, Store, StoreError};
use crate::telemetry::names;

/// A model in memory. A prediction holds the same one from start to end.
#[derive(Debug, Clone, PartialEq)]
pub struct LoadedModel {
    /// Version.
    pub version: u32,
    /// SHA-256 of its weight file, verified when it was loaded.
    pub sha256: String,
    /// The version beneath its adopted effects, if it has some.
    pub base: Option<Base>,
    /// The model, ready to predict.
    pub predictor: Predictor,
}

impl LoadedModel {
    /// The model.
    pub fn model(&self) -> &RigModel {
        self.predictor.model()
    }
}

/// The reason why a model cannot be loaded.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// The store failed, or the weight file is damaged.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The weight file cannot be read as a model.
    #[error("model {rig} version {version}: {source}")]
    Weights {
        /// Rig.
        rig: RigId,
        /// Version.
        version: u32,
        /// What is wrong.
        source: EngineError,
    },
    /// No thread for it.
    #[error(transparent)]
    Compute(#[from] ComputeError),
}

impl ModelError {
    /// Whether the model itself is corrupt, so that loading it again fails too.
    fn is_corrupt(&self) -> bool {
        matches!(
            self,
            Self::Weights { .. }
                | Self::Store(StoreError::ObjectDamaged { .. } | StoreError::ObjectMissing { .. })
        )
    }
}

/// A model, run, diagnosis or evaluation that could not be read when it was last needed; `readyz` lists it as degraded.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct Degraded {
    /// Rig.
    pub rig: RigId,
    /// Model version.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub version: Option<u32>,
    /// Run.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub run: Option<RunId>,
    /// Diagnosis.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub diagnosis: Option<DiagnosisId>,
    /// Evaluation.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub evaluation: Option<EvaluationId>,
    /// Reason.
    pub reason: String,
}

/// Rig, version and digest: the versions of a rig that is deleted and made again start from one again.
type Key = (RigId, u32, String);

/// The cache. Clones share it.
#[derive(Debug, Clone)]
pub struct Models {
    store: Store,
    compute: Compute,
    cache: Arc<Mutex<Cache>>,
}

#[derive(Debug)]
struct Cache {
    capacity: usize,
    /// Counter of uses.
    clock: u64,
    entries: HashMap<Key, Entry>,
    degraded: HashMap<(RigId, u32), String>,
}

#[derive(Debug)]
struct Entry {
    used: u64,
    /// Filled by the first request; the others wait for it.
    model: Arc<OnceCell<Arc<LoadedModel>>>,
}

impl Models {
    /// A cache of at most `capacity` models (at least one).
    pub fn new(store: Store, compute: Compute, capacity: usize) -> Self {
        let cache =
            Cache { capacity: capacity.max(1), clock: 0, entries: HashMap::new(), degraded: HashMap::new() };
        Self { store, compute, cache: Arc::new(Mutex::new(cache)) }
    }

    /// The rig's active model or, if that is corrupt, the last intact forward model before it; `None` when no
    /// model is active, or there is no such rig.
    ///
    /// # Errors
    /// See [`ModelError`].
    pub async fn active(&self, rig: &RigId) -> Result<Option<Arc<LoadedModel>>, ModelError> {
        let active = self.store.active_model(rig).await?.and_then(|active| active.version);
        let Some(version) = active else { return Ok(None) };
        match self.version(rig, version).await {
            Err(corruption) if corruption.is_corrupt() => match self.last_good(rig, version).await? {
                Some(good) => {
                    tracing::error!(
                        rig.id = %rig, error = %corruption, model.version = good.version,
                        "the active model is damaged: an earlier version answers"
                    );
                    Ok(Some(good))
                }
                None => Err(corruption),
            },
            found => found,
        }
    }

    async fn last_good(&self, rig: &RigId, before: u32) -> Result<Option<Arc<LoadedModel>>, ModelError> {
        let Some(row) = self.store.rig(rig).await? else { return Ok(None) };
        for model in self.store.models_before(rig, before).await? {
            if model.is_forward(&row)
                && let Ok(Some(good)) = self.version(rig, model.version).await
            {
                return Ok(Some(good));
            }
        }
        Ok(None)
    }

    /// One version; `None` when there is no such one.
    ///
    /// # Errors
    /// See [`ModelError`].
    pub async fn version(&self, rig: &RigId, version: u32) -> Result<Option<Arc<LoadedModel>>, ModelError> {
        let Some(model) = self.store.model(rig, version).await? else { return Ok(None) };
        let slot = self.lock().slot((rig.clone(), version, model.sha256.clone()));
        let loaded = slot.get_or_try_init(|| self.load(&model)).await.cloned();
        let mut cache = self.lock();
        match &loaded {
            Ok(_) => {
                cache.degraded.remove(&(rig.clone(), version));
            }
            // A busy service is no fault of the model.
            Err(ModelError::Compute(ComputeError::Busy(_))) => {}
            Err(error) => {
                cache.degraded.insert((rig.clone(), version), error.to_string());
            }
        }
        loaded.map(Some)
    }

    /// Models in memory.
    pub fn loaded(&self) -> usize {
        self.lock().entries.values().filter(|entry| entry.model.initialized()).count()
    }

    /// Existing models that could not be loaded when they were last needed; runs and diagnoses whose objects
    /// were found corrupt.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn degraded(&self) -> Result<Vec<Degraded>, StoreError> {
        let corrupt = self.store.corrupt_objects().await?;
        let new = |rig: &RigId, reason: &str| Degraded {
            rig: rig.clone(),
            version: None,
            run: None,
            diagnosis: None,
            evaluation: None,
            reason: reason.to_owned(),
        };
        let mut degraded: Vec<Degraded> = self
            .lock()
            .degraded
            .iter()
            .map(|((rig, version), reason)| Degraded { version: Some(*version), ..new(rig, reason) })
            .collect();
        for (rig, of) in corrupt {
            let found = new(&rig, "its object is damaged or missing");
            match of {
                CorruptObject::Run(run) => degraded.push(Degraded { run: Some(run), ..found }),
                CorruptObject::Diagnosis(id) => degraded.push(Degraded { diagnosis: Some(id), ..found }),
                CorruptObject::Evaluation(id) => degraded.push(Degraded { evaluation: Some(id), ..found }),
                CorruptObject::Model(version) => {
                    if !degraded.iter().any(|d| d.rig == rig && d.version == Some(version)) {
                        degraded.push(Degraded { version: Some(version), ..found });
                    }
                }
            }
        }
        degraded.sort_by(|a, b| {
            let place = |d: &Degraded| (d.version, d.run, d.diagnosis, d.evaluation);
            (&a.rig, place(a)).cmp(&(&b.rig, place(b)))
        });
        Ok(degraded)
    }

    /// Forgets a deleted model of a rig, or all models of a deleted rig.
    pub fn forget(&self, rig: &RigId, version: Option<u32>) {
        let mut cache = self.lock();
        let meant = |r: &RigId, v: u32| r == rig && version.is_none_or(|version| version == v);
        cache.entries.retain(|(r, v, _), _| !meant(r, *v));
        cache.degraded.retain(|(r, v), _| !meant(r, *v));
    }

    async fn load(&self, model: &Model) -> Result<Arc<LoadedModel>, ModelError> {
        let bytes = self.store.weights(model).await?;
        let read =
            self.compute.run(Class::Predict, None, move || Predictor::new(from_safetensors(&bytes)?)).await?;
        let (rig, version) = (model.rig.clone(), model.version);
        let read = read.map_err(|source| ModelError::Weights { rig: rig.clone(), version, source })?;
        metrics::counter!(names::MODEL_LOADS).increment(1);
        tracing::info!(rig.id = %rig, model.version = version, "loaded a model");
        let base = model.adoption.as_ref().map(|adoption| adoption.base.clone());
        Ok(Arc::new(LoadedModel { version, sha256: model.sha256.clone(), base, predictor: read }))
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Cache> {
        // Nothing in here panics half-way through a change.
        self.cache.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Cache {
    /// The entry of a model; removes the least recently used one if the cache is full.
    fn slot(&mut self, key: Key) -> Arc<OnceCell<Arc<LoadedModel>>> {
        self.clock += 1;
        let used = self.clock;
        let entry = self.entries.entry(key).or_insert_with(|| Entry { used, model: Arc::default() });
        entry.used = used;
        let slot = Arc::clone(&entry.model);
        if self.entries.len() > self.capacity
            && let Some(oldest) = self.entries.iter().min_by_key(|(_, e)| e.used).map(|(key, _)| key.clone())
        {
            self.entries.remove(&oldest);
        }
        slot
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::compute::ComputeSettings;
    use crate::storage::testing::{TestStore, draft, now};

    fn cache(capacity: usize) -> Cache {
        Cache { capacity, clock: 0, entries: HashMap::new(), degraded: HashMap::new() }
    }

    fn key(version: u32) -> Key {
        ("bench".parse().unwrap(), version, "00".into())
    }

    #[test]
    fn the_model_that_was_used_longest_ago_makes_room() {
        let mut cache = cache(2);
        cache.slot(key(1));
        cache.slot(key(2));
        cache.slot(key(1));
        cache.slot(key(3));
        let mut kept: Vec<u32> = cache.entries.keys().map(|key| key.1).collect();
        kept.sort_unstable();
        assert_eq!(kept, [1, 3]);
    }

    #[tokio::test]
    async fn a_damaged_model_degrades_its_rig_until_it_is_forgotten() {
        let store = TestStore::open().await;
        let compute = Compute::new(&ComputeSettings::default()).unwrap();
        let models = Models::new(store.clone(), compute, 4);
        let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
        assert_eq!(models.active(&rig.id).await.unwrap(), None);
        assert_eq!(models.version(&rig.id, 1).await.unwrap(), None);
        let model = store.import(&rig, b"weights").await;
        let path = store.data_dir().join("objects").join(&model.sha256[..2]).join(&model.sha256);
        std::fs::write(path, b"Weights").unwrap();
        let loaded = models.version(&rig.id, 1).await;
        assert!(matches!(loaded, Err(ModelError::Store(StoreError::ObjectDamaged { .. }))));
        let degraded = models.degraded().await.unwrap();
        assert_eq!((degraded.len(), degraded[0].version), (1, Some(1)));
        models.forget(&rig.id, Some(2));
        assert_eq!(models.degraded().await.unwrap().len(), 1);
        store.delete_model(&rig.id, 1).await.unwrap();
        models.forget(&rig.id, None);
        assert_eq!(models.degraded().await.unwrap(), []);
    }
}
