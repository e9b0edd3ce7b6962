//! Files that pages load: one style sheet, small scripts. Their path holds the digest of all of them, so that a
//! browser keeps them until the program changes.

use std::sync::LazyLock;

use sha2::{Digest, Sha256};

/// A file that pages load.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Asset {
    /// Its name.
    pub name: &'static str,
    /// Its media type.
    pub media_type: &'static str,
    /// Its content.
    pub content: &'static str,
}

const CSS: &str = "text/css; charset=utf-8";
const SCRIPT: &str = "text/javascript; charset=utf-8";

/// Rules for pages and plots.
pub const STYLE: &str = concat!(
    include_str!("assets/style.css"),
    include_str!("plot/plot.css"),
    include_str!("evaluation/style.css")
);

/// All files.
pub static ASSETS: [Asset; 7] = [
    Asset { name: "style.css", media_type: CSS, content: STYLE },
    Asset { name: "api.js", media_type: SCRIPT, content: include_str!("assets/api.js") },
    Asset { name: "forms.js", media_type: SCRIPT, content: include_str!("assets/forms.js") },
    Asset { name: "figures.js", media_type: SCRIPT, content: include_str!("assets/figures.js") },
    Asset { name: "job.js", media_type: SCRIPT, content: include_str!("assets/job.js") },
    Asset { name: "upload.js", media_type: SCRIPT, content: include_str!("assets/upload.js") },
    Asset { name: "docs.js", media_type: SCRIPT, content: include_str!("assets/docs.js") },
];

static DIGEST: LazyLock<String> = LazyLock::new(|| {
    let mut hash = Sha256::new();
    for asset in &ASSETS {
        hash.update(asset.name);
        hash.update(asset.content);
    }
    hash.finalize().iter().take(8).map(|byte| format!("{byte:02x}")).collect()
});

/// Path of a file.
pub fn path(name: &str) -> String {
    format!("/assets/{}/{name}", *DIGEST)
}

/// The file of this name, if the digest is that of this program.
pub fn find(digest: &str, name: &str) -> Option<&'static Asset> {
    ASSETS.iter().find(|asset| digest == *DIGEST && asset.name == name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_found_under_its_own_path_only() {
        let path = path("style.css");
        let mut parts = path.trim_start_matches("/assets/").split('/');
        let (digest, name) = (parts.next().unwrap(), parts.next().unwrap());
        assert!(find(digest, name).is_some_and(|asset| asset.media_type.starts_with("text/css")));
        assert!(find("0000000000000000", name).is_none() && find(digest, "../style.css").is_none());
    }

    #[test]
    fn files_are_small_and_load_nothing_from_elsewhere() {
        for asset in &ASSETS {
            assert!(asset.content.len() < 20_000, "{}", asset.name);
            assert!(!asset.content.contains("://"), "{}", asset.name);
        }
    }
}
