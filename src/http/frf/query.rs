//! Query parameters of a request for an FRF.

use std::ops::RangeInclusive;

use crate::engine::frf::{DEFAULT_RIDGE, Frf};
use crate::http::params::{Params, invalid};
use crate::http::problem::Answer;

/// Most values of one array in an answer: larger FRFs are read in bands.
const MAX_VALUES: usize = 2_500_000;

/// One array of an answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    /// Frequencies.
    FreqHz,
    /// `H`, or its inverse.
    H,
    /// Ordinary coherence.
    Coherence,
    /// Multiple coherence.
    MultipleCoherence,
    /// Condition number.
    Condition,
    /// Radius of confidence.
    Confidence,
}

impl Part {
    /// All parts, in the order of an answer.
    pub const ALL: [Self; 6] =
        [Self::FreqHz, Self::H, Self::Coherence, Self::MultipleCoherence, Self::Condition, Self::Confidence];

    /// The word of the contract.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::FreqHz => "freq_hz",
            Self::H => "h",
            Self::Coherence => "coherence",
            Self::MultipleCoherence => "multiple_coherence",
            Self::Condition => "condition",
            Self::Confidence => "confidence",
        }
    }
}

/// The parameters, checked.
#[derive(Debug, Clone, PartialEq)]
pub struct Query {
    /// The only array that is wanted.
    pub part: Option<Part>,
    /// The inverse in place of `H`, with this ridge.
    pub inverse: Option<f64>,
    from_hz: Option<f64>,
    to_hz: Option<f64>,
}

impl Query {
    /// Takes `part`, `inverse`, `ridge`, `from_hz` and `to_hz`.
    ///
    /// # Errors
    /// `query.invalid`.
    pub fn take(params: &mut Params) -> Answer<Self> {
        let words = "h, freq_hz, coherence, multiple_coherence, condition or confidence";
        let part = params
            .one("part")?
            .map(|text| {
                let found = Part::ALL.into_iter().find(|part| part.as_str() == text);
                found.ok_or_else(|| invalid("part", format!("is {text:?}"), words))
            })
            .transpose()?;
        let inverse = params.flag("inverse")?;
        let limit = "a finite number, not negative";
        let ridge = not_negative(params, "ridge", limit)?;
        if ridge.is_some() && !inverse {
            return Err(invalid("ridge", "is given", "left out unless inverse=true"));
        }
        if inverse && part.is_some_and(|part| !matches!(part, Part::H | Part::FreqHz)) {
            return Err(invalid("part", "is given", "h, freq_hz or left out beside inverse=true"));
        }
        let limit = "a frequency in hertz, not negative";
        Ok(Self {
            part,
            inverse: inverse.then_some(ridge.unwrap_or(DEFAULT_RIDGE)),
            from_hz: not_negative(params, "from_hz", limit)?,
            to_hz: not_negative(params, "to_hz", limit)?,
        })
    }

    /// The lines from `from_hz` to `to_hz`, both included.
    ///
    /// # Errors
    /// `query.invalid` for no line, and for more than an answer holds.
    pub fn lines(&self, frf: &Frf) -> Answer<std::ops::Range<usize>> {
        let last = frf.n_lines() - 1;
        // A millionth of a line: decimal frequencies are not exact in binary.
        let line = |hz: f64| hz / frf.df_hz();
        let first = self.from_hz.map_or(0.0, |hz| (line(hz) - 1e-6).ceil().max(0.0));
        let end = self.to_hz.map_or(last as f64, |hz| (line(hz) + 1e-6).floor());
        if first > end || first > last as f64 {
            let limit = format!(
                "at most to_hz, with a line between them: lines are {} Hz apart, up to {} Hz",
                frf.df_hz(),
                last as f64 * frf.df_hz()
            );
            return Err(invalid("from_hz", "leaves no line", &limit));
        }
        let lines: RangeInclusive<usize> = first as usize..=(end as usize).min(last);
        let (from, to) = lines.into_inner();
        let most = MAX_VALUES / (frf.n_inputs * frf.n_outputs);
        let found = to - from + 1;
        if found > most.max(1) {
            let limit =
                format!("near enough to from_hz for {most} lines, the most in one answer of this model");
            return Err(invalid("to_hz", format!("leaves {found} lines"), &limit));
        }
        Ok(from..to + 1)
    }
}

fn not_negative(params: &mut Params, name: &str, limit: &str) -> Answer<Option<f64>> {
    match params.number(name, limit)? {
        Some(v) if v < 0.0 => Err(invalid(name, format!("is {v}"), limit)),
        v => Ok(v),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An FRF of this many inputs and outputs, lines 0.5 Hz apart up to 1024 Hz; its values play no part.
    fn frf(n_inputs: usize, n_outputs: usize) -> Frf {
        Frf {
            sample_rate_hz: 2048.0,
            segment_len: 4096,
            n_inputs,
            n_outputs,
            h: Vec::new(),
            usable_hz: [0.0, 1024.0],
            x_mean: vec![0.0; n_inputs],
            y_mean: vec![0.0; n_outputs],
        }
    }

    fn lines(frf: &Frf, from_hz: Option<f64>, to_hz: Option<f64>) -> Result<std::ops::Range<usize>, String> {
        let query = Query { part: None, inverse: None, from_hz, to_hz };
        query.lines(frf).map_err(|problem| String::from_utf8(problem.document("")).expect("text"))
    }

    #[test]
    fn both_ends_of_a_band_belong_to_it() {
        let small = frf(2, 3);
        assert_eq!(lines(&small, None, None), Ok(0..2049));
        assert_eq!(lines(&small, Some(0.5), Some(1.0)), Ok(1..3));
        assert_eq!(lines(&small, Some(0.6), Some(1.4)), Ok(2..3));
        assert_eq!(lines(&small, None, Some(1e9)), Ok(0..2049));
        assert_eq!(lines(&small, Some(1.0 / 3.0 * 3.0), Some(1.0)), Ok(2..3));
        for (from, to) in [(Some(0.6), Some(0.9)), (Some(1024.1), None), (Some(2.0), Some(1.0))] {
            assert!(lines(&small, from, to).is_err_and(|text| text.contains("?from_hz")), "{from:?} {to:?}");
        }
    }

    #[test]
    fn a_large_frf_is_read_in_bands() {
        let large = frf(128, 128);
        let refused = lines(&large, None, None).expect_err("too much");
        assert!(refused.contains("?to_hz") && refused.contains("152 lines"), "{refused}");
        assert_eq!(lines(&large, Some(10.0), Some(85.5)), Ok(20..172));
        assert!(lines(&large, Some(10.0), Some(86.0)).is_err());
        assert_eq!(lines(&frf(16, 16), None, None), Ok(0..2049));
    }
}
