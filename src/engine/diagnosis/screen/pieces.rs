//! What is looked at of a recording: all of it, or of a long one the beginnings of its stretches.
//!
//! Each beginning is then a record of its own, so that neither what lies between is filtered nor laws are run over it.

use std::borrow::Cow;

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
    pub most: usize,
    /// Start of the first record and end of the last, s.
    pub programme: [f64; 2],
}

impl<'a> Pieces<'a> {
    /// What is looked at of a recording by at `most` so many rows.
    pub fn of(recording: &'a Recording, grouping: &'a Grouping, band: Band, most: usize) -> Self {
        let cut = cut(recording, &grouping.stretches, band.step, most);
        let (recording_of, stretches) = match cut {
            Some((records, stretches)) => {
                let (drives, responses) = (recording.drives.clone(), recording.responses.clone());
                (Cow::Owned(Recording { drives, responses, records }), Cow::Owned(stretches))
            }
            None => (Cow::Borrowed(recording), Cow::Borrowed(grouping.stretches.as_slice())),
        };
        Self { recording: recording_of, stretches, band, most, programme: programme(recording) }
    }

    /// Share of the rows of all stretches that are looked at.
    pub fn share(&self, step: usize) -> f64 {
        share(&self.stretches, step, self.most)
    }
}

fn share(stretches: &[Stretch], step: usize, most: usize) -> f64 {
    let rows: usize = stretches.iter().map(|s| s.samples.len() / step).sum();
    (most as f64 / rows.max(1) as f64).min(1.0)
}

/// A record for the beginning of each stretch, with what the linear part remembers before it; `None` where little would
/// be saved, or the pieces were short.
fn cut(
    recording: &Recording,
    stretches: &[Stretch],
    step: usize,
    most: usize,
) -> Option<(Vec<Record>, Vec<Stretch>)> {
    let share = share(stretches, step, most);
    let memory = MOST / recording.drives.len().max(1);
    let mut whole = vec![0; recording.records.len()];
    let pieces: Vec<(Record, Stretch)> = stretches
        .iter()
        .enumerate()
        .map(|(at, stretch)| {
            let record = &recording.records[stretch.record];
            let n = record.drive.n_samples();
            // Whole rows, so that pieces are thinned alike.
            let from = (stretch.samples.start.min(n) / step).saturating_sub(memory) * step;
            let kept = (stretch.samples.len() as f64 * share) as usize;
            let to = (stretch.samples.start + kept).min(n);
            whole[stretch.record] = whole[stretch.record].max(to);
            let samples = stretch.samples.start.min(n) - from..to - from;
            (record.piece(from..to), Stretch { record: at, samples, ..stretch.clone() })
        })
        .collect();
    let length = |piece: &(Record, Stretch)| piece.0.drive.n_samples();
    let total: usize = pieces.iter().map(length).sum();
    let shortest = pieces.iter().map(length).min().unwrap_or(0);
    let saves = (total as f64) < WORTH * whole.iter().sum::<usize>() as f64;
    (saves && shortest >= MEMORIES * memory * step).then(|| pieces.into_iter().unzip())
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
