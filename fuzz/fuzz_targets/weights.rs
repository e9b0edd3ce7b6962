//! Weight files: a model that is read can be written, reads back as the same, and predicts finite numbers
//! or returns an error.
#![no_main]

use libfuzzer_sys::fuzz_target;
use rigcast::engine::Signal;
use rigcast::engine::model::{Predictor, from_safetensors, to_safetensors};
use rigcast::engine::progress::unwatched;
use rigcast_fuzz::plant;

/// Operations of a network above which predicting would only be slow.
const MAX_WORK: f64 = 1e7;

fuzz_target!(init: plant("weights"), |file: &[u8]| {
    let Ok(model) = from_safetensors(file) else { return };
    let written = to_safetensors(&model);
    assert_eq!(from_safetensors(&written).as_ref(), Ok(&model), "what is written reads back");
    let (inputs, rate) = (model.inputs.len(), model.sample_rate_hz);
    let Ok(predictor) = Predictor::new(model) else { return };
    let drive = |c: usize| (0..40).map(|i| ((i + 3 * c) as f64 * 0.7).sin()).collect();
    let Ok(drive) = Signal::new(rate, (0..inputs).map(drive).collect()) else { return };
    if predictor.network_work(drive.n_samples()) > MAX_WORK {
        return;
    }
    let Ok(mut prediction) = predictor.begin(drive) else { return };
    let Ok(response) = predictor.rest(&mut prediction, &unwatched) else { return };
    assert!(response.channels().iter().flatten().all(|v| v.is_finite()), "what is answered is finite");
});
