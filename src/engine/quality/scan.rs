//! The one pass over a channel that looks at every sample.

use std::io;

use super::dropouts::{Dropouts, SpanFinder};
use super::spikes::{SpikeFinder, Spikes};
use super::{Excerpts, SHORTEST};
use crate::Samples;
use crate::samples::each_block;

/// Samples of another channel that are read to see whether it rests too.
const LOOKED_AT: usize = 256;

/// The figures of one pass.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Scan {
    /// Spikes.
    pub spikes: Spikes,
    /// Drop-outs. A span in which every other channel rests as well is a rest of the rig.
    pub dropouts: Dropouts,
}

/// Spikes and drop-outs of a channel that moves; `others` are the other channels that do. `None` for a run
/// of fewer than [`SHORTEST`] samples. `min`, `max`, `std` and `step` (of the values, 0 for none) are those of the
/// channel.
///
/// # Errors
/// Those of the file that holds the samples.
pub fn scan(
    samples: &mut impl Samples,
    channel: usize,
    others: &[usize],
    excerpts: &Excerpts,
    [min, max, std, step]: [f64; 4],
) -> io::Result<Option<Scan>> {
    let (n, peak) = (samples.n_samples(), min.abs().max(max.abs()));
    if n < SHORTEST || !(std > 0.0 && peak < f64::MAX.sqrt()) {
        return Ok(None);
    }
    let mut spikes = SpikeFinder::new(excerpts, n, std, peak, step);
    let mut spans = SpanFinder::new(excerpts, n, step, [min, max]);
    let margin = SpikeFinder::MARGIN;
    // The samples that are not yet judged, and those before them that judging needs.
    let (mut kept, mut start): (Vec<f64>, usize) = (Vec::new(), 0);
    each_block(samples, channel, |block| {
        spans.take(block);
        kept.extend_from_slice(block);
        if kept.len() > 2 * margin {
            let end = kept.len() - margin;
            spikes.take(&kept, margin..end, start);
            let used = end - margin;
            start += used;
            kept.drain(..used);
        }
        Ok(())
    })?;
    let (found, beyond) = spans.end();
    let mut dropouts = Dropouts::default();
    for span in found {
        if !all_rest(samples, others, span.first..span.first + span.len)? {
            dropouts.add(span);
        }
    }
    // Where all spans that were looked at are rests, those that were not are taken for rests too.
    if dropouts.count > 0 {
        dropouts.count += beyond.count;
        dropouts.longest = dropouts.longest.max(beyond.longest);
        dropouts.samples += beyond.samples;
    }
    Ok(Some(Scan { spikes: spikes.end(), dropouts }))
}

/// Whether every one of these channels holds its value over a range, of which the middle is looked at.
fn all_rest(
    samples: &mut impl Samples,
    channels: &[usize],
    range: std::ops::Range<usize>,
) -> io::Result<bool> {
    let len = range.len().min(LOOKED_AT);
    let first = range.start + (range.len() - len) / 2;
    for &channel in channels {
        let mut part = Vec::with_capacity(len);
        samples.read(channel, first..first + len, &mut part)?;
        if part.iter().any(|v| *v != part[0]) {
            return Ok(false);
        }
    }
    Ok(!channels.is_empty())
}
