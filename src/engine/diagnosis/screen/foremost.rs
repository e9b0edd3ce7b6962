//! The foremost laws of each family, with what confirms them: fits to each group alone, and free runs.

use rayon::prelude::*;

use super::free_run::{Aim, FreeRun, left};
use super::judge::HeldOut;
use super::law::Way;
use super::place::Argument;
use super::report::Standing;
use super::run::{Bench, SCREENED};
use crate::EngineError;
use crate::progress::{Watch, report};

/// A family is run freely where it leaves no more than so many times what the best leaves, and less than this of
/// the linear part's error; at most so many are. Beside modes that were found beside bends a regression tells too little to
/// leave out what leaves more than the linear part.
pub(super) const BEHIND: f64 = 2.0;
pub(super) const NOTHING: f64 = 0.97;
const CONFIRMED: usize = 6;
/// The same of effects, beside modes that were found beside bends.
const CONFIRMED_APART: usize = 12;
/// Places at which a family is run freely at most, and how much more than the best law may be left at others.
const PLACES: usize = 3;
const ELSEWHERE: f64 = 1.3;
/// Share of what a family leaves at its first place below which another place stands.
const CLEARLY: f64 = 0.85;
/// The stage, and the share of its first free runs.
const STAGE: &str = "free runs";
const ALONE: f64 = 0.8;
/// A law that leaves more than so many times what the best leaves gets no linear part of its own.
const FAR: f64 = 2.0;

impl Bench<'_> {
    /// Fits the foremost laws of each family to each group alone.
    pub(super) fn confirm(&self, arguments: &[Argument], standings: &mut [Standing]) {
        for at in contenders(standings).concat() {
            let standing = &mut standings[at];
            let Some(argument) = self.argument(arguments, standing) else { continue };
            let of_two = self.among(arguments, standing);
            let other = standing.other.and_then(|o| of_two.iter().find(|a| a.place == o));
            let signals = self.signals(standing.law, &argument, other);
            let law =
                self.block(argument.place, self.way(standing.law, &argument), &signals, standing.response);
            let companion =
                self.block(argument.place, Way::Plain, &[self.unbent(&argument)], standing.response);
            let companion = match other {
                Some(other) => {
                    let errors = HeldOut { errors: Vec::new() };
                    let alone = [(standing.response, companion, errors)];
                    self.beside_other(&alone, other).swap_remove(0).1
                }
                None => companion,
            };
            let block = law.beside(&companion, self.base.segments);
            standing.gains = self.base.gains(&block, law.width(), standing.response);
        }
    }

    /// Runs the foremost of each family freely, as far as they may be the right one, and its rivals at other places; of
    /// a family one that leaves clearly less then comes first.
    pub(super) fn run_free(
        &self,
        arguments: &[Argument],
        standings: &mut [Standing],
        watch: Watch<'_>,
    ) -> Result<(), EngineError> {
        let best = standings.first().map_or(1.0, |s| s.ratio);
        let of_families = contenders(standings);
        let apart = self.base.setting().apart;
        let (least, most) = if apart { (f64::INFINITY, CONFIRMED_APART) } else { (NOTHING, CONFIRMED) };
        let near = |of: &&Vec<usize>| standings[of[0]].ratio < (BEHIND * best).min(least);
        let chosen: Vec<usize> = of_families.iter().filter(near).take(most).flatten().copied().collect();
        let found: Vec<(usize, Option<(Aim, FreeRun)>)> = chosen
            .into_par_iter()
            .map(|at| {
                report(watch, STAGE, SCREENED)?;
                Ok((at, self.free_run(arguments, &standings[at])))
            })
            .collect::<Result<_, EngineError>>()?;
        let least = found.iter().map(|(_, f)| left(f.as_ref().map(|f| &f.1))).fold(f64::INFINITY, f64::min);
        let found: Vec<(usize, FreeRun)> = found
            .into_par_iter()
            .filter_map(|(at, found)| found.map(|(aim, run)| (at, aim, run)))
            .map(|(at, aim, run)| {
                report(watch, STAGE, ALONE)?;
                let standing = &standings[at];
                let near = run.ratio < FAR * least;
                Ok((
                    at,
                    if near { self.free_run_beside_its_own(arguments, standing, &aim, run) } else { run },
                ))
            })
            .collect::<Result<_, EngineError>>()?;
        for (at, free) in found {
            standings[at].free = Some(free);
        }
        let left = |at: usize| left(standings[at].free.as_ref());
        let ahead: Vec<(usize, usize)> = of_families
            .iter()
            .filter_map(|of| {
                let least = of.iter().copied().min_by(|&a, &b| left(a).total_cmp(&left(b)))?;
                let first = &standings[of[0]];
                // The right place needs no measured motion to do as well as the first does by it.
                let better = left(least) < CLEARLY * left(of[0]) && left(least) < first.ratio;
                better.then_some((of[0], least))
            })
            .collect();
        for (first, least) in ahead {
            standings.swap(first, least);
        }
        report(watch, STAGE, 1.0)
    }
}

/// Of each family the foremost standing (of each effect beside modes that were found beside bends), then those of other
/// places of the structure that do nearly as well as the best of all.
fn contenders(standings: &[Standing]) -> Vec<Vec<usize>> {
    let best = standings.first().map_or(1.0, |s| s.ratio);
    let mut of_families: Vec<Vec<usize>> = Vec::new();
    for (at, standing) in standings.iter().enumerate() {
        match of_families.iter_mut().find(|of| standing.is_after(&standings[of[0]])) {
            None => of_families.push(vec![at]),
            Some(of) => {
                let seen = of.iter().any(|&other| standings[other].place == standing.place);
                let near = standing.ratio < ELSEWHERE * best;
                if standing.place.is_fed_back() && near && !seen && of.len() < PLACES {
                    of.push(at);
                }
            }
        }
    }
    of_families
}
