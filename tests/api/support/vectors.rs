//! Weights that PyTorch wrote, with their inputs and outputs.

use safetensors::SafeTensors;
use serde_json::{Value, json};

/// A committed file of `tests/vectors/`.
pub fn vector_file(name: &str) -> Vec<u8> {
    let path = format!("{}/tests/vectors/{name}.safetensors", env!("CARGO_MANIFEST_DIR"));
    std::fs::read(&path).unwrap_or_else(|e| panic!("{path}: {e}"))
}

/// A `[sample, channel]` tensor as `[channel][sample]`.
pub fn columns(file: &SafeTensors, name: &str) -> Vec<Vec<f64>> {
    let view = file.tensor(name).expect("the tensor is there");
    let data = view.data();
    let values: Vec<f64> = match view.dtype() {
        safetensors::Dtype::F32 => {
            data.chunks_exact(4).map(|b| f64::from(f32::from_le_bytes(b.try_into().expect("four")))).collect()
        }
        safetensors::Dtype::F64 => {
            data.chunks_exact(8).map(|b| f64::from_le_bytes(b.try_into().expect("eight"))).collect()
        }
        other => panic!("{other:?}"),
    };
    let channels = view.shape()[1];
    (0..channels).map(|c| values.iter().skip(c).step_by(channels).copied().collect()).collect()
}

/// The rig that the weights are for.
pub fn vector_rig() -> Value {
    let channel =
        |name: &str, role: &str| json!({"name": name, "unit": "kN", "role": role, "quantity": "force"});
    json!({"id": "torch", "name": "Weights made elsewhere", "sample_rate_hz": 1000.0, "channels": [
        channel("drive_x", "drive"), channel("drive_y", "drive"), channel("drive_z", "drive"),
        channel("force_x", "response"), channel("force_y", "response")]})
}
