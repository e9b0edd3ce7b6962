//! Rigs, runs and models that tests need, as small as they may be.

use realfft::num_complex::Complex64;
use rigcast::engine::frf::Frf;
use rigcast::engine::model::{InputRange, ModelKind, Preprocess, RigModel, to_safetensors};
use serde_json::{Value, json};

use super::TestApp;

/// A rig of one drive `u` (kN) and one response `y` (mm) at 100 Hz.
pub fn bench() -> Value {
    json!({
        "id": "bench", "name": "Bench", "sample_rate_hz": 100.0,
        "channels": [
            {"name": "u", "unit": "kN", "role": "drive", "quantity": "force"},
            {"name": "y", "unit": "mm", "role": "response", "quantity": "displacement", "axis": "z"},
        ],
    })
}

/// A rig of one drive and a group of three responses.
pub fn triple() -> Value {
    let axis = |axis: &str| json!({"name": format!("f{axis}"), "unit": "kN", "role": "response", "axis": axis, "group": "force"});
    json!({
        "id": "triple", "name": "Triple", "sample_rate_hz": 100.0,
        "channels": [{"name": "u", "unit": "kN", "role": "drive"}, axis("x"), axis("y"), axis("z")],
    })
}

/// `n` samples of a scaled sum of two sines.
pub fn wave(n: usize, scale: f64) -> Vec<f64> {
    (0..n).map(|i| scale * ((0.9 * i as f64).sin() + (0.31 * i as f64).sin())).collect()
}

/// Seeded noise: a linear congruential generator, uniform in -1..1.
pub fn noise(n: usize, seed: u64) -> Vec<f64> {
    let mut state = seed.wrapping_mul(2_862_933_555_777_941_757).wrapping_add(3_037_000_493);
    (0..n)
        .map(|_| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1u64 << 52) as f64 - 1.0
        })
        .collect()
}

/// A CSV file of `u` and `y = 2 u`, from noise.
pub fn noise_csv(n: usize, seed: u64) -> String {
    let mut text = String::from("u,y\n");
    for u in noise(n, seed) {
        text.push_str(&format!("{u},{}\n", 2.0 * u));
    }
    text
}

/// A CSV file of `u`, from noise, and `y`, which follows it with a lag.
pub fn lag_csv(n: usize, seed: u64) -> String {
    let mut y = 0.0;
    let row = |u: f64| {
        y += 0.3 * (u - y);
        format!("{u},{y}\n")
    };
    std::iter::once("u,y\n".to_owned()).chain(noise(n, seed).into_iter().map(row)).collect()
}

/// A model that multiplies every input by `gain` and gives the sum at every output: an FRF without
/// frequency dependence. Its training range is -1..1.
pub fn gain_model(inputs: &[&str], outputs: &[&str], gain: f64) -> RigModel {
    let own = |names: &[&str]| names.iter().map(|n| (*n).to_owned()).collect::<Vec<_>>();
    let (segment_len, n_inputs, n_outputs) = (8, inputs.len(), outputs.len());
    RigModel {
        kind: ModelKind::Frf,
        inputs: own(inputs),
        outputs: own(outputs),
        sample_rate_hz: 100.0,
        preprocess: Preprocess::default(),
        frf: Some(Frf {
            sample_rate_hz: 100.0,
            segment_len,
            n_inputs,
            n_outputs,
            h: vec![Complex64::new(gain, 0.0); (segment_len / 2 + 1) * n_inputs * n_outputs],
            usable_hz: [0.0, 50.0],
            x_mean: vec![0.0; n_inputs],
            y_mean: vec![0.0; n_outputs],
        }),
        frf_quality: None,
        core: Vec::new(),
        lstm: None,
        joint_range: None,
        window_range: Vec::new(),
        range: vec![
            InputRange { min: -1.0, max: 1.0, max_rate: 1000.0, band_hz: None, local: None };
            n_inputs
        ],
        band: None,
        effects: Vec::new(),
    }
}

/// The weight file of [`gain_model`].
pub fn gain_weights(inputs: &[&str], outputs: &[&str], gain: f64) -> Vec<u8> {
    to_safetensors(&gain_model(inputs, outputs, gain))
}

/// Media type of weight files.
pub const SAFETENSORS: &str = "application/x-safetensors";

impl TestApp {
    /// Creates a rig.
    pub async fn rig(&self, draft: &Value) {
        self.post_json("/v1/rigs", draft).await.expect(201);
    }

    /// Uploads a CSV run of the bench; returns the answer.
    pub async fn run(&self, query: &str, csv: &str) -> Value {
        self.post_file(&format!("/v1/rigs/bench/runs?{query}"), "text/csv", csv).await.expect(201).json()
    }

    /// Imports a model of a rig and makes it the active one; returns its version.
    pub async fn activate(&self, rig: &str, weights: Vec<u8>) -> u64 {
        let models = format!("/v1/rigs/{rig}/models");
        let model = self.post_file(&models, SAFETENSORS, weights).await.expect(201).json();
        let version = model["version"].as_u64().expect("a version");
        let active = format!("/v1/rigs/{rig}/active-model");
        let put = self.call("PUT", &active).header("if-match", "*").json(&json!({"version": version}));
        put.send().await.expect(200);
        version
    }

    /// The bench with a model `y = 2 u`.
    pub async fn bench_with_model(&self) {
        self.rig(&bench()).await;
        self.activate("bench", gain_weights(&["u"], &["y"], 2.0)).await;
    }

    /// Number of runs of the bench.
    pub async fn runs(&self) -> usize {
        let runs = self.get("/v1/rigs/bench/runs").await.expect(200).json();
        runs["items"].as_array().expect("items").len()
    }
}

/// An NPY file, version 1.0, of this descr, order and shape.
pub fn npy(descr: &str, fortran: bool, shape: &str, data: &[u8]) -> Vec<u8> {
    let fortran = if fortran { "True" } else { "False" };
    let mut header = format!("{{'descr': '{descr}', 'fortran_order': {fortran}, 'shape': {shape}, }}");
    while (header.len() + 11) % 64 != 0 {
        header.push(' ');
    }
    header.push('\n');
    let mut file = b"\x93NUMPY\x01\x00".to_vec();
    file.extend((header.len() as u16).to_le_bytes());
    file.extend(header.as_bytes());
    file.extend(data);
    file
}

/// Little-endian doubles.
pub fn f8(values: &[f64]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

/// Little-endian singles.
pub fn f4(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

/// The singles of an NPY file that the service wrote, and the text of its header.
pub fn read_f4(file: &[u8]) -> (String, Vec<f32>) {
    assert_eq!(&file[..8], b"\x93NUMPY\x01\x00", "an NPY file");
    let len = usize::from(u16::from_le_bytes([file[8], file[9]]));
    let header = String::from_utf8(file[10..10 + len].to_vec()).expect("text");
    let data = file[10 + len..].as_chunks::<4>().0;
    (header, data.iter().map(|b| f32::from_le_bytes(*b)).collect())
}
