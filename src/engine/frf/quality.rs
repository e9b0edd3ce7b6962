//! Quality figures of an estimated FRF. They are stored with the model and shown to its users.

use super::{Estimator, Frf, FrfSettings};
use crate::EngineError;

/// Condition numbers are given up to this: beyond it `S_xx` is singular to the precision of numbers.
pub const MAX_CONDITION: f64 = 1e15;

/// Quality figures of an estimated FRF. All values are finite.
#[derive(Debug, Clone, PartialEq)]
pub struct FrfQuality {
    /// The settings used, none left open.
    pub settings: FrfSettings,
    /// Segments averaged.
    pub averages: usize,
    /// Independent segments that the overlapping ones are worth.
    pub effective_averages: f64,
    /// Stretches of lines on which all inputs together have power, first and last of each, ascending;
    /// elsewhere `H` is tapered to zero.
    pub excited: Vec<[usize; 2]>,
    /// First and last frequency at which each input has power, Hz.
    pub input_hz: Vec<[f64; 2]>,
    /// Ordinary coherence of each output with each input, 0..=1, `[line, output, input]`; 0 on
    /// lines that the inputs do not excite.
    pub coherence: Vec<f64>,
    /// Multiple coherence of each output with all inputs, 0..=1, `[line, output]`; 0 on lines that
    /// the inputs do not excite.
    pub multiple_coherence: Vec<f64>,
    /// Condition number of `S_xx`, each input scaled to its standard deviation, `[line]`;
    /// [`MAX_CONDITION`] where it is singular.
    pub condition: Vec<f64>,
    /// Standard deviation of the random error of `H` (see [`FrfQuality::confidence_factor`]), output
    /// unit / input unit, `[line, output, input]`; 0 on lines that the inputs do not excite.
    pub std_error: Vec<f64>,
}

impl FrfQuality {
    /// Factor on [`FrfQuality::std_error`] that gives the radius about each `H[line, output, input]`
    /// which holds the true value with probability `confidence`; the magnitude then lies within
    /// `|H| +- radius`, the phase within `+- asin(radius / |H|)` (unknown where that is no angle).
    ///
    /// With `n` independent averages of `q` inputs, `m = n - q` (see `degrees`), and the noise
    /// spectrum `S_yy (1 - coherence^2)` estimated from the same averages, `|H_est - H|^2 / s^2` has
    /// an F distribution with 2 and 2 m degrees of freedom, `s^2 = S_yy (1 - coherence^2)
    /// (S_xx^-1)_ii / m` (Bendat and Piersol, Random Data, section 9.3: the confidence limits
    /// of multiple-input estimates, for one `H` at a time). Its quantile is closed:
    /// `m ((1 - confidence)^(-1/m) - 1)`. Holds between DC and Nyquist, for noise at the outputs;
    /// the bias of segments too short for a resonance, a ridge, and noise at the inputs come on
    /// top.
    ///
    /// # Errors
    /// [`EngineError::Setting`] unless 0 < confidence < 1.
    pub fn confidence_factor(&self, confidence: f64) -> Result<f64, EngineError> {
        if !(confidence > 0.0 && confidence < 1.0) {
            return Err(EngineError::Setting {
                setting: "confidence",
                found: confidence.to_string(),
                limit: "above 0 and below 1".into(),
            });
        }
        let m = degrees(self.settings.estimator, self.effective_averages, self.input_hz.len());
        Ok((m * ((1.0 - confidence).powf(-1.0 / m) - 1.0)).sqrt())
    }

    /// Random error of the magnitude of each output's strongest path, relative to it: root of the sum
    /// of squares over the excited lines, of the error over that of the magnitude. `None` where the
    /// magnitude is zero.
    ///
    /// Strongest at a line is the input of the largest ordinary coherence. The standard deviation of
    /// `|H|` is that of one of the two components of the error, `s / sqrt 2`; of one input it is
    /// `sqrt(1 - coherence^2) / (|coherence| sqrt(2 n))` (Bendat and Piersol, Random Data, table 9.6).
    pub fn random_error(&self, frf: &Frf) -> Vec<Option<f64>> {
        let (nx, ny) = (frf.n_inputs, frf.n_outputs);
        let of = |output: usize| {
            let (mut error, mut magnitude) = (0.0, 0.0);
            for line in self.judged_lines() {
                let at = (line * ny + output) * nx;
                let coherence = &self.coherence[at..at + nx];
                let strongest = (0..nx).fold(0, |a, b| if coherence[b] > coherence[a] { b } else { a });
                error += self.std_error[at + strongest].powi(2) / 2.0;
                magnitude += frf.h[at + strongest].norm_sqr();
            }
            Some((error / magnitude).sqrt()).filter(|relative| relative.is_finite())
        };
        (0..ny).map(of).collect()
    }

    /// The excited lines that coherence is judged on: not DC and its neighbour, where the offsets of the
    /// runs lie.
    pub(super) fn judged_lines(&self) -> impl Iterator<Item = usize> + '_ {
        self.excited.iter().flat_map(|&[first, last]| first.max(2)..=last)
    }

    /// Checks that sizes and values belong to `frf`; those of an estimate always do, an import's may not.
    ///
    /// # Errors
    /// [`EngineError::TensorShape`] or [`EngineError::Weights`] naming the tensor.
    pub fn check(&self, frf: &Frf) -> Result<(), EngineError> {
        let (lines, ny, nx) = (frf.n_lines(), frf.n_outputs, frf.n_inputs);
        let wrong = |what: &str, limit: &str| Err(EngineError::Weights(format!("{what}: {limit}")));
        let check = |name: &str, values: &[f64], shape: &[usize], [least, most]: [f64; 2]| {
            if values.len() != shape.iter().product::<usize>() {
                let (expected, found) = (shape.to_vec(), vec![values.len()]);
                return Err(EngineError::TensorShape { tensor: name.into(), expected, found });
            }
            match values.iter().position(|v| !(least..=most).contains(v)) {
                None => Ok(()),
                Some(at) => wrong(
                    name,
                    &format!("value {at} is {:?}, from {least} to {most:e} is allowed", values[at]),
                ),
            }
        };
        check("frf.coherence", &self.coherence, &[lines, ny, nx], [0.0, 1.0])?;
        check("frf.multiple_coherence", &self.multiple_coherence, &[lines, ny], [0.0, 1.0])?;
        check("frf.condition", &self.condition, &[lines], [1.0, MAX_CONDITION])?;
        check("frf.std_error", &self.std_error, &[lines, ny, nx], [0.0, f64::MAX])?;
        self.settings.check()?;
        if self.averages == 0 {
            return wrong("frf.averages", "at least 1 is needed");
        }
        if !(self.effective_averages > 0.0 && self.effective_averages <= self.averages as f64 * (1.0 + 1e-9))
        {
            return wrong("frf.effective_averages", "a positive number, at most frf.averages, is needed");
        }
        let ascending = self.excited.iter().all(|[first, last]| first <= last && *last < lines)
            && self.excited.windows(2).all(|w| w[0][1] < w[1][0]);
        if !ascending {
            return wrong("frf.excited", "pairs of lines, ascending and apart, are needed");
        }
        let nyquist = frf.sample_rate_hz / 2.0;
        let within = |[from, to]: &[f64; 2]| 0.0 <= *from && from <= to && *to <= nyquist * (1.0 + 1e-9);
        if self.input_hz.len() != nx || !self.input_hz.iter().all(within) {
            return wrong("frf.input_hz", "a band for each input, up to sample_rate_hz / 2, is needed");
        }
        Ok(())
    }
}

/// Degrees of freedom that the averages leave for the noise, `m = n - q`: `q` is the number of inputs
/// that the estimator tells apart at a time. Overlap can push them below one, where nothing is known.
pub(super) fn degrees(estimator: Estimator, effective_averages: f64, n_inputs: usize) -> f64 {
    let told_apart = match estimator {
        Estimator::H1 => n_inputs,
        Estimator::Ratio | Estimator::Auto => 1,
    };
    (effective_averages - told_apart as f64).max(0.5)
}

/// Median; of an even number the mean of the middle two.
pub(super) fn median(values: &mut [f64]) -> Option<f64> {
    let middle = values.len() / 2;
    values.sort_unstable_by(f64::total_cmp);
    let upper = *values.get(middle)?;
    Some(if values.len() % 2 == 1 { upper } else { values[middle - 1] + (upper - values[middle - 1]) / 2.0 })
}
