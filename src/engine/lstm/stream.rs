//! Inference of one long signal with the state carried through: sixteen cells in the lanes.

use super::activation::{output, state};
use super::forward::GATE_SCALE;
use super::params::{GATES, Shape};
use crate::simd::{Kernel, LANES, Lanes, Simd};

/// Weights for one lane a cell.
pub(super) struct StreamWeights {
    shape: Shape,
    /// Per block `[cells / 16][columns][gate]`, sixteen cells in the lanes, zero after the last cell.
    gates: Vec<Vec<[Lanes; GATES]>>,
    /// `[outputs / 16][columns]`, sixteen outputs in the lanes.
    fc: Vec<Lanes>,
}

impl StreamWeights {
    /// Packs a row of weights.
    pub(super) fn new(shape: &Shape, row: &[f32]) -> Self {
        let mut gates = Vec::with_capacity(shape.blocks.len());
        for block in &shape.blocks {
            let (weights, columns) = (&row[block.at..block.end()], block.columns());
            let mut packed = vec![[Lanes::ZERO; GATES]; block.cells.div_ceil(LANES) * columns];
            for (r, weights) in weights.chunks_exact(columns).enumerate() {
                let (cell, gate) = (r / GATES, r % GATES);
                for (c, &w) in weights.iter().enumerate() {
                    packed[cell / LANES * columns + c][gate].0[cell % LANES] = w * GATE_SCALE[gate];
                }
            }
            gates.push(packed);
        }
        let columns = shape.fc_columns();
        let mut fc = vec![Lanes::ZERO; shape.outputs.div_ceil(LANES) * columns];
        for (o, weights) in row[shape.fc_at()..].chunks_exact(columns).enumerate() {
            for (c, &w) in weights.iter().enumerate() {
                fc[o / LANES * columns + c].0[o % LANES] = w;
            }
        }
        Self { shape: shape.clone(), gates, fc }
    }
}

/// The state that is carried from sample to sample.
pub(super) struct StreamState {
    /// Step vectors [x, 1, h] of each block, h padded to whole vectors.
    z: Vec<Vec<f32>>,
    c: Vec<Vec<Lanes>>,
    h: Vec<Vec<Lanes>>,
}

impl StreamState {
    /// The zero state.
    pub(super) fn new(shape: &Shape) -> Self {
        let z = shape.blocks.iter().map(|b| {
            let mut z = vec![0.0; b.inputs + 1 + b.cells.next_multiple_of(LANES)];
            z[b.inputs] = 1.0;
            z
        });
        let c: Vec<Vec<Lanes>> =
            shape.blocks.iter().map(|b| vec![Lanes::ZERO; b.cells.div_ceil(LANES)]).collect();
        Self { z: z.collect(), h: c.clone(), c }
    }
}

/// Computes `y`, `[sample][output]`, from the samples `x`, `[sample][input]`, and advances the state.
pub(super) struct Stream<'a> {
    pub weights: &'a StreamWeights,
    pub state: &'a mut StreamState,
    pub x: &'a [f32],
    pub y: &'a mut [f32],
    /// Steps before the samples in which the first one is held.
    pub pre_roll: usize,
}

impl Kernel for Stream<'_> {
    type Out = ();
    const WIDE: bool = false;

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let shape = &self.weights.shape;
        let inputs = shape.blocks[0].inputs;
        let StreamState { z, c, h } = self.state;

        for _ in 0..self.pre_roll {
            step(s, self.weights, &self.x[..inputs], z, c, h);
        }
        let samples = self.x.chunks_exact(inputs).zip(self.y.chunks_exact_mut(shape.outputs));
        for (x, y) in samples {
            step(s, self.weights, x, z, c, h);
            let last = shape.last();
            let hidden = &z[shape.blocks.len() - 1][last.inputs..][..shape.fc_columns()];
            for (w, y) in self.weights.fc.chunks_exact(hidden.len()).zip(y.chunks_mut(LANES)) {
                let (mut even, mut odd) = (s.splat(0.0), s.splat(0.0));
                let (pairs, rest) = w.as_chunks::<2>();
                let (h_pairs, h_rest) = hidden.as_chunks::<2>();
                for (w, h) in pairs.iter().zip(h_pairs) {
                    even = s.mul_add(s.load(&w[0]), s.splat(h[0]), even);
                    odd = s.mul_add(s.load(&w[1]), s.splat(h[1]), odd);
                }
                for (w, &h) in rest.iter().zip(h_rest) {
                    even = s.mul_add(s.load(w), s.splat(h), even);
                }
                let mut out = Lanes::ZERO;
                s.store(&mut out, s.add(even, odd));
                y.copy_from_slice(&out.0[..y.len()]);
            }
        }
    }
}

/// One step of all blocks; afterwards the `h` in `z` is the new one.
#[inline(always)]
fn step<S: Simd>(
    s: S,
    weights: &StreamWeights,
    x: &[f32],
    z: &mut [Vec<f32>],
    c: &mut [Vec<Lanes>],
    h: &mut [Vec<Lanes>],
) {
    z[0][..x.len()].copy_from_slice(x);
    for (b, block) in weights.shape.blocks.iter().enumerate() {
        if b > 0 {
            let (below, here) = z.split_at_mut(b);
            let from = weights.shape.blocks[b - 1].inputs + 1;
            here[0][..block.inputs].copy_from_slice(&below[b - 1][from..][..block.inputs]);
        }
        let columns = block.columns();
        let groups = weights.gates[b].chunks_exact(columns).zip(c[b].iter_mut().zip(&mut h[b]));
        for (w, (c, h)) in groups {
            // Even and odd columns apart: a single chain of sums would stall on its own latency.
            let (mut even, mut odd) = ([s.splat(0.0); GATES], [s.splat(0.0); GATES]);
            let (pairs, rest) = w.as_chunks::<2>();
            let (z_pairs, z_rest) = z[b][..columns].as_chunks::<2>();
            for (w, z) in pairs.iter().zip(z_pairs) {
                let (z0, z1) = (s.splat(z[0]), s.splat(z[1]));
                for g in 0..GATES {
                    even[g] = s.mul_add(s.load(&w[0][g]), z0, even[g]);
                    odd[g] = s.mul_add(s.load(&w[1][g]), z1, odd[g]);
                }
            }
            for (w, &z) in rest.iter().zip(z_rest) {
                for g in 0..GATES {
                    even[g] = s.mul_add(s.load(&w[g]), s.splat(z), even[g]);
                }
            }
            for g in 0..GATES {
                even[g] = s.add(even[g], odd[g]);
            }
            let [i, f, g, o] = even;
            let c_new = state(s, [i, f, g], s.load(c));
            s.store(c, c_new);
            s.store(h, output(s, o, c_new));
        }
        for (to, from) in z[b][block.inputs + 1..].chunks_exact_mut(LANES).zip(&h[b]) {
            to.copy_from_slice(&from.0);
        }
    }
}
