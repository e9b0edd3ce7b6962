//! Stretches of windows over which a channel is beyond a limit, and how that is told.

use std::ops::Range;

use crate::rounded;

/// A way to be beyond a limit over a window.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Way {
    High,
    Low,
    Strong,
    Fast,
    Tonal,
}

impl Way {
    /// The one of the levels of a window that the way is about: its mean, RMS about it, RMS of the rate, RMS of the rate
    /// of a tone.
    pub fn level(self, levels: &[f64]) -> f64 {
        match self {
            Self::High | Self::Low => levels[0],
            Self::Strong => levels[1],
            Self::Fast => levels[2],
            Self::Tonal => levels[3],
        }
    }

    /// Whether the levels of a window, as far as the way goes, are beyond the limit.
    pub fn beyond(self, levels: &[f64], limit: f64) -> bool {
        let level = self.level(levels);
        if self == Self::Low { level < limit } else { level > limit }
    }
}

/// A stretch of one channel beyond a limit.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Beyond {
    /// Samples.
    pub samples: Range<usize>,
    /// In which way.
    pub way: Way,
    /// The limit, channel unit, of rates per second.
    pub limit: f64,
}

impl Beyond {
    /// The quantity and its limit over windows of this length.
    pub fn reason(&self, window_s: f64) -> String {
        let (what, unit) = match self.way {
            Way::High => ("mean over windows above", ""),
            Way::Low => ("mean over windows below", ""),
            Way::Strong => ("RMS over windows above", ""),
            Way::Fast => ("RMS of the rate over windows above", " per second"),
            Way::Tonal => ("RMS of the rate of a single tone over windows above", " per second"),
        };
        let (window_s, limit) = (rounded(window_s, 3), rounded(self.limit, 6));
        format!("{what} that of the training (windows of {window_s} s; limit {limit}{unit})")
    }
}

/// Adds the samples of a window to stretches in order: to the last one where they meet, whose finding takes this one in.
pub(super) fn join<T>(
    stretches: &mut Vec<(Range<usize>, T)>,
    samples: &Range<usize>,
    found: T,
    take_in: impl FnOnce(&mut T, T),
) {
    match stretches.last_mut() {
        Some((last, of_last)) if last.end >= samples.start => {
            last.end = samples.end;
            take_in(of_last, found);
        }
        _ => stretches.push((samples.clone(), found)),
    }
}
