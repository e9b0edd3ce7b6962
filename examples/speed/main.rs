//! Speed of the engine on this machine, one JSON line a row:
//! `cargo run --release --example speed -- [--works infer,train,frf,rainflow,latency,large] [--threads N]`
//!
//! `peak_fma` comes first and again after each group of measurements. The other figures are best read as
//! shares of it, since the speed of a shared machine varies. `--against examples/speed/last.jsonl` compares them so with
//! the committed run of the machine most like this one, and ends with 1 where a row has lost more than 15 % of its share.

use std::cell::RefCell;
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::process::ExitCode;
use std::slice::from_ref;
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use clap::{Parser, ValueEnum};
use rigcast::engine::EngineError;
use rigcast::engine::checkpoint::NoCheckpoints;
use rigcast::engine::fatigue::{DamageSettings, multi_rain};
use rigcast::engine::frf::estimate;
use rigcast::engine::lstm::{Recombine, Until, predict, train};
use rigcast::engine::progress::{Progress, unwatched};
use rigcast::engine::simd::{Isa, peak_fma};
use serde_json::{Value, json};

mod guard;
mod large;
mod works;

use works::{FS, HOP, WINDOW};

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Work {
    Infer,
    Train,
    Frf,
    Rainflow,
    Latency,
    Large,
}

/// Measures the engine on this machine.
#[derive(Debug, Parser)]
struct Args {
    /// Groups to measure.
    #[arg(long, value_delimiter = ',', default_values = ["infer", "train", "frf", "rainflow", "latency", "large"])]
    works: Vec<Work>,
    /// Threads; all cores unless said.
    #[arg(long)]
    threads: Option<usize>,
    /// Lines of an earlier run to compare with.
    #[arg(long)]
    against: Option<PathBuf>,
}

fn main() -> Result<ExitCode, Box<dyn std::error::Error>> {
    let args = Args::parse();
    let pool = rayon::ThreadPoolBuilder::new().num_threads(args.threads.unwrap_or(0)).build()?;
    let before = args.against.as_deref().map(guard::read).transpose()?;
    let lines = RefCell::default();
    let mut report = Report { threads: pool.current_num_threads(), isa: Isa::of_process()?.name(), lines };
    pool.install(|| {
        let report = &mut report;
        report.peak()?;
        for work in &args.works {
            match work {
                Work::Infer => infer(report)?,
                Work::Train => training(report)?,
                Work::Frf => frf(report)?,
                Work::Rainflow => rainflow(report)?,
                Work::Latency => latency(report)?,
                Work::Large => large::measure(report)?,
            }
            report.peak()?;
        }
        Ok::<(), EngineError>(())
    })?;
    let Some(before) = before else { return Ok(ExitCode::SUCCESS) };
    let (told, fast) = guard::compare(&before, &guard::rows(&report.lines.into_inner())?)?;
    told.iter().for_each(|row| println!("{row}"));
    Ok(if fast { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

struct Report {
    threads: usize,
    isa: &'static str,
    /// Everything that was printed.
    lines: RefCell<Vec<Value>>,
}

impl Report {
    fn print(&self, work: &str, unit: &str, mut values: Vec<f64>) {
        values.sort_by(f64::total_cmp);
        let line = json!({"work": work, "unit": unit, "median": values[values.len() / 2], "min": values[0],
                          "max": values[values.len() - 1], "reps": values.len(), "threads": self.threads,
                          "isa": self.isa});
        println!("{line}");
        self.lines.borrow_mut().push(line);
    }

    fn peak(&self) -> Result<(), EngineError> {
        let gflops = (0..15).map(|_| Ok(peak_fma()? / 1e9)).collect::<Result<_, EngineError>>()?;
        self.print("peak_fma", "gflops", gflops);
        Ok(())
    }
}

/// Seconds of each of `reps` calls, after one call to warm up.
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

fn infer(report: &Report) -> Result<(), EngineError> {
    let (net, all) = (works::net(), works::net_input(3600));
    for (length_s, reps) in [(60, 41), (600, 11), (3600, 5)] {
        let x: Vec<Vec<f32>> = all.iter().map(|x| x[..length_s * FS].to_vec()).collect();
        let took = seconds(reps, || predict(&net, &x, WINDOW, HOP, Recombine::Welch))?;
        let rates = took.iter().map(|s| length_s as f64 / s).collect();
        report.print(&format!("infer_{length_s}s"), "signal_s_per_s", rates);
    }
    Ok(())
}

fn training(report: &Report) -> Result<(), EngineError> {
    const EPOCHS: usize = 6;
    let (stretch, validation) = works::training();
    for batch_size in [32, 128, 512] {
        // One call per mini-batch: a whole mini-batch lies between two calls of one epoch.
        let calls = Mutex::new(Vec::new());
        let watch = |progress: Progress<'_>| {
            let call = (progress.fraction, Instant::now());
            calls.lock().unwrap_or_else(PoisonError::into_inner).push(call);
            ControlFlow::Continue(())
        };
        let settings = works::training_settings(batch_size, EPOCHS);
        train(
            from_ref(&stretch),
            Until::Best(from_ref(&validation)),
            &works::net(),
            (&settings, 1),
            (&NoCheckpoints, ""),
            &watch,
        )?;
        let calls = calls.into_inner().unwrap_or_else(PoisonError::into_inner);
        let epoch = |fraction: f64| (fraction * EPOCHS as f64 + 1e-9).floor();
        let rates: Vec<f64> = calls
            .chunk_by(|a, b| epoch(a.0) == epoch(b.0))
            .filter(|calls| calls.len() > 2)
            .skip(1)
            .map(|calls| {
                // The last mini-batch of an epoch may be smaller.
                let (first, last) = (calls[0].1, calls[calls.len() - 2].1);
                ((calls.len() - 2) * batch_size) as f64 / (last - first).as_secs_f64()
            })
            .collect();
        report.print(&format!("train_b{batch_size}"), "windows_per_s", rates);
    }
    Ok(())
}

fn frf(report: &Report) -> Result<(), EngineError> {
    let (x, y) = (works::drives(1800)?, works::responses(1800)?);
    let once = || estimate(&[(&x, &y)], &works::frf_settings(), &unwatched);
    report.print("frf_h1_30min", "s", seconds(11, once)?);
    let (filter, drive) = (once()?.frf.filter()?, works::drives(600)?);
    report.print("frf_apply_10min", "s", seconds(31, || filter.apply(&drive))?);
    Ok(())
}

fn rainflow(report: &Report) -> Result<(), EngineError> {
    let [x, y, z] = &works::group();
    let took = seconds(11, || multi_rain([x, y, z], &DamageSettings::default()))?;
    report.print("multirain_500x600s", "s", took);
    Ok(())
}

fn latency(report: &Report) -> Result<(), EngineError> {
    let (net, x) = (works::net(), works::net_input(10));
    let took = seconds(201, || predict(&net, &x, WINDOW, HOP, Recombine::Welch))?;
    report.print("infer_10s_latency", "s", took);
    Ok(())
}
