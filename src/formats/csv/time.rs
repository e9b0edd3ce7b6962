//! The time column and the sample rate that it gives.

use crate::formats::times::{Even, Rounding, rate, unit_of_time};
use crate::formats::{FormatError, ReadError, Spool};

/// A column of times.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct TimeColumn {
    /// Index among the columns of the file.
    pub(super) column: usize,
    /// Seconds per unit.
    scale: f64,
}

impl TimeColumn {
    /// The time column of a file with these names and units, apart from the columns of date-times (`stamps`); `row`
    /// is the header's.
    ///
    /// # Errors
    /// `csv.time_column` when two columns claim to be it, or its unit is neither s nor ms.
    pub(super) fn find(
        names: &[String],
        units: Option<&[String]>,
        stamps: &[bool],
        row: u64,
    ) -> Result<Option<Self>, FormatError> {
        let refuse = |column: usize, reason| Err(FormatError::CsvTime { row, column: column + 1, reason });
        let is_stamp = |column: &usize| stamps.get(*column).copied().unwrap_or_default();
        let named: Vec<_> = names
            .iter()
            .enumerate()
            .filter(|(i, _)| !is_stamp(i))
            .filter_map(|(i, name)| Some((i, unit_of_time(name)?)))
            .collect();
        let by_unit: Vec<_> =
            units.unwrap_or_default().iter().enumerate().filter(|(i, u)| *u == "s" && !is_stamp(i)).collect();
        let (column, unit) = match (&named[..], &by_unit[..]) {
            ([(column, unit)], _) => (*column, *unit),
            ([], [(column, _)]) => (*column, None),
            ([], []) => return Ok(None),
            ([_, (second, _), ..], _) => return refuse(*second, "two columns are named as time"),
            ([], [_, (second, _), ..]) => {
                return refuse(*second, "two columns have the unit s and none is named time");
            }
        };
        let given = units.map(|u| u[column].as_str()).filter(|u| !u.is_empty());
        match (unit, given) {
            (Some(a), Some(b)) if a != b => refuse(column, "name and unit of the time column disagree"),
            (unit, given) => match unit.or(given).unwrap_or("s") {
                "s" | "sec" => Ok(Some(Self { column, scale: 1.0 })),
                "ms" => Ok(Some(Self { column, scale: 1e-3 })),
                _ => refuse(column, "the unit of a time column is s or ms"),
            },
        }
    }

    /// Sample rate of evenly spaced `times` (one column, in the unit of the time column), and its largest relative
    /// error by rounded times; `None` for a single one.
    ///
    /// # Errors
    /// As [`even`].
    pub(super) fn sample_rate(
        &self,
        times: &Spool,
        rounding: Rounding,
        first_row: u64,
    ) -> Result<Option<(f64, f64)>, ReadError> {
        even(times, rounding, first_row, self.column, self.scale)
    }
}

/// The rate of times that rise in even steps of `scale` seconds a unit, and its largest relative error by rounded
/// times; `None` for a single one.
///
/// # Errors
/// `csv.uneven_time` with the row of the first step that is not the step of most rows; `first_row` is the row of
/// the first sample, `column` the index of the time column. Errors of the file system.
pub(super) fn even(
    times: &Spool,
    rounding: Rounding,
    first_row: u64,
    column: usize,
    scale: f64,
) -> Result<Option<(f64, f64)>, ReadError> {
    match rate(times, rounding, scale)? {
        Even::Single => Ok(None),
        Even::Rate { rate_hz, error } => Ok(Some((rate_hz, error))),
        Even::Not { sample, usual_s, found_s } => Err(FormatError::CsvUnevenTime {
            // Rows of samples are consecutive lines, since a number holds no line end.
            row: first_row + sample as u64,
            column: column + 1,
            step_s: usual_s,
            found_s,
        }
        .into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn find(names: &[&str], units: Option<&[&str]>) -> Result<Option<TimeColumn>, FormatError> {
        let own = |list: &[&str]| list.iter().map(|s| s.to_string()).collect::<Vec<_>>();
        TimeColumn::find(&own(names), units.map(own).as_deref(), &[], 1)
    }

    #[test]
    fn time_columns_are_found_by_name_or_by_unit() {
        for name in ["time", "Time", "t", "TIME_S", "t_s", "Zeit", "time [s]", "Time (s)", "time_sec"] {
            assert_eq!(find(&["a", name], None), Ok(Some(TimeColumn { column: 1, scale: 1.0 })), "{name}");
        }
        for name in ["time_ms", "t [ms]", "zeit_ms"] {
            assert_eq!(find(&[name, "a"], None), Ok(Some(TimeColumn { column: 0, scale: 1e-3 })), "{name}");
        }
        for name in ["tension", "t_x", "time_lag", "drive_s", "temp"] {
            assert_eq!(find(&[name, "a"], None), Ok(None), "{name}");
        }
        assert_eq!(find(&["a", "x"], Some(&["kN", "s"])), Ok(Some(TimeColumn { column: 1, scale: 1.0 })));
        assert_eq!(find(&["t", "x"], Some(&["ms", "s"])), Ok(Some(TimeColumn { column: 0, scale: 1e-3 })));
        assert_eq!(find(&["t", "x"], Some(&["", "kN"])), Ok(Some(TimeColumn { column: 0, scale: 1.0 })));
        assert_eq!(find(&["a", "b"], Some(&["kN", "mm"])), Ok(None));
    }

    #[test]
    fn unclear_time_columns_are_refused_by_their_column() {
        let column = |found: Result<_, FormatError>| found.unwrap_err().column();
        assert_eq!(column(find(&["a", "t", "time"], None)), Some(3));
        assert_eq!(column(find(&["a", "b"], Some(&["s", "s"]))), Some(2));
        assert_eq!(column(find(&["a", "t"], Some(&["kN", "min"]))), Some(2));
        assert_eq!(column(find(&["time_s", "a"], Some(&["ms", "kN"]))), Some(1));
    }

    const SECONDS: TimeColumn = TimeColumn { column: 0, scale: 1.0 };

    fn rate(column: TimeColumn, times: &[f64], first_row: u64) -> Result<Option<f64>, FormatError> {
        let mut spool = Spool::in_memory();
        spool.add_columns(1);
        spool.extend(0, times.iter().copied()).unwrap();
        let found = column.sample_rate(&spool, Rounding::NONE, first_row);
        found.map(|found| found.map(|(rate, _)| rate)).map_err(ReadError::of_bytes)
    }

    /// The rate of `n` times at `rate_hz` as `format` writes them, and its error.
    fn written(
        n: usize,
        rate_hz: f64,
        lost: Option<usize>,
        format: impl Fn(f64) -> String,
    ) -> Option<(f64, f64)> {
        let (mut spool, mut rounding) = (Spool::in_memory(), Rounding::default());
        spool.add_columns(1);
        for i in (0..n).filter(|&i| Some(i) != lost) {
            let text = format(i as f64 / rate_hz);
            rounding.add(super::super::number::digits(text.as_bytes()).unwrap());
            spool.push(0, text.parse().unwrap()).unwrap();
        }
        SECONDS.sample_rate(&spool, rounding, 1).ok().flatten()
    }

    /// Four digits, as a spreadsheet's general format has them.
    fn four_digits(t: f64) -> String {
        let scientific = format!("{t:.3e}");
        let exponent: i32 = scientific.split_once('e').unwrap().1.parse().unwrap();
        format!("{t:.*}", (3 - exponent).max(0) as usize)
    }

    #[test]
    fn times_rounded_to_a_few_digits_give_the_rate_within_its_error() {
        for rate_hz in [512.0, 1000.0, 2048.0, 819.2] {
            for (format, digit) in [
                (&(|t: f64| format!("{t:.4}")) as &dyn Fn(f64) -> String, 1e-4),
                (&|t: f64| format!("{t:.3}"), 1e-3),
                (&four_digits, 1e-2),
                (&|t: f64| format!("{}", t as f32), 1e-6),
            ] {
                let n = 30_000;
                let (found, error) = written(n, rate_hz, None, format).unwrap();
                assert!((found / rate_hz - 1.0).abs() <= error + 1e-7, "{rate_hz} {digit}: {found} {error}");
                assert!(error <= 1.01 * digit * rate_hz / (n - 1) as f64, "{rate_hz} {digit}: {error}");
            }
        }
    }

    #[test]
    fn a_lost_sample_is_found_among_rounded_times_that_resolve_the_step() {
        for rate_hz in [512.0, 1000.0, 2048.0] {
            for lost in [1, 400, 15_000, 29_998] {
                assert_eq!(
                    written(30_000, rate_hz, Some(lost), |t| format!("{t:.5}")),
                    None,
                    "{rate_hz} {lost}"
                );
            }
        }
        assert_eq!(written(1000, 1000.0, Some(500), |t| format!("{t:.3}")), None);
        assert_eq!(written(1000, 1.0, Some(500), |t| format!("{t}")), None);
    }

    #[test]
    fn even_times_give_the_rate() {
        let times: Vec<f64> = (0..5000).map(|i| 7.0 + f64::from(i) / 1000.0).collect();
        let found = rate(SECONDS, &times, 2).unwrap().unwrap();
        // Times near 12 s are exact to 1e-15 s, their difference of 5 s to 1e-15 relative.
        assert!((found / 1000.0 - 1.0).abs() < 1e-12, "{found}");
        let milliseconds = TimeColumn { column: 0, scale: 1e-3 };
        assert_eq!(rate(milliseconds, &[0.0, 2.0, 4.0], 2), Ok(Some(500.0)));
        assert_eq!(rate(SECONDS, &[3.0], 2), Ok(None));
        assert_eq!(rate(SECONDS, &[], 2), Ok(None));
    }

    #[test]
    fn times_may_be_rounded_to_a_thousandth_of_the_step() {
        let times = |error: f64| -> Vec<f64> {
            (0..100).map(|i| f64::from(i) + if i == 50 { error } else { 0.0 }).collect()
        };
        assert_eq!(rate(SECONDS, &times(0.9e-3), 2), Ok(Some(1.0)));
        assert_eq!(rate(SECONDS, &times(1.1e-3), 2).unwrap_err().row(), Some(52));
    }

    #[test]
    fn a_gap_a_repeat_and_a_step_back_are_named_by_row() {
        let mut gap: Vec<f64> = (0..10).map(f64::from).collect();
        gap.remove(6);
        assert_eq!(
            rate(SECONDS, &gap, 3),
            Err(FormatError::CsvUnevenTime { row: 9, column: 1, step_s: 1.0, found_s: 2.0 })
        );
        let row = |times: &[f64]| rate(SECONDS, times, 1).unwrap_err().row();
        assert_eq!(row(&[0.0, 1.0, 1.0, 2.0, 3.0]), Some(3));
        assert_eq!(row(&[0.0, 1.0, 0.5, 2.0, 3.0]), Some(3));
        assert_eq!(row(&[1.0, 1.0]), Some(2));
        assert_eq!(row(&[3.0, 2.0, 1.0]), Some(2));
        assert_eq!(row(&[-f64::MAX, f64::MAX]), Some(2));
    }
}
