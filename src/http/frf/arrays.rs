//! The arrays of an answer: some lines of a model's FRF and of its quality, cut from it as they are written.

use std::borrow::Cow;
use std::io;
use std::ops::Range;
use std::sync::Arc;

use realfft::num_complex::Complex64;

use super::frf_of;
use super::query::{Part, Query};
use crate::domain::model::NO_COHERENCE;
use crate::engine::frf::{Frf, FrfInverse, FrfQuality};
use crate::engine::model::RigModel;
use crate::formats::{NUMBERS_AT_ONCE, npy};
use crate::http::deadline::Deadline;
use crate::http::problem::{Answer, Problem};
use crate::http::{codes, errors};
use crate::models::LoadedModel;

/// Probability that the true value lies within the radius of confidence.
pub const CONFIDENCE: f64 = 0.95;

/// The inverse in an answer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Inverse {
    /// Its ridge.
    pub ridge: f64,
    /// First and last frequency at which it is not zero.
    pub zero_outside_hz: [f64; 2],
}

/// Numbers of an array, `[line, ...]`.
#[derive(Debug)]
pub enum Numbers<'a> {
    Real(Cow<'a, [f64]>),
    Complex(Cow<'a, [Complex64]>),
}

impl Numbers<'_> {
    /// As they go into an array file.
    pub fn as_array(&self) -> npy::Array<'_> {
        match self {
            Self::Real(numbers) => npy::Array::Real(numbers),
            Self::Complex(numbers) => npy::Array::Complex(numbers),
        }
    }
}

/// The arrays that are asked for.
#[derive(Debug)]
pub struct Arrays {
    pub loaded: Arc<LoadedModel>,
    /// Lines of the FRF.
    pub lines: Range<usize>,
    /// In order; those of the estimate are missing where the model does not carry it.
    pub parts: Vec<Part>,
    /// Parts that are wanted but that the model does not carry.
    pub missing: Vec<Part>,
    /// In place of `H`.
    inverse: Option<(FrfInverse, f64)>,
}

impl Arrays {
    /// The arrays of `query` for these lines; `one` for a format that holds one array only.
    ///
    /// # Errors
    /// `model.no_frf`; `model.no_coherence` for a part that the model does not carry;
    /// `result.non_finite` for an inverse beyond the largest number; the deadline.
    pub fn of(
        loaded: Arc<LoadedModel>,
        query: &Query,
        lines: Range<usize>,
        one: bool,
        deadline: &Deadline,
    ) -> Answer<Self> {
        let carried = loaded.model().frf_quality.is_some();
        let part = if one { Some(query.part.unwrap_or(Part::H)) } else { query.part };
        // Frequencies are the first column of every table and document.
        let wanted = |p: Part| match part {
            None => query.inverse.is_none() || matches!(p, Part::H | Part::FreqHz),
            Some(part) => p == part || (!one && p == Part::FreqHz),
        };
        let of_estimate = |p: &Part| !matches!(p, Part::H | Part::FreqHz);
        let (missing, parts): (Vec<Part>, Vec<Part>) =
            Part::ALL.into_iter().filter(|&p| wanted(p)).partition(|p| !carried && of_estimate(p));
        if let (Some(p), Some(_)) = (missing.first(), query.part) {
            let detail = format!("There is no {} here: {NO_COHERENCE}.", p.as_str());
            return Err(Problem::new(codes::MODEL_NO_COHERENCE, detail));
        }
        let inverse = match query.inverse {
            Some(ridge) if parts.contains(&Part::H) => {
                Some((inverse(&loaded, ridge, &lines, deadline)?, ridge))
            }
            _ => None,
        };
        Ok(Self { loaded, lines, parts, missing, inverse })
    }

    /// The model.
    pub fn model(&self) -> &RigModel {
        self.loaded.model()
    }

    /// Its FRF.
    ///
    /// # Errors
    /// `model.no_frf`
    pub fn frf(&self) -> Answer<&Frf> {
        frf_of(self.model())
    }

    /// Whether `H` is the inverse.
    pub fn is_inverse(&self) -> bool {
        self.inverse.is_some()
    }

    /// The inverse in place of `H`, if it was asked for.
    ///
    /// # Errors
    /// `model.no_frf`
    pub fn inverse(&self) -> Answer<Option<Inverse>> {
        let df_hz = self.frf()?.df_hz();
        Ok(self.inverse.as_ref().map(|(inverse, ridge)| Inverse {
            ridge: *ridge,
            zero_outside_hz: inverse.zero_outside().map(|line| line as f64 * df_hz),
        }))
    }

    /// Lengths of the axes of an array after the lines: of the paths between inputs and outputs, of the
    /// outputs, or none.
    pub fn axes(&self, part: Part) -> Vec<usize> {
        let model = self.model();
        let (nx, ny) = (model.inputs.len(), model.outputs.len());
        match part {
            Part::FreqHz | Part::Condition => Vec::new(),
            Part::MultipleCoherence => vec![ny],
            Part::H if self.is_inverse() => vec![nx, ny],
            Part::H | Part::Coherence | Part::Confidence => vec![ny, nx],
        }
    }

    /// Numbers of a line of an array.
    pub fn width(&self, part: Part) -> usize {
        self.axes(part).iter().product()
    }

    /// The lines from `at` on that are written at once, where each has so many numbers.
    pub fn piece(&self, at: usize, width: usize) -> Range<usize> {
        at..self.lines.end.min(at + (NUMBERS_AT_ONCE / width).max(1))
    }

    /// Some of the lines of a part.
    ///
    /// # Errors
    /// None that a query can cause.
    pub fn numbers(&self, part: Part, lines: Range<usize>) -> io::Result<Numbers<'_>> {
        let model = self.model();
        let none = || io::Error::other("an array that the model does not carry: this is a bug");
        let frf = model.frf.as_ref().ok_or_else(none)?;
        Ok(match (part, &self.inverse) {
            (Part::FreqHz, _) => Numbers::Real(lines.map(|line| line as f64 * frf.df_hz()).collect()),
            (Part::H, None) => Numbers::Complex(Cow::Borrowed(of_lines(&frf.h, frf.n_lines(), &lines))),
            (Part::H, Some((inverse, _))) => {
                Numbers::Complex(inverse.lines(frf, lines).map_err(io::Error::other)?.into())
            }
            (part, _) => {
                let quality = model.frf_quality.as_ref().ok_or_else(none)?;
                Numbers::Real(of_quality(frf, quality, part, &lines)?)
            }
        })
    }
}

/// The inverse of a model's FRF. All its lines are finite: they are computed once to see that, and again as
/// they are written.
fn inverse(
    loaded: &LoadedModel,
    ridge: f64,
    lines: &Range<usize>,
    deadline: &Deadline,
) -> Answer<FrfInverse> {
    let model = loaded.model();
    let frf = frf_of(model)?;
    let refuse = |error| errors::engine(&error, &model.inputs, "");
    let inverse = FrfInverse::new(frf, model.frf_quality.as_ref(), ridge).map_err(refuse)?;
    let step = (NUMBERS_AT_ONCE / (frf.n_inputs * frf.n_outputs)).max(1);
    for from in lines.clone().step_by(step) {
        deadline.check()?;
        inverse.lines(frf, from..lines.end.min(from + step)).map_err(refuse)?;
    }
    Ok(inverse)
}

/// Some lines of one of the estimate's arrays.
fn of_quality<'a>(
    frf: &Frf,
    quality: &'a FrfQuality,
    part: Part,
    lines: &Range<usize>,
) -> io::Result<Cow<'a, [f64]>> {
    let cut = |all: &'a [f64]| of_lines(all, frf.n_lines(), lines);
    Ok(match part {
        Part::Coherence => Cow::Borrowed(cut(&quality.coherence)),
        Part::MultipleCoherence => Cow::Borrowed(cut(&quality.multiple_coherence)),
        Part::Condition => Cow::Borrowed(cut(&quality.condition)),
        _ => {
            let factor = quality.confidence_factor(CONFIDENCE).map_err(io::Error::other)?;
            // Finite, however uncertain a path is.
            cut(&quality.std_error).iter().map(|s| (s * factor).min(f64::MAX)).collect()
        }
    })
}

/// Some lines of an array of `n_lines`.
fn of_lines<'a, T>(all: &'a [T], n_lines: usize, lines: &Range<usize>) -> &'a [T] {
    let per_line = all.len() / n_lines;
    &all[lines.start * per_line..lines.end * per_line]
}
