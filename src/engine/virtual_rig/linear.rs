//! The exact FRF of the bench's linear part.

use faer::Mat;
use realfft::num_complex::Complex64;
use rigcast_numerics::decompose;

use super::integrate::SUBSTEPS;
use super::plant::{Plant, State, row};
use super::{Effects, SAMPLE_RATE_HZ, VirtualRig};

/// Rows of the state without friction, which has no force in the linear bench.
const LINEAR_ROWS: usize = row::FRICTION;
const ORDER: usize = 3 * LINEAR_ROWS;

/// Typical magnitude of each row, which keeps the matrices well conditioned.
const SCALE: [f64; LINEAR_ROWS] = [1e-3, 0.1, 1e6, 0.1, 10.0, 0.1, 1e-3, 0.1];

impl VirtualRig {
    /// FRF of the linear part (non-linear effects off) at `freq_hz`: `[line][response][drive]` with
    /// exp(+j w t), responses as in [`Self::simulate`], mm/kN and kN/kN.
    ///
    /// It is that of the sampled simulation itself: one sample is the linear map
    /// `x' = Phi x + G0 r + G1 r'`, so that `H = C (z I - Phi)^-1 (G0 + z G1)`, z = exp(j w / rate).
    pub fn linear_response(&self, freq_hz: &[f64]) -> Vec<[[Complex64; 3]; 6]> {
        let plant = Plant::new(&self.bench, &self.axes, &Effects::none());
        let dt = 1.0 / SAMPLE_RATE_HZ;
        let step = |state: &State, from: &[f64; 3], to: &[f64; 3]| {
            scaled(&plant.next_sample(state, from, to, dt, SUBSTEPS))
        };
        // A command of 1 kN: columns then are per kN.
        let unit = |axis: usize| -> [f64; 3] { std::array::from_fn(|i| if i == axis { 1e3 } else { 0.0 }) };
        let none = [0.0; 3];
        let phi: Vec<[f64; ORDER]> = (0..ORDER).map(|j| step(&basis(j), &none, &none)).collect();
        let from: Vec<[f64; ORDER]> = (0..3).map(|i| step(&State::ZERO, &unit(i), &none)).collect();
        let to: Vec<[f64; ORDER]> = (0..3).map(|i| step(&State::ZERO, &none, &unit(i))).collect();
        let seen: Vec<[f64; 6]> = (0..ORDER)
            .map(|j| {
                let (stroke, force) = plant.measured(&basis(j));
                std::array::from_fn(|r| if r < 3 { stroke[r] * 1e3 } else { force[r - 3] * 1e-3 })
            })
            .collect();

        freq_hz
            .iter()
            .map(|f| {
                let z = Complex64::cis(2.0 * std::f64::consts::PI * f * dt);
                let resolvent = Mat::from_fn(ORDER, ORDER, |i, j| {
                    let diagonal = if i == j { z } else { Complex64::ZERO };
                    diagonal - phi[j][i]
                });
                let excited = Mat::from_fn(ORDER, 3, |i, drive| z * to[drive][i] + from[drive][i]);
                let states = decompose::solve(&resolvent, &excited);
                std::array::from_fn(|response| {
                    std::array::from_fn(|drive| {
                        (0..ORDER).map(|j| states[(j, drive)] * seen[j][response]).sum()
                    })
                })
            })
            .collect()
    }
}

/// State with one entry at its typical magnitude.
fn basis(index: usize) -> State {
    let mut state = State::ZERO;
    state.0[index / 3][index % 3] = SCALE[index / 3];
    state
}

fn scaled(state: &State) -> [f64; ORDER] {
    std::array::from_fn(|index| state.0[index / 3][index % 3] / SCALE[index / 3])
}
