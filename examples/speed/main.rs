//! Speed of the engine on this machine, one JSON line a row:
//! `cargo run --release --example speed -- [--works infer,train,frf,rainflow,latency] [--threads N]`
//!
//! The network is the paper's hybrid 2: 9 inputs, 39 cells, 6 outputs, windows of 256 samples that
//! half overlap, at 1 kHz. `peak_fma` comes first and again after each group of works: the other
//! figures are to be read as shares of it, since machines and their neighbours differ.

use std::ops::ControlFlow;
use std::sync::Mutex;
use std::time::Instant;

use clap::{Parser, ValueEnum};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use rigcast::engine::fatigue::{DamageSettings, multi_rain};
use rigcast::engine::frf::{Estimator, FrfSettings, estimate};
use rigcast::engine::lstm::{
    LstmNet, LstmSettings, Optimizer, Recombine, RecombineChoice, Schedule, Stretch, predict, train,
};
use rigcast::engine::progress::{Progress, unwatched};
use rigcast::engine::simd::{Isa, peak_fma};
use rigcast::engine::{EngineError, Signal};
use serde_json::json;

const FS: usize = 1000;
const WINDOW: usize = 256;

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Work {
    Infer,
    Train,
    Frf,
    Rainflow,
    Latency,
}

/// Measures the engine on this machine.
#[derive(Debug, Parser)]
struct Args {
    /// Works to measure.
    #[arg(long, value_delimiter = ',', default_values = ["infer", "train", "frf", "rainflow", "latency"])]
    works: Vec<Work>,
    /// Threads; all cores unless said.
    #[arg(long)]
    threads: Option<usize>,
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args = Args::parse();
    let pool = rayon::ThreadPoolBuilder::new().num_threads(args.threads.unwrap_or(0)).build()?;
    let report = Report { threads: pool.current_num_threads(), isa: Isa::of_process()?.name() };
    pool.install(|| {
        report.peak()?;
        for work in &args.works {
            match work {
                Work::Infer => infer(&report)?,
                Work::Train => training(&report)?,
                Work::Frf => frf(&report)?,
                Work::Rainflow => rainflow(&report)?,
                Work::Latency => latency(&report)?,
            }
            report.peak()?;
        }
        Ok::<(), EngineError>(())
    })?;
    Ok(())
}

struct Report {
    threads: usize,
    isa: &'static str,
}

impl Report {
    fn print(&self, work: &str, unit: &str, mut values: Vec<f64>) {
        values.sort_by(f64::total_cmp);
        let line = json!({"work": work, "unit": unit, "median": values[values.len() / 2], "min": values[0],
                          "max": values[values.len() - 1], "reps": values.len(), "threads": self.threads,
                          "isa": self.isa});
        println!("{line}");
    }

    fn peak(&self) -> Result<(), EngineError> {
        let gflops = (0..15).map(|_| Ok(peak_fma()? / 1e9)).collect::<Result<_, EngineError>>()?;
        self.print("peak_fma", "gflops", gflops);
        Ok(())
    }
}

/// Seconds of each of `reps` calls, after one that is not counted.
fn seconds<T>(
    reps: usize,
    mut call: impl FnMut() -> Result<T, EngineError>,
) -> Result<Vec<f64>, EngineError> {
    call()?;
    (0..reps)
        .map(|_| {
            let begin = Instant::now();
            let answer = call()?;
            let took = begin.elapsed().as_secs_f64();
            drop(answer);
            Ok(took)
        })
        .collect()
}

/// Noise below about 80 Hz at 1 kHz, standard deviation near one.
fn noise(samples: usize, seed: u64) -> Vec<f64> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut state = [0.0_f64; 4];
    (0..samples)
        .map(|_| {
            let mut value: f64 = StandardNormal.sample(&mut rng);
            for s in &mut state {
                *s += 0.5 * (value - *s);
                value = *s;
            }
            2.2 * value
        })
        .collect()
}

fn noise_f32(channels: usize, samples: usize) -> Vec<Vec<f32>> {
    (0..channels).map(|c| noise(samples, c as u64).iter().map(|&v| v as f32).collect()).collect()
}

fn net() -> LstmNet {
    LstmNet::init(9, &[39], 6, 1.0, &mut ChaCha8Rng::seed_from_u64(1))
}

fn infer(report: &Report) -> Result<(), EngineError> {
    let net = net();
    let all = noise_f32(9, 3600 * FS);
    for (length_s, reps) in [(60, 41), (600, 11), (3600, 5)] {
        let x: Vec<Vec<f32>> = all.iter().map(|x| x[..length_s * FS].to_vec()).collect();
        let took = seconds(reps, || predict(&net, &x, WINDOW, WINDOW / 2, Recombine::Welch))?;
        let rates = took.iter().map(|s| length_s as f64 / s).collect();
        report.print(&format!("infer_{length_s}s"), "signal_s_per_s", rates);
    }
    Ok(())
}

fn training(report: &Report) -> Result<(), EngineError> {
    let stretch = Stretch { x: noise_f32(9, 600 * FS), y: noise_f32(6, 600 * FS), score_from: 0 };
    let short = |c: &Vec<f32>| c[..WINDOW].to_vec();
    let validation = Stretch {
        x: stretch.x.iter().map(short).collect(),
        y: stretch.y.iter().map(short).collect(),
        score_from: 0,
    };
    for batch_size in [32, 128, 512] {
        let settings = LstmSettings {
            blocks: vec![39],
            window_len: WINDOW,
            hop: WINDOW / 2,
            optimizer: Optimizer::Adam,
            learning_rate: 5e-3,
            schedule: Schedule::Cosine,
            warmup_steps: 100,
            epochs: 6,
            batch_size,
            burn_in: 0.25,
            clip_norm: Some(1.0),
            forget_bias: 1.0,
            recombine: RecombineChoice::Welch,
            seeds: vec![1],
        };
        // One call a mini-batch; a whole mini-batch lies between two calls of one epoch.
        let calls = Mutex::new(Vec::new());
        let watch = |progress: Progress<'_>| {
            calls
                .lock()
                .unwrap_or_else(std::sync::PoisonError::into_inner)
                .push((progress.fraction, Instant::now()));
            ControlFlow::Continue(())
        };
        train(
            std::slice::from_ref(&stretch),
            std::slice::from_ref(&validation),
            &net(),
            &settings,
            1,
            &watch,
        )?;
        let calls = calls.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner);
        let epoch = |fraction: f64| (fraction * settings.epochs as f64 + 1e-9).floor();
        let rates: Vec<f64> = calls
            .chunk_by(|a, b| epoch(a.0) == epoch(b.0))
            .filter(|calls| calls.len() > 2)
            .skip(1)
            .map(|calls| {
                // The last mini-batch of an epoch may be a rest.
                let (first, last) = (calls[0].1, calls[calls.len() - 2].1);
                ((calls.len() - 2) * batch_size) as f64 / (last - first).as_secs_f64()
            })
            .collect();
        report.print(&format!("train_b{batch_size}"), "windows_per_s", rates);
    }
    Ok(())
}

fn frf(report: &Report) -> Result<(), EngineError> {
    let signal = |channels: usize, seconds: usize, seed: u64| {
        Signal::new(FS as f64, (0..channels).map(|c| noise(seconds * FS, seed + c as u64)).collect())
    };
    let (x, y) = (signal(3, 1800, 1)?, signal(6, 1800, 100)?);
    let settings =
        FrfSettings { segment_len: Some(4096), overlap: 0.5, estimator: Estimator::H1, ridge: Some(0.0) };
    let took = seconds(11, || estimate(&[(&x, &y)], &settings, &unwatched))?;
    report.print("frf_h1_30min", "s", took);
    let filter = estimate(&[(&x, &y)], &settings, &unwatched)?.frf.filter()?;
    let drive = signal(3, 600, 1)?;
    report.print("frf_apply_10min", "s", seconds(31, || filter.apply(&drive))?);
    Ok(())
}

fn rainflow(report: &Report) -> Result<(), EngineError> {
    let group: Vec<Vec<f64>> = (0..3).map(|c| noise(600 * FS, c)).collect();
    let settings = DamageSettings { directions: 500, ..DamageSettings::default() };
    let took = seconds(11, || multi_rain([&group[0], &group[1], &group[2]], &settings))?;
    report.print("multirain_500x600s", "s", took);
    Ok(())
}

fn latency(report: &Report) -> Result<(), EngineError> {
    let (net, x) = (net(), noise_f32(9, 10 * FS));
    let took = seconds(201, || predict(&net, &x, WINDOW, WINDOW / 2, Recombine::Welch))?;
    report.print("infer_10s_latency", "s", took);
    Ok(())
}
