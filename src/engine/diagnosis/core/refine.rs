//! Output-error refinement: poles and paths together, by Levenberg and Marquardt's method with
//! exact derivatives. Steiglitz and McBride's iteration stops near this optimum, not at it, and what
//! it leaves would grow with the drive.

use super::fit::{Linear, Part};
use super::modes::{Modes, Pole};
use crate::diagnosis::numerics::linear::{dot, from_columns, norm, solve_spd, transposed_times};

/// Jacobians.
const ROUNDS: usize = 12;
/// Relative fall of the error below which nothing more is to be had.
const STILL: f64 = 1e-6;

/// Moves poles and paths to the least squared free-run error.
pub(super) fn refine(parts: &[Part<'_>], start: Linear) -> Linear {
    let mut now = start;
    let mut cost = error(parts, &now);
    let mut damping = 1e-4;
    for _ in 0..ROUNDS {
        let (columns, left) = jacobian(parts, &now);
        let lengths: Vec<f64> = columns.iter().map(|c| norm(c)).collect();
        let unit = |x: f64, length: f64| if length > 0.0 { x / length } else { 0.0 };
        let mut scaled = from_columns(left.len(), &columns);
        for (c, length) in lengths.iter().enumerate() {
            scaled.col_as_slice_mut(c).iter_mut().for_each(|x| *x = unit(*x, *length));
        }
        let product = transposed_times(&scaled, &scaled);
        let of = |r: usize, c: usize| if r == c { 1.0 } else { product[(r, c)] };
        let normal: Vec<Vec<f64>> =
            (0..columns.len()).map(|r| (0..columns.len()).map(|c| of(r, c)).collect()).collect();
        let gradient: Vec<f64> = (0..columns.len()).map(|c| dot(scaled.col_as_slice(c), &left)).collect();
        let before = cost;
        for _ in 0..7 {
            let mut damped = normal.clone();
            damped.iter_mut().enumerate().for_each(|(i, row)| row[i] += damping);
            let next = solve_spd(&damped, &gradient).and_then(|step| {
                let step: Vec<f64> = step.iter().zip(&lengths).map(|(s, l)| unit(*s, *l)).collect();
                moved(&now, &step)
            });
            if let Some(next) = next {
                let next_cost = error(parts, &next);
                if next_cost < cost {
                    (now, cost) = (next, next_cost);
                    damping = (damping * 0.1).max(1e-10);
                    break;
                }
            }
            damping *= 10.0;
        }
        if before - cost <= STILL * before {
            break;
        }
    }
    now
}

fn error(parts: &[Part<'_>], linear: &Linear) -> f64 {
    parts.iter().map(|part| part.error(linear)).sum()
}

/// Rows of the prediction's derivative by each parameter (per drive `D`, then `B`; then the poles),
/// and the rows that are left.
fn jacobian(parts: &[Part<'_>], linear: &Linear) -> (Vec<Vec<f64>>, Vec<f64>) {
    let modes = &linear.modes;
    let mut columns: Vec<Vec<f64>> = Vec::new();
    let mut left = Vec::new();
    for part in parts {
        let mut signals: Vec<Vec<f64>> = Vec::new();
        for drive in &part.drives {
            signals.push(drive.to_vec());
            signals.extend(modes.basis(drive));
        }
        signals.extend(pole_derivatives(linear, &part.drives));
        columns.resize(signals.len(), Vec::new());
        for (column, signal) in columns.iter_mut().zip(&signals) {
            part.rows_of(signal, column);
        }
        part.rows_of(&linear.residual(&part.drives, part.response), &mut left);
    }
    (columns, left)
}

/// Derivative of the output by each pole's real part and, for a pair, by its imaginary part: with
/// `s+ = p s + e u` the derivative obeys `s'+ = p s' + s`.
fn pole_derivatives(linear: &Linear, drives: &[&[f64]]) -> Vec<Vec<f64>> {
    let samples = drives[0].len();
    let mut out = Vec::new();
    let mut at = 0;
    for pole in linear.modes.poles() {
        match *pole {
            Pole::Real(p) => {
                let (mut s, mut ds) = (0.0, 0.0);
                let mut signal = Vec::with_capacity(samples);
                for k in 0..samples {
                    signal.push(ds);
                    ds = p * ds + s;
                    s = p * s + drives.iter().zip(&linear.input).map(|(u, e)| u[k] * e[at]).sum::<f64>();
                }
                out.push(signal);
                at += 1;
            }
            Pole::Pair(p) => {
                let (mut s, mut ds) = ((0.0, 0.0), (0.0, 0.0));
                let (mut real, mut imaginary) = (Vec::with_capacity(samples), Vec::with_capacity(samples));
                for k in 0..samples {
                    real.push(ds.0);
                    imaginary.push(-ds.1);
                    ds = (p.re * ds.0 - p.im * ds.1 + s.0, p.im * ds.0 + p.re * ds.1 + s.1);
                    let (mut a, mut b) = (0.0, 0.0);
                    for (u, e) in drives.iter().zip(&linear.input) {
                        a += u[k] * e[at];
                        b += u[k] * e[at + 1];
                    }
                    s = (p.re * s.0 - p.im * s.1 + a, p.im * s.0 + p.re * s.1 + b);
                }
                out.push(real);
                out.push(imaginary);
                at += 2;
            }
        }
    }
    out
}

/// The model after a step; `None` if a pole would leave the unit circle.
fn moved(linear: &Linear, step: &[f64]) -> Option<Linear> {
    let order = linear.modes.order();
    let (mut input, mut direct) = (linear.input.clone(), linear.direct.clone());
    for (d, step) in step.chunks(order + 1).take(direct.len()).enumerate() {
        direct[d] += step[0];
        input[d].iter_mut().zip(&step[1..]).for_each(|(b, s)| *b += s);
    }
    let mut step = step[direct.len() * (order + 1)..].iter();
    let mut values = Vec::new();
    for pole in linear.modes.poles() {
        match *pole {
            Pole::Real(p) => values.push((p + step.next()?).into()),
            Pole::Pair(mut p) => {
                p.re += step.next()?;
                p.im += step.next()?;
                if p.im <= 0.0 {
                    return None;
                }
                values.extend([p, p.conj()]);
            }
        }
    }
    if values.iter().any(|p: &realfft::num_complex::Complex64| p.norm() >= 1.0 - 1e-6) {
        return None;
    }
    let modes = Modes::of_values(&values);
    (modes.order() == order).then_some(Linear { modes, input, direct })
}
