//! From runs to an FRF with everything that says how far to trust it.

use realfft::num_complex::Complex64;

pub(super) use crate::engine::spectral::Means;

use super::band::Band;
use super::choose::{ENOUGH_AVERAGES, choose};
use super::data::Data;
use super::lines::Lines;
use super::{Estimator, Frf, FrfSettings};
use crate::engine::progress::{Watch, report};
use crate::engine::spectral::cross_spectra;
use crate::engine::{EngineError, Signal};

/// An estimated FRF and its quality.
#[derive(Debug, Clone, PartialEq)]
pub struct FrfEstimate {
    /// The estimate.
    pub frf: Frf,
    /// The settings used, none left open.
    pub settings: FrfSettings,
    /// Ordinary coherence of each output with each input, 0..=1, `[line, output, input]`; 0 on
    /// lines that the inputs do not excite.
    pub ordinary_coherence: Vec<f64>,
    /// Multiple coherence of each output with all inputs, 0..=1, `[line, output]`; 0 on lines that
    /// the inputs do not excite.
    pub multiple_coherence: Vec<f64>,
    /// Condition number of `S_xx`, each input scaled to its standard deviation, `[line]`;
    /// `f64::MAX` where it is singular.
    pub condition: Vec<f64>,
    /// Standard deviation of the random error of `H` (see [`FrfEstimate::random_error`]), output
    /// unit / input unit, `[line, output, input]`; 0 on lines that the inputs do not excite.
    pub std_error: Vec<f64>,
    /// Segments averaged.
    pub n_averages: usize,
    /// Independent segments that the overlapping ones are worth.
    pub effective_averages: f64,
    /// What an engineer should know: few averages, correlated inputs, dead bands.
    pub warnings: Vec<String>,
}

impl FrfEstimate {
    /// Radius about each `H[line, output, input]` that holds the true value with probability
    /// `confidence`, output unit / input unit.
    ///
    /// With `n` independent averages of `q` inputs, `m = n - q`, and the noise spectrum
    /// `S_yy (1 - coherence^2)` estimated from the same averages, `|H_est - H|^2 / s^2` has an
    /// F distribution with 2 and 2 m degrees of freedom, `s^2 = S_yy (1 - coherence^2)
    /// (S_xx^-1)_ii / m` (Bendat and Piersol, Random Data, section 9.3: the confidence limits
    /// of multiple-input estimates, for one `H` at a time). Its quantile is closed:
    /// `m ((1 - confidence)^(-1/m) - 1)`. Holds between DC and Nyquist, for noise at the outputs;
    /// the bias of segments too short for a resonance, a ridge, and noise at the inputs come on
    /// top.
    ///
    /// # Errors
    /// [`EngineError::Setting`] unless 0 < confidence < 1.
    pub fn random_error(&self, confidence: f64) -> Result<Vec<f64>, EngineError> {
        if !(confidence > 0.0 && confidence < 1.0) {
            return Err(EngineError::Setting {
                setting: "confidence",
                found: confidence.to_string(),
                limit: "above 0 and below 1".into(),
            });
        }
        let m = degrees(self.effective_averages, self.frf.n_inputs);
        let quantile = m * ((1.0 - confidence).powf(-1.0 / m) - 1.0);
        Ok(self.std_error.iter().map(|s| s * quantile.sqrt()).collect())
    }
}

/// Averages left for the noise estimate; overlap can push them below one, where nothing is known.
fn degrees(effective_averages: f64, n_inputs: usize) -> f64 {
    (effective_averages - n_inputs as f64).max(0.5)
}

/// Estimates an FRF from runs of (inputs, outputs).
///
/// # Errors
/// No runs, runs that do not fit each other, a channel that does not move
/// ([`EngineError::DeadChannel`]), settings outside their limits, no more averages than inputs
/// ([`EngineError::TooFewAverages`]), linearly dependent inputs without a ridge
/// ([`EngineError::DependentInputs`]), cancellation.
pub fn estimate(
    runs: &[(&Signal, &Signal)],
    settings: &FrfSettings,
    watch: Watch<'_>,
) -> Result<FrfEstimate, EngineError> {
    settings.check()?;
    report(watch, "FRF", 0.0)?;
    let data = Data::check(runs)?;
    let choice = choose(&data, settings, watch)?;
    let welch = settings.welch(choice.segment_len);
    let averages = data.n_averages(&welch);
    if averages <= data.n_inputs {
        return Err(EngineError::TooFewAverages { averages, drives: data.n_inputs });
    }
    report(watch, "FRF", 0.9)?;
    let stretches = data.all();
    let means = &data.means;
    let spectra = cross_spectra(&stretches, means, &welch, data.sample_rate_hz)?;
    let lines = Lines::new(&spectra, &data.x_scale)?;
    let (frf, band) = solve(&data, &lines, means, settings.estimator, choice.ridge, choice.segment_len)?;

    let (nx, ny) = (data.n_inputs, data.n_outputs);
    let mut estimate = FrfEstimate {
        settings: FrfSettings {
            segment_len: Some(choice.segment_len),
            ridge: Some(choice.ridge),
            ..settings.clone()
        },
        ordinary_coherence: vec![0.0; frf.h.len()],
        multiple_coherence: vec![0.0; spectra.syy.len()],
        condition: (0..spectra.n_lines).map(|line| lines.condition(line)).collect(),
        std_error: vec![0.0; frf.h.len()],
        n_averages: averages,
        effective_averages: spectra.effective_averages,
        warnings: choice.warnings,
        frf,
    };
    let m = degrees(spectra.effective_averages, nx);
    for line in band.lines() {
        let diagonal: Vec<f64> = (0..nx).map(|i| lines.inverse_diagonal(line, i)).collect();
        for o in 0..ny {
            let coherence = lines.multiple_coherence(line, o);
            let noise = spectra.syy[line * ny + o] * (1.0 - coherence);
            estimate.multiple_coherence[line * ny + o] = coherence;
            for (i, diagonal) in diagonal.iter().enumerate() {
                let at = (line * ny + o) * nx + i;
                estimate.ordinary_coherence[at] = lines.ordinary_coherence(line, o, i);
                estimate.std_error[at] = (noise * diagonal / m).sqrt();
            }
        }
    }
    estimate.frf.check()?;
    warn(&mut estimate, &lines, &band);
    report(watch, "FRF", 1.0)?;
    Ok(estimate)
}

/// `H` from decomposed spectra, shaped to the excited band.
pub(super) fn solve(
    data: &Data<'_>,
    lines: &Lines<'_>,
    means: &Means,
    estimator: Estimator,
    ridge: f64,
    segment_len: usize,
) -> Result<(Frf, Band), EngineError> {
    let n_lines = segment_len / 2 + 1;
    let mean_power: Vec<f64> = (0..n_lines).map(|line| lines.mean_eigenvalue(line)).collect();
    let dead = || EngineError::DeadChannel { what: "frf inputs", channel: 0 };
    let excited = Band::new(&mean_power).ok_or_else(dead)?;
    let singular = excited.lines().all(|line| lines.singular(line));
    if singular && ridge == 0.0 && estimator == Estimator::H1 {
        let channel = lines.most_dependent_input(excited.lines().next().unwrap_or(0));
        return Err(EngineError::DependentInputs { channel });
    }
    let band = match estimator {
        // With a ridge, what dependent inputs have in common can still be told.
        Estimator::H1 if singular => excited,
        Estimator::H1 => {
            let power: Vec<f64> = (0..n_lines).map(|line| lines.eigenvalues[line * data.n_inputs]).collect();
            Band::new(&power).ok_or_else(dead)?
        }
        Estimator::Ratio => {
            let power: Vec<f64> = (0..n_lines).map(|line| lines.smallest_power(line)).collect();
            Band::new(&power).ok_or_else(dead)?
        }
    };
    let mut h: Vec<Complex64> = match estimator {
        Estimator::H1 => lines.h1(ridge),
        Estimator::Ratio => lines.ratio(ridge),
    };
    band.shape(&mut h, data.n_inputs * data.n_outputs);
    let df_hz = data.sample_rate_hz / segment_len as f64;
    let frf = Frf {
        sample_rate_hz: data.sample_rate_hz,
        segment_len,
        n_inputs: data.n_inputs,
        n_outputs: data.n_outputs,
        h,
        usable_hz: [band.first() as f64 * df_hz, band.last() as f64 * df_hz],
        x_mean: means.x.clone(),
        y_mean: means.y.clone(),
    };
    Ok((frf, band))
}

/// Says what limits the estimate.
fn warn(estimate: &mut FrfEstimate, lines: &Lines<'_>, band: &Band) {
    let (frf, nx) = (&estimate.frf, estimate.frf.n_inputs);
    let hz = |line: usize| line as f64 * frf.df_hz();
    let mut warnings = Vec::new();
    let (averages, effective) = (estimate.n_averages, estimate.effective_averages);
    if averages < ENOUGH_AVERAGES * nx || effective < 2.0 * nx as f64 {
        warnings.push(format!(
            "{averages} averages ({effective:.1} independent ones) for {nx} inputs: coherence is too high by \
             construction and H uncertain; shorten frf.segment_len or add runs"
        ));
    }
    let nyquist = frf.n_lines() - 1;
    if band.first() > 0 || band.last() < nyquist {
        let gain = if band.first() > 0 { "; the static gain is unknown and taken as zero" } else { "" };
        warnings.push(format!(
            "inputs excite {:.4} to {:.4} Hz of 0 to {:.4} Hz; outside, H is tapered to zero{gain}",
            frf.usable_hz[0],
            frf.usable_hz[1],
            hz(nyquist)
        ));
    }
    if let Some(gap) = band.spans.windows(2).max_by_key(|w| w[1].0 - w[0].1) {
        warnings.push(format!(
            "{} gaps inside the usable band are not excited, the widest from {:.4} to {:.4} Hz; H is zero there",
            band.spans.len() - 1,
            hz(gap[0].1),
            hz(gap[1].0)
        ));
    }
    let dependent: Vec<usize> = band.lines().filter(|&line| lines.singular(line)).collect();
    if let (Some(&first), Some(&last)) = (dependent.first(), dependent.last()) {
        warnings.push(format!(
            "inputs are linearly dependent on {} lines between {:.4} and {:.4} Hz (input channel {} follows from \
             the others): only their common effect is known",
            dependent.len(),
            hz(first),
            hz(last),
            lines.most_dependent_input(first)
        ));
    }
    if estimate.settings.estimator == Estimator::Ratio {
        warnings.extend(correlated(estimate, lines, band));
    }
    estimate.warnings.extend(warnings);
}

/// A warning for each pair of inputs whose coherence is more than averaging explains.
fn correlated(estimate: &FrfEstimate, lines: &Lines<'_>, band: &Band) -> Vec<String> {
    let frf = &estimate.frf;
    let excited: Vec<usize> = band.lines().collect();
    let n = estimate.effective_averages.max(1.5);
    // Independent inputs show a mean coherence of 1 / n, and in one of a thousand estimates a
    // peak above the second bound on any of the lines.
    let mean_bound = 0.05 + 2.0 / n;
    let peak_bound = (1.0 - (1e-3 / excited.len() as f64).powf(1.0 / (n - 1.0))).max(0.2);
    let mut warnings = Vec::new();
    for a in 0..frf.n_inputs {
        for b in a + 1..frf.n_inputs {
            let coherence = |line: usize| lines.input_coherence(line, a, b);
            let mean = excited.iter().map(|&line| coherence(line)).sum::<f64>() / excited.len() as f64;
            let Some(&peak) = excited.iter().max_by(|&&k, &&l| coherence(k).total_cmp(&coherence(l))) else {
                continue;
            };
            if mean > mean_bound || coherence(peak) > peak_bound {
                warnings.push(format!(
                    "input channels {a} and {b} are correlated (coherence {mean:.2} on average over {:.4} to {:.4} \
                     Hz, {:.2} at {:.4} Hz): estimator \"ratio\" is biased, use \"h1\"",
                    frf.usable_hz[0],
                    frf.usable_hz[1],
                    coherence(peak),
                    peak as f64 * frf.df_hz()
                ));
            }
        }
    }
    warnings
}
