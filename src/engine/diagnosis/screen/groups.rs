//! Which parts of a recording are alike, so that something can be carried from some to others.
//!
//! Records whose drives agree are repeats, and so are the periods of a drive inside a record: they count as one
//! drive, since a linear part with a value of its own at every line predicts a repeat perfectly, whatever the
//! rig. What is left is classed by the drives' level, spectrum and offset.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use super::input::Recording;
use super::period::period;

/// What the held-out groups differ in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Transfer {
    /// Level, spectrum or offset: three classes or more.
    Classes,
    /// Two classes, each in parts: a law is seen at both levels while one part of one is held out.
    TwoClasses,
    /// Runs of one class.
    Runs,
    /// Stretches of one run.
    Stretches,
    /// Stretches of one drive that every run and period repeats: nothing is carried to another drive.
    OneDrive,
}

/// Samples of one record that belong to one group.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Stretch {
    /// Record.
    pub record: usize,
    /// Samples.
    pub samples: Range<usize>,
    /// Group that is held out together.
    pub group: usize,
    /// Part of the data by which the linear part is chosen: parts hold every class.
    pub part: usize,
    /// A drive and a place in it: repeats share it, and tell nothing new of it but noise.
    pub unit: usize,
}

/// The parts of a recording.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Grouping {
    /// Stretches by record and time.
    pub stretches: Vec<Stretch>,
    /// Number of groups, at least two.
    pub groups: usize,
    /// What they differ in.
    pub transfer: Transfer,
    /// The period of each record's drives, samples.
    pub periods: Vec<Option<usize>>,
    /// Records that have one drive, of each drive that several have.
    pub repeats: Vec<Vec<usize>>,
}

/// Parts by which the linear part is chosen.
pub(super) const PARTS: usize = 4;
/// Most groups: each costs a factorisation.
const MOST_GROUPS: usize = 8;
/// Relative RMS difference of two drives that count as one: a measured drive has noise of its own.
const SAME: f64 = 0.05;
/// Drives below this share of the loudest are at rest.
const REST: f64 = 0.03;
/// Two drives of one class differ by no more: logarithm of the level, means in standard deviations, and half of
/// the absolute difference of normalised spectra.
const LEVEL: f64 = 0.16;
const OFFSET: f64 = 0.5;
const SPECTRUM: f64 = 0.35;

/// The parts of a recording that can be held out. `given` are records of one drive, whatever differs between them.
pub fn group(recording: &Recording, given: &[Vec<usize>]) -> Grouping {
    let periods: Vec<Option<usize>> = recording.records.iter().map(|r| period(r.drive.channels())).collect();
    let identity = identities(recording, given);
    let drives = identity.iter().max().map_or(0, |last| last + 1);
    let cuts = match drives {
        0 | 1 => 5,
        2 => 3,
        3 | 4 => 2,
        _ => 1,
    };
    let mut pieces: Vec<Piece> = Vec::new();
    for (record, found) in periods.iter().enumerate() {
        let n = recording.records[record].drive.n_samples();
        for (cut, samples) in pieces_of(n, *found, cuts) {
            let unit = identity[record] * cuts + cut;
            pieces.push(Piece { record, samples, unit, look: Look::default() });
        }
    }
    for piece in &mut pieces {
        piece.look = look(recording, piece);
    }
    let loudest = pieces.iter().map(|p| p.look.loudness()).fold(0.0, f64::max);
    pieces.retain(|p| p.look.loudness() > REST * loudest);
    let classes = classes(&pieces);
    let n_classes = classes.iter().max().map_or(0, |last| last + 1);
    let transfer = match (n_classes, drives) {
        // However its parts differ, each comes again and again.
        (_, 1) if periods.iter().all(Option::is_some) => Transfer::OneDrive,
        (3.., _) => Transfer::Classes,
        (2, _) => Transfer::TwoClasses,
        (_, 3..) => Transfer::Runs,
        (_, 1) if periods.iter().any(Option::is_some) || recording.records.len() > 1 => Transfer::OneDrive,
        _ => Transfer::Stretches,
    };
    // A unit's rank among those of its class splits a class into halves of alternating units.
    let rank = |at: usize| -> usize {
        let mut before: Vec<usize> =
            (0..pieces.len()).filter(|&i| classes[i] == classes[at]).map(|i| pieces[i].unit).collect();
        before.sort_unstable();
        before.dedup();
        before.iter().position(|unit| *unit == pieces[at].unit).unwrap_or(0)
    };
    let raw: Vec<usize> = (0..pieces.len())
        .map(|i| match transfer {
            Transfer::Classes if n_classes > MOST_GROUPS => classes[i] * MOST_GROUPS / n_classes,
            Transfer::Classes => classes[i],
            Transfer::TwoClasses => 2 * classes[i] + rank(i) % 2,
            Transfer::Runs => (pieces[i].unit / cuts) % MOST_GROUPS,
            Transfer::Stretches | Transfer::OneDrive => pieces[i].unit % MOST_GROUPS,
        })
        .collect();
    let mut seen: Vec<usize> = raw.clone();
    seen.sort_unstable();
    seen.dedup();
    let number = |of: usize| seen.iter().position(|s| *s == of).unwrap_or(0);
    let stretches = pieces
        .iter()
        .zip(&raw)
        .enumerate()
        .map(|(i, (p, g))| Stretch {
            record: p.record,
            samples: p.samples.clone(),
            group: number(*g),
            part: (rank(i) + classes[i]) % PARTS,
            unit: p.unit,
        })
        .collect();
    let repeats = (0..drives)
        .map(|d| (0..identity.len()).filter(|&r| identity[r] == d).collect::<Vec<usize>>())
        .filter(|same| same.len() > 1)
        .collect();
    Grouping { stretches, groups: seen.len(), transfer, periods, repeats }
}

/// A stretch before it has a group.
struct Piece {
    record: usize,
    samples: Range<usize>,
    /// Drive and place in it: repeats of both have one.
    unit: usize,
    look: Look,
}

/// What a class is known by.
#[derive(Debug, Clone, Default)]
struct Look {
    level: Vec<f64>,
    mean: Vec<f64>,
    /// Normalised power in octaves of each drive.
    octaves: Vec<Vec<f64>>,
}

impl Look {
    /// Largest deviation of a drive about zero.
    fn loudness(&self) -> f64 {
        self.level.iter().copied().fold(0.0, f64::max)
    }

    fn like(&self, other: &Self) -> bool {
        let loudest = self.loudness().max(other.loudness());
        (0..self.level.len()).all(|d| {
            let (a, b) = (self.level[d], other.level[d]);
            if a.max(b) < REST * loudest {
                return true;
            }
            let spectrum: f64 =
                self.octaves[d].iter().zip(&other.octaves[d]).map(|(a, b)| 0.5 * (a - b).abs()).sum();
            (a.max(1e-300) / b.max(1e-300)).ln().abs() < LEVEL
                && (self.mean[d] - other.mean[d]).abs() < OFFSET * a.max(b)
                && spectrum < SPECTRUM
        })
    }
}

/// Cuts of a record: `(place, samples)`. Of a drive that repeats itself the first periods, in which the rig
/// settles, are left out, and equal phases have one place.
fn pieces_of(n: usize, period: Option<usize>, cuts: usize) -> Vec<(usize, Range<usize>)> {
    let even = |from: usize, len: usize| -> Vec<(usize, Range<usize>)> {
        (0..cuts).map(|c| (c, from + c * len / cuts..from + (c + 1) * len / cuts)).collect()
    };
    let Some(period) = period else { return even(0, n) };
    let settled = period * (n / 8).div_ceil(period).max(1);
    let least = (n / 3).min(2000);
    let block = period * least.div_ceil(period).max(1);
    let blocks = (n - settled) / block;
    if blocks == 0 {
        return even(0, n);
    }
    (0..blocks).flat_map(|b| even(settled + b * block, block)).collect()
}

/// Number of each record's drive; repeats share one.
fn identities(recording: &Recording, given: &[Vec<usize>]) -> Vec<usize> {
    let mut of: Vec<usize> = Vec::new();
    let mut firsts: Vec<usize> = Vec::new();
    for (r, record) in recording.records.iter().enumerate() {
        let told = |f: usize| given.iter().any(|same| same.contains(&f) && same.contains(&r));
        let same = firsts.iter().position(|&f| {
            if told(f) {
                return true;
            }
            let first = &recording.records[f].drive;
            let n = first.n_samples().min(record.drive.n_samples());
            let longest = first.n_samples().max(record.drive.n_samples());
            2 * n > longest
                && (0..recording.drives.len())
                    .all(|d| agree(&first.channel(d)[..n], &record.drive.channel(d)[..n]))
        });
        of.push(same.unwrap_or(firsts.len()));
        if same.is_none() {
            firsts.push(r);
        }
    }
    of
}

fn agree(a: &[f64], b: &[f64]) -> bool {
    let power = |x: &mut dyn Iterator<Item = f64>| x.map(|x| x * x).sum::<f64>();
    let difference = power(&mut a.iter().zip(b).map(|(a, b)| a - b));
    let size = power(&mut a.iter().copied()).max(power(&mut b.iter().copied()));
    difference <= SAME * SAME * size
}

fn look(recording: &Recording, piece: &Piece) -> Look {
    let mut look = Look::default();
    for d in 0..recording.drives.len() {
        let x = &recording.records[piece.record].drive.channel(d)[piece.samples.clone()];
        let n = x.len().max(1) as f64;
        let mean = x.iter().sum::<f64>() / n;
        look.level.push((x.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / n).sqrt());
        look.mean.push(mean);
        look.octaves.push(octaves(x, mean));
    }
    look
}

/// Shares of power by octave: of the differences of sums of 1, 2, 4 ... neighbours (Haar's wavelets).
fn octaves(x: &[f64], mean: f64) -> Vec<f64> {
    let mut sums: Vec<f64> = x.iter().map(|x| x - mean).collect();
    let mut power = Vec::new();
    for _ in 0..12 {
        let half: f64 = sums.chunks_exact(2).map(|p| 0.5 * (p[0] - p[1]).powi(2)).sum();
        sums = sums.chunks_exact(2).map(|p| (p[0] + p[1]) * 0.5_f64.sqrt()).collect();
        power.push(half);
    }
    power.push(sums.iter().map(|s| s * s).sum());
    let total: f64 = power.iter().sum::<f64>().max(f64::MIN_POSITIVE);
    power.iter().map(|p| p / total).collect()
}

/// Class of each piece, in the order of their level.
fn classes(pieces: &[Piece]) -> Vec<usize> {
    let mut firsts: Vec<usize> = Vec::new();
    let raw: Vec<usize> = (0..pieces.len())
        .map(|i| {
            let known = firsts.iter().position(|&f| pieces[f].look.like(&pieces[i].look));
            known.unwrap_or_else(|| {
                firsts.push(i);
                firsts.len() - 1
            })
        })
        .collect();
    let mut order: Vec<usize> = (0..firsts.len()).collect();
    order.sort_by(|&a, &b| {
        let loud = |f: usize| pieces[firsts[f]].look.loudness();
        loud(a).total_cmp(&loud(b))
    });
    raw.iter().map(|r| order.iter().position(|o| o == r).unwrap_or(0)).collect()
}
