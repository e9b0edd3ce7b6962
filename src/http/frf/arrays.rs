//! The arrays of an answer: some lines of a model's FRF and of its quality.

use std::borrow::Cow;
use std::ops::Range;

use realfft::num_complex::Complex64;

use super::frf_of;
use super::query::{Part, Query};
use crate::domain::model::NO_COHERENCE;
use crate::engine::frf::{Frf, FrfInverse, FrfQuality};
use crate::engine::model::RigModel;
use crate::formats::npy;
use crate::http::problem::{Answer, Problem};
use crate::http::{codes, errors};

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

/// The arrays that are asked for.
#[derive(Debug)]
pub struct Arrays<'a> {
    pub model: &'a RigModel,
    pub frf: &'a Frf,
    /// In place of `H`.
    pub inverse: Option<Inverse>,
    /// In order; those of the estimate are missing where the model does not carry it.
    pub parts: Vec<(Part, Numbers<'a>)>,
    /// Parts that are wanted but that the model does not carry.
    pub missing: Vec<Part>,
    lines: usize,
}

impl<'a> Arrays<'a> {
    /// The arrays of `query` for these lines; `one` for a format that holds one array only.
    ///
    /// # Errors
    /// `model.no_frf`; `model.no_coherence` for a part that the model does not carry;
    /// `result.non_finite` for an inverse beyond the largest number.
    pub fn of(model: &'a RigModel, query: &Query, lines: Range<usize>, one: bool) -> Answer<Self> {
        let frf = frf_of(model)?;
        let part = if one { Some(query.part.unwrap_or(Part::H)) } else { query.part };
        // Frequencies are the first column of every table and document.
        let wanted = |p: Part| match part {
            None => query.inverse.is_none() || matches!(p, Part::H | Part::FreqHz),
            Some(part) => p == part || (!one && p == Part::FreqHz),
        };
        let mut arrays =
            Self { model, frf, inverse: None, parts: Vec::new(), missing: Vec::new(), lines: lines.len() };
        for p in Part::ALL.into_iter().filter(|&p| wanted(p)) {
            let numbers = match (p, &query.inverse) {
                (Part::FreqHz, _) => {
                    Numbers::Real(lines.clone().map(|line| line as f64 * frf.df_hz()).collect())
                }
                (Part::H, None) => Numbers::Complex(Cow::Borrowed(of_lines(&frf.h, frf.n_lines(), &lines))),
                (Part::H, Some(ridge)) => Numbers::Complex(arrays.invert(*ridge, &lines)?.into()),
                (p, _) => match &model.frf_quality {
                    Some(quality) => Numbers::Real(of_quality(frf, quality, p, &lines)?),
                    None if query.part.is_none() => {
                        arrays.missing.push(p);
                        continue;
                    }
                    None => {
                        let detail = format!("There is no {} here: {NO_COHERENCE}.", p.as_str());
                        return Err(Problem::new(codes::MODEL_NO_COHERENCE, detail));
                    }
                },
            };
            arrays.parts.push((p, numbers));
        }
        Ok(arrays)
    }

    fn invert(&mut self, ridge: f64, lines: &Range<usize>) -> Answer<Vec<Complex64>> {
        let refuse = |error| errors::engine(&error, &self.model.inputs, "");
        let inverse = FrfInverse::new(self.frf, self.model.frf_quality.as_ref(), ridge).map_err(refuse)?;
        let zero_outside_hz = inverse.zero_outside().map(|line| line as f64 * self.frf.df_hz());
        let found = inverse.lines(lines.clone()).map_err(refuse)?;
        self.inverse = Some(Inverse { ridge, zero_outside_hz });
        Ok(found)
    }

    /// Whether an array is of the paths between inputs and outputs, of the outputs, or of neither, by its
    /// shape after the lines.
    pub fn axes(&self, part: Part) -> Vec<usize> {
        let (nx, ny) = (self.frf.n_inputs, self.frf.n_outputs);
        match part {
            Part::FreqHz | Part::Condition => Vec::new(),
            Part::MultipleCoherence => vec![ny],
            Part::H if self.inverse.is_some() => vec![nx, ny],
            Part::H | Part::Coherence | Part::Confidence => vec![ny, nx],
        }
    }

    /// The one array of an answer that holds no more, and its shape.
    ///
    /// # Errors
    /// None that a query can cause.
    pub fn only(&self, part: Part) -> Answer<(npy::Array<'_>, Vec<usize>)> {
        let found = self.parts.iter().find(|(p, _)| *p == part);
        let (_, numbers) =
            found.ok_or_else(|| Problem::internal("the array that was asked for is missing"))?;
        let shape = [vec![self.lines], self.axes(part)].concat();
        let array = match numbers {
            Numbers::Real(numbers) => npy::Array::Real(numbers),
            Numbers::Complex(numbers) => npy::Array::Complex(numbers),
        };
        Ok((array, shape))
    }
}

/// Some lines of one of the estimate's arrays.
fn of_quality<'a>(
    frf: &Frf,
    quality: &'a FrfQuality,
    part: Part,
    lines: &Range<usize>,
) -> Answer<Cow<'a, [f64]>> {
    let cut = |all: &'a [f64]| of_lines(all, frf.n_lines(), lines);
    Ok(match part {
        Part::Coherence => Cow::Borrowed(cut(&quality.coherence)),
        Part::MultipleCoherence => Cow::Borrowed(cut(&quality.multiple_coherence)),
        Part::Condition => Cow::Borrowed(cut(&quality.condition)),
        _ => {
            let factor = quality.confidence_factor(CONFIDENCE).map_err(Problem::internal)?;
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
