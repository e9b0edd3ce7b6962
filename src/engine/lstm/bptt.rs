//! Back-propagation through time for sixteen windows at once, in the lanes of the forward kernels.
//!
//! The forward pass keeps the step vectors `[x, 1, h]`, the gates and the cell states for the backward
//! pass. The backward pass writes the errors of the gate pre-activations per step. The gradient of the
//! weights is then one product of errors and step vectors over all steps and lanes.

mod input_gradient;

use super::activation::{TANH_SCALE, sigmoid, tanh};
use super::forward::{Packed, connect};
use super::params::{BlockShape, GATES, Shape};
use super::product::{Steps, outer, pack, product};
use crate::simd::{Kernel, LANES, Lanes, Simd};

pub(super) use input_gradient::InputGradient;

/// Kept per cell and step: gates i, f, g, o, the cell state and its tanh.
const KEPT: usize = 6;

/// Steps whose share of the gradient is summed at once, while they are in the cache.
const STEPS_PER_PASS: usize = 32;

/// Weights in the order in which the forward and the backward pass read them.
pub(super) struct TrainWeights<const R: usize> {
    /// Weights of the forward pass.
    pub forward: Packed<R>,
    back: Vec<BackBlock<R>>,
}

struct BackBlock<const R: usize> {
    /// `[cells / R][errors][R]`: from the errors of the next step's gates, and in the last block of
    /// this step's outputs, to those of this step's `h`.
    hidden: Vec<[f32; R]>,
    /// `[inputs / R][gate rows][R]`: to the block below; in the first, to the network's inputs, and empty unless those
    /// are asked for.
    inputs: Vec<[f32; R]>,
}

impl<const R: usize> TrainWeights<R> {
    /// Packs a row of weights.
    pub(super) fn new(shape: &Shape, row: &[f32]) -> Self {
        let back =
            shape.blocks.iter().map(|_| BackBlock { hidden: Vec::new(), inputs: Vec::new() }).collect();
        let mut weights = Self { forward: Packed::new(shape, row), back };
        weights.set(row);
        weights
    }

    /// Packs a row of weights for gradients by the network's inputs.
    pub(super) fn for_inputs(shape: &Shape, row: &[f32]) -> Self {
        let mut weights = Self::new(shape, row);
        let first = shape.blocks[0];
        pack(first.inputs, first.rows(), &mut weights.back[0].inputs, |input, e| {
            row[first.at + e * first.columns() + input]
        });
        weights
    }

    /// Packs other weights of the same shape.
    pub(super) fn set(&mut self, row: &[f32]) {
        self.forward.set(row);
        let shape = &self.forward.shape;
        let fc = &row[shape.fc_at()..];
        for (b, (block, back)) in shape.blocks.iter().zip(&mut self.back).enumerate() {
            let (rows, columns) = (block.rows(), block.columns());
            let weights = &row[block.at..block.end()];
            pack(block.cells, errors(shape, b), &mut back.hidden, |cell, e| {
                if e < rows {
                    weights[e * columns + block.inputs + 1 + cell]
                } else {
                    fc[(e - rows) * shape.fc_columns() + 1 + cell]
                }
            });
            if b > 0 {
                pack(block.inputs, rows, &mut back.inputs, |input, e| weights[e * columns + input]);
            }
        }
    }
}

/// Number of errors kept per step of block `b`: those of its gates and, in the last block, of the outputs.
fn errors(shape: &Shape, b: usize) -> usize {
    shape.blocks[b].rows() + if b + 1 == shape.blocks.len() { shape.outputs } else { 0 }
}

/// Memory for the forward and backward pass of sixteen windows of one length; it is reused.
pub(super) struct Group {
    shape: Shape,
    steps: usize,
    /// Leading steps that the loss leaves out.
    burn_in: usize,
    blocks: Vec<Kept>,
    /// Target outputs, `[step][output]`.
    target: Vec<Lanes>,
    /// One channel before it is transposed into the lanes, `[window][step]`.
    rows: Vec<f32>,
    /// 1 for lanes that hold a window.
    used: Lanes,
    /// Gradient of the scaled loss, in the order of the weights.
    pub gradient: Vec<f32>,
    /// Sum of squared errors after the burn-in.
    pub squared_error: f64,
}

struct Kept {
    /// `[step 0..=steps][stride]`: `[x, 1, h before]`.
    z: Vec<Lanes>,
    /// `[step][padded cell]`: i, f, g, o, c, tanh c.
    cells: Vec<[Lanes; KEPT]>,
    /// `[step 0..=steps][errors]`: of this step's gates, then of the step before's outputs.
    errors: Vec<Lanes>,
    /// `[step][cell]`: error that the block above sends to `h`; empty in the last block.
    above: Vec<Lanes>,
    /// Error of each cell's state, from the next step.
    dc: Vec<Lanes>,
}

impl Group {
    /// Bytes of one group, to be checked before it is allocated.
    pub(super) fn bytes(shape: &Shape, steps: usize) -> usize {
        let per_step: usize = (0..shape.blocks.len())
            .map(|b| {
                let block = shape.blocks[b];
                block.stride() + (KEPT + 1) * block.padded_cells() + errors(shape, b)
            })
            .sum();
        (steps + 1) * (per_step + shape.outputs + 1) * size_of::<Lanes>()
    }

    /// Memory for windows of `steps` samples.
    pub(super) fn new(shape: &Shape, steps: usize, burn_in: usize) -> Self {
        let blocks = (0..shape.blocks.len())
            .map(|b| {
                let block = shape.blocks[b];
                let mut z = vec![Lanes::ZERO; (steps + 1) * block.stride()];
                z.iter_mut().skip(block.inputs).step_by(block.stride()).for_each(|z| *z = Lanes::ONE);
                let last = b + 1 == shape.blocks.len();
                Kept {
                    z,
                    cells: vec![[Lanes::ZERO; KEPT]; steps * block.padded_cells()],
                    errors: vec![Lanes::ZERO; (steps + 1) * errors(shape, b)],
                    above: vec![Lanes::ZERO; if last { 0 } else { steps * block.cells }],
                    dc: vec![Lanes::ZERO; block.cells],
                }
            })
            .collect();
        Self {
            shape: shape.clone(),
            steps,
            burn_in,
            blocks,
            target: vec![Lanes::ZERO; steps * shape.outputs],
            rows: vec![0.0; LANES * steps],
            used: Lanes::ZERO,
            gradient: vec![0.0; shape.len()],
            squared_error: 0.0,
        }
    }

    /// Sets the windows, at most sixteen: `(inputs, outputs, first sample)` each, which must lie
    /// within the signals.
    pub(super) fn set_windows<'a>(
        &mut self,
        windows: impl Iterator<Item = (&'a [Vec<f32>], &'a [Vec<f32>], usize)>,
    ) {
        let windows: Vec<_> = windows.collect();
        assert!(windows.len() <= LANES, "a group has {LANES} lanes");
        // Unused lanes are computed too, on zeros.
        self.rows[windows.len() * self.steps..].fill(0.0);
        self.used = Lanes::ZERO;
        self.used.0[..windows.len()].fill(1.0);
        let block = self.shape.blocks[0];
        for channel in 0..block.inputs {
            for ((x, _, start), row) in windows.iter().zip(self.rows.chunks_exact_mut(self.steps)) {
                row.copy_from_slice(&x[channel][*start..][..self.steps]);
            }
            transpose(&self.rows, self.steps, block.stride(), &mut self.blocks[0].z[channel..]);
        }
        for channel in 0..self.shape.outputs {
            for ((_, y, start), row) in windows.iter().zip(self.rows.chunks_exact_mut(self.steps)) {
                row.copy_from_slice(&y[channel][*start..][..self.steps]);
            }
            transpose(&self.rows, self.steps, self.shape.outputs, &mut self.target[channel..]);
        }
    }
}

/// Sixteen rows of `steps` samples to lanes, `to` being `[step][stride]`.
fn transpose(rows: &[f32], steps: usize, stride: usize, to: &mut [Lanes]) {
    let mut row = rows.chunks_exact(steps);
    let rows: [&[f32]; LANES] = std::array::from_fn(|_| row.next().expect("sixteen rows"));
    for (t, to) in to.iter_mut().step_by(stride).take(steps).enumerate() {
        for (to, row) in to.0.iter_mut().zip(rows) {
            *to = row[t];
        }
    }
}

/// Forward and backward pass: fills `gradient` and `squared_error` of the group.
///
/// The gradient is that of `scale / 2 * sum of squared errors`.
pub(super) struct Backprop<'a, const R: usize, const WIDE: bool> {
    pub weights: &'a TrainWeights<R>,
    pub group: &'a mut Group,
    pub scale: f32,
}

impl<const R: usize, const WIDE: bool> Kernel for Backprop<'_, R, WIDE> {
    type Out = ();
    const WIDE: bool = WIDE;

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { weights, group, scale } = self;
        let last = group.blocks.len() - 1;
        keep_steps::<S, R>(s, &weights.forward, group);
        group.squared_error = output_errors::<S, R>(s, &weights.forward.fc, group, scale);

        group.gradient.fill(0.0);
        for b in (0..=last).rev() {
            let block = group.shape.blocks[b];
            let width = errors(&group.shape, b);
            let (below, here) = group.blocks.split_at_mut(b);
            let kept = &mut here[0];
            kept.dc.fill(Lanes::ZERO);
            let mut end = group.steps;
            while end > 0 {
                let begin = end.saturating_sub(STEPS_PER_PASS);
                for t in (begin..end).rev() {
                    step_back::<S, R>(s, &weights.back[b], block, width, t, kept);
                    if let Some(below) = below.last_mut() {
                        let gates = &kept.errors[t * width..][..block.rows()];
                        let to = &mut below.above[t * block.inputs..][..block.inputs];
                        hand_down::<S, R>(s, &weights.back[b].inputs, gates, to);
                    }
                }
                let (columns, stride) = (block.columns(), block.stride());
                let a = Steps { data: &kept.errors, stride: width, at: 0, width: block.rows() };
                let z = Steps { data: &kept.z, stride, at: 0, width: columns };
                outer::<S, WIDE>(s, a, z, (begin, end), &mut group.gradient[block.at..block.end()]);
                if b == last {
                    let a = Steps {
                        data: &kept.errors,
                        stride: width,
                        at: block.rows(),
                        width: group.shape.outputs,
                    };
                    let at = block.inputs;
                    let z = Steps { data: &kept.z, stride, at, width: columns - at };
                    // The outputs of step t are stored with the h and the errors of step t + 1.
                    let steps = (begin.max(group.burn_in) + 1, end + 1);
                    if steps.0 < steps.1 {
                        outer::<S, WIDE>(s, a, z, steps, &mut group.gradient[group.shape.fc_at()..]);
                    }
                }
                end = begin;
            }
        }
    }
}

/// All steps of all blocks, keeping gates and states.
#[inline(always)]
fn keep_steps<S: Simd, const R: usize>(s: S, weights: &Packed<R>, group: &mut Group) {
    for t in 0..group.steps {
        for b in 0..group.blocks.len() {
            let block = group.shape.blocks[b];
            let (below, here) = group.blocks.split_at_mut(b);
            if let Some(below) = below.last() {
                let from = group.shape.blocks[b - 1];
                let h = &below.z[(t + 1) * from.stride() + from.inputs + 1..][..from.cells];
                here[0].z[t * block.stride()..][..block.inputs].copy_from_slice(h);
            }
            keep_step::<S, R>(s, &weights.gates[b], block, t, &mut here[0]);
        }
    }
}

/// Sends the errors of one step's gates to the block's inputs.
#[inline(always)]
fn hand_down<S: Simd, const R: usize>(s: S, weights: &[[f32; R]], gates: &[Lanes], to: &mut [Lanes]) {
    for (w, to) in weights.chunks_exact(gates.len()).zip(to.chunks_mut(R)) {
        let a = product::<S, R, 1>(s, w, gates.as_chunks().0);
        for (to, a) in to.iter_mut().zip(a) {
            s.store(to, a[0]);
        }
    }
}

/// One step of one block, keeping gates and states.
#[inline(always)]
fn keep_step<S: Simd, const R: usize>(
    s: S,
    weights: &[[f32; R]],
    block: BlockShape,
    t: usize,
    kept: &mut Kept,
) {
    let (now, next) = kept.z.split_at_mut((t + 1) * block.stride());
    let now = now[t * block.stride()..][..block.columns()].as_chunks::<1>().0;
    let h = next[block.inputs + 1..block.stride()].chunks_exact_mut(R / GATES);
    let (before, cells) = kept.cells.split_at_mut(t * block.padded_cells());
    let before = if t > 0 { &before[(t - 1) * block.padded_cells()..] } else { &[] };
    let cells = cells[..block.padded_cells()].chunks_exact_mut(R / GATES).zip(h);
    for (n, (w, (cells, h))) in weights.chunks_exact(now.len()).zip(cells).enumerate() {
        let a = product::<S, R, 1>(s, w, now);
        // As in inference all states first, then all outputs.
        for k in 0..R / GATES {
            let i = sigmoid(s, a[4 * k][0]);
            let f = sigmoid(s, a[4 * k + 1][0]);
            let g = tanh(s, a[4 * k + 2][0]);
            let mut c = s.mul(i, g);
            if let Some(before) = before.get(n * (R / GATES) + k) {
                c = s.mul_add(f, s.load(&before[4]), c);
            }
            s.store(&mut cells[k][0], i);
            s.store(&mut cells[k][1], f);
            s.store(&mut cells[k][2], g);
            s.store(&mut cells[k][4], c);
        }
        for k in 0..R / GATES {
            let o = sigmoid(s, a[4 * k + 3][0]);
            let tc = tanh(s, s.mul(s.load(&cells[k][4]), s.splat(TANH_SCALE)));
            s.store(&mut cells[k][3], o);
            s.store(&mut cells[k][5], tc);
            s.store(&mut h[k], s.mul(o, tc));
        }
    }
}

/// Computes the outputs after the burn-in, stores their scaled errors beside those of the next step's
/// gates, and returns the sum of squared errors over the lanes in use.
#[inline(always)]
fn output_errors<S: Simd, const R: usize>(s: S, weights: &[[f32; R]], group: &mut Group, scale: f32) -> f64 {
    let (block, outputs) = (group.shape.last(), group.shape.outputs);
    let width = block.rows() + outputs;
    let kept = group.blocks.last_mut().expect("a network has at least one block");
    let used = s.load(&group.used);
    let factor = s.mul(used, s.splat(scale));
    let mut sum = s.splat(0.0);
    for t in group.burn_in..group.steps {
        let z = &kept.z[(t + 1) * block.stride() + block.inputs..][..1 + block.cells];
        let errors = &mut kept.errors[(t + 1) * width + block.rows()..][..outputs];
        connect::<S, R, 1>(s, weights, z.as_chunks().0, errors.as_chunks_mut().0);
        for (error, target) in errors.iter_mut().zip(&group.target[t * outputs..]) {
            let e = s.sub(s.load(error), s.load(target));
            sum = s.mul_add(s.mul(e, used), e, sum);
            s.store(error, s.mul(e, factor));
        }
    }
    f64::from(s.sum(sum))
}

/// One backward step of one block: the errors of its gates from those of the next step.
#[inline(always)]
fn step_back<S: Simd, const R: usize>(
    s: S,
    weights: &BackBlock<R>,
    block: BlockShape,
    width: usize,
    t: usize,
    kept: &mut Kept,
) {
    let (now, after) = kept.errors.split_at_mut((t + 1) * width);
    let after = after[..width].as_chunks::<1>().0;
    let errors = now[t * width..][..block.rows()].as_chunks_mut::<GATES>().0;
    let padded = block.padded_cells();
    let cells = &kept.cells[t * padded..][..block.cells];
    let before = if t > 0 { &kept.cells[(t - 1) * padded..][..block.cells] } else { &[] };
    // Memory is read backwards, which the processor does not prefetch.
    let soon = if t > 1 { &kept.cells[(t - 2) * padded..][..block.cells] } else { &[] };
    let above = if kept.above.is_empty() { &[][..] } else { &kept.above[t * block.cells..][..block.cells] };
    let one = s.splat(1.0);
    let groups = weights.hidden.chunks_exact(width).zip(errors.chunks_mut(R));
    for (n, (w, errors)) in groups.enumerate() {
        let a = product::<S, R, 1>(s, w, after);
        for (k, (error, a)) in errors.iter_mut().zip(a).enumerate() {
            let cell = n * R + k;
            if let Some(soon) = soon.get(cell) {
                for kept in soon {
                    s.prefetch(kept, 0);
                }
            }
            let [i, f, g, o, _, tc] = &cells[cell];
            let (i, f, g) = (s.load(i), s.load(f), s.load(g));
            let (o, tc) = (s.load(o), s.load(tc));
            let mut dh = a[0];
            if let Some(above) = above.get(cell) {
                dh = s.add(dh, s.load(above));
            }
            let do_ = s.mul(dh, tc);
            let dc = s.mul_add(s.mul(dh, o), s.neg_mul_add(tc, tc, one), s.load(&kept.dc[cell]));
            // x (1 - x) = x - x x
            s.store(&mut error[0], s.mul(s.mul(dc, g), s.neg_mul_add(i, i, i)));
            let c_before = before.get(cell).map_or(&Lanes::ZERO, |b| &b[4]);
            s.store(&mut error[1], s.mul(s.mul(dc, s.load(c_before)), s.neg_mul_add(f, f, f)));
            s.store(&mut error[2], s.mul(s.mul(dc, i), s.neg_mul_add(g, g, one)));
            s.store(&mut error[3], s.mul(do_, s.neg_mul_add(o, o, o)));
            s.store(&mut kept.dc[cell], s.mul(dc, f));
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::super::net::LstmNet;
    use super::super::params::flatten;
    use super::super::reference::Twin;
    use super::super::samples::noise;
    use super::*;
    use crate::simd::Isa;
    use crate::simd::dispatch;

    /// Planar signals as the twin takes them.
    fn steps(x: &[Vec<f32>], start: usize, len: usize) -> Vec<Vec<f64>> {
        (start..start + len).map(|t| x.iter().map(|x| f64::from(x[t])).collect()).collect()
    }

    #[test]
    fn gradients_agree_with_the_f64_twin_on_every_instruction_set() {
        for (inputs, blocks, outputs, windows, burn_in) in [
            (9, &[39][..], 6, 16, 16),
            (3, &[23, 23], 3, 5, 0),
            (1, &[3], 1, 1, 63),
            (2, &[17, 5, 9], 5, 11, 30),
        ] {
            let len = 64;
            let mut rng = ChaCha8Rng::seed_from_u64(8);
            let mut net = LstmNet::init(inputs, blocks, outputs, 1.0, &mut rng);
            net.fc_bias.fill(0.3);
            let (x, y) = (noise(inputs, 200, 1), noise(outputs, 200, 2));
            let starts: Vec<usize> = (0..windows).map(|w| w * 8).collect();
            let twin = Twin::of(&net);
            let for_twin: Vec<_> = starts.iter().map(|&s| (steps(&x, s, len), steps(&y, s, len))).collect();
            let (loss, gradient) = twin.squared_error(&for_twin, burn_in);
            let largest = gradient.iter().fold(0.0_f64, |m, g| m.max(g.abs()));

            let (shape, row) = (Shape::of(&net), flatten(&net));
            let full = noise(inputs, 300, 9);
            for isa in Isa::ALL {
                if !isa.is_available() {
                    println!("skipped {}: not on this machine", isa.name());
                    continue;
                }
                let mut group = Group::new(&shape, len, burn_in);
                let (narrow, blocked) =
                    (TrainWeights::<4>::new(&shape, &row), TrainWeights::<16>::new(&shape, &row));
                for wide in [false, isa == Isa::Avx512] {
                    // A full group of other windows runs first, since the memory is reused.
                    let outputs_before = noise(outputs, 300, 10);
                    for round in 0..2 {
                        if round == 0 {
                            group.set_windows((0..16).map(|w| (&full[..], &outputs_before[..], w * 9)));
                        } else {
                            group.set_windows(starts.iter().map(|&s| (&x[..], &y[..], s)));
                        }
                        let group = &mut group;
                        if wide {
                            dispatch(isa, Backprop::<16, true> { weights: &blocked, group, scale: 2.0 });
                        } else {
                            dispatch(isa, Backprop::<4, false> { weights: &narrow, group, scale: 2.0 });
                        }
                    }
                    assert_eq!(group.gradient.len(), gradient.len());
                    assert!(
                        (group.squared_error - loss).abs() < 1e-5 * loss,
                        "{} {loss}",
                        group.squared_error
                    );
                    for (k, (found, expected)) in group.gradient.iter().zip(&gradient).enumerate() {
                        // The bound is 1e-3 of the largest entry; the error of f32 is far smaller.
                        assert!(
                            (f64::from(*found) - expected).abs() < 2e-5 * largest,
                            "{} {blocks:?} weight {k}: {found} {expected} of {largest}",
                            isa.name()
                        );
                    }
                }
            }
        }
    }
}
