//! The program under strace while it receives hostile names: every path that it opens lies in its data
//! directory.
//!
//! Skipped where there is no strace, or no right to trace.

use std::path::Path;
use std::process::Command;

use tempfile::TempDir;

use super::names::{NAMES, send_all};
use crate::support::Program;

/// Paths that the program may open outside its data directory once it listens: the system's files about the
/// process, and those that the runtime opens.
const SYSTEM: &[&str] = &["/proc/self/", "/proc/stat", "/sys/fs/cgroup/", "/dev/urandom", "/etc/localtime"];

/// System calls that open, make, move or remove a path.
const CALLS: &str = "open,openat,openat2,creat,mkdir,mkdirat,rename,renameat,renameat2,link,linkat,symlink,symlinkat,unlink,unlinkat,execve,connect";

/// Paths in a line of strace: quoted texts, relative to the descriptor for calls that take one.
fn paths(line: &str) -> Vec<String> {
    line.split('"').skip(1).step_by(2).map(str::to_owned).collect()
}

/// Whether a path is inside `directory`, or one of the system's.
fn is_allowed(path: &str, directory: &Path) -> bool {
    let inside = path.strip_prefix(directory.to_str().expect("UTF-8"));
    // A `..` inside would lead out of it.
    let climbs = path.split('/').any(|part| part == "..");
    (inside.is_some_and(|rest| rest.is_empty() || rest.starts_with('/')) && !climbs)
        || SYSTEM.iter().any(|known| path.starts_with(known))
}

#[tokio::test]
async fn nothing_is_opened_outside_the_data_directory() {
    let traces = TempDir::new().expect("a directory");
    let trace = traces.path().join("trace");
    let can_trace = Command::new("strace").args(["-o", "/dev/null", "true"]).output();
    if !can_trace.is_ok_and(|done| done.status.success()) {
        println!("skipped: there is no strace, or nothing may be traced");
        return;
    }
    let directory = TempDir::new().expect("a directory");
    let out = trace.to_str().expect("UTF-8");
    let calls = format!("trace={CALLS}");
    let tracer = ["strace", "-f", "-q", "-s", "4096", "-e", &calls, "-o", out];
    let program = Program::under(&tracer, directory.path());
    let before = std::fs::read_to_string(&trace).expect("a trace").lines().count();
    let (kept, refused) = send_all(program.base()).await;
    for traced in program.children() {
        crate::support::signal("-TERM", traced);
    }
    assert_eq!(program.ended().0, Some(0));

    let lines = std::fs::read_to_string(&trace).expect("a trace");
    let (mut seen, mut outside) = (0, Vec::new());
    for line in lines.lines().skip(before) {
        for path in paths(line) {
            seen += 1;
            if !is_allowed(&path, directory.path()) {
                outside.push(line.to_owned());
            }
        }
    }
    println!(
        "{} names kept {kept} times, refused {refused} times: {seen} paths, {} outside the data directory",
        NAMES.len(),
        outside.len()
    );
    assert!(seen > 100, "runs were stored: {seen}");
    assert!(outside.is_empty(), "{}", outside.join("\n"));
}
