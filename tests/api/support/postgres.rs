//! A PostgreSQL of a test's own, which `scripts/postgres.sh` starts.

use std::net::SocketAddr;
use std::process::{Command, Output};

/// A running PostgreSQL that ends with the test.
pub struct Postgres {
    url: String,
    directory: String,
}

impl Postgres {
    /// Starts one; `None` where none is installed.
    pub fn start() -> Option<Self> {
        let started = script(&[]);
        if !started.status.success() {
            let said = String::from_utf8_lossy(&started.stderr).into_owned();
            println!("skipped: no PostgreSQL can be started (apt-get install postgresql): {said}");
            return None;
        }
        let said = String::from_utf8(started.stdout).expect("text");
        let mut lines = said.lines().map(str::to_owned);
        let (url, directory) = (lines.next().expect("a URL"), lines.next().expect("a directory"));
        Some(Self { url, directory })
    }

    /// A URL of it with a password, which it does not ask for.
    pub fn url(&self) -> String {
        self.url.replace("rigcast@", "rigcast:hunter3hunter3@")
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        let (_, place) = self.url.split_once('@').expect("a user");
        place.split('/').next().and_then(|place| place.parse().ok()).expect("an address")
    }

    /// The same URL by way of another address.
    pub fn url_by(&self, way: SocketAddr) -> String {
        self.url().replace(&self.address().to_string(), &way.to_string())
    }

    /// The URL of another database of it, which is made.
    pub fn another(&self, name: &str) -> String {
        self.run(&format!("CREATE DATABASE {name}"));
        let url = self.url();
        let (place, _) = url.rsplit_once('/').expect("a database");
        format!("{place}/{name}")
    }

    /// Does a statement; its rows, a line each.
    pub fn run(&self, statement: &str) -> String {
        let done =
            Command::new("psql").args([&self.url, "-Atqc", statement]).output().expect("psql is there");
        assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
        String::from_utf8(done.stdout).expect("text")
    }

    /// Ends it as a crash would, and starts it again.
    pub fn restart(&self) {
        let done = script(&["restart", &self.directory]);
        assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    }
}

impl Drop for Postgres {
    fn drop(&mut self) {
        script(&["stop", &self.directory]);
    }
}

fn script(arguments: &[&str]) -> Output {
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/scripts/postgres.sh");
    Command::new(script).args(arguments).output().expect("bash is there")
}
