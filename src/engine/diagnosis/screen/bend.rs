//! A bend between two filters (Wiener and Hammerstein).
//!
//! The screen tries fronts, the filters ahead of the bend, with signals that leave through what the linear part has
//! beyond them. That linear part was fitted to bent responses. Here the filter behind the bend has coefficients of its
//! own. Filter and shape are fitted in turn by linear least squares (Narendra and Gallman 1966), and between these
//! rounds the front's numbers take a step of Gauss and Newton beside free changes of both.

use rayon::prelude::*;

use super::arguments;
use super::desk::Desk;
use super::entry::Entry;
use super::free_run::FreeRun;
use super::front::Front;
use super::judge::Block;
use super::kernel::Kernel;
use super::law::{KINKS_OF_BEND, Law, Way};
use super::linear_part::Setting;
use super::moments::Lags;
use super::place::Argument;
use super::report::Standing;
use super::run::Bench;
use super::track::{Segment, Track, delayed};

/// Steps of the front's numbers, and rounds of filter and shape before each and after the last.
const STEPS: usize = 4;
const ROUNDS: usize = 3;
/// Change of a number's logarithm over which a slope is taken, and the smallest and largest step.
const NUDGE: f64 = 1e-4;
const SMALLEST_STEP: f64 = 1e-3;
const LARGEST_STEP: f64 = 0.15;
/// Ridge of a finite impulse response beside a bend, relative to the drives' power.
const RIDGE: f64 = 1e-7;
/// Rows times the square of its length at most.
const WORK: f64 = 8e8;
/// Steps of the power method.
const POWERS: usize = 30;

impl Bench<'_> {
    /// The free run of a bend behind a filter, beside the screen's linear part where that is no long impulse response, or
    /// beside a finite impulse response at the rate of the analysis or at the recording's own, whichever leaves least:
    /// modes that were placed on bent responses are not those of the filters, and a bend has harmonics above the band.
    pub(super) fn bent(&self, arguments: &[Argument], standing: &Standing, front: Front) -> Option<FreeRun> {
        // A linear part that is a long impulse response is no better a start than the one below, and takes minutes.
        let affordable = self.base.setting().width() <= affordable(self.desk);
        let own = affordable.then(|| self.bent_here(arguments, standing, front)).flatten();
        let lags = self.beside_lags(self.desk, |bench| bench.bent_here(arguments, standing, front));
        let unthinned = self.desk.unthinned().and_then(|desk| {
            let arguments = arguments::arguments(desk.recording, desk.limits, &desk.used);
            self.beside_lags(&desk, |bench| bench.bent_here(&arguments, standing, front))
        });
        [own, lags.flatten(), unthinned.flatten()]
            .into_iter()
            .flatten()
            .min_by(|a, b| a.ratio.total_cmp(&b.ratio))
    }

    /// Does something beside a finite impulse response; `None` where it is singular.
    fn beside_lags<T>(&self, desk: &Desk<'_>, then: impl FnOnce(&Bench<'_>) -> T) -> Option<T> {
        let lags = self.base.setting().lags;
        let span = lags.lead + desk.longest().min(affordable(desk));
        let setting =
            Setting { lags: Lags { span, ..lags }, poles: None, ridge: RIDGE, growth: 1.0, apart: false };
        let base = desk.rebased(&setting, &[])?;
        let entries = Entry::all(&base, self.entries.len(), &desk.drives);
        Some(then(&Bench { desk, base: &base, entries: &entries, linear: self.linear, predicted: &[] }))
    }

    /// The same beside this linear part.
    fn bent_here(&self, arguments: &[Argument], standing: &Standing, mut front: Front) -> Option<FreeRun> {
        let argument = &*self.argument(arguments, standing)?;
        let hinges = |front| self.signals(Law::Block { front, kinks: KINKS_OF_BEND }, argument, None);
        let mut signals = hinges(front);
        let first = self.block(standing.place, Way::Behind, &signals, standing.response);
        let mut bend = foremost(&self.columns_of(&first, standing.response))?;
        for step in 0..=STEPS {
            for _ in 0..ROUNDS {
                let through = self.behind(standing, argument, front, bend);
                bend = self.shape(standing, &through, &signals)?;
            }
            if step == STEPS {
                break;
            }
            let Some(next) = self.step(standing, argument, front, bend, &signals) else { break };
            front = next;
            signals = hinges(front);
        }
        let law = Law::Bent { front, bend };
        let aim = self.aim(arguments, &Standing { law, ..standing.clone() })?;
        self.beside(&aim, None)
    }

    /// The filter behind a bend.
    fn behind(
        &self,
        standing: &Standing,
        argument: &Argument,
        front: Front,
        bend: [f64; KINKS_OF_BEND],
    ) -> Kernel {
        let signals = self.signals(Law::Bent { front, bend }, argument, None);
        let block = self.block(standing.place, Way::Free, &signals, standing.response);
        let columns = self.columns_of(&block, standing.response);
        let entry = &self.entries[standing.response];
        entry.kernels(standing.place, false, Way::Free, 1, &columns).swap_remove(0)
    }

    /// The shape of a bend ahead of a filter; `None` where no part of it is left.
    fn shape(
        &self,
        standing: &Standing,
        through: &Kernel,
        signals: &[Track],
    ) -> Option<[f64; KINKS_OF_BEND]> {
        let block = self.base.block(self.filtered(through, signals), standing.response);
        normalised(&self.columns_of(&block, standing.response))
    }

    /// A front whose numbers are a step of Gauss and Newton further, beside free changes of filter and shape; `None`
    /// where the step is not finite or there is none to take.
    fn step(
        &self,
        standing: &Standing,
        argument: &Argument,
        front: Front,
        bend: [f64; KINKS_OF_BEND],
        signals: &[Track],
    ) -> Option<Front> {
        let through = self.behind(standing, argument, front, bend);
        let of = |front| self.signals(Law::Bent { front, bend }, argument, None).swap_remove(0);
        let here = of(front);
        let slopes: Vec<Track> = (0..Front::NUMBERS)
            .map(|number| {
                let mut change = [0.0; Front::NUMBERS];
                change[number] = NUDGE;
                let there = of(front.changed(change));
                let slope =
                    |(a, b): (&Vec<f64>, &Vec<f64>)| a.iter().zip(b).map(|(a, b)| (a - b) / NUDGE).collect();
                there.iter().zip(&here).map(slope).collect()
            })
            .collect();
        let mut columns = self.filtered(&through, &slopes);
        let shapes = self.filtered(&through, signals);
        let entry = &self.entries[standing.response];
        let lags = entry.columns(standing.place, false, Way::Free, &[here], &self.desk.segments);
        for (segment, more) in columns.iter_mut().zip(shapes.into_iter().zip(lags)) {
            segment.extend(more.0.into_iter().chain(more.1));
        }
        let block = self.base.block(columns, standing.response);
        let found = self.columns_of(&block, standing.response);
        let mut change = [0.0; Front::NUMBERS];
        change.iter_mut().zip(&found).for_each(|(c, found)| *c = found.clamp(-LARGEST_STEP, LARGEST_STEP));
        let moves = change.iter().any(|c| c.abs() > SMALLEST_STEP) && change.iter().all(|c| c.is_finite());
        moves.then(|| front.changed(change))
    }

    /// Columns of signals behind a filter, `[segment][signal][row]`.
    fn filtered(&self, through: &Kernel, signals: &[Track]) -> Vec<Vec<Vec<f64>>> {
        let filtered: Vec<Track> =
            signals.par_iter().map(|s| s.iter().map(|x| through.apply_held(x, 0.0)).collect()).collect();
        let of_segment =
            |segment: &Segment| filtered.iter().map(|f| delayed(&f[segment.record], segment, 0)).collect();
        self.desk.segments.iter().map(of_segment).collect()
    }

    /// Coefficients of a block's columns beside the linear part, fitted to all groups.
    fn columns_of(&self, block: &Block, response: usize) -> Vec<f64> {
        self.base.coefficients(block, response, None, 1).columns
    }
}

/// Coefficients of a filter behind a bend at most.
fn affordable(desk: &Desk<'_>) -> usize {
    (WORK / desk.rows().max(1) as f64).sqrt() as usize
}

/// What the signals have in common over all lags: the strongest direction of their coefficients, `[signal][lag]`.
fn foremost(coefficients: &[f64]) -> Option<[f64; KINKS_OF_BEND]> {
    let lags = coefficients.len() / KINKS_OF_BEND;
    let rows: Vec<&[f64]> = coefficients.chunks_exact(lags.max(1)).take(KINKS_OF_BEND).collect();
    let mut shape = vec![1.0; KINKS_OF_BEND];
    for _ in 0..POWERS {
        let over: Vec<f64> =
            (0..lags).map(|l| rows.iter().zip(&shape).map(|(row, s)| row[l] * s).sum()).collect();
        let next: Vec<f64> = rows.iter().map(|row| row.iter().zip(&over).map(|(a, b)| a * b).sum()).collect();
        shape = normalised(&next)?.to_vec();
    }
    normalised(&shape)
}

fn normalised(shape: &[f64]) -> Option<[f64; KINKS_OF_BEND]> {
    let most = shape.iter().fold(0.0_f64, |m, s| m.max(s.abs()));
    if !(most > 0.0 && most.is_finite()) {
        return None;
    }
    let mut out = [0.0; KINKS_OF_BEND];
    out.iter_mut().zip(shape).for_each(|(o, s)| *o = s / most);
    Some(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_shape_is_what_all_lags_have_in_common() {
        let shape: Vec<f64> = (0..KINKS_OF_BEND).map(|k| 1.0 - 0.1 * k as f64).collect();
        let lags = [0.2, -1.0, 0.6];
        let coefficients: Vec<f64> = shape.iter().flat_map(|s| lags.map(|l| l * s)).collect();
        let found = foremost(&coefficients).unwrap();
        let of = found[0] / shape[0];
        assert!(found.iter().zip(&shape).all(|(a, b)| (a - of * b).abs() < 1e-9), "{found:?}");
        assert!(foremost(&vec![0.0; 3 * KINKS_OF_BEND]).is_none());
    }
}
