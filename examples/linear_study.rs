//! The linear study of the source paper (section 3.5) on the FRF of the virtual rig:
//! `cargo run --release --example linear_study -- [--files 3,6,12,25] [--seconds 180] [--epochs 100] [--out docs]`
//!
//! Fits an FRF to ten minutes of the rig's small noise, makes noise files and its responses, trains {10}, {39}, {23,23}
//! and {39,39} on more and more files, and scores them on files of their own. Prints a CSV row for each network and
//! number of files, and writes all rows and a plot to `linear-study.csv` and `linear-study.svg` in the folder `--out`.
//! The service does the same as a study of kind `linear_study`.

use std::error::Error;
use std::fmt::Write as _;
use std::path::PathBuf;

use clap::Parser;
use rigcast::domain::study::LinearFit;
use rigcast::engine::checkpoint::NoCheckpoints;
use rigcast::engine::frf::{FrfSettings, RunPart, estimate_parts};
use rigcast::engine::progress::unwatched;
use rigcast::engine::study::{FixedNet, NoiseFiles, mean_rms};
use rigcast::engine::virtual_rig::{VirtualRig, drives};
use rigcast::ui::study::linear_study_svg;

/// Trains networks on files that an FRF makes.
#[derive(Debug, Parser)]
struct Args {
    /// Numbers of training files.
    #[arg(long, value_delimiter = ',', default_value = "3,6,12,25")]
    files: Vec<u64>,
    /// Files that score.
    #[arg(long, default_value_t = 6)]
    scored: u64,
    /// Length of a file, s.
    #[arg(long, default_value_t = 180.0)]
    seconds: f64,
    /// Epochs of each network.
    #[arg(long, default_value_t = 100)]
    epochs: usize,
    /// Seed of the rig, the files and the networks.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Folder of the table and the plot.
    #[arg(long, default_value = ".")]
    out: PathBuf,
}

/// Number of the first file that scores.
const FIRST_SCORED: u64 = 1 << 32;

fn main() -> Result<(), Box<dyn Error>> {
    let args = Args::parse();
    let rig = VirtualRig::draw(args.seed);
    let drive = drives::linear_noise(600.0, args.seed)?;
    let response = rig.simulate(&drive, args.seed)?;
    let whole = RunPart { x: &drive, y: &response, samples: 0..drive.n_samples() };
    let frf = estimate_parts(&[whole], &FrfSettings::default(), &unwatched)?.frf;
    let noise = NoiseFiles {
        duration_s: args.seconds,
        mean: 4.0,
        amplitude: [0.5, 2.0],
        white_to_hz: 20.0,
        end_hz: 50.0,
        seed: args.seed,
    };
    let mut fits = Vec::new();
    let mut csv = String::from("net,parameters,files,minutes,rms\n");
    print!("{csv}");
    for &files in &args.files {
        for blocks in [vec![10], vec![39], vec![23, 23], vec![39, 39]] {
            let net = FixedNet {
                blocks: blocks.clone(),
                epochs: args.epochs,
                learning_rate: 1e-3,
                seed: args.seed,
            };
            let training = (0..files).map(|number| noise.file(&frf, number)).collect::<Result<_, _>>()?;
            let model = net.train(training, &NoCheckpoints, &unwatched)?;
            let scored = (FIRST_SCORED..FIRST_SCORED + args.scored).map(|number| noise.file(&frf, number));
            let rms = mean_rms(&model, scored)?;
            let known: Vec<f64> = rms.iter().flatten().copied().collect();
            let error = known.iter().sum::<f64>() / known.len() as f64;
            let parameters = model.lstm.as_ref().map_or(0, |part| part.net.n_parameters());
            let minutes = files as f64 * args.seconds / 60.0;
            let row = format!("\"{blocks:?}\",{parameters},{files},{minutes},{error:.5}");
            println!("{row}");
            writeln!(csv, "{row}")?;
            let files = files as usize;
            fits.push(LinearFit {
                net: blocks,
                parameters,
                files,
                minutes,
                error: Some(error),
                rms,
                reason: None,
            });
        }
    }
    std::fs::write(args.out.join("linear-study.csv"), csv)?;
    std::fs::write(args.out.join("linear-study.svg"), linear_study_svg(&fits))?;
    Ok(())
}
