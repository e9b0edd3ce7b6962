//! Which stretches are fitted to, chosen on and tested on.

use serde::Serialize;

use crate::diagnosis::core::samples_for;
use crate::diagnosis::input::{Input, Role};
use crate::diagnosis::numerics::linear::rms;

/// Drives of one repeat group are equal within this share of their RMS.
const SAME_DRIVE: f64 = 1e-3;
/// From this many different drives on, whole runs get roles; below, each run is cut in time.
const ENOUGH_GROUPS: usize = 8;

/// Most samples, of all pieces together, that are fitted to, of a rig of few drives; half as many are chosen on and tested on.
/// More would cost minutes and change no verdict.
const FITTED: usize = 120_000;

/// A stretch of a run.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Piece {
    /// Index into the request's runs.
    pub run: usize,
    /// First sample that is scored.
    pub from: usize,
    /// First sample that is not.
    pub to: usize,
    /// Which stretches have the same drives: repeats share it.
    pub group: usize,
    /// What it is used for.
    pub role: Role,
}

/// Quarters of a run that is cut in time.
pub const QUARTERS: usize = 4;
/// Their roles, unless the effect shows elsewhere.
const USUAL: [Role; QUARTERS] = [Role::Fit, Role::Fit, Role::Select, Role::Test];

/// Pieces of all runs and what was wrong with the repeats.
pub struct Split {
    pub pieces: Vec<Piece>,
    pub warnings: Vec<String>,
    /// Runs of equal drives, where each run is cut in time.
    pub cut: Option<Vec<Vec<usize>>>,
}

/// Cuts the runs. Repeats always share a role: a test drive is never seen in a fit.
pub fn split(input: &Input) -> Split {
    let mut warnings = Vec::new();
    let mut groups: Vec<Vec<usize>> = Vec::new();
    for group in &input.repeats {
        let mut kept: Vec<usize> = Vec::new();
        for &run in group {
            if kept.first().is_none_or(|&first| same_drive(input, first, run)) {
                kept.push(run);
            } else {
                warnings.push(format!("repeat_drive_differs: {}", input.runs[run].name));
                groups.push(vec![run]);
            }
        }
        groups.push(kept);
    }
    for run in 0..input.runs.len() {
        if !groups.iter().flatten().any(|&r| r == run) {
            groups.push(vec![run]);
        }
    }
    groups.sort_by_key(|g| g[0]);
    let mut pieces = Vec::new();
    if let Some(roles) = &input.roles {
        for (g, group) in groups.iter().enumerate() {
            for &run in group {
                pieces.push(whole(input, run, g, roles[run]));
            }
        }
        trim(input.drives.len(), &mut pieces);
        return Split { pieces, warnings, cut: None };
    }
    if groups.len() >= ENOUGH_GROUPS {
        // By level, so that each role sees weak and strong drives, the strongest fitted.
        let mut order: Vec<usize> = (0..groups.len()).collect();
        order.sort_by(|&a, &b| level(input, groups[b][0]).total_cmp(&level(input, groups[a][0])));
        let cycle = [Role::Fit, Role::Test, Role::Fit, Role::Select];
        for (place, &g) in order.iter().enumerate() {
            for &run in &groups[g] {
                pieces.push(whole(input, run, g, cycle[place % cycle.len()]));
            }
        }
        trim(input.drives.len(), &mut pieces);
        return Split { pieces, warnings, cut: None };
    }
    Split { pieces: in_quarters(input, &groups, USUAL), warnings, cut: Some(groups) }
}

/// Every run cut in quarters of these roles; neighbours of one role stay together.
pub fn in_quarters(input: &Input, groups: &[Vec<usize>], roles: [Role; QUARTERS]) -> Vec<Piece> {
    let mut pieces = Vec::new();
    for (g, group) in groups.iter().enumerate() {
        let n = group.iter().map(|&r| input.runs[r].drive.n_samples()).min().unwrap_or(0);
        let first = (0..QUARTERS).filter(|&q| q == 0 || roles[q] != roles[q - 1]);
        let firsts: Vec<usize> = first.chain([QUARTERS]).collect();
        for &run in group {
            for ends in firsts.windows(2) {
                let [from, to] = [ends[0], ends[1]].map(|q| q * n / QUARTERS);
                pieces.push(Piece { run, from, to, group: QUARTERS * g + ends[0], role: roles[ends[0]] });
            }
        }
    }
    trim(input.drives.len(), &mut pieces);
    pieces
}

/// One quarter of every run.
pub fn quarter(input: &Input, groups: &[Vec<usize>], which: usize) -> Vec<Piece> {
    let mut roles = [Role::Select; QUARTERS];
    roles[which] = Role::Fit;
    let mut pieces = in_quarters(input, groups, roles);
    pieces.retain(|p| p.role == Role::Fit);
    pieces
}

/// Cuts the end off pieces of a role that has too many samples; what is kept starts where it did, so
/// that repeats stay repeats.
fn trim(drives: usize, pieces: &mut [Piece]) {
    let fitted = samples_for(drives, FITTED);
    for (role, most) in [(Role::Fit, fitted), (Role::Select, fitted / 2), (Role::Test, fitted / 2)] {
        let mut of_role: Vec<&mut Piece> = pieces.iter_mut().filter(|p| p.role == role).collect();
        let total: usize = of_role.iter().map(|p| p.to - p.from).sum();
        if total > most {
            for piece in &mut of_role {
                piece.to =
                    piece.from + ((piece.to - piece.from) as f64 * most as f64 / total as f64) as usize;
            }
        }
    }
}

fn whole(input: &Input, run: usize, group: usize, role: Role) -> Piece {
    Piece { run, from: 0, to: input.runs[run].drive.n_samples(), group, role }
}

fn level(input: &Input, run: usize) -> f64 {
    input.runs[run].drive.channels().iter().map(|d| rms(d)).sum()
}

/// Whether two runs have one drive.
pub(super) fn same_drive(input: &Input, a: usize, b: usize) -> bool {
    let (a, b) = (&input.runs[a].drive, &input.runs[b].drive);
    a.n_samples() == b.n_samples()
        && a.channels().iter().zip(b.channels()).all(|(a, b)| {
            let difference: Vec<f64> = a.iter().zip(b).map(|(a, b)| a - b).collect();
            rms(&difference) <= SAME_DRIVE * rms(a)
        })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_many_drives_fewer_samples_are_looked_at() {
        let samples = |drives| {
            let piece = |k: usize, role| Piece { run: k, from: 1000, to: 1000 + FITTED, group: k, role };
            let mut pieces =
                [piece(0, Role::Fit), piece(1, Role::Fit), piece(2, Role::Select), piece(3, Role::Test)];
            trim(drives, &mut pieces);
            assert!(pieces.iter().all(|p| p.from == 1000));
            pieces.map(|p| p.to - p.from)
        };
        assert_eq!(samples(8), [60_000; 4]);
        assert_eq!(samples(32), [15_000; 4]);
    }
}
