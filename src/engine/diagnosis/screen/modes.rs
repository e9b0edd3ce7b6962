//! The linear part as modes of the rig: poles that all responses and drives share.
//!
//! A finite impulse response ends before a lightly damped mode has rung down, and costs a coefficient a sample. A
//! few modes ring for ever. Their poles are relocated on the measured signals (vector fitting in the time domain,
//! Grivet-Talocia 2003): responses and drives go through the present poles, and the zeros of the common factor
//! that best reconciles them are the next poles.

use std::f64::consts::TAU;

use faer::Mat;
use rayon::prelude::*;
use realfft::num_complex::Complex64;
use rigcast_numerics::decompose::Cholesky;

use super::track::{Segment, Track, delayed};
use crate::diagnosis::numerics::linear::{eigenvalues, from_columns, transposed_times};

/// Rounds of relocation at a time.
const ROUNDS: usize = 4;
/// Largest magnitude of a pole: a mode that takes 10,000 samples to ring down.
const SLOWEST: f64 = 0.9999;
/// Ridge relative to each column's power.
const RIDGE: f64 = 1e-10;
/// Samples of an impulse response, and poles of a filter, that are computed side by side.
const TOGETHER: usize = 8;
/// Samples of a filter that are kept at hand.
const BLOCK: usize = 64;

/// Poles of the upper half plane and real ones, of sampled signals.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Poles(Vec<Complex64>);

impl Poles {
    /// Lightly damped pairs at even frequencies up to `high`, cycles a sample.
    pub fn spread(pairs: usize, high: f64) -> Self {
        let pole = |k: usize| {
            let angle = TAU * high * (k as f64 + 0.5) / pairs as f64;
            Complex64::from_polar((-0.05 * angle).exp().min(0.999), angle)
        };
        Self((0..pairs).map(pole).collect())
    }

    /// Number of real states.
    pub fn states(&self) -> usize {
        self.0.iter().map(|p| if p.im == 0.0 { 1 } else { 2 }).sum()
    }

    /// The states of a signal that drives every mode by itself, one sample late; held before its start.
    pub fn filter(&self, track: &Track) -> Vec<Track> {
        let mut out = Vec::with_capacity(self.states());
        // Several poles at a time: one alone would wait for the sample before.
        for poles in self.0.chunks(TOGETHER) {
            let mut states: Vec<[Track; 2]> = vec![[Vec::new(), Vec::new()]; poles.len()];
            for x in track {
                let of_poles = together(poles, x);
                states.iter_mut().zip(of_poles).for_each(|([re, im], [x, y])| {
                    re.push(x);
                    im.push(y);
                });
            }
            for (pole, [re, im]) in poles.iter().zip(states) {
                out.push(re);
                if pole.im != 0.0 {
                    out.push(im);
                }
            }
        }
        out
    }

    /// Impulse response of coefficients of the states, `n` samples.
    pub fn impulse(&self, coefficients: &[f64], n: usize) -> Vec<f64> {
        let mut out = vec![0.0; n];
        let mut at = 0;
        for &pole in &self.0 {
            let (re, im) = (coefficients[at], if pole.im == 0.0 { 0.0 } else { coefficients[at + 1] });
            at += if pole.im == 0.0 { 1 } else { 2 };
            // Several samples at a time: one power would wait for the one before.
            let powers: [Complex64; TOGETHER] = std::array::from_fn(|k| pole.powu(k as u32));
            let (mut cos, mut sin) = (powers.map(|z| z.re), powers.map(|z| z.im));
            let next = pole.powu(TOGETHER as u32);
            for part in out[1.min(n)..].chunks_mut(TOGETHER) {
                let mut values = [0.0; TOGETHER];
                for k in 0..TOGETHER {
                    values[k] = re * cos[k] + im * sin[k];
                    (cos[k], sin[k]) =
                        (cos[k] * next.re - sin[k] * next.im, cos[k] * next.im + sin[k] * next.re);
                }
                part.iter_mut().zip(values).for_each(|(y, value)| *y += value);
            }
        }
        out
    }

    /// From -1 to 1: how far coefficients of the states move every mode as a force does that it follows, of a response
    /// that is the motion itself (0), its rate (1) or the rate of that (2).
    pub fn follows(&self, coefficients: &[f64], rates: usize) -> f64 {
        let (mut with, mut all, mut at) = (0.0, 0.0, 0);
        for &pole in &self.0 {
            let (re, im) = (coefficients[at], if pole.im == 0.0 { 0.0 } else { coefficients[at + 1] });
            at += if pole.im == 0.0 { 1 } else { 2 };
            // The states are a sample late.
            let now = Complex64::new(re, -im) / pole;
            // A struck mode goes as a sine, its rate as a cosine, the rate of that against the sine.
            let along = match (rates, pole.im == 0.0) {
                (0, true) | (1, false) => now.re,
                (_, true) => 0.0,
                (0, false) => -now.im,
                _ => now.im,
            };
            let power = 1.0 / (1.0 - pole.norm_sqr()).max(1e-6);
            with += along * power;
            all += now.norm() * power;
        }
        if all > 0.0 { with / all } else { 0.0 }
    }

    /// Samples after which every mode has rung down to a thousandth, at most `most`.
    pub fn memory(&self, most: usize) -> usize {
        let slowest = self.0.iter().map(|p| p.norm()).fold(0.0, f64::max);
        ((6.9 / -slowest.ln()).ceil().min(most as f64) as usize).max(1)
    }

    /// The zeros of `1 + sum d_m / (z - p_m)`, made stable; `None` where they cannot be had.
    fn relocated(&self, d: &[f64]) -> Option<Self> {
        let n = self.states();
        let mut matrix = vec![vec![0.0; n]; n];
        let mut into = vec![0.0; n];
        let mut at = 0;
        for &pole in &self.0 {
            into[at] = 1.0;
            matrix[at][at] = pole.re;
            if pole.im != 0.0 {
                matrix[at][at + 1] = -pole.im;
                matrix[at + 1][at] = pole.im;
                matrix[at + 1][at + 1] = pole.re;
                at += 1;
            }
            at += 1;
        }
        for (row, into) in matrix.iter_mut().zip(&into) {
            row.iter_mut().zip(d).for_each(|(m, d)| *m -= into * d);
        }
        let poles: Vec<Complex64> = eigenvalues(&matrix)?
            .into_iter()
            .filter(|p| p.im >= 0.0)
            .map(|p| {
                let p = if p.norm() > 1.0 { 1.0 / p.conj() } else { p };
                let p = if p.im.abs() < 1e-9 { Complex64::new(p.re, 0.0) } else { p };
                p * (SLOWEST / p.norm().max(SLOWEST))
            })
            .collect();
        let mut poles = poles;
        poles.sort_by(|a, b| a.im.total_cmp(&b.im).then(a.re.total_cmp(&b.re)));
        Some(Self(poles))
    }
}

/// Real and imaginary parts of the states of at most [`TOGETHER`] poles over one record.
fn together(poles: &[Complex64], x: &[f64]) -> Vec<[Vec<f64>; 2]> {
    let of = |part: fn(&Complex64) -> f64, from: &[Complex64]| -> [f64; TOGETHER] {
        std::array::from_fn(|k| from.get(k).map_or(0.0, part))
    };
    let first = x.first().copied().unwrap_or_default();
    let held: Vec<Complex64> = poles.iter().map(|pole| Complex64::from(first) / (1.0 - pole)).collect();
    let (p, q) = (of(|p| p.re, poles), of(|p| p.im, poles));
    let (mut re, mut im) = (of(|z| z.re, &held), of(|z| z.im, &held));
    let mut out = vec![[Vec::with_capacity(x.len()), Vec::with_capacity(x.len())]; poles.len()];
    let mut block = [[[0.0; TOGETHER]; 2]; BLOCK];
    for samples in x.chunks(BLOCK) {
        for (now, x) in block.iter_mut().zip(samples) {
            *now = [re, im];
            for k in 0..TOGETHER {
                (re[k], im[k]) = (p[k] * re[k] - q[k] * im[k] + x, p[k] * im[k] + q[k] * re[k]);
            }
        }
        for (k, parts) in out.iter_mut().enumerate() {
            for (part, out) in parts.iter_mut().enumerate() {
                out.extend(block[..samples.len()].iter().map(|now| now[part][k]));
            }
        }
    }
    out
}

/// Columns of drives: `direct` lags from `-lead` on, and the states of every mode, drive by drive; one matrix a
/// segment.
pub(super) fn columns(
    drives: &[Track],
    segments: &[Segment],
    poles: &Poles,
    lead: usize,
    direct: usize,
) -> Vec<Mat<f64>> {
    columns_beside(drives, &[], segments, poles, lead, direct)
}

/// The same, then the states of every mode alone that `forces` drive.
pub(super) fn columns_beside(
    drives: &[Track],
    forces: &[Track],
    segments: &[Segment],
    poles: &Poles,
    lead: usize,
    direct: usize,
) -> Vec<Mat<f64>> {
    let of_drives: Vec<Vec<Track>> = drives.par_iter().map(|d| poles.filter(d)).collect();
    let of_forces: Vec<Vec<Track>> = forces.par_iter().map(|d| poles.filter(d)).collect();
    segments
        .par_iter()
        .map(|segment| {
            let late = |track: &Track, lag| delayed(&track[segment.record], segment, lag);
            let mut all: Vec<Vec<f64>> = Vec::new();
            for (drive, states) in drives.iter().zip(&of_drives) {
                all.extend((0..direct).map(|k| late(drive, k as isize - lead as isize)));
                all.extend(states.iter().map(|state| late(state, 0)));
            }
            all.extend(of_forces.iter().flatten().map(|state| late(state, 0)));
            from_columns(segment.rows.len(), &all)
        })
        .collect()
}

/// Relocates poles for some rounds, fewer where they rest; `None` where a round fails. `forces` drive the modes alone.
pub(super) fn relocate(
    start: Poles,
    drives: &[Track],
    forces: &[Track],
    responses: &[Track],
    segments: &[Segment],
    direct: usize,
) -> Option<Poles> {
    let mut poles = start;
    for _ in 0..ROUNDS {
        let base = columns_beside(drives, forces, segments, &poles, 0, direct);
        let p = base.first()?.ncols();
        let mut a = Mat::<f64>::zeros(p, p);
        for x in &base {
            a += x.transpose() * x;
        }
        for k in 0..p {
            a[(k, k)] += RIDGE * a[(k, k)] + 1e-300;
        }
        let factor = Cholesky::new(&a)?;
        let n = poles.states();
        let of_responses: Vec<(Mat<f64>, Mat<f64>)> = responses
            .par_iter()
            .map(|response| {
                let states = poles.filter(response);
                let (mut cross, mut gram, mut with, mut by) =
                    (Mat::zeros(p, n), Mat::zeros(n, n), Mat::zeros(n, 1), Mat::zeros(p, 1));
                let mut yy = 0.0;
                for (segment, x) in segments.iter().zip(&base) {
                    let rows = segment.rows.len();
                    let s: Vec<_> = states.iter().map(|s| delayed(&s[segment.record], segment, 0)).collect();
                    let s = from_columns(rows, &s);
                    let y = from_columns(rows, &[delayed(&response[segment.record], segment, 0)]);
                    cross += x.transpose() * &s;
                    gram += s.transpose() * &s;
                    with += transposed_times(&s, &y);
                    by += transposed_times(x, &y);
                    yy += (0..y.nrows()).map(|r| y[(r, 0)] * y[(r, 0)]).sum::<f64>();
                }
                let scale = if yy > 0.0 { 1.0 / yy } else { 0.0 };
                let solved = factor.solve(&cross);
                (
                    Mat::from_fn(n, n, |r, c| scale * gram[(r, c)])
                        - faer::Scale(scale) * (cross.transpose() * &solved),
                    faer::Scale(scale) * (with - solved.transpose() * by),
                )
            })
            .collect();
        let (mut gram, mut with) = (Mat::<f64>::zeros(n, n), Mat::<f64>::zeros(n, 1));
        for (g, w) in &of_responses {
            gram += g;
            with += w;
        }
        for k in 0..n {
            gram[(k, k)] += RIDGE * gram[(k, k)] + 1e-300;
        }
        let found = Cholesky::new(&gram)?.solve(&with);
        let d: Vec<f64> = (0..n).map(|k| -found[(k, 0)]).collect();
        if !d.iter().all(|d| d.is_finite()) {
            return None;
        }
        let next = poles.relocated(&d)?;
        if next == poles {
            break;
        }
        poles = next;
    }
    Some(poles)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn poles_move_to_those_of_the_system_and_stay() {
        let true_pole = Complex64::from_polar(0.98, 0.4);
        let mut state = 1_u64;
        let mut next = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as f64 / f64::from(1_u32 << 31) - 0.5
        };
        let drive: Track = vec![(0..1500).map(|_| next()).collect()];
        let response = Poles(vec![true_pole]).filter(&drive)[1].clone();
        let segments = [Segment { record: 0, rows: 200..1500, group: 0, part: 0, unit: 0, weight: 1.0 }];
        let found = relocate(Poles::spread(2, 0.4), &[drive], &[], &[response], &segments, 2).unwrap();
        let nearest = found.0.iter().map(|p| (p - true_pole).norm()).fold(f64::INFINITY, f64::min);
        assert!(nearest < 1e-6, "{found:?}");
    }

    #[test]
    fn a_force_that_drives_the_modes_alone_moves_no_poles() {
        let true_pole = Complex64::from_polar(0.98, 0.4);
        let wave = |f: f64, k: usize| (f * k as f64).sin();
        let track = |of: &dyn Fn(usize) -> f64| -> Track { vec![(0..1500).map(of).collect()] };
        let drive = track(&|k| wave(0.31, k) + wave(0.44, k) + wave(0.9, k) + wave(1.7, k));
        let force = track(&|k| 3.0 * (wave(0.47, k) + wave(0.36, k) + wave(1.1, k)));
        let both: Track = vec![drive[0].iter().zip(&force[0]).map(|(u, f)| u + f).collect()];
        let response = Poles(vec![true_pole]).filter(&both)[1].clone();
        let segments = [Segment { record: 0, rows: 300..1500, group: 0, part: 0, unit: 0, weight: 1.0 }];
        let nearest = |forces: &[Track]| {
            let start = Poles::spread(1, 0.4);
            let drives = std::slice::from_ref(&drive);
            let found =
                relocate(start, drives, forces, std::slice::from_ref(&response), &segments, 2).unwrap();
            found.0.iter().map(|p| (p - true_pole).norm()).fold(f64::INFINITY, f64::min)
        };
        let (beside, alone) = (nearest(std::slice::from_ref(&force)), nearest(&[]));
        assert!(beside < 1e-5 && alone > 1e-2, "{beside} {alone}");
    }

    #[test]
    fn modes_that_are_struck_follow_and_modes_that_are_held_back_do_not() {
        let poles = Poles(vec![Complex64::from_polar(0.95, 1.9), Complex64::from_polar(0.98, 0.3)]);
        // Coefficients of a sum of `p^n`, whose states are a sample late.
        let of = |parts: [Complex64; 2]| -> Vec<f64> {
            let late = |(part, pole): (Complex64, &Complex64)| {
                let now = part * pole;
                [now.re, -now.im]
            };
            parts.into_iter().zip(&poles.0).flat_map(late).collect()
        };
        let (sine, cosine) = (Complex64::new(0.0, -1.0), Complex64::new(1.0, 0.0));
        for (parts, rates, expected) in
            [([sine; 2], 0, 1.0), ([-sine; 2], 0, -1.0), ([cosine; 2], 1, 1.0), ([-sine; 2], 2, 1.0)]
        {
            assert!((poles.follows(&of(parts), rates) - expected).abs() < 1e-12, "{parts:?} {rates}");
        }
        assert!(poles.follows(&of([sine, -sine]), 0).abs() < 0.9);
    }

    #[test]
    fn many_poles_side_by_side_are_each_by_itself() {
        let pole = |k: usize| {
            if k == 4 {
                Complex64::new(0.7, 0.0)
            } else {
                Complex64::from_polar(0.99 - 0.02 * k as f64, 0.2 * k as f64 + 0.1)
            }
        };
        let poles = Poles((0..TOGETHER + 3).map(pole).collect());
        let record = |n: usize| -> Vec<f64> { (0..n).map(|k| 0.5 + (0.3 * k as f64).sin()).collect() };
        let track = vec![record(2 * BLOCK + 7), Vec::new(), record(3)];
        let mut found = poles.filter(&track).into_iter();
        for pole in &poles.0 {
            let alone = |x: &Vec<f64>| -> Vec<Complex64> {
                let mut z = x.first().map_or(Complex64::default(), |x| Complex64::from(*x) / (1.0 - pole));
                let mut step = |x: &f64| {
                    let now = z;
                    z = pole * z + x;
                    now
                };
                x.iter().map(&mut step).collect()
            };
            let states: Vec<Vec<Complex64>> = track.iter().map(alone).collect();
            let of = |part: fn(&Complex64) -> f64| -> Track {
                states.iter().map(|record| record.iter().map(part).collect()).collect()
            };
            assert_eq!(found.next(), Some(of(|z| z.re)));
            if pole.im != 0.0 {
                assert_eq!(found.next(), Some(of(|z| z.im)));
            }
        }
        assert_eq!(found.next(), None);
    }

    #[test]
    fn states_and_impulse_responses_agree() {
        let poles = Poles(vec![Complex64::new(0.5, 0.0), Complex64::new(0.3, 0.6)]);
        let mut pulse = vec![0.0; 12];
        pulse[1] = 1.0;
        let states = poles.filter(&vec![pulse]);
        let coefficients = [2.0, -1.0, 0.5];
        let impulse = poles.impulse(&coefficients, 11);
        for k in 0..11 {
            let output: f64 = coefficients.iter().zip(&states).map(|(c, s)| c * s[0][k + 1]).sum();
            assert!((output - impulse[k]).abs() < 1e-12, "{k}");
        }
    }
}
