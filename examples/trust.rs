//! Whether the trust of a model tells where its error doubles: `cargo run --release --example trust -- [--seed 1]`
//!
//! Fits a hybrid 2 to noise of the virtual rig and predicts 40 drives that nothing was fitted on: 20 like the training,
//! and 20 that leave it, 12 of them built so that every value of every channel stays inside its own range. Prints for each
//! drive the share inside and the RMS error over the usual one (that of the median drive like the training, geometric mean
//! over the outputs), then the area under the ROC curve of "the error doubles" over the share outside, the share of
//! samples of drives like the training that are outside, and the errors with the FRF in place of the model outside.

mod bench_programme;

use bench_programme::{fit_data, fitted, record};
use clap::Parser;
use rayon::prelude::*;
use rigcast::engine::model::{FitSplit, LstmOptions, ModelKind, Predictor, Preset, RigModel, Task, Trust};
use rigcast::engine::progress::unwatched;
use rigcast::engine::virtual_rig::VirtualRig;
use rigcast::engine::virtual_rig::drives::{
    MixedNoise, Noise, NoiseRegion, ServiceLoad, ServiceShape, Sine, Sweep, mixed_noise, noise, service_load,
    sine, sweep,
};
use rigcast::engine::{EngineError, Signal};
use serde_json::json;

/// Judges drives inside and outside.
#[derive(Debug, Parser)]
struct Args {
    /// Seed of the rig, its runs and the network.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Minutes of training noise.
    #[arg(long, default_value_t = 10.0)]
    minutes: f64,
    /// Epochs; left out: those of the default preset.
    #[arg(long)]
    epochs: Option<usize>,
}

/// Length of a drive, s.
const DRIVE_S: f64 = 30.0;

/// Which drives of the figures one belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Class {
    /// Like the training.
    Inside,
    /// It leaves the training, but no channel its own range of values.
    Hidden,
    /// A channel leaves its range.
    Beyond,
}

/// A drive with its name.
struct Drive {
    class: Class,
    name: String,
    x: Signal,
}

/// What was found of one.
struct Found {
    trust: Trust,
    /// Whether each channel stays within its own range of values.
    within: bool,
    /// RMS error of each output, channel unit.
    errors: Vec<f64>,
    /// With the FRF outside.
    fallen_back: Vec<f64>,
    /// With the FRF alone.
    linear: Vec<f64>,
}

fn main() -> Result<(), EngineError> {
    let args = Args::parse();
    let rig = VirtualRig::draw(args.seed);
    let runs = record(args.minutes, args.seed)?;
    let mut data = fit_data(&runs);
    data.split = FitSplit::ValidationHalves;
    let lstm = LstmOptions { seeds: Some(vec![args.seed]), epochs: args.epochs, ..LstmOptions::default() };
    let model = fitted(Task::Forward, ModelKind::Hybrid2, Preset::Default, lstm, &data, &unwatched)?.model;
    let frf = RigModel { kind: ModelKind::Frf, lstm: None, ..model.clone() };
    let (predictor, frf) = (Predictor::new(model)?, Predictor::new(frf)?);
    let drives = drives(args.seed)?;
    let found: Vec<Found> = drives
        .par_iter()
        .enumerate()
        .map(|(k, drive)| judge(&rig, &predictor, &frf, &drive.x, args.seed.wrapping_mul(7919) + k as u64))
        .collect::<Result<_, EngineError>>()?;
    report(&drives, &found);
    Ok(())
}

fn judge(
    rig: &VirtualRig,
    predictor: &Predictor,
    frf: &Predictor,
    x: &Signal,
    sensors: u64,
) -> Result<Found, EngineError> {
    let y = rig.simulate(x, sensors)?;
    let of = |predicted: &Signal| -> Vec<f64> {
        let one = |(p, m): (&Vec<f64>, &Vec<f64>)| {
            let squares: f64 = p.iter().zip(m).map(|(p, m)| (p - m).powi(2)).sum();
            (squares / p.len() as f64).sqrt()
        };
        predicted.channels().iter().zip(y.channels()).map(one).collect()
    };
    let mut prediction = predictor.begin(x.clone())?;
    let trust = predictor.trust(&prediction);
    predictor.fall_back(&mut prediction, &trust);
    let mut ranges = predictor.model().range.iter().zip(x.channels());
    Ok(Found {
        within: ranges.all(|(range, samples)| samples.iter().all(|v| (range.min..=range.max).contains(v))),
        errors: of(&predictor.predict(x.clone())?),
        fallen_back: of(&predictor.rest(&mut prediction, &unwatched)?),
        linear: of(&frf.predict(x.clone())?),
        trust,
    })
}

fn report(drives: &[Drive], found: &[Found]) {
    let n = found[0].errors.len();
    // The usual error of each output: the median over the drives like the training.
    let usual: Vec<f64> = (0..n)
        .map(|c| {
            let like = drives.iter().zip(found).filter(|(drive, _)| drive.class == Class::Inside);
            let mut errors: Vec<f64> = like.map(|(_, found)| found.errors[c]).collect();
            errors.sort_by(f64::total_cmp);
            errors[errors.len() / 2]
        })
        .collect();
    // The geometric mean over the outputs.
    let over_usual = |errors: &[f64]| {
        let sum: f64 = errors.iter().zip(&usual).map(|(error, usual)| (error / usual).ln()).sum();
        (sum / n as f64).exp()
    };
    for (drive, found) in drives.iter().zip(found) {
        let reasons: Vec<&str> = found.trust.spans.iter().map(|span| span.reason.as_str()).take(2).collect();
        println!(
            "{}",
            json!({"drive": drive.name, "class": format!("{:?}", drive.class), "within_values": found.within,
                   "inside": found.trust.inside, "error_over_usual": over_usual(&found.errors),
                   "with_fallback": over_usual(&found.fallen_back), "frf": over_usual(&found.linear),
                   "reasons": reasons})
        );
    }
    let points: Vec<(f64, bool)> =
        found.iter().map(|found| (1.0 - found.trust.inside, over_usual(&found.errors) > 2.0)).collect();
    let of = |wanted: &dyn Fn(&Drive) -> bool| -> Vec<&Found> {
        drives.iter().zip(found).filter(|(drive, _)| wanted(drive)).map(|(_, found)| found).collect()
    };
    let like = of(&|drive| drive.class == Class::Inside);
    let flagged = like.iter().map(|found| 1.0 - found.trust.inside).sum::<f64>() / like.len() as f64;
    let outside = of(&|drive| drive.class != Class::Inside);
    let hidden = outside.iter().filter(|found| found.within).count();
    let fallback = |name: &str| {
        let of_name = of(&|drive| drive.name == name);
        let mean = |errors: fn(&Found) -> &Vec<f64>| {
            of_name.iter().map(|found| over_usual(errors(found))).sum::<f64>() / of_name.len() as f64
        };
        let (frf, model, with) = (mean(|f| &f.linear), mean(|f| &f.errors), mean(|f| &f.fallen_back));
        json!({"frf": frf, "model": model, "with_fallback": with,
               "over_frf": with / frf, "over_model": with / model})
    };
    println!(
        "{}",
        json!({"drives": found.len(), "outside": outside.len(), "outside_within_values": hidden,
               "error_doubles": points.iter().filter(|(_, doubles)| *doubles).count(),
               "area_under_curve": area(&points), "flagged_like_training": flagged,
               "boundary": fallback("boundary"), "service": fallback("service")})
    );
}

/// Area under the ROC curve: how often a drive whose error doubles has the larger share outside, ties counted half.
fn area(points: &[(f64, bool)]) -> f64 {
    let (mut wins, mut pairs) = (0.0, 0.0);
    for (bad, _) in points.iter().filter(|(_, doubled)| *doubled) {
        for (good, _) in points.iter().filter(|(_, doubled)| !*doubled) {
            pairs += 1.0;
            wins += if bad > good {
                1.0
            } else if bad < good {
                0.0
            } else {
                0.5
            };
        }
    }
    wins / pairs
}

/// A sine on all axes, each at a phase of its own.
fn tone(hz: f64, amplitude_kn: f64) -> Result<Signal, EngineError> {
    sine(&Sine {
        duration_s: DRIVE_S,
        frequency_hz: [hz; 3],
        amplitude_kn: [amplitude_kn; 3],
        mean_kn: [0.0; 3],
        phase_rad: [0.0, 1.0, 2.0],
    })
}

/// 20 drives like the training, 12 that leave it with every value inside, 8 that leave it plainly.
fn drives(seed: u64) -> Result<Vec<Drive>, EngineError> {
    let seed = |k: u64| seed.wrapping_mul(1_000_003).wrapping_add(90_000 + k);
    let mut all = Vec::new();
    let mut add = |class: Class, name: &str, x: Signal| all.push(Drive { class, name: name.into(), x });
    let of_noise = |mean_kn: [f64; 3], amplitude_kn: [f64; 3], k: u64| {
        noise(&Noise { duration_s: DRIVE_S, mean_kn, amplitude_kn }, seed(k))
    };
    for k in 0..8 {
        let mixed = MixedNoise { duration_s: DRIVE_S, stretch_s: 7.5, region: NoiseRegion::Interior };
        add(Class::Inside, "noise", mixed_noise(&mixed, seed(k))?);
    }
    for (k, shape) in ServiceShape::ALL.into_iter().enumerate() {
        for (j, (scale, offset_kn)) in
            [(0.5, 0.0), (0.8, 0.0), (0.3, 2.5), (0.3, -2.5)].into_iter().enumerate()
        {
            let load = ServiceLoad { shape, duration_s: DRIVE_S, scale, offset_kn };
            add(Class::Inside, "service", service_load(&load, seed(10 + 4 * k as u64 + j as u64))?);
        }
    }
    // All channels strong at once, and in step.
    for (k, mean) in [[0.0; 3], [2.0, -2.0, 2.0], [-2.0; 3]].into_iter().enumerate() {
        let x = of_noise([0.0; 3], [1.9, 0.0, 0.0], 40 + k as u64)?;
        let same = |axis: usize| x.channel(0).iter().map(|v| mean[axis] + v).collect();
        add(Class::Hidden, "in step", Signal::new(x.sample_rate_hz(), (0..3).map(same).collect())?);
    }
    // A corner of the means that each axis reaches alone.
    for (k, mean) in [[3.7; 3], [-3.7, 3.7, -3.7], [3.7, 3.7, -3.7]].into_iter().enumerate() {
        add(Class::Hidden, "corner", of_noise(mean, [0.6; 3], 44 + k as u64)?);
    }
    // The power of the training in one line, or in a narrow band.
    for (hz, amplitude_kn) in [(5.0, 1.6), (10.0, 1.6), (14.0, 2.5)] {
        add(Class::Hidden, "tone", tone(hz, amplitude_kn)?);
    }
    // Fast and strong, though within the values.
    for (hz, amplitude_kn) in [(30.0, 3.0), (40.0, 3.0), (48.0, 3.0)] {
        add(Class::Hidden, "fast", tone(hz, amplitude_kn)?);
    }
    for k in 0..4 {
        let mixed = MixedNoise { duration_s: DRIVE_S, stretch_s: 7.5, region: NoiseRegion::Boundary };
        add(Class::Beyond, "boundary", mixed_noise(&mixed, seed(50 + k))?);
    }
    for k in 0..2 {
        add(Class::Beyond, "strong", of_noise([0.0; 3], [5.0; 3], 60 + k)?);
    }
    add(Class::Beyond, "out of band", tone(80.0, 0.3)?);
    let swept = Sweep {
        duration_s: DRIVE_S,
        from_hz: 5.0,
        to_hz: 70.0,
        amplitude_kn: 3.0,
        mean_kn: [3.0, -3.0, 3.0],
    };
    add(Class::Beyond, "sweep", sweep(&swept)?);
    Ok(all)
}
