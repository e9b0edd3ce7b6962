//! The FRF whose inverse corrects the drive: the model's own, or one estimated from the model.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use serde::{Deserialize, Serialize};

use crate::frf::{Frf, FrfQuality, FrfSettings, estimate};
use crate::model::{InputRange, Predictor, Preprocess};
use crate::progress::Watch;
use crate::{EngineError, Signal};

/// Samples of a segment of the estimate.
const SEGMENT_LEN: usize = 2048;

/// Segments' lengths of noise that a model without an FRF is asked about.
const LENGTHS: usize = 64;

/// Standard deviations of that noise within half the training range.
const DEVIATIONS: f64 = 3.0;

/// Where the FRF comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LinearPart {
    /// It is part of the model.
    Model,
    /// It was estimated from the model's response to noise over its training range.
    Estimated,
}

/// The FRF from the model's inputs to some of its outputs, and its quality where that is known.
pub(super) struct Linear {
    pub frf: Frf,
    pub quality: Option<FrfQuality>,
    pub part: LinearPart,
}

impl Linear {
    /// # Errors
    /// A model with neither an FRF nor the range of its inputs; those of an estimate.
    pub fn of(predictor: &Predictor, outputs: &[usize], watch: Watch<'_>) -> Result<Self, EngineError> {
        let model = predictor.model();
        let (frf, quality, part) = match &model.frf {
            Some(frf) => (frf.clone(), model.frf_quality.clone(), LinearPart::Model),
            None => {
                let x = noise(&model.range, model.sample_rate_hz)?;
                let y = predictor.rest(&mut predictor.begin(x.clone())?, watch)?;
                let settings = FrfSettings { segment_len: Some(SEGMENT_LEN), ..FrfSettings::default() };
                let found = estimate(&[(&x, &y)], &settings, watch)?;
                (found.frf, Some(found.quality), LinearPart::Estimated)
            }
        };
        let h = (0..frf.n_lines())
            .flat_map(|line| outputs.iter().map(move |&output| (line, output)))
            .flat_map(|(line, output)| (0..frf.n_inputs).map(move |input| (line, output, input)))
            .map(|(line, output, input)| frf.at(line, output, input))
            .collect();
        let y_mean = outputs.iter().map(|&output| frf.y_mean[output]).collect();
        let quality = quality.map(|quality| {
            let n = frf.n_outputs;
            let kept = |all: &[f64]| {
                all.chunks(n).flat_map(|line| outputs.iter().map(|&output| line[output])).collect()
            };
            FrfQuality { multiple_coherence: kept(&quality.multiple_coherence), ..quality }
        });
        Ok(Self { frf: Frf { h, y_mean, n_outputs: outputs.len(), ..frf }, quality, part })
    }
}

/// Gaussian noise over the training range of every input, limited to the band of the training. Its seed is fixed.
fn noise(range: &[InputRange], sample_rate_hz: f64) -> Result<Signal, EngineError> {
    if range.is_empty() {
        return Err(EngineError::Setting {
            setting: "model",
            found: "a model with neither an FRF nor the range of its inputs".into(),
            limit: "a model that an inverse can be made of".into(),
        });
    }
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let channels = range
        .iter()
        .map(|range| {
            let white: Vec<f64> =
                (0..LENGTHS * SEGMENT_LEN).map(|_| rng.sample::<f64, _>(StandardNormal)).collect();
            let white = Signal::new(sample_rate_hz, vec![white])?;
            let last = range.band_hz.map(|[_, last]| last).filter(|last| 2.0 * last < sample_rate_hz);
            let filter = Preprocess { low_pass_hz: last, ..Preprocess::default() };
            let mut samples = filter.apply_to(white)?.into_channels().swap_remove(0);
            let rms = (samples.iter().map(|v| v * v).sum::<f64>() / samples.len() as f64).sqrt();
            let (middle, half) = ((range.max + range.min) / 2.0, (range.max - range.min) / 2.0);
            for v in &mut samples {
                *v = middle + (*v * half / (DEVIATIONS * rms)).clamp(-half, half);
            }
            Ok(samples)
        })
        .collect::<Result<_, EngineError>>()?;
    Signal::new(sample_rate_hz, channels)
}
