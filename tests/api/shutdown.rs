//! The real program: started, stopped, refused.

use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use tempfile::TempDir;

/// The program with its environment cleared of settings.
fn rigcast(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_rigcast"));
    command.args(arguments).stderr(Stdio::piped()).stdout(Stdio::null());
    for (name, _) in std::env::vars().filter(|(name, _)| name.starts_with("RIGCAST_")) {
        command.env_remove(name);
    }
    command
}

/// A started program that is killed if the test fails.
struct Running {
    child: Child,
    log: std::io::Lines<BufReader<std::process::ChildStderr>>,
    base: String,
}

impl Running {
    fn start(data_dir: &TempDir) -> Self {
        let directory = data_dir.path().to_str().expect("UTF-8");
        let arguments = ["serve", "--listen", "127.0.0.1:0", "--data-dir", directory, "--log-format", "json"];
        let mut child = rigcast(&arguments).spawn().expect("the program starts");
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

    fn signal(&self, name: &str) {
        let sent = Command::new("kill").args([name, &self.child.id().to_string()]).status();
        assert!(sent.expect("kill is there").success());
    }

    /// Waits for the end, at most 30 s; gives the log.
    fn ended(mut self) -> (Option<i32>, Vec<String>) {
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

impl Drop for Running {
    fn drop(&mut self) {
        // An error means that it has ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[tokio::test]
async fn sigterm_finishes_the_answer_under_way_and_exits_with_0() {
    for signal in ["-TERM", "-INT"] {
        let directory = TempDir::new().expect("a directory");
        let running = Running::start(&directory);
        let rig = crate::support::bench();
        let client = reqwest::Client::new();
        let created =
            client.post(format!("{}/v1/rigs", running.base)).json(&rig).send().await.expect("an answer");
        assert_eq!(created.status(), 201);
        // A body that is still coming when the signal does.
        let (sender, body) = tokio::sync::mpsc::channel::<Result<Vec<u8>, std::io::Error>>(1);
        sender.send(Ok(b"u,y\n1,2\n".to_vec())).await.expect("room");
        let stream = reqwest::Body::wrap_stream(tokio_stream::wrappers::ReceiverStream::new(body));
        let url = format!("{}/v1/rigs/bench/runs", running.base);
        let upload = client.post(url).header("content-type", "text/csv").body(stream).send();
        let upload = tokio::spawn(upload);
        tokio::time::sleep(Duration::from_millis(300)).await;
        running.signal(signal);
        tokio::time::sleep(Duration::from_millis(300)).await;
        assert!(
            client.get(format!("{}/livez", running.base)).send().await.is_err(),
            "no new connection is taken"
        );
        sender.send(Ok(b"3,4\n".to_vec())).await.expect("room");
        drop(sender);
        let answer = upload.await.expect("no panic").expect("the answer under way is finished");
        assert_eq!(answer.status(), 201);
        drop(client);
        let (code, log) = running.ended();
        assert_eq!(code, Some(0), "{log:?}");
        assert!(log.iter().any(|line| line.contains("stopped")), "{log:?}");
        let line = log.iter().find(|line| line.contains("/v1/rigs/{rig}/runs")).expect("a line a request");
        assert!(!line.contains("3,4"), "no samples in the log");
    }
}

#[test]
fn a_second_program_on_the_same_data_is_refused() {
    let directory = TempDir::new().expect("a directory");
    let running = Running::start(&directory);
    let path = directory.path().to_str().expect("UTF-8");
    let second =
        rigcast(&["serve", "--listen", "127.0.0.1:0", "--data-dir", path]).output().expect("it ends");
    assert_eq!(second.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&second.stderr).contains("in use by another process"), "{second:?}");
    running.signal("-TERM");
    assert_eq!(running.ended().0, Some(0));
}

#[test]
fn a_wider_bind_is_refused_while_there_is_no_authentication() {
    let directory = TempDir::new().expect("a directory");
    let path = directory.path().join("data");
    let path = path.to_str().expect("UTF-8");
    let refused = rigcast(&["serve", "--listen", "0.0.0.0:0", "--data-dir", path]).output().expect("it ends");
    assert_eq!(refused.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&refused.stderr).contains("--allow-unauthenticated"), "{refused:?}");
    assert!(!std::path::Path::new(path).exists(), "nothing was made");
}
