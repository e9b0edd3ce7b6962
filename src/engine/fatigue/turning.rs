//! Turning points of a signal, and two filters that some counting rules apply before rainflow.
//!
//! Conventions for every counting method:
//! - The first and the last sample are turning points; without samples there is none.
//! - A plateau is one point, at its first sample, so a constant signal has one turning point and
//!   doubling every sample changes no value. One sample gives one point, two different samples
//!   give two, `[1, 2, 3]` gives `[1, 3]`.
//! - Neither hysteresis nor classes apply unless asked for: a quantiser before a k-th power changes the
//!   damage, and nothing in the answer would show it.

use serde::{Deserialize, Serialize};

use super::classes::Classes;

/// A local extremum, or an end, of a signal.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct TurningPoint {
    /// Sample index; of a plateau the first.
    pub index: usize,
    /// Value in the channel's unit.
    pub value: f64,
}

/// A point as the counting stack sees it, so that damage can be computed on bare values too.
pub(super) trait Point: Copy {
    /// Value in the channel's unit.
    fn value(self) -> f64;
}

impl Point for f64 {
    #[inline(always)]
    fn value(self) -> f64 {
        self
    }
}

impl Point for TurningPoint {
    #[inline(always)]
    fn value(self) -> f64 {
        self.value
    }
}

/// Whether `b` may be a turning point between its neighbours: any point but those inside a strictly
/// monotone part. Comparisons only, so that no difference can overflow.
#[inline(always)]
pub(super) fn may_turn(a: f64, b: f64, c: f64) -> bool {
    let rises = (a < b) & (b < c);
    let falls = (a > b) & (b > c);
    !(rises | falls)
}

/// Appends `point` to a sequence of turning points, or moves its last one when `point` continues
/// in the same direction. Equal values are one point.
fn append(points: &mut Vec<TurningPoint>, point: TurningPoint) {
    if let Some(last) = points.last() {
        if point.value == last.value {
            return;
        }
        if let [.., before, last] = points[..]
            && (last.value > before.value) == (point.value > last.value)
        {
            points.pop();
        }
    }
    points.push(point);
}

/// Turning points of `x`, in order, alternating strictly; cost O(n).
pub fn turning_points(x: &[f64]) -> Vec<TurningPoint> {
    let mut points = Vec::new();
    let Some(last) = x.len().checked_sub(1) else { return points };
    points.push(TurningPoint { index: 0, value: x[0] });
    for (i, w) in x.windows(3).enumerate() {
        if may_turn(w[0], w[1], w[2]) {
            append(&mut points, TurningPoint { index: i + 1, value: w[1] });
        }
    }
    append(&mut points, TurningPoint { index: last, value: x[last] });
    points
}

/// Filters between turning points and counting; by default none.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Prefilter {
    /// Reversals up to this size (channel's unit) are dropped; zero keeps all.
    pub hysteresis: f64,
    /// Values are replaced by the middle of their class; `None` keeps them.
    pub binning: Option<Classes>,
}

impl Prefilter {
    /// Applies hysteresis, then classes.
    pub fn apply(&self, points: &[TurningPoint]) -> Vec<TurningPoint> {
        let kept = if self.hysteresis > 0.0 {
            drop_small_reversals(points, self.hysteresis)
        } else {
            points.to_vec()
        };
        let Some(classes) = self.binning else { return kept };
        let mut binned = Vec::with_capacity(kept.len());
        for point in kept {
            append(&mut binned, TurningPoint { value: classes.middle(classes.index(point.value)), ..point });
        }
        binned
    }
}

/// Keeps reversals larger than `hysteresis` (the filter of a-ma72/rainflow's `feed_filter_pt`).
///
/// The first point kept is the earlier of the two extremes that first lie more than `hysteresis`
/// apart; the last extreme is always kept.
fn drop_small_reversals(points: &[TurningPoint], hysteresis: f64) -> Vec<TurningPoint> {
    let mut kept: Vec<TurningPoint> = Vec::new();
    let Some(&first) = points.first() else { return kept };
    let (mut low, mut high) = (first, first);
    let mut rest = points.iter().copied();
    for point in rest.by_ref() {
        if point.value < low.value {
            low = point;
        }
        if point.value > high.value {
            high = point;
        }
        if high.value - low.value > hysteresis {
            let (earlier, later) = if low.index < high.index { (low, high) } else { (high, low) };
            kept.extend([earlier, later]);
            break;
        }
    }
    if kept.is_empty() {
        return vec![first];
    }
    for point in rest {
        let n = kept.len();
        let rising = kept[n - 1].value > kept[n - 2].value;
        let onward = if rising { point.value - kept[n - 1].value } else { kept[n - 1].value - point.value };
        if onward > 0.0 {
            kept[n - 1] = point;
        } else if -onward > hysteresis {
            kept.push(point);
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn values(x: &[f64]) -> Vec<f64> {
        turning_points(x).iter().map(|p| p.value).collect()
    }

    fn indices(x: &[f64]) -> Vec<usize> {
        turning_points(x).iter().map(|p| p.index).collect()
    }

    #[test]
    fn signals_of_zero_to_three_samples_have_the_documented_points() {
        assert!(values(&[]).is_empty());
        assert_eq!(values(&[3.0]), [3.0]);
        assert_eq!(values(&[3.0, 3.0]), [3.0]);
        assert_eq!(values(&[1.0, 2.0]), [1.0, 2.0]);
        assert_eq!(values(&[1.0, 2.0, 3.0]), [1.0, 3.0]);
        assert_eq!(values(&[1.0, 3.0, 2.0]), [1.0, 3.0, 2.0]);
        assert_eq!(values(&[2.0, 2.0, 2.0]), [2.0]);
    }

    #[test]
    fn a_plateau_is_one_point_at_its_first_sample() {
        let x = [0.0, 1.0, 1.0, 1.0, 0.5, 0.5, 2.0, 2.0, 3.0, 3.0];
        assert_eq!(values(&x), [0.0, 1.0, 0.5, 3.0]);
        assert_eq!(indices(&x), [0, 1, 4, 8]);
    }

    #[test]
    fn differences_that_overflow_still_turn() {
        let x = [-f64::MAX, f64::MAX, -f64::MAX, 0.0];
        assert_eq!(values(&x), x);
    }

    #[test]
    fn hysteresis_drops_small_reversals_and_keeps_the_ends() {
        let points = turning_points(&[0.0, 5.0, 4.0, 9.0, 1.0, 2.0, 1.5, 7.0, 6.5]);
        let kept = Prefilter { hysteresis: 1.0, binning: None }.apply(&points);
        assert_eq!(kept.iter().map(|p| p.value).collect::<Vec<_>>(), [0.0, 9.0, 1.0, 7.0]);
        assert_eq!(kept.iter().map(|p| p.index).collect::<Vec<_>>(), [0, 3, 4, 7]);
    }

    #[test]
    fn hysteresis_wider_than_the_signal_leaves_its_first_point() {
        let points = turning_points(&[1.0, 2.0, 1.0, 2.0]);
        let kept = Prefilter { hysteresis: 1.0, binning: None }.apply(&points);
        assert_eq!(kept, [TurningPoint { index: 0, value: 1.0 }]);
    }

    #[test]
    fn points_of_one_class_become_one_point() {
        let classes = Classes::new(0.0, 10.0, 10).unwrap();
        let points = turning_points(&[0.2, 3.4, 3.1, 3.9, 1.0]);
        let binned = Prefilter { hysteresis: 0.0, binning: Some(classes) }.apply(&points);
        assert_eq!(binned.iter().map(|p| p.value).collect::<Vec<_>>(), [0.5, 3.5, 1.5]);
        assert_eq!(binned.iter().map(|p| p.index).collect::<Vec<_>>(), [0, 1, 4]);
    }

    /// Few distinct values, so that plateaus are common.
    fn signal() -> impl Strategy<Value = Vec<f64>> {
        prop::collection::vec((-4i8..4).prop_map(f64::from), 0..60)
    }

    /// The definition, read sample by sample: merge plateaus, then keep ends and extrema.
    fn obvious(x: &[f64]) -> Vec<TurningPoint> {
        let mut merged: Vec<TurningPoint> = Vec::new();
        for (index, &value) in x.iter().enumerate() {
            if merged.last().is_none_or(|p| p.value != value) {
                merged.push(TurningPoint { index, value });
            }
        }
        (0..merged.len())
            .filter(|&i| {
                i == 0
                    || i + 1 == merged.len()
                    || (merged[i].value > merged[i - 1].value) == (merged[i].value > merged[i + 1].value)
            })
            .map(|i| merged[i])
            .collect()
    }

    proptest! {
        #[test]
        fn the_fast_pass_is_the_definition(x in signal()) {
            prop_assert_eq!(turning_points(&x), obvious(&x));
        }

        #[test]
        fn doubling_every_sample_changes_no_value(x in signal()) {
            let doubled: Vec<f64> = x.iter().flat_map(|&v| [v, v]).collect();
            prop_assert_eq!(values(&doubled), values(&x));
            let halved: Vec<usize> = indices(&doubled).iter().map(|i| i / 2).collect();
            prop_assert_eq!(halved, indices(&x));
        }

        #[test]
        fn a_vanishing_hysteresis_keeps_everything(x in signal()) {
            let points = turning_points(&x);
            prop_assert_eq!(Prefilter { hysteresis: 1e-9, binning: None }.apply(&points), points);
        }
    }
}
