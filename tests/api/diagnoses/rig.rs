//! A mass on a spring that stiffens, integrated with Runge and Kutta's fourth-order rule at ten steps a
//! sample, behind a service.

use rigcast::engine::Signal;
use rigcast::engine::frf::{FrfSettings, estimate};
use rigcast::engine::model::{InputRange, ModelKind, Preprocess, RigModel, to_safetensors};
use rigcast::engine::progress::unwatched;
use serde_json::{Value, json};

use crate::support::{SAFETENSORS, TestApp, noise};

pub const RATE: f64 = 128.0;
pub const DIAGNOSES: &str = "/v1/rigs/mass/diagnoses";

/// The rig: a force in kN, a displacement in mm.
pub fn draft() -> Value {
    json!({
        "id": "mass", "name": "Mass", "sample_rate_hz": RATE,
        "channels": [
            {"name": "drive", "unit": "kN", "role": "drive", "quantity": "force", "axis": "z"},
            {"name": "disp", "unit": "mm", "role": "response", "quantity": "displacement", "axis": "z"},
        ],
    })
}

/// Noise below some 20 Hz of this RMS.
pub fn drive(seconds: f64, level: f64, seed: u64) -> Vec<f64> {
    let mut stages = [0.0; 4];
    let mut out: Vec<f64> = noise((seconds * RATE) as usize, seed)
        .into_iter()
        .map(|mut x| {
            for s in &mut stages {
                *s += 0.5 * (x - *s);
                x = *s;
            }
            x
        })
        .collect();
    let rms = (out.iter().map(|x| x * x).sum::<f64>() / out.len() as f64).sqrt();
    out.iter_mut().for_each(|x| *x *= level / rms);
    out
}

/// `x'' + 6 x' + 1600 x + cubic x^3 = 1600 u`, from rest.
pub fn respond(drive: &[f64], cubic: f64) -> Vec<f64> {
    const STEPS: usize = 10;
    let h = 1.0 / (RATE * STEPS as f64);
    let slope = |[x, v]: [f64; 2], u: f64| [v, 1600.0 * (u - x) - 6.0 * v - cubic * x * x * x];
    let along = |s: [f64; 2], d: [f64; 2], h: f64| [s[0] + h * d[0], s[1] + h * d[1]];
    let mut s = [0.0; 2];
    let mut out = Vec::with_capacity(drive.len());
    for &u in drive {
        out.push(s[0]);
        for _ in 0..STEPS {
            let a = slope(s, u);
            let b = slope(along(s, a, 0.5 * h), u);
            let c = slope(along(s, b, 0.5 * h), u);
            let d = slope(along(s, c, h), u);
            for (i, s) in s.iter_mut().enumerate() {
                *s += h / 6.0 * (a[i] + 2.0 * b[i] + 2.0 * c[i] + d[i]);
            }
        }
    }
    out
}

/// Stiffness of the real rig that its model lacks.
pub const CUBIC: f64 = 20.0;

/// The reading of a sensor of the rig: 0.03 mm of noise.
pub fn measure(drive: &[f64], cubic: f64, seed: u64) -> Vec<f64> {
    let error = noise(drive.len(), seed ^ 0xabcd);
    respond(drive, cubic).iter().zip(error).map(|(y, e)| y + 0.03 * 3.0_f64.sqrt() * e).collect()
}

pub fn csv(columns: &[(&str, &[f64])]) -> String {
    let names: Vec<&str> = columns.iter().map(|(name, _)| *name).collect();
    let mut text = names.join(",") + "\n";
    for k in 0..columns[0].1.len() {
        let row: Vec<String> = columns.iter().map(|(_, c)| c[k].to_string()).collect();
        text += &(row.join(",") + "\n");
    }
    text
}

/// A service with the rig, runs at low and high level, and an FRF of the low ones.
pub struct Lab {
    pub app: TestApp,
    /// Low-level noise that the model was fitted on.
    pub low: String,
    /// Two drives at full level, each run twice: a, b, b, a.
    pub high: [String; 4],
}

impl Lab {
    /// The FRF is fitted by the service.
    pub async fn with_frf() -> Self {
        Self::with_frf_of(json!({"segment_len": 2048})).await
    }

    /// With an FRF fitted by these settings to the runs of low level.
    pub async fn with_frf_of(settings: Value) -> Self {
        let lab = Self::without_model().await;
        let request = json!({"kind": "frf", "frf": settings});
        let job = lab.app.post_json("/v1/rigs/mass/fits", &request).await.expect(202).json();
        let job = lab.app.finished(job["id"].as_str().expect("an id")).await;
        assert_eq!(job["state"], "succeeded", "{job}");
        lab
    }

    pub async fn without_model() -> Self {
        let app = TestApp::start();
        app.rig(&draft()).await;
        let low = upload(&app, "kind=noise&tag=low", &drive(120.0, 0.15, 3), 10).await;
        let (a, b) = (drive(16.0, 1.0, 1), drive(16.0, 0.7, 2));
        let mut high = Vec::new();
        for (k, drive) in [&a, &b, &b, &a].into_iter().enumerate() {
            high.push(upload(&app, "kind=service&tag=high", drive, 11 + k as u64).await);
        }
        Self { app, low, high: high.try_into().expect("four runs") }
    }

    /// A valid request with few effects, so that it is quick.
    pub fn request(&self) -> Value {
        let [a, b, c, d] = &self.high;
        json!({
            "mode": "external", "runs": self.high, "repeats": [[a, d], [b, c]],
            "catalogue": ["linear_change", "cubic_stiffness", "coulomb_friction", "quadratic_damping"],
        })
    }

    /// The finished job of a diagnosis.
    pub async fn finished(&self, request: &Value) -> Value {
        let reply = self.app.post_json(DIAGNOSES, request).await.expect(202);
        let job = reply.json();
        assert_eq!(reply.header("location"), format!("/v1/jobs/{}", job["id"].as_str().expect("an id")));
        assert_eq!(job["kind"], "diagnosis");
        self.app.finished(job["id"].as_str().expect("an id")).await
    }

    /// The report of a diagnosis that succeeds, and where it is.
    pub async fn report(&self, request: &Value) -> (String, Value) {
        let job = self.finished(request).await;
        assert_eq!(job["state"], "succeeded", "{job}");
        assert_eq!(job["result"]["kind"], "diagnosis", "{job}");
        let href = job["result"]["href"].as_str().expect("a link").to_owned();
        let report = self.app.get(&href).await.expect(200).json();
        assert_eq!((&report["id"], &report["job"]), (&job["result"]["id"], &job["id"]));
        (href, report)
    }

    /// The problem of a request with some fields replaced, told at once.
    pub async fn refused(&self, changes: Value, status: u16, code: &str) -> Value {
        let mut request = self.request();
        for (field, value) in changes.as_object().expect("fields") {
            request[field] = value.clone();
        }
        self.app.post_json(DIAGNOSES, &request).await.problem(status, code)
    }

    /// RMS error of a version's prediction of a run, relative to the run.
    pub async fn error_of(&self, version: u64, run: &str) -> f64 {
        let request =
            json!({"model": version, "drive": {"run": run}, "target": {"run": run}, "include": ["errors"]});
        let answer = self.app.post_json("/v1/rigs/mass/predict", &request).await.expect(200).json();
        answer["errors"]["channels"]["disp"]["rms"].as_f64().expect("an error")
    }

    /// Makes a version the active one.
    pub async fn activate(&self, version: u64) {
        let put = self.app.call("PUT", "/v1/rigs/mass/active-model").header("if-match", "*");
        put.json(&json!({"version": version})).send().await.expect(200);
    }

    /// Uploads weights; returns their version.
    pub async fn import(&self, weights: Vec<u8>) -> u64 {
        let reply = self.app.post_file("/v1/rigs/mass/models", SAFETENSORS, weights).await.expect(201);
        reply.json()["version"].as_u64().expect("a version")
    }
}

/// Uploads the rig's response to a drive; returns the id of the run.
pub async fn upload(app: &TestApp, query: &str, drive: &[f64], seed: u64) -> String {
    upload_csv(app, query, &csv(&[("drive", drive), ("disp", &measure(drive, CUBIC, seed))])).await
}

pub async fn upload_csv(app: &TestApp, query: &str, csv: &str) -> String {
    let path = format!("/v1/rigs/mass/runs?{query}");
    let run = app.post_file(&path, "text/csv", csv).await.expect(201).json();
    run["id"].as_str().expect("an id").to_owned()
}

/// Weights of an FRF whose runs the service has never seen: it has no lineage.
pub fn frf_weights(preprocess: Preprocess) -> Vec<u8> {
    let u = drive(120.0, 0.15, 77);
    let x = Signal::new(RATE, vec![u.clone()]).expect("a signal");
    let y = Signal::new(RATE, vec![measure(&u, 0.0, 78)]).expect("a signal");
    let settings = FrfSettings { segment_len: Some(2048), ..FrfSettings::default() };
    let found = estimate(&[(&x, &y)], &settings, &unwatched).expect("an FRF");
    to_safetensors(&RigModel {
        kind: ModelKind::Frf,
        inputs: vec!["drive".into()],
        outputs: vec!["disp".into()],
        sample_rate_hz: RATE,
        preprocess,
        frf: Some(found.frf),
        frf_quality: Some(found.quality),
        core: Vec::new(),
        lstm: None,
        joint_range: None,
        window_range: Vec::new(),
        range: vec![InputRange { min: -1.0, max: 1.0, max_rate: 1e3, band_hz: None, local: None }],
        band: None,
        effects: Vec::new(),
    })
}
