//! From runs to an FRF with everything that says how far to trust it.

use realfft::num_complex::Complex64;

pub(super) use crate::spectral::Means;

use super::band::Band;
use super::choose::choose;
use super::data::{Data, RunPart};
use super::lines::Lines;
use super::quality::{MAX_CONDITION, degrees};
use super::warnings::random_error;
use super::{Estimator, Frf, FrfQuality, FrfSettings};
use crate::progress::{Progress, Watch, report};
use crate::spectral::cross_spectra;
use crate::{EngineError, Signal};

/// An estimated FRF and its quality.
#[derive(Debug, Clone, PartialEq)]
pub struct FrfEstimate {
    /// The estimate.
    pub frf: Frf,
    /// Its quality, with the settings used.
    pub quality: FrfQuality,
    /// What an engineer should know: few averages, correlated inputs, dead bands.
    pub warnings: Vec<String>,
}

/// Estimates an FRF from runs of (inputs, outputs).
///
/// # Errors
/// No runs, runs that do not fit each other, a channel that does not move
/// ([`EngineError::DeadChannel`]), settings outside their limits, no more averages than inputs
/// ([`EngineError::TooFewAverages`]), linearly dependent inputs without a ridge
/// ([`EngineError::DependentInputs`]), cancellation.
pub fn estimate<'a>(
    runs: &[(&'a Signal, &'a Signal)],
    settings: &FrfSettings,
    watch: Watch<'_>,
) -> Result<FrfEstimate, EngineError> {
    let whole = |(x, y): &(&'a Signal, &'a Signal)| RunPart { x, y, samples: 0..x.n_samples() };
    estimate_parts(&runs.iter().map(whole).collect::<Vec<_>>(), settings, watch)
}

/// [`estimate`] from parts of runs.
///
/// # Errors
/// As [`estimate`].
pub fn estimate_parts(
    parts: &[RunPart<'_>],
    settings: &FrfSettings,
    watch: Watch<'_>,
) -> Result<FrfEstimate, EngineError> {
    let by = |estimator, watch: Watch<'_>| {
        estimate_by(parts, &FrfSettings { estimator, ..settings.clone() }, watch)
    };
    let first = |p: Progress<'_>| watch(Progress { fraction: 0.5 * p.fraction, ..p });
    let second = |p: Progress<'_>| watch(Progress { fraction: 0.5 + 0.5 * p.fraction, ..p });
    let (mut found, correlated, hence) = match settings.estimator {
        Estimator::H1 => return Ok(by(Estimator::H1, watch)?.0),
        Estimator::Ratio => {
            let (found, correlated) = by(Estimator::Ratio, watch)?;
            (found, correlated, "estimator \"ratio\" is biased, use \"h1\"")
        }
        Estimator::Auto => {
            let (ratio, correlated) = by(Estimator::Ratio, &first)?;
            let found = if correlated.is_empty() { ratio } else { by(Estimator::H1, &second)?.0 };
            report(watch, "FRF", 1.0)?;
            (found, correlated, "estimator \"h1\" was used, since \"ratio\" is biased then")
        }
    };
    found.warnings.extend(correlated.into_iter().map(|pair| format!("{pair}: {hence}")));
    Ok(found)
}

/// An estimate by one estimator, and by the ratio the pairs of inputs that correlate.
fn estimate_by(
    parts: &[RunPart<'_>],
    settings: &FrfSettings,
    watch: Watch<'_>,
) -> Result<(FrfEstimate, Vec<String>), EngineError> {
    settings.check()?;
    report(watch, "FRF", 0.0)?;
    let data = Data::check(parts)?;
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
    let df_hz = frf.df_hz();
    let mut quality = FrfQuality {
        settings: FrfSettings {
            segment_len: Some(choice.segment_len),
            ridge: Some(choice.ridge),
            ..settings.clone()
        },
        averages,
        effective_averages: spectra.effective_averages,
        excited: band.spans.iter().map(|&(first, last)| [first, last]).collect(),
        input_hz: (0..nx).map(|i| lines.input_band(i).map(|line| line as f64 * df_hz)).collect(),
        coherence: vec![0.0; frf.h.len()],
        multiple_coherence: vec![0.0; spectra.syy.len()],
        condition: (0..spectra.n_lines).map(|line| lines.condition(line).min(MAX_CONDITION)).collect(),
        std_error: vec![0.0; frf.h.len()],
    };
    let m = degrees(settings.estimator, spectra.effective_averages, nx);
    for line in band.lines() {
        let diagonal: Vec<f64> = (0..nx).map(|i| lines.inverse_diagonal(line, i)).collect();
        for o in 0..ny {
            let multiple = lines.multiple_coherence(line, o);
            quality.multiple_coherence[line * ny + o] = multiple;
            for (i, diagonal) in diagonal.iter().enumerate() {
                let at = (line * ny + o) * nx + i;
                let coherence = lines.ordinary_coherence(line, o, i);
                quality.coherence[at] = coherence;
                // For the ratio form, the share of the other inputs is noise.
                let (unexplained, inverse) = match settings.estimator {
                    Estimator::H1 => (1.0 - multiple, *diagonal),
                    Estimator::Ratio | Estimator::Auto => (1.0 - coherence, 1.0 / lines.power(line, i)),
                };
                quality.std_error[at] = (spectra.syy[line * ny + o] * unexplained * inverse / m).sqrt();
            }
        }
    }
    let mut estimate = FrfEstimate { frf, quality, warnings: choice.warnings };
    estimate.frf.check()?;
    estimate.quality.check(&estimate.frf)?;
    warn(&mut estimate, &lines, &band);
    let correlated = match settings.estimator {
        Estimator::H1 => Vec::new(),
        Estimator::Ratio | Estimator::Auto => correlated(&estimate, &lines, &band),
    };
    report(watch, "FRF", 1.0)?;
    Ok((estimate, correlated))
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
            let power: Vec<f64> = (0..n_lines).map(|line| lines.weakest(line)).collect();
            Band::new(&power).ok_or_else(dead)?
        }
        Estimator::Ratio | Estimator::Auto => {
            let power: Vec<f64> = (0..n_lines).map(|line| lines.smallest_power(line)).collect();
            Band::new(&power).ok_or_else(dead)?
        }
    };
    let mut h: Vec<Complex64> = match estimator {
        Estimator::H1 => lines.h1(ridge, &band)?,
        Estimator::Ratio | Estimator::Auto => lines.ratio(ridge, &band),
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
    let frf = &estimate.frf;
    let hz = |line: usize| line as f64 * frf.df_hz();
    let mut warnings = Vec::new();
    warnings.extend(random_error(frf, &estimate.quality));
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
    estimate.warnings.extend(warnings);
}

/// Each pair of inputs whose coherence is more than averaging explains, with what was found and what
/// the limit is.
fn correlated(estimate: &FrfEstimate, lines: &Lines<'_>, band: &Band) -> Vec<String> {
    let frf = &estimate.frf;
    let excited: Vec<usize> = band.lines().collect();
    let n = estimate.quality.effective_averages.max(1.5);
    // Independent inputs show a mean coherence of 1 / n, and in one of a thousand estimates a
    // peak above the second bound on any of the lines.
    let mean_bound = 0.05 + 2.0 / n;
    let peak_bound = (1.0 - (1e-3 / excited.len() as f64).powf(1.0 / (n - 1.0))).max(0.2);
    let mut pairs = Vec::new();
    for a in 0..frf.n_inputs {
        for b in a + 1..frf.n_inputs {
            let coherence = |line: usize| lines.input_coherence(line, a, b);
            let mean = excited.iter().map(|&line| coherence(line)).sum::<f64>() / excited.len() as f64;
            let Some(&peak) = excited.iter().max_by(|&&k, &&l| coherence(k).total_cmp(&coherence(l))) else {
                continue;
            };
            if mean > mean_bound || coherence(peak) > peak_bound {
                pairs.push(format!(
                    "input channels {a} and {b} are correlated (coherence {mean:.2} on average over {:.4} to {:.4} \
                     Hz, limit {mean_bound:.2}; {:.2} at {:.4} Hz, limit {peak_bound:.2})",
                    frf.usable_hz[0],
                    frf.usable_hz[1],
                    coherence(peak),
                    peak as f64 * frf.df_hz()
                ));
            }
        }
    }
    pairs
}
