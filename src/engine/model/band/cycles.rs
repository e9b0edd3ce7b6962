//! How much wider a band must be for the damage that follows from it: errors at the turning points of large cycles are not
//! those of all samples.

use crate::fatigue::{Rainflow, Residue, turning_points};

/// The weight of a cycle is this power of its range, as its damage for the source paper's slope.
const SLOPE: i32 = 5;

/// Stretches, in windows, whose cycles weigh as much as those of any other stretch.
pub(super) const WINDOWS: usize = 40;

/// One output over one stretch of the calibration.
pub(super) struct Stretch<'a> {
    pub measured: &'a [f64],
    pub residual: &'a [f64],
    pub half_width: &'a [f64],
}

/// Of each cycle the error of its range over that of the band at both its ends, and its weight.
pub(super) type Cycles = Vec<[f64; 2]>;

/// The factor on the half widths at which the error of a cycle's range is at most that of the band at both its ends, for a
/// share of the damage; at least 1.
pub(super) fn factor<'a>(cycles: impl Iterator<Item = &'a Cycles>, share: f64) -> f64 {
    let mut found: Vec<[f64; 2]> = cycles.flatten().copied().collect();
    found.sort_by(|a, b| a[0].total_cmp(&b[0]));
    let wanted = share * found.iter().map(|[_, weight]| weight).sum::<f64>();
    let mut sum = 0.0;
    let place = found.iter().find(|[_, weight]| {
        sum += weight;
        sum >= wanted
    });
    place.map_or(1.0, |[ratio, _]| ratio.max(1.0))
}

/// The cycles of an output over stretches; of a section shorter than one they weigh in proportion to its length.
pub(super) fn of_stretches(stretch: &Stretch<'_>, window: usize) -> Cycles {
    let n = stretch.measured.len();
    let len = (WINDOWS * window).min(n).max(1);
    let starts = (0..(n + 1).saturating_sub(len)).step_by(len);
    let weight = len as f64 / (WINDOWS * window) as f64;
    let of = |start| {
        let at = start..start + len;
        let stretch = Stretch {
            measured: &stretch.measured[at.clone()],
            residual: &stretch.residual[at.clone()],
            half_width: &stretch.half_width[at],
        };
        of_stretch(&stretch, weight)
    };
    starts.flat_map(of).collect()
}

fn of_stretch(stretch: &Stretch<'_>, together: f64) -> Cycles {
    let cycles = Rainflow::of_points(&turning_points(stretch.measured)).all_cycles(Residue::Repeated);
    let largest = cycles.iter().map(|cycle| cycle.range()).fold(0.0, f64::max);
    let of = |cycle: &crate::fatigue::Cycle| {
        let [from, to] = [cycle.from.index, cycle.to.index];
        let allowed = stretch.half_width[from] + stretch.half_width[to];
        let error = (stretch.residual[from] - stretch.residual[to]).abs();
        (allowed > 0.0 && largest > 0.0)
            .then(|| [error / allowed, cycle.count * (cycle.range() / largest).powi(SLOPE)])
    };
    let found: Vec<[f64; 2]> = cycles.iter().filter_map(of).collect();
    let sum: f64 = found.iter().map(|[_, weight]| weight).sum();
    found.into_iter().map(|[ratio, weight]| [ratio, together * weight / sum]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Cycles of amplitude 1 every 20 samples, on cycles of amplitude 5 every 400.
    fn measured(n: usize) -> Vec<f64> {
        let tone = |t: usize, period: f64| (std::f64::consts::TAU * t as f64 / period).sin();
        (0..n).map(|t| tone(t, 20.0) + 5.0 * tone(t, 400.0)).collect()
    }

    #[test]
    fn errors_that_grow_with_the_value_make_it_wider_and_those_at_rest_do_not() {
        let n = 8000;
        let measured = measured(n);
        let half_width = vec![0.1; n];
        let of = |residual: Vec<f64>| {
            let stretch = Stretch { measured: &measured, residual: &residual, half_width: &half_width };
            factor([of_stretches(&stretch, 100)].iter(), 0.9)
        };
        // A tenth of the value: ranges of about 12 are wrong by 1.2, where the band allows 0.2.
        let found = of(measured.iter().map(|y| 0.1 * y).collect());
        assert!((found - 5.9).abs() < 0.3, "{found}");
        // Wrong in between, right at the peaks.
        let between = measured.iter().map(|y| if y.abs() < 3.0 { 0.5 } else { 0.0 }).collect();
        assert_eq!(of(between), 1.0);
        // An offset changes no range.
        assert_eq!(of(vec![0.3; n]), 1.0);
    }

    #[test]
    fn a_short_section_weighs_less_than_a_stretch() {
        let measured = measured(8000);
        let half_width = vec![0.1; 8000];
        let tenth: Vec<f64> = measured.iter().map(|y| 0.1 * y).collect();
        let right = vec![0.0; 8000];
        let of = |residual: &[f64], n: usize| {
            let stretch =
                Stretch { measured: &measured[..n], residual: &residual[..n], half_width: &half_width[..n] };
            of_stretches(&stretch, 100)
        };
        // An eighth of a stretch is wrong, two whole ones are right.
        assert_eq!(factor([of(&tenth, 500), of(&right, 8000)].iter(), 0.9), 1.0);
        assert!(factor([of(&tenth, 8000), of(&right, 8000)].iter(), 0.9) > 5.0);
    }

    #[test]
    fn short_still_and_absent_stretches_have_a_factor() {
        for n in [0, 1, 3, 5000] {
            let still = vec![0.0; n];
            let stretch = Stretch { measured: &still, residual: &still, half_width: &still };
            assert_eq!(factor([of_stretches(&stretch, 100)].iter(), 0.9), 1.0, "{n}");
        }
        assert_eq!(factor(std::iter::empty(), 0.9), 1.0);
    }
}
