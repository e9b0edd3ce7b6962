//! Drop-outs: spans in which a measured channel holds one value while it should move.
//!
//! A span counts if it is longer than the channel's own repetitions of a value make likely (the converter's steps make
//! neighbours equal), if the channel enters or leaves it by a jump, and if another channel moves meanwhile. A channel
//! that comes to rest has no jump, and neither has one that is clipped.

use serde::{Deserialize, Serialize};

use super::{Excerpts, FALSE_ALARM};

/// Shortest drop-out, samples.
const SHORTEST_SPAN: usize = 8;
/// A jump is at least this share of the channel's typical step (the median of the steps that are not zero), ...
const SHARE_OF_STEP: f64 = 0.25;
/// ... and so many steps of its values: a coarse signal leaves a level by one or two.
const STEPS: f64 = 4.0;
/// A span at the smallest or largest value of a channel is clipping, unless the channel both enters and leaves it
/// by so many typical steps.
const STEPS_FROM_EXTREME: f64 = 4.0;
/// Spans that are kept to be compared with the other channels.
const KEPT: usize = 1024;
/// Samples of a piece in which equal neighbours are counted. A piece may lie wholly in a drop-out.
const PIECE: usize = 16;
/// Share of equal neighbours in a piece with a single change: that of a signal which holds its value by nature.
const HOLDS: f64 = 14.0 / 15.0;

/// Drop-outs of one channel.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Dropouts {
    /// Number.
    pub count: u64,
    /// First sample of the first one, from 0; `None` without one.
    pub first_sample: Option<u64>,
    /// Samples of the longest one.
    pub longest: u64,
    /// Samples of all.
    pub samples: u64,
}

/// A span of equal samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Span {
    pub first: usize,
    pub len: usize,
}

/// Finds spans of equal samples with a jump at an end, block by block.
#[derive(Debug)]
pub(super) struct SpanFinder {
    /// Shortest span that counts.
    least: usize,
    /// Smallest jump that counts.
    jump: f64,
    /// Smallest and largest value, and the smallest jump that counts there.
    extremes: [f64; 2],
    jump_from_extreme: f64,
    n: usize,
    /// Samples that were taken.
    taken: usize,
    /// Value, length and jump into the span that runs.
    value: f64,
    len: usize,
    entered_by: f64,
    found: Vec<Span>,
    /// Spans that were found beyond [`KEPT`].
    beyond: Dropouts,
}

impl SpanFinder {
    /// For a channel of `n` samples; `step` is that of its values, 0 for none.
    pub fn new(excerpts: &Excerpts, n: usize, step: f64, extremes: [f64; 2]) -> Self {
        let least = least_span(excerpts, n);
        let mut steps: Vec<f64> = excerpts
            .parts()
            .iter()
            .flat_map(|part| part.windows(2).map(|p| (p[1] - p[0]).abs()))
            .filter(|d| *d > 0.0)
            .collect();
        let typical = super::quantile(&mut steps, 0.5);
        Self {
            least,
            jump: (SHARE_OF_STEP * typical).max((STEPS - 0.5) * step),
            extremes,
            jump_from_extreme: STEPS_FROM_EXTREME * typical,
            n,
            taken: 0,
            value: f64::NAN,
            len: 0,
            entered_by: 0.0,
            found: Vec::new(),
            beyond: Dropouts::default(),
        }
    }

    pub fn take(&mut self, block: &[f64]) {
        if self.least >= self.n {
            return;
        }
        for &sample in block {
            if sample != self.value {
                if self.len >= self.least {
                    self.close((sample - self.value).abs());
                }
                self.entered_by = if self.taken == 0 { 0.0 } else { (sample - self.value).abs() };
                (self.value, self.len) = (sample, 0);
            }
            self.len += 1;
            self.taken += 1;
        }
    }

    fn close(&mut self, left_by: f64) {
        let clipped =
            self.extremes.contains(&self.value) && self.entered_by.min(left_by) < self.jump_from_extreme;
        if clipped || self.entered_by.max(left_by) < self.jump || self.len < self.least || self.len == self.n
        {
            return;
        }
        let span = Span { first: self.taken - self.len, len: self.len };
        if self.found.len() < KEPT {
            self.found.push(span);
        } else {
            self.beyond.add(span);
        }
    }

    /// The first [`KEPT`] spans in order, and the sum of all further ones.
    pub fn end(mut self) -> (Vec<Span>, Dropouts) {
        self.close(0.0);
        (self.found, self.beyond)
    }
}

impl Dropouts {
    pub(super) fn add(&mut self, span: Span) {
        self.count += 1;
        self.first_sample.get_or_insert(span.first as u64);
        self.longest = self.longest.max(span.len as u64);
        self.samples += span.len as u64;
    }
}

/// Samples of the shortest span of equal samples that the channel does not make by itself. A run of `len` equal samples
/// has the probability `p^(len - 1)`, and there are `n` places for it. `p` is the share of equal neighbours in the stillest
/// pieces of the channel that are not still altogether, since quiet stretches repeat values more often than loud ones.
fn least_span(excerpts: &Excerpts, n: usize) -> usize {
    let share = |piece: &[f64]| piece.windows(2).filter(|p| p[0] == p[1]).count() as f64 / (PIECE - 1) as f64;
    let pieces = excerpts.parts().iter().flat_map(|part| part.chunks_exact(PIECE));
    let (still, mut moving): (Vec<f64>, Vec<f64>) = pieces.map(share).partition(|share| *share >= 1.0);
    let equal = super::quantile(&mut moving, 0.99);
    // A square wave, a switch: its spans are what it is made of.
    if moving.is_empty() || (still.len() > moving.len() && equal >= HOLDS) {
        return n;
    }
    let unlikely = (n as f64 / FALSE_ALARM).ln() / -equal.ln();
    (unlikely.ceil() as usize).clamp(SHORTEST_SPAN, n.max(SHORTEST_SPAN))
}
