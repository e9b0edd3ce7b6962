//! Copies objects from one directory of objects to another, several at once.

use std::collections::BTreeSet;
use std::io::Write;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use rayon::prelude::*;
use tokio::runtime::Handle;

use crate::storage::bucket::Bucket;
use crate::storage::files::{self, failed};
use crate::storage::objects::{off_thread, place};
use crate::storage::{Digest, StoreError};

/// Is told how many objects are done, and of how many. Called from several threads.
pub type Progress = Arc<dyn Fn(u64, u64) + Send + Sync>;

/// Copies objects and returns their size in bytes. Each is verified when it is read, and all are durable when this
/// returns. What `from` lacks, or has damaged, comes from the bucket. Those that `to` has already are only verified.
pub(super) async fn copy_objects(
    from: &Path,
    bucket: Option<&Bucket>,
    previous: Option<&Path>,
    to: &Path,
    wanted: &BTreeSet<String>,
    progress: &Progress,
) -> Result<u64, StoreError> {
    let (from, previous, to) = (from.to_owned(), previous.map(Path::to_owned), to.to_owned());
    let (wanted, progress) = (wanted.clone(), Arc::clone(progress));
    let bucket = bucket.map(|bucket| (bucket.clone(), Handle::current()));
    off_thread(move || {
        let (done, all) = (AtomicU64::new(0), wanted.len() as u64);
        let sizes = wanted.par_iter().map(|name| {
            let bytes = copy(&from, bucket.as_ref(), previous.as_deref(), &to, name)?;
            progress(done.fetch_add(1, Ordering::Relaxed) + 1, all);
            Ok(bytes)
        });
        let bytes = sizes.sum::<Result<u64, StoreError>>()?;
        // One sync of the file system instead of two for each object.
        let directory = std::fs::File::open(&to).map_err(failed(&to))?;
        rustix::fs::syncfs(&directory).map_err(|error| failed(&to)(error.into()))?;
        Ok(bytes)
    })
    .await
}

/// Brings one object over. Returns its size.
fn copy(
    from: &Path,
    bucket: Option<&(Bucket, Handle)>,
    previous: Option<&Path>,
    to: &Path,
    name: &str,
) -> Result<u64, StoreError> {
    let target = place(to, name);
    if let Some(bytes) = intact(&target, name)? {
        return Ok(bytes.len() as u64);
    }
    let folder = target.parent().unwrap_or(to);
    std::fs::create_dir_all(folder).map_err(failed(folder))?;
    if let Some(earlier) = previous.map(|previous| place(previous, name))
        && let Some(bytes) = intact(&earlier, name)?
    {
        files::remove(&target)?;
        if std::fs::hard_link(&earlier, &target).is_ok() {
            return Ok(bytes.len() as u64);
        }
    }
    let path = place(from, name);
    if let Some((bucket, runtime)) = bucket
        && !matches!(intact(&path, name), Ok(Some(_)))
    {
        let file = runtime.block_on(bucket.fetch(name, to))?;
        let size = file.size();
        file.persist(&target)?;
        return Ok(size);
    }
    let bytes = match std::fs::read(&path) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
            return Err(StoreError::ObjectMissing { digest: name.to_owned() });
        }
        read => read.map_err(failed(&path))?,
    };
    let found = Digest::of(&bytes);
    if found.as_str() != name {
        let (digest, found) = (name.to_owned(), found.as_str().to_owned());
        return Err(StoreError::ObjectDamaged { digest, found });
    }
    let mut file = tempfile::NamedTempFile::new_in(folder).map_err(failed(folder))?;
    file.write_all(&bytes).map_err(failed(&target))?;
    file.persist(&target).map_err(|error| failed(&target)(error.error))?;
    Ok(bytes.len() as u64)
}

/// The bytes of an object if it is there and whole.
fn intact(path: &Path, name: &str) -> Result<Option<Vec<u8>>, StoreError> {
    match std::fs::read(path) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(None),
        read => {
            let bytes = read.map_err(failed(path))?;
            Ok((Digest::of(&bytes).as_str() == name).then_some(bytes))
        }
    }
}
