//! Range-pair count, level-crossing count and from-to matrix of one signal.
//!
//! Cycles are counted on the unquantised samples; the classes only sort them into a table.

use serde::{Deserialize, Serialize};

use super::classes::Classes;
use super::rainflow::{Cycle, Rainflow, Residue};
use super::turning::{TurningPoint, turning_points};

/// Cycles by range.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RangePair {
    /// `count + 1` edges of the range classes in the channel's unit, from 0 to the span of the
    /// classes; a class holds its lower edge, the last one its upper edge too.
    pub range_edges: Vec<f64>,
    /// Cycles per class; halves come from the residue method `half`.
    pub cycles: Vec<f64>,
    /// Cycles of this class and all wider ones.
    pub cumulative: Vec<f64>,
}

/// Number of crossings of each level in one pass of the signal.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LevelCrossing {
    /// The class edges, in the channel's unit.
    pub levels: Vec<f64>,
    /// Crossings from below a level to it or above.
    pub rising: Vec<u64>,
    /// Crossings from a level or above to below it.
    pub falling: Vec<u64>,
}

/// Cycles by the class in which they begin and the class in which they end.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FromTo {
    /// `count + 1` class edges in the channel's unit.
    pub edges: Vec<f64>,
    /// `[from class][to class]`; the diagonal holds cycles inside one class.
    pub cycles: Vec<Vec<f64>>,
}

/// The three tables of one signal.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Counts {
    /// Cycles by range.
    pub range_pair: RangePair,
    /// Level crossings.
    pub level_crossing: LevelCrossing,
    /// Cycles from class to class.
    pub from_to: FromTo,
}

/// Counts finite `samples` in `classes`; `residue` is the treatment of unclosed turning points in the
/// range-pair count and the from-to matrix. Values outside the classes fall into the outer ones.
pub fn counts(samples: &[f64], classes: &Classes, residue: Residue) -> Counts {
    let points = turning_points(samples);
    let cycles = Rainflow::of_points(&points).all_cycles(residue);
    Counts {
        range_pair: range_pair(&cycles, classes),
        level_crossing: level_crossing(&points, classes),
        from_to: from_to(&cycles, classes),
    }
}

fn range_pair(cycles: &[Cycle], classes: &Classes) -> RangePair {
    let (n, width) = (classes.count(), classes.width());
    let mut per_class = vec![0.0; n];
    for cycle in cycles {
        per_class[((cycle.range() / width) as usize).min(n - 1)] += cycle.count;
    }
    let mut cumulative = per_class.clone();
    for i in (0..n - 1).rev() {
        cumulative[i] += cumulative[i + 1];
    }
    RangePair { range_edges: (0..=n).map(|i| i as f64 * width).collect(), cycles: per_class, cumulative }
}

fn level_crossing(points: &[TurningPoint], classes: &Classes) -> LevelCrossing {
    let levels = classes.edges();
    // Marks the levels at which each leg starts and stops crossing; the running sum is the count.
    let (mut rising, mut falling) = (vec![0i64; levels.len() + 1], vec![0i64; levels.len() + 1]);
    for leg in points.windows(2) {
        let (a, b) = (leg[0].value, leg[1].value);
        let marks = if a < b { &mut rising } else { &mut falling };
        marks[levels.partition_point(|&l| l <= a.min(b))] += 1;
        marks[levels.partition_point(|&l| l <= a.max(b))] -= 1;
    }
    let total = |marks: Vec<i64>| {
        let running = marks.iter().scan(0, |sum: &mut i64, &m| {
            *sum += m;
            Some(sum.unsigned_abs())
        });
        running.take(levels.len()).collect()
    };
    let (rising, falling) = (total(rising), total(falling));
    LevelCrossing { levels, rising, falling }
}

fn from_to(cycles: &[Cycle], classes: &Classes) -> FromTo {
    let mut matrix = vec![vec![0.0; classes.count()]; classes.count()];
    for cycle in cycles {
        matrix[classes.index(cycle.from.value)][classes.index(cycle.to.value)] += cycle.count;
    }
    FromTo { edges: classes.edges(), cycles: matrix }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fatigue::ClassSettings;
    use proptest::prelude::*;

    /// The history of ASTM E1049-85, figure 6.
    const ASTM: [f64; 9] = [-2.0, 1.0, -3.0, 5.0, -1.0, 3.0, -4.0, 4.0, -2.0];

    #[test]
    fn range_pairs_of_astm_figure_6_are_those_of_the_standard() {
        let classes = Classes::new(-4.0, 6.0, 10).unwrap();
        let found = counts(&ASTM, &classes, Residue::Half).range_pair;
        // Table of section 5.4.4: range 3: 0.5, 4: 1.5, 6: 0.5, 8: 1.0, 9: 0.5.
        assert_eq!(found.range_edges, [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0]);
        assert_eq!(found.cycles, [0.0, 0.0, 0.0, 0.5, 1.5, 0.0, 0.5, 0.0, 1.0, 0.5]);
        assert_eq!(found.cumulative, [4.0, 4.0, 4.0, 4.0, 3.5, 2.0, 2.0, 1.5, 1.5, 0.5]);
    }

    #[test]
    fn cycles_stand_in_the_row_they_come_from_and_the_column_they_go_to() {
        let classes = Classes::new(-4.5, 5.5, 10).unwrap();
        let found = counts(&ASTM, &classes, Residue::Ignore).from_to;
        for (from, row) in found.cycles.iter().enumerate() {
            for (to, &n) in row.iter().enumerate() {
                // The one closed cycle goes from -1 (class 3) to 3 (class 7).
                assert_eq!(n, if (from, to) == (3, 7) { 1.0 } else { 0.0 }, "{from} {to}");
            }
        }
        let half = counts(&ASTM, &classes, Residue::Half).from_to.cycles;
        assert_eq!(half[classes.index(5.0)][classes.index(-4.0)], 0.5);
        assert_eq!(half[classes.index(-4.0)][classes.index(5.0)], 0.0);
        assert_eq!(half.iter().flatten().sum::<f64>(), 4.0);
    }

    #[test]
    fn a_level_is_crossed_upwards_when_it_is_reached_from_below() {
        let classes = Classes::new(0.0, 4.0, 4).unwrap();
        let found = counts(&[0.0, 2.0, 1.0, 4.0, 0.0], &classes, Residue::Repeated).level_crossing;
        assert_eq!(found.levels, [0.0, 1.0, 2.0, 3.0, 4.0]);
        assert_eq!(found.rising, [0, 1, 2, 1, 1]);
        assert_eq!(found.falling, [0, 1, 2, 1, 1]);
    }

    #[test]
    fn a_still_signal_counts_nothing() {
        let x = [2.0; 10];
        let classes = ClassSettings::default().over(&[&x]).unwrap();
        let found = counts(&x, &classes, Residue::Repeated);
        assert_eq!(found.range_pair.cumulative, [0.0; 64]);
        assert_eq!(found.level_crossing.rising, [0; 65]);
        assert!(found.from_to.cycles.iter().flatten().all(|&n| n == 0.0));
    }

    #[test]
    fn tables_serialise_under_their_names() {
        let classes = Classes::new(0.0, 2.0, 2).unwrap();
        let json = serde_json::to_string(&counts(&[0.0, 2.0], &classes, Residue::Repeated)).unwrap();
        assert_eq!(
            json,
            concat!(
                r#"{"range_pair":{"range_edges":[0.0,1.0,2.0],"cycles":[0.0,1.0],"cumulative":[1.0,1.0]},"#,
                r#""level_crossing":{"levels":[0.0,1.0,2.0],"rising":[0,1,1],"falling":[0,0,0]},"#,
                r#""from_to":{"edges":[0.0,1.0,2.0],"cycles":[[0.0,0.0],[1.0,0.0]]}}"#
            )
        );
    }

    proptest! {
        #[test]
        fn crossings_are_those_of_each_pair_of_samples(
            x in prop::collection::vec((-8i8..8).prop_map(|v| f64::from(v) * 0.5), 1..60)
        ) {
            let classes = ClassSettings { count: 7, ..Default::default() }.over(&[&x]).unwrap();
            let found = counts(&x, &classes, Residue::Ignore).level_crossing;
            prop_assert_eq!(found.rising.len(), 8);
            for (i, &level) in found.levels.iter().enumerate() {
                let rising = x.windows(2).filter(|w| w[0] < level && level <= w[1]).count();
                let falling = x.windows(2).filter(|w| w[1] < level && level <= w[0]).count();
                prop_assert_eq!((found.rising[i], found.falling[i]), (rising as u64, falling as u64));
            }
        }

        #[test]
        fn every_cycle_is_in_every_table(
            x in prop::collection::vec(-5.0..5.0f64, 1..60)
        ) {
            let classes = ClassSettings { count: 9, ..Default::default() }.over(&[&x]).unwrap();
            let found = counts(&x, &classes, Residue::Half);
            let expected: f64 = Rainflow::of_points(&turning_points(&x))
                .all_cycles(Residue::Half).iter().map(|c| c.count).sum();
            // Sums of halves are exact.
            prop_assert_eq!(found.range_pair.cumulative[0], expected);
            prop_assert_eq!(found.from_to.cycles.iter().flatten().sum::<f64>(), expected);
        }
    }
}
