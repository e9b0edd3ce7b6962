//! Shares with their intervals, and quantiles.

/// A count out of a total.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Share {
    pub of: usize,
    pub all: usize,
}

impl Share {
    /// The count of items for which a condition holds.
    pub fn count<T>(items: impl IntoIterator<Item = T>, holds: impl Fn(&T) -> bool) -> Self {
        items
            .into_iter()
            .fold(Self::default(), |s, item| Self { of: s.of + usize::from(holds(&item)), all: s.all + 1 })
    }

    /// The share; 0 for an empty total.
    pub fn value(self) -> f64 {
        self.of as f64 / self.all.max(1) as f64
    }

    /// Wilson's 95 % interval (Wilson 1927, J. Am. Stat. Assoc. 22).
    pub fn interval(self) -> [f64; 2] {
        if self.all == 0 {
            return [0.0, 1.0];
        }
        const Z2: f64 = 1.959_964 * 1.959_964;
        let (n, p) = (self.all as f64, self.value());
        let centre = (p + Z2 / (2.0 * n)) / (1.0 + Z2 / n);
        let half = (Z2 * (p * (1.0 - p) / n + Z2 / (4.0 * n * n))).sqrt() / (1.0 + Z2 / n);
        [(centre - half).max(0.0), (centre + half).min(1.0)]
    }
}

/// The value below which a share `q` of the values lies; `None` without values.
pub fn quantile(values: impl IntoIterator<Item = f64>, q: f64) -> Option<f64> {
    let mut sorted: Vec<f64> = values.into_iter().collect();
    sorted.sort_by(f64::total_cmp);
    let at = ((sorted.len() as f64 * q).ceil() as usize).saturating_sub(1);
    sorted.get(at).copied()
}

/// Median.
pub fn median(values: impl IntoIterator<Item = f64>) -> Option<f64> {
    let mut sorted: Vec<f64> = values.into_iter().collect();
    sorted.sort_by(f64::total_cmp);
    let n = sorted.len();
    if n == 0 { None } else { Some(0.5 * (sorted[(n - 1) / 2] + sorted[n / 2])) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wilsons_interval_is_the_published_one() {
        // Newcombe 1998, Statist. Med. 17, table I, method 3: 81 of 263, 15 of 148, 0 of 20.
        let cases = [((81, 263), [0.2553, 0.3662]), ((15, 148), [0.0624, 0.1605]), ((0, 20), [0.0, 0.1611])];
        for ((of, all), expected) in cases {
            let found = Share { of, all }.interval();
            assert!((found[0] - expected[0]).abs() < 5e-5 && (found[1] - expected[1]).abs() < 5e-5);
        }
    }

    #[test]
    fn quantiles_of_few_values_are_values() {
        let ten = || (1..=10).map(f64::from);
        assert_eq!(median(ten()), Some(5.5));
        assert_eq!(quantile(ten(), 0.9), Some(9.0));
        assert_eq!(quantile([3.0], 0.9), Some(3.0));
        assert_eq!((median([]), quantile([], 0.5)), (None, None));
    }
}
