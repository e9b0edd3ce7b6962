//! Services and workers that share a registry on PostgreSQL and objects in a bucket, each a process with a directory of
//! its own as on a machine of its own. Skipped where there is no PostgreSQL, or no storage (`scripts/python_env.sh
//! storage`).

use std::path::Path;
use std::time::{Duration, Instant};

use rigcast::client::Client;
use serde_json::{Value, json};
use tempfile::TempDir;

use crate::support::{
    Postgres, Program, Storage, Way, Weather, bench, noise_csv, refused_start, rigcast, signal,
};

mod clocks;
mod faults;
mod helping;
mod partitions;
mod rolling;

/// The engines that the processes share.
struct Cluster {
    postgres: Postgres,
    storage: Storage,
    way: Option<Way>,
    url: String,
    endpoint: String,
}

impl Cluster {
    fn start() -> Option<Self> {
        let storage = Storage::start()?;
        let postgres = Postgres::start()?;
        let (url, endpoint) = (postgres.url(), storage.endpoint().to_owned());
        Some(Self { postgres, storage, way: None, url, endpoint })
    }

    /// The same with a storage that can fail, and machines whose way to the database can be cut.
    fn start_behind_weather() -> Option<Self> {
        let cluster = Self::start()?;
        let way = Way::to(cluster.storage.address());
        let endpoint = format!("http://{}", way.address());
        Some(Self { way: Some(way), endpoint, ..cluster })
    }

    fn set_weather(&self, weather: Weather) {
        self.way.as_ref().expect("it was asked for").set(weather);
    }

    fn environment(&self) -> Vec<(&str, &str)> {
        let mut environment = self.storage.environment();
        environment.retain(|(name, _)| *name != "RIGCAST_S3_ENDPOINT");
        environment.extend([
            ("RIGCAST_S3_ENDPOINT", self.endpoint.as_str()),
            ("RIGCAST_DATABASE", self.url.as_str()),
            ("RIGCAST_LEASE_S", "3"),
            ("RIGCAST_HEARTBEAT_S", "1"),
            ("RIGCAST_SWEEP_S", "1"),
        ]);
        environment
    }

    fn serve(&self) -> Machine {
        self.machine(Kind::Serve)
    }

    fn work(&self) -> Machine {
        self.machine(Kind::Work)
    }

    /// A worker that has one core.
    fn work_on_core(&self, core: usize) -> Machine {
        let directory = directory();
        let program = Program::work_on_core(core, directory.path(), &self.environment());
        Machine { program, kind: Kind::Work, directory, way: None }
    }

    /// A service that runs no jobs itself, or a worker.
    fn machine(&self, kind: Kind) -> Machine {
        self.machine_with(kind, &[])
    }

    /// The same with more in its environment.
    fn machine_with(&self, kind: Kind, more: &[(&str, &str)]) -> Machine {
        let directory = directory();
        let way = self.way.as_ref().map(|_| Way::to(self.postgres.address()));
        let program = self.program(kind, &directory, "127.0.0.1:0", (way.as_ref(), more));
        Machine { program, kind, directory, way }
    }

    fn program(
        &self,
        kind: Kind,
        directory: &TempDir,
        address: &str,
        (way, more): (Option<&Way>, &[(&str, &str)]),
    ) -> Program {
        let url = way.map(|way| self.postgres.url_by(way.address()));
        let mut environment = self.environment();
        environment.extend(url.as_deref().map(|url| ("RIGCAST_DATABASE", url)));
        environment.extend_from_slice(more);
        match kind {
            Kind::Work => Program::work(address, directory.path(), &environment),
            Kind::Serve => {
                environment.push(("RIGCAST_WORKERS", "0"));
                Program::listening(address, directory.path(), &environment)
            }
        }
    }

    /// Kills a process and starts it again where it was.
    fn kill_and_start(&self, machine: &mut Machine) {
        let address = machine.program.base().trim_start_matches("http://").to_owned();
        signal("-KILL", machine.program.id());
        machine.program.wait();
        let way = machine.way.as_ref();
        machine.program = self.program(machine.kind, &machine.directory, &address, (way, &[]));
    }

    /// What a command of the program on a data directory says, and whether it succeeds.
    fn command(&self, arguments: &[&str], data_dir: &Path, succeeds: bool) -> String {
        let mut command = rigcast(arguments);
        let command = command.arg("--data-dir").arg(data_dir).envs(self.environment());
        let done = command.stdout(std::process::Stdio::piped()).output().expect("it ends");
        let said = [done.stdout, done.stderr].concat();
        let said = String::from_utf8(said).expect("text");
        assert_eq!(done.status.success(), succeeds, "{said}");
        assert!(!said.contains("hunter"), "{said}");
        said
    }

    /// What a start says that is refused.
    fn refused(&self, directory: &Path, change: &[(&str, &str)]) -> String {
        refused_start(directory, &self.environment(), change)
    }
}

fn directory() -> TempDir {
    TempDir::new().expect("a directory")
}

/// What a process does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Serve,
    Work,
}

/// A process and its directory.
struct Machine {
    program: Program,
    kind: Kind,
    directory: TempDir,
    /// Its way to the database.
    way: Option<Way>,
}

impl Machine {
    fn set_way(&self, weather: Weather) {
        self.way.as_ref().expect("it was asked for").set(weather);
    }

    fn client(&self, token: Option<&str>) -> Client {
        Client::new(self.program.base(), token).expect("a client")
    }
}

/// Asks until the answer is as wanted, at most so long.
async fn until(limit: Duration, what: &str, mut asked: impl AsyncFnMut() -> bool) -> Duration {
    let began = Instant::now();
    while !asked().await {
        assert!(began.elapsed() < limit, "{what} takes longer than {limit:?}");
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    began.elapsed()
}

/// An LSTM that trains for a while.
fn long_fit(run: &Value) -> Value {
    let lstm = json!({"blocks": [24], "window_len": 128, "epochs": 15_000, "seeds": [1]});
    json!({"kind": "lstm", "runs": [run["id"]], "lstm": lstm})
}

#[tokio::test(flavor = "multi_thread")]
async fn two_services_and_a_worker_are_one_service() {
    let Some(cluster) = Cluster::start() else { return };
    let (a, b, worker) = (cluster.serve(), cluster.serve(), cluster.work());
    let (at_a, at_b) = (a.client(None), b.client(None));
    at_a.post("/v1/rigs", &bench()).await.expect("a rig");
    assert_eq!(at_b.get("/v1/rigs/bench").await.expect("the same rig")["id"], "bench");
    let csv = noise_csv(6000, 1).into_bytes();
    let run = at_a.upload("bench", &[("kind", "noise")], "text/csv", csv).await.expect("a run");

    // Queued at one, done by the worker, followed at the other, whose stream has the end of the job.
    let fit = at_b.fit("bench", &json!({"kind": "frf", "runs": [run["id"]]})).await.expect("a job");
    let began = Instant::now();
    at_a.wait(&fit, |_| {}).await.expect("a model");
    println!("a fit that was queued at another process ended after {:.1} s", began.elapsed().as_secs_f64());
    let worked = cluster.postgres.run("SELECT count(*) FROM jobs WHERE state = 'succeeded'");
    assert_eq!(worked.trim(), "1");

    // What is active at one is active at the other with the next request.
    let drive = json!({"drive": {"sample_rate_hz": 100.0, "channels": {"u": [0.5, 1.0]}}});
    at_a.activate("bench", 1).await.expect("active");
    let predicted = at_b.post("/v1/rigs/bench/predict", &drive).await.expect("a prediction");
    assert_eq!(predicted["model"]["version"], 1, "{predicted}");
    assert_eq!(at_a.post("/v1/rigs/bench/predict", &drive).await.expect("the same"), predicted);

    // The same key at both at once makes one rig, and both get the same answer.
    for k in 0..10 {
        let draft = Value::Object(
            bench()
                .as_object()
                .into_iter()
                .flatten()
                .map(|(key, value)| {
                    let value = if key == "id" { json!(format!("rig{k}")) } else { value.clone() };
                    (key.clone(), value)
                })
                .collect(),
        );
        let key = format!("key{k}");
        let send = |machine: &Machine| {
            let (base, draft, key) = (machine.program.base().to_owned(), draft.clone(), key.clone());
            async move {
                let sent = reqwest::Client::new().post(format!("{base}/v1/rigs")).json(&draft);
                let answer = sent.header("Idempotency-Key", key).send().await.expect("an answer");
                (answer.status().as_u16(), answer.json::<Value>().await.expect("JSON"))
            }
        };
        let (one, other) = tokio::join!(send(&a), send(&b));
        assert_eq!(one, other);
        assert_eq!(one.0, 201, "{}", one.1);
    }

    // A token that is made at one holds at the other, and is refused there soon after it was revoked.
    let made = at_a.post("/v1/tokens", &json!({"name": "lab", "role": "admin"})).await.expect("a token");
    let admin = made["secret"].as_str().expect("a secret");
    let (admin_a, admin_b) = (a.client(Some(admin)), b.client(Some(admin)));
    until(Duration::from_secs(5), "a new token", async || admin_b.get("/v1/rigs").await.is_ok()).await;
    let second = json!({"name": "second", "role": "reader"});
    let second = admin_b.post("/v1/tokens", &second).await.expect("a token");
    let reader = a.client(second["secret"].as_str());
    until(Duration::from_secs(5), "a new token", async || reader.get("/v1/rigs").await.is_ok()).await;
    admin_b.delete(&format!("/v1/tokens/{}", second["id"].as_str().expect("an id"))).await.expect("revoked");
    let gone =
        until(Duration::from_secs(5), "a revoked token", async || reader.get("/v1/rigs").await.is_err());
    println!(
        "a token that was revoked at another process was refused after {:.1} s",
        gone.await.as_secs_f64()
    );

    // The worker tells monitors how it is, and nobody anything of the rigs.
    let monitor = worker.client(Some(admin));
    assert_eq!(monitor.get("/readyz").await.expect("ready")["bucket"], "ok");
    assert!(monitor.get("/v1/rigs").await.is_err());

    // One is killed: the other goes on.
    a.program.kill();
    assert_eq!(
        admin_b.get("/v1/rigs?limit=100").await.expect("rigs")["items"].as_array().map(Vec::len),
        Some(11)
    );
    drop(admin_a);
    b.program.signal("-TERM");
    let (status, log) = b.program.ended();
    assert_eq!(status, Some(0));
    assert!(!log.join("\n").contains("hunter"), "a secret in the log");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_fit_goes_on_at_another_worker_when_its_own_is_gone() {
    let Some(cluster) = Cluster::start() else { return };
    let service = cluster.serve();
    let client = service.client(None);
    client.post("/v1/rigs", &bench()).await.expect("a rig");
    let csv = noise_csv(6000, 1).into_bytes();
    let run = client.upload("bench", &[("kind", "noise")], "text/csv", csv).await.expect("a run");
    let fit = client.fit("bench", &long_fit(&run)).await.expect("a job");
    let job = format!("/v1/jobs/{fit}");
    let first = cluster.work();
    until(Duration::from_secs(60), "the start of the fit", async || {
        let job = client.get(&job).await.expect("a job");
        assert!(job["finished_at"].is_null(), "{job}");
        job["state"] == "running" && job["progress"].as_f64().is_some_and(|share| share > 0.05)
    })
    .await;
    first.program.kill();
    let second = cluster.work();
    let taken = until(Duration::from_secs(30), "a second start", async || {
        cluster.postgres.run("SELECT lease_token FROM jobs").trim() == "2"
    });
    println!("the job of a worker that was killed went on after {:.1} s", taken.await.as_secs_f64());
    let ended = client.wait(&fit, |_| {}).await.expect("a model");
    assert_eq!(ended["attempt"], 1, "the death of a machine counts no attempt: {ended}");
    let models = client.get("/v1/rigs/bench/models").await.expect("models");
    assert_eq!(models["items"].as_array().map(Vec::len), Some(1));
    drop(second);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_database_that_restarts_loses_nothing_and_is_back_soon() {
    let Some(cluster) = Cluster::start() else { return };
    let service = cluster.serve();
    let client = service.client(None);
    client.post("/v1/rigs", &bench()).await.expect("a rig");
    let mut stored = Vec::new();
    for k in 0..5 {
        let csv = noise_csv(500, k).into_bytes();
        let run = client.upload("bench", &[("kind", "noise")], "text/csv", csv).await.expect("a run");
        stored.push(run["id"].clone());
        cluster.postgres.restart();
        let back = until(Duration::from_secs(10), "the way back", async || {
            client.get("/v1/rigs/bench").await.is_ok()
        });
        println!("back {:.2} s after the database was", back.await.as_secs_f64());
    }
    let runs = client.get("/v1/rigs/bench/runs?limit=100").await.expect("runs");
    let found: Vec<Value> =
        runs["items"].as_array().expect("runs").iter().map(|run| run["id"].clone()).collect();
    assert_eq!(found, stored);
    assert_eq!(client.get("/readyz").await.expect("ready")["status"], "ready");
}

#[test]
fn a_registry_that_cannot_be_used_stops_the_start_with_its_reason() {
    let Some(cluster) = Cluster::start() else { return };
    let first = directory();
    Program::start(&first, &cluster.environment()).kill();
    let other = directory();
    let said = cluster.refused(first.path(), &[("RIGCAST_DATABASE", "")]);
    assert!(said.contains("Start it with that one as --database"), "{said}");
    let said = cluster.refused(first.path(), &[("RIGCAST_DATABASE", ""), ("RIGCAST_OBJECTS", "")]);
    assert!(said.contains("name it with --objects"), "{said}");
    let said = cluster.refused(other.path(), &[("RIGCAST_OBJECTS", "")]);
    assert!(said.contains("name a bucket with --objects"), "{said}");
    let another = cluster.postgres.another("another");
    let said = cluster.refused(other.path(), &[("RIGCAST_DATABASE", &another)]);
    assert!(said.contains("it belongs to another Rigcast"), "{said}");
    for wrong in ["postgres://lab:hunter3@127.0.0.1:1/rigcast", "postgres://lab:hunter3@127.0.0.1:1"] {
        let said = cluster.refused(other.path(), &[("RIGCAST_DATABASE", wrong)]);
        assert!(said.contains("postgres://127.0.0.1:1/") && said.contains("cannot be used"), "{said}");
    }
    for wrong in ["mysql://lab:hunter3@db/rigcast", "lab:hunter3@db", "postgres://lab:hunter3@:x/"] {
        let said = cluster.refused(other.path(), &[("RIGCAST_DATABASE", wrong)]);
        assert!(said.contains("write postgres://user@host:port/database"), "{said}");
    }
    let own = directory();
    Program::start(&own, &[]).kill();
    let said = cluster.refused(own.path(), &[]);
    assert!(said.contains("has a registry of its own"), "{said}");
    cluster.postgres.run(
        "INSERT INTO _sqlx_migrations SELECT 9999, description, installed_on, success, checksum, execution_time
         FROM _sqlx_migrations LIMIT 1",
    );
    let said = cluster.refused(first.path(), &[]);
    assert!(said.contains("newer Rigcast") && said.contains("9999"), "{said}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_registry_moves_from_a_directory_and_back_and_is_backed_up_on_the_way() {
    let Some(cluster) = Cluster::start() else { return };
    let (own, back, copies) = (directory(), directory(), directory());
    let program = Program::start(&own, &[]);
    let client = Client::new(program.base(), None).expect("a client");
    client.post("/v1/rigs", &bench()).await.expect("a rig");
    let csv = noise_csv(6000, 1).into_bytes();
    let run = client.upload("bench", &[("kind", "noise")], "text/csv", csv).await.expect("a run");
    let fit = client.fit("bench", &json!({"kind": "frf", "runs": [run["id"]]})).await.expect("a job");
    client.wait(&fit, |_| {}).await.expect("a model");
    let drive = json!({"model": 1, "drive": {"sample_rate_hz": 100.0, "channels": {"u": [0.5, 1.0]}}});
    let predicted = client.post("/v1/rigs/bench/predict", &drive).await.expect("a prediction");
    let run = format!("/v1/rigs/bench/runs/{}", run["id"].as_str().expect("an id"));
    let described = client.get(&run).await.expect("a run");
    let refused = cluster.command(&["move"], own.path(), false);
    assert!(refused.contains("is in use by another rigcast"), "{refused}");
    program.signal("-TERM");
    program.ended();
    let said = cluster.command(&["move"], own.path(), true);
    assert!(said.contains("and s3://lab/one its 2 objects"), "{said}");

    let service = cluster.serve();
    let client = service.client(None);
    assert_eq!(client.get(&run).await.expect("the run"), described);
    assert_eq!(client.post("/v1/rigs/bench/predict", &drive).await.expect("the same"), predicted);
    let csv = noise_csv(500, 2).into_bytes();
    client.upload("bench", &[("kind", "noise")], "text/csv", csv).await.expect("a run");
    let runs = client.get("/v1/rigs/bench/runs").await.expect("runs");

    // A backup beside the running service; a data directory only once it has stopped.
    let backup = copies.path().join("backup");
    let said = cluster.command(&["backup", backup.to_str().expect("UTF-8")], own.path(), true);
    assert!(said.contains("backed up 3 objects"), "{said}");
    let refused = cluster.command(&["move", "--back"], back.path(), false);
    assert!(refused.contains("stop them first"), "{refused}");
    service.program.signal("-TERM");
    service.program.ended();
    let said = cluster.command(&["move", "--back"], back.path(), true);
    assert!(said.contains("its 3 objects"), "{said}");
    let restored = copies.path().join("restored");
    let done = rigcast(&["restore", backup.to_str().expect("UTF-8"), "--data-dir"]).arg(&restored).output();
    assert!(done.expect("it ends").status.success());
    for directory in [back.path(), &restored] {
        let program = Program::start_on(directory, &[]);
        let client = Client::new(program.base(), None).expect("a client");
        assert_eq!(client.get("/v1/rigs/bench/runs").await.expect("runs"), runs);
        assert_eq!(client.post("/v1/rigs/bench/predict", &drive).await.expect("the same"), predicted);
        program.kill();
    }
}

#[test]
fn a_token_is_made_beside_running_services() {
    let Some(cluster) = Cluster::start() else { return };
    let service = cluster.serve();
    let arguments = ["token", "create", "--name", "lab", "--role", "admin"];
    let made = rigcast(&arguments).envs(cluster.environment()).output().expect("it ends");
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let runtime = tokio::runtime::Runtime::new().expect("a runtime");
    runtime.block_on(async {
        let client = service.client(None);
        until(Duration::from_secs(5), "a new token", async || client.get("/v1/rigs").await.is_err()).await;
    });
}
