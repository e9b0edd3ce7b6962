//! Measured systems, where the shared data folder is present.

use super::*;

fn folder(name: &str) -> Option<std::path::PathBuf> {
    let shared = std::env::var_os("RIGCAST_SHARED").map_or_else(
        || std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared"),
        std::path::PathBuf::from,
    );
    let folder = shared.join("data").join(name);
    if folder.is_dir() {
        return Some(folder);
    }
    println!("skipped: no {}", folder.display());
    None
}

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
    let folder = folder(name)?;
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
    println!("{name} {test}: {error:.2} mV with {:?}, {:?}", found.settings, found.warnings);
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
