//! `RIGCAST_ISA`: every instruction set gives the same predictions.

use rigcast::engine::simd::{ISA_VARIABLE, Isa};
use rigcast::formats::npy::{self, Dtype, Order};
use safetensors::SafeTensors;
use tempfile::TempDir;

use crate::support::{Program, columns, rigcast, vector_file, vector_rig};

/// The prediction of a program on `isa` with the weights `name` for their own input, `[channel][sample]`.
async fn predicted(isa: Isa, name: &str) -> Vec<Vec<f64>> {
    let directory = TempDir::new().expect("a directory");
    let program = Program::start(&directory, &[(ISA_VARIABLE, isa.name())]);
    let client = reqwest::Client::new();
    let url = |path: &str| format!("{}/v1/rigs{path}", program.base());
    let made = client.post(url("")).json(&vector_rig()).send().await.expect("an answer");
    assert_eq!(made.status(), 201);
    let upload = client.post(url("/torch/models")).header("content-type", "application/octet-stream");
    let model = upload.body(vector_file(name)).send().await.expect("an answer");
    assert_eq!(model.status(), 201);
    let bytes = vector_file(&format!("{name}_io"));
    let vectors = SafeTensors::deserialize(&bytes).expect("a safetensors file");
    let drive = npy::write(&columns(&vectors, "x"), Dtype::F8, Order::C).expect("finite");
    let predict = client.post(url("/torch/predict?model=1&sample_rate_hz=1000"));
    let predict = predict.header("content-type", "application/x-npy").header("accept", "application/x-npy");
    let answer = predict.body(drive).send().await.expect("an answer");
    assert_eq!(answer.status(), 200);
    npy::read(&answer.bytes().await.expect("a body")).expect("an NPY file").channels
}

#[tokio::test]
async fn every_instruction_set_that_the_variable_names_predicts_the_same() {
    for name in ["torch_lstm", "torch_hybrid2"] {
        let expected = predicted(Isa::Portable, name).await;
        for isa in [Isa::Avx2, Isa::Avx512] {
            if !isa.is_available() {
                println!("skipped {}: not on this machine", isa.name());
                continue;
            }
            let found = predicted(isa, name).await;
            assert_eq!(found.len(), expected.len());
            for (found, expected) in found.iter().zip(&expected) {
                let n = expected.len() as f64;
                let mean = expected.iter().sum::<f64>() / n;
                let std = (expected.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt();
                let worst = found.iter().zip(expected).map(|(f, e)| (f - e).abs()).fold(0.0, f64::max);
                assert!(worst <= 1e-5 * std, "{name} on {}: {worst} of {std}", isa.name());
            }
        }
    }
}

#[test]
fn an_unknown_instruction_set_is_refused_at_the_start() {
    let directory = TempDir::new().expect("a directory");
    let path = directory.path().join("data");
    let path = path.to_str().expect("UTF-8");
    let arguments = ["serve", "--listen", "127.0.0.1:0", "--data-dir", path];
    let refused = rigcast(&arguments).env(ISA_VARIABLE, "sse9").output().expect("it ends");
    assert_eq!(refused.status.code(), Some(1));
    let said = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(said.contains(ISA_VARIABLE) && said.contains("sse9"), "{said}");
    assert!(!std::path::Path::new(path).exists(), "nothing was made");
}
