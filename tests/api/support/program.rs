//! The real program as a process of its own.

use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use tempfile::TempDir;

/// The program with its environment cleared of settings.
pub fn rigcast(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_rigcast"));
    command.args(arguments).stderr(Stdio::piped()).stdout(Stdio::null());
    for (name, _) in std::env::vars().filter(|(name, _)| name.starts_with("RIGCAST_")) {
        command.env_remove(name);
    }
    command
}

/// A started program that is killed if the test fails.
pub struct Program {
    child: Child,
    log: std::io::Lines<BufReader<std::process::ChildStderr>>,
    base: String,
}

impl Program {
    /// `rigcast serve` on `data_dir` and a free port, with `environment` set.
    pub fn start(data_dir: &TempDir, environment: &[(&str, &str)]) -> Self {
        let directory = data_dir.path().to_str().expect("UTF-8");
        let arguments = ["serve", "--listen", "127.0.0.1:0", "--data-dir", directory, "--log-format", "json"];
        let mut child =
            rigcast(&arguments).envs(environment.iter().copied()).spawn().expect("the program starts");
        let mut log = BufReader::new(child.stderr.take().expect("piped")).lines();
        let base = loop {
            let line = log.next().expect("the program says where it listens").expect("text");
            let event: serde_json::Value = serde_json::from_str(&line).expect("a JSON line");
            if let Some(address) = event["http.address"].as_str() {
                break format!("http://{address}");
            }
        };
        Self { child, log, base }
    }

    /// Where it listens, `http://address:port`.
    pub fn base(&self) -> &str {
        &self.base
    }

    /// Sends `-TERM`, say.
    pub fn signal(&self, name: &str) {
        let sent = Command::new("kill").args([name, &self.child.id().to_string()]).status();
        assert!(sent.expect("kill is there").success());
    }

    /// Waits for the end, at most 30 s; gives the log.
    pub fn ended(mut self) -> (Option<i32>, Vec<String>) {
        let started = Instant::now();
        let status = loop {
            if let Some(status) = self.child.try_wait().expect("a child") {
                break status;
            }
            assert!(started.elapsed() < Duration::from_secs(30), "it does not end within 30 s");
            std::thread::sleep(Duration::from_millis(20));
        };
        (status.code(), self.log.by_ref().map_while(Result::ok).collect())
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        // An error means that it has ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
