//! The band of one output.

use serde::{Deserialize, Serialize};

use super::COVERAGE;
use super::cycles::{self, Cycles, Stretch};
use super::frequencies::{self, BANDS};
use super::moving::moving_mean_square;
use super::scale::{self, Row};

/// A window gives so many rows to the fit of the scale.
const ROWS_PER_WINDOW: usize = 2;

/// Most classes of scales with a quantile of their own, each of at least so many windows.
const CLASSES: usize = 8;
const WINDOWS_PER_CLASS: usize = 20;

/// Classes that a growth above the loudest of them is told by at least.
const LEAST_FOR_GROWTH: usize = 3;

/// The scale of one output's residuals, and how wide the band is for it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct OutputBand {
    /// Mean of the response in the data of the fit, channel unit.
    mean: f64,
    /// Scale at rest, channel unit.
    floor: f64,
    /// Share of the response's level.
    level: f64,
    /// Share of the network's correction.
    correction: f64,
    /// Further shares of the level and of the correction in each frequency band, from high to low. Empty: none, as in files
    /// of earlier versions.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    by_frequency: Vec<[f64; 2]>,
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

/// One output over a section, as a model predicts it and as it was measured.
pub(super) struct Known<'a> {
    /// Of the section and of the context before it.
    pub response: &'a [f64],
    /// The same of the FRF or core that a network corrects.
    pub linear: Option<&'a [f64]>,
    /// Of the section.
    pub measured: &'a [f64],
}

/// Rows of each frequency band: 1, level and correction there, level and correction of all frequencies; and the mean square
/// of the residual there.
pub(super) type Rows = [Vec<Row<5>>; BANDS];

impl Known<'_> {
    fn skip(&self) -> usize {
        self.response.len() - self.measured.len()
    }

    /// Measured minus predicted.
    fn residual(&self) -> Vec<f64> {
        self.measured.iter().zip(&self.response[self.skip()..]).map(|(m, y)| m - y).collect()
    }

    /// What the scale is fitted to.
    pub fn rows(&self, mean: f64, window: usize) -> Rows {
        let step = (window / ROWS_PER_WINDOW).max(1);
        let (skip, n) = (self.skip(), self.measured.len());
        let at = |squares: &[f64], offset: usize| -> Vec<f64> {
            (0..n).step_by(step).map(|t| squares[offset + t]).collect()
        };
        let level = at(&moving_mean_square(about(self.response, mean), window), skip);
        let mut rows: Rows =
            std::array::from_fn(|_| level.iter().map(|l| ([1.0, 0.0, 0.0, *l, 0.0], 0.0)).collect());
        let mut add = |band: usize, column: usize, values: &[f64]| {
            rows[band].iter_mut().zip(values).for_each(|((x, _), value)| x[column] = *value);
        };
        frequencies::mean_squares(about(self.response, mean), window, |band, squares| {
            add(band, 1, &at(&squares, skip));
        });
        if let Some(linear) = self.linear {
            let all = at(&moving_mean_square(change(self.response, linear), window), skip);
            frequencies::mean_squares(change(self.response, linear), window, |band, squares| {
                add(band, 2, &at(&squares, skip));
                add(band, 4, &all);
            });
        }
        frequencies::mean_squares(self.residual().into_iter(), window, |band, squares| {
            rows[band].iter_mut().zip(at(&squares, 0)).for_each(|((_, square), value)| *square = value);
        });
        rows
    }
}

fn about(response: &[f64], mean: f64) -> impl Iterator<Item = f64> {
    response.iter().map(move |y| y - mean)
}

fn change(response: &[f64], linear: &[f64]) -> impl Iterator<Item = f64> {
    response.iter().zip(linear).map(|(y, l)| y - l)
}

impl OutputBand {
    /// Of an output whose response has this mean: `training` are rows of the data that made the model, `known` the data that
    /// compare it.
    pub fn of<'a>(
        mean: f64,
        training: impl Iterator<Item = &'a Rows>,
        known: &[Known<'_>],
        window: usize,
    ) -> Self {
        let compared: Vec<Rows> = known.iter().map(|part| part.rows(mean, window)).collect();
        let all: Vec<&Rows> = training.map(|rows| rows as &Rows).chain(&compared).collect();
        let band = Self::scaled(mean, &all);
        let parts: Vec<(Vec<f64>, Vec<f64>)> = known
            .iter()
            .map(|part| {
                let scales = band.scales(part.response, part.linear, window);
                (scales[part.skip()..].to_vec(), part.residual())
            })
            .collect();
        band.with_classes(&parts, window)
    }

    /// With the factor for the damage that holds in the data that compare, and in these and the training together.
    pub fn with_cycles<'a>(self, training: impl Iterator<Item = &'a Cycles>, compared: &'a [Cycles]) -> Self {
        let of_all = cycles::factor(training.chain(compared), COVERAGE);
        Self { of_cycles: of_all.max(cycles::factor(compared.iter(), COVERAGE)), ..self }
    }

    /// The cycles of a section with their errors over those of the band.
    pub fn cycles(&self, known: &Known<'_>, window: usize) -> Cycles {
        let half_width = self.half_widths(known.response, known.linear, window);
        let (residual, half_width) = (known.residual(), &half_width[known.skip()..]);
        cycles::of_stretches(&Stretch { measured: known.measured, residual: &residual, half_width }, window)
    }

    /// With the scale that fits the rows.
    fn scaled(mean: f64, all: &[&Rows]) -> Self {
        let fitted: [[f64; 5]; BANDS] = std::array::from_fn(|band| {
            let rows: Vec<Row<5>> = all.iter().flat_map(|rows| rows[band].iter().copied()).collect();
            scale::fit(&rows)
        });
        let sum = |column: usize| fitted.iter().map(|found| found[column]).sum::<f64>().sqrt();
        Self {
            mean,
            floor: sum(0),
            level: sum(3),
            correction: sum(4),
            by_frequency: fitted.iter().map(|found| [found[1].sqrt(), found[2].sqrt()]).collect(),
            quantile: 1.0,
            by_scale: Vec::new(),
            of_cycles: 1.0,
        }
    }

    /// With the quantiles of residual over scale, of pairs of both.
    fn with_classes(self, parts: &[(Vec<f64>, Vec<f64>)], window: usize) -> Self {
        // Scale, residual over scale.
        let mut found: Vec<[f64; 2]> = parts
            .iter()
            .flat_map(|(scales, residual)| {
                let ratio = |(s, r): (&f64, &f64)| [*s, if *s > 0.0 { r.abs() / s } else { 0.0 }];
                scales.iter().zip(residual).map(ratio)
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
        Self { quantile: quantile(&found), by_scale, ..self }
    }

    /// Half width about each sample of a response.
    pub fn half_widths(&self, response: &[f64], linear: Option<&[f64]>, window: usize) -> Vec<f64> {
        let mut scales = self.scales(response, linear, window);
        scales.iter_mut().for_each(|scale| *scale = self.half_width(*scale));
        scales
    }

    /// Factor on the half width for the damage that follows.
    pub fn of_cycles(&self) -> f64 {
        self.of_cycles
    }

    /// Whether its numbers can be those of a band.
    pub fn is_one(&self) -> bool {
        let known = |v: &f64| (0.0..=1e15).contains(v);
        let scale = [self.floor, self.level, self.correction, self.quantile, self.of_cycles];
        let rising = self.by_scale.windows(2).all(|pair| pair[0][0] < pair[1][0]);
        let above_zero =
            self.by_scale.iter().all(|[scale, ratio]| *scale > 0.0 && known(scale) && known(ratio));
        scale.iter().chain(self.by_frequency.as_flattened()).all(known)
            && known(&self.mean.abs())
            && [0, BANDS].contains(&self.by_frequency.len())
            && self.by_scale.len() <= CLASSES
            && rising
            && above_zero
    }

    /// The scale of the residual about each sample of a response.
    fn scales(&self, response: &[f64], linear: Option<&[f64]>, window: usize) -> Vec<f64> {
        let mut squares = vec![self.floor.powi(2); response.len()];
        let mut add = |share: f64, of: &[f64]| {
            squares.iter_mut().zip(of).for_each(|(square, of)| *square += share.powi(2) * of);
        };
        let by_frequency = !self.by_frequency.is_empty();
        add(self.level, &moving_mean_square(about(response, self.mean), window));
        if by_frequency {
            frequencies::mean_squares(about(response, self.mean), window, |band, of| {
                add(self.by_frequency[band][0], &of);
            });
        }
        if let Some(linear) = linear {
            add(self.correction, &moving_mean_square(change(response, linear), window));
            if by_frequency {
                frequencies::mean_squares(change(response, linear), window, |band, of| {
                    add(self.by_frequency[band][1], &of);
                });
            }
        }
        squares.iter_mut().for_each(|square| *square = square.sqrt());
        squares
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
}

/// The quantile of the ratios `[scale, ratio]` that so many more hold with the rate of the band.
fn quantile(found: &[[f64; 2]]) -> f64 {
    let mut ratios: Vec<f64> = found.iter().map(|[_, ratio]| *ratio).collect();
    ratios.sort_by(f64::total_cmp);
    let place = ((ratios.len() + 1) as f64 * COVERAGE).ceil() as usize;
    ratios.get(place.clamp(1, ratios.len().max(1)) - 1).copied().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;

    const WINDOW: usize = 256;

    struct Made {
        response: Vec<f64>,
        linear: Vec<f64>,
        measured: Vec<f64>,
    }

    impl Made {
        /// White responses, changes and residuals with the amplitudes `[response, change, residual]` of each time from 0 to 1.
        fn of(n: usize, seed: u64, amplitudes: impl Fn(f64) -> [f64; 3]) -> Self {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let mut white = || -> f64 { StandardNormal.sample(&mut rng) };
            let mut made = Self { response: Vec::new(), linear: Vec::new(), measured: Vec::new() };
            for t in 0..n {
                let [response, change, residual] = amplitudes(t as f64 / n as f64);
                let y = response * white();
                made.response.push(y);
                made.linear.push(y - change * white());
                made.measured.push(y + residual * white());
            }
            made
        }

        /// Residuals of 0.02 at rest, 5 % of the level and 30 % of the change, at levels that rise up to `loudest`.
        fn hybrid(n: usize, loudest: f64, seed: u64) -> Self {
            Self::of(n, seed, |t| {
                let response = loudest * t.sqrt();
                let change = 0.5 * response * (60.0 * t).sin().abs();
                [response, change, (0.0004 + (0.05 * response).powi(2) + (0.3 * change).powi(2)).sqrt()]
            })
        }

        fn known(&self) -> Known<'_> {
            Known { response: &self.response, linear: Some(&self.linear), measured: &self.measured }
        }
    }

    fn band(known: &[Known<'_>]) -> OutputBand {
        OutputBand::of(0.0, std::iter::empty(), known, WINDOW)
    }

    fn held(band: &OutputBand, known: &Known<'_>) -> f64 {
        let half_widths = band.half_widths(known.response, known.linear, WINDOW);
        let inside = known.residual().iter().zip(&half_widths).filter(|(r, h)| r.abs() <= **h).count();
        inside as f64 / known.measured.len() as f64
    }

    #[test]
    fn the_scale_of_the_residuals_is_found_and_holds_at_another_level() {
        let made = [Made::hybrid(60_000, 2.0, 1), Made::hybrid(60_000, 0.7, 2)];
        let band = band(&made.each_ref().map(Made::known));
        assert!((band.floor - 0.02).abs() < 0.006, "{band:?}");
        assert!((band.quantile - 1.645).abs() < 0.12, "{band:?}");
        for (loudest, seed) in [(6.0, 3), (0.2, 4)] {
            let new = Made::hybrid(30_000, loudest, seed);
            let share = held(&band, &new.known());
            assert!((0.87..0.93).contains(&share), "{share} at {loudest}");
        }
    }

    #[test]
    fn rows_of_the_training_tell_the_scale_of_levels_that_nothing_compared() {
        let (loud, quiet) = (Made::hybrid(60_000, 6.0, 1), Made::hybrid(60_000, 0.2, 2));
        let compared = Made::of(30_000, 3, |_| [1.0, 0.2, (0.0004_f64 + 0.0025 + 0.0036).sqrt()]);
        let rows = [loud.known().rows(0.0, WINDOW), quiet.known().rows(0.0, WINDOW)];
        let band = OutputBand::of(0.0, rows.iter(), &[compared.known()], WINDOW);
        for (loudest, seed) in [(6.0, 4), (0.2, 5)] {
            let share = held(&band, &Made::hybrid(30_000, loudest, seed).known());
            assert!((0.85..0.95).contains(&share), "{share} at {loudest}: {band:?}");
        }
    }

    #[test]
    fn a_load_of_other_frequencies_has_the_band_of_those() {
        // A third of what is fast is wrong, a hundredth of what is slow.
        let made = |n: usize, slow: f64, fast: f64, seed: u64| {
            let tone = |t: usize, period: f64| (std::f64::consts::TAU * t as f64 / period).sin();
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let response: Vec<f64> =
                (0..n).map(|t| slow * tone(t, 150.0) + fast * tone(t, 10.0) * tone(t, 977.0)).collect();
            let mut white = || -> f64 { StandardNormal.sample(&mut rng) };
            let wrong = |(t, y): (usize, &f64)| {
                y + 0.005 * white() + fast * tone(t, 10.3) / 3.0 + slow * tone(t, 161.0) / 100.0
            };
            let measured = response.iter().enumerate().map(wrong).collect();
            Made { linear: response.clone(), response, measured }
        };
        let known = |made: &Made| made.known().residual().iter().map(|r| r * r).sum::<f64>();
        let all: Vec<Made> = [(1.0, 1.0), (3.0, 1.0), (1.0, 0.2), (0.5, 0.0), (2.0, 0.5)]
            .into_iter()
            .enumerate()
            .map(|(i, (slow, fast))| made(30_000, slow, fast, i as u64))
            .collect();
        let band = band(&all.iter().map(Made::known).collect::<Vec<_>>());
        let slow = made(30_000, 4.0, 0.0, 9);
        let rms = (known(&slow) / 30_000.0).sqrt();
        let half_widths = band.half_widths(&slow.response, Some(&slow.linear), WINDOW);
        let mean = half_widths.iter().sum::<f64>() / half_widths.len() as f64;
        assert!((1.0..3.0).contains(&(mean / rms)), "{mean} for residuals of {rms}: {band:?}");
    }

    #[test]
    fn a_network_that_hardly_changes_its_frf_tells_nothing_by_what_it_changes() {
        let made = |change: f64, seed: u64| Made::of(20_000, seed, |t| [1.0 + t, change * t, 0.05]);
        let band = band(&[made(1e-9, 1).known()]);
        let share = held(&band, &made(1e-4, 2).known());
        let half_width = band.half_widths(&[1.0; 600], Some(&[0.9; 600]), WINDOW)[300];
        assert!((0.87..0.93).contains(&share) && half_width < 0.5, "{share}, {half_width}: {band:?}");
        assert!(band.is_one());
    }

    #[test]
    fn residuals_of_one_scale_and_of_none_have_a_band() {
        let part = |size: f64| Made::of(5000, 5, |_| [1.0, 0.0, 0.02 * size]);
        let one = part(1.0);
        let found = band(&[one.known()]);
        let half = found.half_widths(&one.response, Some(&one.linear), WINDOW)[2500];
        assert!((half / (1.645 * 0.02) - 1.0).abs() < 0.1, "{found:?}");
        let none = part(0.0);
        let found = band(&[none.known()]);
        assert_eq!(found.half_widths(&none.response, Some(&none.linear), WINDOW)[2500], 0.0);
        assert_eq!(band(&[]).quantile, 0.0);
    }

    #[test]
    fn residuals_that_grow_faster_than_the_level_are_held_at_quiet_and_at_loud_times() {
        // Residuals in proportion to the square of the response's level.
        let steep = |loudest: f64, seed: u64| {
            Made::of(60_000, seed, |t| [loudest * t.sqrt(), 0.0, 0.05 * loudest.powi(2) * t])
        };
        let made = [steep(3.0, 1), steep(3.0, 2)];
        let band = band(&made.each_ref().map(Made::known));
        // The last is louder than all of the calibration.
        for (loudest, seed) in [(1.0, 3), (1.7, 4), (3.0, 5), (6.0, 6)] {
            let share = held(&band, &steep(loudest, seed).known());
            assert!((0.85..0.95).contains(&share), "{share} at {loudest}: {band:?}");
        }
    }

    #[test]
    fn a_band_of_an_earlier_version_has_one_level_for_all_frequencies() {
        let text = r#"{"mean": 1, "floor": 0.3, "level": 0.4, "correction": 0, "quantile": 2}"#;
        let band: OutputBand = serde_json::from_str(text).unwrap();
        assert!(band.is_one());
        let response = vec![2.0; 600];
        let half_width = band.half_widths(&response, None, WINDOW)[300];
        assert!((half_width - 2.0 * 0.5).abs() < 1e-12, "{half_width}");
    }

    #[test]
    fn a_band_that_cannot_be_one_is_told() {
        let good = OutputBand {
            mean: 0.0,
            floor: 0.1,
            level: 0.0,
            correction: 0.0,
            by_frequency: vec![[0.1, 0.2]; BANDS],
            quantile: 1.6,
            by_scale: vec![[0.1, 1.6], [0.2, 2.0]],
            of_cycles: 1.0,
        };
        assert!(good.is_one());
        let falling = vec![[0.2, 1.6], [0.1, 2.0]];
        for wrong in [
            OutputBand { floor: -0.1, ..good.clone() },
            OutputBand { mean: f64::NAN, ..good.clone() },
            OutputBand { by_frequency: vec![[0.1, 0.2]], ..good.clone() },
            OutputBand { by_frequency: vec![[0.1, -0.2]; BANDS], ..good.clone() },
            OutputBand { by_scale: falling, ..good },
        ] {
            assert!(!wrong.is_one(), "{wrong:?}");
        }
    }
}
