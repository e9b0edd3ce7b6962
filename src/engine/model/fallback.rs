//! The FRF in place of a model where its drive is outside what the model was fitted on.
//!
//! Outside, a network or a nonlinear law extrapolates, which an FRF does in proportion to its input. So the
//! answer is the FRF's in every span that the trust reports, and for one fade after it, because the model still
//! remembers what was outside; a raised cosine of one fade leads in before the span, and another one out.

use std::ops::Range;

use serde::Serialize;

use super::{ModelKind, RigModel, Trust};
use crate::frf::FrfFilter;
use crate::{EngineError, Signal};

/// Length of a fade for models without a network, seconds.
const FADE_S: f64 = 0.1;

/// Most samples that the FRF is applied to at once.
const PIECE_SAMPLES: usize = 1 << 18;

/// Where a prediction is the FRF's, as an answer tells it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FallbackUse {
    /// Share of the answer that is the FRF's: the mean of its weight over the samples, 0..=1.
    pub fallback_share: f64,
    /// Length of a fade, seconds: half of the network's window, and 0.1 s without a network.
    pub fallback_fade_s: f64,
    /// Spans in which the FRF has a part, fades included, by start.
    pub fallback_spans: Vec<FallbackSpan>,
}

/// A span in which the FRF has a part.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct FallbackSpan {
    /// Time of its first sample.
    pub from_s: f64,
    /// Time of the sample after its last one.
    pub to_s: f64,
}

/// The weight of the FRF over a prediction.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Fallback {
    /// Samples at which it is 1, by start, more than two fades apart from each other or one span.
    full: Vec<Range<usize>>,
    fade: usize,
    n_samples: usize,
}

impl Fallback {
    /// Of a prediction of so many samples with this trust. A plain FRF has nothing to fall back from.
    pub(super) fn new(model: &RigModel, trust: &Trust, n_samples: usize) -> Self {
        let rate = model.sample_rate_hz;
        let fade = match &model.lstm {
            Some(part) => part.window_len / 2,
            None => (FADE_S * rate).round() as usize,
        };
        let plain = model.kind == ModelKind::Frf && model.effects.is_empty();
        let sample = |s: f64| ((s * rate).round() as usize).min(n_samples);
        let mut full: Vec<Range<usize>> = Vec::new();
        if !plain {
            let mut spans: Vec<_> = trust.spans.iter().map(|s| sample(s.from_s)..sample(s.to_s)).collect();
            spans.sort_by_key(|span| (span.start, span.end));
            for span in spans {
                let span = span.start..n_samples.min(span.end + fade);
                match full.last_mut() {
                    // Between spans whose fades would meet the FRF stays.
                    Some(last) if span.start <= last.end + 2 * fade => last.end = last.end.max(span.end),
                    _ => full.push(span),
                }
            }
        }
        Self { full, fade, n_samples }
    }

    /// What an answer tells of it.
    pub(super) fn used(&self, sample_rate_hz: f64) -> FallbackUse {
        let time = |sample: usize| sample as f64 / sample_rate_hz;
        let sum: f64 = self.parts().flat_map(|(full, part)| part.map(move |t| self.weight(&full, t))).sum();
        FallbackUse {
            fallback_share: if self.n_samples == 0 { 0.0 } else { sum / self.n_samples as f64 },
            fallback_fade_s: time(self.fade),
            fallback_spans: self
                .parts()
                .map(|(_, part)| FallbackSpan { from_s: time(part.start), to_s: time(part.end) })
                .collect(),
        }
    }

    /// Blends a piece of the response, which begins at sample `from`, with the FRF's to the whole inputs `x`.
    ///
    /// # Errors
    /// A result that is not finite.
    pub(super) fn blend(
        &self,
        filter: &FrfFilter,
        x: &Signal,
        from: usize,
        piece: Signal,
    ) -> Result<Signal, EngineError> {
        let to = from + piece.n_samples();
        if !self.parts().any(|(_, part)| part.start < to && from < part.end) {
            return Ok(piece);
        }
        let rate = piece.sample_rate_hz();
        let mut channels = piece.into_channels();
        for (full, part) in self.parts() {
            let common = part.start.max(from)..part.end.min(to);
            for start in common.clone().step_by(PIECE_SAMPLES) {
                let range = start..common.end.min(start + PIECE_SAMPLES);
                let linear = super::predict::linear(filter, x, range.clone())?;
                for (channel, linear) in channels.iter_mut().zip(&linear) {
                    let samples = &mut channel[range.start - from..range.end - from];
                    for ((t, y), frf) in range.clone().zip(samples).zip(linear) {
                        let weight = self.weight(&full, t);
                        *y = (1.0 - weight) * *y + weight * frf;
                    }
                }
            }
        }
        Signal::new(rate, channels)
    }

    /// Each span of weight 1, and the samples around it with any weight.
    fn parts(&self) -> impl Iterator<Item = (Range<usize>, Range<usize>)> {
        let part = |full: &Range<usize>| {
            full.start.saturating_sub(self.fade)..self.n_samples.min(full.end + self.fade)
        };
        self.full.iter().map(move |full| (full.clone(), part(full)))
    }

    /// Weight of the FRF at sample `t` near a span of weight 1: a raised cosine of the distance.
    fn weight(&self, full: &Range<usize>, t: usize) -> f64 {
        let distance = match t {
            t if t < full.start => full.start - t,
            t if t >= full.end => t + 1 - full.end,
            _ => return 1.0,
        };
        let at = distance as f64 / (self.fade + 1) as f64;
        0.5 + 0.5 * (std::f64::consts::PI * at.min(1.0)).cos()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::tests::made_up;
    use crate::model::{Predictor, TrustSpan};
    use crate::progress::unwatched;

    const N: usize = 3000;

    fn span(from: usize, to: usize) -> TrustSpan {
        let time = |t: usize| t as f64 / 100.0;
        TrustSpan { from_s: time(from), to_s: time(to), channel: "x0".into(), reason: "a test".into() }
    }

    fn trust(spans: Vec<TrustSpan>) -> Trust {
        Trust { inside: 0.5, spans }
    }

    #[test]
    fn the_weight_is_one_in_each_span_and_one_fade_after_it_and_fades_smoothly_on_either_side() {
        // Windows of 20 samples: fades of 10.
        let model = made_up(ModelKind::Hybrid2);
        let of = |spans| Fallback::new(&model, &trust(spans), N);
        let fallback = of(vec![span(500, 600), span(550, 580), span(1000, 1001)]);
        assert_eq!(fallback.full, [500..610, 1000..1011]);
        let used = fallback.used(100.0);
        assert_eq!(used.fallback_fade_s, 0.1);
        let spans: Vec<_> = used.fallback_spans.iter().map(|s| (s.from_s, s.to_s)).collect();
        assert_eq!(spans, [(4.9, 6.2), (9.9, 10.21)]);
        // A fade of ten samples holds five.
        assert!((used.fallback_share * N as f64 - (110.0 + 11.0 + 4.0 * 5.0)).abs() < 1e-9, "{used:?}");
        let weights: Vec<f64> = (480..630).map(|t| fallback.weight(&(500..610), t)).collect();
        assert!(weights.windows(2).all(|w| (w[1] - w[0]).abs() < 0.15), "{weights:?}");
        assert_eq!(
            (weights[9], weights[20], weights[139], weights[140]),
            (0.0, 1.0, weights[10], weights[9])
        );
        // Spans whose fades would meet are one; the ends of the signal end a span.
        let [full] = &of(vec![span(500, 600), span(630, 640)]).full[..] else { panic!("one span") };
        assert_eq!(*full, 500..650);
        assert_eq!(of(vec![span(0, 5), span(2990, 3000)]).full, [0..15, 2990..3000]);
        assert_eq!(of(vec![]).used(100.0).fallback_share, 0.0);
        let linear = made_up(ModelKind::Frf);
        assert_eq!(Fallback::new(&linear, &trust(vec![span(0, 3000)]), N).full, []);
    }

    #[test]
    fn the_answer_is_the_frfs_in_the_spans_the_models_elsewhere_and_the_same_in_pieces() {
        let n = 300_000;
        let wave = |f: f64| (0..n).map(|t| (t as f64 * f).sin()).collect();
        let x = Signal::new(100.0, vec![wave(0.05), wave(0.021)]).unwrap();
        for kind in [ModelKind::Hybrid1, ModelKind::Hybrid2] {
            let model = made_up(kind);
            let predictor = Predictor::new(model.clone()).unwrap();
            let plain = predictor.predict(x.clone()).unwrap();
            let linear = RigModel { kind: ModelKind::Frf, lstm: None, ..model }.predict(&x).unwrap();
            let outside = trust(vec![span(500, 600), span(250_000, 290_000)]);
            let begin = || {
                let mut prediction = predictor.begin(x.clone()).unwrap();
                let used = predictor.fall_back(&mut prediction, &outside).unwrap();
                (prediction, used)
            };
            let (mut prediction, used) = begin();
            let blended = predictor.rest(&mut prediction, &unwatched).unwrap();
            let expected = (100.0 + 40_000.0 + 2.0 * 10.0 + 4.0 * 5.0) / n as f64;
            assert!((used.fallback_share - expected).abs() < 1e-9, "{used:?}");
            for output in 0..3 {
                let (y, model, frf) =
                    (blended.channel(output), plain.channel(output), linear.channel(output));
                for t in [0, 400, 489, 620, 700, 249_000, 299_000] {
                    assert_eq!(y[t], model[t], "{kind:?}, sample {t}");
                }
                for t in [500, 555, 609, 250_000, 270_000, 290_009] {
                    assert!((y[t] - frf[t]).abs() < 1e-9, "{kind:?}, sample {t}");
                }
                let half = |t: usize| 0.5 * (model[t] + frf[t]);
                assert!((y[494] - half(494)).abs() <= 0.2 * (model[494] - frf[494]).abs(), "within the fade");
            }
            let (mut prediction, _) = begin();
            let mut pieces: Vec<Vec<f64>> = vec![Vec::new(); 3];
            while let Some(piece) = predictor.next(&mut prediction, &unwatched).unwrap() {
                pieces.iter_mut().zip(piece.channels()).for_each(|(all, piece)| all.extend(piece));
            }
            for (pieces, whole) in pieces.iter().zip(blended.channels()) {
                for (t, (a, b)) in pieces.iter().zip(whole).enumerate() {
                    assert!((a - b).abs() < 1e-9, "sample {t}: {a} {b}");
                }
            }
        }
    }

    #[test]
    fn a_model_without_an_frf_has_nothing_to_fall_back_to() {
        let predictor = Predictor::new(made_up(ModelKind::Lstm)).unwrap();
        let x = Signal::new(100.0, vec![vec![0.0; 50]; 2]).unwrap();
        let mut prediction = predictor.begin(x).unwrap();
        assert_eq!(predictor.fall_back(&mut prediction, &trust(vec![])), None);
    }
}
