//! Lists of what a rig has, newest first, page by page.

use super::database::{FromRow, Sql, sql};
use super::rigs::rig_in;
use super::rows::all;
use super::{Store, StoreError};
use crate::domain::{Page, PageRequest, RigId};

impl Store {
    /// A page of a rig's rows, newest first; `None` when there is no such rig. `select` binds the rig, the id that the page
    /// comes after, if there is one, and how many rows to read.
    pub(super) async fn newest<R, T>(
        &self,
        select: impl Into<Sql>,
        rig: &RigId,
        page: &PageRequest,
        id: impl Fn(&T) -> String,
    ) -> Result<Option<Page<T>>, StoreError>
    where
        R: FromRow,
        T: TryFrom<R, Error = StoreError>,
    {
        let mut tx = self.snapshot().await?;
        if rig_in(&mut tx, rig).await?.is_none() {
            return Ok(None);
        }
        let rows: Vec<R> = sql(select)
            .bind(rig.as_str())
            .bind(page.cursor.as_ref().map(|cursor| cursor.as_str()))
            .bind(i64::from(page.limit) + 1)
            .fetch_all(&mut tx)
            .await?;
        Ok(Some(Page::cut(all(rows)?, page.limit, id)))
    }
}
