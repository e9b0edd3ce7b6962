//! The backward pass down to the network's inputs: the weights stay as they are, the drive is what changes.

use super::{Group, TrainWeights, errors, hand_down, keep_steps, step_back};
use crate::lstm::predict::gather;
use crate::simd::{Kernel, Lanes, Simd};

impl Group {
    /// Begins with other windows: no inputs, no errors of the outputs.
    pub(in crate::lstm) fn clear(&mut self) {
        let (block, width) = (self.shape.blocks[0], errors(&self.shape, self.blocks.len() - 1));
        for z in self.blocks[0].z.chunks_exact_mut(block.stride()) {
            z[..block.inputs].fill(Lanes::ZERO);
        }
        let last = self.blocks.last_mut().expect("a network has at least one block");
        for errors in last.errors.chunks_exact_mut(width) {
            errors[width - self.shape.outputs..].fill(Lanes::ZERO);
        }
    }

    /// The window of a lane: its inputs are those of the planar `x` from sample `start` on, the first and the last value
    /// held beyond either end, and the error of each output at each step is `error(output, step)`.
    pub(in crate::lstm) fn set_window(
        &mut self,
        lane: usize,
        x: &[Vec<f32>],
        start: isize,
        error: impl Fn(usize, usize) -> f32,
    ) {
        let (steps, outputs) = (self.steps, self.shape.outputs);
        let (first, width) = (self.shape.blocks[0], errors(&self.shape, self.blocks.len() - 1));
        gather(x, start, 0..steps, lane, first.stride(), self.blocks[0].z.as_chunks_mut::<1>().0);
        let last = self.blocks.last_mut().expect("a network has at least one block");
        // The outputs of step t are stored with the errors of step t + 1.
        for (t, errors) in last.errors.chunks_exact_mut(width).skip(1).enumerate() {
            for (output, to) in errors[width - outputs..].iter_mut().enumerate() {
                to.0[lane] = error(output, t);
            }
        }
    }
}

/// Forward and backward pass: fills `to`, `[step][input]`, with the sum over steps and outputs of an output's error times
/// its derivative by the input.
pub(in crate::lstm) struct InputGradient<'a, const R: usize> {
    /// Made by [`TrainWeights::for_inputs`].
    pub weights: &'a TrainWeights<R>,
    pub group: &'a mut Group,
    pub to: &'a mut [Lanes],
}

impl<const R: usize> Kernel for InputGradient<'_, R> {
    type Out = ();
    const WIDE: bool = R >= 16;

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { weights, group, to } = self;
        keep_steps::<S, R>(s, &weights.forward, group);
        for b in (0..group.blocks.len()).rev() {
            let block = group.shape.blocks[b];
            let width = errors(&group.shape, b);
            let (below, here) = group.blocks.split_at_mut(b);
            let kept = &mut here[0];
            kept.dc.fill(Lanes::ZERO);
            for t in (0..group.steps).rev() {
                step_back::<S, R>(s, &weights.back[b], block, width, t, kept);
                let gates = &kept.errors[t * width..][..block.rows()];
                let to = match below.last_mut() {
                    Some(below) => &mut below.above[t * block.inputs..],
                    None => &mut to[t * block.inputs..],
                };
                hand_down::<S, R>(s, &weights.back[b].inputs, gates, &mut to[..block.inputs]);
            }
        }
    }
}
