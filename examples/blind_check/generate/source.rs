//! Hashes of the sources that a final round stands for.

use std::fs;
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};

use crate::AnyError;

/// Files that a diagnosis is made of, and those that make the cases.
pub const DIAGNOSIS: &str = "src/engine/diagnosis";
pub const GENERATOR: &str = "examples/blind_check/generate";

/// SHA-256 over the names and bytes of all files below a folder of the repository, in the order of their names.
///
/// # Errors
/// A folder that cannot be read.
pub fn hash(folder: &str) -> Result<String, AnyError> {
    hash_below(&Path::new(env!("CARGO_MANIFEST_DIR")).join(folder))
}

fn hash_below(root: &Path) -> Result<String, AnyError> {
    let mut files = Vec::new();
    collect(root, &mut files)?;
    files.sort();
    let mut hash = Sha256::new();
    for file in files {
        let name = file.strip_prefix(root)?.to_string_lossy().into_owned();
        let bytes = fs::read(&file)?;
        // Lengths keep a name from running into what follows.
        for part in [name.as_bytes(), bytes.as_slice()] {
            hash.update((part.len() as u64).to_le_bytes());
            hash.update(part);
        }
    }
    Ok(hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect())
}

fn collect(folder: &Path, files: &mut Vec<PathBuf>) -> Result<(), AnyError> {
    for entry in fs::read_dir(folder).map_err(|e| format!("{}: {e}", folder.display()))? {
        let path = entry?.path();
        if path.is_dir() {
            collect(&path, files)?;
        } else {
            files.push(path);
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hash_follows_names_and_bytes_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, bytes: &str| fs::write(folder.path().join(name), bytes).unwrap();
        fs::create_dir(folder.path().join("below")).unwrap();
        write("a.rs", "one");
        write("below/b.rs", "two");
        let first = hash_below(folder.path()).unwrap();
        assert_eq!(first.len(), 64);
        assert_eq!(first, hash_below(folder.path()).unwrap());
        write("below/b.rs", "three");
        let changed = hash_below(folder.path()).unwrap();
        assert_ne!(first, changed);
        write("below/b.rs", "two");
        fs::rename(folder.path().join("a.rs"), folder.path().join("c.rs")).unwrap();
        assert_ne!(first, hash_below(folder.path()).unwrap());
    }
}
