//! The samples that fill the last frame of a file. The format's description fills with zeros, other programs
//! with the last value; the true length is not stored unless a program adds `SAMPLES`.

use std::io;

use serde::Deserialize;

use crate::formats::Spool;

/// What happens to samples that seem to fill the last frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Padding {
    /// They are left out: an offset that drops to zero adds a cycle to the damage of every channel.
    #[default]
    Strip,
    /// They are kept.
    Keep,
}

/// Equal samples at the end of all channels that count as padding; fewer may be chance.
const FEWEST: usize = 8;

/// Samples that are looked at, so that a frame of the length of a file takes no more memory.
const MOST: usize = 1 << 16;

/// Shortens the columns by the samples of the last frame that are the same in every column: all of them where they
/// are zero, all but the first where they repeat a value. A run that does not change at all is kept.
///
/// # Errors
/// Those of the file.
pub(super) fn strip(spool: &mut Spool, frame: usize) -> io::Result<()> {
    let samples = spool.len(0);
    let looked_at = samples.min(frame).min(MOST);
    let (mut alike, mut zero) = (looked_at, true);
    let mut end = Vec::new();
    for column in 0..spool.n_columns() {
        end.clear();
        spool.read(column, samples - looked_at..samples, &mut end)?;
        let Some(&last) = end.last() else { return Ok(()) };
        alike = alike.min(end.iter().rev().take_while(|&&value| value == last).count());
        zero &= last == 0.0;
    }
    if alike < FEWEST || alike == samples {
        return Ok(());
    }
    spool.truncate(samples - alike + usize::from(!zero))
}
