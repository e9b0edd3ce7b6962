//! The linear correction of a drive: the inverse FRF of the error, with a gain for each target and line that falls
//! where the error grew and rises where it shrank.

use std::ops::RangeInclusive;

use realfft::num_complex::Complex64;

use super::linear::Linear;
use super::{IterationSettings, Problem};
use crate::frf::{Frf, FrfFilter, FrfInverse};
use crate::spectral::{Detrend, Welch, psd};
use crate::{EngineError, Signal};

/// Third-octave bands, but none narrower than this many lines.
const NARROWEST: usize = 8;

/// Ratio of a band's last to its first line: a third of an octave.
const THIRD_OCTAVE: f64 = 1.259_921_049_894_873;

/// Lines to either side over which the gain is averaged, so that its edges do not ring.
const SMOOTH: usize = 4;

/// Part of a target's error power below which a band's growth is no reason for anything.
const NEGLIGIBLE: f64 = 1e-4;

const FALL: f64 = 0.5;
const RISE: f64 = 1.25;

/// The inverse of the linear part with its gains.
pub(super) struct Correction {
    frf: Frf,
    /// `H^+` at gain 1, input unit / output unit, `[line, input, target]`.
    inverse: Vec<Complex64>,
    /// How far the FRF can be relied on where a correction was asked for, 0..=1, `[target][line]`.
    pub reach: Vec<Vec<f64>>,
    /// That times the gain asked for, `[target][line]`.
    gain: Vec<Vec<f64>>,
    bands: Vec<RangeInclusive<usize>>,
    /// Factor of each band, at most 1, `[target][band]`.
    factor: Vec<Vec<f64>>,
}

impl Correction {
    pub fn new(
        linear: &Linear,
        problem: &Problem<'_>,
        settings: &IterationSettings,
    ) -> Result<Self, EngineError> {
        let frf = &linear.frf;
        let mut inverse =
            FrfInverse::weighted(frf, linear.quality.as_ref(), settings.ridge, problem.weights)?;
        if let Some(quality) = &linear.quality {
            inverse = inverse.damped_by(quality);
        }
        let [first, last] = inverse.zero_outside();
        let within = inverse.reach(frf);
        let of_targets = (0..frf.n_outputs).map(|target| gains(linear, problem, settings, &within, target));
        let (reach, gain) = of_targets.unzip();
        let bands = bands(first, last);
        Ok(Self {
            inverse: inverse.lines(frf, 0..frf.n_lines())?,
            factor: vec![vec![1.0; bands.len()]; frf.n_outputs],
            frf: frf.clone(),
            reach,
            gain,
            bands,
        })
    }

    /// First and last frequency at which any target is corrected with at least half of its gain.
    pub fn band_hz(&self) -> Option<[f64; 2]> {
        let df = self.frf.df_hz();
        let used = |line: &usize| self.reach.iter().any(|reach| reach[*line] >= 0.5);
        let lines = 0..self.frf.n_lines();
        let (first, last) = (lines.clone().find(used)?, lines.rev().find(used)?);
        Some([first as f64 * df, last as f64 * df])
    }

    /// Spectral density on the lines of the FRF, the mean included, `[channel][line]`. A signal shorter than the
    /// FRF's segments has coarser lines, each at its nearest.
    pub fn density(&self, x: &Signal) -> Result<Vec<Vec<f64>>, EngineError> {
        let segment_len = self.frf.segment_len.min(x.n_samples());
        let found = psd(&[x], &Welch { segment_len, overlap: 0.5, detrend: Detrend::None })?;
        let place = |line: usize| {
            ((line as f64 * found.df_hz / self.frf.df_hz()).round() as usize).min(self.frf.n_lines() - 1)
        };
        let placed = |density: &Vec<f64>| {
            let mut lines = vec![0.0; self.frf.n_lines()];
            density.iter().enumerate().for_each(|(line, d)| lines[place(line)] += d);
            lines
        };
        Ok(found.density.iter().map(placed).collect())
    }

    /// Power of an error in each band, `[target][band]`.
    pub fn powers(&self, error: &Signal) -> Result<Vec<Vec<f64>>, EngineError> {
        let of_target =
            |density: Vec<f64>| self.bands.iter().map(|band| density[band.clone()].iter().sum()).collect();
        Ok(self.density(error)?.into_iter().map(of_target).collect())
    }

    /// Lowers the gain where an error grew, and raises it towards the one asked for elsewhere if the step was `kept`.
    pub fn learn(&mut self, before: &[Vec<f64>], after: &[Vec<f64>], kept: bool) {
        for ((factor, before), after) in self.factor.iter_mut().zip(before).zip(after) {
            let floor = NEGLIGIBLE * before.iter().sum::<f64>();
            for ((factor, before), after) in factor.iter_mut().zip(before).zip(after) {
                if after > before && *after > floor {
                    *factor *= FALL;
                } else if kept {
                    *factor = (*factor * RISE).min(1.0);
                }
            }
        }
    }

    /// Lowers every gain.
    pub fn lower(&mut self) {
        self.factor.iter_mut().flatten().for_each(|factor| *factor *= FALL);
    }

    /// Mean factor on the gains asked for.
    pub fn mean_factor(&self) -> f64 {
        let all = self.factor.iter().flatten();
        all.clone().sum::<f64>() / all.count().max(1) as f64
    }

    /// `x_mean + H^+ (target - y_mean)`: the drive that the linear part alone would take.
    pub fn start(&self, target: &Signal) -> Result<Signal, EngineError> {
        let once = |_, target: usize, line: usize| self.reach[target][line];
        self.with_gains(once, self.frf.y_mean.clone(), self.frf.x_mean.clone()).filter()?.apply(target)
    }

    /// The correction of the drive for an error (target minus response).
    pub fn of(&self, error: &Signal) -> Result<Signal, EngineError> {
        let at = |band: Option<usize>, target: usize, line: usize| {
            self.gain[target][line] * band.map_or(0.0, |band| self.factor[target][band])
        };
        self.about_zero(at).filter()?.apply(error)
    }

    /// The inverse on the lines that corrections reach, whatever their gains. `square` is the weight of each target's
    /// squared error.
    pub fn reachable(&self, square: &[f64]) -> Result<Reachable, EngineError> {
        let once = |_, target: usize, line: usize| self.reach[target][line];
        Ok(Reachable { inverse: self.about_zero(once).filter()?, square: square.to_vec() })
    }

    fn about_zero(&self, gain: impl Fn(Option<usize>, usize, usize) -> f64) -> Frf {
        self.with_gains(gain, vec![0.0; self.frf.n_outputs], vec![0.0; self.frf.n_inputs])
    }

    /// `H^+` with gains, as a response of its own: of a drive with the mean `y_mean` to a target with the mean `x_mean`.
    fn with_gains(
        &self,
        gain: impl Fn(Option<usize>, usize, usize) -> f64,
        x_mean: Vec<f64>,
        y_mean: Vec<f64>,
    ) -> Frf {
        let (n_inputs, n_targets) = (self.frf.n_inputs, self.frf.n_outputs);
        let mut h = self.inverse.clone();
        for (line, inverse) in h.chunks_mut(n_inputs * n_targets).enumerate() {
            let band = self.bands.iter().position(|band| band.contains(&line));
            for (at, value) in inverse.iter_mut().enumerate() {
                *value *= gain(band, at % n_targets, line);
            }
        }
        Frf { n_inputs: n_targets, n_outputs: n_inputs, h, x_mean, y_mean, ..self.frf.clone() }
    }
}

/// The inverse FRF as a preconditioner of gradients.
pub(super) struct Reachable {
    inverse: FrfFilter,
    square: Vec<f64>,
}

impl Reachable {
    /// `C (2 W)^-1 C^T g`, `[drive, sample]`, of a gradient of the square error by the drive; on either side of it
    /// the factors of the taper.
    ///
    /// # Errors
    /// A result that is not finite.
    pub fn precondition(&self, gradient: &Signal, taper: &[f64]) -> Result<Signal, EngineError> {
        let rate = gradient.sample_rate_hz();
        let tapered = |x: &Signal| {
            let of = |x: &Vec<f64>| x.iter().zip(taper).map(|(x, taper)| x * taper).collect();
            Signal::new(rate, x.channels().iter().map(of).collect())
        };
        let mut by_target = self.inverse.adjoint(&tapered(gradient)?)?.into_channels();
        for (samples, square) in by_target.iter_mut().zip(&self.square) {
            samples.iter_mut().for_each(|v| *v /= 2.0 * square);
        }
        tapered(&self.inverse.apply(&Signal::new(rate, by_target)?)?)
    }
}

/// At every line of a target, how far the FRF can be relied on where a correction was asked for, and that times the gain
/// asked for. `within` is the share of an error that the damped inverse reaches, `[line, target]`.
fn gains(
    linear: &Linear,
    problem: &Problem<'_>,
    settings: &IterationSettings,
    within: &[f64],
    target: usize,
) -> (Vec<f64>, Vec<f64>) {
    let df = linear.frf.df_hz();
    let n_targets = linear.frf.n_outputs;
    let asked = |line: usize| {
        let hz = line as f64 * df;
        let inside = |from: f64, to: f64| hz >= from && hz <= to;
        if settings.band_hz.is_some_and(|[from, to]| !inside(from, to)) {
            return 0.0;
        }
        let bands = settings.gain_bands.iter().filter(|band| inside(band.from_hz, band.to_hz));
        settings.gain * problem.gains[target] * bands.map(|band| band.gain).product::<f64>()
    };
    let coherent = |line: usize| match &linear.quality {
        None => {
            let [first, last] = linear.frf.usable_hz;
            let hz = line as f64 * df;
            if hz >= first && hz <= last { 1.0 } else { 0.0 }
        }
        Some(quality) => {
            let (coherence, least) =
                (quality.multiple_coherence[line * n_targets + target], settings.min_coherence);
            // Full half way between the least coherence and 1.
            if coherence < least { 0.0 } else { (2.0 * (coherence - least) / (1.0 - least)).min(1.0) }
        }
    };
    // What is damped by less than a half is corrected all the same, in a few iterations.
    let reliable = |line: usize| coherent(line) * (2.0 * within[line * n_targets + target]).min(1.0);
    let lines = 0..linear.frf.n_lines();
    let reach =
        smooth(&lines.clone().map(|l| if asked(l) > 0.0 { reliable(l) } else { 0.0 }).collect::<Vec<_>>());
    let gain = smooth(&lines.map(|line| asked(line) * reliable(line)).collect::<Vec<_>>());
    (reach, gain)
}

/// The mean of each line and its neighbours.
fn smooth(lines: &[f64]) -> Vec<f64> {
    (0..lines.len())
        .map(|line| {
            let near = &lines[line.saturating_sub(SMOOTH)..(line + SMOOTH + 1).min(lines.len())];
            near.iter().sum::<f64>() / near.len() as f64
        })
        .collect()
}

/// Third-octave bands over some lines.
fn bands(first: usize, last: usize) -> Vec<RangeInclusive<usize>> {
    let mut bands = Vec::new();
    let mut from = first;
    while from <= last {
        let to = ((from as f64 * THIRD_OCTAVE) as usize).max(from + NARROWEST - 1).min(last);
        bands.push(from..=to);
        from = to + 1;
    }
    bands
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_bands_cover_all_lines_once() {
        let bands = bands(3, 400);
        let lines: Vec<usize> = bands.iter().flat_map(Clone::clone).collect();
        assert_eq!(lines, (3..=400).collect::<Vec<_>>());
        assert!(bands.len() > 10 && bands.len() < 30, "{}", bands.len());
    }
}
