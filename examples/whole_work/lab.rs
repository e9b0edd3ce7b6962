//! One rig's work from the first upload to the diagnosis of a change, stage by stage.

use std::ops::Range;
use std::time::Duration;

use rigcast::client::{Client, ClientError, elapsed_s};
use rigcast::engine::simd::peak_fma;
use rigcast::formats::npy::{Dtype, Order, write};
use serde_json::{Value, json};

use crate::progress;
use crate::rigs::{Drive, RATE_HZ, Rig, State};
use crate::service::{Cost, Service};
use crate::{AnyError, Args, Stage};

/// Runs that an upload of noise is divided into; the first holds the small, centred noise.
const NOISE_RUNS: usize = 6;
/// Runs that an upload of load is divided into: an evaluation takes no hour of 64 channels as one run.
const LOAD_RUNS: usize = 2;

/// A stage that is done.
#[derive(Debug, Clone)]
pub struct Done {
    pub rig: &'static str,
    pub stage: &'static str,
    pub cost: Cost,
    /// Floating-point work per second as a share of what the machine's vector units reached beside it.
    pub share: Option<f64>,
    /// Iterations of a search, seconds of a diagnosed programme, and the like.
    pub counted: Value,
}

/// A lab with one rig.
pub struct Lab<'a> {
    service: &'a Service,
    client: Client,
    rig: &'a dyn Rig,
    args: &'a Args,
    /// Ids of the runs of noise.
    noise: Vec<String>,
    /// Versions by kind.
    versions: Vec<(&'static str, u64)>,
    /// Floating-point operations of the active network for one second of signal.
    flop_per_s: f64,
    pub done: Vec<Done>,
    pub failed: bool,
}

/// What a stage hands back for its line: the work in floating-point operations if that means something, and counts.
type Outcome = Result<(Option<f64>, Value), AnyError>;

impl<'a> Lab<'a> {
    pub async fn open(service: &'a Service, rig: &'a dyn Rig, args: &'a Args) -> Result<Self, AnyError> {
        let client = Client::new(&service.url(), None)?;
        let body =
            json!({"id": rig.id(), "name": rig.id(), "sample_rate_hz": RATE_HZ, "channels": rig.channels()});
        client.post("/v1/rigs", &body).await?;
        Ok(Self {
            service,
            client,
            rig,
            args,
            noise: Vec::new(),
            versions: Vec::new(),
            flop_per_s: 0.0,
            done: Vec::new(),
            failed: false,
        })
    }

    /// All stages that were asked for, and the upload that they build on.
    pub async fn work(&mut self) -> Result<(), AnyError> {
        self.stage("upload", Self::upload_noise).await?;
        for (kind, stage) in [
            ("frf", Stage::Frf),
            ("lstm", Stage::Lstm),
            ("hybrid1", Stage::Hybrid1),
            ("hybrid2", Stage::Hybrid2),
        ] {
            if self.args.stages.contains(&stage) {
                self.stage(kind, async |lab: &mut Self| lab.fit(kind).await).await?;
            }
        }
        let later = [Stage::Drift, Stage::Predict, Stage::Evaluate, Stage::Iterate, Stage::Diagnose];
        if self.versions.is_empty() || !self.args.stages.iter().any(|stage| later.contains(stage)) {
            return Ok(());
        }
        self.stage("activate", Self::activate).await?;
        self.stage("upload_load", Self::upload_load).await?;
        // The service judges the load in the background: the next stages shall have the machine for themselves.
        self.stage("drift", Self::drift).await?;
        if self.args.stages.contains(&Stage::Predict) {
            for (kind, version) in self.versions.clone() {
                let name = match kind {
                    "frf" => "predict_frf",
                    "lstm" => "predict_lstm",
                    "hybrid1" => "predict_hybrid1",
                    _ => "predict_hybrid2",
                };
                self.stage(name, async |lab: &mut Self| lab.predict(version).await).await?;
            }
        }
        if self.args.stages.contains(&Stage::Evaluate) {
            self.stage("evaluate", Self::evaluate).await?;
        }
        if self.args.stages.contains(&Stage::Iterate) {
            self.stage("iterate", Self::iterate).await?;
        }
        if self.args.stages.contains(&Stage::Diagnose) {
            self.stage("diagnose", Self::diagnose).await?;
        }
        Ok(())
    }

    /// Runs a stage and prints its line, or the problem that ended it.
    async fn stage(
        &mut self,
        name: &'static str,
        work: impl AsyncFnOnce(&mut Self) -> Outcome,
    ) -> Result<(), AnyError> {
        let rig = self.rig.id();
        let before = peak_fma()?;
        let meter = self.service.meter();
        let outcome = work(self).await;
        let mut cost = meter.read();
        let peak = f64::midpoint(before, peak_fma()?);
        match outcome {
            Ok((flop, mut counted)) => {
                // Where the client makes its signals meanwhile, only the calls count.
                if let Some(seconds) = counted.as_object_mut().and_then(|counted| counted.remove("seconds")) {
                    cost.seconds = seconds.as_f64().unwrap_or(cost.seconds);
                }
                let share = flop.map(|flop| flop / cost.seconds / peak);
                println!(
                    "{}",
                    json!({"stage": name, "rig": rig, "minutes": self.args.minutes, "seconds": round(cost.seconds),
                           "resident_mib": round(cost.resident_mib), "share_of_peak_fma": share.map(round),
                           "peak_fma_gflops": round(peak / 1e9), "cpu_s": round(cost.cpu_s), "counted": counted})
                );
                self.done.push(Done { rig, stage: name, cost, share, counted });
            }
            Err(error) => {
                self.failed = true;
                let problem = match error.downcast_ref() {
                    Some(ClientError::Problem { problem, .. } | ClientError::Job { problem, .. }) => {
                        problem.clone()
                    }
                    _ => json!(error.to_string()),
                };
                println!(
                    "{}",
                    json!({"stage": name, "rig": rig, "seconds": round(cost.seconds), "problem": problem})
                );
            }
        }
        Ok(())
    }

    /// Makes a run and uploads it; answers its id and the seconds of the call.
    async fn upload(
        &self,
        name: &str,
        query: &[(&str, &str)],
        channels: &[Vec<f64>],
    ) -> Result<(String, f64), AnyError> {
        let file = write(channels, Dtype::F4, Order::C)?;
        self.keep(&format!("{name}.npy"), &file)?;
        let rate = RATE_HZ.to_string();
        let mut all = vec![("name", name), ("sample_rate_hz", rate.as_str())];
        all.extend_from_slice(query);
        let began = std::time::Instant::now();
        let run = self.client.upload(self.rig.id(), &all, "application/x-npy", file).await?;
        let seconds = began.elapsed().as_secs_f64();
        Ok((run["id"].as_str().ok_or(ClientError::Missing("id"))?.to_owned(), seconds))
    }

    /// Leaves a file for other programs, if that was asked for.
    fn keep(&self, name: &str, bytes: &[u8]) -> std::io::Result<()> {
        let Some(folder) = &self.args.kept else { return Ok(()) };
        std::fs::create_dir_all(folder)?;
        std::fs::write(folder.join(name), bytes)
    }

    fn seed(&self, number: u64) -> u64 {
        self.args.seed.wrapping_mul(1_000).wrapping_add(number)
    }

    async fn upload_noise(&mut self) -> Outcome {
        let seconds = 60.0 * self.args.minutes / NOISE_RUNS as f64;
        let (mut calls_s, bar) = (0.0, progress::steps("upload", NOISE_RUNS));
        for run in 0..NOISE_RUNS {
            let (kind, tag) = if run == 0 { (Drive::LinearNoise, "linear") } else { (Drive::Noise, "mixed") };
            let drive = self.rig.drive(kind, seconds, self.seed(run as u64))?;
            let channels = self.rig.record(&drive, State::Fitted, self.seed(50 + run as u64))?;
            let query = [("kind", "noise"), ("split", "training"), ("tag", tag)];
            let (id, seconds) = self.upload(&format!("noise-{run}"), &query, &channels).await?;
            self.noise.push(id);
            calls_s += seconds;
            bar.inc(1);
        }
        bar.finish_and_clear();
        Ok((None, json!({"seconds": calls_s, "runs": NOISE_RUNS})))
    }

    async fn upload_load(&mut self) -> Outcome {
        let drive = self.rig.drive(Drive::Service, 60.0 * self.args.minutes, self.seed(100))?;
        let channels = self.rig.record(&drive, State::Fitted, self.seed(101))?;
        let query = [("kind", "service"), ("split", "test"), ("tag", "load")];
        let mut calls_s = 0.0;
        for run in 0..LOAD_RUNS {
            let [from, to] = [run, run + 1].map(|part| part * drive.n_samples() / LOAD_RUNS);
            let part: Vec<Vec<f64>> = channels.iter().map(|x| x[from..to].to_vec()).collect();
            calls_s += self.upload(&format!("load-{run}"), &query, &part).await?.1;
        }
        Ok((None, json!({"seconds": calls_s, "runs": LOAD_RUNS})))
    }

    async fn wait(&self, name: &str, job: &str) -> Result<Value, AnyError> {
        let bar = progress::bar(name);
        let done = self.client.wait(job, |job| progress::show(&bar, job)).await;
        bar.finish_and_clear();
        Ok(done?)
    }

    async fn fit(&mut self, kind: &'static str) -> Outcome {
        let mut request = json!({"kind": kind, "activate": "never"});
        if (kind == "hybrid1" || kind == "hybrid2") && !self.args.frf_of_all_noise {
            request["frf"] = json!({"runs": {"tags": ["linear"]}});
        }
        if kind != "frf" {
            request["lstm"] = json!({"seeds": [1, 2, 3]});
            if let Some(epochs) = self.args.epochs {
                request["lstm"]["epochs"] = epochs.into();
            }
        }
        let job = self.client.fit(self.rig.id(), &request).await?;
        let job = self.wait(kind, &job).await?;
        let model = self.client.fitted_model(&job).await?;
        let version = model["version"].as_u64().ok_or(ClientError::Missing("version"))?;
        self.versions.push((kind, version));
        if kind == "hybrid2" {
            let kept = json!({"runs": self.noise, "seconds": elapsed_s(&job), "model": model});
            self.keep("hybrid2.json", kept.to_string().as_bytes())?;
        }
        let network = Network::of(&model, self.rig.drives());
        self.flop_per_s = network.as_ref().map_or(0.0, Network::flop_per_s);
        let trained = network.map(|network| network.training_flop(&model));
        let rms = model["report"]["validation_rms"].clone();
        let errors: Vec<f64> = rms.as_array().into_iter().flatten().filter_map(Value::as_f64).collect();
        let mean = errors.iter().sum::<f64>() / errors.len() as f64;
        Ok((
            trained,
            json!({"version": version, "job_s": elapsed_s(&job), "mean_rms": round(mean),
                            "frf": model["report"]["frf"], "lstm": model["report"]["lstm"]}),
        ))
    }

    async fn activate(&mut self) -> Outcome {
        let &(kind, version) = self.versions.last().ok_or("no model was fitted")?;
        self.client.activate(self.rig.id(), version).await?;
        Ok((None, json!({"kind": kind})))
    }

    async fn drift(&mut self) -> Outcome {
        loop {
            let drift = self.client.get(&format!("/v1/rigs/{}/drift", self.rig.id())).await?;
            if drift["pending"].as_u64().ok_or(ClientError::Missing("pending"))? == 0 {
                return Ok((None, json!({"runs": drift["runs"].as_array().map(Vec::len)})));
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    }

    async fn predict(&mut self, version: u64) -> Outcome {
        let seconds = 60.0 * self.args.minutes;
        let drive = self.rig.drive(Drive::Service, seconds, self.seed(100))?;
        let body = write(drive.channels(), Dtype::F4, Order::C)?;
        drop(drive);
        let began = std::time::Instant::now();
        let answer = self.client.predict_npy(self.rig.id(), &version.to_string(), RATE_HZ, body).await?;
        let took = began.elapsed().as_secs_f64();
        let model = self.client.get(&format!("/v1/rigs/{}/models/{version}", self.rig.id())).await?;
        let flop = Network::of(&model, self.rig.drives()).map(|network| network.flop_per_s() * seconds);
        Ok((
            flop,
            json!({"seconds": took, "signal_s_per_s": round(seconds / took), "inside": answer.trust_inside}),
        ))
    }

    /// Sends a request that makes a job, and reads its result.
    async fn job(&self, what: &str, request: &Value) -> Result<(Value, f64), AnyError> {
        let job = self.client.post(&format!("/v1/rigs/{}/{what}", self.rig.id()), request).await?;
        let job = self.wait(what, job["id"].as_str().ok_or(ClientError::Missing("id"))?).await?;
        let result =
            self.client.get(job["result"]["href"].as_str().ok_or(ClientError::Missing("href"))?).await?;
        Ok((result, elapsed_s(&job).unwrap_or(f64::NAN)))
    }

    async fn evaluate(&mut self) -> Outcome {
        let models: Vec<u64> = self.versions.iter().map(|(_, version)| *version).collect();
        let request = json!({"models": models, "runs": {"tags": ["load"], "split": "test"}});
        let (report, job_s) = self.job("evaluations", &request).await?;
        let omitted = report["omitted"].as_array().map(Vec::len);
        Ok((None, json!({"models": models.len(), "job_s": job_s, "omitted": omitted})))
    }

    async fn iterate(&mut self) -> Outcome {
        let drive = self.rig.drive(Drive::Service, 60.0, self.seed(200))?;
        let channels = self.rig.record(&drive, State::Fitted, self.seed(201))?;
        let (run, _) = self
            .upload("target", &[("kind", "service"), ("split", "test"), ("tag", "target")], &channels)
            .await?;
        let began = std::time::Instant::now();
        let request = json!({"target": {"run": run, "channels": self.rig.targets()}});
        let (found, job_s) = self.job("iterations", &request).await?;
        let steps = found["steps"].as_array().ok_or(ClientError::Missing("steps"))?.len();
        let searched_s = found["elapsed_s"].as_f64().ok_or(ClientError::Missing("elapsed_s"))?;
        Ok((
            None,
            json!({"seconds": began.elapsed().as_secs_f64(), "job_s": job_s, "iterations": steps,
                         "ms_per_iteration": round(1e3 * searched_s / steps as f64),
                         "error": found["total_error"], "stopped": found["stopped"]}),
        ))
    }

    /// Two noise drives, each run twice, and a load, all on the changed rig: together a third of the noise.
    async fn diagnose(&mut self) -> Outcome {
        let seconds = 60.0 * self.args.minutes / 15.0;
        let drives = [
            (Drive::Noise, 300),
            (Drive::Noise, 300),
            (Drive::Noise, 301),
            (Drive::Noise, 301),
            (Drive::Service, 302),
        ];
        let mut runs = Vec::new();
        for (number, (kind, seed)) in (0..).zip(drives) {
            let drive = self.rig.drive(kind, seconds, self.seed(seed))?;
            let channels = self.rig.record(&drive, State::Worn, self.seed(310 + number))?;
            let kind = if kind == Drive::Service { "service" } else { "noise" };
            let query = [("kind", kind), ("split", "test"), ("tag", "later")];
            runs.push(self.upload(&format!("later-{number}"), &query, &channels).await?.0);
        }
        self.drift().await?;
        let pair = |Range { start, end }: Range<usize>| runs[start..end].to_vec();
        let request = json!({"mode": "external", "baseline_runs": {"tags": ["linear"], "split": "training"},
                             "runs": pair(0..4), "repeats": [pair(0..2), pair(2..4)]});
        let began = std::time::Instant::now();
        let (report, job_s) = self.job("diagnoses", &request).await?;
        Ok((
            None,
            json!({"seconds": began.elapsed().as_secs_f64(), "job_s": job_s, "signal_s": 4.0 * seconds,
                         "verdict": report["verdict"], "gap": report["gap"], "warnings": report["warnings"]}),
        ))
    }
}

/// The size of a model's network.
struct Network {
    inputs: usize,
    blocks: Vec<usize>,
    outputs: usize,
    window: f64,
    hop: f64,
}

impl Network {
    /// `None` for a model without one.
    fn of(model: &Value, drives: usize) -> Option<Self> {
        let lstm = &model["report"]["lstm"];
        let blocks: Vec<usize> =
            lstm["blocks"].as_array()?.iter().filter_map(|c| Some(c.as_u64()? as usize)).collect();
        let outputs = model["outputs"].as_array()?.len();
        let inputs = if model["kind"] == "hybrid2" { drives + outputs } else { drives };
        Some(Self {
            inputs,
            blocks,
            outputs,
            window: lstm["window_len"].as_f64()?,
            hop: lstm["hop"].as_f64()?,
        })
    }

    /// Of all windows that one second of signal lies in.
    fn flop_per_s(&self) -> f64 {
        let (mut input, mut flop) = (self.inputs, 0.0);
        for &cells in &self.blocks {
            flop += (8 * cells * (input + cells)) as f64;
            input = cells;
        }
        flop += (2 * input * self.outputs) as f64;
        flop * RATE_HZ * self.window / self.hop
    }

    /// Of all epochs of all seeds, and of the fit on all runs: forward, and twice as much backward.
    fn training_flop(&self, model: &Value) -> f64 {
        let report = &model["report"];
        let seconds = |of: &str| {
            let spans = model["lineage"][of].as_array().into_iter().flatten();
            let samples = spans.filter_map(|s| Some(s["to_sample"].as_f64()? - s["from_sample"].as_f64()?));
            samples.sum::<f64>() / RATE_HZ
        };
        let epochs = report["lstm"]["epochs"].as_f64().unwrap_or(0.0);
        let seeds = report["seeds"].as_array().map_or(0.0, |seeds| seeds.len() as f64);
        let kept = |seed: &&Value| seed["seed"] == report["best_seed"];
        let best = report["seeds"].as_array().into_iter().flatten().find(kept);
        let all = seconds("training");
        let trained = if report["comparison"]["refitted"] == true {
            let held_out = seconds("validation") + seconds("stopping");
            seeds * epochs * (all - held_out)
                + best.and_then(|seed| seed["best_epoch"].as_f64()).unwrap_or(0.0) * all
        } else {
            seeds * epochs * all
        };
        3.0 * self.flop_per_s() * trained
    }
}

/// Four digits are enough to compare.
fn round(value: f64) -> f64 {
    rigcast::engine::rounded(value, 4)
}
