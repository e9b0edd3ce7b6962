//! Means of what the sim leaves, part by part of each run: the screen takes them off, and what drifts with them.

use super::problem::{Problem, Stretch};
use crate::diagnosis::numerics::linear::{mean, rms};

/// Parts of a stretch.
const PARTS: usize = 8;
/// How many times their scatter about it a line in time explains of the means at least, where an offset drifts.
const CLEAR: f64 = 10.0;

/// Whether an offset of the response drifts: the means of what the sim leaves follow a line in time, by more than
/// `material_gap` of the response's RMS about its mean.
pub fn drift(problem: &Problem, material_gap: f64) -> bool {
    let stretches = || problem.fit.iter().chain(&problem.select).chain(&problem.test);
    let points: Vec<Point> = stretches().flat_map(|s| points(s, problem.response)).collect();
    let measured: Vec<f64> = stretches().flat_map(|s| s.scored(s.measured.to_vec())).collect();
    let least = material_gap * rms(&measured);
    line(&points).is_some_and(|[by_line, scatter]| by_line > least * least && by_line > CLEAR * scatter)
}

/// A mean over a part of a stretch.
struct Point {
    /// Of the programme, from 0 to 1.
    time: f64,
    mean: f64,
    /// Samples.
    weight: f64,
}

fn points(stretch: &Stretch, response: usize) -> Vec<Point> {
    let gap = stretch.gap(response);
    let scored = &gap[stretch.lead..];
    let length = (scored.len() / PARTS).max(1);
    let of_part = |(k, part): (usize, &[f64])| Point {
        time: stretch.clock.start + stretch.clock.step * (stretch.lead + k * length + length / 2) as f64,
        mean: mean(part),
        weight: part.len() as f64,
    };
    scored.chunks_exact(length).enumerate().map(of_part).collect()
}

/// Variance of the means that a line in time explains, and what it leaves; `None` where no time passes.
fn line(points: &[Point]) -> Option<[f64; 2]> {
    let weight: f64 = points.iter().map(|p| p.weight).sum();
    let average = |of: &dyn Fn(&Point) -> f64| points.iter().map(|p| p.weight * of(p)).sum::<f64>() / weight;
    let (time, level) = (average(&|p| p.time), average(&|p| p.mean));
    let spread = average(&|p| (p.time - time).powi(2));
    let along = average(&|p| (p.time - time) * (p.mean - level));
    let all = average(&|p| (p.mean - level).powi(2));
    (spread > 0.0).then(|| {
        let explained = along * along / spread;
        [explained, (all - explained).max(0.0)]
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_explains_what_follows_time_and_leaves_the_scatter() {
        let point = |(k, mean): (usize, f64)| Point { time: k as f64, mean, weight: 2.0 };
        let of = |means: &[f64]| line(&means.iter().copied().enumerate().map(point).collect::<Vec<_>>());
        let close = |found: Option<[f64; 2]>, expected: [f64; 2]| {
            let found = found.unwrap();
            assert!(found.iter().zip(expected).all(|(f, e)| (f - e).abs() < 1e-12), "{found:?}");
        };
        close(of(&[1.0, 3.0, 5.0, 7.0]), [5.0, 0.0]);
        close(of(&[1.0, -1.0, -1.0, 1.0]), [0.0, 1.0]);
        assert_eq!(of(&[4.0]), None);
    }
}
