//! The span of time in which a prediction is farthest off.

use serde::{Deserialize, Serialize};

use crate::Signal;

/// The span and the channel with the largest error.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct WorstSpan {
    /// Time of its first sample.
    pub from_s: f64,
    /// Time of the sample after its last.
    pub to_s: f64,
    /// Channel name.
    pub channel: String,
    /// RMS of the error in the span, relative to the measured channel's RMS over the whole run.
    pub rms: f64,
}

/// Looks through spans of `span_s` (the whole run, if that is shorter) that begin half a span apart, and the last
/// one. Of equals the first counts, channels in their order. `None` where every measured channel is zero.
pub(super) fn worst_span(
    names: &[String],
    measured: &Signal,
    predicted: &Signal,
    span_s: f64,
) -> Option<WorstSpan> {
    let (n, fs) = (measured.n_samples(), measured.sample_rate_hz());
    let len = ((span_s * fs).round() as usize).clamp(1, n.max(1));
    let mut worst: Option<(f64, usize, usize)> = None;
    for channel in 0..measured.n_channels() {
        let (m, p) = (measured.channel(channel), predicted.channel(channel));
        let power = m.iter().map(|v| v * v).sum::<f64>() / n as f64;
        if power == 0.0 {
            continue;
        }
        let last = n - len;
        for start in (0..last).step_by((len / 2).max(1)).chain([last]) {
            let pairs = m[start..start + len].iter().zip(&p[start..start + len]);
            let error = pairs.map(|(m, p)| (m - p).powi(2)).sum::<f64>() / len as f64;
            let rms = (error / power).sqrt();
            if worst.is_none_or(|(most, ..)| rms > most) {
                worst = Some((rms, channel, start));
            }
        }
    }
    worst.map(|(rms, channel, start)| WorstSpan {
        from_s: start as f64 / fs,
        to_s: (start + len) as f64 / fs,
        channel: names[channel].clone(),
        rms,
    })
}
