//! Whether an input lies inside what a model was fitted on: value and rate of each channel.

use serde::{Deserialize, Serialize};

use crate::engine::Signal;

/// What one input channel did in the training data, after the model's filter.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct InputRange {
    /// Smallest value, channel unit.
    pub min: f64,
    /// Largest value, channel unit.
    pub max: f64,
    /// Largest absolute rate of change, channel unit per second.
    pub max_rate: f64,
}

/// A stretch in which one channel is outside in one way.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TrustSpan {
    /// Time of the first sample outside.
    pub from_s: f64,
    /// Time of the last sample outside.
    pub to_s: f64,
    /// Channel name.
    pub channel: String,
    /// What left the training range, with the limit.
    pub reason: String,
}

/// Share of samples inside, and the spans outside.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Trust {
    /// Share of samples at which every channel is inside, 0..=1.
    pub inside: f64,
    /// Spans outside, by start. Excursions of one channel in one way that are less than
    /// 0.1 s apart are one span.
    pub spans: Vec<TrustSpan>,
}

/// Excursions closer than this are one span, so that a vibration about the limit reads as one.
const JOIN_S: f64 = 0.1;

/// Rounding of a filter or a file format must not put a training run outside of itself.
const TOLERANCE: f64 = 1e-9;

impl InputRange {
    /// Range over several stretches of one channel.
    pub fn of<'a>(stretches: impl Iterator<Item = &'a [f64]>, sample_rate_hz: f64) -> Self {
        let mut range = Self { min: f64::INFINITY, max: f64::NEG_INFINITY, max_rate: 0.0 };
        for samples in stretches {
            for &v in samples {
                range.min = range.min.min(v);
                range.max = range.max.max(v);
            }
            for pair in samples.windows(2) {
                range.max_rate = range.max_rate.max((pair[1] - pair[0]).abs() * sample_rate_hz);
            }
        }
        range
    }
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Way {
    Above,
    Below,
    Fast,
}

pub(super) fn trust(names: &[String], range: &[InputRange], x: &Signal) -> Trust {
    let n = x.n_samples();
    let fs = x.sample_rate_hz();
    let join = (JOIN_S * fs) as usize;
    let mut outside = vec![false; n];
    let mut rates = Vec::new();
    let mut spans: Vec<(usize, usize, usize, Way)> = Vec::new();
    for (channel, range) in range.iter().enumerate() {
        let samples = x.channel(channel);
        let slack = TOLERANCE * range.min.abs().max(range.max.abs());
        let rate_limit = range.max_rate * (1.0 + TOLERANCE) + slack * fs;
        for way in [Way::Above, Way::Below, Way::Fast] {
            let mut open: Option<(usize, usize)> = None;
            let mut leave = |t: usize| {
                outside[t] = true;
                open = match open {
                    Some((from, to)) if t - to <= join.max(1) => Some((from, t)),
                    Some((from, to)) => {
                        spans.push((from, to, channel, way));
                        Some((t, t))
                    }
                    None => Some((t, t)),
                };
            };
            match way {
                Way::Above => each(samples, |v| *v > range.max + slack, &mut leave),
                Way::Below => each(samples, |v| *v < range.min - slack, &mut leave),
                Way::Fast => {
                    let steps = samples.windows(2).map(|pair| pair[1] - pair[0]);
                    rates.clear();
                    rates.extend(steps.map(|step| step.abs() * fs));
                    each(&rates, |rate| *rate > rate_limit, |t| leave(t + 1));
                }
            }
            if let Some((from, to)) = open {
                spans.push((from, to, channel, way));
            }
        }
    }
    spans.sort_by_key(|&(from, _, channel, _)| (from, channel));
    let spans = spans
        .into_iter()
        .map(|(from, to, channel, way)| {
            let r = &range[channel];
            let reason = match way {
                Way::Above => format!("value above the training maximum {}", r.max),
                Way::Below => format!("value below the training minimum {}", r.min),
                Way::Fast => format!("rate above the training maximum {} per second", r.max_rate),
            };
            TrustSpan {
                from_s: from as f64 / fs,
                to_s: to as f64 / fs,
                channel: names[channel].clone(),
                reason,
            }
        })
        .collect();
    let inside = outside.iter().filter(|&&o| !o).count();
    Trust { inside: if n == 0 { 1.0 } else { inside as f64 / n as f64 }, spans }
}

/// Calls `then` with the place of each value that is `out`. Hardly any is, so whole blocks are looked
/// at without a branch a value.
fn each(values: &[f64], out: impl Fn(&f64) -> bool, mut then: impl FnMut(usize)) {
    const BLOCK: usize = 512;
    for (block, values) in values.chunks(BLOCK).enumerate() {
        if values.iter().fold(false, |any, v| any | out(v)) {
            let places = values.iter().enumerate().filter(|(_, v)| out(v)).map(|(i, _)| i);
            places.for_each(|i| then(block * BLOCK + i));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ramp_range() -> Vec<InputRange> {
        vec![InputRange::of([&[0.0, 1.0, 2.0][..], &[-1.0, -1.0]].into_iter(), 10.0)]
    }

    #[test]
    fn a_range_spans_all_stretches_but_no_step_between_them() {
        assert_eq!(ramp_range()[0], InputRange { min: -1.0, max: 2.0, max_rate: 10.0 });
    }

    #[test]
    fn the_training_signal_itself_is_wholly_inside() {
        let x = Signal::new(10.0, vec![vec![0.0, 1.0, 2.0]]).unwrap();
        assert_eq!(trust(&["d".into()], &ramp_range(), &x), Trust { inside: 1.0, spans: vec![] });
    }

    #[test]
    fn each_way_out_is_a_span_with_its_limit() {
        let x = Signal::new(10.0, vec![vec![0.0, 1.0, 2.0, 2.5, 2.0, 1.0, 0.0, -2.0]]).unwrap();
        let t = trust(&["d".into()], &ramp_range(), &x);
        assert_eq!(t.inside, 6.0 / 8.0);
        let seen: Vec<_> = t.spans.iter().map(|s| (s.from_s, s.to_s, s.reason.as_str())).collect();
        assert_eq!(
            seen,
            [
                (0.3, 0.3, "value above the training maximum 2"),
                (0.7, 0.7, "value below the training minimum -1"),
                (0.7, 0.7, "rate above the training maximum 10 per second"),
            ]
        );
    }

    #[test]
    fn excursions_close_together_are_one_span() {
        let mut samples = vec![0.0; 100];
        samples[10] = 3.0;
        samples[15] = 3.0;
        samples[60] = 3.0;
        let x = Signal::new(100.0, vec![samples]).unwrap();
        let range = [InputRange { min: -1.0, max: 1.0, max_rate: 1e9 }];
        let t = trust(&["d".into()], &range, &x);
        assert_eq!(t.spans.iter().map(|s| (s.from_s, s.to_s)).collect::<Vec<_>>(), [(0.1, 0.15), (0.6, 0.6)]);
        assert_eq!(t.inside, 0.97);
    }
}
