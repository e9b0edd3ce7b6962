//! A row of the table: a figure and its bar.

use serde_json::{Value, json};

use super::statistics::Share;

/// A figure.
#[derive(Debug, Clone, Copy)]
pub enum Figure {
    /// With Wilson's interval.
    Share(Share),
    /// `None` where nothing could be measured.
    Number(Option<f64>),
}

/// The bar that a figure has to reach.
#[derive(Debug, Clone, Copy)]
pub enum Bar {
    AtLeast(f64),
    AtMost(f64),
    Below(f64),
    Between(f64, f64),
    /// Shown, not judged.
    None,
}

/// One line of the table.
#[derive(Debug, Clone)]
pub struct Row {
    pub suite: &'static str,
    pub name: String,
    pub figure: Figure,
    pub bar: Bar,
}

impl Row {
    pub fn share(suite: &'static str, name: &str, share: Share, bar: Bar) -> Self {
        Self { suite, name: name.into(), figure: Figure::Share(share), bar }
    }

    pub fn number(suite: &'static str, name: &str, value: Option<f64>, bar: Bar) -> Self {
        Self { suite, name: name.into(), figure: Figure::Number(value), bar }
    }

    /// Suite and figure.
    pub fn title(&self) -> String {
        format!("{}: {}", self.suite, self.name)
    }

    fn value(&self) -> Option<f64> {
        match self.figure {
            Figure::Share(share) => (share.all > 0).then(|| share.value()),
            Figure::Number(value) => value,
        }
    }

    /// Whether the bar is reached; `None` without one, and where nothing could exceed it for want of cases. Any other
    /// figure that could not be measured misses it.
    pub fn passes(&self) -> Option<bool> {
        let reached = |test: &dyn Fn(f64) -> bool| Some(self.value().is_some_and(test));
        match self.bar {
            Bar::AtMost(_) if matches!(self.figure, Figure::Share(share) if share.all == 0) => None,
            Bar::AtLeast(bar) => reached(&|v| v >= bar),
            Bar::AtMost(bar) => reached(&|v| v <= bar),
            Bar::Below(bar) => reached(&|v| v < bar),
            Bar::Between(low, high) => reached(&|v| v >= low && v <= high),
            Bar::None => None,
        }
    }

    /// Suite, figure, interval, bar, verdict.
    pub fn cells(&self) -> [String; 5] {
        let percent = matches!(self.figure, Figure::Share(_));
        let show = |v: f64| if percent { format!("{:.1} %", 100.0 * v) } else { format!("{v:.3}") };
        let (value, interval) = match self.figure {
            Figure::Share(share) if share.all == 0 => ("none of 0".into(), String::new()),
            Figure::Share(share) => {
                let [low, high] = share.interval();
                (
                    format!("{} ({} of {})", show(share.value()), share.of, share.all),
                    format!("{:.1}-{:.1} %", 100.0 * low, 100.0 * high),
                )
            }
            Figure::Number(value) => (value.map_or("not measured".into(), show), String::new()),
        };
        let bar = match self.bar {
            Bar::AtLeast(bar) => format!(">= {}", show(bar)),
            Bar::AtMost(bar) => format!("<= {}", show(bar)),
            Bar::Below(bar) => format!("< {}", show(bar)),
            Bar::Between(low, high) => format!("{} to {}", show(low), show(high)),
            Bar::None => String::new(),
        };
        let verdict = match self.passes() {
            Some(true) => "PASS",
            Some(false) => "MISS",
            None => "",
        };
        [self.title(), value, interval, bar, verdict.into()]
    }

    /// For programs.
    pub fn json(&self) -> Value {
        let share = |s: Share| json!({"of": s.of, "all": s.all, "interval95": s.interval()});
        let detail = if let Figure::Share(s) = self.figure { share(s) } else { Value::Null };
        json!({"suite": self.suite, "figure": self.name, "value": self.value(), "share": detail,
               "bar": self.cells()[3], "passes": self.passes()})
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn without_cases_nothing_exceeds_a_bar_and_nothing_reaches_one() {
        let of = |bar| Row::share("place", "blamed", Share { of: 0, all: 0 }, bar).passes();
        assert_eq!([of(Bar::AtMost(0.03)), of(Bar::AtLeast(0.85))], [None, Some(false)]);
        assert_eq!(Row::number("time", "a case, s", None, Bar::AtMost(5.0)).passes(), Some(false));
    }
}
