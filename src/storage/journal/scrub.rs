//! While the service runs: the rows against the journal again, now and then and whenever one cannot be read.

use super::check::mend;
use super::{file, schema};
use crate::storage::objects::off_thread;
use crate::storage::{Store, StoreError};

impl Store {
    /// Notes that a row could not be read.
    pub fn doubt_rows(&self) {
        if let Some(journal) = self.journal() {
            journal.doubt.notify_one();
        }
    }

    /// Returns once a row could not be read.
    pub async fn rows_in_doubt(&self) {
        match self.journal() {
            Some(journal) => journal.doubt.notified().await,
            None => std::future::pending().await,
        }
    }

    /// Compares all rows with the journal, and mends those that are not as they were written. Writes wait
    /// meanwhile. Returns the number of mended rows.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn mend_rows(&self) -> Result<usize, StoreError> {
        let Some(journal) = self.journal() else { return Ok(0) };
        // In the order of every write: the journal's lock first, then the writer.
        let state = journal.state.lock().await;
        let journal_path = state.path.clone();
        let path = journal_path.clone();
        let contents = off_thread(move || file::outline(&path)).await?;
        let Some(contents) = contents.filter(|contents| contents.damaged == 0) else {
            tracing::warn!(
                "the journal is damaged or gone, so rows are not held against it; a start tells more"
            );
            return Ok(0);
        };
        let mut writer = journal.writer.acquire().await?;
        // Lines of another schema have other columns; the next start writes the journal anew.
        let schema = schema(&mut writer).await?;
        if contents.header.as_ref().is_none_or(|header| header.schema != schema) {
            return Ok(0);
        }
        mend(&mut writer, &contents, &journal_path).await
    }
}
