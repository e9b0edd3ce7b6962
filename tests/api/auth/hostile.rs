//! Hostile names are returned unchanged or refused, and never become paths, log lines or HTML.

use tempfile::TempDir;

use super::names::{NAMES, send_all};
use crate::support::Program;

/// Everything below a directory, as paths relative to it.
fn below(root: &std::path::Path) -> Vec<String> {
    let (mut found, mut open) = (Vec::new(), vec![root.to_owned()]);
    while let Some(directory) = open.pop() {
        for entry in std::fs::read_dir(directory).expect("a directory") {
            let path = entry.expect("an entry").path();
            found.push(path.strip_prefix(root).expect("below").to_str().expect("UTF-8").to_owned());
            if path.is_dir() {
                open.push(path);
            }
        }
    }
    found
}

/// Whether a file of the data directory has a name that the service gives.
fn is_ours(path: &str) -> bool {
    let hex = |text: &str| !text.is_empty() && text.bytes().all(|b| b.is_ascii_hexdigit());
    match path.split('/').collect::<Vec<_>>()[..] {
        [file] => [
            "rigcast.db",
            "rigcast.db-wal",
            "rigcast.db-shm",
            "rigcast.journal",
            "lock",
            "reserve",
            "scratch",
            "objects",
        ]
        .contains(&file),
        ["objects", folder] => hex(folder) && folder.len() == 2,
        ["objects", folder, digest] => digest.starts_with(folder) && hex(digest) && digest.len() == 64,
        _ => false,
    }
}

#[tokio::test]
async fn hostile_names_come_back_as_they_are_and_become_nothing_else() {
    let outside = TempDir::new().expect("a directory");
    let directory = TempDir::new_in(&outside).expect("a directory");
    let program = Program::start(&directory, &[("RIGCAST_LOG", "trace"), ("RIGCAST_LOG_FORMAT", "text")]);
    let (kept, refused) = send_all(program.base()).await;
    println!("{} names: {kept} kept exactly, {refused} refused", NAMES.len());
    assert!(kept >= 2 * NAMES.len(), "people may call things as they like: {kept}");

    let entries: Vec<String> = below(outside.path());
    let inside = directory.path().file_name().and_then(|name| name.to_str()).expect("UTF-8");
    for path in &entries {
        let own = path == inside || path.strip_prefix(&format!("{inside}/")).is_some_and(is_ours);
        assert!(own, "{path} is none of our names");
    }
    assert!(entries.len() > 50, "runs were stored: {}", entries.len());
    program.signal("-TERM");
    let (code, log) = program.ended();
    assert_eq!(code, Some(0));
    assert!(log.len() > 200, "{} lines", log.len());
    for line in &log {
        let begins =
            line.get(..20).is_some_and(|start| start.starts_with("20") && start.as_bytes()[10] == b'T');
        assert!(begins && !line.contains(|c: char| c.is_control()), "{line:?}");
        assert!(!line.starts_with("2026-01-01T00:00:00Z"), "{line:?}");
    }
}
