//! The works of a large rig: 32 drives, 32 responses. They shall take no longer than channels squared ask for.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rigcast::engine::frf::{FrfSettings, estimate};
use rigcast::engine::lstm::{LstmNet, Recombine, predict};
use rigcast::engine::model::{
    FitData, FitSettings, LstmOptions, ModelKind, Pair, Predictor, Preprocess, Preset, Task, fit,
};
use rigcast::engine::progress::unwatched;
use rigcast::engine::{EngineError, Signal};

use crate::works::{self, FS, HOP, WINDOW};
use crate::{Report, seconds};

/// Drives, and responses.
const N: usize = 32;

/// Prints the rows.
pub fn measure(report: &Report) -> Result<(), EngineError> {
    let channels: Vec<Vec<f64>> = (0..N as u64).map(|c| works::noise(1200 * FS, 500 + c)).collect();
    let x = Signal::new(FS as f64, channels)?;
    // Each response is its drive, a part of the next one, and noise.
    let response = |o: usize| -> Vec<f64> {
        let (own, next) = (x.channel(o), x.channel((o + 1) % N));
        let noise = works::noise(x.n_samples(), 900 + o as u64);
        own.iter().zip(next).zip(noise).map(|((a, b), c)| a + 0.5 * b + 0.01 * c).collect()
    };
    let y = Signal::new(FS as f64, (0..N).map(response).collect())?;
    for (work, settings, reps) in [
        ("large_h1_20min", works::frf_settings(), 3),
        // Segment length and ridge are chosen by held-out prediction.
        ("large_frf_20min", FrfSettings::default(), 1),
    ] {
        report.print(work, "s", seconds(reps, || estimate(&[(&x, &y)], &settings, &unwatched))?);
    }
    let data = FitData::of_training(vec![Pair { x, y }]);
    let mut fitted = None;
    let took = seconds(1, || {
        fitted = Some(fit(&data, &settings(), &unwatched)?.model);
        Ok(())
    })?;
    report.print("large_fit_frf_20min", "s", took);
    let drive = data.training[0].x.slice(0..600 * FS);
    drop(data);
    let model = fitted.expect("it was fitted");
    let filter = model.frf.as_ref().expect("a fitted FRF").filter()?;
    report.print("large_apply_10min", "s", seconds(5, || filter.apply(&drive))?);
    let predictor = Predictor::new(model)?;
    let prediction = predictor.begin(drive)?;
    report.print("large_trust_10min", "s", seconds(5, || Ok(predictor.trust(&prediction)))?);

    let net = LstmNet::init(2 * N, &[39], N, 1.0, &mut ChaCha8Rng::seed_from_u64(1));
    let one: Vec<f32> = works::noise(600 * FS, 1).iter().map(|&v| v as f32).collect();
    let inputs = vec![one; 2 * N];
    let took = seconds(3, || predict(&net, &inputs, WINDOW, HOP, Recombine::Welch))?;
    report.print("large_infer_600s", "signal_s_per_s", took.into_iter().map(|s| 600.0 / s).collect());
    Ok(())
}

/// An FRF on segments of a given length.
fn settings() -> FitSettings {
    let names = |what: &str| (0..N).map(|i| format!("{what}_{i}")).collect();
    FitSettings {
        kind: ModelKind::Frf,
        task: Task::Forward,
        inputs: names("drive"),
        outputs: names("force"),
        preprocess: Preprocess::default(),
        frf: works::frf_settings(),
        lstm: LstmOptions::default(),
        preset: Preset::Default,
        start: None,
        core: None,
    }
}
