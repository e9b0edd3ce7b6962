//! Times that a file gives for its samples, and the sample rate that even ones give.

use std::io;

use super::Spool;

/// Number of steps, spread over the file, from which the usual step is found.
const STEPS: usize = 10_000;

/// Largest deviation of a step, relative to it, but for the rounding of its digits.
const TOLERANCE: f64 = 1e-3;

/// Largest deviation that is put down to times of single precision, relative to the step.
const SINGLE: f64 = 0.1;

/// Fewest rows whose uneven steps are put down to rounding.
const ROUNDED_FROM_ROWS: usize = 20;

/// Largest share of the sample rate that rounding may leave open.
const ROUNDED_MOST: f64 = 0.1;

/// Share of the steps that rounding makes uneven, at least.
const ROUNDED_SHARE: f64 = 0.02;

/// What the times of a file are.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Even {
    /// One time or none: no step.
    Single,
    /// Even steps.
    Rate {
        /// Sample rate.
        rate_hz: f64,
        /// Its largest relative error by rounded times.
        error: f64,
    },
    /// Uneven steps.
    Not {
        /// The first sample whose step is not the usual one.
        sample: usize,
        /// The step of most samples, seconds.
        usual_s: f64,
        /// The step to this sample, seconds.
        found_s: f64,
    },
}

/// The digits that the times of a file are written with: the most behind the mark, and the most from the first that
/// is not zero.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Rounding {
    decimals: i32,
    significant: i32,
}

impl Rounding {
    /// Times that are written as binary numbers: their last digit is that of a double.
    pub(super) const NONE: Self = Self { decimals: 300, significant: 17 };

    /// Takes the digits of one more time.
    pub(super) fn add(&mut self, (decimals, significant): (i32, i32)) {
        self.decimals = self.decimals.max(decimals);
        self.significant = self.significant.max(significant);
    }

    /// Times with this many digits behind the mark.
    pub(super) fn add_decimals(&mut self, decimals: i32) {
        self.add((decimals, i32::from(i16::MAX)));
    }

    /// The last digit of a time: fixed digits behind the mark have one for all, a fixed number of digits has a
    /// coarser one for larger times.
    fn last_digit(self, time: f64) -> f64 {
        let leading = if time == 0.0 { 0.0 } else { time.abs().log10().floor() };
        let significant = 10f64.powf(leading + 1.0 - f64::from(self.significant));
        significant.max(10f64.powi(-self.decimals))
    }
}

/// The rate of times (one column) that rise in even steps of `scale` seconds a unit.
///
/// # Errors
/// Those of the file of `times`.
pub(super) fn rate(times: &Spool, rounding: Rounding, scale: f64) -> io::Result<Even> {
    let n = times.len(0);
    if n < 2 {
        return Ok(Even::Single);
    }
    let grid = Grid { first: times.at(0, 0)?, last: times.at(0, n - 1)?, n };
    let step = grid.step();
    let rate_hz = 1.0 / (step * scale);
    let mut usual = None;
    if step > 0.0 && step.is_finite() && rate_hz.is_finite() {
        // Compared with the grid and not step by step: rounded times may not drift.
        // Times of single precision are as far off as their last bit.
        let exact = |t: f64| TOLERANCE * step + (f64::from(f32::EPSILON) / 2.0 * t.abs()).min(SINGLE * step);
        if times.position(0, |i, t| grid.is_off(i, t, exact(t)))?.is_none() {
            return Ok(Even::Rate { rate_hz, error: 0.0 });
        }
        let last_digit = rounding.last_digit(grid.last);
        let rounded = |t: f64| exact(t) + rounding.last_digit(t) + last_digit;
        if n >= ROUNDED_FROM_ROWS
            && last_digit <= ROUNDED_MOST * (grid.last - grid.first)
            && times.position(0, |i, t| grid.is_off(i, t, rounded(t)))?.is_none()
            && is_rounded(times, rounding, *usual.insert(usual_step(times, &grid)?))?
        {
            return Ok(Even::Rate { rate_hz, error: last_digit / (grid.last - grid.first) });
        }
    }
    let usual = usual.map_or_else(|| usual_step(times, &grid), Ok)?;
    let mut before = grid.first;
    let uneven = times.position(0, |i, t| {
        let step = t - before;
        before = t;
        i > 0 && (step <= 0.0 || (step - usual).abs() > TOLERANCE * usual.abs())
    })?;
    // When every step is within the limit the times drift, and the last row is the farthest off.
    let place = uneven.unwrap_or(n - 1);
    Ok(Even::Not {
        sample: place,
        usual_s: usual * scale,
        found_s: (times.at(0, place)? - times.at(0, place - 1)?) * scale,
    })
}

/// Even times from the first to the last.
struct Grid {
    first: f64,
    last: f64,
    n: usize,
}

impl Grid {
    fn step(&self) -> f64 {
        (self.last - self.first) / (self.n - 1) as f64
    }

    fn is_off(&self, index: usize, time: f64, tolerance: f64) -> bool {
        let distance = (time - (self.first + index as f64 * self.step())).abs();
        distance.is_nan() || distance > tolerance
    }
}

/// The step that half of the rows stay below.
fn usual_step(times: &Spool, grid: &Grid) -> io::Result<f64> {
    let every = grid.n / STEPS + 1;
    let (mut steps, mut before) = (Vec::new(), grid.first);
    times.position(0, |i, t| {
        if i > 0 && (i - 1) % every == 0 {
            steps.push(t - before);
        }
        before = t;
        false
    })?;
    let middle = steps.len() / 2;
    Ok(*steps.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Whether rounding explains uneven steps. Where the digits resolve the usual step, a rounded step is off again and
/// again, and a lost sample is off once.
fn is_rounded(times: &Spool, rounding: Rounding, usual: f64) -> io::Result<bool> {
    let (mut resolved, mut off, mut before) = (0_usize, 0_usize, None);
    times.position(0, |_, t| {
        if let Some(before) = before.replace(t) {
            let digit = rounding.last_digit(t);
            if digit <= 1.001 * usual {
                resolved += 1;
                off += usize::from((t - before - usual).abs() > digit / 2.0);
            }
        }
        false
    })?;
    Ok(off == 0 || off as f64 >= ROUNDED_SHARE * resolved as f64)
}

/// `Some` for the name of a time column, with the unit that the name holds, if any.
pub(super) fn unit_of_time(name: &str) -> Option<Option<&'static str>> {
    let lower = name.to_lowercase();
    let (stem, unit) = match lower.split_once(['[', '(']) {
        Some((stem, unit)) => (stem.trim(), Some(unit.trim_end_matches([']', ')']).trim())),
        None => match lower.rsplit_once('_') {
            Some((stem, unit)) => (stem, Some(unit)),
            None => (lower.as_str(), None),
        },
    };
    if !matches!(stem, "time" | "t" | "zeit" | "zeitkanal" | "time channel") {
        return None;
    }
    match unit {
        None => Some(None),
        Some("s" | "sec") => Some(Some("s")),
        Some("ms") => Some(Some("ms")),
        Some(_) => None,
    }
}

/// Seconds a unit of times by the name of their column or variable; `None` for a name of something else.
pub(super) fn seconds_by_name(name: &str) -> Option<f64> {
    unit_of_time(name).map(|unit| if unit == Some("ms") { 1e-3 } else { 1.0 })
}
