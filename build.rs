//! Gives the program its version: the package's, and the commit that it is built from (`0.1.0+f8d4022c1a2b`).
//!
//! Only optimised builds name the commit. Builds for tests say `0.1.0+debug`, so that a commit does not compile
//! everything again for them.

use std::path::{Path, PathBuf};
use std::process::Command;

/// What the program is made of: a change elsewhere leaves it as it was.
const SOURCES: [&str; 6] = ["build.rs", "Cargo.lock", "Cargo.toml", "migrations", "openapi.yaml", "src"];

/// Names the commit where the sources come without their repository, as in a container.
const OVERRIDE: &str = "RIGCAST_COMMIT";

fn main() {
    let variable = |name: &str| std::env::var(name).unwrap_or_default();
    let root = PathBuf::from(variable("CARGO_MANIFEST_DIR"));
    println!("cargo::rerun-if-changed=build.rs");
    let build = if variable("PROFILE") == "release" {
        println!("cargo::rerun-if-env-changed={OVERRIDE}");
        for path in watched(&root) {
            println!("cargo::rerun-if-changed={}", path.display());
        }
        named(&variable(OVERRIDE)).or_else(|| commit(&root))
    } else {
        Some("debug".to_owned())
    };
    let version = match build {
        Some(build) => format!("{}+{build}", variable("CARGO_PKG_VERSION")),
        None => variable("CARGO_PKG_VERSION"),
    };
    println!("cargo::rustc-env=RIGCAST_VERSION={version}");
}

/// The commit that was given, if it can stand in a version (SemVer 2.0, item 10).
pub(crate) fn named(commit: &str) -> Option<String> {
    let plain = commit.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'-' || b == b'.');
    (plain && !commit.is_empty() && commit.len() <= 64).then(|| commit.to_owned())
}

/// The commit of the repository whose root `root` is, with `-dirty` if the program's sources differ from it.
/// `None` without a repository, without a commit and without git.
pub(crate) fn commit(root: &Path) -> Option<String> {
    let top = PathBuf::from(git(root, &["rev-parse", "--show-toplevel"])?);
    // Sources that lie inside another project's repository are none of its commits.
    if top.canonicalize().ok()? != root.canonicalize().ok()? {
        return None;
    }
    let commit = git(root, &["rev-parse", "--short=12", "HEAD"])?;
    let changed = git(root, &[&["status", "--porcelain", "--"], &SOURCES[..]].concat())?;
    Some(if changed.is_empty() { commit } else { format!("{commit}-dirty") })
}

/// The sources, and what changes with the commit. Paths that are missing would compile the program each time.
pub(crate) fn watched(root: &Path) -> Vec<PathBuf> {
    let mut names = vec!["HEAD".to_owned(), "packed-refs".to_owned()];
    names.extend(git(root, &["symbolic-ref", "HEAD"]));
    let of_git = names.iter().filter_map(|name| git(root, &["rev-parse", "--git-path", name]));
    let all = SOURCES.iter().map(|name| root.join(name)).chain(of_git.map(|path| root.join(path)));
    all.filter(|path| path.exists()).collect()
}

/// What git says, trimmed.
fn git(root: &Path, arguments: &[&str]) -> Option<String> {
    let said = Command::new("git").current_dir(root).args(arguments).output().ok()?;
    said.status.success().then(|| String::from_utf8_lossy(&said.stdout).trim().to_owned())
}
