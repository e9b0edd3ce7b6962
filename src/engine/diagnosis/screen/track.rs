//! Signals over all records at the rate of the analysis, and the rows of them that are fitted and judged.

use std::ops::Range;

/// Samples of one signal, `[record][sample]`.
pub(super) type Track = Vec<Vec<f64>>;

/// Rows of one record that belong together.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Segment {
    pub record: usize,
    pub rows: Range<usize>,
    /// Held out together.
    pub group: usize,
    /// Held out together while the linear part is chosen.
    pub part: usize,
    /// Repeats of the same drive share it.
    pub unit: usize,
    /// Factor of its rows, so that loud groups do not outvote quiet ones.
    pub weight: f64,
}

/// `samples[rows - lag]`, held before the first and after the last sample, about its own mean, times `weight`.
pub(super) fn delayed(samples: &[f64], segment: &Segment, lag: isize) -> Vec<f64> {
    let last = samples.len() as isize - 1;
    let rows = segment.rows.start as isize - lag..segment.rows.end as isize - lag;
    let mut out: Vec<f64> = if rows.start >= 0 && rows.end <= last + 1 {
        samples[rows.start as usize..rows.end as usize].to_vec()
    } else {
        rows.map(|t| samples[t.clamp(0, last) as usize]).collect()
    };
    centre(&mut out, segment);
    out
}

/// Centres rows of a segment and weights them.
pub(super) fn centre(rows: &mut [f64], segment: &Segment) {
    let mean = rows.iter().sum::<f64>() / rows.len().max(1) as f64;
    rows.iter_mut().for_each(|x| *x = (*x - mean) * segment.weight);
}

/// Mean over all samples.
pub(super) fn mean(track: &Track) -> f64 {
    let n = track.iter().map(Vec::len).sum::<usize>().max(1);
    track.iter().flatten().sum::<f64>() / n as f64
}

/// One track less another.
pub(super) fn less(track: &Track, other: &Track) -> Track {
    let of = |(x, y): (&Vec<f64>, &Vec<f64>)| x.iter().zip(y).map(|(x, y)| x - y).collect();
    track.iter().zip(other).map(of).collect()
}

/// Adds a track to another.
pub(super) fn add(to: &mut Track, more: &Track) {
    to.iter_mut().flatten().zip(more.iter().flatten()).for_each(|(x, more)| *x += more);
}

/// Deviation over all rows of a track, each segment about its own mean.
pub(super) fn deviation(track: &Track, segments: &[Segment]) -> f64 {
    let (mut sum, mut count) = (0.0, 0);
    for segment in segments {
        let rows = &track[segment.record][segment.rows.clone()];
        let mean = rows.iter().sum::<f64>() / rows.len().max(1) as f64;
        sum += rows.iter().map(|x| (x - mean).powi(2)).sum::<f64>();
        count += rows.len();
    }
    (sum / count.max(1) as f64).sqrt()
}
