//! Measured systems, where the shared data folder is present.

use super::*;
use crate::measured::shared_data;
use crate::metrics::nrmse;
use crate::model::Preprocess;
use crate::resample::resample;

/// Columns of a CSV file with one header row.
fn csv(path: &std::path::Path) -> Vec<Vec<f64>> {
    let mut reader = csv::Reader::from_path(path).unwrap();
    let mut columns = vec![Vec::new(); reader.headers().unwrap().len()];
    for record in reader.records() {
        for (column, cell) in columns.iter_mut().zip(record.unwrap().iter()) {
            column.push(cell.trim().parse().unwrap());
        }
    }
    columns
}

/// One drive, one response; error on a test file, its first 50 samples skipped, in millivolts.
fn siso_error_mv(name: &str, fs: f64, test: &str) -> Option<f64> {
    let folder = shared_data(name)?;
    let read = |file: &str| {
        let mut columns = csv(&folder.join(file));
        let y = columns.pop().unwrap();
        (signal(fs, columns), signal(fs, vec![y]))
    };
    let (x, y) = read("train.csv");
    let found = estimate(&[(&x, &y)], &FrfSettings::default(), &unwatched).unwrap();
    let (x, y) = read(test);
    let predicted = found.frf.apply(&x).unwrap();
    let scored = 50..y.n_samples();
    let (y, p) = (&y.channel(0)[scored.clone()], &predicted.channel(0)[scored]);
    let square: f64 = y.iter().zip(p).map(|(y, p)| (y - p).powi(2)).sum();
    let error = 1e3 * (square / y.len() as f64).sqrt();
    println!("{name} {test}: {error:.2} mV with {:?}, {:?}", found.quality.settings, found.warnings);
    Some(error)
}

#[test]
fn silverbox_is_predicted_as_well_as_a_linear_model_can() {
    if let Some(error) = siso_error_mv("silverbox", 610.351_562_5, "test_multisine.csv") {
        assert!(error <= 7.1, "{error}");
    }
}

#[test]
fn the_wiener_hammerstein_circuit_is_predicted_as_well_as_a_linear_model_can() {
    if let Some(error) = siso_error_mv("wiener_hammerstein", 51_200.0, "test.csv") {
        assert!(error <= 44.0, "{error}");
    }
}

/// The client's part of the shaker data: 4096 Hz, 12 to 1250 Hz; 9 inputs, 3 outputs.
fn shaker(folder: &std::path::Path, file: &str) -> (Signal, Signal) {
    let bytes = std::fs::read(folder.join(file)).unwrap();
    let npy = npyz::NpyFile::new(&bytes[..]).unwrap();
    let columns = usize::try_from(npy.shape()[1]).unwrap();
    let values: Vec<f32> = npy.into_vec().unwrap();
    let channels =
        (0..columns).map(|c| values.iter().skip(c).step_by(columns).map(|&v| v.into()).collect()).collect();
    let filter = Preprocess { band_pass_hz: Some([12.0, 1250.0]), ..Preprocess::default() };
    let slow = resample(&signal(50_000.0, channels), 4096.0).unwrap();
    let slow = filter.apply(&slow).unwrap();
    (slow.select(&(0..9).collect::<Vec<_>>()), slow.select(&[9, 10, 11]))
}

#[test]
fn the_multiaxis_shaker_is_predicted_from_two_seconds() {
    let Some(folder) = shared_data("multiaxis_shaker") else { return };
    let (x, y) = shaker(&folder, "run1.npy");
    let found = estimate(&[(&x, &y)], &FrfSettings::default(), &unwatched).unwrap();
    let (x, y) = shaker(&folder, "run2.npy");
    let predicted = found.frf.apply(&x).unwrap();
    let errors: Vec<f64> = (0..3).map(|o| nrmse(y.channel(o), predicted.channel(o)).unwrap()).collect();
    println!("multiaxis_shaker run2: {errors:.3?} with {:?}, {:?}", found.quality.settings, found.warnings);
    for (error, bound) in errors.iter().zip([0.125, 0.095, 0.21]) {
        assert!(*error <= bound, "{errors:?}");
    }
}
