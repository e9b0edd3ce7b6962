//! Inference of many windows at once: sixteen windows in the lanes of a vector, all time steps of
//! a group of windows in one go, weights and state in the nearest caches.

use super::activation::{SIGMOID_SCALE, TANH_SCALE, output, state};
use super::params::{BlockShape, GATES, Shape};
use super::product::{pack, product};
use crate::simd::{Kernel, Lanes, Simd};

/// Factors of the activations that are folded into the weights, in gate order.
pub(super) const GATE_SCALE: [f32; GATES] = [SIGMOID_SCALE, SIGMOID_SCALE, TANH_SCALE, SIGMOID_SCALE];

/// Weights in the order in which the forward kernels read them, `R` rows (`R / 4` cells) at a time.
pub(super) struct Packed<const R: usize> {
    pub shape: Shape,
    /// Per block `[rows / R][columns][R]`, the activations' factors folded in.
    pub gates: Vec<Vec<[f32; R]>>,
    /// `[outputs / R][columns][R]`.
    pub fc: Vec<[f32; R]>,
}

impl<const R: usize> Packed<R> {
    /// Packs a row of weights.
    pub(super) fn new(shape: &Shape, row: &[f32]) -> Self {
        let gates = vec![Vec::new(); shape.blocks.len()];
        let mut packed = Self { shape: shape.clone(), gates, fc: Vec::new() };
        packed.set(row);
        packed
    }

    /// Packs other weights of the same shape.
    pub(super) fn set(&mut self, row: &[f32]) {
        for (block, to) in self.shape.blocks.iter().zip(&mut self.gates) {
            let (weights, columns) = (&row[block.at..block.end()], block.columns());
            pack(block.rows(), columns, to, |r, c| weights[r * columns + c] * GATE_SCALE[r % GATES]);
        }
        let (weights, columns) = (&row[self.shape.fc_at()..], self.shape.fc_columns());
        pack(self.shape.outputs, columns, &mut self.fc, |r, c| weights[r * columns + c]);
    }
}

/// State of `NV * 16` windows between steps.
pub(super) struct State<const NV: usize> {
    blocks: Vec<BlockState<NV>>,
}

struct BlockState<const NV: usize> {
    /// Step vector `[x, 1, h]` that is read.
    now: Vec<[Lanes; NV]>,
    /// Step vector whose `h` is written.
    next: Vec<[Lanes; NV]>,
    /// Cell states.
    c: Vec<[Lanes; NV]>,
}

impl<const NV: usize> State<NV> {
    /// The zero state at the start of a window.
    pub(super) fn new(shape: &Shape) -> Self {
        let blocks = shape
            .blocks
            .iter()
            .map(|b| {
                let mut z = vec![[Lanes::ZERO; NV]; b.stride()];
                z[b.inputs] = [Lanes::ONE; NV];
                BlockState { now: z.clone(), next: z, c: vec![[Lanes::ZERO; NV]; b.padded_cells()] }
            })
            .collect();
        Self { blocks }
    }

    /// Sets the state to zero.
    pub(super) fn reset(&mut self, shape: &Shape) {
        for (state, block) in self.blocks.iter_mut().zip(&shape.blocks) {
            state.now[block.inputs + 1..].fill([Lanes::ZERO; NV]);
            state.c.fill([Lanes::ZERO; NV]);
        }
    }
}

/// Some steps of `NV * 16` windows.
pub(super) struct Forward<'a, const R: usize, const NV: usize> {
    pub weights: &'a Packed<R>,
    pub state: &'a mut State<NV>,
    /// `[step][input]`.
    pub x: &'a [[Lanes; NV]],
    /// `[step][output]`.
    pub y: &'a mut [[Lanes; NV]],
}

impl<const R: usize, const NV: usize> Kernel for Forward<'_, R, NV> {
    type Out = ();
    const WIDE: bool = R * NV >= 16;

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let shape = &self.weights.shape;
        let (inputs, outputs) = (shape.blocks[0].inputs, shape.outputs);
        let steps = self.x.chunks_exact(inputs).zip(self.y.chunks_exact_mut(outputs));
        for (x, y) in steps {
            self.state.blocks[0].now[..inputs].copy_from_slice(x);
            for b in 0..shape.blocks.len() {
                if b > 0 {
                    // The block before has swapped: its newest output is in `now`.
                    let inputs = shape.blocks[b].inputs;
                    let (below, here) = self.state.blocks.split_at_mut(b);
                    let from = shape.blocks[b - 1];
                    let h = &below[b - 1].now[from.inputs + 1..][..from.cells];
                    here[0].now[..inputs].copy_from_slice(h);
                }
                let block = &mut self.state.blocks[b];
                step_block::<S, R, NV>(s, &self.weights.gates[b], shape.blocks[b], block);
                std::mem::swap(&mut block.now, &mut block.next);
            }
            let last = shape.last();
            let h = &self.state.blocks[shape.blocks.len() - 1].now[last.inputs..][..1 + last.cells];
            connect::<S, R, NV>(s, &self.weights.fc, h, y);
        }
    }
}

/// One step of one block: `next.h` and `c` from `now`.
#[inline(always)]
fn step_block<S: Simd, const R: usize, const NV: usize>(
    s: S,
    weights: &[[f32; R]],
    block: BlockShape,
    memory: &mut BlockState<NV>,
) {
    let now = &memory.now[..block.columns()];
    let h = memory.next[block.inputs + 1..].chunks_exact_mut(R / GATES);
    let groups = weights.chunks_exact(now.len()).zip(memory.c.chunks_exact_mut(R / GATES).zip(h));
    for (w, (c, h)) in groups {
        let a = product::<S, R, NV>(s, w, now);
        // All states first, then all outputs: each is a long chain of dependent operations, and the
        // processor runs several of them at once.
        let mut c_new = [[s.splat(0.0); NV]; R];
        for k in 0..R / GATES {
            for v in 0..NV {
                let gates = [a[4 * k][v], a[4 * k + 1][v], a[4 * k + 2][v]];
                c_new[k][v] = state(s, gates, s.load(&c[k][v]));
                s.store(&mut c[k][v], c_new[k][v]);
            }
        }
        for k in 0..R / GATES {
            for v in 0..NV {
                s.store(&mut h[k][v], output(s, a[4 * k + 3][v], c_new[k][v]));
            }
        }
    }
}

/// The fully connected layer; `z` is `[1, h]`.
#[inline(always)]
pub(super) fn connect<S: Simd, const R: usize, const NV: usize>(
    s: S,
    weights: &[[f32; R]],
    z: &[[Lanes; NV]],
    y: &mut [[Lanes; NV]],
) {
    for (w, y) in weights.chunks_exact(z.len()).zip(y.chunks_mut(R)) {
        let a = product::<S, R, NV>(s, w, z);
        for (y, a) in y.iter_mut().zip(a) {
            for v in 0..NV {
                s.store(&mut y[v], a[v]);
            }
        }
    }
}
