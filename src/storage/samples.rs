//! Samples of a run, read from its object stretch by stretch. The object is verified before the first of
//! them is read, in one pass that keeps only a piece of it in memory.

use std::fs::File;
use std::io::{self, Read};
use std::ops::Range;
use std::os::unix::fs::FileExt;

use sha2::{Digest as _, Sha256};

use super::files::{self, failed};
use super::objects::off_thread;
use super::{Digest, Store, StoreError, npy};
use crate::domain::Run;
use crate::engine::{Samples, Signal, samples};

/// Bytes that are verified between two looks at whether the caller still waits: some ten milliseconds.
const VERIFIED_AT_ONCE: usize = 16 << 20;

/// Bytes that are read at once.
const READ_AT_ONCE: usize = 256 << 10;

/// Some channels of a run, and a range of their samples, in the verified file of its object. The open file
/// keeps its bytes even if the run is deleted.
#[derive(Debug)]
pub struct StoredSamples {
    file: File,
    /// First byte of the samples.
    start: u64,
    /// Samples of each channel in the file.
    stored: usize,
    sample_rate_hz: f64,
    /// Which of the file's channels these are.
    columns: Vec<usize>,
    range: Range<usize>,
    bytes: Vec<u8>,
}

impl Store {
    /// A range of samples of some channels of a run, whose object is verified first.
    ///
    /// # Errors
    /// The store's failures, a damaged or missing object among them.
    ///
    /// # Panics
    /// If the run has no such channels or samples.
    pub async fn open_samples(
        &self,
        run: &Run,
        columns: Vec<usize>,
        range: Range<usize>,
    ) -> Result<StoredSamples, StoreError> {
        let samples = usize::try_from(run.samples).unwrap_or(usize::MAX);
        assert!(range.end <= samples && columns.iter().all(|c| *c < run.channels.len()));
        let (file, size) = self.verified(&run.object).await?;
        let header = npy::header(samples, run.channels.len());
        let mut found = vec![0; header.len()];
        if npy::size(samples, run.channels.len()) != Some(size)
            || file.read_exact_at(&mut found, 0).is_err()
            || found != header
        {
            let what = "its object has another shape".to_owned();
            return Err(StoreError::Row { table: "runs", key: run.id.to_string(), what });
        }
        let (start, sample_rate_hz) = (header.len() as u64, run.sample_rate_hz);
        Ok(StoredSamples { file, start, stored: samples, sample_rate_hz, columns, range, bytes: Vec::new() })
    }

    /// Some channels of a run as a whole, in memory once.
    ///
    /// # Errors
    /// As [`Store::open_samples`].
    pub async fn load_channels(&self, run: &Run, columns: Vec<usize>) -> Result<Signal, StoreError> {
        self.load_stretch(run, columns, 0..run.samples).await
    }

    /// A range of samples of some channels of a run, in memory once.
    ///
    /// # Errors
    /// As [`Store::open_samples`].
    ///
    /// # Panics
    /// As [`Store::open_samples`].
    pub async fn load_stretch(
        &self,
        run: &Run,
        columns: Vec<usize>,
        range: Range<u64>,
    ) -> Result<Signal, StoreError> {
        let place = |sample: u64| usize::try_from(sample).unwrap_or(usize::MAX);
        let range = place(range.start)..place(range.end);
        let all = 0..range.len();
        let mut stored = self.open_samples(run, columns, range).await?;
        let (key, path) = (run.id.to_string(), self.objects().path_of(&run.object));
        off_thread(move || {
            let channels = samples::block(&mut stored, &all).map_err(failed(&path))?;
            Signal::new(stored.sample_rate_hz, channels).map_err(|error| StoreError::Row {
                table: "runs",
                key,
                what: error.to_string(),
            })
        })
        .await
    }

    /// The file of an object, and its size, once its bytes were found to have their digest. It stops when
    /// its caller goes away.
    async fn verified(&self, digest: &str) -> Result<(File, u64), StoreError> {
        match self.verified_here(digest).await {
            Err(StoreError::ObjectMissing { .. } | StoreError::ObjectDamaged { .. })
                if self.objects().bring(digest).await? =>
            {
                self.verified_here(digest).await
            }
            found => found,
        }
    }

    /// As [`Store::verified`], of the local disk.
    async fn verified_here(&self, digest: &str) -> Result<(File, u64), StoreError> {
        let path = self.objects().path_of(digest);
        let opened = {
            let (path, is_copy) = (path.clone(), self.objects().bucket().is_some());
            off_thread(move || {
                if is_copy {
                    // Only a guess at what will be used again; a missing file is told below.
                    let _ = files::touch(&path);
                }
                Ok(File::open(path))
            })
            .await?
        };
        let mut file = match opened {
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                self.objects().corrupt().note(digest, true);
                return Err(StoreError::ObjectMissing { digest: digest.to_owned() });
            }
            file => file.map_err(failed(&path))?,
        };
        let (mut hash, mut size, mut more) = (Sha256::new(), 0, true);
        while more {
            let here = path.clone();
            (file, hash, size, more) = off_thread(move || {
                let mut piece = vec![0; READ_AT_ONCE];
                for _ in 0..VERIFIED_AT_ONCE / READ_AT_ONCE {
                    let n = file.read(&mut piece).map_err(failed(&here))?;
                    hash.update(&piece[..n]);
                    size += n as u64;
                    if n == 0 {
                        return Ok((file, hash, size, false));
                    }
                }
                Ok((file, hash, size, true))
            })
            .await?;
        }
        let found = Digest::finished(hash);
        self.objects().corrupt().note(digest, found.as_str() != digest);
        if found.as_str() != digest {
            let (digest, found) = (digest.to_owned(), found.as_str().to_owned());
            return Err(StoreError::ObjectDamaged { digest, found });
        }
        Ok((file, size))
    }
}

impl Samples for StoredSamples {
    fn sample_rate_hz(&self) -> f64 {
        self.sample_rate_hz
    }

    fn n_channels(&self) -> usize {
        self.columns.len()
    }

    fn n_samples(&self) -> usize {
        self.range.len()
    }

    fn read(&mut self, channel: usize, samples: Range<usize>, to: &mut Vec<f64>) -> io::Result<()> {
        assert!(samples.end <= self.range.len(), "{samples:?} leaves {:?}", self.range);
        let first = self.columns[channel] * self.stored + self.range.start;
        for from in samples.clone().step_by(READ_AT_ONCE / 8) {
            let n = (samples.end - from).min(READ_AT_ONCE / 8);
            self.bytes.resize(8 * n, 0);
            self.file.read_exact_at(&mut self.bytes, self.start + 8 * (first + from) as u64)?;
            to.extend(self.bytes.as_chunks::<8>().0.iter().map(|bytes| f64::from_le_bytes(*bytes)));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::{TestStore, draft, now};
    use super::*;

    #[tokio::test]
    async fn any_range_of_any_channels_is_what_was_stored_even_after_the_run_is_deleted() {
        let store = TestStore::open().await;
        let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
        // More than is read or verified at once.
        let sent: Vec<f64> = (0..(VERIFIED_AT_ONCE / 8 + 12_345)).map(|i| (i as f64).sin()).collect();
        let run = store.upload(&rig, &sent).await.run;
        let whole = store.load_signal(&run).await.unwrap();
        assert_eq!(store.load_channels(&run, vec![1, 0]).await.unwrap(), whole.select(&[1, 0]));
        for range in [0..sent.len(), 5..6, 70_000..140_001] {
            let mut samples = store.open_samples(&run, vec![1, 0], range.clone()).await.unwrap();
            assert_eq!((samples.n_channels(), samples.n_samples()), (2, range.len()));
            let (mut found, n) = (Vec::new(), range.len());
            for channel in 0..2 {
                samples.read(channel, 0..n / 2, &mut found).unwrap();
                samples.read(channel, n / 2..n, &mut found).unwrap();
            }
            let expected = [&whole.channel(1)[range.clone()], &whole.channel(0)[range]].concat();
            assert!(found == expected, "{n} samples");
        }
        let mut open = store.open_samples(&run, vec![0], 0..3).await.unwrap();
        assert!(store.delete_run(&rig.id, run.id).await.unwrap());
        let mut found = Vec::new();
        open.read(0, 0..3, &mut found).unwrap();
        assert_eq!(found, sent[..3]);
    }

    #[tokio::test]
    async fn a_damaged_or_missing_object_is_found_before_a_sample_is_read() {
        let store = TestStore::open_sqlite().await;
        let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
        let run = store.upload(&rig, &[0.5; 40_000]).await.run;
        let path = store.objects().path_of(&run.object);
        let stored = std::fs::read(&path).unwrap();
        for at in [0, 200, stored.len() - 1] {
            let mut damaged = stored.clone();
            damaged[at] ^= 1;
            std::fs::write(&path, &damaged).unwrap();
            let opened = store.open_samples(&run, vec![0], 0..1).await;
            assert!(matches!(opened, Err(StoreError::ObjectDamaged { .. })), "byte {at}");
            assert_eq!(store.corrupt_objects().await.unwrap().len(), 1);
        }
        std::fs::write(&path, &stored).unwrap();
        store.open_samples(&run, vec![0], 0..1).await.unwrap();
        assert_eq!(store.corrupt_objects().await.unwrap(), []);
        std::fs::remove_file(&path).unwrap();
        let opened = store.open_samples(&run, vec![0], 0..1).await;
        assert!(matches!(opened, Err(StoreError::ObjectMissing { .. })));
    }
}
