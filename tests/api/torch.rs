//! Weights that PyTorch wrote (`scripts/export_torch.py`), imported and used by the service.

use rigcast::formats::npy::{self, Dtype, Order};
use safetensors::SafeTensors;

use crate::support::{TestApp, columns, vector_file, vector_rig};

#[tokio::test]
async fn the_services_prediction_is_that_of_the_framework_that_made_the_weights() {
    let app = TestApp::start();
    app.post_json("/v1/rigs", &vector_rig()).await.expect(201);
    for name in ["torch_lstm", "torch_hybrid2"] {
        let path = "/v1/rigs/torch/models";
        let model =
            app.post_file(path, "application/octet-stream", vector_file(name)).await.expect(201).json();
        let bytes = vector_file(&format!("{name}_io"));
        let vectors = SafeTensors::deserialize(&bytes).expect("a safetensors file");
        let drive = npy::write(&columns(&vectors, "x"), Dtype::F8, Order::C).expect("finite");
        let predict = format!("/v1/rigs/torch/predict?model={}&sample_rate_hz=1000", model["version"]);
        let call = app.call("POST", &predict).header("accept", "application/x-npy");
        let answer = call.body("application/x-npy", drive).send().await.expect(200);
        let predicted = npy::read(&answer.bytes).expect("an NPY file").channels;
        let expected = columns(&vectors, "y.welch");
        assert_eq!(predicted.len(), expected.len());
        for (predicted, expected) in predicted.iter().zip(&expected) {
            assert_eq!(predicted.len(), expected.len());
            let n = expected.len() as f64;
            let mean = expected.iter().sum::<f64>() / n;
            let std = (expected.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt();
            // f32 sums in another order, as in the engine's own comparison.
            let worst = predicted.iter().zip(expected).map(|(p, e)| (p - e).abs()).fold(0.0, f64::max);
            assert!(worst < 1e-5 * std.max(mean.abs()), "{name}: {worst} of {std}");
        }
    }
}
