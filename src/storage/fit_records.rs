//! What fits keep about their data, beside their models.

use super::database::{Session, sql};
use super::rows::json;
use super::{Store, StoreError};
use crate::domain::RigId;
use crate::engine::model::FitRecord;

impl Store {
    /// What the fit of a model version has kept; `None` where there is no such version, or it keeps nothing.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn fit_record(&self, rig: &RigId, version: u32) -> Result<Option<FitRecord>, StoreError> {
        let found: Option<String> = sql("SELECT record FROM fit_records WHERE rig = $1 AND version = $2")
            .bind(rig.as_str())
            .bind(version)
            .fetch_optional(self.reader())
            .await?;
        let read = |text: String| {
            serde_json::from_str(&text).map_err(|error| StoreError::Row {
                table: "fit_records",
                key: format!("{rig}/{version}"),
                what: error.to_string(),
            })
        };
        found.map(read).transpose()
    }
}

/// Adds the record of a model that was just added.
pub(super) async fn insert_record(
    connection: &mut Session,
    rig: &RigId,
    version: u32,
    record: &FitRecord,
) -> Result<(), StoreError> {
    sql("INSERT INTO fit_records (rig, version, record) VALUES ($1, $2, $3)")
        .bind(rig.as_str())
        .bind(version)
        .bind(json(record))
        .execute(connection)
        .await?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::super::testing::{TestStore, draft, imported, now};
    use super::super::{Activation, NewModel};
    use super::*;

    #[tokio::test]
    async fn what_a_fit_has_kept_goes_with_its_model() {
        let store = TestStore::open().await;
        let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
        let record = FitRecord { residual: None, coverage: Vec::new() };
        let new = NewModel { record: Some(record.clone()), ..imported(b"fitted") };
        let model = store.insert_model(&rig.id, new, Activation::Leave, None, now()).await.unwrap().unwrap();
        let bare = store.import(&rig, b"other").await;
        let kept = |version| store.fit_record(&rig.id, version);
        assert_eq!(kept(model.version).await.unwrap(), Some(record));
        assert_eq!(kept(bare.version).await.unwrap(), None);
        store.delete_model(&rig.id, model.version).await.unwrap();
        assert_eq!(kept(model.version).await.unwrap(), None);
    }
}
