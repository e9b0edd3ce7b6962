//! A band around a prediction that holds the measured response at 90 % of the samples.
//!
//! The band is calibrated on data that the model was neither trained nor stopped on (split conformal prediction; Lei et
//! al., "Distribution-free predictive inference for regression", 2018, section 5.2: locally weighted residuals). A residual
//! is divided by a local scale that is known at prediction, so that residuals of loud and quiet, of nearly linear and of
//! strongly nonlinear times can be held against each other:
//!
//!     scale(t)^2 = floor^2 + level^2 * L(t) + correction^2 * C(t)
//!
//! L is the mean square of the predicted response about its mean in the calibration, so that an offset counts, and C that
//! of what a hybrid's network changes of its FRF or core; both over a window about t. The half width is the scale times
//! the 90 % quantile of |residual| / scale, which is taken apart for quiet and loud times (Mondrian conformal prediction;
//! Vovk, Gammerman, Shafer, "Algorithmic Learning in a Random World", 2005, section 4.5): residuals of a rig grow faster
//! than in proportion, and other loads have other shares of quiet and loud. Above the loudest class the quantile grows on
//! as over the louder half of them.

mod cycles;
mod scale;

use serde::{Deserialize, Serialize};

use self::cycles::Stretch;
use self::scale::moving_mean_square;

use super::fit_data::FitData;
use super::score::PredictedSection;
use super::{ModelKind, RigModel};
use crate::{EngineError, Signal};

/// Share of the samples at which a band holds the response.
pub const COVERAGE: f64 = 0.9;

/// Samples of the window about a sample, for models without a network; with one its own window.
const WINDOW: usize = 256;

/// Longest window that is read from a file.
const MAX_WINDOW: usize = 65_536;

/// A window gives so many rows to the fit of the scale.
const ROWS_PER_WINDOW: usize = 4;

/// Most classes of scales with a quantile of their own, each of at least so many windows.
const CLASSES: usize = 8;
const WINDOWS_PER_CLASS: usize = 20;

/// Classes that a growth above the loudest of them is told by at least.
const LEAST_FOR_GROWTH: usize = 3;

/// The calibration of a model's band.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Band {
    /// Samples of the window about a sample.
    window: usize,
    /// Of each output, in order.
    outputs: Vec<OutputBand>,
}

/// The scale of one output's residuals.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct OutputBand {
    /// Mean of the predicted response in the calibration, channel unit.
    mean: f64,
    /// Scale at rest, channel unit.
    floor: f64,
    /// Share of the response's level.
    level: f64,
    /// Share of the network's correction.
    correction: f64,
    /// Half width over scale, of all the calibration.
    quantile: f64,
    /// The same by scale: middle of a class of scales, half width over scale in it. By rising scale, linear in its
    /// logarithm between the classes, constant below them, growing on above them. Empty: the same at any scale.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    by_scale: Vec<[f64; 2]>,
    /// Factor on the half width for the damage that follows.
    #[serde(default = "one")]
    of_cycles: f64,
}

fn one() -> f64 {
    1.0
}

impl Band {
    /// Calibrates the band of a model without filter of its own on sections of filtered data that it has not seen, as
    /// it predicts them.
    ///
    /// # Errors
    /// Those of the prediction.
    pub(super) fn calibrate(
        model: &RigModel,
        filtered: &FitData,
        predicted: &[PredictedSection<'_>],
    ) -> Result<Self, EngineError> {
        let window = model.lstm.as_ref().map_or(WINDOW, |part| part.window_len);
        let mut parts = Vec::new();
        for found in predicted {
            let linear = corrected(model).then(|| model.linear(&found.x)).transpose()?.flatten();
            parts.push((found, linear));
        }
        let output = |k: usize| {
            let n: usize = parts.iter().map(|(part, _)| part.scored(k).len()).sum();
            let sum: f64 = parts.iter().flat_map(|(part, _)| part.scored(k)).sum();
            let mean = sum / n.max(1) as f64;
            let columns = parts.iter().map(|(part, linear)| {
                let y = part.response.channel(k);
                let linear = linear.as_ref().map(|linear| linear.channel(k));
                let [level, correction] = features(y, linear, mean, window);
                let skip = part.skip;
                let measured = &filtered.run(part.section.run).y.channel(k)[part.section.samples.clone()];
                let residual: Vec<f64> = part.scored(k).iter().zip(measured).map(|(y, m)| m - y).collect();
                let (level, correction) = (level[skip..].to_vec(), correction[skip..].to_vec());
                (Columns { level, correction, residual }, measured)
            });
            let (columns, measured): (Vec<_>, Vec<_>) = columns.unzip();
            let band = OutputBand::of(mean, &columns, window);
            let half_widths: Vec<Vec<f64>> = columns.iter().map(|part| band.half_widths(part)).collect();
            let stretches: Vec<Stretch<'_>> = columns
                .iter()
                .zip(measured)
                .zip(&half_widths)
                .map(|((part, measured), half_width)| Stretch {
                    measured,
                    residual: &part.residual,
                    half_width,
                })
                .collect();
            OutputBand { of_cycles: cycles::factor(&stretches, window, COVERAGE), ..band }
        };
        let outputs = (0..model.outputs.len()).map(output).collect();
        Ok(Self { window, outputs })
    }

    /// Half width of each output about a whole response, `[output, sample]`. `linear` is the response of the FRF or core
    /// of a hybrid.
    pub(super) fn half_width(
        &self,
        response: &Signal,
        linear: Option<&Signal>,
    ) -> Result<Signal, EngineError> {
        let of = |(k, output): (usize, &OutputBand)| {
            let linear = linear.map(|linear| linear.channel(k));
            let [level, correction] = features(response.channel(k), linear, output.mean, self.window);
            let scale = level.iter().zip(&correction).map(|(l, c)| output.scale(*l, *c));
            scale.map(|scale| output.half_width(scale)).collect()
        };
        Signal::new(response.sample_rate_hz(), self.outputs.iter().enumerate().map(of).collect())
    }

    /// Factor on each output's half width for the damage that follows from the band.
    pub(super) fn of_cycles(&self) -> Vec<f64> {
        self.outputs.iter().map(|output| output.of_cycles).collect()
    }

    /// Whether it is one of a model with so many outputs.
    ///
    /// # Errors
    /// What is wrong with a band from a file.
    pub(super) fn check(&self, outputs: usize) -> Result<(), EngineError> {
        let wrong = |what: String| Err(EngineError::Weights(format!("band: {what}")));
        if self.outputs.len() != outputs {
            return wrong(format!("{} entries for {outputs} outputs", self.outputs.len()));
        }
        if !(1..=MAX_WINDOW).contains(&self.window) {
            return wrong(format!("window {}: 1 to {MAX_WINDOW} samples are needed", self.window));
        }
        let known = |v: &f64| (0.0..=1e15).contains(v);
        let bad = self.outputs.iter().position(|o| {
            let scale = [o.floor, o.level, o.correction, o.quantile, o.of_cycles];
            let rising = o.by_scale.windows(2).all(|pair| pair[0][0] < pair[1][0]);
            let above_zero =
                o.by_scale.iter().all(|[scale, ratio]| *scale > 0.0 && known(scale) && known(ratio));
            let classes = o.by_scale.len() <= CLASSES && rising && above_zero;
            !(scale.iter().all(known) && known(&o.mean.abs()) && classes)
        });
        bad.map_or(Ok(()), |k| wrong(format!("outputs[{k}]: numbers from 0 to 1e15 are needed")))
    }
}

/// Whether a network changes the response of an FRF.
pub(super) fn corrected(model: &RigModel) -> bool {
    matches!(model.kind, ModelKind::Hybrid1 | ModelKind::Hybrid2)
}

/// One section's features and residuals of one output.
struct Columns {
    level: Vec<f64>,
    correction: Vec<f64>,
    residual: Vec<f64>,
}

impl OutputBand {
    fn of(mean: f64, parts: &[Columns], window: usize) -> Self {
        let step = (window / ROWS_PER_WINDOW).max(1);
        let rows: Vec<([f64; 3], f64)> = parts
            .iter()
            .flat_map(|part| {
                let square = moving_mean_square(part.residual.iter().copied(), window);
                let row = |t: usize| ([1.0, part.level[t], part.correction[t]], square[t]);
                (0..part.residual.len()).step_by(step).map(row).collect::<Vec<_>>()
            })
            .collect();
        let [floor, level, correction] = scale::fit(&rows).map(f64::sqrt);
        let band =
            Self { mean, floor, level, correction, quantile: 1.0, by_scale: Vec::new(), of_cycles: 1.0 };
        // Scale, residual over scale.
        let mut found: Vec<[f64; 2]> = parts
            .iter()
            .flat_map(|part| {
                let scales = part.level.iter().zip(&part.correction).map(|(l, c)| band.scale(*l, *c));
                part.residual.iter().zip(scales).map(|(r, s)| [s, if s > 0.0 { r.abs() / s } else { 0.0 }])
            })
            .collect();
        found.sort_by(|a, b| a[0].total_cmp(&b[0]));
        let classes = (found.len() / (WINDOWS_PER_CLASS * window)).min(CLASSES);
        let mut by_scale: Vec<[f64; 2]> = Vec::new();
        if classes > 1 {
            for class in found.chunks(found.len().div_ceil(classes)) {
                let middle = class[class.len() / 2][0];
                if by_scale.last().map_or(0.0, |last| last[0]) < middle {
                    by_scale.push([middle, quantile(class)]);
                }
            }
        }
        Self { quantile: quantile(&found), by_scale, ..band }
    }

    fn half_widths(&self, part: &Columns) -> Vec<f64> {
        let scales = part.level.iter().zip(&part.correction).map(|(l, c)| self.scale(*l, *c));
        scales.map(|scale| self.half_width(scale)).collect()
    }

    fn half_width(&self, scale: f64) -> f64 {
        let after = self.by_scale.partition_point(|[middle, _]| *middle <= scale);
        let ratio = match (after.checked_sub(1).map(|k| &self.by_scale[k]), self.by_scale.get(after)) {
            (None, None) => self.quantile,
            (None, Some([_, ratio])) => *ratio,
            (Some([loudest, ratio]), None) => ratio * (scale / loudest).powf(self.growth()),
            (Some([from, low]), Some([to, high])) => {
                low + (high - low) * (scale / from).ln() / (to / from).ln()
            }
        };
        ratio * scale
    }

    /// Power of the scale that the ratio grows with in the louder half of the classes, and so above them: none where it
    /// falls there, at most the first, since residuals that grow faster than the square of the level are none of a rig.
    fn growth(&self) -> f64 {
        let louder = &self.by_scale[self.by_scale.len() / 2..];
        let points: Vec<[f64; 2]> = louder
            .iter()
            .filter(|[_, ratio]| *ratio > 0.0)
            .map(|[scale, ratio]| [scale.ln(), ratio.ln()])
            .collect();
        if points.len() < LEAST_FOR_GROWTH {
            return 0.0;
        }
        let mean = |i: usize| points.iter().map(|p| p[i]).sum::<f64>() / points.len() as f64;
        let (x, y) = (mean(0), mean(1));
        let along: f64 = points.iter().map(|p| (p[0] - x) * (p[1] - y)).sum();
        let spread: f64 = points.iter().map(|p| (p[0] - x).powi(2)).sum();
        (along / spread).clamp(0.0, 1.0)
    }

    fn scale(&self, level: f64, correction: f64) -> f64 {
        (self.floor.powi(2) + self.level.powi(2) * level + self.correction.powi(2) * correction).sqrt()
    }
}

/// The quantile of the ratios `[scale, ratio]` that so many more hold with the rate of the band.
fn quantile(found: &[[f64; 2]]) -> f64 {
    let mut ratios: Vec<f64> = found.iter().map(|[_, ratio]| *ratio).collect();
    ratios.sort_by(f64::total_cmp);
    let place = ((ratios.len() + 1) as f64 * COVERAGE).ceil() as usize;
    ratios.get(place.clamp(1, ratios.len().max(1)) - 1).copied().unwrap_or_default()
}

/// Mean squares of the response about `mean`, and of its distance from `linear`, over a window about each sample.
fn features(y: &[f64], linear: Option<&[f64]>, mean: f64, window: usize) -> [Vec<f64>; 2] {
    let level = moving_mean_square(y.iter().map(|y| y - mean), window);
    let correction = match linear {
        Some(linear) => moving_mean_square(y.iter().zip(linear).map(|(y, l)| y - l), window),
        None => vec![0.0; y.len()],
    };
    [level, correction]
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;

    /// Residuals whose scale is `floor^2 + level^2 L + correction^2 C`, at levels that rise over the section.
    fn columns(n: usize, loudest: f64, seed: u64) -> Columns {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut part = Columns { level: Vec::new(), correction: Vec::new(), residual: Vec::new() };
        for t in 0..n {
            let level = loudest * t as f64 / n as f64;
            let correction = 0.3 * level * (t as f64 * 0.001).sin().powi(2);
            let scale = (0.02_f64.powi(2) + 0.05_f64.powi(2) * level + 0.3_f64.powi(2) * correction).sqrt();
            let white: f64 = StandardNormal.sample(&mut rng);
            part.level.push(level);
            part.correction.push(correction);
            part.residual.push(scale * white);
        }
        part
    }

    #[test]
    fn the_scale_of_the_residuals_is_found_and_holds_at_another_level() {
        let band = OutputBand::of(0.0, &[columns(60_000, 4.0, 1), columns(60_000, 0.5, 2)], 256);
        assert!((band.floor - 0.02).abs() < 0.004, "{band:?}");
        assert!((band.level - 0.05).abs() < 0.01 && (band.correction - 0.3).abs() < 0.05, "{band:?}");
        assert!((band.quantile - 1.645).abs() < 0.03, "{band:?}");
        for (loudest, seed) in [(40.0, 3), (0.05, 4)] {
            let new = columns(30_000, loudest, seed);
            let scales = new.level.iter().zip(&new.correction).map(|(l, c)| band.scale(*l, *c));
            let held =
                new.residual.iter().zip(scales).filter(|(r, s)| r.abs() <= band.half_width(*s)).count();
            let share = held as f64 / 30_000.0;
            assert!((0.87..0.93).contains(&share), "{share} at {loudest}");
        }
    }

    #[test]
    fn residuals_of_one_scale_and_of_none_have_a_band() {
        let part = |size: f64| Columns {
            level: vec![1.0; 5000],
            correction: vec![0.0; 5000],
            residual: columns(5000, 0.0, 5).residual.iter().map(|r| size * r).collect(),
        };
        let band = OutputBand::of(0.0, &[part(1.0)], 256);
        let half = band.half_width(band.scale(1.0, 0.0));
        assert!((half / (1.645 * 0.02) - 1.0).abs() < 0.05, "{band:?}");
        let none = OutputBand::of(0.0, &[part(0.0)], 256);
        assert_eq!(none.half_width(none.scale(1.0, 0.0)), 0.0);
        let empty = OutputBand::of(0.0, &[], 256);
        assert_eq!(empty.quantile, 0.0);
    }

    #[test]
    fn residuals_that_grow_faster_than_the_level_are_held_at_quiet_and_at_loud_times() {
        // Residuals in proportion to the square of the response's level.
        let steep = |loudest: f64, seed: u64| {
            let mut part = columns(60_000, loudest, seed);
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            for (residual, level) in part.residual.iter_mut().zip(&part.level) {
                let white: f64 = StandardNormal.sample(&mut rng);
                *residual = 0.05 * level * white;
            }
            part.correction.fill(0.0);
            part
        };
        let band = OutputBand::of(0.0, &[steep(9.0, 1), steep(9.0, 2)], 256);
        // The last is louder than all of the calibration.
        for (loudest, seed) in [(1.0, 3), (3.0, 4), (9.0, 5), (36.0, 6)] {
            let new = steep(loudest, seed);
            let inside = |(r, l): (&f64, &f64)| r.abs() <= band.half_width(band.scale(*l, 0.0));
            let held = new.residual.iter().zip(&new.level).filter(|one| inside(*one)).count();
            let share = held as f64 / 60_000.0;
            assert!((0.85..0.95).contains(&share), "{share} at {loudest}: {band:?}");
        }
    }

    #[test]
    fn a_band_that_cannot_be_one_is_refused() {
        let output = OutputBand {
            mean: 0.0,
            floor: 0.1,
            level: 0.0,
            correction: 0.0,
            quantile: 1.6,
            by_scale: vec![[0.1, 1.6], [0.2, 2.0]],
            of_cycles: 1.0,
        };
        let band = Band { window: 256, outputs: vec![output.clone()] };
        band.check(1).unwrap();
        let refused = |band: Band, outputs| band.check(outputs).unwrap_err().to_string();
        assert!(refused(band.clone(), 2).contains("1 entries for 2 outputs"));
        assert!(refused(Band { window: 0, ..band.clone() }, 1).contains("window 0"));
        let negative = OutputBand { floor: -0.1, ..output.clone() };
        let falling = OutputBand { by_scale: vec![[0.2, 1.6], [0.1, 2.0]], ..output };
        for wrong in [negative, falling] {
            assert!(refused(Band { outputs: vec![wrong], ..band.clone() }, 1).contains("outputs[0]"));
        }
    }
}
