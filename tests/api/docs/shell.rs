//! Runs the blocks of a page as a new user would.

use std::path::Path;
use std::process::Command;

use super::pages::Page;

/// Address that the pages give for the service.
pub const ADDRESS: &str = "http://127.0.0.1:8080";

/// The `sh` blocks of a section in their order, for the service at `base`; a refusal ends the session.
pub fn blocks(page: &str, section: &str, base: &str) -> Vec<String> {
    let blocks = Page::read(page).blocks().into_iter();
    let blocks = blocks.filter(|block| block.section == section && block.language == "sh");
    let blocks: Vec<String> = blocks
        .map(|block| block.code.replace(ADDRESS, base).replace("curl -sS", "curl --fail-with-body -sS"))
        .collect();
    assert!(!blocks.is_empty(), "{page} has no sh block under {section}");
    blocks
}

/// A tool that the blocks need and that is missing here.
pub fn missing() -> Option<&'static str> {
    let have = |tool: &str| Command::new(tool).arg("--version").output().is_ok();
    ["bash", "curl", "awk", "grep", "sed", "tr"].into_iter().find(|tool| !have(tool))
}

/// Runs a script in a folder, with `rigcast` on the path; gives what it printed.
pub fn run(script: &str, folder: &Path) -> String {
    let program = Path::new(env!("CARGO_BIN_EXE_rigcast")).parent().expect("a directory");
    let path = format!("{}:{}", program.display(), std::env::var("PATH").expect("a path"));
    let mut command = Command::new("bash");
    command.arg("-c").arg(format!("set -euo pipefail\n{script}")).current_dir(folder).env("PATH", path);
    for (name, _) in std::env::vars().filter(|(name, _)| name.starts_with("RIGCAST_")) {
        command.env_remove(name);
    }
    let done = command.output().expect("bash runs");
    let (out, err) = (String::from_utf8_lossy(&done.stdout), String::from_utf8_lossy(&done.stderr));
    assert!(done.status.success(), "{script}\n{out}\n{err}");
    out.into_owned()
}
