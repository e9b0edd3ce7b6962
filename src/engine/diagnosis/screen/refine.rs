//! The numbers of laws between the grid's.

use rayon::prelude::*;

use super::judge::{Block, HeldOut};
use super::law::{Law, Way};
use super::place::{Argument, Place};
use super::report::Standing;
use super::run::Bench;

/// Factors by which the numbers of laws are moved between the grid's.
const FINER: [f64; 3] = [1.18, 1.09, 1.04];
/// A bend behind a filter that leaves more than this is not searched further: the best of many filters leaves a little
/// less than the linear part by chance.
const WORTH_A_SEARCH: f64 = 0.9;
/// Highest corner of a filter ahead of a bend, as a multiple of the band's: one beyond filters nothing, and the bend is
/// the drive's own.
const HIGHEST_FRONT: f64 = 2.0;
/// The same of filters ahead of a bend, and how often each is tried in turn.
const FINER_FILTERS: [f64; 2] = [1.4, 1.15];
const PASSES: usize = 4;

impl Bench<'_> {
    /// Moves the numbers of each family's foremost law that has one between the grid's; beside modes that were found beside
    /// bends those of each effect's.
    pub(super) fn refine(&self, arguments: &[Argument], standings: &mut [Standing]) {
        let mut foremost: Vec<usize> = Vec::new();
        for (at, standing) in standings.iter().enumerate() {
            let bend = standing.law.way() == Way::Behind;
            if bend && standing.ratio > WORTH_A_SEARCH {
                continue;
            }
            let seen = foremost.iter().any(|&before| standing.is_after(&standings[before]));
            if !standing.law.values().is_empty() && !seen {
                foremost.push(at);
            }
        }
        let better: Vec<(usize, Standing)> = foremost
            .into_par_iter()
            .filter_map(|at| self.refined(arguments, &standings[at]).map(|better| (at, better)))
            .collect();
        for (at, standing) in better {
            standings[at] = standing;
        }
        standings.sort_by(|a, b| a.ratio.total_cmp(&b.ratio));
    }

    /// The standing with its number moved, where that leaves less.
    fn refined(&self, arguments: &[Argument], standing: &Standing) -> Option<Standing> {
        let argument = &*self.argument(arguments, standing)?;
        let responses: Vec<usize> = match standing.place {
            Place::Output(response) => vec![response],
            _ => (0..self.entries.len()).collect(),
        };
        let companions = self.companions(argument.place, &[self.unbent(argument)], &responses);
        let found = |law: Law, beside: &[(usize, Block, HeldOut)]| {
            let law = law.over(argument);
            let signals = self.signals(law, argument, None);
            self.standing(law, argument, None, &signals, beside)
        };
        // A filter has many neighbours: they are compared at one response.
        let behind = standing.law.way() == Way::Behind;
        let (steps, passes): (&[f64], usize) = if behind { (&FINER_FILTERS, PASSES) } else { (&FINER, 1) };
        let one = companions.iter().position(|(r, ..)| behind && *r == standing.response);
        let beside = one.map_or(&companions[..], |at| &companions[at..=at]);
        let high = HIGHEST_FRONT * self.desk.band.high_hz / self.desk.recording.sample_rate_hz();
        let mut best = if behind { found(standing.law, beside) } else { standing.clone() };
        for step in steps {
            for _ in 0..passes {
                let nearby: Vec<Standing> =
                    best.law.nearby(*step, high).into_par_iter().map(|law| found(law, beside)).collect();
                match nearby.into_iter().min_by(|a, b| a.ratio.total_cmp(&b.ratio)) {
                    Some(better) if better.ratio < best.ratio => best = better,
                    _ => break,
                }
            }
        }
        let best = if behind { found(best.law, &companions) } else { best };
        (best.ratio < standing.ratio).then_some(best)
    }
}
