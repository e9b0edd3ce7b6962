//! A service of its own for a test.

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::path::Path;
use std::process::Command;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

use rigcast::app::{App, AppError};
use rigcast::config::Config;
use rigcast::http::Limits;
use rigcast::jobs::WorkerProgram;
use rigcast::storage::{BucketSettings, PostgresSettings, StoreError, StoreSettings};
use serde_json::{Value, json};
use tempfile::TempDir;
use tokio::sync::oneshot;

use super::reply::{Call, Reply};

/// A running service. Dropping it stops the service, and fails a test that leaves jobs unfinished.
pub struct TestApp {
    address: SocketAddr,
    client: reqwest::Client,
    directory: Arc<TempDir>,
    /// Where its registry and objects are, if not in the directory.
    store: StoreSettings,
    /// An admin's token, once there is one; requests send it unless told otherwise.
    token: Option<String>,
    /// Ids of the operations that have answered with success.
    succeeded: Arc<Mutex<BTreeSet<String>>>,
    stop: Option<oneshot::Sender<()>>,
    server: Option<JoinHandle<()>>,
}

impl TestApp {
    /// Starts a service with the default limits on an empty data directory.
    pub fn start() -> Self {
        Self::start_with(Limits::default())
    }

    /// Starts a service with other limits.
    pub fn start_with(limits: Limits) -> Self {
        Self::start_as(move |config| Config { limits, ..config })
    }

    /// Starts a service with settings that differ from the default.
    pub fn start_as(change: impl FnOnce(Config) -> Config) -> Self {
        Self::start_in(Arc::new(TempDir::new().expect("a directory")), shared_store(), change)
    }

    /// Stops the service and starts another one on the same data.
    pub fn restart(mut self) -> Self {
        self.end();
        let mut next = Self::start_in(self.directory.clone(), self.store.clone(), |config| config);
        next.token = self.token.take();
        next
    }

    /// The server has threads of its own, so that a test that waits never starves it.
    fn start_in(
        directory: Arc<TempDir>,
        store: StoreSettings,
        change: impl FnOnce(Config) -> Config,
    ) -> Self {
        let (stop, stopped) = oneshot::channel::<()>();
        let (started, ready) = std::sync::mpsc::channel();
        let listen = ([127, 0, 0, 1], 0).into();
        let mut config = change(Config::new(directory.path().to_owned(), listen));
        config.jobs.program = Some(worker());
        config.store = store.clone();
        let server = std::thread::spawn(move || {
            let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build();
            runtime.expect("a runtime").block_on(async {
                let app = build(&config).await;
                let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("a free port");
                started.send(listener.local_addr().expect("an address")).expect("the test waits");
                app.serve(listener, async {
                    // An error means that the test is gone, which is a reason to stop too.
                    let _ = stopped.await;
                })
                .await;
            });
        });
        let address = ready.recv().expect("the service starts");
        Self {
            address,
            // A redirect is an answer like any other.
            client: reqwest::Client::builder()
                .redirect(reqwest::redirect::Policy::none())
                .build()
                .expect("a client"),
            directory,
            store,
            token: None,
            succeeded: Arc::default(),
            stop: Some(stop),
            server: Some(server),
        }
    }

    /// Its address.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Its data directory.
    pub fn directory(&self) -> &Path {
        self.directory.path()
    }

    /// Operations that have answered with a 2xx.
    pub fn succeeded(&self) -> BTreeSet<String> {
        self.succeeded.lock().expect("no test panics with the lock").clone()
    }

    /// A request; the path may carry a query.
    pub fn call(&self, method: &str, path: &str) -> Call {
        self.call_as(self.token.as_deref(), method, path)
    }

    /// A request with this token, or without any.
    pub fn call_as(&self, token: Option<&str>, method: &str, path: &str) -> Call {
        let url = format!("http://{}{path}", self.address);
        let method: reqwest::Method = method.parse().expect("a method");
        let mut request = self.client.request(method.clone(), url);
        if let Some(token) = token {
            request = request.bearer_auth(token);
        }
        Call::new(request, method, path, self.succeeded.clone())
    }

    /// Makes the first token, an admin's, which all requests send from now on.
    pub async fn close_doors(&mut self) -> Value {
        let token = self.post_json("/v1/tokens", &json!({"role": "admin"})).await.expect(201).json();
        self.token = Some(token["secret"].as_str().expect("a secret").to_owned());
        token
    }

    /// Makes one more token; returns its secret and its id.
    pub async fn token(&self, draft: &Value) -> (String, String) {
        let token = self.post_json("/v1/tokens", draft).await.expect(201).json();
        let text = |key: &str| token[key].as_str().expect(key).to_owned();
        (text("secret"), text("id"))
    }

    /// `GET`
    pub async fn get(&self, path: &str) -> Reply {
        self.call("GET", path).send().await
    }

    /// `DELETE`
    pub async fn delete(&self, path: &str) -> Reply {
        self.call("DELETE", path).send().await
    }

    /// `POST` without a body.
    pub async fn post(&self, path: &str) -> Reply {
        self.call("POST", path).send().await
    }

    /// `POST` of JSON.
    pub async fn post_json(&self, path: &str, body: &Value) -> Reply {
        self.call("POST", path).json(body).send().await
    }

    /// `POST` of a file.
    pub async fn post_file(&self, path: &str, media_type: &str, bytes: impl Into<Vec<u8>>) -> Reply {
        self.call("POST", path).body(media_type, bytes).send().await
    }

    /// Waits until a job has ended, at most a minute; returns it.
    pub async fn finished(&self, job: &str) -> Value {
        for _ in 0..1800 {
            let found = self.get(&format!("/v1/jobs/{job}")).await.expect(200).json();
            if ["succeeded", "failed", "cancelled"].contains(&found["state"].as_str().unwrap_or_default()) {
                return found;
            }
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
        panic!("job {job} did not end within three minutes");
    }

    /// Files under the data directory's scratch and object folders.
    pub fn files(&self) -> Vec<std::path::PathBuf> {
        fn walk(directory: &Path, found: &mut Vec<std::path::PathBuf>) {
            for entry in std::fs::read_dir(directory).into_iter().flatten().flatten() {
                let path = entry.path();
                if path.is_dir() { walk(&path, found) } else { found.push(path) }
            }
        }
        let mut found = Vec::new();
        for folder in ["scratch", "objects"] {
            walk(&self.directory().join(folder), &mut found);
        }
        found
    }

    fn end(&mut self) {
        if let Some(stop) = self.stop.take() {
            // The server may have ended by itself; joining it tells.
            let _ = stop.send(());
        }
        if let Some(server) = self.server.take() {
            server.join().expect("the service ends without a panic");
        }
    }

    /// Jobs in this state, requested on a thread with a runtime of its own.
    fn jobs_in(&self, state: &'static str) -> Vec<Value> {
        let url = format!("http://{}/v1/jobs?state={state}", self.address);
        let request = reqwest::Client::new().get(url);
        let request = match &self.token {
            Some(token) => request.bearer_auth(token),
            None => request,
        };
        let asked = std::thread::spawn(move || {
            let runtime =
                tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
            runtime.block_on(async {
                let reply = request.send().await.expect("the service answers");
                assert!(reply.status().is_success(), "the list of jobs: {}", reply.status());
                reply.json::<Value>().await.expect("a list of jobs")
            })
        });
        asked.join().expect("the list of jobs")["items"].as_array().cloned().unwrap_or_default()
    }
}

/// Builds a service. A lock that was just released may be held a moment longer by a program that another
/// test is starting: between fork and exec it has all open files of this process.
async fn build(config: &Config) -> App {
    for _ in 0..100 {
        match App::build(config).await {
            Err(AppError::Store(StoreError::Locked { .. })) => {
                tokio::time::sleep(Duration::from_millis(20)).await
            }
            built => return built.expect("a service on this directory"),
        }
    }
    panic!("the directory stays locked")
}

/// With `RIGCAST_TEST_DATABASE`, a PostgreSQL in which databases may be made, and `RIGCAST_TEST_STORAGE`, the endpoint of
/// a storage with a bucket `lab`, tests have their registry and objects there. Those that look into the data directory
/// fail then, and those that start the program itself go on as ever.
fn shared_store() -> StoreSettings {
    let (Ok(server), Ok(endpoint)) =
        (std::env::var("RIGCAST_TEST_DATABASE"), std::env::var("RIGCAST_TEST_STORAGE"))
    else {
        return StoreSettings::default();
    };
    static COUNT: AtomicU32 = AtomicU32::new(0);
    let name = format!("api_{}_{}", std::process::id(), COUNT.fetch_add(1, Ordering::Relaxed));
    let made = Command::new("psql").args([&server, "-qc", &format!("CREATE DATABASE {name}")]).status();
    assert!(made.expect("psql is there").success());
    let (place, _) = server.rsplit_once('/').expect("a database");
    StoreSettings {
        bucket: Some(BucketSettings {
            url: format!("s3://lab/{name}"),
            endpoint: Some(endpoint),
            region: None,
            virtual_hosted: false,
            cache_bytes: 1 << 30,
        }),
        database: Some(PostgresSettings { url: format!("{place}/{name}") }),
    }
}

/// Jobs run as in `rigcast serve`: each in a process of the real program.
fn worker() -> WorkerProgram {
    WorkerProgram {
        program: env!("CARGO_BIN_EXE_rigcast").into(),
        arguments: ["job", "--log", "error"].map(Into::into).to_vec(),
        memory_bytes: 4 << 30,
        time_limit: Duration::from_secs(600),
    }
}

impl Drop for TestApp {
    fn drop(&mut self) {
        let mut left = Vec::new();
        if self.server.is_some() && !std::thread::panicking() {
            left = [self.jobs_in("queued"), self.jobs_in("running")].concat();
        }
        if std::thread::panicking() {
            // The test has its failure already; joining could only hide it behind a second one.
            self.stop.take();
            return;
        }
        self.end();
        assert!(left.is_empty(), "the test leaves jobs unfinished: {left:?}");
    }
}
