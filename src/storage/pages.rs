//! Lists of what a rig has, newest first, page by page.

use sqlx::FromRow;
use sqlx::sqlite::SqliteRow;

use super::rigs::rig_in;
use super::rows::all;
use super::{Store, StoreError};
use crate::domain::{Page, PageRequest, RigId};

impl Store {
    /// A page of a rig's rows, newest first; `None` when there is no such rig. `sql` binds the rig, the id that the page
    /// comes after, if there is one, and how many rows to read.
    pub(super) async fn newest<R, T>(
        &self,
        sql: &'static str,
        rig: &RigId,
        page: &PageRequest,
        id: impl Fn(&T) -> String,
    ) -> Result<Option<Page<T>>, StoreError>
    where
        R: for<'r> FromRow<'r, SqliteRow> + Send + Unpin,
        T: TryFrom<R, Error = StoreError>,
    {
        let mut tx = self.reader().begin().await?;
        if rig_in(&mut tx, rig).await?.is_none() {
            return Ok(None);
        }
        let rows: Vec<R> = sqlx::query_as(sql)
            .bind(rig.as_str())
            .bind(page.cursor.as_ref().map(|cursor| cursor.as_str()))
            .bind(i64::from(page.limit) + 1)
            .fetch_all(&mut *tx)
            .await?;
        Ok(Some(Page::cut(all(rows)?, page.limit, id)))
    }
}
