//! The program as people call it: when it does not do what was asked, it says why in words that help.

use std::net::TcpListener;
use std::path::Path;
use std::process::Stdio;

use tempfile::TempDir;

use crate::support::{Program, rigcast};

/// Runs the program, which must end by itself: its exit status and all that it said.
fn run(arguments: &[&str]) -> (Option<i32>, String) {
    let done = rigcast(arguments).stdout(Stdio::piped()).output().expect("it ends");
    (done.status.code(), String::from_utf8_lossy(&[done.stdout, done.stderr].concat()).into_owned())
}

fn text(path: &Path) -> &str {
    path.to_str().expect("UTF-8")
}

/// Runs the program, which must refuse in these words.
fn refused(arguments: &[&str], words: &[&str]) {
    let (code, said) = run(arguments);
    assert_eq!(code, Some(1), "{arguments:?}: {said}");
    assert!(words.iter().all(|word| said.contains(word)), "{arguments:?}: {said}");
    // One sentence for a person: no Rust, no number of the system alone.
    assert!(!said.contains("Os {") && !said.contains("::"), "{said}");
}

#[test]
fn an_address_that_is_in_use_is_named_and_no_directory_is_left_behind() {
    let directory = TempDir::new().expect("a directory");
    let data = directory.path().join("data");
    let taken = TcpListener::bind("127.0.0.1:0").expect("a free port");
    let address = taken.local_addr().expect("an address").to_string();
    for subcommand in ["serve", "demo"] {
        let arguments = [subcommand, "--listen", &address, "--data-dir", text(&data)];
        refused(&arguments, &[&format!("cannot listen on {address}: another program"), "--listen"]);
        assert!(!data.exists(), "{subcommand}");
    }
    refused(&["serve", "--listen", "192.0.2.1:80", "--data-dir", text(&data)], &["no such address"]);
    refused(&["serve", "--listen", "0.0.0.0:0", "--data-dir", text(&data)], &["rigcast token create"]);
    assert!(!data.exists());
}

#[test]
fn a_data_directory_that_cannot_be_used_is_named_with_the_reason() {
    let directory = TempDir::new().expect("a directory");
    let file = directory.path().join("file");
    std::fs::write(&file, b"x").expect("written");
    let serve = |data: &Path, words: &[&str]| {
        refused(&["serve", "--listen", "127.0.0.1:0", "--data-dir", text(data)], words);
    };
    serve(&file, &[text(&file), "there is a file of that name"]);
    serve(&file.join("below"), &["a part of this path is a file"]);
    let data = TempDir::new().expect("a directory");
    let program = Program::start(&data, &[]);
    serve(data.path(), &["is in use by another rigcast", "--data-dir"]);
    drop(program);
}

#[test]
fn a_restore_or_backup_of_something_else_says_what_it_is_not() {
    let directory = TempDir::new().expect("a directory");
    let (empty, target) = (directory.path().join("empty"), directory.path().join("target"));
    std::fs::create_dir(&empty).expect("a directory");
    refused(&["restore", text(&empty), "--data-dir", text(&target)], &["is no backup", "backup.json"]);
    refused(&["restore", "nowhere", "--data-dir", text(&target)], &["nowhere is no backup"]);
    refused(&["backup", text(&target), "--data-dir", text(&empty)], &["is no data directory", "rigcast.db"]);
    assert!(!target.exists());
}

#[test]
fn health_tells_a_service_that_answers_from_one_that_does_not() {
    let directory = TempDir::new().expect("a directory");
    let program = Program::start(&directory, &[]);
    let address = program.base().strip_prefix("http://").expect("a URL").to_owned();
    assert_eq!(run(&["health", "--listen", &address]), (Some(0), "alive\n".into()));
    let port = address.rsplit(':').next().expect("a port");
    let everywhere = format!("0.0.0.0:{port}");
    let by_variable = rigcast(&["health"]).env("RIGCAST_LISTEN", &everywhere).status().expect("it ends");
    assert!(by_variable.success(), "a container sets the address to listen on, all of them");
    program.signal("-TERM");
    assert_eq!(program.ended().0, Some(0));
    refused(&["health", "--listen", &address], &[&format!("no answer from {address}")]);
    let help = run(&["--help"]).1;
    assert!(help.contains("health"), "{help}");
}

#[test]
fn the_program_tells_its_version() {
    assert_eq!(run(&["--version"]), (Some(0), format!("rigcast {}\n", rigcast::VERSION)));
}
