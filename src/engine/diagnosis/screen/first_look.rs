//! A first look at all laws by a quarter of the rows: which of them are worth all rows.

use super::desk::Desk;
use super::foremost::NOTHING;
use super::law::Way;
use super::pieces::MOST_ROWS;
use super::place::{Argument, Place};
use super::report::Standing;
use super::run::{Bench, Ways};
use crate::EngineError;

/// Rows of a first look.
pub(super) const ROWS: usize = MOST_ROWS / 4;
/// It is worth it where all rows are more than so many times as many.
pub(super) const WORTH: usize = 3;
/// A linear part takes so many rows for each of its columns to be known.
const OF_A_COLUMN: usize = 15;
/// Laws that leave no more than so many times what the best of their family leaves, and than what the best of all leaves,
/// may be the foremost by all rows; so may the first of each family, and at each place the first and, beside bends behind
/// filters, the first that is none.
const OF_FAMILY: f64 = 1.25;
const OF_ALL: f64 = 1.5;
const FIRST: usize = 4;

/// A recording with few rows, and what moves there.
pub(super) struct FirstLook<'a> {
    pub desk: &'a Desk<'a>,
    pub arguments: &'a [Argument],
}

/// Which laws at each place are worth all rows.
pub(super) struct Chosen(Vec<AtPlace>);

struct AtPlace {
    place: Place,
    predicted: bool,
    /// In the order in which they are tried.
    laws: Vec<bool>,
}

impl Chosen {
    /// Whether the laws over an argument are, in the order in which they are tried; `None` where nothing is known.
    pub fn over(&self, argument: &Argument) -> Option<&[bool]> {
        let same = |at: &&AtPlace| at.place == argument.place && at.predicted == argument.predicted;
        self.0.iter().find(same).map(|at| at.laws.as_slice())
    }
}

impl FirstLook<'_> {
    /// Tries all laws beside a linear part that is set as that of `whole` is; `None` where it cannot be had of few rows.
    /// `step` is told the share that is done.
    pub fn chosen(
        &self,
        whole: &Bench<'_>,
        step: impl Fn(f64) -> Result<(), EngineError>,
    ) -> Result<Option<Chosen>, EngineError> {
        let setting = whole.base.setting();
        if self.desk.rows() < OF_A_COLUMN * setting.width() * self.desk.drives.len() {
            return Ok(None);
        }
        let Some(base) = self.desk.rebased(setting, &[]) else { return Ok(None) };
        let ways = Ways::new(self.desk, &base, self.arguments);
        let bench = ways.bench(self.desk, &base);
        let promising = bench.promising();
        let all = (self.arguments.len() + promising.len()) as f64;
        let mut found: Vec<(&Argument, Vec<Standing>)> = Vec::new();
        for at in 0..self.arguments.len() {
            step(found.len() as f64 / all)?;
            found.push((&self.arguments[at], bench.over(self.arguments, at, None)));
        }
        for at in promising {
            step(found.len() as f64 / all)?;
            found.push((&bench.predicted[at], bench.over(bench.predicted, at, None)));
        }
        Ok(Some(chosen(&found)))
    }
}

fn chosen(found: &[(&Argument, Vec<Standing>)]) -> Chosen {
    let mut ranked: Vec<&Standing> = found.iter().flat_map(|(_, standings)| standings).collect();
    ranked.sort_by(|a, b| a.ratio.total_cmp(&b.ratio));
    let best = ranked.first().map_or(1.0, |s| s.ratio);
    let worth = |standing: &Standing| {
        let of_family = ranked.iter().filter(|s| s.family == standing.family).map(|s| s.ratio);
        let first: Vec<f64> = of_family.take(FIRST).collect();
        let near = standing.ratio <= OF_FAMILY * first[0] || standing.ratio <= OF_ALL * best;
        first.contains(&standing.ratio) || (near && standing.ratio < NOTHING)
    };
    let of_place = |(argument, standings): &(&Argument, Vec<Standing>)| {
        let least = |of: &dyn Fn(&&Standing) -> bool| {
            standings.iter().filter(of).map(|s| s.ratio).fold(f64::INFINITY, f64::min)
        };
        let (first, unfiltered) = (least(&|_| true), least(&|s| s.law.way() == Way::Plain));
        AtPlace {
            place: argument.place,
            predicted: argument.predicted,
            laws: standings
                .iter()
                .map(|s| s.ratio <= first || (s.law.way() == Way::Plain && s.ratio <= unfiltered) || worth(s))
                .collect(),
        }
    };
    Chosen(found.iter().map(of_place).collect())
}
