//! The client that openapi-python-client generates from `openapi.yaml`, used against the service.

use std::path::{Path, PathBuf};
use std::process::Command;

use crate::support::{Contract, TestApp};

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// The environment of Python with the generator; nothing where it is not installed.
fn environment() -> Option<PathBuf> {
    let Some(folder) = std::env::var_os("RIGCAST_CLIENT").filter(|path| !path.is_empty()) else {
        println!("skipped: RIGCAST_CLIENT names no environment of Python (scripts/python_env.sh client)");
        return None;
    };
    Some(folder.into())
}

/// Generates the client into a folder, as `docs/clients.md` says; gives what the generator printed.
fn generate(environment: &Path, folder: &Path) -> String {
    let mut command = Command::new(environment.join("bin/openapi-python-client"));
    command.arg("generate").arg("--path").arg(root().join("openapi.yaml"));
    command.arg("--config").arg(root().join("scripts/client.yaml")).arg("--output-path").arg(folder);
    let output = command.output().expect("the generator runs");
    let text =
        String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{text}");
    text
}

/// Names of the modules of the client's operations.
fn modules(folder: &Path) -> Vec<String> {
    let groups = std::fs::read_dir(folder.join("rigcast_client/api")).expect("the client's operations");
    let groups = groups.map(|group| group.expect("an entry").path()).filter(|path| path.is_dir());
    let files = groups.flat_map(|group| std::fs::read_dir(group).expect("a folder"));
    let names = files.filter_map(|file| {
        let name = file.expect("an entry").file_name().into_string().expect("UTF-8");
        name.strip_suffix(".py").filter(|name| *name != "__init__").map(str::to_owned)
    });
    names.collect()
}

#[test]
fn the_generated_client_has_every_operation_and_works_against_the_service() {
    let Some(environment) = environment() else { return };
    let directory = tempfile::tempdir().expect("a directory");
    let folder = directory.path().join("client");
    let printed = generate(&environment, &folder);
    let found = modules(&folder).len();
    let operations = Contract::get().operations().len();
    assert_eq!(found, operations, "operations that were left out:\n{printed}");

    let app = TestApp::start();
    let base = format!("http://{}", app.address());
    let python = environment.join("bin/python");
    let program = root().join("scripts/generated_client.py");
    let output = Command::new(python).arg(program).arg(&folder).arg(base).output().expect("Python runs");
    let (out, err) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success() && out.trim() == "all answers are right", "{out}\n{err}");
}
