//! The real program as a process of its own.

use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};
use std::thread::JoinHandle;
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
    /// Reads all the time: a program whose log nobody reads stands still.
    log: Option<JoinHandle<Vec<String>>>,
    base: String,
}

impl Program {
    /// `rigcast serve` on `data_dir` and a free port of loopback, with `environment` set.
    pub fn start(data_dir: &TempDir, environment: &[(&str, &str)]) -> Self {
        Self::listening("127.0.0.1:0", data_dir, environment)
    }

    /// The same at another address.
    pub fn listening(address: &str, data_dir: &TempDir, environment: &[(&str, &str)]) -> Self {
        let directory = data_dir.path().to_str().expect("UTF-8");
        let arguments = ["serve", "--listen", address, "--data-dir", directory];
        let mut child =
            rigcast(&arguments).envs(environment.iter().copied()).spawn().expect("the program starts");
        let mut log = BufReader::new(child.stderr.take().expect("piped")).lines();
        let base = loop {
            let line = log.next().expect("the program says where it listens").expect("text");
            if let Some((_, rest)) = line.split_once("rigcast listens on ") {
                let end = rest.find(['"', ' ']).unwrap_or(rest.len());
                break rest[..end].to_owned();
            }
        };
        let log = std::thread::spawn(move || log.map_while(Result::ok).collect());
        Self { child, log: Some(log), base }
    }

    /// Where it listens, `http://address:port`.
    pub fn base(&self) -> &str {
        &self.base
    }

    /// Its process.
    pub fn id(&self) -> u32 {
        self.child.id()
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
        let log = self.log.take().expect("it ends once").join().expect("reading cannot fail");
        (status.code(), log)
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        // An error means that it has ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
