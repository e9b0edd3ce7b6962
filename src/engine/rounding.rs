//! Numbers for people: as short as they would write them.

/// The value rounded to so many significant digits (at least one), which `Display` then prints
/// without the digits that a computation left behind: 0.004999999999999893 becomes 0.005.
pub fn rounded(value: f64, digits: usize) -> f64 {
    format!("{value:.*e}", digits.max(1) - 1).parse().unwrap_or(value)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_computation_leaves_behind_goes() {
        for (value, text) in [
            (0.004999999999999893, "0.005"),
            (199.99999999999997, "200"),
            (-0.1 - 0.2, "-0.3"),
            (0.0, "0"),
            (1.0 / 3.0, "0.3333333333"),
            (1234567.0, "1234567"),
        ] {
            assert_eq!(rounded(value, 10).to_string(), text);
        }
        assert_eq!(rounded(51.7578125, 3), 51.8);
        assert!(rounded(f64::NAN, 10).is_nan() && rounded(f64::INFINITY, 10).is_infinite());
    }
}
