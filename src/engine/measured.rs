//! Measured data for tests, where the shared folder is present. The service's tests take this file in too.

use std::path::{Path, PathBuf};

/// A file or folder of the shared data; where it is absent, says that the test skips it.
pub(crate) fn shared_data(name: &str) -> Option<PathBuf> {
    let package = Path::new(env!("CARGO_MANIFEST_DIR"));
    let root = package.ancestors().find(|folder| folder.join("Cargo.lock").is_file()).unwrap();
    let shared = std::env::var_os("RIGCAST_SHARED").map_or_else(|| root.join("../shared"), PathBuf::from);
    let path = shared.join("data").join(name);
    if path.exists() {
        return Some(path);
    }
    println!("skipped: there is no {}", path.display());
    None
}
