//! The sample rate behind a sample interval that was rounded to a few digits.

use super::FormatError;

/// `1 / step_s`. A step that is known within the share `rounding` (1e-6: one part in a million) stands for a whole
/// number of hertz, for a tenth of one or for a whole number of seconds where there is one so near: 4.882813E-04 s
/// is 2048 Hz, 1.22070E-03 s is 819.2 Hz.
///
/// # Errors
/// [`FormatError::SampleRate`] if the step is not positive, or so small that the rate is not finite.
pub(super) fn rate(step_s: f64, rounding: f64) -> Result<f64, FormatError> {
    let found = step_s.recip();
    // A NaN is no step either.
    if !(step_s > 0.0 && found.is_finite()) {
        return Err(FormatError::SampleRate { found });
    }
    let simple = [found.round(), (10.0 * found).round() / 10.0, step_s.round().recip()];
    let near = |rate: &f64| *rate > 0.0 && (rate - found).abs() <= rounding * found;
    Ok(simple.into_iter().find(near).unwrap_or(found))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rate_is_simple_where_the_digits_of_the_step_allow_it() {
        for (step, rounding, expected) in [
            (4.882813e-4, 1e-6, 2048.0),
            (1.22070e-3, 5e-6, 819.2),
            (1.22070e-3, 1e-6, 1.0 / 1.22070e-3),
            (1.52588e-5, 5e-6, 65536.0),
            (0.03, 1e-6, 1.0 / 0.03),
            (30.0, 1e-6, 1.0 / 30.0),
            (30.00001, 1e-6, 1.0 / 30.0),
            (2.5, 1e-6, 0.4),
        ] {
            assert_eq!(rate(step, rounding), Ok(expected), "{step}");
        }
    }

    #[test]
    fn a_step_that_makes_no_rate_is_refused() {
        for step in [0.0, -0.0, -0.01, f64::NAN, 5e-324] {
            assert_eq!(rate(step, 1e-6).unwrap_err().code(), "run.sample_rate", "{step}");
        }
        assert_eq!(rate(f64::INFINITY, 1e-6), Ok(0.0), "the run's own check refuses it");
    }
}
