//! Four-point rainflow counting on a flat stack, O(n).
//!
//! Source: McInnes and Meehan, "Equivalence of four-point and three-point rainflow cycle counting
//! algorithms", Int. J. Fatigue 30 (2008) 547-559. Of four consecutive turning points A, B, C, D
//! the inner pair is a closed cycle when its range exceeds neither neighbour's:
//! `|B-C| <= |A-B|` and `|B-C| <= |C-D|`. It is counted and removed, and the rest is examined again.
//! The turning points that never close a cycle are the residue: ranges that first grow, then shrink.

use serde::{Deserialize, Serialize};

use super::turning::{Point, Prefilter, TurningPoint, turning_points};

/// Treatment of the residue.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Residue {
    /// The residue is ignored. This leaves out the largest range of the signal, so that the damage is far
    /// too low.
    Ignore,
    /// Each range between neighbouring residue points is half a cycle (with it the four-point
    /// method gives the counts of ASTM E1049-85, section 5.4.4).
    Half,
    /// The residue is counted as if it came twice in a row, and the cycles that the second pass closes
    /// count once each. Correct for a load that repeats.
    #[default]
    Repeated,
}

/// One closed cycle, or one range of the residue.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Cycle {
    /// Where the range begins.
    pub from: TurningPoint,
    /// Where it ends. Of a cycle that only the repeated residue closes it may lie before `from`.
    pub to: TurningPoint,
    /// 1, or 0.5 for a residue range under [`Residue::Half`].
    pub count: f64,
}

impl Cycle {
    /// Maximum minus minimum.
    pub fn range(&self) -> f64 {
        (self.to.value - self.from.value).abs()
    }

    /// Half the range: `S_a`.
    pub fn amplitude(&self) -> f64 {
        0.5 * self.range()
    }

    /// Middle between maximum and minimum.
    pub fn mean(&self) -> f64 {
        0.5 * self.from.value + 0.5 * self.to.value
    }
}

/// Closed cycles in the order in which they close, and the residue.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Rainflow {
    /// Closed cycles, each counting 1.
    pub cycles: Vec<Cycle>,
    /// Turning points that closed no cycle, in order.
    pub residue: Vec<TurningPoint>,
}

impl Rainflow {
    /// Counts turning points that alternate strictly, as [`turning_points`] gives them.
    pub fn of_points(points: &[TurningPoint]) -> Self {
        let mut cycles = Vec::new();
        let mut stack = Stack { points: Vec::new() };
        for &point in points {
            stack.push(point, |from, to| cycles.push(Cycle { from, to, count: 1.0 }));
        }
        Self { cycles, residue: stack.points }
    }

    /// Counts a signal; `prefilter` by default changes nothing.
    pub fn of_signal(x: &[f64], prefilter: &Prefilter) -> Self {
        Self::of_points(&prefilter.apply(&turning_points(x)))
    }

    /// Cycles of the residue under `method`.
    pub fn residue_cycles(&self, method: Residue) -> Vec<Cycle> {
        match method {
            Residue::Ignore => Vec::new(),
            Residue::Half => {
                self.residue.windows(2).map(|w| Cycle { from: w[0], to: w[1], count: 0.5 }).collect()
            }
            Residue::Repeated => {
                let mut cycles = Vec::new();
                let mut stack = Stack { points: self.residue.clone() };
                for &point in &self.residue {
                    stack.push(point, |from, to| cycles.push(Cycle { from, to, count: 1.0 }));
                }
                cycles
            }
        }
    }

    /// Closed cycles, then those of the residue.
    pub fn all_cycles(&self, method: Residue) -> Vec<Cycle> {
        let mut all = self.cycles.clone();
        all.extend(self.residue_cycles(method));
        all
    }
}

/// Turning points that have closed no cycle so far; they alternate strictly.
#[derive(Debug)]
pub(super) struct Stack<P> {
    /// First to last.
    pub(super) points: Vec<P>,
}

impl<P: Point> Stack<P> {
    /// Adds the next point, and passes every cycle that it closes to `close(from, to)`.
    ///
    /// A point equal to the last is ignored, and a point that goes on in the last direction replaces the
    /// last one. Unfiltered candidates for turning points and the joint of a repeated residue are
    /// therefore valid input.
    #[inline(always)]
    pub(super) fn push(&mut self, d: P, mut close: impl FnMut(P, P)) {
        let stack = &mut self.points;
        if let Some(&last) = stack.last() {
            if d.value() == last.value() {
                return;
            }
            if let [.., before, last] = stack[..]
                && (last.value() > before.value()) == (d.value() > last.value())
            {
                stack.pop();
            }
        }
        while let [.., a, b, c] = stack[..] {
            let inner = (b.value() - c.value()).abs();
            if inner > (a.value() - b.value()).abs() || inner > (c.value() - d.value()).abs() {
                break;
            }
            close(b, c);
            stack.truncate(stack.len() - 2);
        }
        stack.push(d);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::measured::shared_data;
    use proptest::prelude::*;

    fn count(x: &[f64]) -> Rainflow {
        Rainflow::of_signal(x, &Prefilter::default())
    }

    /// `(range, mean, count, index from, index to)`, sorted: published tables have no common order.
    fn table(cycles: &[Cycle]) -> Vec<(f64, f64, f64, usize, usize)> {
        let mut rows: Vec<_> =
            cycles.iter().map(|c| (c.range(), c.mean(), c.count, c.from.index, c.to.index)).collect();
        rows.sort_by(|a, b| a.partial_cmp(b).unwrap());
        rows
    }

    fn sorted(mut rows: Vec<(f64, f64, f64, usize, usize)>) -> Vec<(f64, f64, f64, usize, usize)> {
        rows.sort_by(|a, b| a.partial_cmp(b).unwrap());
        rows
    }

    /// ASTM E1049-85, section 5.4.4, figure 6, with the indices of iamlikeme/rainflow TEST_CASE_1.
    #[test]
    fn half_residue_gives_the_cycles_of_astm_e1049_figure_6() {
        let all = count(&[-2.0, 1.0, -3.0, 5.0, -1.0, 3.0, -4.0, 4.0, -2.0]).all_cycles(Residue::Half);
        let published = vec![
            (3.0, -0.5, 0.5, 0, 1),
            (4.0, -1.0, 0.5, 1, 2),
            (4.0, 1.0, 1.0, 4, 5),
            (8.0, 1.0, 0.5, 2, 3),
            (9.0, 0.5, 0.5, 3, 6),
            (8.0, 0.0, 0.5, 6, 7),
            (6.0, 1.0, 0.5, 7, 8),
        ];
        assert_eq!(table(&all), sorted(published));
    }

    /// iamlikeme/rainflow TEST_CASE_2 (MIT), which applies ASTM's rule to a longer history.
    #[test]
    fn half_residue_gives_the_cycles_of_a_longer_history() {
        let x = [
            -1.5, 1.0, -3.0, 10.0, -1.0, 3.0, -8.0, 4.0, -2.0, 6.0, -1.0, -4.0, -8.0, 2.0, 1.0, -5.0, 0.0,
            2.5, -4.0, 1.0, 0.0, 2.0, -0.5,
        ];
        let published = vec![
            (2.5, -0.25, 0.5, 0, 1),
            (4.0, -1.0, 0.5, 1, 2),
            (4.0, 1.0, 1.0, 4, 5),
            (13.0, 3.5, 0.5, 2, 3),
            (6.0, 1.0, 1.0, 7, 8),
            (14.0, -1.0, 1.0, 6, 9),
            (7.0, -1.5, 1.0, 13, 15),
            (1.0, 0.5, 1.0, 19, 20),
            (18.0, 1.0, 0.5, 3, 12),
            (10.5, -2.75, 0.5, 12, 17),
            (6.5, -0.75, 0.5, 17, 18),
            (6.0, -1.0, 0.5, 18, 21),
            (2.5, 0.75, 0.5, 21, 22),
        ];
        assert_eq!(table(&count(&x).all_cycles(Residue::Half)), sorted(published));
    }

    /// iamlikeme/rainflow TEST_CASE_3 (MIT): two sines; ranges to 1e-12 of the signal's size,
    /// since the sines themselves differ in the last digits between libraries.
    #[test]
    fn half_residue_gives_the_ranges_of_two_sines() {
        let x: Vec<f64> = (0..=1000)
            .map(|i| {
                let t = std::f64::consts::PI * f64::from(i);
                0.8 * (0.01 * t).sin() + 0.2 * (0.032 * t).sin()
            })
            .collect();
        let published = [
            (0.025559850506591708, 1.0),
            (0.025559850506592263, 1.0),
            (0.09020631993390904, 1.0),
            (0.09020631993390937, 1.0),
            (0.7841230166856958, 0.5),
            (0.7841230166856961, 0.5),
            (1.6512875405599488, 0.5),
            (1.651287540559949, 0.5),
            (1.798637423867886, 0.5),
            (1.7986374238678877, 0.5),
            (1.9065326561275655, 0.5),
            (1.9065326561275668, 0.5),
            (1.9722034009805516, 0.5),
            (1.9722034009805522, 0.5),
            (1.9942872896932382, 0.5),
        ];
        // At sample 1000 both sines are zero but for rounding; the published table has no range
        // that small, so neither may ours.
        let rows = table(&count(&x).all_cycles(Residue::Half));
        assert_eq!(rows.len(), published.len());
        for (row, expected) in rows.iter().zip(published) {
            assert!((row.0 - expected.0).abs() < 1e-12, "{} {}", row.0, expected.0);
            assert_eq!(row.2, expected.1, "count of range {}", expected.0);
        }
    }

    /// Gunnstein/fatpack, fatpack/test.py (ISC), after ISO 12110-2: the classed reversals.
    #[test]
    fn four_points_give_the_cycles_and_residue_of_fatpack() {
        let reversals = [
            4.0, 7.0, 2.0, 10.0, 5.0, 9.0, 3.0, 4.0, 2.0, 12.0, 5.0, 11.0, 1.0, 4.0, 3.0, 10.0, 6.0, 12.0,
            4.0, 8.0, 1.0, 9.0, 4.0, 6.0,
        ];
        let counted = count(&reversals);
        let pairs = |cycles: &[Cycle]| -> Vec<(f64, f64)> {
            let mut pairs: Vec<_> = cycles.iter().map(|c| (c.from.value, c.to.value)).collect();
            pairs.sort_by(|a, b| a.partial_cmp(b).unwrap());
            pairs
        };
        let mut closed = [
            (5.0, 9.0),
            (3.0, 4.0),
            (10.0, 2.0),
            (5.0, 11.0),
            (4.0, 3.0),
            (10.0, 6.0),
            (4.0, 8.0),
            (1.0, 12.0),
        ];
        closed.sort_by(|a, b| a.partial_cmp(b).unwrap());
        assert_eq!(pairs(&counted.cycles), closed);
        let residue: Vec<f64> = counted.residue.iter().map(|p| p.value).collect();
        assert_eq!(residue, [4.0, 7.0, 2.0, 12.0, 1.0, 9.0, 4.0, 6.0]);
        assert_eq!(
            pairs(&counted.residue_cycles(Residue::Repeated)),
            [(1.0, 12.0), (4.0, 6.0), (4.0, 7.0), (9.0, 2.0)]
        );
        assert!(counted.residue_cycles(Residue::Ignore).is_empty());
    }

    #[test]
    fn short_and_constant_signals_count_as_documented() {
        for x in [&[][..], &[1.0], &[2.0, 2.0, 2.0]] {
            for method in [Residue::Ignore, Residue::Half, Residue::Repeated] {
                assert!(count(x).all_cycles(method).is_empty(), "{x:?}");
            }
        }
        let ranges = |x: &[f64], method| -> Vec<(f64, f64)> {
            count(x).all_cycles(method).iter().map(|c| (c.range(), c.count)).collect()
        };
        assert_eq!(ranges(&[1.0, 2.0], Residue::Half), [(1.0, 0.5)]);
        assert_eq!(ranges(&[1.0, 2.0], Residue::Repeated), [(1.0, 1.0)]);
        assert_eq!(ranges(&[1.0, 2.0, 3.0], Residue::Half), [(2.0, 0.5)]);
        // Repeated, 1 3 2 1 3 2 ... has no turning point at 2.
        assert_eq!(ranges(&[1.0, 3.0, 2.0], Residue::Repeated), [(2.0, 1.0)]);
    }

    /// The definition with nothing kept between steps: look from the start for the first four
    /// points whose inner pair closes, take it out, start again.
    fn obvious(x: &[f64]) -> (Vec<(usize, usize)>, Vec<usize>) {
        let mut points = turning_points(x);
        let mut cycles = Vec::new();
        while let Some(i) = points.windows(4).position(|w| {
            let inner = (w[1].value - w[2].value).abs();
            inner <= (w[0].value - w[1].value).abs() && inner <= (w[2].value - w[3].value).abs()
        }) {
            cycles.push((points[i + 1].index, points[i + 2].index));
            points.drain(i + 1..i + 3);
        }
        (cycles, points.iter().map(|p| p.index).collect())
    }

    /// Whole numbers make equal ranges, the case where rules differ, frequent.
    fn signal() -> impl Strategy<Value = Vec<f64>> {
        prop::collection::vec((-6i8..=6).prop_map(f64::from), 0..80)
    }

    proptest! {
        #[test]
        fn the_stack_counts_what_the_obvious_search_counts(x in signal()) {
            let counted = count(&x);
            let (cycles, residue) = obvious(&x);
            let found: Vec<_> = counted.cycles.iter().map(|c| (c.from.index, c.to.index)).collect();
            prop_assert_eq!(found, cycles);
            prop_assert_eq!(counted.residue.iter().map(|p| p.index).collect::<Vec<_>>(), residue);
        }

        #[test]
        fn repeated_residue_is_the_count_of_a_second_pass(x in signal()) {
            // What a second pass over the whole signal adds: its own cycles plus those that the
            // residue closes.
            let once = count(&x);
            let twice: Vec<f64> = x.iter().chain(&x).copied().collect();
            let ranges = |cycles: Vec<Cycle>| {
                let mut r: Vec<f64> = cycles.iter().map(Cycle::range).collect();
                r.sort_by(f64::total_cmp);
                r
            };
            let mut expected = once.cycles.clone();
            expected.extend(once.all_cycles(Residue::Repeated));
            prop_assert_eq!(ranges(count(&twice).cycles), ranges(expected));
        }

        #[test]
        fn doubling_samples_and_changing_sign_keep_all_ranges(x in signal()) {
            let ranges = |x: &[f64]| -> Vec<(f64, f64)> {
                count(x).all_cycles(Residue::Repeated).iter().map(|c| (c.range(), c.count)).collect()
            };
            let doubled: Vec<f64> = x.iter().flat_map(|&v| [v, v]).collect();
            let negated: Vec<f64> = x.iter().map(|v| -v).collect();
            prop_assert_eq!(ranges(&doubled), ranges(&x));
            prop_assert_eq!(ranges(&negated), ranges(&x));
        }

        #[test]
        fn no_turning_point_is_lost(x in signal()) {
            let counted = count(&x);
            prop_assert_eq!(2 * counted.cycles.len() + counted.residue.len(), turning_points(&x).len());
        }
    }

    /// a-ma72/rainflow, src/python/tests/long_series.csv and test_long_series (BSD-2): classes of
    /// width 50 from -2025, hysteresis 50, residue as it is.
    #[test]
    fn a_long_series_gives_the_published_count_and_residue() {
        let Some(path) = shared_data("rainflow/long_series.csv") else { return };
        let text = std::fs::read_to_string(path).unwrap();
        let x: Vec<f64> = text.split_whitespace().map(|v| v.parse().unwrap()).collect();
        assert_eq!(x.len(), 10_001);
        let classes = super::super::Classes::new(-2025.0, -2025.0 + 50.0 * 100.0, 100).unwrap();
        let prefilter = Prefilter { hysteresis: 50.0, binning: Some(classes) };
        let counted = Rainflow::of_signal(&x, &prefilter);
        assert_eq!(counted.cycles.len(), 640);
        let residue: Vec<f64> = counted.residue.iter().map(|p| x[p.index]).collect();
        assert_eq!(residue, [0.0, 142.0, -609.0, 2950.0, -2000.0, 2159.0, 1894.0, 2101.0, 1991.0, 2061.0]);
    }
}
