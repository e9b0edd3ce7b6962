//! Whether an input lies inside what a model was fitted on: value and rate of each channel, where its power lies in
//! frequency, means and levels over short times, and those of the linear response to all channels together.

mod band;
mod beyond;
mod excursion;
mod joint;
mod levels;
mod local;
mod range;
mod response;
mod short_time;
#[cfg(test)]
mod tests;
mod watch;

use std::ops::Range;

use serde::Serialize;

use super::RigModel;
use crate::{Signal, rounded};

pub(super) use excursion::excursions;
pub use excursion::{Excursion, Remedy};
pub use joint::JointRange;
pub use local::LocalRange;
pub use range::InputRange;
pub use response::WindowRange;
pub(super) use watch::{SpectrumWatch, of_training};

/// A span in which one channel is outside in one way.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TrustSpan {
    /// Time of the first sample outside.
    pub from_s: f64,
    /// Time of the sample after the last one outside.
    pub to_s: f64,
    /// Channel name.
    pub channel: String,
    /// The quantity that left the training range, with the limit.
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

/// `watch` is the model's, [`SpectrumWatch::new`]; `x` the inputs behind its filter.
pub(super) fn trust(model: &RigModel, watch: Option<&SpectrumWatch>, x: &Signal) -> Trust {
    let range = &model.range;
    let n = x.n_samples();
    let fs = x.sample_rate_hz();
    // Channels are counted from the first input to the last output.
    let mut found: Vec<(Range<usize>, usize, String)> = Vec::new();
    let mut outside = Outside { join: ((JOIN_S * fs) as usize).max(1), samples: vec![false; n] };
    let mut rates = Vec::new();
    for (channel, range) in range.iter().enumerate() {
        let InputRange { min, max, max_rate, .. } = *range;
        let slack = TOLERANCE * min.abs().max(max.abs());
        let rate_limit = max_rate * (1.0 + TOLERANCE) + slack * fs;
        let samples = x.channel(channel);
        rates.clear();
        rates.extend(samples.windows(2).map(|pair| (pair[1] - pair[0]).abs() * fs));
        let mut add = |excursions: Vec<Range<usize>>, what: &str, limit: f64, unit: &str| {
            let reason = format!("{what} {}{unit}", rounded(limit, 6));
            found.extend(excursions.into_iter().map(|samples| (samples, channel, reason.clone())));
        };
        add(outside.leaving(samples, 0, |v| v > max + slack), "value above the training maximum", max, "");
        add(outside.leaving(samples, 0, |v| v < min - slack), "value below the training minimum", min, "");
        // The sample at which a step ends is outside.
        let fast = outside.leaving(&rates, 1, |rate| rate > rate_limit);
        add(fast, "rate above the training maximum", max_rate, " per second");
    }
    let mut add = |samples: Range<usize>, channel: usize, reason: String| {
        outside.samples[samples.clone()].fill(true);
        found.push((samples, channel, reason));
    };
    if let Some(watch) = watch {
        let seen = watch.find(model, x);
        for part in seen.out_of_band {
            let reason = out_of_band(&part);
            add(part.samples, part.input, reason);
        }
        let (of, first) =
            if model.frf.is_some() { ("linear response: ", model.inputs.len()) } else { ("", 0) };
        for (place, beyond) in seen.driven {
            let reason = beyond.reason(model.window_range[place].window as f64 / fs);
            add(beyond.samples, first + place, format!("{of}{reason}"));
        }
        if let Some(joint) = &model.joint_range {
            for (samples, apart) in seen.apart {
                add(samples, apart.input, far_apart(joint, apart.distance, fs));
            }
        }
    }
    for (channel, range) in range.iter().enumerate() {
        let Some(local) = &range.local else { continue };
        for beyond in local.find([range.min, range.max], x.channel(channel)) {
            let reason = beyond.reason(local.window as f64 / fs);
            add(beyond.samples, channel, reason);
        }
    }
    found.sort_by_key(|(samples, channel, _)| (samples.start, *channel));
    let span = |(samples, channel, reason): (Range<usize>, usize, String)| TrustSpan {
        from_s: samples.start as f64 / fs,
        to_s: samples.end as f64 / fs,
        channel: model.inputs.iter().chain(&model.outputs).nth(channel).cloned().unwrap_or_default(),
        reason,
    };
    let inside = outside.samples.iter().filter(|&&o| !o).count();
    Trust {
        inside: if n == 0 { 1.0 } else { inside as f64 / n as f64 },
        spans: found.into_iter().map(span).collect(),
    }
}

fn far_apart(joint: &JointRange, distance: f64, sample_rate_hz: f64) -> String {
    let (window_s, distance, limit) =
        (rounded(joint.window as f64 / sample_rate_hz, 3), rounded(distance, 3), rounded(joint.limit(), 3));
    format!(
        "means of all drives together farther from the middle of the training than its own (windows of {window_s} s; \
         Mahalanobis distance {distance}, limit {limit})"
    )
}

fn out_of_band(out: &band::OutOfBand) -> String {
    let [from, to] = out.band_hz.map(|hz| rounded(hz, 4));
    format!(
        "{} % of the power lies outside {from} to {to} Hz, the band of the training (over windows of {} s; {} % are inside)",
        rounded(100.0 * out.share, 2),
        rounded(out.window_s, 3),
        100.0 * band::SHARE
    )
}

/// The samples that are outside in any way.
struct Outside {
    /// Excursions so close together are one.
    join: usize,
    samples: Vec<bool>,
}

impl Outside {
    /// Excursions of values, the first of which is that of the sample `first`.
    fn leaving(&mut self, values: &[f64], first: usize, out: impl Fn(f64) -> bool) -> Vec<Range<usize>> {
        let mut found: Vec<Range<usize>> = Vec::new();
        each(values, out, |place| {
            let t = first + place;
            self.samples[t] = true;
            match found.last_mut() {
                Some(last) if t - (last.end - 1) <= self.join => last.end = t + 1,
                _ => found.push(t..t + 1),
            }
        });
        found
    }
}

/// Calls `then` with the index of each value that is `out`. Hardly any is, so that whole blocks are checked
/// without a branch per value.
fn each(values: &[f64], out: impl Fn(f64) -> bool, mut then: impl FnMut(usize)) {
    const BLOCK: usize = 512;
    for (block, values) in values.chunks(BLOCK).enumerate() {
        if values.iter().fold(false, |any, v| any | out(*v)) {
            let places = values.iter().enumerate().filter(|(_, v)| out(**v)).map(|(i, _)| i);
            places.for_each(|i| then(block * BLOCK + i));
        }
    }
}
