//! Axes: positions of values, and ticks.

use crate::ui::text::{number, superscript};

/// Decades that a logarithmic axis shows at most.
const DECADES: f64 = 9.0;

/// Scale of an axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Scale {
    /// Linear.
    Linear,
    /// Linear, for whole numbers: no tick lies between them.
    Count,
    /// Logarithmic; values that are not positive lie below the axis.
    Log,
    /// For shares close to 1: linear in the logarithm of the difference from 1.
    ToOne,
}

/// An axis from `low` to `high`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Axis {
    scale: Scale,
    low: f64,
    high: f64,
}

/// A tick: a position with a name.
#[derive(Debug, Clone, PartialEq)]
pub struct Tick {
    pub value: f64,
    pub label: String,
}

impl Axis {
    /// An axis over exactly this range; an empty range is widened.
    pub fn exact(scale: Scale, low: f64, high: f64) -> Self {
        let usable = |x: f64| x.is_finite() && (scale != Scale::Log || x > 0.0);
        let (mut low, mut high) = match (usable(low), usable(high)) {
            (true, true) => (low.min(high), low.max(high)),
            (true, false) => (low, low),
            (false, true) => (high, high),
            (false, false) => (1.0, 1.0),
        };
        match scale {
            Scale::Linear | Scale::Count if high - low <= 1e-12 * high.abs().max(low.abs()) => {
                let half = if low == 0.0 { 1.0 } else { 0.5 * low.abs() };
                (low, high) = (low - half, high + half);
            }
            Scale::Log => {
                if high <= low * (1.0 + 1e-9) {
                    (low, high) = (low / 3.0, high * 3.0);
                }
                low = low.max(high / 10.0_f64.powf(DECADES));
            }
            Scale::ToOne => (low, high) = (0.0, high.clamp(0.5, 0.9999)),
            Scale::Linear | Scale::Count => {}
        }
        Self { scale, low, high }
    }

    /// An axis that holds all values, with round ends and, where it is linear, a small margin.
    pub fn around(scale: Scale, values: impl IntoIterator<Item = f64>) -> Self {
        let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
        for x in values {
            if x.is_finite() && (scale != Scale::Log || x > 0.0) {
                (low, high) = (low.min(x), high.max(x));
            }
        }
        let exact = Self::exact(scale, low, high);
        match scale {
            Scale::Linear | Scale::Count => {
                let step = exact.step(8.0);
                let (low, high) = ((exact.low / step).floor() * step, (exact.high / step).ceil() * step);
                Self { low, high, ..exact }
            }
            Scale::Log => {
                let round = |x: f64, up: bool| {
                    let decade = 10.0_f64.powf(x.log10().floor());
                    let steps = [1.0, 2.0, 5.0, 10.0].map(|m| m * decade);
                    if up {
                        steps.into_iter().find(|s| *s >= x * 0.999).unwrap_or(x)
                    } else {
                        steps.into_iter().rev().find(|s| *s <= x * 1.001).unwrap_or(x)
                    }
                };
                Self { low: round(exact.low, false), high: round(exact.high, true), ..exact }
            }
            Scale::ToOne => exact,
        }
    }

    /// Position of a value, 0 at the low end and 1 at the high end, limited to the axis.
    pub fn place(&self, x: f64) -> f64 {
        let share = match self.scale {
            Scale::Linear | Scale::Count => (x - self.low) / (self.high - self.low),
            Scale::Log if x > 0.0 => (x / self.low).ln() / (self.high / self.low).ln(),
            Scale::Log => 0.0,
            Scale::ToOne => (1.0 - x).max(1.0 - self.high).ln() / (1.0 - self.high).ln(),
        };
        if share.is_finite() && !x.is_nan() { share.clamp(0.0, 1.0) } else { 0.0 }
    }

    /// Whether a value lies on the axis.
    pub fn holds(&self, x: f64) -> bool {
        let air = 1e-9 * (self.high - self.low);
        x >= self.low - air && x <= self.high + air
    }

    /// About `wanted` ticks with names.
    pub fn ticks(&self, wanted: usize) -> Vec<Tick> {
        match self.scale {
            Scale::Linear | Scale::Count => self.linear_ticks(wanted.max(2) as f64),
            Scale::Log => self.log_ticks(wanted.max(2) as f64),
            Scale::ToOne => [0.0, 0.5, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.998, 0.999, 0.9999]
                .into_iter()
                .filter(|x| self.holds(*x))
                .map(|x| Tick { value: x, label: number(100.0 * x) })
                .map(|tick| if tick.value > 0.999 { Tick { label: "99.99".into(), ..tick } } else { tick })
                .collect(),
        }
    }

    /// The step of a linear axis with at most about `wanted` ticks.
    fn step(&self, wanted: f64) -> f64 {
        let step = step(self.high - self.low, wanted);
        if self.scale == Scale::Count { step.max(1.0) } else { step }
    }

    fn linear_ticks(&self, wanted: f64) -> Vec<Tick> {
        let step = self.step(wanted);
        let first = (self.low / step - 1e-6).ceil() as i64;
        let last = (self.high / step + 1e-6).floor() as i64;
        (first..=last)
            .map(|k| k as f64 * step)
            .map(|value| Tick { value, label: label(value, step) })
            .collect()
    }

    fn log_ticks(&self, wanted: f64) -> Vec<Tick> {
        let (from, to) = (self.low.log10().floor() as i32, self.high.log10().ceil() as i32);
        let decades = (self.high / self.low).log10();
        let multiples: &[f64] = if decades > 2.5 { &[1.0] } else { &[1.0, 2.0, 5.0] };
        let every = if decades > 2.5 { (decades / wanted).ceil().max(1.0) as i32 } else { 1 };
        let mut out = Vec::new();
        for decade in (from..=to).filter(|d| d.rem_euclid(every) == 0) {
            for m in multiples {
                let value = m * 10.0_f64.powi(decade);
                if value >= self.low * (1.0 - 1e-9) && value <= self.high * (1.0 + 1e-9) {
                    let plain = (1e-3..1e5).contains(&value);
                    let label =
                        if plain || *m > 1.0 { number(value) } else { format!("10{}", superscript(decade)) };
                    out.push(Tick { value, label });
                }
            }
        }
        out
    }
}

/// A step of 1, 2 or 5 times a power of ten that cuts `range` into at most about `wanted` pieces.
fn step(range: f64, wanted: f64) -> f64 {
    let raw = range / wanted;
    let decade = 10.0_f64.powf(raw.log10().floor());
    let multiple = [1.0, 2.0, 5.0, 10.0].into_iter().find(|m| m * decade >= raw * (1.0 - 1e-9));
    (multiple.unwrap_or(10.0) * decade).max(f64::MIN_POSITIVE)
}

/// As many decimals as the step has.
fn label(value: f64, step: f64) -> String {
    let size = value.abs().max(step);
    if !(1e-4..1e6).contains(&size) {
        return number(value);
    }
    let decimals = (-step.log10().floor()).max(0.0) as usize;
    let text = format!("{value:.decimals$}");
    if text.trim_start_matches(['-', '0', '.']).is_empty() { "0".into() } else { text.replace('-', "−") }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labels(axis: Axis, wanted: usize) -> Vec<String> {
        axis.ticks(wanted).into_iter().map(|t| t.label).collect()
    }

    #[test]
    fn linear_ticks_are_round_and_inside() {
        let axis = Axis::exact(Scale::Linear, -0.34, 1.07);
        assert_eq!(labels(axis, 6), ["0", "0.5", "1.0"]);
        assert_eq!(labels(Axis::exact(Scale::Linear, 0.0, 1.0), 5), ["0", "0.2", "0.4", "0.6", "0.8", "1.0"]);
        for tick in axis.ticks(6) {
            assert!(axis.holds(tick.value));
        }
        assert_eq!(labels(Axis::exact(Scale::Count, 0.5, 2.5), 16), ["1", "2"]);
        assert_eq!(labels(Axis::exact(Scale::Count, 0.0, 40.0), 4), ["0", "10", "20", "30", "40"]);
        let tiny = Axis::exact(Scale::Linear, 0.0, 3e-7);
        assert_eq!(labels(tiny, 3)[1], "1·10⁻⁷");
    }

    #[test]
    fn log_ticks_are_decades_or_finer_where_there_are_few() {
        assert_eq!(labels(Axis::exact(Scale::Log, 0.5, 60.0), 6), ["0.5", "1", "2", "5", "10", "20", "50"]);
        assert_eq!(labels(Axis::exact(Scale::Log, 1e-6, 1.0), 4), ["10⁻⁶", "10⁻⁴", "0.01", "1"]);
    }

    #[test]
    fn places_run_from_end_to_end_and_are_held_there() {
        let log = Axis::exact(Scale::Log, 1.0, 100.0);
        assert!((log.place(10.0) - 0.5).abs() < 1e-12);
        assert_eq!((log.place(0.0), log.place(1e9), log.place(-3.0)), (0.0, 1.0, 0.0));
        let closure = Axis::exact(Scale::ToOne, 0.0, 0.9999);
        assert!((closure.place(0.99) - 0.5).abs() < 1e-9);
        assert_eq!((closure.place(1.0), closure.place(-0.4)), (1.0, 0.0));
    }

    #[test]
    fn no_range_is_too_odd_for_an_axis() {
        for scale in [Scale::Linear, Scale::Count, Scale::Log, Scale::ToOne] {
            for values in [
                vec![],
                vec![0.0],
                vec![5.0, 5.0],
                vec![f64::NAN],
                vec![-3.0, f64::INFINITY],
                vec![1e-300, 1e300],
            ] {
                let axis = Axis::around(scale, values.iter().copied());
                assert!(axis.low < axis.high, "{scale:?} {values:?}");
                let ticks = axis.ticks(6);
                assert!(ticks.len() < 40, "{scale:?} {values:?}");
                assert!(ticks.iter().all(|t| axis.place(t.value).is_finite()));
                assert!(axis.place(values.first().copied().unwrap_or(0.0)).is_finite());
            }
        }
    }
}
