//! Poles in the z-plane as a block-diagonal state space, the basis that every linear part shares.
//!
//! A real pole `p` is one state, `s+ = p s + e`; a conjugate pair `p, conj p` two, which turn with
//! `[[re p, -im p], [im p, re p]]`. The output sums each real state and the first of each pair.
//! An input vector `e` of [`Modes::order`] entries then places the zeros freely: with poles given,
//! everything is linear in it.

use realfft::num_complex::Complex64;
use serde::{Deserialize, Serialize};

use crate::simd::{Isa, Kernel, Simd, dispatch};

/// Nearest that a pole may come to the unit circle: a memory of a million samples.
const LARGEST: f64 = 1.0 - 1e-6;
/// Poles whose states a filter turns side by side.
const TOGETHER: usize = 8;

/// One real pole or one conjugate pair (its member with the positive imaginary part).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(from = "Parts", into = "Parts")]
pub enum Pole {
    /// One state.
    Real(f64),
    /// Two states.
    Pair(Complex64),
}

/// A pole as it is stored.
#[derive(Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Parts {
    Real(f64),
    Pair([f64; 2]),
}

impl From<Parts> for Pole {
    fn from(parts: Parts) -> Self {
        match parts {
            Parts::Real(p) => Self::Real(p),
            Parts::Pair([re, im]) => Self::Pair(Complex64::new(re, im)),
        }
    }
}

impl From<Pole> for Parts {
    fn from(pole: Pole) -> Self {
        match pole {
            Pole::Real(p) => Self::Real(p),
            Pole::Pair(p) => Self::Pair([p.re, p.im]),
        }
    }
}

impl Pole {
    /// Distance from the origin of the z-plane.
    pub fn radius(self) -> f64 {
        match self {
            Self::Real(p) => p.abs(),
            Self::Pair(p) => p.norm(),
        }
    }

    /// Samples until it has fallen to `share`.
    pub fn ring_down(self, share: f64) -> usize {
        let r = self.radius();
        if r < 1e-6 { 1 } else { (share.ln() / r.ln()).ceil().max(1.0) as usize }
    }
}

/// Poles of one linear system, each inside the unit circle.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Modes {
    poles: Vec<Pole>,
}

impl Modes {
    /// From z-plane values: conjugates are paired, what lies on or outside the unit circle is
    /// reflected into it (same magnitude response).
    pub fn of_values(values: &[Complex64]) -> Self {
        let mut poles = Vec::with_capacity(values.len());
        for &z in values {
            let r = z.norm();
            let z = if r > 1.0 { z / (r * r) } else { z };
            let z = if z.norm() > LARGEST { z * (LARGEST / z.norm()) } else { z };
            if z.im.abs() <= 1e-9 * (1.0 + z.re.abs()) {
                poles.push(Pole::Real(z.re));
            } else if z.im > 0.0 {
                poles.push(Pole::Pair(z));
            }
        }
        Self { poles }
    }

    /// The same modes at a sample rate `times` as high.
    pub fn faster(&self, times: usize) -> Self {
        let share = 1.0 / times as f64;
        let faster = |pole: &Pole| match *pole {
            // A negative real pole turns once a sample; at the higher rate nothing does.
            Pole::Real(p) => Pole::Real(p.abs().powf(share)),
            Pole::Pair(p) => Pole::Pair(Complex64::from_polar(p.norm().powf(share), p.arg() * share)),
        };
        Self { poles: self.poles.iter().map(faster).collect() }
    }

    /// The poles, in the order of the states.
    pub fn poles(&self) -> &[Pole] {
        &self.poles
    }

    /// Number of states.
    pub fn order(&self) -> usize {
        self.poles.iter().map(|p| if matches!(p, Pole::Real(_)) { 1 } else { 2 }).sum()
    }

    /// Samples until the slowest mode has fallen to `share`.
    pub fn ring_down(&self, share: f64) -> usize {
        self.poles.iter().map(|pole| pole.ring_down(share)).max().unwrap_or(1)
    }

    /// The poles that pass.
    pub fn only(&self, keep: impl Fn(&Pole) -> bool) -> Self {
        Self { poles: self.poles.iter().copied().filter(keep).collect() }
    }

    /// `x <- A x`.
    #[inline]
    pub fn turn(&self, x: &mut [f64]) {
        let mut at = 0;
        for pole in &self.poles {
            match *pole {
                Pole::Real(p) => {
                    x[at] *= p;
                    at += 1;
                }
                Pole::Pair(p) => {
                    let (a, b) = (x[at], x[at + 1]);
                    x[at] = p.re * a - p.im * b;
                    x[at + 1] = p.im * a + p.re * b;
                    at += 2;
                }
            }
        }
    }

    /// `C x`.
    #[inline]
    pub fn read(&self, x: &[f64]) -> f64 {
        let mut at = 0;
        let mut sum = 0.0;
        for pole in &self.poles {
            sum += x[at];
            at += if matches!(pole, Pole::Real(_)) { 1 } else { 2 };
        }
        sum
    }

    /// Output of a unit input vector per state, `[state][sample]`: with input vector `e` the
    /// system's output is `sum_n e_n basis_n`. Sample `k` knows the input up to `k - 1`.
    pub fn basis(&self, input: &[f64]) -> Vec<Vec<f64>> {
        let mut out = Vec::with_capacity(self.order());
        for pole in &self.poles {
            match *pole {
                Pole::Real(p) => {
                    let mut s = 0.0;
                    out.push(
                        input
                            .iter()
                            .map(|x| {
                                let y = s;
                                s = p * s + x;
                                y
                            })
                            .collect(),
                    );
                }
                Pole::Pair(p) => {
                    let (mut a, mut b) = (0.0, 0.0);
                    let mut first = Vec::with_capacity(input.len());
                    let mut second = Vec::with_capacity(input.len());
                    for x in input {
                        first.push(a);
                        second.push(-b);
                        (a, b) = (p.re * a - p.im * b + x, p.im * a + p.re * b);
                    }
                    out.push(first);
                    out.push(second);
                }
            }
        }
        out
    }

    /// Free decays from each state, `[state][sample]`.
    pub fn decays(&self, samples: usize) -> Vec<Vec<f64>> {
        let mut pulse = vec![0.0; samples + 1];
        pulse[0] = 1.0;
        self.basis(&pulse).into_iter().map(|decay| decay[1..].to_vec()).collect()
    }

    /// Output for input vector `e`.
    ///
    /// # Panics
    /// If `e` has not [`Modes::order`] entries.
    pub fn filter(&self, e: &[f64], input: &[f64]) -> Vec<f64> {
        assert_eq!(e.len(), self.order(), "an input vector has one entry a state");
        let mut out = vec![0.0; input.len()];
        let isa = Isa::of_plain_loops();
        // So many poles at a time turn side by side.
        let mut at = 0;
        for poles in self.poles.chunks(TOGETHER) {
            let [mut re, mut im, mut cos, mut sin] = [[0.0; TOGETHER]; 4];
            for (k, pole) in poles.iter().enumerate() {
                cos[k] = e[at];
                at += 1;
                match *pole {
                    Pole::Real(p) => re[k] = p,
                    Pole::Pair(p) => {
                        (re[k], im[k], sin[k]) = (p.re, p.im, e[at]);
                        at += 1;
                    }
                }
            }
            let (turn, enter) = ([re, im], [cos, sin]);
            dispatch(isa, Filtering { turn, enter, poles: poles.len(), signal: input, out: &mut out });
        }
        out
    }

    /// Transfer function for input vector `e` at `frequency`, cycles a sample.
    pub fn transfer(&self, e: &[f64], frequency: f64) -> Complex64 {
        let z = Complex64::from_polar(1.0, std::f64::consts::TAU * frequency);
        let mut at = 0;
        let mut sum = Complex64::default();
        for pole in &self.poles {
            match *pole {
                Pole::Real(p) => {
                    sum += e[at] / (z - p);
                    at += 1;
                }
                Pole::Pair(p) => {
                    let e = Complex64::new(e[at], e[at + 1]);
                    sum += 0.5 * (e / (z - p) + e.conj() / (z - p.conj()));
                    at += 2;
                }
            }
        }
        sum
    }

    /// `A` as a full matrix, `[row][column]`.
    pub fn matrix(&self) -> Vec<Vec<f64>> {
        let n = self.order();
        let mut rows = vec![vec![0.0; n]; n];
        for j in 0..n {
            let mut x = vec![0.0; n];
            x[j] = 1.0;
            self.turn(&mut x);
            for (row, x) in rows.iter_mut().zip(&x) {
                row[j] = *x;
            }
        }
        rows
    }

    /// `C` as a row.
    pub fn output_row(&self) -> Vec<f64> {
        let mut row = Vec::with_capacity(self.order());
        for pole in &self.poles {
            row.push(1.0);
            if matches!(pole, Pole::Pair(_)) {
                row.push(0.0);
            }
        }
        row
    }

    /// `A + e C`: the system with feedback of its own output through `e`.
    pub fn fed_back(&self, e: &[f64]) -> Vec<Vec<f64>> {
        let mut matrix = self.matrix();
        let c = self.output_row();
        for (row, e) in matrix.iter_mut().zip(e) {
            for (a, c) in row.iter_mut().zip(&c) {
                *a += e * c;
            }
        }
        matrix
    }
}

/// Adds the output of some poles for a signal to `out`.
struct Filtering<'a> {
    /// What turns the states of each pole, and what a unit of the signal adds to them; real parts first.
    turn: [[f64; TOGETHER]; 2],
    enter: [[f64; TOGETHER]; 2],
    /// Poles; the rest stay at rest.
    poles: usize,
    signal: &'a [f64],
    out: &'a mut [f64],
}

impl Kernel for Filtering<'_> {
    type Out = ();
    const WIDE: bool = false;

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let ([re, im], [cos, sin]) = (self.turn, self.enter);
        let (mut a, mut b) = ([0.0; TOGETHER], [0.0; TOGETHER]);
        for (u, out) in self.signal.iter().zip(self.out) {
            for a in &a[..self.poles] {
                *out += a;
            }
            let (before, beside) = (a, b);
            for k in 0..TOGETHER {
                a[k] = re[k] * before[k] - im[k] * beside[k] + cos[k] * u;
                b[k] = im[k] * before[k] + re[k] * beside[k] + sin[k] * u;
            }
        }
    }
}

/// Natural frequency, Hz, and damping ratio of a z-plane pole; `None` for a real one.
pub fn natural(pole: Pole, sample_rate_hz: f64) -> Option<(f64, f64)> {
    let Pole::Pair(z) = pole else { return None };
    let s = z.ln() * sample_rate_hz;
    Some((s.norm() / std::f64::consts::TAU, -s.re / s.norm()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn modes() -> Modes {
        Modes::of_values(&[
            Complex64::from_polar(0.97, 0.3),
            Complex64::from_polar(0.97, -0.3),
            Complex64::new(0.5, 0.0),
        ])
    }

    #[test]
    fn the_basis_adds_up_to_the_filter() {
        let modes = modes();
        let input: Vec<f64> = (0..200).map(|i| (f64::from(i) * 0.17).sin() + 0.2).collect();
        let e = [0.3, -0.8, 1.4];
        let filtered = modes.filter(&e, &input);
        let basis = modes.basis(&input);
        assert_eq!(basis.len(), 3);
        for (k, y) in filtered.iter().enumerate() {
            let sum: f64 = basis.iter().zip(&e).map(|(b, e)| b[k] * e).sum();
            assert!((y - sum).abs() < 1e-12, "sample {k}");
        }
    }

    #[test]
    fn more_poles_than_turn_side_by_side_add_up_alike() {
        let pair = |k: usize| Complex64::from_polar(0.9 + 0.004 * k as f64, 0.1 + 0.2 * k as f64);
        let real = |k: usize| Complex64::new(0.3 + 0.1 * k as f64, 0.0);
        let values: Vec<Complex64> = (0..TOGETHER).map(pair).chain((0..3).map(real)).collect();
        let modes = Modes::of_values(&values);
        let e: Vec<f64> = (0..modes.order()).map(|i| (0.7 * i as f64).cos()).collect();
        let input: Vec<f64> = (0..300).map(|i| (f64::from(i) * 0.17).sin() + 0.2).collect();
        let basis = modes.basis(&input);
        for (k, y) in modes.filter(&e, &input).iter().enumerate() {
            let sum: f64 = basis.iter().zip(&e).map(|(b, e)| b[k] * e).sum();
            assert!((y - sum).abs() < 1e-10, "sample {k}");
        }
    }

    #[test]
    fn an_impulse_rings_with_the_poles() {
        let modes = modes();
        let mut input = vec![0.0; 40];
        input[0] = 1.0;
        let y = modes.filter(&[1.0, 0.0, 0.0], &input);
        for (k, y) in y.iter().enumerate().skip(1) {
            let n = (k - 1) as f64;
            assert!((y - 0.97_f64.powf(n) * (0.3 * n).cos()).abs() < 1e-12, "sample {k}");
        }
    }

    #[test]
    fn the_transfer_function_is_that_of_the_filter() {
        let (modes, e, f) = (modes(), [0.3, -0.8, 1.4], 0.03);
        let gain = modes.transfer(&e, f);
        let w = std::f64::consts::TAU * f;
        let input: Vec<f64> = (0..2000).map(|k| (w * f64::from(k)).cos()).collect();
        let y = modes.filter(&e, &input);
        for (k, y) in y.iter().enumerate().skip(1500) {
            let expected = (gain * Complex64::from_polar(1.0, w * k as f64)).re;
            assert!((y - expected).abs() < 1e-9, "sample {k}");
        }
    }

    #[test]
    fn poles_outside_the_circle_are_reflected_and_feedback_moves_them() {
        let modes = Modes::of_values(&[Complex64::new(2.0, 0.0)]);
        assert_eq!(modes.poles(), [Pole::Real(0.5)]);
        assert_eq!(modes.fed_back(&[0.3]), [vec![0.8]]);
        assert_eq!(modes.ring_down(0.25), 2);
        assert_eq!(modes.only(|p| p.ring_down(0.25) < 2).order(), 0);
    }

    #[test]
    fn natural_frequency_and_damping_of_an_oscillator_come_back() {
        let (f, zeta, fs) = (12.0_f64, 0.05_f64, 512.0_f64);
        let w = std::f64::consts::TAU * f;
        let s = Complex64::new(-zeta * w, w * (1.0 - zeta * zeta).sqrt());
        let (found, damping) = natural(Pole::Pair((s / fs).exp()), fs).unwrap();
        assert!((found / f - 1.0).abs() < 1e-12 && (damping / zeta - 1.0).abs() < 1e-10);
    }
}
