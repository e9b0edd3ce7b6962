//! The real program as a process of its own.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};
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

/// What a start of `rigcast serve` on `data_dir` says that is refused, where `change` replaces variables of the environment,
/// or removes those that it leaves empty. No secret of the tests is in it.
pub fn refused_start(data_dir: &Path, environment: &[(&str, &str)], change: &[(&str, &str)]) -> String {
    let kept = environment.iter().filter(|(name, _)| !change.iter().any(|(changed, _)| changed == name));
    let set = kept.chain(change.iter().filter(|(_, value)| !value.is_empty())).copied();
    let mut start = rigcast(&["serve", "--listen", "127.0.0.1:0", "--data-dir"]);
    let done = start.arg(data_dir).envs(set).output().expect("it ends");
    let said = String::from_utf8_lossy(&done.stderr).into_owned();
    assert_eq!(done.status.code(), Some(1), "{said}");
    assert!(!said.contains("hunter"), "{said}");
    said
}

/// `rigcast serve`.
fn serve(address: &str, data_dir: &Path) -> Command {
    rigcast(&["serve", "--listen", address, "--data-dir", data_dir.to_str().expect("UTF-8")])
}

/// State and parent of a process.
fn state(pid: u32) -> Option<(char, u32)> {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    // The name in brackets may hold anything.
    let mut words = stat.rsplit(')').next()?.split_whitespace();
    Some((words.next()?.chars().next()?, words.next()?.parse().ok()?))
}

/// Whether a process is there and not a zombie.
pub fn lives(pid: u32) -> bool {
    state(pid).is_some_and(|(state, _)| state != 'Z')
}

/// Sends `-TERM`, say, to a process.
pub fn signal(name: &str, pid: u32) {
    assert!(try_signal(name, pid), "there is no process {pid}");
}

/// The same; whether the process was there.
pub fn try_signal(name: &str, pid: u32) -> bool {
    let sent = Command::new("kill").args([name, &pid.to_string()]).stderr(Stdio::null()).status();
    sent.expect("kill is there").success()
}

/// A started program that is killed if the test fails.
pub struct Program {
    child: Child,
    log: Arc<Mutex<Vec<String>>>,
    /// Reads all the time: a program blocks when nobody reads its log.
    reader: Option<std::thread::JoinHandle<()>>,
    base: String,
}

impl Program {
    /// `rigcast serve` on `data_dir` and a free port of loopback, with `environment` set.
    pub fn start(data_dir: &TempDir, environment: &[(&str, &str)]) -> Self {
        Self::listening("127.0.0.1:0", data_dir.path(), environment)
    }

    /// The same on any directory.
    pub fn start_on(data_dir: &Path, environment: &[(&str, &str)]) -> Self {
        Self::listening("127.0.0.1:0", data_dir, environment)
    }

    /// The same as a child of another program, which is given its command line.
    pub fn under(tracer: &[&str], data_dir: &Path) -> Self {
        let serve = serve("127.0.0.1:0", data_dir);
        let mut command = Command::new(tracer[0]);
        command.args(&tracer[1..]).arg(serve.get_program()).args(serve.get_args());
        for (name, _) in serve.get_envs() {
            command.env_remove(name);
        }
        Self::started(command.stderr(Stdio::piped()).stdout(Stdio::null()))
    }

    /// The same at another address.
    pub fn listening(address: &str, data_dir: &Path, environment: &[(&str, &str)]) -> Self {
        Self::started(serve(address, data_dir).envs(environment.iter().copied()))
    }

    /// `rigcast work` on `data_dir`.
    pub fn work(address: &str, data_dir: &Path, environment: &[(&str, &str)]) -> Self {
        let mut work = rigcast(&["work", "--listen", address, "--data-dir"]);
        Self::started(work.arg(data_dir).envs(environment.iter().copied()))
    }

    /// The same on a free port and one core.
    pub fn work_on_core(core: usize, data_dir: &Path, environment: &[(&str, &str)]) -> Self {
        let work = rigcast(&["work", "--listen", "127.0.0.1:0", "--data-dir"]);
        let mut command = Command::new("taskset");
        command.args(["-c", &core.to_string()]).arg(work.get_program()).args(work.get_args()).arg(data_dir);
        for (name, _) in work.get_envs() {
            command.env_remove(name);
        }
        let command = command.envs(environment.iter().copied());
        Self::started(command.stderr(Stdio::piped()).stdout(Stdio::null()))
    }

    fn started(command: &mut Command) -> Self {
        let mut child = command.spawn().expect("the program starts");
        let mut log = BufReader::new(child.stderr.take().expect("piped")).lines();
        let mut before = Vec::new();
        let base = loop {
            let line = log.next().expect("the program says where it listens").expect("text");
            let base = line.split_once("rigcast listens on ").map(|(_, rest)| {
                let end = rest.find(['"', ' ']).unwrap_or(rest.len());
                rest[..end].to_owned()
            });
            before.push(line);
            if let Some(base) = base {
                break base;
            }
        };
        // A pipe that nobody reads from would block the program.
        let kept = Arc::new(Mutex::new(before));
        let keep = kept.clone();
        let reader = std::thread::spawn(move || {
            for line in log.map_while(Result::ok) {
                keep.lock().expect("nobody panics with it").push(line);
            }
        });
        Self { child, log: kept, reader: Some(reader), base }
    }

    /// Its process id.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Process ids of its children.
    pub fn children(&self) -> Vec<u32> {
        let processes = std::fs::read_dir("/proc").expect("Linux");
        let ids = processes.flatten().filter_map(|entry| entry.file_name().to_str()?.parse::<u32>().ok());
        ids.filter(|pid| state(*pid).is_some_and(|(_, parent)| parent == self.id())).collect()
    }

    /// Kills it at once, as a power cut would.
    pub fn kill(mut self) {
        self.child.kill().expect("it runs");
        self.child.wait().expect("it ends");
    }

    /// Waits for its end after it was killed.
    pub fn wait(&mut self) {
        self.child.wait().expect("it ends");
    }

    /// Its URL, `http://address:port`.
    pub fn base(&self) -> &str {
        &self.base
    }

    /// A figure of its memory, such as `VmRSS` or `VmHWM`, bytes.
    pub fn memory(&self, what: &str) -> u64 {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.id())).expect("it lives");
        let line = status.lines().find(|line| line.starts_with(what)).expect("Linux says it");
        let kib: u64 = line.split_whitespace().nth(1).and_then(|n| n.parse().ok()).expect("a number");
        kib << 10
    }

    /// Counts the peak `VmHWM` from now on; returns its resident memory.
    pub fn count_peak(&self) -> u64 {
        std::fs::write(format!("/proc/{}/clear_refs", self.id()), "5").expect("Linux");
        self.memory("VmRSS")
    }

    /// Sends `-TERM`, say.
    pub fn signal(&self, name: &str) {
        signal(name, self.id());
    }

    /// Waits for its end, at most 30 s; returns the log.
    pub fn ended(mut self) -> (Option<i32>, Vec<String>) {
        let started = Instant::now();
        let status = loop {
            if let Some(status) = self.child.try_wait().expect("a child") {
                break status;
            }
            assert!(started.elapsed() < Duration::from_secs(30), "it does not end within 30 s");
            std::thread::sleep(Duration::from_millis(20));
        };
        self.reader.take().expect("it is read once").join().expect("it reads to the end");
        (status.code(), std::mem::take(&mut *self.log.lock().expect("nobody panics with it")))
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        // An error means that it has ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
