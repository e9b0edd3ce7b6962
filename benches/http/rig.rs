//! The rig, the model and the drives that are sent: the paper's sizes, all seeded.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use realfft::num_complex::Complex64;
use rigcast::engine::frf::Frf;
use rigcast::engine::lstm::{LstmNet, Recombine};
use rigcast::engine::model::{InputRange, LstmPart, ModelKind, Preprocess, RigModel, Scaler, to_safetensors};
use rigcast::formats::npy::{Dtype, Order, write};
use serde_json::{Value, json};

use crate::service::Service;

/// Samples per second.
pub const RATE_HZ: f64 = 1000.0;
/// Drives of the rig.
pub const DRIVES: [&str; 3] = ["drive_x", "drive_y", "drive_z"];
/// Responses of the rig.
pub const RESPONSES: [&str; 6] = ["disp_x", "disp_y", "disp_z", "force_x", "force_y", "force_z"];

/// Path of predictions.
pub const PREDICT: &str = "POST /v1/rigs/bench/predict";

/// Smooth noise: white noise after a first-order low pass of some 30 Hz, standard deviation 1.
pub fn noise(samples: usize, channels: usize, seed: u64) -> Vec<Vec<f64>> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    (0..channels)
        .map(|_| {
            let mut state = 0.0;
            (0..samples)
                .map(|_| {
                    state += 0.17 * (5.8 * (rng.random::<f64>() - 0.5) * 1.95 - state);
                    state
                })
                .collect()
        })
        .collect()
}

/// A hybrid 2 of 39 cells, windows of 256 at half overlap, random weights.
fn hybrid2() -> RigModel {
    let own = |names: &[&str]| names.iter().map(|n| (*n).to_owned()).collect::<Vec<_>>();
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let (inputs, outputs, segment_len) = (DRIVES.len(), RESPONSES.len(), 4096);
    let lines = segment_len / 2 + 1;
    let line = |line: usize, rng: &mut ChaCha8Rng| {
        // The fall-off of an oscillator, so that the response is a plausible signal.
        let gain = 1.0 / (1.0 + (line as f64 / 100.0).powi(2));
        let imaginary = if line == 0 || line == lines - 1 { 0.0 } else { rng.random::<f64>() - 0.5 };
        Complex64::new(rng.random::<f64>() - 0.5, imaginary) * gain
    };
    let h = (0..lines * inputs * outputs).map(|i| line(i / (inputs * outputs), &mut rng)).collect();
    let frf = Frf {
        sample_rate_hz: RATE_HZ,
        segment_len,
        n_inputs: inputs,
        n_outputs: outputs,
        h,
        usable_hz: [0.0, RATE_HZ / 2.0],
        x_mean: vec![0.0; inputs],
        y_mean: vec![0.0; outputs],
    };
    let scaler = |n: usize| Scaler { mean: vec![0.1; n], std: vec![1.3; n] };
    RigModel {
        kind: ModelKind::Hybrid2,
        inputs: own(&DRIVES),
        outputs: own(&RESPONSES),
        sample_rate_hz: RATE_HZ,
        preprocess: Preprocess::default(),
        frf: Some(frf),
        frf_quality: None,
        core: Vec::new(),
        lstm: Some(LstmPart {
            net: LstmNet::init(inputs + outputs, &[39], outputs, 1.0, &mut rng),
            x: scaler(inputs + outputs),
            y: scaler(outputs),
            window_len: 256,
            hop: 128,
            recombine: Recombine::Welch,
        }),
        joint_range: None,
        window_range: Vec::new(),
        range: vec![InputRange { min: -20.0, max: 20.0, max_rate: 1e6, band_hz: None, local: None }; inputs],
        band: None,
        effects: Vec::new(),
    }
}

/// Makes the rig, without groups: there is no Multi-Rain.
pub fn create(service: &Service) {
    create_with(service, |_| json!({}));
}

/// Makes the rig with both of its groups of three, displacement and force.
pub fn create_grouped(service: &Service) {
    create_with(service, |name| {
        let (group, axis) = name.split_once('_').expect("names have two parts");
        json!({"group": group, "axis": axis})
    });
}

fn create_with(service: &Service, more: impl Fn(&str) -> Value) {
    let channel = |name: &str, role: &str, more: Value| {
        let mut channel = json!({"name": name, "unit": "kN", "role": role});
        channel.as_object_mut().expect("an object").extend(more.as_object().cloned().unwrap_or_default());
        channel
    };
    let drives = DRIVES.iter().map(|name| channel(name, "drive", json!({})));
    let responses = RESPONSES.iter().map(|name| channel(name, "response", more(name)));
    let channels: Vec<Value> = drives.chain(responses).collect();
    let rig = json!({"id": "bench", "name": "Bench", "sample_rate_hz": RATE_HZ, "channels": channels});
    service.connect().json("POST /v1/rigs", "", &rig, 201);
}

/// Imports the model and makes it the active one.
pub fn activate(service: &Service, recombine: Recombine, low_pass_hz: Option<f64>) {
    let mut model = hybrid2();
    model.preprocess.low_pass_hz = low_pass_hz;
    if let Some(part) = &mut model.lstm {
        part.recombine = recombine;
    }
    let mut connection = service.connect();
    let head = "POST /v1/rigs/bench/models HTTP/1.1\r\nContent-Type: application/x-safetensors";
    let answer = connection.call(head, &to_safetensors(&model), 201);
    let version = serde_json::from_slice::<Value>(answer).expect("JSON")["version"].clone();
    let put = "PUT /v1/rigs/bench/active-model";
    connection.json(put, "\r\nIf-Match: *", &json!({ "version": version }), 200);
}

/// A prediction with an NPY drive of `<f4` or `<f8` and an NPY answer: head and body.
pub fn npy_request(samples: usize, dtype: Dtype) -> (String, Vec<u8>) {
    let head = format!(
        "{PREDICT}?sample_rate_hz={RATE_HZ} HTTP/1.1\r\nContent-Type: application/x-npy\r\nAccept: application/x-npy"
    );
    (head, write(&noise(samples, DRIVES.len(), 7), dtype, Order::C).expect("a drive"))
}

/// The same with JSON in request and answer; numbers have all their digits.
pub fn json_request(samples: usize) -> (String, Vec<u8>) {
    json_body(json!({"drive": signal(&DRIVES, samples, 7)}))
}

/// A JSON request with a target for each response: the answer has response, errors, damage and trust.
pub fn json_request_with_targets(samples: usize) -> (String, Vec<u8>) {
    json_body(json!({"drive": signal(&DRIVES, samples, 7), "target": signal(&RESPONSES, samples, 8)}))
}

fn signal(names: &[&str], samples: usize, seed: u64) -> Value {
    let channels: serde_json::Map<String, Value> = names
        .iter()
        .zip(noise(samples, names.len(), seed))
        .map(|(name, s)| ((*name).into(), s.into()))
        .collect();
    json!({"sample_rate_hz": RATE_HZ, "channels": channels})
}

fn json_body(body: Value) -> (String, Vec<u8>) {
    (format!("{PREDICT} HTTP/1.1\r\nContent-Type: application/json"), body.to_string().into_bytes())
}
