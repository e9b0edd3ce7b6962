//! Noise against systematic error, from runs with the same drive.
//!
//! The difference of two residuals holds no systematic error, only noise, twice: half its spectrum
//! is the noise floor. What of it the drive predicts is time variance, not noise, and is taken out
//! first.

use super::settled::{Left, settled};
use crate::diagnosis::core::Core;
use crate::diagnosis::input::Run;
use crate::diagnosis::numerics::ar::Ar;
use crate::diagnosis::numerics::linear::{dot, least_squares, mean};
use crate::diagnosis::numerics::rows::Rows;

/// Largest order of the noise's autoregression.
const MAX_ORDER: usize = 24;
/// Below this coherence with the drive a repeat difference is taken as it is.
pub const COHERENT: f64 = 0.02;

/// Noise of one response.
#[derive(Debug, Clone)]
pub struct Noise {
    pub ar: Ar,
    /// Share of the repeat differences that the drive predicts, chance taken off.
    pub drive_coherence: f64,
}

/// One pair of repeats: the difference of their responses, the drives, the sim, and the samples at
/// its start that are not used.
pub struct Pair<'a> {
    pub difference: Vec<f64>,
    pub drives: Vec<&'a [f64]>,
    pub simulated: &'a [f64],
    pub lead: usize,
}

/// Noise from pairs of repeats; `None` without any.
pub fn from_repeats(pairs: &[Pair<'_>], core: &Core, band: [f64; 2]) -> Option<Noise> {
    let kept: Vec<&Pair<'_>> = pairs.iter().filter(|p| p.difference.len() > p.lead + 64).collect();
    if kept.is_empty() {
        return None;
    }
    let columns: Vec<Vec<Vec<f64>>> = kept.iter().map(|p| signals(p, core)).collect();
    let white = Ar::white(1.0);
    let mut rows_of_columns = vec![Vec::new(); columns[0].len()];
    let mut target = Vec::new();
    for (pair, columns) in kept.iter().zip(&columns) {
        let rows = Rows::new(pair.difference.len() - pair.lead, band, &white);
        for (out, column) in rows_of_columns.iter_mut().zip(columns) {
            rows.extend(&column[pair.lead..], out);
        }
        rows.extend(&pair.difference[pair.lead..], &mut target);
    }
    let slices: Vec<&[f64]> = rows_of_columns.iter().map(Vec::as_slice).collect();
    let x = least_squares(&slices, &target);
    let mut left = target.clone();
    for (column, x) in slices.iter().zip(&x) {
        left.iter_mut().zip(*column).for_each(|(l, c)| *l -= x * c);
    }
    let (rows, p) = (target.len() as f64, slices.len() as f64);
    let total = dot(&target, &target);
    let drive_coherence = if total > 0.0 && rows > 2.0 * p {
        (1.0 - dot(&left, &left) / total * rows / (rows - p)).max(0.0)
    } else {
        0.0
    };
    let halves: Vec<Vec<f64>> = kept
        .iter()
        .zip(&columns)
        .map(|(pair, columns)| {
            let mut d = pair.difference.clone();
            if drive_coherence > COHERENT {
                for (column, x) in columns.iter().zip(&x) {
                    d.iter_mut().zip(column).for_each(|(d, c)| *d -= x * c);
                }
            }
            d[pair.lead..].iter().map(|d| d * std::f64::consts::FRAC_1_SQRT_2).collect()
        })
        .collect();
    let stretches: Vec<&[f64]> = halves.iter().map(Vec::as_slice).collect();
    Some(Noise { ar: Ar::fit(&stretches, MAX_ORDER), drive_coherence })
}

/// Noise with what the sim of a response erred by on the baseline runs beyond it, which is no change: grown with the
/// response, as far as the sim leaves so much of the runs to explain. The noise where the sim erred by less than that, or does
/// not say.
pub fn with_own_error(noise: &Ar, baseline: &[Run], runs: &[Run], response: usize, band: [f64; 2]) -> Ar {
    let error = |run: &Run| -> Option<Vec<f64>> {
        let [y, sim] = [&run.response, run.simulated.as_ref()?].map(|of| settled(of.channel(response)));
        let mut error: Vec<f64> = y.iter().zip(sim).map(|(y, sim)| y - sim).collect();
        let centre = mean(&error);
        error.iter_mut().for_each(|e| *e -= centre);
        Some(error)
    };
    let left = |runs: &[Run]| -> Option<(Ar, f64)> {
        let errors: Vec<Vec<f64>> = runs.iter().map(error).collect::<Option<_>>()?;
        let errors: Vec<&[f64]> = errors.iter().map(Vec::as_slice).collect();
        Some((Ar::fit(&errors, MAX_ORDER), Left::of(runs, response)?.variance()))
    };
    let (Some((was, small)), Some((now, large))) = (left(baseline), left(runs)) else { return noise.clone() };
    let floor = noise.mean_power(band);
    let [was_power, now_power] = [&was, &now].map(|ar| ar.mean_power(band));
    let own = ((was_power - floor) * large / small).min(now_power - floor);
    if own < floor {
        return noise.clone();
    }
    Ar { variance: was.variance * (floor + own) / was_power, ..was }
}

/// What a slow change of the rig would add between two repeats: the drives and the response
/// through the core's poles.
fn signals(pair: &Pair<'_>, core: &Core) -> Vec<Vec<f64>> {
    let mut out = Vec::new();
    for (d, drive) in pair.drives.iter().enumerate() {
        let moved: Vec<f64> = drive.iter().map(|u| u - core.drive_mean[d]).collect();
        out.extend(core.modes.basis(&moved));
        out.push(moved);
    }
    let moved: Vec<f64> = pair.simulated.iter().map(|y| y - core.response_mean).collect();
    out.extend(core.modes.basis(&moved));
    let n = pair.difference.len();
    out.push(vec![1.0; n]);
    out.push((0..n).map(|k| k as f64 / n as f64 - 0.5).collect());
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Signal;
    use crate::diagnosis::tests::rig::{RATE, noise_drive, none, respond, run};

    #[test]
    fn what_a_sim_erred_by_before_counts_with_the_noise_and_grows_with_the_response() {
        let band = [0.0, 0.1];
        let of = |level: f64, gain: f64, change: f64, seed: u64| -> Run {
            let run = run("", noise_drive(60.0, level, seed), none, 0.01, seed);
            let linear = respond(run.drive.channel(0), none);
            let sim = linear.iter().map(|y| gain * y - change * y * y).collect();
            Run { simulated: Some(Signal::new(RATE, vec![sim]).unwrap()), ..run }
        };
        let noise = Ar::white(1e-4);
        let power = |gain: f64, change: f64| {
            let (baseline, runs) = ([of(0.5, gain, 0.0, 1)], [of(1.0, gain, change, 2)]);
            with_own_error(&noise, &baseline, &runs, 0, band).mean_power(band)
        };
        let floor = noise.mean_power(band);
        assert!((power(1.0, 0.0) / floor - 1.0).abs() < 1e-12, "an exact sim");
        let response = of(1.0, 1.0, 0.0, 2).response;
        let all = Ar::fit(&[response.channel(0)], MAX_ORDER).mean_power(band);
        let own = 0.05 * 0.05 * all;
        let erring = power(1.05, 0.0);
        assert!((erring / (own + floor) - 1.0).abs() < 0.15, "{erring} {own} {floor}");
        let changed = power(1.05, 0.3);
        assert!(
            (changed / (own + floor) - 1.0).abs() < 0.15,
            "a change is no error of before: {changed} {own}"
        );
    }
}
