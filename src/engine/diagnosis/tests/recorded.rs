//! Channels of a measured file, read by other programs' crates: `formats` is above the engine.

use std::path::Path;

/// Channels `[channel][sample]` of a `.npy` file of `[sample, channel]`, or of a `.csv` file with one header row.
pub fn channels(file: &Path) -> Vec<Vec<f64>> {
    if file.extension().is_some_and(|e| e == "npy") { npy(file) } else { csv(file) }
}

fn npy(file: &Path) -> Vec<Vec<f64>> {
    let array = npyz::NpyFile::new(std::fs::File::open(file).unwrap()).unwrap();
    assert_eq!(array.order(), npyz::Order::C);
    let width = usize::try_from(array.shape()[1]).unwrap();
    let values: Vec<f32> = array.into_vec().unwrap();
    (0..width).map(|c| values.iter().skip(c).step_by(width).map(|&x| f64::from(x)).collect()).collect()
}

fn csv(file: &Path) -> Vec<Vec<f64>> {
    let mut reader = csv::Reader::from_path(file).unwrap();
    let mut channels = vec![Vec::new(); reader.headers().unwrap().len()];
    for record in reader.records() {
        for (channel, field) in channels.iter_mut().zip(&record.unwrap()) {
            channel.push(field.trim().parse().unwrap());
        }
    }
    channels
}
