//! The preset of the source paper against Keras, with which the paper was made
//! (`scripts/keras_vectors.py`, committed under `tests/vectors`).

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use safetensors::{Dtype, SafeTensors};

use super::tests::{data, settings};
use super::*;
use crate::checkpoint::NoCheckpoints;
use crate::frf::Estimator;
use crate::lstm::{HybridStart, LstmBlock, LstmSettings, RecombineChoice, Segment, Trained, Until, train};
use crate::progress::unwatched;

/// A training that Keras did.
struct Keras(Vec<u8>);

impl Keras {
    fn read(name: &str) -> Self {
        let path = format!("{}/../../tests/vectors/{name}.safetensors", env!("CARGO_MANIFEST_DIR"));
        Self(std::fs::read(&path).unwrap_or_else(|e| panic!("{path}: {e}")))
    }

    /// A tensor's shape and values.
    fn get(&self, name: &str) -> (Vec<usize>, Vec<f64>) {
        let file = SafeTensors::deserialize(&self.0).unwrap();
        let view = file.tensor(name).unwrap_or_else(|e| panic!("{name}: {e}"));
        let values = match view.dtype() {
            Dtype::F32 => {
                view.data().as_chunks().0.iter().map(|b| f64::from(f32::from_le_bytes(*b))).collect()
            }
            Dtype::F64 => view.data().as_chunks().0.iter().map(|b| f64::from_le_bytes(*b)).collect(),
            other => panic!("{name}: {other:?}"),
        };
        (view.shape().to_vec(), values)
    }

    fn f32s(&self, name: &str) -> Vec<f32> {
        self.get(name).1.into_iter().map(|v| v as f32).collect()
    }

    /// The network at one point of the training.
    fn net(&self, when: &str, blocks: &[usize]) -> LstmNet {
        let mut inputs = 2;
        let block = |(i, &cells): (usize, &usize)| {
            let tensor = |name: &str| self.f32s(&format!("{when}.lstm.{i}.{name}"));
            let (weight_ih, weight_hh, bias) = (tensor("weight_ih"), tensor("weight_hh"), tensor("bias"));
            LstmBlock { inputs: std::mem::replace(&mut inputs, cells), cells, weight_ih, weight_hh, bias }
        };
        let net = LstmNet {
            blocks: blocks.iter().enumerate().map(block).collect(),
            outputs: 2,
            fc_weight: self.f32s(&format!("{when}.fc.weight")),
            fc_bias: self.f32s(&format!("{when}.fc.bias")),
        };
        assert_eq!(net.check(), Ok(()));
        net
    }

    /// A run; `of` is what stands between the name and `x` or `y`.
    fn run(&self, x: &str, y: &str) -> Segment {
        let planar = |name: &str| {
            let values = self.f32s(name);
            (0..2).map(|c| values[c..].iter().step_by(2).copied().collect()).collect()
        };
        Segment { x: planar(x), y: planar(y), score_from: 0 }
    }
}

const TRAININGS: [(&str, &[usize]); 2] = [("keras_10", &[10]), ("keras_6_5", &[6, 5])];

/// The preset's settings on the small networks and short windows of the vectors.
fn paper(keras: &Keras, blocks: &[usize]) -> LstmSettings {
    let options = LstmOptions {
        blocks: Some(blocks.to_vec()),
        window_len: Some(64),
        epochs: Some(keras.get("loss").1.len()),
        learning_rate: Some(keras.get("rate").1[0]),
        ..LstmOptions::default()
    };
    options.resolve(Preset::Paper, ModelKind::Lstm, Task::Forward, &[500, 333]).unwrap()
}

fn trained(keras: &Keras, blocks: &[usize], settings: &LstmSettings) -> Trained {
    let runs = [keras.run("x.0", "y.0"), keras.run("x.1", "y.1")];
    let validation = [keras.run("validation.x", "validation.y")];
    let start = keras.net("start", blocks);
    train(&runs, Until::Best(&validation), &start, (settings, 1), (&NoCheckpoints, ""), &unwatched).unwrap()
}

/// Largest distance of two networks' weights.
fn distance(a: &LstmNet, b: &LstmNet) -> f64 {
    let all = |net: &LstmNet| -> Vec<f32> {
        let blocks = net.blocks.iter().flat_map(|b| [&b.weight_ih, &b.weight_hh, &b.bias]);
        blocks.chain([&net.fc_weight, &net.fc_bias]).flatten().copied().collect()
    };
    all(a).iter().zip(all(b)).map(|(a, b)| f64::from((a - b).abs())).fold(0.0, f64::max)
}

#[test]
fn it_trains_as_keras_does() {
    for (name, blocks) in TRAININGS {
        let keras = Keras::read(name);
        let settings = paper(&keras, blocks);
        let trained = trained(&keras, blocks, &settings);
        let (loss, validation) = (keras.get("loss").1, keras.get("validation.loss").1);
        assert_eq!(trained.history.len(), loss.len(), "every epoch is validated");
        for (epoch, (loss, validation)) in trained.history.iter().zip(loss.iter().zip(&validation)) {
            let of = |found: f64, expected: f64| (found / expected - 1.0).abs();
            let errors = (of(epoch.training_mse, *loss), of(epoch.validation_mse, *validation));
            println!("{name} epoch {}: {:.1e} {:.1e}", epoch.epoch, errors.0, errors.1);
            assert!(errors.0 < 1e-5 && errors.1 < 1e-5, "{name} epoch {}: {errors:?}", epoch.epoch);
        }
        assert_eq!(trained.best_epoch, keras.get("best.epoch").1[0] as usize);
        assert!(trained.best_epoch < loss.len(), "not merely the last one");
        let best = keras.net("best", blocks);
        let (off, moved) = (distance(&trained.net, &best), distance(&best, &keras.net("start", blocks)));
        println!("{name}: weights moved {moved:.2e}, off by {off:.1e}");
        assert!(off < 1e-5 * moved, "{name}: moved {moved}, off by {off}");
    }
}

#[test]
fn each_setting_of_ours_in_its_place_would_train_otherwise() {
    let (name, blocks) = TRAININGS[0];
    let keras = Keras::read(name);
    let paper = paper(&keras, blocks);
    let ours = LstmOptions::default()
        .resolve(Preset::Default, ModelKind::Hybrid2, Task::Forward, &[500, 333])
        .unwrap();
    let best = keras.net("best", blocks);
    let moved = distance(&best, &keras.net("start", blocks));
    for (what, settings) in [
        ("window_offset", LstmSettings { window_offset: ours.window_offset, ..paper.clone() }),
        ("optimizer", LstmSettings { optimizer: ours.optimizer, ..paper.clone() }),
        ("schedule", LstmSettings { schedule: ours.schedule, ..paper.clone() }),
        ("warmup_steps", LstmSettings { warmup_steps: ours.warmup_steps, ..paper.clone() }),
        ("burn_in", LstmSettings { burn_in: ours.burn_in, ..paper.clone() }),
        ("clip_norm", LstmSettings { clip_norm: Some(1e-2), ..paper.clone() }),
    ] {
        let off = distance(&trained(&keras, blocks, &settings).net, &best);
        assert!(off > 0.02 * moved, "{what}: {off} of {moved}");
    }
}

#[test]
fn its_networks_start_as_those_of_keras() {
    for (name, blocks) in TRAININGS {
        let keras = Keras::read(name).net("start", blocks);
        let rng = &mut ChaCha8Rng::seed_from_u64(1);
        let forget_bias = paper(&Keras::read(name), blocks).forget_bias;
        for net in [keras, LstmNet::init(2, blocks, 2, forget_bias, rng)] {
            // Uniform up to Glorot's limit: the largest of so many draws is near it, and their variance a
            // third of its square.
            let glorot = |weights: &[f32], fans: usize| {
                let limit = (6.0 / fans as f64).sqrt();
                let largest = weights.iter().map(|w| f64::from(w.abs())).fold(0.0, f64::max);
                assert!(
                    (0.8 * limit..=limit * (1.0 + 1e-6)).contains(&largest),
                    "{name}: {largest} of {limit}"
                );
                let square = weights.iter().map(|w| f64::from(*w).powi(2)).sum::<f64>();
                let variance = 3.0 * square / weights.len() as f64 / limit.powi(2);
                assert!((0.5..1.5).contains(&variance), "{name}: {variance}");
            };
            for block in &net.blocks {
                let cells = block.cells;
                glorot(&block.weight_ih, block.inputs + 4 * cells);
                for (j, k) in (0..cells).flat_map(|j| (0..=j).map(move |k| (j, k))) {
                    let row = |i: usize, k: usize| f64::from(block.weight_hh[i * cells + k]);
                    let dot: f64 = (0..4 * cells).map(|i| row(i, j) * row(i, k)).sum();
                    assert!((dot - f64::from(u8::from(j == k))).abs() < 1e-5, "{name}: {dot}");
                }
                let forget = cells..2 * cells;
                for (i, bias) in block.bias.iter().enumerate() {
                    assert_eq!(*bias, f32::from(u8::from(forget.contains(&i))), "{name}: bias {i}");
                }
            }
            glorot(&net.fc_weight, net.outputs + net.blocks[net.blocks.len() - 1].cells);
            assert!(net.fc_bias.iter().all(|&bias| bias == 0.0));
        }
    }
}

/// The settings of a small fit by the preset.
fn small(kind: ModelKind, task: Task) -> FitSettings {
    let mut settings = FitSettings { task, preset: Preset::Paper, ..settings(kind) };
    settings.frf = Preset::Paper.frf();
    settings.lstm.seeds = None;
    settings.lstm.epochs = Some(3);
    settings
}

#[test]
fn a_fit_by_it_says_what_it_did() {
    for (task, rate) in [(Task::Forward, 1e-4), (Task::VirtualSensing, 2e-4)] {
        let mut settings = small(ModelKind::Hybrid2, task);
        settings.lstm.blocks = None;
        let report = fit(&data(), &settings, &unwatched).unwrap().report;
        assert_eq!(report.task, Some(task));
        let lstm = report.lstm.unwrap();
        assert_eq!((lstm.blocks, lstm.learning_rate), (vec![39], rate));
        assert_eq!(lstm.hybrid_start, HybridStart::Random);
        assert_eq!((lstm.recombine, report.recombine), (RecombineChoice::Welch, Some(Recombine::Welch)));
        let frf = report.frf.unwrap();
        assert_eq!((frf.estimator, frf.ridge), (Estimator::Ratio, Some(0.0)));
        assert_eq!(report.seeds.iter().map(|s| s.seed).collect::<Vec<_>>(), [1, 2, 3]);
        let least = report.seeds.iter().min_by(|a, b| a.validation_mse.total_cmp(&b.validation_mse));
        assert_eq!(report.best_seed, least.map(|s| s.seed));
    }
}

#[test]
fn a_hybrid_by_it_keeps_its_best_epoch_where_ours_would_keep_its_frf() {
    // Three epochs at a low rate make no hybrid that starts at random as good as its FRF.
    for kind in [ModelKind::Hybrid1, ModelKind::Hybrid2] {
        let mut settings = small(kind, Task::Forward);
        settings.lstm.learning_rate = Some(1e-5);
        let report = fit(&data(), &settings, &unwatched).unwrap().report;
        for seed in &report.seeds {
            let least = seed.curve.iter().min_by(|a, b| a.2.total_cmp(&b.2)).unwrap();
            assert_eq!((seed.best_epoch, seed.validation_mse), (least.0, least.2), "{kind:?}");
        }
        settings.lstm.hybrid_start = Some(HybridStart::Copy);
        let copies = fit(&data(), &settings, &unwatched).unwrap().report;
        assert!(copies.seeds.iter().all(|seed| seed.best_epoch == 0), "{kind:?}: {:?}", copies.seeds);
    }
}
