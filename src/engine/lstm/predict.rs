//! Prediction of a whole signal from window predictions or from one carried state.

use std::ops::Range;

use rayon::prelude::*;

use super::forward::{Forward, Packed, State};
use super::net::LstmNet;
use super::params::{Shape, flatten};
use super::settings::Recombine;
use super::stream::{Stream, StreamState, StreamWeights};
use crate::EngineError;
use crate::progress::{Watch, report, unwatched};
use crate::simd::{Isa, LANES, Lanes, dispatch};
use crate::windowing::{Weights, Windows, check_window};

/// Length of the pre-roll before a stream, in windows; the first value is held in it.
const PRE_ROLL_WINDOWS: usize = 2;

/// Up to this many windows are computed in groups of 16 instead of 64, so that short signals use all
/// cores. The limit is a number of windows, not of threads: the order of sums must not depend on the machine.
const SMALL: usize = 256;

/// Groups of windows whose predictions are in memory at once.
const GROUPS_PER_SLAB: usize = 64;

/// Steps between which inputs are gathered and outputs are scattered; small enough for the
/// second-level cache.
const STEPS_PER_CHUNK: usize = 64;

/// Steps of a stream between two looks at whether to go on: some ten milliseconds.
const STEPS_PER_LOOK: usize = 4096;

/// Predicts a whole signal from standardised planar inputs `[channel][sample]` of one sample or more.
/// Returns `[output][sample]`, standardised.
///
/// [`Recombine::Welch`] is Heindel et al., section 2.2.2 (see [`crate::windowing`]);
/// [`Recombine::Stream`] carries the state through the signal after a pre-roll of `2 * window_len`
/// samples in which the first value is held. The result depends on the arguments and the instruction set only, bit for bit.
///
/// # Errors
/// Weights that do not fit together, another channel count, unequal lengths, no samples, an input or a
/// result that is not finite, `window_len` or `hop` outside their limits.
pub fn predict(
    net: &LstmNet,
    x: &[Vec<f32>],
    window_len: usize,
    hop: usize,
    recombine: Recombine,
) -> Result<Vec<Vec<f32>>, EngineError> {
    predict_on(Isa::of_process()?, net, x, window_len, hop, recombine, &unwatched)
}

/// [`predict`] that asks `watch` between groups of windows whether to go on.
///
/// # Errors
/// As [`predict`]; [`EngineError::Cancelled`].
pub fn predict_watched(
    net: &LstmNet,
    x: &[Vec<f32>],
    window_len: usize,
    hop: usize,
    recombine: Recombine,
    watch: Watch<'_>,
) -> Result<Vec<Vec<f32>>, EngineError> {
    predict_on(Isa::of_process()?, net, x, window_len, hop, recombine, watch)
}

/// [`predict_watched`] on a given instruction set.
///
/// # Errors
/// As [`predict_watched`].
pub(super) fn predict_on(
    isa: Isa,
    net: &LstmNet,
    x: &[Vec<f32>],
    window_len: usize,
    hop: usize,
    recombine: Recombine,
    watch: Watch<'_>,
) -> Result<Vec<Vec<f32>>, EngineError> {
    net.check()?;
    let samples = check_channels("input", x, net.inputs())?;
    let shape = Shape::of(net);
    let row = flatten(net);
    let y = match recombine {
        Recombine::Welch => {
            let windows = Windows::new(window_len, hop, samples)?;
            if isa != Isa::Avx512 {
                welch::<4, 1>(isa, &shape, &row, x, windows, watch)?
            } else if windows.count() <= SMALL {
                welch::<16, 1>(isa, &shape, &row, x, windows, watch)?
            } else {
                welch::<4, 4>(isa, &shape, &row, x, windows, watch)?
            }
        }
        Recombine::Stream => {
            check_window(window_len, hop)?;
            Streaming::begin(isa, shape, &row, window_len).run(x, watch)?
        }
    };
    check_result(&y)?;
    Ok(y)
}

fn check_result(y: &[Vec<f32>]) -> Result<(), EngineError> {
    for (channel, y) in y.iter().enumerate() {
        if let Some(sample) = y.iter().position(|v| !v.is_finite()) {
            return Err(EngineError::NonFiniteResult { what: "LSTM prediction", channel, sample });
        }
    }
    Ok(())
}

/// Checks the count, the equal lengths and the finiteness of planar channels. Returns their length, at
/// least one.
///
/// # Errors
/// The first of these that does not hold.
pub(super) fn check_channels(
    what: &'static str,
    x: &[Vec<f32>],
    expected: usize,
) -> Result<usize, EngineError> {
    if x.len() != expected || x.is_empty() {
        return Err(EngineError::ChannelCount { what, expected, found: x.len() });
    }
    let samples = x[0].len();
    if samples == 0 {
        return Err(EngineError::TooShort { what, needed: 1, found: 0 });
    }
    for (channel, x) in x.iter().enumerate() {
        if x.len() != samples {
            return Err(EngineError::UnequalLength { what, channel, expected: samples, found: x.len() });
        }
        if let Some(sample) = x.iter().position(|v| !v.is_finite()) {
            return Err(EngineError::NonFinite { what, channel, sample });
        }
    }
    Ok(samples)
}

/// Copies steps `steps` of one window of `x` into lane `lane` of `to`, which is
/// `[step][stride][lane]`; before the start and after the end the first and last value are held.
pub(super) fn gather<const NV: usize>(
    x: &[Vec<f32>],
    start: isize,
    steps: Range<usize>,
    lane: usize,
    stride: usize,
    to: &mut [[Lanes; NV]],
) {
    let (v, l) = (lane / LANES, lane % LANES);
    for (channel, x) in x.iter().enumerate() {
        let places = to[channel..].iter_mut().step_by(stride);
        let first = start + steps.start as isize;
        match usize::try_from(first).ok().and_then(|first| x.get(first..first + steps.len())) {
            Some(x) => places.zip(x).for_each(|(to, &x)| to[v].0[l] = x),
            None => {
                let last = x.len() as isize - 1;
                for (t, to) in places.take(steps.len()).enumerate() {
                    to[v].0[l] = x[(first + t as isize).clamp(0, last) as usize];
                }
            }
        }
    }
}

/// Runs up to `NV * 16` windows of `len` steps and hands the outputs, `[step][output][lane]`, to
/// `sink` chunk by chunk with the range of steps. `source(lane)` gives a window's signal and start.
pub(super) fn run_windows<'x, const R: usize, const NV: usize>(
    isa: Isa,
    weights: &Packed<R>,
    state: &mut State<NV>,
    len: usize,
    windows: usize,
    source: impl Fn(usize) -> (&'x [Vec<f32>], isize),
    mut sink: impl FnMut(Range<usize>, &[[Lanes; NV]]),
) {
    let (inputs, outputs) = (weights.shape.blocks[0].inputs, weights.shape.outputs);
    state.reset(&weights.shape);
    let chunk = len.min(STEPS_PER_CHUNK);
    let mut x = vec![[Lanes::ZERO; NV]; chunk * inputs];
    let mut y = vec![[Lanes::ZERO; NV]; chunk * outputs];
    for first in (0..len).step_by(chunk) {
        let steps = first..len.min(first + chunk);
        let x = &mut x[..steps.len() * inputs];
        let y = &mut y[..steps.len() * outputs];
        for lane in 0..windows {
            let (signal, start) = source(lane);
            gather(signal, start, steps.clone(), lane, inputs, x);
        }
        dispatch(isa, Forward { weights, state, x, y });
        sink(steps, y);
    }
}

/// Windows, recombined with Welch's weights.
fn welch<const R: usize, const NV: usize>(
    isa: Isa,
    shape: &Shape,
    row: &[f32],
    x: &[Vec<f32>],
    windows: Windows,
    watch: Watch<'_>,
) -> Result<Vec<Vec<f32>>, EngineError> {
    let samples = x[0].len();
    let packed = Packed::<R>::new(shape, row);
    let weights = windows.weights();
    let group = NV * LANES;
    let groups: Vec<Range<usize>> =
        (0..windows.count()).step_by(group).map(|first| first..windows.count().min(first + group)).collect();
    let mut y = vec![vec![0.0; samples]; shape.outputs];
    for slab in groups.chunks(GROUPS_PER_SLAB) {
        let done = slab[0].start as f64 / windows.count() as f64;
        let parts: Vec<PartialSum> = slab
            .par_iter()
            .map_init(
                || State::<NV>::new(shape),
                |state, group| {
                    report(watch, "LSTM", done)?;
                    Ok(part::<R, NV>(isa, &packed, state, x, windows, &weights, group.clone()))
                },
            )
            .collect::<Result<_, EngineError>>()?;
        // Always in the order of the signal, whichever thread was first.
        for part in &parts {
            for (y, part_y) in y.iter_mut().zip(&part.y) {
                y[part.from..][..part_y.len()].iter_mut().zip(part_y).for_each(|(y, p)| *y += p);
            }
        }
    }
    Ok(y)
}

/// The weighted sum of some windows.
struct PartialSum {
    /// First sample.
    from: usize,
    /// `[output][sample - from]`.
    y: Vec<Vec<f32>>,
}

fn part<const R: usize, const NV: usize>(
    isa: Isa,
    packed: &Packed<R>,
    state: &mut State<NV>,
    x: &[Vec<f32>],
    windows: Windows,
    weights: &Weights,
    group: Range<usize>,
) -> PartialSum {
    let (len, outputs, samples) = (windows.len(), packed.shape.outputs, x[0].len());
    let from = windows.start(group.start).max(0) as usize;
    let to = samples.min((windows.start(group.end - 1) + len as isize) as usize);
    let mut y = vec![vec![0.0; to - from]; outputs];
    let lane_weights: Vec<_> = group.clone().map(|w| weights.of(windows.start(w))).collect();
    run_windows::<R, NV>(
        isa,
        packed,
        state,
        len,
        group.len(),
        |lane| (x, windows.start(group.start + lane)),
        |steps, out| {
            for (lane, weights) in lane_weights.iter().enumerate() {
                // The steps of this window that lie inside the signal.
                let start = windows.start(group.start + lane);
                let inside =
                    (-start).max(0) as usize..(samples as isize - start).clamp(0, len as isize) as usize;
                let t = steps.start.max(inside.start)..steps.end.min(inside.end);
                if t.is_empty() {
                    continue;
                }
                let at = (start + t.start as isize) as usize - from;
                let (v, l) = (lane / LANES, lane % LANES);
                for (channel, y) in y.iter_mut().enumerate() {
                    let out = out[(t.start - steps.start) * outputs + channel..].iter().step_by(outputs);
                    let y = &mut y[at..][..t.len()];
                    for ((y, w), out) in y.iter_mut().zip(&weights[t.clone()]).zip(out) {
                        *y += w * out[v].0[l];
                    }
                }
            }
        },
    );
    PartialSum { from, y }
}

/// Prediction piece by piece with the state carried through: [`Recombine::Stream`] for signals that are
/// not in memory as a whole. The result is bit-identical however the signal is cut.
pub struct Streaming {
    isa: Isa,
    shape: Shape,
    weights: StreamWeights,
    state: StreamState,
    /// Steps of the pre-roll that are left.
    pre_roll: usize,
}

impl std::fmt::Debug for Streaming {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Streaming").field("isa", &self.isa).finish_non_exhaustive()
    }
}

impl Streaming {
    /// A stream before its first sample.
    ///
    /// # Errors
    /// Weights that do not fit together.
    pub fn new(net: &LstmNet, window_len: usize) -> Result<Self, EngineError> {
        net.check()?;
        Ok(Self::begin(Isa::of_process()?, Shape::of(net), &flatten(net), window_len))
    }

    fn begin(isa: Isa, shape: Shape, row: &[f32], window_len: usize) -> Self {
        Self {
            isa,
            weights: StreamWeights::new(&shape, row),
            state: StreamState::new(&shape),
            shape,
            pre_roll: PRE_ROLL_WINDOWS * window_len,
        }
    }

    /// The outputs of the next samples, both standardised and planar. Asks `watch` now and then whether to
    /// go on; a stream that was cancelled has no next samples.
    ///
    /// # Errors
    /// As [`predict`]; [`EngineError::Cancelled`].
    pub fn next(&mut self, x: &[Vec<f32>], watch: Watch<'_>) -> Result<Vec<Vec<f32>>, EngineError> {
        check_channels("input", x, self.shape.blocks[0].inputs)?;
        let y = self.run(x, watch)?;
        check_result(&y)?;
        Ok(y)
    }

    fn run(&mut self, x: &[Vec<f32>], watch: Watch<'_>) -> Result<Vec<Vec<f32>>, EngineError> {
        let (samples, outputs) = (x[0].len(), self.shape.outputs);
        let mut interleaved = vec![0.0; samples * x.len()];
        for (channel, from) in x.iter().enumerate() {
            interleaved[channel..].iter_mut().step_by(x.len()).zip(from).for_each(|(to, &from)| *to = from);
        }
        let mut out = vec![0.0; samples * outputs];
        let stretches =
            interleaved.chunks(STEPS_PER_LOOK * x.len()).zip(out.chunks_mut(STEPS_PER_LOOK * outputs));
        for (i, (x, y)) in stretches.enumerate() {
            report(watch, "LSTM", (i * STEPS_PER_LOOK) as f64 / samples as f64)?;
            let pre_roll = std::mem::take(&mut self.pre_roll);
            let (weights, state) = (&self.weights, &mut self.state);
            dispatch(self.isa, Stream { weights, state, x, y, pre_roll });
        }
        Ok((0..outputs).map(|c| out[c..].iter().step_by(outputs).copied().collect()).collect())
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::super::reference::Twin;
    use super::super::samples::{distance, noise, std_of};
    use super::*;

    fn net(inputs: usize, blocks: &[usize], outputs: usize, seed: u64) -> LstmNet {
        LstmNet::init(inputs, blocks, outputs, 1.0, &mut ChaCha8Rng::seed_from_u64(seed))
    }

    /// The machine's instruction sets. Prints the ones that it lacks.
    fn sets() -> Vec<Isa> {
        let (here, missing): (Vec<_>, Vec<_>) = Isa::ALL.into_iter().partition(|i| i.is_available());
        missing.iter().for_each(|i| println!("skipped {}: not on this machine", i.name()));
        here
    }

    /// 1e-5 of the output's standard deviation: some ten roundings of `f32`.
    fn assert_agrees(isa: Isa, net: &LstmNet, x: &[Vec<f32>], len: usize, hop: usize, way: Recombine) {
        let expected = Twin::of(net).predict(x, len, hop, way);
        let found = predict_on(isa, net, x, len, hop, way, &unwatched).unwrap();
        let bound = 1e-5 * std_of(&expected).max(0.05);
        let error = distance(&found, &expected);
        assert!(
            error < bound,
            "{} {way:?} L {len} hop {hop} n {}: {error:e} > {bound:e}",
            isa.name(),
            x[0].len()
        );
    }

    #[test]
    fn predictions_agree_with_the_f64_twin_on_every_instruction_set() {
        for isa in sets() {
            for (blocks, seed) in [(&[39][..], 1), (&[23, 23], 2), (&[3], 3), (&[17, 5, 9], 4)] {
                let net = net(3, blocks, 5, seed);
                let x = noise(3, 700, seed);
                for way in [Recombine::Welch, Recombine::Stream] {
                    assert_agrees(isa, &net, &x, 64, 32, way);
                }
            }
        }
    }

    #[test]
    fn every_length_from_one_sample_on_and_every_hop_agree_with_the_twin() {
        let net = net(2, &[4], 2, 7);
        for isa in sets() {
            for (len, hop) in [(16, 8), (16, 5), (15, 7), (16, 1), (2, 1)] {
                for n in (1..40).chain([129]) {
                    let x = noise(2, n, n as u64);
                    assert_agrees(isa, &net, &x, len, hop, Recombine::Welch);
                    assert_agrees(isa, &net, &x, len, hop, Recombine::Stream);
                }
            }
        }
    }

    #[test]
    fn many_windows_agree_with_the_twin_in_groups_of_sixtyfour() {
        let net = net(2, &[5], 3, 9);
        // 601 windows: nine groups of 64 and a remainder.
        let x = noise(2, 2400, 11);
        for isa in sets() {
            assert_agrees(isa, &net, &x, 8, 4, Recombine::Welch);
            assert_agrees(isa, &net, &x, 9, 3, Recombine::Welch);
        }
    }

    #[test]
    fn a_prediction_has_the_same_bits_on_any_number_of_threads() {
        let net = net(2, &[7], 2, 3);
        let x = noise(2, 5000, 5);
        for isa in sets() {
            let on = |threads| {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                pool.install(|| predict_on(isa, &net, &x, 16, 5, Recombine::Welch, &unwatched).unwrap())
            };
            let one = on(1);
            assert_eq!(one, on(2));
            assert_eq!(one, on(3));
        }
    }

    #[test]
    fn a_held_input_predicts_its_own_held_response_from_the_first_sample() {
        // Constant input: a stream that is settled stays settled.
        let net = net(1, &[6], 1, 4);
        let y = predict(&net, &[vec![0.7; 300]], 64, 32, Recombine::Stream).unwrap();
        let (first, last) = (y[0][0], y[0][299]);
        assert!((first - last).abs() < 1e-4, "{first} {last}");
    }

    #[test]
    fn a_stream_has_the_same_bits_however_it_is_cut() {
        let net = net(2, &[5, 3], 2, 6);
        let x = noise(2, 300, 8);
        let whole = predict(&net, &x, 16, 8, Recombine::Stream).unwrap();
        for cuts in [&[300][..], &[1, 299], &[7, 100, 193]] {
            let mut streaming = Streaming::new(&net, 16).unwrap();
            let mut found = vec![Vec::new(); 2];
            let mut at = 0;
            for len in cuts {
                let piece: Vec<Vec<f32>> = x.iter().map(|x| x[at..at + len].to_vec()).collect();
                let y = streaming.next(&piece, &unwatched).unwrap();
                found.iter_mut().zip(y).for_each(|(found, y)| found.extend(y));
                at += len;
            }
            assert_eq!(found, whole, "{cuts:?}");
        }
    }

    #[test]
    fn a_prediction_that_nobody_wants_any_more_ends_at_the_next_look() {
        use std::ops::ControlFlow;
        use std::sync::atomic::{AtomicUsize, Ordering};

        let net = net(2, &[5], 2, 6);
        let x = noise(2, 4 * STEPS_PER_LOOK, 8);
        for way in [Recombine::Welch, Recombine::Stream] {
            let looks = AtomicUsize::new(0);
            let third = |_: crate::Progress<'_>| match looks.fetch_add(1, Ordering::Relaxed) {
                2.. => ControlFlow::Break(()),
                _ => ControlFlow::Continue(()),
            };
            let found = predict_watched(&net, &x, 16, 8, way, &third);
            assert_eq!(found, Err(EngineError::Cancelled), "{way:?}");
            let asked = looks.into_inner();
            // Each thread may have asked once more.
            assert!((3..3 + rayon::current_num_threads().max(2)).contains(&asked), "{way:?}: {asked}");
        }
    }

    #[test]
    fn bad_input_is_refused_with_its_place() {
        let net = net(2, &[3], 1, 1);
        let go = |x: &[Vec<f32>]| predict(&net, x, 8, 4, Recombine::Welch).unwrap_err();
        assert!(matches!(go(&[vec![0.0; 9]]), EngineError::ChannelCount { expected: 2, found: 1, .. }));
        assert!(matches!(
            go(&[vec![0.0; 9], vec![0.0; 8]]),
            EngineError::UnequalLength { channel: 1, expected: 9, found: 8, .. }
        ));
        assert!(matches!(go(&[vec![], vec![]]), EngineError::TooShort { .. }));
        let mut x = vec![vec![0.0; 9]; 2];
        x[1][3] = f32::INFINITY;
        assert!(matches!(go(&x), EngineError::NonFinite { channel: 1, sample: 3, .. }));
        for way in [Recombine::Welch, Recombine::Stream] {
            let x = vec![vec![0.0; 9]; 2];
            assert!(matches!(
                predict(&net, &x, 8, 5, way),
                Err(EngineError::Setting { setting: "lstm.hop", .. })
            ));
        }
    }

    #[test]
    fn a_result_that_is_not_finite_is_an_error() {
        let mut net = net(1, &[2], 2, 1);
        net.fc_weight[2..].fill(f32::MAX);
        net.fc_bias[1] = f32::MAX;
        for way in [Recombine::Welch, Recombine::Stream] {
            let x = [noise(1, 50, 2)[0].iter().map(|x| 100.0 * x).collect()];
            assert!(matches!(
                predict(&net, &x, 8, 4, way),
                Err(EngineError::NonFiniteResult { channel: 1, .. })
            ));
        }
    }

    /// `cargo test --release --lib lstm::predict::tests::speed -- --ignored --nocapture`
    #[test]
    #[ignore = "measures, does not judge"]
    fn speed() {
        let net = net(9, &[39], 6, 1);
        let x = noise(9, 300_000, 1);
        for (way, n) in [(Recombine::Welch, 300_000), (Recombine::Welch, 10_000), (Recombine::Stream, 60_000)]
        {
            let x: Vec<_> = x.iter().map(|x| x[..n].to_vec()).collect();
            let best = (0..5)
                .map(|_| {
                    let begin = std::time::Instant::now();
                    predict(&net, &x, 256, 128, way).unwrap();
                    begin.elapsed().as_secs_f64()
                })
                .fold(f64::INFINITY, f64::min);
            println!(
                "{way:?}: {:.1} ms for {} s, {:.0} signal-s/s at 1 kHz",
                best * 1e3,
                n / 1000,
                n as f64 / 1000.0 / best
            );
        }
    }
}
