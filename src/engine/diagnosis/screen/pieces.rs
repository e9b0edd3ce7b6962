//! What is looked at of a recording: all of it, or of a long one the beginnings of its stretches.
//!
//! Each beginning is then a record of its own, so that neither what lies between is filtered nor laws are run over it.

use std::borrow::Cow;
use std::ops::Range;

use super::band::Band;
use super::groups::{Grouping, Stretch};
use super::input::{Record, Recording};
use super::linear_part::MOST;

/// Most rows that are fitted and judged: more cost time and tell little more.
pub(super) const MOST_ROWS: usize = 48_000;
/// Pieces of this share of the samples that would be filtered otherwise are worth cutting out.
const WORTH: f64 = 0.7;
/// A piece is at least so many times as long as the longest memory of a linear part: no memory gets shorter by it.
const MEMORIES: usize = 4;

/// The pieces of a recording that are looked at.
pub(super) struct Pieces<'a> {
    pub recording: Cow<'a, Recording>,
    /// Stretches of its records.
    pub stretches: Cow<'a, [Stretch]>,
    /// Of the whole recording.
    pub band: Band,
    /// Most rows at any rate.
    most: usize,
    /// Start of the first record and end of the last, s.
    pub programme: [f64; 2],
}

impl<'a> Pieces<'a> {
    /// What is looked at of a recording by at `most` so many rows.
    pub fn of(recording: &'a Recording, grouping: &'a Grouping, band: Band, most: usize) -> Self {
        let whole = Self {
            recording: Cow::Borrowed(recording),
            stretches: Cow::Borrowed(&grouping.stretches),
            band,
            most,
            programme: programme(recording),
        };
        whole.pieces().unwrap_or(whole)
    }

    /// The same by at `most` so many of these rows.
    pub fn fewer(&'a self, most: usize) -> Self {
        self.at(self.band, most)
    }

    /// The same at the rate of another band, by at `most` so many rows there.
    pub fn at(&'a self, band: Band, most: usize) -> Self {
        let same = Self {
            recording: Cow::Borrowed(&*self.recording),
            stretches: Cow::Borrowed(&*self.stretches),
            band,
            most,
            ..*self
        };
        same.pieces().unwrap_or(same)
    }

    /// Share of the rows of all stretches that are looked at.
    pub fn share(&self, step: usize) -> f64 {
        let rows: usize = self.stretches.iter().map(|s| s.samples.len() / step).sum();
        (self.most as f64 / rows.max(1) as f64).min(1.0)
    }

    /// A record for the beginning of each stretch, with what the linear part remembers before it; `None` where little
    /// would be saved, or the pieces were short.
    fn pieces(&self) -> Option<Self> {
        let step = self.band.step;
        let share = self.share(step);
        let memory = MOST / self.recording.drives.len().max(1);
        let mut whole = vec![0; self.recording.records.len()];
        let ranges: Vec<Range<usize>> = self
            .stretches
            .iter()
            .map(|stretch| {
                let n = self.recording.records[stretch.record].drive.n_samples();
                let start = stretch.samples.start.min(n);
                // Whole rows, so that pieces are thinned alike.
                let from = (start / step).saturating_sub(memory) * step;
                let to = (start + (stretch.samples.len() as f64 * share) as usize).min(n);
                whole[stretch.record] = whole[stretch.record].max(to);
                from..to
            })
            .collect();
        let total: usize = ranges.iter().map(Range::len).sum();
        let shortest = ranges.iter().map(Range::len).min().unwrap_or(0);
        let saves = (total as f64) < WORTH * whole.iter().sum::<usize>() as f64;
        if !saves || shortest < MEMORIES * memory * step {
            return None;
        }
        let of = |(at, (stretch, range)): (usize, (&Stretch, Range<usize>))| {
            let samples = stretch.samples.start - range.start..range.len();
            let record = self.recording.records[stretch.record].piece(range);
            (record, Stretch { record: at, samples, ..stretch.clone() })
        };
        let (records, stretches): (Vec<Record>, Vec<Stretch>) =
            self.stretches.iter().zip(ranges).enumerate().map(of).unzip();
        let (drives, responses) = (self.recording.drives.clone(), self.recording.responses.clone());
        Some(Self {
            recording: Cow::Owned(Recording { drives, responses, records }),
            stretches: Cow::Owned(stretches),
            ..*self
        })
    }
}

fn programme(recording: &Recording) -> [f64; 2] {
    let records = &recording.records;
    let first = records.iter().map(|r| r.started_s).fold(f64::INFINITY, f64::min);
    let last = records.iter().map(|r| r.started_s + r.drive.duration_s()).fold(f64::NEG_INFINITY, f64::max);
    [first, last]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diagnosis::screen::group;
    use crate::diagnosis::screen::tests::systems::{RATE_HZ, run};

    const BAND: Band = Band { low_hz: 0.0, high_hz: 15.0, step: 2 };

    #[test]
    fn of_a_long_recording_the_beginnings_of_stretches_are_records_with_their_past() {
        let recording = run(120_000, 1.0, |_, _| 0.0);
        let grouping = group(&recording, &[]);
        let pieces = Pieces::of(&recording, &grouping, BAND, 18_000);
        assert_eq!(pieces.recording.records.len(), grouping.stretches.len());
        for ((piece, stretch), of) in
            pieces.recording.records.iter().zip(pieces.stretches.iter()).zip(&grouping.stretches)
        {
            let past = stretch.samples.start;
            assert_eq!(past, if of.samples.start == 0 { 0 } else { MOST * BAND.step });
            assert_eq!(stretch.samples.len(), of.samples.len() * 3 / 10);
            let whole = of.samples.start - past..of.samples.start + stretch.samples.len();
            let of_whole = |signal: &crate::Signal| signal.channel(0)[whole.clone()].to_vec();
            let record = &recording.records[of.record];
            assert_eq!(piece.drive.channel(0), of_whole(&record.drive));
            assert_eq!(piece.response.channel(0), of_whole(&record.response));
            assert!((piece.started_s - whole.start as f64 / RATE_HZ).abs() < 1e-9);
            assert_eq!((stretch.group, stretch.part, stretch.unit), (of.group, of.part, of.unit));
        }
        assert_eq!(pieces.programme, [0.0, 1200.0]);
        assert!((pieces.share(BAND.step) - 1.0).abs() < 1e-3, "all of them is looked at");
        let fewer = pieces.fewer(9_000);
        assert_eq!(fewer.programme, pieces.programme);
        assert!(
            (fewer.share(BAND.step) - 0.5).abs() < 1e-3,
            "no longer than the memories, they are not cut again"
        );
        assert_eq!(*fewer.recording, *pieces.recording);
    }

    #[test]
    fn a_recording_is_left_whole_where_pieces_would_save_little_or_be_short() {
        let recording = run(120_000, 1.0, |_, _| 0.0);
        let grouping = group(&recording, &[]);
        for most in [48_000, 40_000, 4_000] {
            let pieces = Pieces::of(&recording, &grouping, BAND, most);
            assert_eq!(*pieces.recording, recording, "{most}");
            assert_eq!(*pieces.stretches, *grouping.stretches, "{most}");
        }
    }
}
