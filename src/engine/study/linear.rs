//! The linear study of the source paper (section 3.5): noise files and the responses of an FRF to them, networks of
//! several sizes trained on more and more of the files, scored on files of their own.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use realfft::num_complex::Complex64;
use rigcast_numerics::fft::RealFftPlanner;

use crate::checkpoint::CheckpointStore;
use crate::frf::Frf;
use crate::model::{
    FitData, FitSettings, FitSplit, LstmOptions, ModelKind, Pair, Preprocess, Preset, RigModel, Squares,
    Task, train_for,
};
use crate::{EngineError, Signal, Watch};

/// Noise files: uncorrelated channels, white to a corner, then a PSD that falls as 1/f to an end; each channel of
/// each file has a mean and an amplitude (three standard deviations) of its own.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NoiseFiles {
    /// Length of a file, s.
    pub duration_s: f64,
    /// The mean is drawn from within this of zero, in the unit of the input.
    pub mean: f64,
    /// The amplitude is drawn from here, in the unit of the input.
    pub amplitude: [f64; 2],
    /// End of the white part, Hz.
    pub white_to_hz: f64,
    /// End of the noise, Hz.
    pub end_hz: f64,
    /// Seed of all files.
    pub seed: u64,
}

impl NoiseFiles {
    /// Samples of a file.
    pub fn samples(&self, sample_rate_hz: f64) -> usize {
        (self.duration_s * sample_rate_hz).round() as usize
    }

    /// File number `number`: noise, and the response of `frf` to it. Each number is a file of its own.
    ///
    /// # Errors
    /// A response that is not finite.
    pub fn file(&self, frf: &Frf, number: u64) -> Result<Pair, EngineError> {
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
        rng.set_stream(number);
        let n = self.samples(frf.sample_rate_hz);
        let channel = |rng: &mut ChaCha8Rng| -> Vec<f64> {
            let mean = self.mean * rng.random_range(-1.0..=1.0);
            let [low, high] = self.amplitude;
            let deviation = (low + (high - low) * rng.random::<f64>()) / 3.0;
            self.noise(n, frf.sample_rate_hz, rng).into_iter().map(|v| mean + deviation * v).collect()
        };
        let channels = (0..frf.n_inputs).map(|_| channel(&mut rng)).collect();
        let x = Signal::new(frf.sample_rate_hz, channels)?;
        let y = frf.apply(&x)?;
        Ok(Pair { x, y })
    }

    /// Noise of standard deviation 1: given line amplitudes, drawn phases.
    fn noise(&self, n: usize, sample_rate_hz: f64, rng: &mut ChaCha8Rng) -> Vec<f64> {
        let inverse = RealFftPlanner::new().plan_fft_inverse(n);
        let mut spectrum = inverse.make_input_vec();
        // The lines at zero and half the sample rate stay zero.
        for (k, line) in spectrum.iter_mut().enumerate().take(n.div_ceil(2)).skip(1) {
            let f = k as f64 * sample_rate_hz / n as f64;
            let psd = match f {
                f if f <= self.white_to_hz => 1.0,
                f if f <= self.end_hz => self.white_to_hz / f,
                _ => break,
            };
            *line = Complex64::from_polar(psd.sqrt(), rng.random_range(0.0..std::f64::consts::TAU));
        }
        let mut signal = inverse.make_output_vec();
        inverse.process(&mut spectrum, &mut signal).expect("the buffers come from the plan");
        let deviation = (signal.iter().map(|v| v * v).sum::<f64>() / n as f64).sqrt();
        signal.iter_mut().for_each(|v| *v /= deviation);
        signal
    }
}

/// A network of the study: the paper's way of training, a fixed number of epochs, nothing that stops or chooses.
#[derive(Debug, Clone, PartialEq)]
pub struct FixedNet {
    /// Cells of each block.
    pub blocks: Vec<usize>,
    /// Epochs.
    pub epochs: usize,
    /// Learning rate.
    pub learning_rate: f64,
    /// Seed of the start, the same for every number of files.
    pub seed: u64,
}

impl FixedNet {
    /// Trains the network on files.
    ///
    /// # Errors
    /// As a fit.
    pub fn train(
        &self,
        files: Vec<Pair>,
        checkpoints: &dyn CheckpointStore,
        watch: Watch<'_>,
    ) -> Result<RigModel, EngineError> {
        let names = |what: &str, n: usize| (0..n).map(|i| format!("{what} {i}")).collect();
        let (inputs, outputs) = match files.first() {
            Some(pair) => (pair.x.n_channels(), pair.y.n_channels()),
            None => return Err(EngineError::TooShort { what: "training files", needed: 1, found: 0 }),
        };
        let settings = FitSettings {
            kind: ModelKind::Lstm,
            task: Task::Forward,
            inputs: names("input", inputs),
            outputs: names("output", outputs),
            preprocess: Preprocess::default(),
            frf: Preset::Paper.frf(),
            lstm: LstmOptions {
                blocks: Some(self.blocks.clone()),
                epochs: Some(self.epochs),
                learning_rate: Some(self.learning_rate),
                seeds: Some(vec![self.seed]),
                ..LstmOptions::default()
            },
            preset: Preset::Paper,
            start: None,
            core: None,
        };
        let data = FitData::with_validation(files, Vec::new(), FitSplit::ValidationStops);
        train_for(&data, &settings, checkpoints, watch)
    }
}

/// RMS error of each output on files, each file's error averaged (paper, section 3.5: "averaged over this validation
/// dataset"); `None` where an output is all zero in every file.
///
/// # Errors
/// A prediction that fails.
pub fn mean_rms(
    model: &RigModel,
    files: impl IntoIterator<Item = Result<Pair, EngineError>>,
) -> Result<Vec<Option<f64>>, EngineError> {
    let mut sums: Vec<(f64, usize)> = vec![(0.0, 0); model.outputs.len()];
    for pair in files {
        let pair = pair?;
        let predicted = model.predict(&pair.x)?;
        for (sum, (p, m)) in sums.iter_mut().zip(predicted.channels().iter().zip(pair.y.channels())) {
            if let Some(rms) = Squares::of(p, m).rms() {
                *sum = (sum.0 + rms, sum.1 + 1);
            }
        }
    }
    Ok(sums.into_iter().map(|(sum, n)| (n > 0).then(|| sum / n as f64)).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::checkpoint::NoCheckpoints;
    use crate::progress::unwatched;
    use crate::spectral::{Detrend, Welch, psd};

    /// A first-order low pass of gain 2, as an FRF.
    fn low_pass() -> Frf {
        let (segment_len, fs) = (256, 200.0);
        let line = |k: usize| {
            let f = k as f64 * fs / segment_len as f64;
            let h = Complex64::new(2.0, 0.0) / Complex64::new(1.0, f / 5.0);
            if k == segment_len / 2 { Complex64::new(h.re, 0.0) } else { h }
        };
        Frf {
            sample_rate_hz: fs,
            segment_len,
            n_inputs: 1,
            n_outputs: 1,
            h: (0..=segment_len / 2).map(line).collect(),
            usable_hz: [0.0, 100.0],
            x_mean: vec![0.0],
            y_mean: vec![0.0],
        }
    }

    fn files() -> NoiseFiles {
        NoiseFiles {
            duration_s: 30.0,
            mean: 4.0,
            amplitude: [0.5, 2.0],
            white_to_hz: 20.0,
            end_hz: 50.0,
            seed: 7,
        }
    }

    #[test]
    fn a_file_has_the_papers_spectrum_mean_and_amplitude() {
        let frf = low_pass();
        let mut means = Vec::new();
        for number in 0..8 {
            let pair = files().file(&frf, number).unwrap();
            let x = pair.x.channel(0);
            let n = x.len() as f64;
            let mean = x.iter().sum::<f64>() / n;
            let deviation = (x.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt();
            assert!(mean.abs() <= 4.0 && (0.5 / 3.0..=2.0 / 3.0).contains(&deviation), "{mean} {deviation}");
            means.push(mean);
            assert_eq!(pair.y.channel(0), frf.apply(&pair.x).unwrap().channel(0));
        }
        assert!(means.windows(2).all(|pair| pair[0] != pair[1]), "files differ: {means:?}");
        // White to 20 Hz, half of that at 40 Hz, nothing above 50 Hz.
        let pairs: Vec<Pair> = (0..8).map(|number| files().file(&frf, number).unwrap()).collect();
        let welch = Welch { segment_len: 200, overlap: 0.5, detrend: Detrend::Constant };
        let density = &psd(&pairs.iter().map(|pair| &pair.x).collect::<Vec<_>>(), &welch).unwrap().density[0];
        let about = |hz: usize| density[hz - 2..=hz + 2].iter().sum::<f64>() / 5.0;
        assert!((about(15) / about(8) - 1.0).abs() < 0.1, "{} {}", about(15), about(8));
        assert!((about(40) / about(10) - 0.5).abs() < 0.06, "{}", about(40) / about(10));
        assert!(about(60) < 1e-3 * about(10));
    }

    #[test]
    fn more_files_of_a_linear_rig_lower_the_error_of_a_network() {
        let frf = low_pass();
        let net = FixedNet { blocks: vec![8], epochs: 20, learning_rate: 3e-3, seed: 1 };
        let error = |n: u64| {
            let training = (0..n).map(|number| files().file(&frf, number)).collect::<Result<_, _>>().unwrap();
            let model = net.train(training, &NoCheckpoints, &unwatched).unwrap();
            let scored = (1000..1003).map(|number| files().file(&frf, number));
            mean_rms(&model, scored).unwrap()[0].unwrap()
        };
        let (few, many) = (error(1), error(8));
        assert!(many < 0.7 * few, "{few} {many}");
    }
}
