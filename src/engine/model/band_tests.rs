//! Bands of fitted models: what they hold of runs that nothing was fitted on.

use rayon::prelude::*;

use super::tests::{made_up, pair, settings};
use super::*;
use crate::checkpoint::NoCheckpoints;
use crate::fatigue::{DamageSettings, damage, damage_band};
use crate::virtual_rig::{ProgrammeRun, ProgrammeSettings, VirtualRig, programme};
use crate::{RunKind, Split};

/// Of each output, the share of samples of a run that lie in the band, and its mean half width over the run's RMS.
fn held(predictor: &Predictor, run: &Pair) -> Vec<(f64, f64)> {
    let mut prediction = predictor.begin(run.x.clone()).unwrap();
    let response = predictor.rest(&mut prediction, &unwatched).unwrap();
    let half = predictor.half_width(&prediction, &response).unwrap().expect("a band");
    let n = run.y.n_samples() as f64;
    let of = |k: usize| {
        let (y, p, h) = (run.y.channel(k), response.channel(k), half.channel(k));
        let inside = y.iter().zip(p).zip(h).filter(|((y, p), h)| (*y - *p).abs() <= **h).count() as f64;
        let rms = (y.iter().map(|y| y * y).sum::<f64>() / n).sqrt();
        (inside / n, h.iter().sum::<f64>() / n / rms)
    };
    (0..run.y.n_channels()).map(of).collect()
}

#[test]
fn the_band_of_a_fit_holds_nine_tenths_of_an_unseen_run_of_each_kind_of_model() {
    let data = FitData::of_training((1..4).map(|seed| pair(8000, seed)).collect());
    for kind in [ModelKind::Frf, ModelKind::Lstm, ModelKind::Hybrid1, ModelKind::Hybrid2] {
        // Not fitted again on all runs, which would make the model better than its band.
        let model = try_out(&data, &settings(kind), &NoCheckpoints, &unwatched).unwrap().model;
        assert_eq!(from_safetensors(&to_safetensors(&model)).unwrap().band, model.band, "{kind:?}");
        let predictor = Predictor::new(model).unwrap();
        let (share, width) = held(&predictor, &pair(20_000, 9))[0];
        assert!((0.85..0.95).contains(&share), "{kind:?}: {share} within {width} of the RMS");
        assert!(width < 0.5, "{kind:?}: {width} of the RMS");
    }
}

#[test]
fn a_model_that_nothing_compared_and_one_with_effects_or_made_elsewhere_have_no_band() {
    let runs = |seed| vec![pair(4000, seed)];
    let stops = FitData::with_validation(runs(1), runs(2), FitSplit::ValidationStops);
    assert_eq!(fit(&stops, &settings(ModelKind::Lstm), &unwatched).unwrap().model.band, None);
    let linear = fit(&stops, &settings(ModelKind::Frf), &unwatched).unwrap().model;
    assert!(linear.band.is_some(), "the validation runs compare an FRF, which nothing has to stop");
    let predictor = Predictor::new(made_up(ModelKind::Hybrid1)).unwrap();
    let x = Signal::new(100.0, vec![vec![0.1; 50]; 2]).unwrap();
    let mut prediction = predictor.begin(x).unwrap();
    let response = predictor.rest(&mut prediction, &unwatched).unwrap();
    assert_eq!(predictor.half_width(&prediction, &response).unwrap(), None);
}

/// The rig's answer to a run, in pieces of at most so many samples.
fn measured(rig: &VirtualRig, run: &ProgrammeRun, seed: u64, most: usize) -> Vec<Pair> {
    let y = rig.simulate(&run.drive, seed).unwrap();
    let n = y.n_samples();
    let cut = |from: usize| from..n.min(from + most);
    let piece = |from| Pair { x: run.drive.slice(cut(from)), y: y.slice(cut(from)) };
    (0..n).step_by(most).map(piece).collect()
}

/// Prints how often the bands of noise hold on service loads, for the FRF and for hybrid 2 of eight virtual rigs.
#[test]
#[ignore = "takes minutes: it fits networks"]
fn coverage_on_service_loads_of_virtual_rigs() {
    (1..=8).for_each(coverage);
}

fn coverage(seed: u64) {
    let runs = programme(&ProgrammeSettings::of_minutes(8.0), seed).unwrap();
    let rig = VirtualRig::draw(seed);
    let of = |kind: RunKind, split: Option<Split>, most: usize| -> Vec<Pair> {
        let chosen = |run: &&ProgrammeRun| {
            run.kind == kind && split.is_none_or(|s| run.split == s) && !run.tags.contains(&"linear")
        };
        let chosen: Vec<&ProgrammeRun> = runs.iter().filter(chosen).collect();
        chosen.par_iter().enumerate().flat_map(|(i, run)| measured(&rig, run, i as u64, most)).collect()
    };
    let training = of(RunKind::Noise, Some(Split::Training), usize::MAX);
    let loads = of(RunKind::Service, None, 15_000);
    let names = |prefix: &str, n: usize| (0..n).map(|i| format!("{prefix}{i}")).collect::<Vec<_>>();
    for kind in [ModelKind::Frf, ModelKind::Hybrid2] {
        let mut settings = FitSettings { inputs: names("x", 3), outputs: names("y", 6), ..settings(kind) };
        settings.frf.segment_len = Some(2048);
        settings.lstm = LstmOptions {
            blocks: Some(vec![24]),
            epochs: Some(30),
            seeds: Some(vec![1]),
            ..LstmOptions::default()
        };
        let fitted = fit(&FitData::of_training(training.clone()), &settings, &unwatched).unwrap();
        println!("rig {seed}, {kind:?}: held-out RMS {:.3?}", fitted.report.validation_rms);
        let predictor = Predictor::new(fitted.model).unwrap();
        let shares: Vec<Vec<(f64, f64)>> = loads.par_iter().map(|load| held(&predictor, load)).collect();
        for (group, channels) in [("displacement", 0..3), ("force", 3..6)] {
            let all = shares.iter().flat_map(|load| &load[channels.clone()]);
            let (share, width) = all.clone().fold((0.0, 0.0), |sum, s| (sum.0 + s.0, sum.1 + s.1));
            let n = all.count() as f64;
            println!("  {group}: {:.1} % in the band, {:.3} wide", 100.0 * share / n, width / n);
        }
        let settings = DamageSettings::default();
        let of_cycles = predictor.cycle_factors();
        println!("  factor of cycles {of_cycles:.2?}");
        // Of each output where the true damage lies, below the band, in it or above it, and how wide the band is.
        let holds = |load: &Pair| -> Vec<(i32, f64)> {
            let mut prediction = predictor.begin(load.x.clone()).unwrap();
            let response = predictor.rest(&mut prediction, &unwatched).unwrap();
            let half = predictor.half_width(&prediction, &response).unwrap().expect("a band");
            let of = |k: usize| {
                let wider: Vec<f64> = half.channel(k).iter().map(|h| of_cycles[k] * h).collect();
                let [low, high] = damage_band(response.channel(k), &wider, &settings).unwrap();
                let true_damage = damage(load.y.channel(k), &settings).unwrap();
                let side = i32::from(true_damage > high) - i32::from(true_damage < low);
                (side, (high / low.max(f64::MIN_POSITIVE)).ln())
            };
            (0..6).map(of).collect()
        };
        let found: Vec<Vec<(i32, f64)>> = loads.par_iter().map(holds).collect();
        for k in 0..6 {
            let of_side = |side: i32| {
                100.0 * found.iter().filter(|load| load[k].0 == side).count() as f64 / found.len() as f64
            };
            let mut width: Vec<f64> = found.iter().map(|load| load[k].1).collect();
            width.sort_by(f64::total_cmp);
            let ratio = width[width.len() / 2].exp();
            println!(
                "  damage of output {k}: {:.0} % of {} loads, {:.0} % below, {:.0} % above, median high / low {ratio:.2}",
                of_side(0),
                found.len(),
                of_side(-1),
                of_side(1)
            );
        }
    }
}
