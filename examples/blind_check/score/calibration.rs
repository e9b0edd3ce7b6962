//! Calibration of stated probabilities: their mean against the share of verdicts that are true.

use super::case::Case;
use super::row::{Bar, Row};

/// Bins of the expected calibration error.
const BINS: usize = 10;

/// One bin: verdicts in it, their mean probability, the share of them that is true.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Bin {
    pub count: usize,
    pub stated: f64,
    pub found: f64,
}

/// The probability of each verdict, and whether it is true.
pub fn verdicts(cases: &[Case]) -> Vec<(f64, bool)> {
    let one = |c: &Case| Some((c.verdict()["probability"].as_f64()?, c.verdict_is_true()));
    cases.iter().filter_map(one).collect()
}

/// Verdicts by probability.
pub fn bins(verdicts: &[(f64, bool)]) -> [Bin; BINS] {
    let mut bins = [Bin::default(); BINS];
    for &(p, is_true) in verdicts {
        let bin = &mut bins[((p * BINS as f64) as usize).min(BINS - 1)];
        bin.count += 1;
        bin.stated += p;
        bin.found += f64::from(u8::from(is_true));
    }
    for bin in &mut bins {
        bin.stated /= bin.count.max(1) as f64;
        bin.found /= bin.count.max(1) as f64;
    }
    bins
}

/// Expected calibration error.
pub fn expected_error(verdicts: &[(f64, bool)]) -> f64 {
    let weighted = |b: &Bin| b.count as f64 * (b.stated - b.found).abs();
    bins(verdicts).iter().map(weighted).sum::<f64>() / verdicts.len().max(1) as f64
}

/// Brier's score (Brier 1950, Mon. Weather Rev. 78), and that of the constant that would do best.
pub fn brier(verdicts: &[(f64, bool)]) -> [f64; 2] {
    let n = verdicts.len().max(1) as f64;
    let square = |&(p, is_true): &(f64, bool)| (p - f64::from(u8::from(is_true))).powi(2);
    let share = verdicts.iter().filter(|v| v.1).count() as f64 / n;
    [verdicts.iter().map(square).sum::<f64>() / n, share * (1.0 - share)]
}

/// Rows over all cases.
pub fn rows(cases: &[Case]) -> Vec<Row> {
    let verdicts = verdicts(cases);
    if verdicts.is_empty() {
        return Vec::new();
    }
    let [score, constant] = brier(&verdicts);
    vec![
        Row::number("calibration", "expected error", Some(expected_error(&verdicts)), Bar::AtMost(0.05)),
        Row::number(
            "calibration",
            "Brier score, below the best constant's",
            Some(score),
            Bar::Below(constant),
        ),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn probabilities_that_come_true_as_often_as_they_say_have_no_error() {
        let honest: Vec<(f64, bool)> = (0..100).map(|i| (0.75, i % 4 != 0)).collect();
        assert!(expected_error(&honest) < 1e-12);
        let [score, constant] = brier(&honest);
        assert!((score - 0.1875).abs() < 1e-12 && (constant - 0.1875).abs() < 1e-12);
    }

    #[test]
    fn a_sure_verdict_that_is_wrong_costs_most() {
        let verdicts = [(1.0, false), (1.0, true), (0.0, false), (0.35, true)];
        assert!((expected_error(&verdicts) - (2.0 * 0.5 + 0.65) / 4.0).abs() < 1e-12);
        assert!((brier(&verdicts)[0] - (1.0 + 0.65 * 0.65) / 4.0).abs() < 1e-12);
    }
}
