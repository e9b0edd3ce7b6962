//! Auto and cross spectra between the inputs and the outputs of a system.

use rayon::prelude::*;
use realfft::num_complex::Complex64;

use super::accumulate::{Source, accumulate};
use super::{EngineError, Welch};

/// Averaged one-sided spectra of inputs `x` and outputs `y`, unit * unit / Hz.
#[derive(Debug, Clone, PartialEq)]
pub struct CrossSpectra {
    /// Distance of lines, Hz.
    pub df_hz: f64,
    /// Frequency lines.
    pub n_lines: usize,
    /// Input channels.
    pub n_inputs: usize,
    /// Output channels.
    pub n_outputs: usize,
    /// Segments averaged.
    pub n_averages: usize,
    /// Independent segments that they are worth ([`Welch::effective_averages`]).
    pub effective_averages: f64,
    /// `S_xx[line, i, j] = <X_i conj(X_j)>`, Hermitian.
    pub sxx: Vec<Complex64>,
    /// `S_yx[line, o, i] = <Y_o conj(X_i)>`.
    pub syx: Vec<Complex64>,
    /// `S_yy[line, o] = <|Y_o|^2>`.
    pub syy: Vec<f64>,
}

/// A record of a run or of a part of it: input channels and output channels, all equally long.
pub(crate) struct Record<'a> {
    pub x: Vec<&'a [f64]>,
    pub y: Vec<&'a [f64]>,
}

/// The working point, subtracted before the transforms.
pub(crate) struct Means {
    pub x: Vec<f64>,
    pub y: Vec<f64>,
}

/// Spectra averaged over the segments of all records, each channel transformed once a segment.
///
/// # Errors
/// Settings outside their limits, no whole segment, values whose square overflows.
pub(crate) fn cross_spectra(
    records: &[Record<'_>],
    means: &Means,
    welch: &Welch,
    sample_rate_hz: f64,
) -> Result<CrossSpectra, EngineError> {
    welch.check()?;
    let (nx, ny, lines) = (means.x.len(), means.y.len(), welch.n_lines());
    let sources: Vec<Source<'_>> =
        records.iter().map(|s| s.x.iter().chain(&s.y).copied().collect()).collect();
    let offsets: Vec<f64> = means.x.iter().chain(&means.y).copied().collect();
    let triangle = (0..nx).flat_map(|i| (i..nx).map(move |j| (i, j)));
    let cross = (0..ny).flat_map(|o| (0..nx).map(move |i| (nx + o, i)));
    let auto = (0..ny).map(|o| (nx + o, nx + o));
    let pairs: Vec<(usize, usize)> = triangle.chain(cross).chain(auto).collect();
    let sums = accumulate(&sources, &offsets, welch, sample_rate_hz, &pairs)?;

    let mut spectra = CrossSpectra {
        df_hz: sums.df_hz,
        n_lines: lines,
        n_inputs: nx,
        n_outputs: ny,
        n_averages: sums.n_averages,
        effective_averages: sums.effective_averages,
        sxx: vec![Complex64::default(); lines * nx * nx],
        syx: vec![Complex64::default(); lines * ny * nx],
        syy: vec![0.0; lines * ny],
    };
    // Line by line: what is read next of each pair lies in the caches then.
    let matrices = spectra.sxx.par_chunks_mut(nx * nx).zip(spectra.syx.par_chunks_mut(ny * nx));
    let lines = matrices.zip(spectra.syy.par_chunks_mut(ny)).enumerate().with_min_len(64);
    lines.for_each(|(line, ((sxx, syx), syy))| {
        for ((re, im), &(a, b)) in sums.re.iter().zip(&sums.im).zip(&pairs) {
            let z = Complex64::new(re[line], im[line]);
            if a < nx {
                sxx[a * nx + b] = z;
                sxx[b * nx + a] = z.conj();
            } else if b < nx {
                syx[(a - nx) * nx + b] = z;
            } else {
                syy[a - nx] = z.re;
            }
        }
    });
    Ok(spectra)
}
