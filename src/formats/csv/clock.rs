//! Columns of dates and times of the day.

use std::io::Read;

use super::rows::Rows;
use super::stamp::stamp;
use crate::formats::FormatError;

/// The columns that give the time of a sample, and what was read of them.
#[derive(Debug)]
pub(super) struct ClockColumns {
    /// Column with the time of the day, and the date if it has both.
    time: usize,
    /// Column with the date alone.
    date: Option<usize>,
    /// First day, or that of the clock before any date.
    first_day: Option<i32>,
    /// Days that passed on a clock without date.
    midnights: i32,
    /// Time of the day of the row before.
    before: f64,
}

const DAY_S: f64 = 86_400.0;

impl ClockColumns {
    /// The columns among those that hold date-times in the current row; `None` if no column has a time of the day.
    ///
    /// # Errors
    /// `csv.time_column` for two columns of times of the day.
    pub(super) fn find(rows: &Rows<impl Read>, stamps: &[bool]) -> Result<Option<Self>, FormatError> {
        let (mut time, mut date) = (None, None);
        for (column, cell) in rows.cells().iter().enumerate() {
            let Some(found) = stamps.get(column).filter(|&&s| s).and_then(|_| stamp(cell)) else { continue };
            match (found.clock, time) {
                (None, _) => date = date.or(Some(column)),
                (Some(_), None) => time = Some((column, found.day.is_some())),
                (Some(_), Some(_)) => {
                    let reason = "two columns have times of the day";
                    return Err(FormatError::CsvTime { row: rows.row(), column: column + 1, reason });
                }
            }
        }
        Ok(time.map(|(time, has_day)| Self {
            time,
            date: date.filter(|_| !has_day),
            first_day: None,
            midnights: 0,
            before: 0.0,
        }))
    }

    /// Index of the column that errors name.
    pub(super) fn time_column(&self) -> usize {
        self.time
    }

    /// Seconds from the midnight before the first sample to the current row, and the digits behind the second's
    /// mark.
    ///
    /// # Errors
    /// `csv.time_column` for a cell that holds no time or no date.
    pub(super) fn read(&mut self, rows: &Rows<impl Read>) -> Result<(f64, i32), FormatError> {
        let refuse =
            |column: usize, reason| Err(FormatError::CsvTime { row: rows.row(), column: column + 1, reason });
        let at = |column: usize| rows.cells().get(column).and_then(stamp);
        let Some((clock, own_day)) = at(self.time).and_then(|found| Some((found.clock?, found.day))) else {
            return refuse(self.time, "the cell holds no time of the day");
        };
        let day = match self.date {
            None => own_day,
            Some(date) => match at(date).and_then(|found| found.day) {
                None => return refuse(date, "the cell holds no date"),
                day => day,
            },
        };
        let day = day.unwrap_or_else(|| {
            // A clock without date that falls by more than half a day has passed midnight.
            self.midnights += i32::from(clock.seconds + DAY_S / 2.0 < self.before);
            self.midnights
        });
        self.before = clock.seconds;
        let first = *self.first_day.get_or_insert(day);
        Ok((f64::from(day - first) * DAY_S + clock.seconds, clock.decimals))
    }
}
