//! Learning curves: error against minutes of data, a power law with an offset, and what more data would bring.
//!
//! The error of a model that is fitted to `m` minutes is taken as `e(m) = c + a m^-b` (Hestness et al., 2017), with
//! relative scatter from one subset and start to the next. In logarithms, with `m0` the largest size and
//! `u = c / e(m0)` the share of the error there that no data would remove,
//!
//! `ln e(m) = ln e(m0) + ln(u + (1 - u) (m / m0)^-b) + scatter`.
//!
//! The posterior of `b` and `u` is computed on a grid: `b` is even in 0.05..2, `u` is the square of what is even in 0..1
//! (a curve without an offset is no rare one), the level flat, the
//! scatter's standard deviation with the prior 1 / sigma, so that level and scatter are integrated in closed form and
//! the level has Student's distribution. Repeats of a size are subsets of one pool. Two of them share the part `f` that
//! the size is of the pool, and so does their scatter: `R` repeats count as `R / (1 + (R - 1) f)`.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StudentT};

/// Cells of the grid along each of its two axes.
const GRID: usize = 60;

/// Range of the exponent. Errors of parameters fall with 0.5; nothing that is learnt falls faster than 2.
const EXPONENTS: [f64; 2] = [0.05, 2.0];

/// Scatter below which curves are not told apart: a thousandth of the error.
const LEAST_SCATTER: f64 = 1e-3;

/// Draws from the posterior: the 5 % quantile is then known to a tenth of the interval's width.
const DRAWS: usize = 4000;

/// Errors of the fits to one size.
#[derive(Debug, Clone, PartialEq)]
pub struct CurvePoint {
    /// Minutes of data.
    pub minutes: f64,
    /// Share of the pool that they are, 0 < share <= 1.
    pub share: f64,
    /// Error of each repeat, above zero.
    pub errors: Vec<f64>,
}

/// A fitted curve: draws from its posterior.
#[derive(Debug, Clone)]
pub struct Curve {
    largest_min: f64,
    /// ln e(m0), u, b of each draw.
    draws: Vec<[f64; 3]>,
}

/// An error with the 90 % interval about it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    /// Median.
    pub median: f64,
    /// 5 % quantile.
    pub low: f64,
    /// 95 % quantile.
    pub high: f64,
}

impl Curve {
    /// Fits a curve; `None` for fewer than three sizes with an error, or without any scatter to judge by.
    pub fn fit(points: &[CurvePoint]) -> Option<Self> {
        let sizes: Vec<Size> = points.iter().filter_map(Size::of).collect();
        let largest_min = sizes.iter().map(|size| size.minutes).fold(0.0, f64::max);
        let within: f64 = sizes.iter().map(|size| size.within).sum();
        let freedom = sizes.len() as f64 - 1.0 + sizes.iter().map(|size| size.freedom).sum::<f64>();
        if sizes.len() < 3 {
            return None;
        }
        let weights: f64 = sizes.iter().map(|size| size.weight).sum();
        let floor = weights * LEAST_SCATTER * LEAST_SCATTER;
        let nodes: Vec<Node> = (0..GRID * GRID)
            .map(|cell| {
                let even = |index: usize| (index as f64 + 0.5) / GRID as f64;
                let b = EXPONENTS[0] + (EXPONENTS[1] - EXPONENTS[0]) * even(cell / GRID);
                let u = even(cell % GRID).powi(2);
                let rest = |size: &Size| size.log_error - shape(u, b, size.minutes / largest_min);
                let level = sizes.iter().map(|size| size.weight * rest(size)).sum::<f64>() / weights;
                let between: f64 = sizes.iter().map(|size| size.weight * (rest(size) - level).powi(2)).sum();
                let squares = between + within + floor;
                Node { b, u, level, squares, log_weight: -0.5 * freedom * squares.ln() }
            })
            .collect();
        Some(Self { largest_min, draws: draw(&nodes, freedom, weights) })
    }

    /// Error at so many minutes, and its 90 % interval: of the curve, not of a single fit.
    pub fn at(&self, minutes: f64) -> Estimate {
        let share = minutes / self.largest_min;
        let mut errors: Vec<f64> =
            self.draws.iter().map(|[level, u, b]| (level + shape(*u, *b, share)).exp()).collect();
        errors.sort_by(f64::total_cmp);
        let quantile = |q: f64| errors[((q * errors.len() as f64) as usize).min(errors.len() - 1)];
        Estimate { median: quantile(0.5), low: quantile(0.05), high: quantile(0.95) }
    }

    /// Median of the error that no amount of data would go below, and of the exponent.
    pub fn offset_and_exponent(&self) -> [f64; 2] {
        let median = |of: fn(&[f64; 3]) -> f64| {
            let mut values: Vec<f64> = self.draws.iter().map(of).collect();
            values.sort_by(f64::total_cmp);
            values[values.len() / 2]
        };
        [median(|[level, u, _]| u * level.exp()), median(|[_, _, b]| *b)]
    }
}

/// `ln(u + (1 - u) share^-b)`.
fn shape(u: f64, b: f64, share: f64) -> f64 {
    (u + (1.0 - u) * share.powf(-b)).ln()
}

/// The repeats of one size in a few numbers.
struct Size {
    minutes: f64,
    log_error: f64,
    /// As how many independent repeats they count.
    weight: f64,
    /// Their sum of squares about their mean, made up for what they share.
    within: f64,
    freedom: f64,
}

impl Size {
    fn of(point: &CurvePoint) -> Option<Self> {
        let logs: Vec<f64> =
            point.errors.iter().filter(|e| e.is_finite() && **e > 0.0).map(|e| e.ln()).collect();
        if logs.is_empty() {
            return None;
        }
        let n = logs.len() as f64;
        let log_error = logs.iter().sum::<f64>() / n;
        let squares: f64 = logs.iter().map(|log| (log - log_error).powi(2)).sum();
        // Repeats of the whole pool differ by their start only; they say nothing of the scatter between data.
        let apart = 1.0 - point.share;
        let counts = apart > 0.01;
        Some(Self {
            minutes: point.minutes,
            log_error,
            weight: n / (1.0 + (n - 1.0) * point.share),
            within: if counts { squares / apart } else { 0.0 },
            freedom: if counts { n - 1.0 } else { 0.0 },
        })
    }
}

struct Node {
    b: f64,
    u: f64,
    level: f64,
    squares: f64,
    log_weight: f64,
}

/// Draws nodes by their weights, and a level for each.
fn draw(nodes: &[Node], freedom: f64, weights: f64) -> Vec<[f64; 3]> {
    let most = nodes.iter().map(|node| node.log_weight).fold(f64::NEG_INFINITY, f64::max);
    let mut sum = 0.0;
    let up_to: Vec<f64> = nodes
        .iter()
        .map(|node| {
            sum += (node.log_weight - most).exp();
            sum
        })
        .collect();
    let student = StudentT::new(freedom).expect("at least two degrees of freedom");
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    (0..DRAWS)
        .map(|i| {
            // Evenly through the weights: only the place within each step is drawn.
            let at = (i as f64 + rng.random::<f64>()) / DRAWS as f64 * sum;
            let node = &nodes[up_to.partition_point(|weight| *weight < at).min(nodes.len() - 1)];
            let deviation = (node.squares / freedom / weights).sqrt();
            [node.level + deviation * student.sample(&mut rng), node.u, node.b]
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use rand_distr::StandardNormal;

    use super::*;

    /// Shares of the pool, as a study uses them.
    const SHARES: [f64; 5] = [0.125, 0.21, 0.35, 0.59, 1.0];

    /// Points of a curve with `e(20 min) = 0.03`, and its true error.
    fn synthetic(u: f64, b: f64, scatter: f64, rng: &mut ChaCha8Rng) -> Vec<CurvePoint> {
        let mut normal = || -> f64 { StandardNormal.sample(rng) };
        SHARES
            .iter()
            .map(|&share| {
                let common = normal();
                let mut repeat = || {
                    let noise = share.sqrt() * common + (1.0 - share).sqrt() * normal();
                    truth(u, b, 20.0 * share) * (scatter * noise).exp()
                };
                CurvePoint { minutes: 20.0 * share, share, errors: (0..3).map(|_| repeat()).collect() }
            })
            .collect()
    }

    fn truth(u: f64, b: f64, minutes: f64) -> f64 {
        0.03 * shape(u, b, minutes / 20.0).exp()
    }

    /// Share of curves whose true error at 30 minutes is inside the 90 % interval.
    fn coverage(n: usize, seed: u64, mut draw: impl FnMut(&mut ChaCha8Rng) -> [f64; 3]) -> f64 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let inside = (0..n).filter(|_| {
            let [u, b, scatter] = draw(&mut rng);
            let found = Curve::fit(&synthetic(u, b, scatter, &mut rng)).unwrap().at(30.0);
            let wanted = truth(u, b, 30.0);
            (found.low..=found.high).contains(&wanted)
        });
        inside.count() as f64 / n as f64
    }

    #[test]
    fn a_curve_without_scatter_is_found_again_and_continued() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for (u, b) in [(0.0, 0.5), (0.5, 0.8), (0.8, 1.5)] {
            let curve = Curve::fit(&synthetic(u, b, 0.0, &mut rng)).unwrap();
            for minutes in [5.0, 20.0, 30.0, 40.0] {
                let (found, wanted) = (curve.at(minutes), truth(u, b, minutes));
                assert!((found.median / wanted - 1.0).abs() < 0.02, "{u} {b} {minutes}: {found:?}, {wanted}");
                assert!(found.low <= found.median && found.median <= found.high);
            }
            let [offset, exponent] = curve.offset_and_exponent();
            assert!((offset - 0.03 * u).abs() < 0.0025 && (exponent - b).abs() < 0.25, "{offset} {exponent}");
        }
    }

    /// 300 curves: a true 90 % is found as 90 % with a standard error of 1.7 %.
    #[test]
    fn the_interval_holds_the_true_error_of_nine_curves_in_ten() {
        let spread = coverage(300, 2, |rng| {
            [rng.random_range(0.0_f64..1.0), rng.random_range(0.05..2.0), 0.1 * rng.random_range(0.1..1.0)]
        });
        assert!((0.82..=0.96).contains(&spread), "over all curves: {spread}");
        // Single curves, those at the edges of what is thought possible among them; the standard error is 3 %.
        for (u, b, scatter) in [
            (0.0, 0.5, 0.05),
            (0.0, 1.0, 0.05),
            (0.3, 0.5, 0.05),
            (0.7, 1.0, 0.05),
            (0.9, 0.5, 0.02),
            (0.2, 1.0, 0.1),
        ] {
            let found = coverage(150, 3, |_| [u, b, scatter]);
            assert!(found >= 0.78, "u {u}, b {b}, scatter {scatter}: {found}");
        }
    }

    #[test]
    fn a_wider_scatter_and_a_longer_reach_widen_the_interval() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let width = |scatter: f64, minutes: f64, rng: &mut ChaCha8Rng| {
            let of = |rng: &mut ChaCha8Rng| {
                let found = Curve::fit(&synthetic(0.3, 0.5, scatter, rng)).unwrap().at(minutes);
                (found.high / found.low).ln()
            };
            (0..20).map(|_| of(rng)).sum::<f64>() / 20.0
        };
        let near = width(0.02, 30.0, &mut rng);
        assert!(width(0.1, 30.0, &mut rng) > 1.5 * near && width(0.02, 200.0, &mut rng) > 1.5 * near);
    }

    #[test]
    fn too_few_sizes_make_no_curve() {
        let point = |minutes: f64, errors: &[f64]| CurvePoint {
            minutes,
            share: minutes / 20.0,
            errors: errors.to_vec(),
        };
        let two = [point(5.0, &[0.1, 0.12]), point(20.0, &[0.05])];
        assert!(Curve::fit(&two).is_none());
        let three = [two[0].clone(), point(10.0, &[f64::NAN, 0.0]), two[1].clone()];
        assert!(Curve::fit(&three).is_none(), "a size without an error is none");
        let single = [point(5.0, &[0.1]), point(10.0, &[0.08]), point(20.0, &[0.05])];
        assert!(Curve::fit(&single).is_some(), "one fit a size is enough");
    }
}
