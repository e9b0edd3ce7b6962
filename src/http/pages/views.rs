//! Runs that are being looked at: their verified files stay open, and their envelopes in memory, so that a zoom reads
//! only the samples that it shows.

use std::io;
use std::ops::Range;
use std::sync::{Arc, Mutex, PoisonError};

use crate::compute::Class;
use crate::domain::Run;
use crate::engine::envelope::{Blocks, Envelope};
use crate::http::Shared;
use crate::http::problem::{Answer, Problem};
use crate::storage::StoredSamples;

/// Runs that are kept; one of 128 channels takes some 32 MB at most, the usual one of nine two.
const KEPT: usize = 4;

/// A run that is being looked at.
#[derive(Debug)]
pub struct RunWatch {
    samples: Mutex<StoredSamples>,
    blocks: Blocks,
}

/// The runs that were looked at last.
#[derive(Debug, Default)]
pub struct RunViews(Mutex<Vec<(String, Arc<RunWatch>)>>);

impl RunViews {
    fn get(&self, object: &str) -> Option<Arc<RunWatch>> {
        let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let at = kept.iter().position(|(key, _)| key == object)?;
        let found = kept.remove(at);
        let watch = Arc::clone(&found.1);
        kept.push(found);
        Some(watch)
    }

    fn put(&self, object: &str, watch: &Arc<RunWatch>) {
        let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        kept.retain(|(key, _)| key != object);
        if kept.len() >= KEPT {
            kept.remove(0);
        }
        kept.push((object.to_owned(), Arc::clone(watch)));
    }

    /// The run, opened and verified if it was not yet.
    ///
    /// # Errors
    /// The store's failures; a busy service.
    pub async fn open(&self, http: &Shared, run: &Run) -> Answer<Arc<RunWatch>> {
        if let Some(found) = self.get(&run.object) {
            return Ok(found);
        }
        let all = 0..usize::try_from(run.samples).unwrap_or(usize::MAX);
        let mut samples = http.store.open_samples(run, (0..run.channels.len()).collect(), all).await?;
        let class = Class::of_values(
            usize::try_from(run.samples).unwrap_or(usize::MAX).saturating_mul(run.channels.len()),
        );
        let watch = http
            .off_thread(class, move || {
                let blocks = Blocks::of(&mut samples)?;
                Ok::<_, io::Error>(Arc::new(RunWatch { samples: Mutex::new(samples), blocks }))
            })
            .await?
            .map_err(Problem::internal)?;
        self.put(&run.object, &watch);
        Ok(watch)
    }
}

impl RunWatch {
    /// Envelopes of all channels over a range of samples.
    ///
    /// # Errors
    /// Those of the file.
    pub fn envelopes(&self, range: &Range<usize>, columns: usize) -> io::Result<Vec<Envelope>> {
        let mut samples = self.samples.lock().unwrap_or_else(PoisonError::into_inner);
        let channels = crate::engine::Samples::n_channels(&*samples);
        (0..channels)
            .map(|channel| self.blocks.view(&mut *samples, channel, range.clone(), columns))
            .collect()
    }
}
