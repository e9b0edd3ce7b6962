//! Compares a run with those that were committed last, row by row, as shares of what the machine reached beside each row.
//!
//! A yardstick of arithmetic does not say how fast memory is: a row is compared with that of the machine most like this one.

use std::path::Path;

use serde_json::Value;

/// A row that keeps less than this of its share is slower than machines vary.
const KEPT: f64 = 0.85;

/// A measured work.
#[derive(Debug, Clone, PartialEq)]
pub struct Row {
    work: String,
    /// Works per second over the FLOP per second that the machine reached before and after: the yardstick cancels.
    share: f64,
    /// FLOP per second of the yardstick, in 10^9.
    peak: f64,
    /// Threads and instruction set.
    on: String,
}

/// The rows of a run's lines: the median of each, over the mean of the medians of `peak_fma` around it.
pub fn rows(lines: &[Value]) -> Result<Vec<Row>, String> {
    let number =
        |line: &Value| line["median"].as_f64().filter(|v| *v > 0.0).ok_or(format!("no median: {line}"));
    let is_peak = |line: &&Value| line["work"] == "peak_fma";
    let mut rows = Vec::new();
    for (place, line) in lines.iter().enumerate().filter(|(_, line)| !is_peak(line)) {
        let (before, after) =
            (lines[..place].iter().rev().find(is_peak), lines[place..].iter().find(is_peak));
        let (Some(before), Some(after)) = (before, after) else {
            return Err(format!("no peak_fma before and after {line}"));
        };
        let peak = f64::midpoint(number(before)?, number(after)?);
        let median = number(line)?;
        let per_second = if line["unit"] == "s" { 1.0 / median } else { median };
        rows.push(Row {
            work: line["work"].as_str().ok_or("a row has no name")?.to_owned(),
            share: per_second / peak,
            peak,
            on: format!("{} threads, {}", line["threads"], line["isa"]),
        });
    }
    Ok(rows)
}

/// The lines of committed runs, one after the other.
pub fn read(path: &Path) -> Result<Vec<Row>, String> {
    let text = std::fs::read_to_string(path).map_err(|error| format!("{}: {error}", path.display()))?;
    let lines: Result<Vec<Value>, _> = text.lines().map(serde_json::from_str).collect();
    rows(&lines.map_err(|error| format!("{}: {error}", path.display()))?)
}

/// A sentence for each row, and whether none is slower than it may be. A row that was never committed has nothing to be compared
/// with; a committed one that was not measured is an error.
pub fn compare(before: &[Row], now: &[Row]) -> Result<(Vec<String>, bool), String> {
    let same = |a: &Row, b: &Row| a.work == b.work && a.on == b.on;
    if let Some(lost) = before.iter().find(|old| !now.iter().any(|row| same(old, row))) {
        return Err(format!("{} on {} was committed and is not among the rows", lost.work, lost.on));
    }
    let mut fast = true;
    let mut told = Vec::new();
    for row in now {
        let apart = |old: &&Row| (old.peak / row.peak).ln().abs();
        let olds = before.iter().filter(|old| same(old, row));
        let Some(old) = olds.min_by(|a, b| apart(a).total_cmp(&apart(b))) else {
            told.push(format!("speed: {} is new", row.work));
            continue;
        };
        let kept = row.share / old.share;
        fast &= kept >= KEPT;
        let verdict = if kept >= KEPT { "" } else { ", SLOWER" };
        told.push(format!("speed: {} has {kept:.2} of its last share of peak_fma{verdict}", row.work));
    }
    Ok((told, fast))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn run(peak: f64, rate: f64, seconds: f64) -> Vec<Row> {
        let line = |work: &str, unit: &str, median: f64| json!({"work": work, "unit": unit, "median": median, "threads": 2, "isa": "avx512"});
        rows(&[
            line("peak_fma", "gflops", peak),
            line("infer", "signal_s_per_s", rate),
            line("peak_fma", "gflops", peak),
            line("h1", "s", seconds),
            line("peak_fma", "gflops", peak),
        ])
        .unwrap()
    }

    #[test]
    fn a_slower_machine_changes_nothing_and_a_slower_row_fails() {
        let before = run(400.0, 8000.0, 0.1);
        let (told, fast) = compare(&before, &run(200.0, 4000.0, 0.2)).unwrap();
        assert!(fast && told.len() == 2 && told[0].contains("1.00"), "{told:?}");
        assert!(compare(&before, &run(400.0, 7000.0, 0.115)).unwrap().1);
        let (told, fast) = compare(&before, &run(400.0, 8000.0, 0.12)).unwrap();
        assert!(
            !fast && !told[0].contains("SLOWER") && told[1].contains("0.83") && told[1].contains("SLOWER"),
            "{told:?}"
        );
        assert!(!compare(&before, &run(400.0, 6700.0, 0.1)).unwrap().1);
    }

    #[test]
    fn a_row_is_compared_with_that_of_the_machine_most_like_this_one() {
        let before = [run(400.0, 8000.0, 0.1), run(200.0, 4000.0, 0.1)].concat();
        let (told, fast) = compare(&before, &run(220.0, 4400.0, 0.1)).unwrap();
        assert!(fast && told.len() == 2 && told[1].contains("0.91"), "{told:?}");
        let (told, fast) = compare(&before, &run(350.0, 7000.0, 0.1)).unwrap();
        assert!(fast && told[1].contains("1.14"), "{told:?}");
        assert!(!compare(&before, &run(220.0, 4400.0, 0.11)).unwrap().1);
    }

    #[test]
    fn a_row_is_compared_with_its_like_only() {
        let (before, mut now) = (run(400.0, 8000.0, 0.1), run(400.0, 8000.0, 0.1));
        now[1].on = "1 threads, \"avx2\"".to_owned();
        assert!(compare(&before, &now).is_err(), "two threads were committed");
        let (told, fast) = compare(&before[..1], &run(400.0, 8000.0, 9.0)).unwrap();
        assert!(fast && told[1] == "speed: h1 is new", "{told:?}");
        assert!(compare(&before, &before[..1]).is_err(), "a row is lost");
        assert!(rows(&[json!({"work": "h1", "unit": "s", "median": 1.0})]).is_err());
    }
}
