//! The limits of a linear study, and its defaults: the source paper's at an eighth of its files.

use super::StudyRequest;
use crate::domain::problem::FieldError;
use crate::engine::lstm::{MAX_BLOCKS, MAX_CELLS};
use crate::engine::study::{NoiseFiles, RangeOf};

/// Most samples of all channels of the largest set of training files: about 8 GB of memory.
const MAX_SAMPLES: f64 = 3e8;

/// Longest file, s.
const MAX_DURATION_S: f64 = 3600.0;

/// A linear study, nothing left open.
#[derive(Debug, Clone, PartialEq)]
pub struct LinearStudy {
    /// Numbers of training files, rising.
    pub files: Vec<usize>,
    /// Files that score.
    pub scored_files: usize,
    /// Cells of each block of each network.
    pub nets: Vec<Vec<usize>>,
    /// Epochs.
    pub epochs: usize,
    /// Learning rate.
    pub learning_rate: f64,
    /// The files.
    pub noise: NoiseFiles,
}

/// Resolves the request; `errors` are those that are known already.
pub(super) fn check(
    request: &StudyRequest,
    mut errors: Vec<FieldError>,
    channels: usize,
    sample_rate_hz: f64,
) -> Result<LinearStudy, Vec<FieldError>> {
    let mut refuse = |pointer: &str, limit: String| errors.push(FieldError::new(pointer, limit));
    if request.fit.is_some() {
        refuse("/fit", "left out: a linear study has networks of its own".into());
    }
    let files = request.files.clone().unwrap_or_else(|| vec![3, 6, 12, 25]);
    let rising = files.windows(2).all(|pair| pair[0] < pair[1]);
    if !(1..=10).contains(&files.len()) || !rising || files.iter().any(|n| !(1..=1000).contains(n)) {
        refuse("/files", "1 to 10 numbers from 1 to 1000, rising".into());
    }
    let scored_files = request.scored_files.unwrap_or(6);
    if !(1..=1000).contains(&scored_files) {
        refuse("/scored_files", "1 to 1000".into());
    }
    let nets = request.nets.clone().unwrap_or_else(|| vec![vec![10], vec![39], vec![23, 23], vec![39, 39]]);
    let net_fits = |net: &Vec<usize>| {
        (1..=MAX_BLOCKS).contains(&net.len()) && net.iter().all(|cells| (1..=MAX_CELLS).contains(cells))
    };
    if !(1..=8).contains(&nets.len()) {
        refuse("/nets", "1 to 8 networks".into());
    }
    if let Some(bad) = nets.iter().position(|net| !net_fits(net)) {
        refuse(&format!("/nets/{bad}"), format!("1 to {MAX_BLOCKS} blocks of 1 to {MAX_CELLS} cells"));
    }
    let epochs = request.epochs.unwrap_or(100);
    if !(1..=10_000).contains(&epochs) {
        refuse("/epochs", "1 to 10000".into());
    }
    // Written so that NaN would be refused.
    let mut real =
        |pointer: &str, given: Option<f64>, default: f64, within: std::ops::RangeInclusive<f64>| {
            let value = given.unwrap_or(default);
            if !within.contains(&value) {
                refuse(pointer, format!("from {} to {}; found {value}", within.start(), within.end()));
            }
            value
        };
    let learning_rate = real("/learning_rate", request.learning_rate, 1e-3, 1e-9..=1.0);
    let duration_s = real("/duration_s", request.duration_s, 180.0, 1.0..=MAX_DURATION_S);
    let mean = real("/mean", request.mean, 4.0, 0.0..=1e9);
    let end_hz = real("/end_hz", request.end_hz, 50.0, 1e-3..=0.499 * sample_rate_hz);
    let white_to_hz = real("/white_to_hz", request.white_to_hz, 20.0, 1e-3..=end_hz);
    let RangeOf { min, max } = request.amplitude.unwrap_or(RangeOf { min: 0.5, max: 2.0 });
    if !(min > 0.0 && min <= max && max <= 1e9) {
        refuse("/amplitude", format!("min and max above 0, min <= max; found {min} to {max}"));
    }
    let most = files.last().copied().unwrap_or_default() as f64;
    let samples = most * duration_s * sample_rate_hz * channels as f64;
    if samples > MAX_SAMPLES {
        refuse(
            "/files",
            format!("at most {MAX_SAMPLES:e} samples of all channels together; found {samples:e}"),
        );
    }
    if duration_s * sample_rate_hz < 512.0 {
        refuse("/duration_s", "at least 512 samples, two windows".into());
    }
    let noise =
        NoiseFiles { duration_s, mean, amplitude: [min, max], white_to_hz, end_hz, seed: request.seed };
    let study = LinearStudy { files, scored_files, nets, epochs, learning_rate, noise };
    if errors.is_empty() { Ok(study) } else { Err(errors) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_linear_study_has_the_papers_settings_and_limits() {
        let request = |more: &str| -> StudyRequest {
            serde_json::from_str(&format!(r#"{{"kind": "linear_study"{more}}}"#)).unwrap()
        };
        let study = request("").linear_study(6, 1000.0).unwrap();
        assert_eq!(study.nets, [vec![10], vec![39], vec![23, 23], vec![39, 39]]);
        assert_eq!((study.epochs, study.learning_rate, study.noise.duration_s), (100, 1e-3, 180.0));
        for (more, pointer) in [
            (r#", "files": [5, 5]"#, "/files"),
            (r#", "files": []"#, "/files"),
            (r#", "files": [1000]"#, "/files"),
            (r#", "nets": [[10], []]"#, "/nets/1"),
            (r#", "epochs": 0"#, "/epochs"),
            (r#", "duration_s": 0.2"#, "/duration_s"),
            (r#", "end_hz": 500"#, "/end_hz"),
            (r#", "white_to_hz": 60"#, "/white_to_hz"),
            (r#", "amplitude": {"min": 2, "max": 1}"#, "/amplitude"),
            (r#", "fit": {"kind": "lstm"}"#, "/fit"),
            (r#", "trials": 3"#, "/trials"),
        ] {
            let refused = request(more).linear_study(6, 1000.0).unwrap_err();
            assert_eq!(refused[0].pointer, pointer, "{refused:?}");
        }
        assert!(request("").linear_study(6, 90.0).is_err(), "50 Hz are above half the rate");
    }
}
