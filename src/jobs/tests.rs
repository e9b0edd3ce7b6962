//! The runner on a real store, with fits made for tests.

use std::collections::BTreeMap;

use futures::StreamExt;
use jiff::Timestamp;
use realfft::num_complex::Complex64;

use super::*;
use crate::compute::ComputeSettings;
use crate::domain::fits::Activate;
use crate::domain::{JobState, Model};
use crate::engine::checkpoint::CheckpointStore;
use crate::engine::frf::Frf;
use crate::engine::model::{FitData, FitRecord, FitSettings, Fitted, ModelKind, RigModel};
use crate::engine::progress::report;
use crate::engine::{EngineError, Watch};
use crate::storage::testing::{TestStore, draft, meta, now};
use crate::storage::{JobQuery, RigUpdate};

/// A store with one rig and one run of 20 s, `y = 2 u`, and a runner.
struct Bench {
    store: TestStore,
    rig: Rig,
    jobs: Jobs,
}

impl Bench {
    async fn new(fit: FitFunction) -> Self {
        let store = TestStore::open().await;
        let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
        store.upload(&rig, &noise(1, 2000)).await;
        let jobs = start(&store, fit).await;
        Self { store, rig, jobs }
    }

    async fn fit(&self, request: serde_json::Value) -> JobId {
        let request = serde_json::from_value(request).unwrap();
        self.jobs.submit_fit(&self.rig, &request, None, None).await.unwrap().id
    }

    /// The job's last state.
    async fn end_of(&self, id: JobId) -> Job {
        let snapshots: Vec<Job> = self.jobs.subscribe(id, None).await.unwrap().unwrap().collect().await;
        snapshots.into_iter().last().unwrap()
    }

    async fn once(&self, id: JobId, state: JobState) {
        while self.store.job(id).await.unwrap().unwrap().state != state {
            tokio::time::sleep(Duration::from_millis(2)).await;
        }
    }

    /// Fits an FRF that is a plain gain, and waits for its end.
    async fn fit_gain(&self, gain: f64, activate: Activate) -> (Job, Model) {
        let request = serde_json::json!({"kind": "frf", "frf": {"ridge": gain / 10.0}, "activate": activate});
        let job = self.end_of(self.fit(request).await).await;
        let version = job.result.as_ref().expect("a model").id.parse().unwrap();
        let model = self.store.model(&self.rig.id, version).await.unwrap().unwrap();
        (job, model)
    }
}

pub(super) async fn start(store: &TestStore, fit: FitFunction) -> Jobs {
    let settings = JobSettings {
        sweep: Duration::from_millis(20),
        progress_every: Duration::from_millis(2),
        ..JobSettings::default()
    };
    let small = ComputeSettings { fit_threads: 1, predict_threads: 1, ..ComputeSettings::default() };
    let compute = Compute::new(&small).unwrap();
    Jobs::start_with((**store).clone(), compute, now, settings, fit).await.unwrap()
}

/// Pseudo-random samples, the same every time (a 32-bit linear congruential generator).
pub(super) fn noise(seed: u32, n: usize) -> Vec<f64> {
    let mut state = seed;
    (0..n)
        .map(|_| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            f64::from(state) / f64::from(u32::MAX) - 0.5
        })
        .collect()
}

/// "Fits" an FRF whose gain is ten times the ridge of the settings, which must be one at most.
fn gain(
    data: &FitData,
    settings: &FitSettings,
    _: &dyn CheckpointStore,
    watch: Watch<'_>,
) -> Result<Fitted, EngineError> {
    report(watch, "FRF", 0.5)?;
    let frf = Frf {
        sample_rate_hz: 100.0,
        segment_len: 64,
        n_inputs: 1,
        n_outputs: 1,
        h: vec![Complex64::new(10.0 * settings.frf.ridge.unwrap(), 0.0); 33],
        usable_hz: [0.0, 50.0],
        x_mean: vec![0.0],
        y_mean: vec![0.0],
    };
    let model = RigModel {
        kind: ModelKind::Frf,
        inputs: settings.inputs.clone(),
        outputs: settings.outputs.clone(),
        sample_rate_hz: data.training[0].x.sample_rate_hz(),
        preprocess: settings.preprocess,
        frf: Some(frf),
        frf_quality: None,
        core: Vec::new(),
        lstm: None,
        joint_range: None,
        window_range: Vec::new(),
        range: Vec::new(),
        band: None,
        effects: Vec::new(),
    };
    let report = serde_json::json!({
        "preprocess": {}, "validation_rms": [0.5], "training_s": 18.0, "validation_s": 2.0, "warnings": []
    });
    let record = FitRecord { residual: None, coverage: Vec::new() };
    Ok(Fitted { model, report: serde_json::from_value(report).unwrap(), record })
}

fn fails(_: &FitData, _: &FitSettings, _: &dyn CheckpointStore, _: Watch<'_>) -> Result<Fitted, EngineError> {
    Err(EngineError::DeadChannel { what: "training outputs", channel: 0 })
}

fn panics(
    _: &FitData,
    _: &FitSettings,
    _: &dyn CheckpointStore,
    _: Watch<'_>,
) -> Result<Fitted, EngineError> {
    panic!("a defect")
}

/// A fit that goes on until it is told to stop.
fn endless(
    _: &FitData,
    _: &FitSettings,
    _: &dyn CheckpointStore,
    watch: Watch<'_>,
) -> Result<Fitted, EngineError> {
    for i in 0.. {
        report(watch, "LSTM", 1.0 - 0.9_f64.powi(i))?;
        std::thread::sleep(Duration::from_millis(1));
    }
    unreachable!("the loop has no end")
}

#[tokio::test]
async fn a_failed_fit_keeps_its_reason_and_names_the_channel() {
    let bench = Bench::new(fails).await;
    let job = bench.end_of(bench.fit(serde_json::json!({"kind": "frf"})).await).await;
    assert_eq!((job.state, job.attempt), (JobState::Failed, 1));
    let problem = job.problem.unwrap();
    assert_eq!((problem.code.as_str(), problem.status), ("signal.dead_channel", 422));
    assert_eq!(problem.errors[0].channel.as_deref(), Some("y"));
}

#[tokio::test]
async fn a_panic_fails_the_job_and_not_the_runner() {
    let bench = Bench::new(panics).await;
    for _ in 0..2 {
        let job = bench.end_of(bench.fit(serde_json::json!({"kind": "frf"})).await).await;
        assert_eq!((job.state, job.problem.unwrap().code.as_str()), (JobState::Failed, "job.panicked"));
    }
}

#[tokio::test]
async fn damaged_samples_fail_the_job() {
    let bench = Bench::new(fails).await;
    let run = bench.store.upload(&bench.rig, &noise(2, 500)).await.run;
    let path = bench.store.data_dir().join("objects").join(&run.object[..2]).join(&run.object);
    let mut bytes = std::fs::read(&path).unwrap();
    *bytes.last_mut().unwrap() ^= 1;
    std::fs::write(&path, bytes).unwrap();
    let job = bench.end_of(bench.fit(serde_json::json!({"kind": "frf", "runs": [run.id]})).await).await;
    assert_eq!((job.state, job.problem.unwrap().code.as_str()), (JobState::Failed, "store.damaged"));
}

#[tokio::test]
async fn a_running_job_is_cancelled_and_a_cancel_twice_is_one() {
    let bench = Bench::new(endless).await;
    let id = bench.fit(serde_json::json!({"kind": "frf"})).await;
    bench.once(id, JobState::Running).await;
    assert!(matches!(bench.jobs.cancel(id).await, Ok(CancelOutcome::Noted(_))));
    let job = bench.end_of(id).await;
    assert_eq!((job.state, &job.problem, &job.result), (JobState::Cancelled, &None, &None));
    assert_eq!(bench.jobs.cancel(id).await.unwrap(), CancelOutcome::Noted(Box::new(job)));
}

#[tokio::test]
async fn a_wish_to_cancel_that_another_process_wrote_is_seen() {
    let bench = Bench::new(endless).await;
    let id = bench.fit(serde_json::json!({"kind": "frf"})).await;
    bench.once(id, JobState::Running).await;
    bench.store.request_cancel(id, now()).await.unwrap();
    assert_eq!(bench.end_of(id).await.state, JobState::Cancelled);
}

#[tokio::test]
async fn work_for_a_deleted_rig_stops() {
    let bench = Bench::new(endless).await;
    let id = bench.fit(serde_json::json!({"kind": "frf"})).await;
    bench.once(id, JobState::Running).await;
    bench.store.delete_rig(&bench.rig.id).await.unwrap();
    // The one worker is free again.
    bench.store.insert_rig(&draft("bench"), None, now()).await.unwrap();
    bench.store.upload(&bench.rig, &noise(1, 2000)).await;
    let next = bench.fit(serde_json::json!({"kind": "frf"})).await;
    bench.once(next, JobState::Running).await;
    assert_eq!(bench.store.job(id).await.unwrap(), None);
    // The endless fit must not outlive the test.
    bench.jobs.shutdown().await;
}

#[tokio::test]
async fn a_shutdown_queues_the_work_at_hand_again_and_the_next_start_does_it() {
    let bench = Bench::new(endless).await;
    let first = bench.fit(serde_json::json!({"kind": "frf"})).await;
    let second = bench.fit(serde_json::json!({"kind": "frf"})).await;
    bench.once(first, JobState::Running).await;
    let follower = bench.jobs.subscribe(first, None).await.unwrap().unwrap();
    bench.jobs.shutdown().await;
    let seen: Vec<Job> = follower.collect().await;
    assert!(seen.iter().all(|job| !job.state.is_terminal()), "the stream ends, the job does not");
    for id in [first, second] {
        let job = bench.store.job(id).await.unwrap().unwrap();
        assert_eq!((job.state, job.attempt), (JobState::Queued, 0));
    }
    let again = Bench { jobs: start(&bench.store, fails).await, store: bench.store, rig: bench.rig };
    for id in [first, second] {
        assert_eq!(again.end_of(id).await.state, JobState::Failed);
    }
}

#[tokio::test]
async fn a_job_that_was_running_when_its_process_died_starts_again() {
    let store = TestStore::open().await;
    let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
    store.upload(&rig, &noise(1, 2000)).await;
    let id = store.queue_fit(&rig).await.id;
    let dead = store.claim_job("dead", Timestamp::MAX, now()).await.unwrap().unwrap();
    let bench = Bench { jobs: start(&store, fails).await, store, rig };
    let job = bench.end_of(id).await;
    assert_eq!((job.state, job.attempt), (JobState::Failed, 1), "the job was not to blame");
    let late = bench.store.heartbeat(&dead.lease, "late", 0.5, now(), now()).await.unwrap();
    assert_eq!(late, crate::storage::Beat::Lost);
}

#[tokio::test]
async fn events_rise_end_with_the_job_and_are_not_given_twice() {
    let bench = Bench::new(endless).await;
    let id = bench.fit(serde_json::json!({"kind": "frf"})).await;
    let mut events = Box::pin(bench.jobs.subscribe(id, None).await.unwrap().unwrap());
    let mut last = 0;
    for _ in 0..5 {
        let job = events.next().await.unwrap();
        assert!(job.event > last);
        last = job.event;
    }
    bench.jobs.cancel(id).await.unwrap();
    let rest: Vec<Job> = events.collect().await;
    let end = rest.last().unwrap();
    assert_eq!(end.state, JobState::Cancelled);
    let replay = async |seen| {
        let stream = bench.jobs.subscribe(id, Some(seen)).await.unwrap().unwrap();
        stream.map(|job| job.event).collect::<Vec<_>>().await
    };
    assert_eq!(replay(last).await, [end.event], "the latest state, not each that was missed");
    assert_eq!(replay(end.event).await, [] as [u64; 0]);
    assert_eq!(replay(end.event + 1000).await, [end.event], "an id that was never given");
    let nobody = crate::domain::new_id(now());
    assert!(bench.jobs.subscribe(nobody, None).await.unwrap().is_none());
}

#[tokio::test]
async fn a_fit_that_no_job_has_the_memory_for_is_refused_with_what_it_needs() {
    let bench = Bench::new(gain).await;
    let request =
        || serde_json::from_value(serde_json::json!({"kind": "frf", "frf": {"ridge": 0.1}})).unwrap();
    let program = WorkerProgram {
        program: "rigcast".into(),
        arguments: Vec::new(),
        memory_bytes: 100 << 20,
        time_limit: Duration::from_secs(1),
    };
    let settings = JobSettings { workers: 0, program: Some(program), ..JobSettings::default() };
    let compute = Compute::new(&ComputeSettings::default()).unwrap();
    let small = Jobs::start_with((*bench.store).clone(), compute, now, settings, gain).await.unwrap();
    let problem = small.submit_fit(&bench.rig, &request(), None, None).await.unwrap_err().problem();
    assert_eq!((problem.code.as_str(), problem.status), ("fit.memory", 422));
    assert!(problem.detail.contains("A job may take 100 MiB"), "{}", problem.detail);
    assert_eq!(problem.errors[0].pointer, "/runs");
    // The same with the memory of this machine.
    let job = bench.jobs.submit_fit(&bench.rig, &request(), None, None).await.unwrap();
    assert_eq!(bench.end_of(job.id).await.state, JobState::Succeeded);
}

#[tokio::test]
async fn a_fit_is_refused_before_it_is_queued() {
    let bench = Bench::new(fails).await;
    let refused = async |request: serde_json::Value| {
        let request = serde_json::from_value(request).unwrap();
        bench.jobs.submit_fit(&bench.rig, &request, None, None).await.unwrap_err().problem()
    };
    let problem = refused(serde_json::json!({"kind": "frf", "inputs": ["nope"]})).await;
    assert_eq!((problem.code.as_str(), problem.status), ("fit.invalid", 422));
    assert_eq!(problem.errors[0].channel.as_deref(), Some("nope"));
    let sensor = serde_json::json!({"kind": "frf", "inputs": ["y"], "outputs": ["u"], "activate": "always"});
    assert_eq!(refused(sensor).await.code, "model.not_forward");
    let none = serde_json::json!({"kind": "frf", "runs": {"kinds": ["sweep"]}});
    assert_eq!(refused(none).await.status, 409);
    let listed =
        bench.store.jobs(&JobQuery::default(), &crate::domain::PageRequest::default()).await.unwrap();
    assert_eq!(listed.items, []);
}

#[tokio::test]
async fn the_first_model_becomes_active_and_a_better_one_takes_its_place() {
    let bench = Bench::new(gain).await;
    let active = async || bench.store.active_model(&bench.rig.id).await.unwrap().unwrap().version;
    let (job, first) = bench.fit_gain(1.5, Activate::IfBetter).await;
    assert_eq!((job.state, job.progress, active().await), (JobState::Succeeded, 1.0, Some(1)));
    assert_eq!(job.stage.as_deref(), Some("model 1, active: no model was active"));
    assert_eq!((first.job, first.code_version.as_str()), (Some(job.id), crate::VERSION));
    assert_eq!((first.lineage.training[0].to_sample, first.lineage.validation[0].from_sample), (1800, 1800));
    assert!(first.request.unwrap().runs.is_some());
    // The truth is 2: a gain of 1.8 is better, 1.6 is worse than that.
    let (job, _) = bench.fit_gain(1.8, Activate::IfBetter).await;
    assert_eq!(active().await, Some(2));
    let words = job.stage.unwrap();
    assert!(words.starts_with("model 2, active: RMS error 0.1000 against 0.2500 of model 1"), "{words}");
    let (job, _) = bench.fit_gain(1.6, Activate::IfBetter).await;
    assert_eq!(active().await, Some(2));
    assert!(job.stage.unwrap().starts_with("model 3, not active: RMS error 0.2000"));
    // An equal error is not better.
    bench.fit_gain(1.8005, Activate::IfBetter).await;
    assert_eq!(active().await, Some(2));
    bench.fit_gain(2.0, Activate::Never).await;
    assert_eq!(active().await, Some(2));
    bench.fit_gain(0.1, Activate::Always).await;
    assert_eq!(active().await, Some(6));
}

#[tokio::test]
async fn without_fair_data_a_model_stays_inactive_and_the_job_says_why() {
    let bench = Bench::new(gain).await;
    let run = bench.store.upload(&bench.rig, &noise(3, 1000)).await.run;
    let rest = bench.store.all_runs(&bench.rig.id).await.unwrap();
    let first = rest.iter().find(|other| other.id != run.id).unwrap();
    let request = |training: JobId, validation: JobId| {
        serde_json::json!({
            "kind": "frf", "frf": {"ridge": 0.2}, "runs": [training], "validation_runs": [validation]
        })
    };
    let one = bench.end_of(bench.fit(request(first.id, run.id)).await).await;
    assert_eq!(one.stage.as_deref(), Some("model 1, active: no model was active"));
    // The active model was trained on all validation data of the next one.
    let other = bench.end_of(bench.fit(request(run.id, first.id)).await).await;
    assert!(other.stage.unwrap().contains("there are no data that neither it nor active model 1"));
    assert_eq!(bench.store.active_model(&bench.rig.id).await.unwrap().unwrap().version, Some(1));
    let sensor =
        serde_json::json!({"kind": "frf", "frf": {"ridge": 0.05}, "inputs": ["y"], "outputs": ["u"]});
    let sensor = bench.end_of(bench.fit(sensor).await).await;
    assert!(sensor.stage.unwrap().contains("does not map all drives to all responses"));
}

#[tokio::test]
async fn a_policy_fits_after_uploads_with_all_their_runs() {
    let bench = Bench::new(gain).await;
    let patch = serde_json::json!({
        "fit_policy": {"min_total_s": 25.0, "fits": [{"kind": "frf", "frf": {"ridge": 0.2}}]}
    });
    let patched = bench.store.patch_rig(&bench.rig.id, "*", &patch, now()).await.unwrap();
    assert!(matches!(patched, RigUpdate::Updated(_)), "{patched:?}");
    let inserted = bench.store.upload_with(&bench.rig, meta(), &noise(4, 1000)).await;
    bench.jobs.wake();
    assert_eq!(inserted.jobs.len(), 1);
    let job = bench.end_of(inserted.jobs[0]).await;
    assert_eq!(job.state, JobState::Succeeded, "{job:?}");
    let model = bench.store.model(&bench.rig.id, 1).await.unwrap().unwrap();
    let runs: std::collections::BTreeSet<_> = model.lineage.spans().map(|span| span.run).collect();
    assert_eq!(runs.len(), 2, "one is trained on, the other compares");
    let states: BTreeMap<_, _> =
        bench.store.count_jobs().await.unwrap().into_iter().map(|(s, n)| (s.as_str(), n)).collect();
    assert_eq!((states["succeeded"], states["queued"], states["running"]), (1, 0, 0));
}

/// The engine's fit, with a pause after each progress report.
fn slow(
    data: &FitData,
    settings: &FitSettings,
    checkpoints: &dyn CheckpointStore,
    watch: Watch<'_>,
) -> Result<Fitted, EngineError> {
    let slowly = |progress: crate::engine::Progress<'_>| {
        std::thread::sleep(Duration::from_millis(2));
        watch(progress)
    };
    crate::engine::model::fit_resumable(data, settings, checkpoints, &slowly)
}

#[tokio::test]
async fn a_fit_that_two_stops_interrupted_ends_in_the_same_model_and_leaves_no_checkpoint() {
    let request = || {
        let lstm = serde_json::json!({"blocks": [4], "window_len": 32, "epochs": 20, "seeds": [1, 2]});
        serde_json::json!({"kind": "lstm", "lstm": lstm, "activate": "never"})
    };
    let bench = Bench::new(slow).await;
    let whole = bench.end_of(bench.fit(request()).await).await;
    assert_eq!(whole.state, JobState::Succeeded, "{whole:?}");
    let id = bench.fit(request()).await;
    let Bench { store, rig, mut jobs } = bench;
    for _ in 0..2 {
        while store.job(id).await.unwrap().unwrap().progress < 0.2 {
            tokio::time::sleep(Duration::from_millis(2)).await;
        }
        jobs.shutdown().await;
        let job = store.job(id).await.unwrap().unwrap();
        assert_eq!((job.state, job.attempt), (JobState::Queued, 0));
        assert!(store.count_checkpoints().await > 0);
        jobs = start(&store, slow).await;
    }
    let bench = Bench { store, rig, jobs };
    let resumed = bench.end_of(id).await;
    let model = async |job: &Job| {
        let version = job.result.as_ref().expect("a model").id.parse().unwrap();
        bench.store.model(&bench.rig.id, version).await.unwrap().unwrap()
    };
    let (whole, resumed) = (model(&whole).await, model(&resumed).await);
    assert_eq!((whole.sha256, whole.report), (resumed.sha256, resumed.report));
    assert_eq!(bench.store.count_checkpoints().await, 0);
}
