//! The regularised inverse of an FRF: from a response to the drive that produces it, line by line.

use std::ops::Range;

use faer::Mat;
use rayon::prelude::*;
use realfft::num_complex::Complex64;
use rigcast_numerics::decompose::thin_svd;

use super::band::{fade, tapers};
use super::quality::median;
use super::{Frf, FrfQuality};
use crate::EngineError;

/// Ridge of an inverse when the request gives none. It bounds the inverse of one drive at every line to
/// `1 / (2 sqrt ridge)`, 16 times the reciprocal of the FRF's median gain.
pub const DEFAULT_RIDGE: f64 = 1e-3;

/// Below this share of a line's largest singular value a singular value is rounding.
const ROUNDING: f64 = 1e-10;

/// Rounds of balancing; the scales of any but a degenerate FRF settle in a few.
const ROUNDS: usize = 30;

/// An FRF made ready to be inverted at any of its lines.
///
/// `H^+ = C (A^H A + ridge * level * I)^-1 A^H R` with `A = R H C` (Tikhonov; Hansen, Rank-Deficient and
/// Discrete Ill-Posed Problems, section 5.1), per line, from the singular values of `A`. `R` and `C` are
/// diagonal scales of outputs and inputs with which the median squared gains `|A_oi|^2` over the excited
/// lines have mean 1 in each row and column, so that the inverse does not depend on units. `level` is the
/// median over the excited lines of the mean squared singular value of `A`, so that one drive is damped
/// as well, where its response is far weaker than at most lines. On lines that are not excited the
/// inverse falls from its value at the edge to zero by half a cosine, as `H` does.
#[derive(Debug, Clone)]
pub struct FrfInverse {
    ridge: f64,
    /// Excited lines, first and last of each stretch.
    spans: Vec<(usize, usize)>,
    tapers: Vec<[usize; 2]>,
    row: Vec<f64>,
    column: Vec<f64>,
    level: f64,
    /// Share of each row of `A` that is uncertain, squared, `[line, output]`; none where no uncertainty damps.
    uncertain: Option<Vec<f64>>,
}

/// Incoherent over coherent power that a response counts with at most: what is less coherent is noise altogether.
const MOST_UNCERTAIN: f64 = 1.0;

impl FrfInverse {
    /// Balances an FRF; without `quality`, every line of the usable band counts as excited.
    ///
    /// # Errors
    /// [`EngineError::Setting`] for a ridge that is negative or not finite.
    pub fn new(frf: &Frf, quality: Option<&FrfQuality>, ridge: f64) -> Result<Self, EngineError> {
        Self::weighted(frf, quality, ridge, &vec![1.0; frf.n_outputs])
    }

    /// The same with a weight for each output, by which its row of `R` is multiplied: where there are more outputs
    /// than inputs, an output of twice the weight is followed as if its error counted four times.
    ///
    /// # Errors
    /// As of [`FrfInverse::new`].
    ///
    /// # Panics
    /// If there is not one weight an output.
    pub fn weighted(
        frf: &Frf,
        quality: Option<&FrfQuality>,
        ridge: f64,
        weights: &[f64],
    ) -> Result<Self, EngineError> {
        if !(ridge.is_finite() && ridge >= 0.0) {
            let limit = "a finite number, not negative".into();
            return Err(EngineError::Setting { setting: "ridge", found: ridge.to_string(), limit });
        }
        frf.check()?;
        let spans: Vec<(usize, usize)> = match quality {
            Some(quality) => quality.excited.iter().map(|&[first, last]| (first, last)).collect(),
            None => usable(frf).into_iter().collect(),
        };
        let (mut row, column) = balance(frf, &spans);
        assert_eq!(row.len(), weights.len(), "one weight an output");
        row.iter_mut().zip(weights).for_each(|(row, weight)| *row *= weight);
        let tapers = tapers(&spans, frf.n_lines());
        let mut inverse = Self { ridge, spans, tapers, row, column, level: 0.0, uncertain: None };
        let rank = frf.n_outputs.min(frf.n_inputs) as f64;
        let mut squares: Vec<f64> = inverse
            .excited()
            .map(|line| inverse.scaled(frf, line).map(|a| a.norm_sqr()).sum::<f64>() / rank)
            .collect();
        inverse.level = median(&mut squares).unwrap_or(0.0);
        Ok(inverse)
    }

    /// The same, damped line by line by what the FRF does not know, too. A row of `A` whose output has the multiple
    /// coherence `g` is uncertain by `(1 - g) / g` of its square, and the mean of that over the inputs is added to
    /// `ridge * level`. A combination of inputs is so damped by a half where its singular value is as small as the
    /// uncertainty: where the condition number of the line times the root of `(1 - g) / g` is about 1, beyond which
    /// corrections by the inverse may diverge.
    ///
    /// # Panics
    /// If `quality` is that of another FRF.
    #[must_use]
    pub fn damped_by(mut self, quality: &FrfQuality) -> Self {
        let of_output = |coherence: &f64| ((1.0 - coherence) / coherence).clamp(0.0, MOST_UNCERTAIN);
        let uncertain: Vec<f64> = quality.multiple_coherence.iter().map(of_output).collect();
        assert!(uncertain.len().is_multiple_of(self.row.len()), "one coherence a line and output");
        self.uncertain = Some(uncertain);
        self
    }

    /// Share of an error of each output that `H H^+` reaches, of what any input could: 1 where nothing is damped, 0 where
    /// nothing excites, `[line, output]`.
    ///
    /// # Panics
    /// If the FRF has other channels.
    pub fn reach(&self, frf: &Frf) -> Vec<f64> {
        let of_lines: Vec<Vec<f64>> =
            (0..frf.n_lines()).into_par_iter().map(|line| self.reach_of(frf, line)).collect();
        of_lines.into_iter().flatten().collect()
    }

    fn reach_of(&self, frf: &Frf, line: usize) -> Vec<f64> {
        let nothing = vec![0.0; frf.n_outputs];
        let Some((edge, share)) = self.nearest(line) else { return nothing };
        let Some((u, singular, _)) = self.decomposed(frf, edge) else { return nothing };
        let damping = self.damping(frf, edge);
        let of_output = |o: usize| {
            let (mut reached, mut all) = (0.0, 0.0);
            for (k, s) in singular.iter().enumerate().filter(|(_, s)| **s > 0.0) {
                let part = u[(o, k)].norm_sqr();
                reached += part * s * s / (s * s + damping);
                all += part;
            }
            if all > 0.0 { share * reached / all } else { 0.0 }
        };
        (0..frf.n_outputs).map(of_output).collect()
    }

    /// `H^+` of some lines of the FRF that this was made of, input unit / output unit, `[line, input, output]`.
    ///
    /// # Errors
    /// [`EngineError::NonFiniteResult`].
    ///
    /// # Panics
    /// If there are no such lines, or the FRF has other channels.
    pub fn lines(&self, frf: &Frf, lines: Range<usize>) -> Result<Vec<Complex64>, EngineError> {
        let first = lines.start;
        let of_lines: Vec<Vec<Complex64>> = lines.into_par_iter().map(|line| self.line(frf, line)).collect();
        let inverse: Vec<Complex64> = of_lines.into_iter().flatten().collect();
        match inverse.iter().position(|z| !(z.re.is_finite() && z.im.is_finite())) {
            None => Ok(inverse),
            Some(at) => {
                let per_line = frf.n_inputs * frf.n_outputs;
                let (what, channel) = ("inverse of the FRF", at % per_line / frf.n_outputs);
                Err(EngineError::NonFiniteResult { what, channel, sample: first + at / per_line })
            }
        }
    }

    /// First and last line on which the inverse can be other than zero.
    pub fn zero_outside(&self) -> [usize; 2] {
        let first = self.spans.first().zip(self.tapers.first()).map_or(0, |(span, taper)| span.0 - taper[0]);
        let last = self.spans.last().zip(self.tapers.last()).map_or(0, |(span, taper)| span.1 + taper[1]);
        [first, last]
    }

    fn line(&self, frf: &Frf, line: usize) -> Vec<Complex64> {
        let (nx, ny) = (frf.n_inputs, frf.n_outputs);
        let nothing = || vec![Complex64::default(); nx * ny];
        let Some((edge, share)) = self.nearest(line) else { return nothing() };
        let Some((u, singular, v)) = self.decomposed(frf, edge) else {
            return vec![Complex64::new(f64::NAN, 0.0); nx * ny];
        };
        let damping = self.damping(frf, edge);
        let weight = |s: f64| if s > 0.0 { s / (s * s + damping) } else { 0.0 };
        let weights: Vec<f64> = singular.into_iter().map(weight).collect();
        let mut inverse = nothing();
        for (i, inverse) in inverse.chunks_mut(ny).enumerate() {
            for (o, inverse) in inverse.iter_mut().enumerate() {
                let sum: Complex64 =
                    weights.iter().enumerate().map(|(k, w)| v[(i, k)] * u[(o, k)].conj() * w).sum();
                *inverse = sum * (share * self.column[i] * self.row[o]);
            }
        }
        inverse
    }

    /// `A` of a line as `U S V^H`; singular values that are rounding are zero.
    fn decomposed(&self, frf: &Frf, line: usize) -> Option<(Mat<Complex64>, Vec<f64>, Mat<Complex64>)> {
        let scaled: Vec<Complex64> = self.scaled(frf, line).collect();
        let (u, mut singular, v) =
            thin_svd(&Mat::from_fn(frf.n_outputs, frf.n_inputs, |o, i| scaled[o * frf.n_inputs + i]))?;
        let floor = ROUNDING * singular.first().copied().unwrap_or(0.0);
        singular.iter_mut().filter(|s| **s <= floor).for_each(|s| *s = 0.0);
        Some((u, singular, v))
    }

    /// The number that is added to the squares of a line's singular values.
    fn damping(&self, frf: &Frf, line: usize) -> f64 {
        let uncertain = self.uncertain.as_ref().map_or(0.0, |uncertain| {
            let squares: Vec<f64> = self.scaled(frf, line).map(|a| a.norm_sqr()).collect();
            let rows = squares.chunks(frf.n_inputs).zip(&uncertain[line * frf.n_outputs..]);
            rows.map(|(row, uncertain)| uncertain * row.iter().sum::<f64>()).sum::<f64>()
                / frf.n_inputs as f64
        });
        self.ridge * self.level + uncertain
    }

    /// The excited line that a line takes its inverse from, and what is left of it there.
    fn nearest(&self, line: usize) -> Option<(usize, f64)> {
        self.spans.iter().zip(&self.tapers).find_map(|(&(first, last), &[below, above])| {
            if (first..=last).contains(&line) {
                Some((line, 1.0))
            } else if line < first && first - line <= below {
                Some((first, fade(first - line, below)))
            } else if line > last && line - last <= above {
                Some((last, fade(line - last, above)))
            } else {
                None
            }
        })
    }

    fn excited(&self) -> impl Iterator<Item = usize> + '_ {
        self.spans.iter().flat_map(|&(first, last)| first..=last)
    }

    /// `R H C` of a line, `[output, input]`.
    fn scaled<'a>(&'a self, frf: &'a Frf, line: usize) -> impl Iterator<Item = Complex64> + 'a {
        let pairs = (0..frf.n_outputs).flat_map(|o| (0..frf.n_inputs).map(move |i| (o, i)));
        pairs.map(move |(o, i)| frf.at(line, o, i) * self.row[o] * self.column[i])
    }
}

/// Lines of the usable band.
fn usable(frf: &Frf) -> Option<(usize, usize)> {
    let line = |hz: f64| (hz / frf.df_hz()).round().clamp(0.0, (frf.n_lines() - 1) as f64) as usize;
    let (first, last) = (line(frf.usable_hz[0]), line(frf.usable_hz[1]));
    (first <= last).then_some((first, last))
}

/// Scales of outputs and inputs (Sinkhorn, "A relationship between arbitrary positive matrices and
/// doubly stochastic matrices", 1964); of a channel without gain 0.
fn balance(frf: &Frf, spans: &[(usize, usize)]) -> (Vec<f64>, Vec<f64>) {
    let (nx, ny) = (frf.n_inputs, frf.n_outputs);
    // Gains, not their squares, which might overflow.
    let gains: Vec<f64> = (0..ny * nx)
        .into_par_iter()
        .map(|at| {
            let lines = spans.iter().flat_map(|&(first, last)| first..=last);
            let mut gains: Vec<f64> = lines.map(|line| frf.at(line, at / nx, at % nx).norm()).collect();
            median(&mut gains).unwrap_or(0.0)
        })
        .collect();
    let (mut row, mut column) = (vec![1.0; ny], vec![1.0; nx]);
    let scale = |scaled: &mut dyn Iterator<Item = f64>, n: usize| {
        let rms = (scaled.map(|g| g * g).sum::<f64>() / n as f64).sqrt();
        if rms > 0.0 && rms.is_finite() { 1.0 / rms } else { 0.0 }
    };
    for _ in 0..ROUNDS {
        for (o, row) in row.iter_mut().enumerate() {
            *row = scale(&mut (0..nx).map(|i| gains[o * nx + i] * column[i]), nx);
        }
        for (i, column) in column.iter_mut().enumerate() {
            *column = scale(&mut (0..ny).map(|o| gains[o * nx + i] * row[o]), ny);
        }
    }
    (row, column)
}
