//! Valid requests of every kind, from which mutants are made.

use serde_json::json;

use super::corpus::{CSV, Case, INFER, MODELS, NPY, PREDICT, RUNS};
use super::meter::WEIGHTS;
use crate::support::{bench, f4, f8, gain_weights, noise, noise_csv, npy};

pub fn seeds() -> Vec<Case> {
    let drive = json!({"sample_rate_hz": 100.0, "channels": {"u": noise(20, 3)}});
    let target = json!({"sample_rate_hz": 100.0, "channels": {"y": noise(20, 4)}});
    let parts = ["response", "damage", "errors", "trust"];
    let predict = json!({"drive": drive, "target": target, "include": parts, "damage": {"slope": 5}});
    let damage = json!({"predicted": drive, "groups": {"g": ["u", "u", "u"]}, "classes": {"count": 8}});
    let run = json!({"sample_rate_hz": 100.0, "channels": {"u": noise(20, 1), "y": noise(20, 2)}});
    let mut rig = bench();
    rig["id"] = json!("mutant");
    rig["fit_policy"] = json!({"kinds": ["noise"], "min_total_s": 1e6, "fits": [{"kind": "frf"}]});
    let singles: Vec<f32> = noise(40, 5).into_iter().map(|v| v as f32).collect();
    let timed: String =
        noise(20, 6).iter().enumerate().map(|(i, u)| format!("{:.2};{u:.4}\n", 0.01 * i as f64)).collect();
    let rate = format!("{PREDICT}?sample_rate_hz=100");
    let tensor = json!({"name": "drive", "datatype": "FP64", "shape": [20, 1], "data": noise(20, 7)});
    let infer = json!({"id": "1", "inputs": [tensor], "outputs": [{"name": "response"}]});
    let binary = json!({
        "name": "drive", "datatype": "FP32", "shape": [20, 1], "parameters": {"binary_data_size": 80},
    });
    let binary = json!({"inputs": [binary], "parameters": {"binary_data_output": true}}).to_string();
    let length = binary.len().to_string();
    let binary = [binary.into_bytes(), f4(&singles[..20])].concat();
    vec![
        Case::json("POST", INFER, infer.to_string()).named("tensors", ""),
        Case::file("POST", INFER, "application/octet-stream", binary)
            .with("inference-header-content-length", &length)
            .named("binary tensors", ""),
        Case::file("POST", RUNS, CSV, noise_csv(20, 1)).named("csv", ""),
        Case::file("POST", RUNS, CSV, format!("time_s;u\ns;kN\n{timed}").replace('.', ","))
            .named("csv with time", ""),
        Case::file("POST", RUNS, NPY, npy("<f8", false, "(20, 2)", &f8(&noise(40, 2)))).named("npy", ""),
        Case::file("POST", RUNS, NPY, npy(">f4", true, "(20, 2)", &f4(&singles))).named("npy, big end", ""),
        Case::json("POST", RUNS, run.to_string()).named("json run", ""),
        Case::file("POST", MODELS, WEIGHTS, gain_weights(&["u"], &["y"], 2.0)).named("weights", ""),
        Case::json("POST", PREDICT, predict.to_string()).named("prediction", ""),
        Case::file("POST", &rate, NPY, npy("<f4", false, "(20, 1)", &f4(&singles[..20])))
            .named("npy drive", ""),
        Case::json("POST", "/v1/damage", damage.to_string()).named("damage", ""),
        Case::json("POST", "/v1/rigs", rig.to_string()).named("rig", ""),
    ]
}
