//! Traits of the gap that explain a verdict and decide nothing.

use crate::diagnosis::data::problem::Problem;
use crate::diagnosis::effects::kernel::{Clock, along};
use crate::diagnosis::effects::law::Law;
use crate::diagnosis::numerics::linear::{dot, least_squares, rms};
use crate::diagnosis::numerics::smooth::smooth;

/// Share of odd functions in what functions of the response (its square, third and fourth power
/// through free paths) explain of the gap.
pub fn odd_share(problem: &Problem) -> Option<f64> {
    let target = problem.rows(&problem.fit, |s| s.gap(problem.response));
    let explained = |powers: [i32; 2]| {
        let mut columns: Vec<Vec<f64>> = vec![Vec::new(); 2 * problem.core.modes.order()];
        for stretch in &problem.fit {
            let y = smooth(&stretch.measured, problem.band_end);
            let clock = Clock { start: 0.0, step: 0.0 };
            let y = along(&Law::Linear, &[], &y, &[], problem.scales, clock);
            let mut out = columns.iter_mut();
            for power in powers {
                let values: Vec<f64> = y.iter().map(|y| y.powi(power)).collect();
                for answer in problem.core.modes.basis(&values) {
                    if let Some(column) = out.next() {
                        stretch.extend(&answer, column);
                    }
                }
            }
        }
        let slices: Vec<&[f64]> = columns.iter().map(Vec::as_slice).collect();
        let mut left = target.clone();
        for (column, x) in slices.iter().zip(least_squares(&slices, &target)) {
            left.iter_mut().zip(*column).for_each(|(l, c)| *l -= x * c);
        }
        (dot(&target, &target) - dot(&left, &left)).max(0.0)
    };
    let (odd, even) = (explained([1, 3]), explained([2, 4]));
    (odd + even > 0.0).then(|| odd / (odd + even))
}

/// Slope of the logarithm of the gap's RMS against that of the drive's, over groups of stretches
/// whose levels differ by at least a quarter; noise taken off.
pub fn level_exponent(problem: &Problem) -> Option<f64> {
    let mut points: Vec<(f64, f64)> = Vec::new();
    for stretch in &problem.fit {
        let mut rows = Vec::new();
        stretch.extend(&stretch.gap(problem.response), &mut rows);
        let power = dot(&rows, &rows) / rows.len().max(1) as f64 - 1.0;
        let level: f64 = stretch.drives.iter().map(|d| rms(d)).sum();
        if power > 0.3 && level > 0.0 {
            points.push((level.ln(), 0.5 * power.ln()));
        }
    }
    let n = points.len() as f64;
    let mean = |of: &dyn Fn(&(f64, f64)) -> f64| points.iter().map(of).sum::<f64>() / n;
    let (x, y) = (mean(&|p| p.0), mean(&|p| p.1));
    let spread: f64 = points.iter().map(|p| (p.0 - x).powi(2)).sum();
    let product: f64 = points.iter().map(|p| (p.0 - x) * (p.1 - y)).sum();
    (points.len() > 1 && (spread / n).sqrt() > 0.1).then(|| product / spread)
}
