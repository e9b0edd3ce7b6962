//! Equal classes over a value span, for counts that are shown as tables.

use serde::{Deserialize, Serialize};

use crate::EngineError;

/// Most classes; bounds the from-to matrix at 65,536 numbers a signal.
pub const MAX_CLASSES: usize = 256;

/// Classes as a client may ask for them.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ClassSettings {
    /// Number of classes, 1..=256.
    pub count: usize,
    /// Lower limit in the channel's unit; left out: the smallest sample of the channel.
    pub lower: Option<f64>,
    /// Upper limit in the channel's unit; left out: the largest sample of the channel.
    pub upper: Option<f64>,
}

impl Default for ClassSettings {
    /// 64 classes over the signal's range.
    fn default() -> Self {
        Self { count: 64, lower: None, upper: None }
    }
}

impl ClassSettings {
    /// # Errors
    /// [`EngineError::Setting`] with `classes.count`, `classes.lower` or `classes.upper`.
    pub fn check(&self) -> Result<(), EngineError> {
        check_count(self.count)?;
        for (setting, limit) in [("classes.lower", self.lower), ("classes.upper", self.upper)] {
            if let Some(v) = limit
                && !v.is_finite()
            {
                return Err(refuse(setting, v, "a finite number"));
            }
        }
        if let (Some(lower), Some(upper)) = (self.lower, self.upper)
            && lower >= upper
        {
            return Err(refuse("classes.upper", upper, &format!("above classes.lower ({lower})")));
        }
        Ok(())
    }

    /// Classes that hold every sample of `signals`. Limits that are left out come from all signals
    /// together, so that prediction and target share classes. A constant signal gets classes around its
    /// value.
    ///
    /// # Errors
    /// Those of [`check`](Self::check); a limit that leaves samples out; a span beyond `f64`.
    pub fn over(&self, signals: &[&[f64]]) -> Result<Classes, EngineError> {
        self.check()?;
        let samples = || signals.iter().flat_map(|s| s.iter().copied());
        let smallest = samples().fold(f64::INFINITY, f64::min);
        let largest = samples().fold(f64::NEG_INFINITY, f64::max);
        // Without a sample any limits hold all of them.
        let (smallest, largest) = if smallest <= largest { (smallest, largest) } else { (0.0, 0.0) };
        let (mut lower, mut upper) = (self.lower.unwrap_or(smallest), self.upper.unwrap_or(largest));
        if lower > smallest {
            return Err(refuse("classes.lower", lower, &format!("at most the smallest sample, {smallest}")));
        }
        if upper < largest {
            return Err(refuse("classes.upper", upper, &format!("at least the largest sample, {largest}")));
        }
        if lower == upper {
            let half = 0.5 * lower.abs().max(1.0);
            if self.lower.is_none() {
                lower -= half;
            }
            if self.upper.is_none() {
                upper += half;
            }
        }
        Classes::new(lower, upper, self.count)
    }
}

/// `count` classes of equal width over `lower..=upper`; a class holds its lower edge.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Classes {
    lower: f64,
    upper: f64,
    count: usize,
}

impl Classes {
    /// # Errors
    /// [`EngineError::Setting`] when the count is not in 1..=256 or the limits give no width.
    pub fn new(lower: f64, upper: f64, count: usize) -> Result<Self, EngineError> {
        check_count(count)?;
        let classes = Self { lower, upper, count };
        let width = classes.width();
        if !(lower.is_finite() && width.is_finite() && lower + width > lower) {
            let limit =
                format!("so far above classes.lower ({lower}) that {count} classes have a finite width");
            return Err(refuse("classes.upper", upper, &limit));
        }
        Ok(classes)
    }

    /// Number of classes.
    pub fn count(&self) -> usize {
        self.count
    }

    /// Width of one class in the channel's unit.
    pub fn width(&self) -> f64 {
        (self.upper - self.lower) / self.count as f64
    }

    /// Class of `value`; a value outside belongs to the first or last class.
    pub fn index(&self, value: f64) -> usize {
        // The cast saturates, so values below the lower limit come out as 0.
        (((value - self.lower) / self.width()) as usize).min(self.count - 1)
    }

    /// Middle of a class in the channel's unit.
    pub fn middle(&self, class: usize) -> f64 {
        self.lower + (class as f64 + 0.5) * self.width()
    }

    /// The `count + 1` edges; first and last are the limits themselves.
    pub fn edges(&self) -> Vec<f64> {
        let width = self.width();
        (0..=self.count)
            .map(|i| if i == self.count { self.upper } else { self.lower + i as f64 * width })
            .collect()
    }
}

fn check_count(count: usize) -> Result<(), EngineError> {
    if (1..=MAX_CLASSES).contains(&count) {
        return Ok(());
    }
    Err(EngineError::Setting {
        setting: "classes.count",
        found: count.to_string(),
        limit: format!("from 1 to {MAX_CLASSES}"),
    })
}

fn refuse(setting: &'static str, found: f64, limit: &str) -> EngineError {
    EngineError::Setting { setting, found: found.to_string(), limit: limit.into() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn classes_cover_all_signals_together() {
        let classes =
            ClassSettings { count: 4, ..Default::default() }.over(&[&[0.0, 1.0], &[-3.0, 0.5]]).unwrap();
        assert_eq!(classes.edges(), [-3.0, -2.0, -1.0, 0.0, 1.0]);
        assert_eq!(classes.index(-3.0), 0);
        assert_eq!(classes.index(-2.0), 1);
        assert_eq!(classes.index(0.99), 3);
        assert_eq!(classes.index(1.0), 3, "the upper limit belongs to the last class");
    }

    #[test]
    fn a_constant_signal_lies_inside_its_classes() {
        for v in [0.0, 7.5, -1e12] {
            let classes = ClassSettings::default().over(&[&[v, v]]).unwrap();
            let edges = classes.edges();
            assert!(edges[0] < v && v < edges[64], "{v}");
        }
        let fixed = ClassSettings { lower: Some(2.0), ..Default::default() }.over(&[&[2.0]]).unwrap();
        assert_eq!(fixed.edges()[0], 2.0);
    }

    #[test]
    fn limits_that_leave_samples_out_are_refused_by_name() {
        let name = |settings: ClassSettings, x: &[f64]| match settings.over(&[x]) {
            Err(EngineError::Setting { setting, .. }) => setting,
            other => panic!("{other:?}"),
        };
        let base = ClassSettings::default();
        assert_eq!(name(ClassSettings { lower: Some(0.5), ..base }, &[0.0, 1.0]), "classes.lower");
        assert_eq!(name(ClassSettings { upper: Some(0.5), ..base }, &[0.0, 1.0]), "classes.upper");
        assert_eq!(name(ClassSettings { count: 0, ..base }, &[0.0, 1.0]), "classes.count");
        assert_eq!(name(ClassSettings { count: 257, ..base }, &[0.0, 1.0]), "classes.count");
        assert_eq!(name(ClassSettings { lower: Some(f64::NAN), ..base }, &[0.0]), "classes.lower");
        assert_eq!(
            name(ClassSettings { lower: Some(1.0), upper: Some(1.0), ..base }, &[1.0]),
            "classes.upper"
        );
        assert_eq!(name(base, &[-f64::MAX, f64::MAX]), "classes.upper", "the span overflows");
    }

    #[test]
    fn settings_have_defaults_and_refuse_unknown_fields() {
        assert_eq!(serde_json::from_str::<ClassSettings>("{}").unwrap(), ClassSettings::default());
        assert!(serde_json::from_str::<ClassSettings>(r#"{"width": 1}"#).is_err());
    }
}
