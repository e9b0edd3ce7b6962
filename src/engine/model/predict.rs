//! Predictions piece by piece, so that the intermediate results of an hour of signal are never in memory
//! all at once.
//!
//! A piece is computed from the inputs around it. An FRF needs half its taps on either side. Windows
//! of a network that reach into the piece begin up to a window length before it, and are the same
//! ones as those of the whole signal. A stream's state is carried on. So a prediction in pieces
//! differs from one in a single piece by rounding only: of the FRF's transforms, and with it of the
//! network's inputs and sums, some 1e-7 of an output's standard deviation. Where the pieces lie
//! depends on model and length alone, so that one input always has one result.
//!
//! Effects on top of a model are free runs from the first sample on, which each piece would have to
//! begin anew: with them the whole response is computed before its first piece is given. For the same reason
//! the whole response of a core is computed before the network's first piece.

mod adjoint;

use std::borrow::Cow;
use std::ops::Range;

use rayon::prelude::*;

use super::fallback::{Fallback, FallbackUse};
use super::trust::{self, Excursion, SpectrumWatch, Trust};
use super::{LstmPart, ModelKind, RigModel, band, effect, network_inputs};
use crate::frf::FrfFilter;
use crate::lstm::{self, Recombine, Streaming};
use crate::progress::{Progress, Watch, report, unwatched};
use crate::windowing::check_window;
use crate::{EngineError, Signal};

/// Most samples of a piece.
const PIECE_SAMPLES: usize = 1 << 18;

/// The error after the last piece of a prediction.
const ALL_GIVEN: EngineError = EngineError::TooShort { what: "rest of the drive", needed: 1, found: 0 };

/// Most windows of a piece, including those that only reach into it. The number gives whole groups of
/// windows on any number of threads.
const PIECE_WINDOWS: usize = 2048;

/// A model prepared for repeated use.
#[derive(Debug, Clone)]
pub struct Predictor {
    model: RigModel,
    filter: Option<FrfFilter>,
    watch: Option<SpectrumWatch>,
}

/// A prediction under way.
#[derive(Debug)]
pub struct Prediction {
    /// Inputs behind the model's filter.
    x: Signal,
    /// First sample that is still to be predicted.
    at: usize,
    /// The network's state at that sample, where it is carried through.
    stream: Option<Streaming>,
    /// The whole response of the model's core, if it has one, once it is known.
    core: Option<Signal>,
    /// The whole response with the model's effects, if it has some, once it is known.
    whole: Option<Signal>,
    /// Where the answer is the FRF's, if it falls back to it.
    fallback: Option<Fallback>,
}

impl Predictor {
    /// Prepares `model`.
    ///
    /// # Errors
    /// An FRF whose fields do not belong together.
    pub fn new(model: RigModel) -> Result<Self, EngineError> {
        let filter = model.frf.as_ref().map(|frf| frf.filter()).transpose()?;
        let watch = SpectrumWatch::new(&model);
        Ok(Self { model, filter, watch })
    }

    /// The model.
    pub fn model(&self) -> &RigModel {
        &self.model
    }

    /// Number of multiplications and additions in the network for `samples` samples, which take most of a
    /// prediction's time. 0 without a network.
    pub fn network_work(&self, samples: usize) -> f64 {
        let Some(part) = &self.model.lstm else { return 0.0 };
        let steps = match part.recombine {
            // Every sample has its full set of windows, which reach beyond either end.
            Recombine::Welch => {
                part.window_len as f64 / part.hop.max(1) as f64 * (samples + part.window_len) as f64
            }
            Recombine::Stream => samples as f64,
        };
        2.0 * part.net.n_parameters() as f64 * steps
    }

    /// Response to `x`, whose channels are the model's inputs in order; as long as `x`.
    ///
    /// # Errors
    /// As [`Predictor::begin`] and [`Predictor::next`].
    pub fn predict(&self, x: Signal) -> Result<Signal, EngineError> {
        self.rest(&mut self.begin(x)?, &unwatched)
    }

    /// Begins the prediction of the response to `x`, whose channels are the model's inputs in
    /// order: it passes the model's filter.
    ///
    /// # Errors
    /// Another channel count or sample rate, no samples, a result that is not finite.
    pub fn begin(&self, x: Signal) -> Result<Prediction, EngineError> {
        begin(&self.model, x)
    }

    /// The next samples of the response; none when all have been given. It asks `watch` often whether to
    /// go on; a prediction that was cancelled gives no more.
    ///
    /// # Errors
    /// A result that is not finite; [`EngineError::Cancelled`].
    pub fn next(&self, prediction: &mut Prediction, watch: Watch<'_>) -> Result<Option<Signal>, EngineError> {
        let from = prediction.at;
        match next(&self.model, self.filter.as_ref(), prediction, watch)? {
            Some(piece) => self.blended(prediction, from, piece).map(Some),
            None => Ok(None),
        }
    }

    /// All samples of the response that have not been given yet, at least one. It asks `watch` often
    /// whether to go on.
    ///
    /// # Errors
    /// As [`Predictor::next`]; [`EngineError::TooShort`] when all have been given;
    /// [`EngineError::Cancelled`].
    pub fn rest(&self, prediction: &mut Prediction, watch: Watch<'_>) -> Result<Signal, EngineError> {
        let from = prediction.at;
        let response = rest(&self.model, self.filter.as_ref(), prediction, watch)?;
        self.blended(prediction, from, response)
    }

    /// Lets the FRF answer where `trust`, which is that of the prediction, reports a span outside. Says where that is;
    /// `None` for a model without an FRF, whose prediction stays as it was.
    pub fn fall_back(&self, prediction: &mut Prediction, trust: &Trust) -> Option<FallbackUse> {
        self.filter.as_ref()?;
        let fallback = Fallback::new(&self.model, trust, prediction.n_samples());
        let used = fallback.used(self.model.sample_rate_hz);
        prediction.fallback = Some(fallback);
        Some(used)
    }

    /// A piece of the response that begins at sample `from`, blended with the FRF's where the prediction falls back.
    fn blended(&self, prediction: &Prediction, from: usize, piece: Signal) -> Result<Signal, EngineError> {
        match (&prediction.fallback, &self.filter) {
            (Some(fallback), Some(filter)) => fallback.blend(filter, &prediction.x, from, piece),
            _ => Ok(piece),
        }
    }

    /// Half width of the band about the whole response of a prediction, `[output, sample]`; `None` for a model without a
    /// band, and for one with effects on top, which came after its band.
    ///
    /// # Errors
    /// A result that is not finite.
    pub fn half_width(
        &self,
        prediction: &Prediction,
        response: &Signal,
    ) -> Result<Option<Signal>, EngineError> {
        let model = &self.model;
        let Some(calibrated) = model.band.as_ref().filter(|_| model.effects.is_empty()) else {
            return Ok(None);
        };
        let linear = match (&prediction.core, &self.filter) {
            _ if !band::corrected(model) => None,
            (Some(core), _) => Some(Cow::Borrowed(core)),
            (None, Some(filter)) => {
                Some(Cow::Owned(filter.apply(&prediction.x).map_err(EngineError::of_result)?))
            }
            (None, None) => None,
        };
        calibrated.half_width(response, linear.as_deref()).map(Some)
    }

    /// Factor on each output's half width for the damage that follows: cycles are wrong by more, or by less, than samples.
    pub fn cycle_factors(&self) -> Vec<f64> {
        self.model.band.as_ref().map(super::Band::of_cycles).unwrap_or_default()
    }

    /// Where the inputs of a prediction leave the range that the model was fitted on.
    pub fn trust(&self, prediction: &Prediction) -> Trust {
        trust::trust(&self.model, self.watch.as_ref(), &prediction.x)
    }

    /// How far the inputs of a prediction leave it over short times, in numbers: window by window, with what would bring
    /// them back. Single values and rates are not among them, for which the model's `range` has the limits.
    pub fn excursions(&self, prediction: &Prediction) -> Vec<Excursion> {
        trust::excursions(&self.model, self.watch.as_ref(), &prediction.x)
    }
}

impl PartialEq for Predictor {
    /// The rest follows from the model.
    fn eq(&self, other: &Self) -> bool {
        self.model == other.model
    }
}

impl Prediction {
    /// Samples of the whole response.
    pub fn n_samples(&self) -> usize {
        self.x.n_samples()
    }
}

/// Response to all of `x`.
pub(super) fn whole(model: &RigModel, x: &Signal) -> Result<Signal, EngineError> {
    let mut prediction = begin(model, x.clone())?;
    let filter = model.frf.as_ref().map(|frf| frf.filter()).transpose()?;
    rest(model, filter.as_ref(), &mut prediction, &unwatched)
}

fn begin(model: &RigModel, x: Signal) -> Result<Prediction, EngineError> {
    if x.n_channels() != model.inputs.len() {
        return Err(EngineError::ChannelCount {
            what: "drive",
            expected: model.inputs.len(),
            found: x.n_channels(),
        });
    }
    if !Signal::same_rate(x.sample_rate_hz(), model.sample_rate_hz) {
        return Err(EngineError::SampleRate {
            what: "drive",
            expected_hz: model.sample_rate_hz,
            found_hz: x.sample_rate_hz(),
        });
    }
    if x.n_samples() == 0 {
        return Err(EngineError::TooShort { what: "drive", needed: 1, found: 0 });
    }
    let stream = match &model.lstm {
        Some(part) => {
            check_window(part.window_len, part.hop)?;
            let carried = part.recombine == Recombine::Stream;
            carried.then(|| Streaming::new(&part.net, part.window_len)).transpose()?
        }
        None => None,
    };
    Ok(Prediction {
        x: model.preprocess.apply_to(x)?,
        at: 0,
        stream,
        core: None,
        whole: None,
        fallback: None,
    })
}

fn rest(
    model: &RigModel,
    filter: Option<&FrfFilter>,
    prediction: &mut Prediction,
    watch: Watch<'_>,
) -> Result<Signal, EngineError> {
    if model.effects.is_empty() {
        return rest_without_effects(model, filter, prediction, watch);
    }
    if prediction.at == prediction.n_samples() {
        return Err(ALL_GIVEN);
    }
    let whole = with_effects(model, filter, prediction, watch)?;
    let n = whole.n_samples();
    let from = std::mem::replace(&mut prediction.at, n);
    Ok(if from == 0 { whole } else { whole.slice(from..n) })
}

fn next(
    model: &RigModel,
    filter: Option<&FrfFilter>,
    prediction: &mut Prediction,
    watch: Watch<'_>,
) -> Result<Option<Signal>, EngineError> {
    if model.effects.is_empty() {
        return piece(model, filter, prediction, watch);
    }
    if prediction.at == prediction.n_samples() {
        prediction.whole = None;
        return Ok(None);
    }
    let whole = with_effects(model, filter, prediction, watch)?;
    let range = prediction.at..whole.n_samples().min(prediction.at + PIECE_SAMPLES);
    prediction.at = range.end;
    let piece = whole.slice(range);
    prediction.whole = Some(whole);
    Ok(Some(piece))
}

/// The whole response with the model's effects, taken out of the prediction.
fn with_effects(
    model: &RigModel,
    filter: Option<&FrfFilter>,
    prediction: &mut Prediction,
    watch: Watch<'_>,
) -> Result<Signal, EngineError> {
    if let Some(whole) = prediction.whole.take() {
        return Ok(whole);
    }
    // The model is one part of the work, and each effect another.
    let parts = (1 + model.effects.len()) as f64;
    let first = |p: Progress<'_>| watch(Progress { fraction: p.fraction / parts, ..p });
    let base = rest_without_effects(model, filter, prediction, &first)?;
    prediction.at = 0;
    effect::apply_all(&model.effects, &prediction.x, base, watch)
}

fn rest_without_effects(
    model: &RigModel,
    filter: Option<&FrfFilter>,
    prediction: &mut Prediction,
    watch: Watch<'_>,
) -> Result<Signal, EngineError> {
    let left = prediction.n_samples() - prediction.at;
    let first = piece(model, filter, prediction, watch)?.ok_or(ALL_GIVEN)?;
    if first.n_samples() == left {
        return Ok(first);
    }
    let rate = first.sample_rate_hz();
    let mut channels = first.into_channels();
    channels.iter_mut().for_each(|channel| channel.reserve_exact(left - channel.len()));
    while let Some(next) = piece(model, filter, prediction, watch)? {
        for (channel, next) in channels.iter_mut().zip(next.channels()) {
            channel.extend_from_slice(next);
        }
    }
    Signal::new(rate, channels)
}

/// The next samples of the model without its effects.
fn piece(
    model: &RigModel,
    filter: Option<&FrfFilter>,
    prediction: &mut Prediction,
    watch: Watch<'_>,
) -> Result<Option<Signal>, EngineError> {
    if !model.core.is_empty() && prediction.core.is_none() {
        prediction.core = core(model, filter, &prediction.x, watch)?;
    }
    let Prediction { x, at, stream, core, .. } = prediction;
    let range = *at..x.n_samples().min(*at + piece_len(model.lstm.as_ref()));
    if range.is_empty() {
        return Ok(None);
    }
    let done = range.start as f64 / x.n_samples() as f64;
    report(watch, "prediction", done)?;
    // The network counts from the start of the piece.
    let within = |_: Progress<'_>| watch(Progress::new("prediction", done));
    // Windows that reach into the piece, and the network's inputs from the first of them on.
    let warm_up = match &model.lstm {
        Some(part) if stream.is_none() => warm_up(part),
        _ => 0,
    };
    let from = range.start.saturating_sub(warm_up);
    let linear = match (core, filter) {
        (Some(core), _) => Some(core.slice(from..range.end).into_channels()),
        (None, Some(filter)) => Some(linear(filter, x, from..range.end)?),
        (None, None) => None,
    };
    let channels = match &model.lstm {
        None => linear.ok_or_else(|| EngineError::Weights("a model has an FRF or an LSTM".into()))?,
        Some(part) => {
            let z = network_inputs(&part.x, model.kind, x, from..range.end, linear.as_deref());
            let y = match stream {
                Some(stream) => stream.next(&z, &within),
                None => {
                    lstm::predict_watched(&part.net, &z, part.window_len, part.hop, part.recombine, &within)
                }
            };
            drop(z);
            let y = y.map_err(|error| later(error, from))?;
            let linear = linear.filter(|_| model.kind == ModelKind::Hybrid1);
            let skip = range.start - from;
            y.par_iter()
                .enumerate()
                .map(|(channel, z)| {
                    let mut y = part.y.restore(channel, &z[skip..]);
                    if let Some(linear) = &linear {
                        y.iter_mut().zip(&linear[channel][skip..]).for_each(|(y, linear)| *y += linear);
                    }
                    y
                })
                .collect()
        }
    };
    *at = range.end;
    Signal::new(x.sample_rate_hz(), channels).map(Some).map_err(|error| later(error, range.start))
}

/// The whole response of a model's core; `None` for a model without FRF.
fn core(
    model: &RigModel,
    filter: Option<&FrfFilter>,
    x: &Signal,
    watch: Watch<'_>,
) -> Result<Option<Signal>, EngineError> {
    let Some(filter) = filter else { return Ok(None) };
    report(watch, "prediction", 0.0)?;
    let response = filter.apply(x).map_err(EngineError::of_result)?;
    effect::apply_all(&model.core, x, response, &|_| watch(Progress::new("prediction", 0.0))).map(Some)
}

/// Samples of a piece; with a network a multiple of its hop, so that windows keep their places.
fn piece_len(part: Option<&LstmPart>) -> usize {
    let Some(part) = part else { return PIECE_SAMPLES };
    let most = PIECE_WINDOWS.saturating_sub(1 + warm_up(part) / part.hop);
    part.hop * (PIECE_SAMPLES / part.hop).min(most).max(1)
}

/// Samples before a piece from which on windows reach into it: a multiple of the hop, and at least one
/// window, beyond which the half of the first window before the start has no weight.
fn warm_up(part: &LstmPart) -> usize {
    part.window_len.next_multiple_of(part.hop)
}

/// FRF(x) over a range of samples, `[output][sample - range.start]`.
pub(super) fn linear(
    filter: &FrfFilter,
    x: &Signal,
    range: Range<usize>,
) -> Result<Vec<Vec<f64>>, EngineError> {
    let context = filter.taps() / 2;
    let from = range.start.saturating_sub(context);
    let to = x.n_samples().min(range.end + context);
    let x = if from == 0 && to == x.n_samples() { Cow::Borrowed(x) } else { Cow::Owned(x.slice(from..to)) };
    let mut y = filter.apply(&x).map_err(|error| later(error.of_result(), from))?.into_channels();
    for channel in &mut y {
        channel.truncate(range.end - from);
        channel.drain(..range.start - from);
    }
    Ok(y)
}

/// An error of a piece, with the sample counted in the whole signal.
fn later(error: EngineError, offset: usize) -> EngineError {
    match error.of_result() {
        EngineError::NonFiniteResult { what, channel, sample } => {
            EngineError::NonFiniteResult { what, channel, sample: sample + offset }
        }
        other => other,
    }
}
