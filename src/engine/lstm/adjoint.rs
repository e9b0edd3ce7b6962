//! The vector-Jacobian product of a prediction: from weights on the outputs to those on the inputs.

use std::ops::Range;

use rayon::prelude::*;

use super::bptt::{Group, InputGradient, TrainWeights};
use super::net::LstmNet;
use super::params::{Shape, flatten};
use super::predict::check_channels;
use super::settings::Recombine;
use crate::EngineError;
use crate::progress::{Watch, report};
use crate::simd::{Isa, LANES, Lanes, dispatch};
use crate::windowing::{Weights, Windows, check_window};

/// Windows of a stream before a sample from which its state is told, and after it in which it still has an influence: as
/// many as a stream has in its pre-roll.
const MEMORY_WINDOWS: usize = 2;

/// Groups of windows whose gradients are in memory at once.
const GROUPS_PER_SLAB: usize = 64;

/// Memory that the passes of the groups of one slab may take, unless one alone takes more.
const SLAB_BYTES: usize = 1 << 30;

/// `J^T w` of [`predict`](super::predict) at the inputs `x`, where `J` is the derivative of the standardised outputs by the
/// standardised inputs; both are planar, `[channel][sample]`, and so is the answer, `[input][sample]`.
///
/// [`Recombine::Welch`]: the derivative of every window, with the weights of its recombination, back-propagated through
/// time; inputs that are held beyond either end add to the first and the last sample. [`Recombine::Stream`]: the same of
/// stretches of the signal; an influence that lasts longer than two windows is left out, as the pre-roll of a prediction
/// does. The answer depends on the arguments and the instruction set only, bit for bit, whatever the number of threads.
///
/// # Errors
/// Weights that do not fit together, another channel count, unequal lengths, no samples, a value that is not finite,
/// `window_len` or `hop` outside their limits, a result that is not finite; [`EngineError::Cancelled`].
pub fn adjoint(
    net: &LstmNet,
    x: &[Vec<f32>],
    w: &[Vec<f32>],
    (window_len, hop, recombine): (usize, usize, Recombine),
    watch: Watch<'_>,
) -> Result<Vec<Vec<f64>>, EngineError> {
    net.check()?;
    let samples = check_channels("input", x, net.inputs())?;
    let found = check_channels("weights of the outputs", w, net.outputs)?;
    if found != samples {
        let what = "weights of the outputs";
        return Err(EngineError::UnequalLength { what, channel: 0, expected: samples, found });
    }
    let stretches = match recombine {
        Recombine::Welch => {
            let windows = Windows::new(window_len, hop, samples)?;
            Stretches::Windows(windows, windows.weights())
        }
        Recombine::Stream => {
            check_window(window_len, hop)?;
            Stretches::Stream { part: MEMORY_WINDOWS * window_len, samples }
        }
    };
    let isa = Isa::of_process()?;
    let shape = Shape::of(net);
    let of = Of { isa, shape: &shape, x, w, stretches: &stretches };
    let row = flatten(net);
    let gradient = if isa == Isa::Avx512 {
        of.gradient::<16>(&TrainWeights::for_inputs(&shape, &row), watch)?
    } else {
        of.gradient::<4>(&TrainWeights::for_inputs(&shape, &row), watch)?
    };
    for (channel, gradient) in gradient.iter().enumerate() {
        if let Some(sample) = gradient.iter().position(|v| !v.is_finite()) {
            return Err(EngineError::NonFiniteResult { what: "gradient of the LSTM", channel, sample });
        }
    }
    Ok(gradient)
}

/// Stretches of a signal that are back-propagated each by itself, of equal length.
enum Stretches {
    /// The windows of a recombination.
    Windows(Windows, Weights),
    /// Parts of a stream with what comes before and after them.
    Stream { part: usize, samples: usize },
}

impl Stretches {
    fn count(&self) -> usize {
        match self {
            Self::Windows(windows, _) => windows.count(),
            Self::Stream { part, samples } => samples.div_ceil(*part),
        }
    }

    /// Steps of each.
    fn steps(&self) -> usize {
        match self {
            Self::Windows(windows, _) => windows.len(),
            Self::Stream { part, .. } => 3 * part,
        }
    }

    /// Sample of the first step.
    fn start(&self, index: usize) -> isize {
        match self {
            Self::Windows(windows, _) => windows.start(index),
            Self::Stream { part, .. } => (index * part) as isize - *part as isize,
        }
    }

    /// Steps by whose inputs the derivative is wanted.
    fn own(&self, index: usize) -> Range<usize> {
        match self {
            Self::Windows(windows, _) => 0..windows.len(),
            // Before the start of the signal its first value is held.
            Self::Stream { part, .. } => (if index == 0 { 0 } else { *part })..2 * part,
        }
    }

    /// Weights of the outputs of each step in the prediction.
    fn weights(&self, index: usize) -> Vec<f32> {
        match self {
            Self::Windows(_, weights) => weights.of(self.start(index)).into_owned(),
            Self::Stream { .. } => vec![1.0; self.steps()],
        }
    }
}

struct Of<'a> {
    isa: Isa,
    shape: &'a Shape,
    x: &'a [Vec<f32>],
    w: &'a [Vec<f32>],
    stretches: &'a Stretches,
}

impl Of<'_> {
    fn gradient<const R: usize>(
        &self,
        weights: &TrainWeights<R>,
        watch: Watch<'_>,
    ) -> Result<Vec<Vec<f64>>, EngineError> {
        let (samples, count) = (self.x[0].len(), self.stretches.count());
        let groups: Vec<Range<usize>> =
            (0..count).step_by(LANES).map(|first| first..count.min(first + LANES)).collect();
        let steps = self.stretches.steps();
        let at_once = (SLAB_BYTES / Group::bytes(self.shape, steps)).clamp(1, GROUPS_PER_SLAB);
        let mut gradient = vec![vec![0.0; samples]; self.x.len()];
        for slab in groups.chunks(at_once) {
            let done = slab[0].start as f64 / count as f64;
            let parts: Vec<Vec<Lanes>> = slab
                .par_iter()
                .map_init(
                    || Group::new(self.shape, steps, 0),
                    |memory, group| {
                        report(watch, "LSTM", done)?;
                        Ok(self.part(weights, memory, group))
                    },
                )
                .collect::<Result<_, EngineError>>()?;
            // Always in the order of the signal, whichever thread was first.
            for (group, part) in slab.iter().zip(&parts) {
                self.add(group, part, &mut gradient);
            }
        }
        Ok(gradient)
    }

    /// The derivatives of some stretches, one in each lane, `[step][input]`.
    fn part<const R: usize>(
        &self,
        weights: &TrainWeights<R>,
        memory: &mut Group,
        group: &Range<usize>,
    ) -> Vec<Lanes> {
        let samples = self.x[0].len();
        memory.clear();
        for (lane, index) in group.clone().enumerate() {
            let (start, of_steps) = (self.stretches.start(index), self.stretches.weights(index));
            memory.set_window(lane, self.x, start, |output, step| {
                let sample = usize::try_from(start + step as isize).ok().filter(|sample| *sample < samples);
                sample.map_or(0.0, |sample| of_steps[step] * self.w[output][sample])
            });
        }
        let mut to = vec![Lanes::ZERO; self.stretches.steps() * self.x.len()];
        dispatch(self.isa, InputGradient { weights, group: memory, to: &mut to });
        to
    }

    /// Adds them to the samples whose values the steps have.
    fn add(&self, group: &Range<usize>, part: &[Lanes], gradient: &mut [Vec<f64>]) {
        let (samples, inputs) = (self.x[0].len(), self.x.len());
        for (lane, index) in group.clone().enumerate() {
            let start = self.stretches.start(index);
            for step in self.stretches.own(index) {
                let sample = (start + step as isize).clamp(0, samples as isize - 1) as usize;
                for (gradient, of_step) in gradient.iter_mut().zip(&part[step * inputs..]) {
                    gradient[sample] += f64::from(of_step.0[lane]);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::super::reference::Twin;
    use super::super::samples::noise;
    use super::*;
    use crate::progress::unwatched;

    fn net(inputs: usize, blocks: &[usize], outputs: usize) -> LstmNet {
        LstmNet::init(inputs, blocks, outputs, 1.0, &mut ChaCha8Rng::seed_from_u64(6))
    }

    /// Derivatives of `sum w y` by single inputs, by central differences of the f64 twin.
    #[test]
    fn the_gradient_equals_differences_of_the_twins_predictions() {
        let (len, hop) = (20, 7);
        for (inputs, blocks, outputs, n) in [(2, &[5][..], 3, 90), (3, &[4, 3], 2, 41), (1, &[3], 1, 7)] {
            let net = net(inputs, blocks, outputs);
            let twin = Twin::of(&net);
            let (x, w) = (noise(inputs, n, 3), noise(outputs, n, 4));
            for way in [Recombine::Welch, Recombine::Stream] {
                let found = adjoint(&net, &x, &w, (len, hop, way), &unwatched).unwrap();
                let largest = found.iter().flatten().fold(0.0_f64, |m, v| m.max(v.abs()));
                let value = |x: &[Vec<f32>]| -> f64 {
                    let y = twin.predict(x, len, hop, way);
                    y.iter().flatten().zip(w.iter().flatten()).map(|(y, w)| y * f64::from(*w)).sum()
                };
                for sample in [0, 1, 2, n / 2, n - 2, n - 1] {
                    for input in 0..inputs {
                        let at = |d: f32| {
                            let mut x = x.clone();
                            x[input][sample] += d;
                            (value(&x), f64::from(x[input][sample]))
                        };
                        let ((above, to), (below, from)) = (at(1e-2), at(-1e-2));
                        let slope = (above - below) / (to - from);
                        let error = (slope - found[input][sample]).abs();
                        // The difference of third order is 1e-4 of a curvature.
                        assert!(
                            error < 2e-4 * largest,
                            "{way:?} {blocks:?} input {input} sample {sample}: {slope} {}",
                            found[input][sample]
                        );
                    }
                }
            }
        }
    }

    #[test]
    fn a_gradient_has_the_same_bits_on_any_number_of_threads() {
        let net = net(2, &[7], 2);
        let (x, w) = (noise(2, 5000, 5), noise(2, 5000, 6));
        for way in [Recombine::Welch, Recombine::Stream] {
            let on = |threads| {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                pool.install(|| adjoint(&net, &x, &w, (16, 5, way), &unwatched).unwrap())
            };
            let one = on(1);
            assert_eq!(one, on(2));
            assert_eq!(one, on(3));
        }
    }

    #[test]
    fn weights_of_another_shape_are_refused_and_a_gradient_is_cancelled() {
        let net = net(2, &[3], 1);
        let (x, way) = (noise(2, 50, 1), (8, 4, Recombine::Welch));
        let of = |w: &[Vec<f32>]| adjoint(&net, &x, w, way, &unwatched);
        assert!(matches!(of(&noise(2, 50, 2)), Err(EngineError::ChannelCount { expected: 1, found: 2, .. })));
        assert!(matches!(
            of(&noise(1, 49, 2)),
            Err(EngineError::UnequalLength { expected: 50, found: 49, .. })
        ));
        let stop = |_: crate::Progress<'_>| std::ops::ControlFlow::Break(());
        assert_eq!(adjoint(&net, &x, &noise(1, 50, 2), way, &stop), Err(EngineError::Cancelled));
    }
}
