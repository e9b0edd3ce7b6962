//! The linear algebra of one estimate: each line is a small Hermitian system, solved by its eigenvalues.
//!
//! Inputs are scaled to their standard deviation first, so that eigenvalues and condition number
//! mean the same whatever units and levels the inputs have. A ridge is added to inputs that are
//! scaled to their in-band level: see [`Lines::h1`].

use std::sync::OnceLock;

use faer::Mat;
use rayon::prelude::*;
use realfft::num_complex::Complex64;
use rigcast_numerics::decompose::hermitian_eigen;

use super::band::Band;
use crate::EngineError;
use crate::spectral::CrossSpectra;

/// Below this share of the largest eigenvalue an eigenvalue is rounding, not excitation.
const ROUNDING: f64 = 1e-10;

/// The spectra of all lines, solved.
pub(super) struct Lines<'a> {
    spectra: &'a CrossSpectra,
    by_deviation: Scaled,
    /// For ridges; made when the first is asked for.
    by_level: OnceLock<Result<Scaled, EngineError>>,
}

/// `S_xx = V diag(eigenvalues) V^H` of scaled inputs at every line, and `S_yx V`.
struct Scaled {
    /// What each input is divided by.
    scale: Vec<f64>,
    /// Ascending, `[line, k]`, density of the scaled inputs, 1/Hz.
    eigenvalues: Vec<f64>,
    /// `V[line, input, k]`.
    vectors: Vec<Complex64>,
    /// `(S_yx V)[line, output, k]`.
    projected: Vec<Complex64>,
}

/// One line's share of [`Scaled`].
struct Line {
    eigenvalues: Vec<f64>,
    vectors: Vec<Complex64>,
    projected: Vec<Complex64>,
}

impl Scaled {
    /// Decomposes every line.
    fn new(spectra: &CrossSpectra, scale: Vec<f64>) -> Result<Self, EngineError> {
        let lines: Vec<Line> = (0..spectra.n_lines)
            .into_par_iter()
            .with_min_len(64)
            .map(|line| decompose(spectra, &scale, line))
            .collect::<Result<_, _>>()?;
        let mut all = Self {
            scale,
            eigenvalues: Vec::with_capacity(spectra.n_lines * spectra.n_inputs),
            vectors: Vec::with_capacity(spectra.sxx.len()),
            projected: Vec::with_capacity(spectra.syx.len()),
        };
        for line in lines {
            all.eigenvalues.extend(line.eigenvalues);
            all.vectors.extend(line.vectors);
            all.projected.extend(line.projected);
        }
        Ok(all)
    }

    /// `S_yx (S_xx + ridge * scale^2)^-1`, `[line, output, input]` in the channels' units.
    fn h1(&self, spectra: &CrossSpectra, ridge: f64) -> Vec<Complex64> {
        let (nx, ny) = (spectra.n_inputs, spectra.n_outputs);
        let mut h = vec![Complex64::default(); spectra.syx.len()];
        h.par_chunks_mut(ny * nx).enumerate().for_each(|(line, h)| {
            let inverse = self.inverse(line, ridge);
            let vectors = &self.vectors[line * nx * nx..(line + 1) * nx * nx];
            let projected = &self.projected[line * ny * nx..(line + 1) * ny * nx];
            for (h, projected) in h.chunks_mut(nx).zip(projected.chunks(nx)) {
                for ((h, v), scale) in h.iter_mut().zip(vectors.chunks(nx)).zip(&self.scale) {
                    let sum: Complex64 =
                        projected.iter().zip(v).zip(&inverse).map(|((p, v), w)| p * v.conj() * w).sum();
                    *h = sum / scale;
                }
            }
        });
        h
    }

    /// Inverse eigenvalues; those that are only rounding are left out.
    fn inverse(&self, line: usize, ridge: f64) -> Vec<f64> {
        let nx = self.scale.len();
        let eigenvalues = &self.eigenvalues[line * nx..(line + 1) * nx];
        let floor = ROUNDING * eigenvalues[nx - 1];
        eigenvalues.iter().map(|&e| if e > floor { 1.0 / (e + ridge) } else { 0.0 }).collect()
    }
}

impl<'a> Lines<'a> {
    /// Decomposes every line, each input divided by its standard deviation `x_scale`.
    pub fn new(spectra: &'a CrossSpectra, x_scale: &[f64]) -> Result<Self, EngineError> {
        let by_deviation = Scaled::new(spectra, x_scale.to_vec())?;
        Ok(Self { spectra, by_deviation, by_level: OnceLock::new() })
    }

    /// `H = S_yx (S_xx + ridge * diag(level))^-1` (Bendat and Piersol, Random Data, section 7.5,
    /// with a ridge), `[line, output, input]` in the channels' units.
    ///
    /// `level_i` is [`Lines::level`] of input `i` over `band`. With one input that is
    /// `H = S_yx / (S_xx + ridge * level)`: a line with the level's power loses the share
    /// `ridge / (1 + ridge)` of `H`, a line with far less power than `ridge * level` nearly all.
    /// All ridges of one `Lines` go with one band.
    ///
    /// # Errors
    /// Spectra that are not finite.
    pub fn h1(&self, ridge: f64, band: &Band) -> Result<Vec<Complex64>, EngineError> {
        if ridge == 0.0 {
            return Ok(self.by_deviation.h1(self.spectra, 0.0));
        }
        let by_level = self.by_level.get_or_init(|| {
            let level = |input| self.level(band, input).sqrt();
            Scaled::new(self.spectra, (0..self.spectra.n_inputs).map(level).collect())
        });
        by_level.as_ref().map(|lines| lines.h1(self.spectra, ridge)).map_err(EngineError::clone)
    }

    /// `H_kl = S_kl / S_kk` (Heindel et al., section 2.1), with a ridge `S_kl / (S_kk + ridge *
    /// level_k)`, `[line, output, input]`.
    pub fn ratio(&self, ridge: f64, band: &Band) -> Vec<Complex64> {
        let (nx, ny) = (self.spectra.n_inputs, self.spectra.n_outputs);
        let ridges: Vec<f64> = (0..nx).map(|input| ridge * self.level(band, input)).collect();
        let mut h = self.spectra.syx.clone();
        for (line, h) in h.chunks_mut(ny * nx).enumerate() {
            for row in h.chunks_mut(nx) {
                for (i, h) in row.iter_mut().enumerate() {
                    let power = self.power(line, i) + ridges[i];
                    *h = if power > 0.0 { *h / power } else { Complex64::default() };
                }
            }
        }
        h
    }

    /// In-band level of an input, in its unit squared / Hz: the mean of `S_ii` over the lines of
    /// `band`. Lines 0 and 1 stay out: the offsets of the runs lie there, far above the noise.
    pub fn level(&self, band: &Band, input: usize) -> f64 {
        let (sum, lines) = band
            .lines()
            .filter(|&line| line > 1)
            .fold((0.0, 0_usize), |(sum, lines), line| (sum + self.power(line, input), lines + 1));
        let level = sum / lines as f64;
        // Without any power in the band its `H` is zero, whatever is added to nothing.
        if level > 0.0 { level } else { 1.0 }
    }

    /// Smallest eigenvalue of the scaled `S_xx` at a line: the power of the weakest combination of
    /// inputs.
    pub fn weakest(&self, line: usize) -> f64 {
        self.by_deviation.eigenvalues[line * self.spectra.n_inputs]
    }

    /// `S_ii` of one input.
    pub fn power(&self, line: usize, input: usize) -> f64 {
        let nx = self.spectra.n_inputs;
        self.spectra.sxx[(line * nx + input) * nx + input].re
    }

    /// First and last line on which an input by itself has power.
    pub fn input_band(&self, input: usize) -> [usize; 2] {
        let power: Vec<f64> = (0..self.spectra.n_lines).map(|line| self.power(line, input)).collect();
        Band::new(&power).map_or([0, 0], |band| [band.first(), band.last()])
    }

    /// Smallest power of a scaled input at a line.
    pub fn smallest_power(&self, line: usize) -> f64 {
        let scale = &self.by_deviation.scale;
        let scaled = |i: usize| self.power(line, i) / (scale[i] * scale[i]);
        (0..self.spectra.n_inputs).map(scaled).fold(f64::INFINITY, f64::min)
    }

    /// Mean eigenvalue of the scaled `S_xx` at a line.
    pub fn mean_eigenvalue(&self, line: usize) -> f64 {
        let nx = self.spectra.n_inputs;
        self.by_deviation.eigenvalues[line * nx..(line + 1) * nx].iter().sum::<f64>() / nx as f64
    }

    /// Condition number of the scaled `S_xx` at a line; `f64::MAX` when it is singular.
    pub fn condition(&self, line: usize) -> f64 {
        let nx = self.spectra.n_inputs;
        let eigenvalues = &self.by_deviation.eigenvalues[line * nx..(line + 1) * nx];
        let (smallest, largest) = (eigenvalues[0], eigenvalues[nx - 1]);
        let condition = largest / smallest;
        if smallest > 0.0 && condition.is_finite() { condition } else { f64::MAX }
    }

    /// The input that is nearly a combination of the others at a line.
    pub fn most_dependent_input(&self, line: usize) -> usize {
        let nx = self.spectra.n_inputs;
        let share = |i: usize| self.by_deviation.vectors[(line * nx + i) * nx].norm();
        (0..nx).max_by(|&a, &b| share(a).total_cmp(&share(b))).unwrap_or(0)
    }

    /// Whether the inputs are linearly dependent at a line, rounding apart.
    pub fn singular(&self, line: usize) -> bool {
        let nx = self.spectra.n_inputs;
        let eigenvalues = &self.by_deviation.eigenvalues[line * nx..(line + 1) * nx];
        eigenvalues[0] <= ROUNDING * eigenvalues[nx - 1]
    }

    /// Multiple coherence of one output with all inputs at a line, 0..=1:
    /// `S_yx S_xx^-1 S_xy / S_yy` (Bendat and Piersol, Random Data, section 7.3).
    pub fn multiple_coherence(&self, line: usize, output: usize) -> f64 {
        let (nx, ny) = (self.spectra.n_inputs, self.spectra.n_outputs);
        let at = (line * ny + output) * nx;
        let explained: f64 = self.by_deviation.projected[at..at + nx]
            .iter()
            .zip(self.by_deviation.inverse(line, 0.0))
            .map(|(p, inverse)| p.norm_sqr() * inverse)
            .sum();
        share(explained, self.spectra.syy[line * ny + output])
    }

    /// Ordinary coherence of one output with one input at a line, 0..=1.
    pub fn ordinary_coherence(&self, line: usize, output: usize, input: usize) -> f64 {
        let (nx, ny) = (self.spectra.n_inputs, self.spectra.n_outputs);
        let cross = self.spectra.syx[(line * ny + output) * nx + input].norm_sqr();
        share(cross / self.power(line, input), self.spectra.syy[line * ny + output])
    }

    /// Ordinary coherence of two inputs at a line, 0..=1.
    pub fn input_coherence(&self, line: usize, a: usize, b: usize) -> f64 {
        let nx = self.spectra.n_inputs;
        let cross = self.spectra.sxx[(line * nx + a) * nx + b].norm_sqr();
        share(cross / self.power(line, a), self.power(line, b))
    }

    /// `(S_xx^-1)_ii` in the input's own unit: the variance of `H[output, i]` for one average and unit
    /// output noise.
    pub fn inverse_diagonal(&self, line: usize, input: usize) -> f64 {
        let nx = self.spectra.n_inputs;
        let lines = &self.by_deviation;
        let row = &lines.vectors[(line * nx + input) * nx..(line * nx + input + 1) * nx];
        let sum: f64 = row.iter().zip(lines.inverse(line, 0.0)).map(|(v, w)| v.norm_sqr() * w).sum();
        sum / (lines.scale[input] * lines.scale[input])
    }
}

fn decompose(spectra: &CrossSpectra, scale: &[f64], line: usize) -> Result<Line, EngineError> {
    let (nx, ny) = (spectra.n_inputs, spectra.n_outputs);
    let sxx = &spectra.sxx[line * nx * nx..(line + 1) * nx * nx];
    let syx = &spectra.syx[line * ny * nx..(line + 1) * ny * nx];
    let (eigenvalues, vectors) = if nx == 1 {
        (vec![sxx[0].re / (scale[0] * scale[0])], vec![Complex64::new(1.0, 0.0)])
    } else {
        let scaled = Mat::from_fn(nx, nx, |i, j| sxx[i * nx + j] / (scale[i] * scale[j]));
        let (values, vectors) = hermitian_eigen(&scaled).ok_or(EngineError::NonFiniteResult {
            what: "eigenvalue of S_xx",
            channel: 0,
            sample: line,
        })?;
        (values, (0..nx * nx).map(|at| vectors[(at / nx, at % nx)]).collect())
    };
    let projected = (0..ny * nx)
        .map(|at| {
            let (o, k) = (at / nx, at % nx);
            (0..nx).map(|i| syx[o * nx + i] / scale[i] * vectors[i * nx + k]).sum()
        })
        .collect();
    Ok(Line { eigenvalues, vectors, projected })
}

/// `part / whole` within 0..=1; 0 / 0 is 0.
fn share(part: f64, whole: f64) -> f64 {
    let share = part / whole;
    if share.is_finite() { share.clamp(0.0, 1.0) } else { 0.0 }
}
