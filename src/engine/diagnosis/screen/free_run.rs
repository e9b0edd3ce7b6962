//! The foremost laws confirmed by free runs: fitted to what they do when they never see a measured response.
//!
//! The screen's regression takes a law's argument as it was measured, noise and all that other laws do included. Here
//! the argument is simulated. The coefficients are fitted to the signals of a free run, the next free run follows
//! from them, until nothing changes; then every group is simulated with coefficients fitted to the others.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

use super::entry::Entry;
use super::forward::{Course, Forward, Output, Run, Source};
use super::judge::{Base, Block, Coefficients};
use super::kernel::{Kernel, RunningSums};
use super::law::{Law, Scale, Way};
use super::linear_part::Setting;
use super::place::{Argument, Place, Seen};
use super::report::Standing;
use super::run::{Bench, geometric_mean};
use super::track::{Segment, Track, centre, delayed, less, mean};
use crate::diagnosis::numerics::linear::rms;

/// Rounds of simulation and fit.
const ROUNDS: usize = 8;
/// Relative gain of a round below which the next is not run.
const STILL: f64 = 1e-3;
/// A linear part that leaves more than this of a response is one that a law may have disturbed.
pub(super) const DISTORTED: f64 = 0.03;
/// How often its modes are found anew beside the law, and the relative gain that asks for another time.
const RELOCATIONS: usize = 3;
const GAINED: f64 = 0.05;
/// A law over a predicted motion that leaves more than so many times what its regression leaves does not run well.
const RUNS_WELL: f64 = 1.15;
/// Shares of the law that are tried where the whole runs away.
const SHARES: [f64; 4] = [1.0, 0.7, 0.4, 0.1];

/// What a law leaves when it is simulated forward.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FreeRun {
    /// Held-out error relative to that of the linear part: the geometric mean over groups at the response that it
    /// helps most.
    pub ratio: f64,
    /// The largest such ratio of a group.
    pub worst: f64,
    /// Held-out error relative to the response, `[response][group]`.
    pub errors: Vec<Vec<f64>>,
    /// Fitted to all groups.
    pub forward: Forward,
}

/// Columns that enter together, `[signals]` of them at one place.
#[derive(Clone)]
struct Part {
    place: Place,
    way: Way,
    signals: std::ops::Range<usize>,
    /// Whether it enters at all.
    open: bool,
}

/// The best round so far.
struct Round {
    error: f64,
    forward: Forward,
    signals: Vec<Track>,
    /// Those of the linear part beside the law; `None`: those of the linear part alone.
    entries: Option<Vec<Entry>>,
}

/// A law with its arguments, before anything is fitted.
#[derive(Clone)]
pub(super) struct Aim {
    bare: Forward,
    parts: Vec<Part>,
    /// Its signals over the measured arguments, then the unbent arguments.
    signals: Vec<Track>,
    /// Arguments that are fed back, and the place of each.
    extra: Vec<Track>,
    fed: Vec<Place>,
    /// What known effects add to the responses, then to these; empty without any.
    added: Vec<Track>,
}

/// One candidate on its linear part with the arguments among the outputs.
struct Fit<'a, 'd> {
    bench: &'a Bench<'d>,
    base: &'a Base<'d>,
    entries: &'a [Entry],
    aim: &'a Aim,
    /// Measured outputs.
    measured: Vec<&'a Track>,
    most: usize,
}

/// What a free run leaves; nothing leaves less than none.
pub(super) fn left(run: Option<&FreeRun>) -> f64 {
    run.map_or(f64::INFINITY, |run| run.ratio)
}

impl Aim {
    /// The same with a law that moves every mode by itself.
    fn by_modes(mut self) -> Self {
        self.parts[0].way = Way::Modal;
        self
    }

    /// The same over the motion that the linear part alone has.
    fn opened(&self) -> Self {
        let open = |(source, scale): (Source, Scale)| (source.opened(), scale);
        let bare = Forward {
            argument: open(self.bare.argument),
            second: self.bare.second.map(open),
            ..self.bare.clone()
        };
        Self { bare, ..self.clone() }
    }
}

impl Bench<'_> {
    /// The free run of a standing beside the screen's linear part, with what was simulated; `None` where it runs away
    /// or its place is none of these records.
    pub(super) fn free_run(&self, arguments: &[Argument], standing: &Standing) -> Option<(Aim, FreeRun)> {
        let aim = self.aim(arguments, standing)?;
        let feeds_back = aim.bare.feeds_back();
        let by_modes = aim.parts[0].way == Way::Modal && !standing.predicted;
        let mut starts = vec![aim];
        if feeds_back && self.base.setting().poles.is_some() && !by_modes {
            // From the motion as it was measured, what the law has made of it included, by a way of its own into every
            // mode.
            let measured = Standing { predicted: false, ..standing.clone() };
            starts.extend(self.aim(arguments, &measured).map(Aim::by_modes));
        }
        let mut best: Option<(Aim, FreeRun)> = None;
        for start in starts {
            if self.base.setting().apart && feeds_back {
                // Of all bends that the modes were found beside the law is one.
                let law = &start.signals[start.parts[0].signals.clone()];
                if let Some(own) = self.desk.setting_beside(law, self.base.setting()) {
                    best = self.better(best, start.clone(), Some(&own));
                }
            }
            best = self.better(best, start, None);
        }
        let badly = standing.predicted && left(best.as_ref().map(|b| &b.1)) > RUNS_WELL * standing.ratio;
        if feeds_back && (badly || best.is_none()) {
            // A law that runs away in its own motion may still do well in that of the linear part.
            let open = match &best {
                Some((aim, _)) => aim.opened(),
                None => self.aim(arguments, standing)?.opened(),
            };
            best = match self.better(best, open.clone(), None) {
                None => self.better(None, open.by_modes(), None),
                found => found,
            };
        }
        best
    }

    /// The free run of another start, on the screen's linear part or one that is set otherwise, where it leaves less.
    fn better(
        &self,
        best: Option<(Aim, FreeRun)>,
        start: Aim,
        setting: Option<&Setting>,
    ) -> Option<(Aim, FreeRun)> {
        let found = self.beside(&start, setting);
        if left(found.as_ref()) < left(best.as_ref().map(|b| &b.1)) {
            found.map(|run| (start, run))
        } else {
            best
        }
    }

    /// The free run of a law beside a linear part that was found anew beside it, where that leaves less.
    pub(super) fn free_run_beside_its_own(
        &self,
        arguments: &[Argument],
        standing: &Standing,
        aim: &Aim,
        run: FreeRun,
    ) -> FreeRun {
        if let Law::Block { front, .. } = standing.law {
            let bent = self.bent(arguments, standing, front);
            return bent.filter(|bent| bent.ratio < run.ratio).unwrap_or(run);
        }
        let mut best = run;
        if !aim.bare.is_over_a_motion() || rms(&self.linear[standing.response].errors) < DISTORTED {
            return best;
        }
        // The less of the law is in the responses, the truer the modes, and the more of the law is found beside them.
        let mut setting: Option<Setting> = None;
        for _ in 0..RELOCATIONS {
            let Some(undisturbed) = self.without_law(aim, setting.as_ref()) else { break };
            let next = match &setting {
                None => self.desk.setting_of(&undisturbed, self.base.setting()),
                Some(near) => self.desk.moved(&undisturbed, near),
            };
            let Some(next) = next else { break };
            let found = self.beside(aim, Some(&next));
            let Some(found) = found.filter(|found| found.ratio < best.ratio) else { break };
            let still = found.ratio > (1.0 - GAINED) * best.ratio;
            (best, setting) = (found, Some(next));
            if still {
                break;
            }
        }
        best
    }

    /// What is simulated: the law with its arguments.
    pub(super) fn aim(&self, arguments: &[Argument], standing: &Standing) -> Option<Aim> {
        let argument = &*self.argument(arguments, standing)?;
        let among = self.among(arguments, standing);
        let other = match standing.other {
            Some(place) => Some(among.iter().find(|a| a.place == place)?),
            None => None,
        };
        // A rate that is measured, or is one integral away, need not be had from a displacement.
        let of_rate = standing.law.is_over_rate()
            && argument.place.is_fed_back()
            && argument.quantity.integrals() > 0
            && self.desk.added.is_empty();
        let unbent_of = |a: &Argument| if of_rate { self.rate(a) } else { self.unbent(a) };
        let unbent: Vec<Track> = std::iter::once(argument).chain(other).map(unbent_of).collect();
        let places: Vec<Place> = std::iter::once(argument).chain(other).map(|a| a.place).collect();
        let fed: Vec<usize> = (0..places.len()).filter(|&i| places[i].is_fed_back()).collect();
        // Whatever the signals begin with, what is fed back is fitted to what was measured.
        let seen: Vec<&Argument> =
            fed.iter().map(|&i| arguments.iter().find(|a| a.place == places[i])).collect::<Option<_>>()?;
        let of_fed: Vec<Track> = seen.iter().filter_map(|a| self.desk.added_to(a)).collect();
        let extra: Vec<Track> = seen
            .iter()
            .enumerate()
            .map(|(i, a)| {
                let measured = unbent_of(a);
                match of_fed.get(i) {
                    Some(added) => less(&measured, added),
                    None => measured,
                }
            })
            .collect();
        let source = |i: usize| match (places[i], fed.iter().position(|&f| f == i)) {
            (_, Some(at)) if of_rate => Source::OutputRate(self.entries.len() + at),
            (_, Some(at)) => Source::Output(self.entries.len() + at),
            (Place::Drive(channel), _) => {
                let quantity =
                    if i == 0 { argument.quantity } else { other.map_or(argument.quantity, |o| o.quantity) };
                Source::Drive { channel, quantity }
            }
            (Place::Output(r) | Place::Response(r) | Place::Between(r, _), _)
            | (Place::Error(_, r) | Place::OnTable(_, r), _) => Source::Linear(r),
        };
        let law = standing.law;
        let count = law.count();
        let way = self.way(law, argument);
        // Beside modes that no law has moved the motion itself tells nothing more, but how a response goes on.
        let open = !(self.base.setting().apart && way == Way::Modal);
        let mut parts = vec![
            Part { place: argument.place, way, signals: 0..count, open: true },
            Part { place: argument.place, way: Way::Plain, signals: count..count + 1, open },
        ];
        if let Some(other) = other {
            parts.push(Part {
                place: other.place,
                way: Way::Plain,
                signals: count + 1..count + 2,
                open: true,
            });
        }
        let desk = self.desk;
        let bare = Forward {
            law,
            place: argument.place,
            other: other.map(|o| o.place),
            argument: (source(0), argument.scale),
            second: other.map(|o| (source(1), o.scale)),
            rate_hz: desk.recording.sample_rate_hz(),
            step: desk.band.step,
            limits: desk.limits,
            drive_mean: desk.drives.iter().map(mean).collect(),
            responses: self.entries.len(),
            outputs: Vec::new(),
            seen: if of_fed.is_empty() { Vec::new() } else { seen.iter().map(|a| Seen::of(a)).collect() },
        };
        Some(Aim {
            fed: fed.iter().map(|&i| places[i]).collect(),
            parts,
            signals: self.signals(law, argument, other).into_iter().chain(unbent).collect(),
            extra,
            added: desk.added.iter().cloned().chain(of_fed).collect(),
            bare,
        })
    }

    /// The free run of a law on the screen's linear part, or on one that is set otherwise.
    pub(super) fn beside(&self, aim: &Aim, setting: Option<&Setting>) -> Option<FreeRun> {
        self.with_fit(aim, setting, |fit| fit.found())?
    }

    /// The responses without what the law does to them by its measured arguments: what a linear part that the law
    /// does not disturb has to explain.
    fn without_law(&self, aim: &Aim, setting: Option<&Setting>) -> Option<Vec<Track>> {
        self.with_fit(aim, setting, |fit| {
            let blocks = fit.blocks(fit.entries, &aim.signals);
            let forward = fit.forward(fit.entries, &blocks, None, 1.0);
            let mut responses = self.desk.responses.clone();
            for record in 0..self.desk.recording.records.len() {
                let course = fit.course(record);
                let of_record: Vec<Vec<f64>> = aim.signals.iter().map(|s| s[record].clone()).collect();
                let made = forward.outputs_of(&course, &of_record);
                for ((response, made), output) in responses.iter_mut().zip(made).zip(&forward.outputs) {
                    let linear = forward.linear(&output.linear, &course);
                    let law = made.iter().zip(&linear).map(|(made, linear)| made - linear);
                    response[record].iter_mut().zip(law).for_each(|(y, law)| *y -= law);
                }
            }
            responses
        })
    }

    /// Does something with the law beside a linear part.
    fn with_fit<T>(
        &self,
        aim: &Aim,
        setting: Option<&Setting>,
        then: impl FnOnce(&Fit<'_, '_>) -> T,
    ) -> Option<T> {
        let desk = self.desk;
        let rebased;
        let (base, more): (&Base<'_>, Vec<Entry>) = if aim.extra.is_empty() && setting.is_none() {
            (self.base, Vec::new())
        } else {
            rebased = desk.rebased(setting.unwrap_or(self.base.setting()), &aim.extra)?;
            let outputs = self.entries.len() + aim.extra.len();
            (&rebased, Entry::all(&rebased, outputs, &desk.drives))
        };
        let entries: &[Entry] = if more.is_empty() { self.entries } else { &more };
        Some(then(&Fit {
            bench: self,
            base,
            entries,
            aim,
            measured: desk.responses.iter().chain(&aim.extra).collect(),
            most: desk.lengths().into_iter().max().unwrap_or(1),
        }))
    }
}

impl Fit<'_, '_> {
    /// Fits and simulates in turn, from the signals of the measured arguments on. A law that is strong has disturbed
    /// the linear part: with each round its signals enter through that which was fitted beside them.
    fn found(&self) -> Option<FreeRun> {
        let records: Vec<usize> = (0..self.bench.desk.recording.records.len()).collect();
        let mut best: Option<Round> = None;
        let mut signals = self.aim.signals.clone();
        let mut own: Option<Vec<Entry>> = None;
        // Beside modes of its own a law that is let in by what was measured needs no second round, and one by what was
        // simulated with a strong law strays.
        let rounds = if self.base.setting().apart { 1 } else { ROUNDS };
        for round in 1..=rounds {
            let entries = own.as_deref().unwrap_or(self.entries);
            let blocks = self.blocks(entries, &signals);
            let Some((forward, runs)) = self.run(entries, &blocks, &signals, None, &records) else { break };
            let error = self.error(&runs);
            let so_far = best.as_ref().map_or(f64::INFINITY, |b| b.error);
            let still = error > (1.0 - STILL) * so_far && error < (1.0 + STILL) * so_far;
            let following = (round < rounds && forward.is_over_a_motion() && !still).then(|| {
                let of_runs = |i: usize| runs.iter().map(|run| run.signals[i].clone()).collect();
                ((0..forward.signals()).map(of_runs).collect(), self.through(&forward))
            });
            if error < so_far {
                best = Some(Round { error, forward, signals, entries: own });
            }
            let Some((next, through)) = following else { break };
            (signals, own) = (next, Some(through));
        }
        let Round { forward, signals, entries, .. } = best?;
        let entries = entries.as_deref().unwrap_or(self.entries);
        let blocks = self.blocks(entries, &signals);
        let groups = self.base.n_groups();
        let errors: Vec<Vec<f64>> = {
            let of_groups: Vec<Vec<f64>> =
                (0..groups).map(|g| self.held_out(entries, &blocks, &signals, g)).collect::<Option<_>>()?;
            (0..forward.responses).map(|r| of_groups.iter().map(|errors| errors[r]).collect()).collect()
        };
        let ratios = |r: usize| -> Vec<f64> {
            let moving = (0..groups).filter(|&g| self.base.moves(r, g));
            moving.map(|g| errors[r][g] / self.bench.linear[r].errors[g].max(f64::MIN_POSITIVE)).collect()
        };
        let all: Vec<Vec<f64>> = (0..forward.responses).map(ratios).collect();
        let best = all.iter().min_by(|a, b| geometric_mean(a).total_cmp(&geometric_mean(b)))?;
        let (ratio, worst) = (geometric_mean(best), best.iter().copied().fold(0.0, f64::max));
        Some(FreeRun { ratio, worst, errors, forward })
    }

    /// The ways into every output through the linear part of a forward model.
    fn through(&self, forward: &Forward) -> Vec<Entry> {
        let lead = self.base.setting().lags.lead;
        let of = |output: &Output| {
            // Taps that were left out are zeros; the lead is kept.
            let impulse = |kernel: &Kernel| {
                let mut taps = kernel.taps.clone();
                taps.resize(taps.len().max(lead + 2), 0.0);
                taps
            };
            Entry::of(
                output.linear.iter().map(impulse).collect(),
                self.base.setting(),
                &self.bench.desk.drives,
            )
        };
        forward.outputs.iter().map(of).collect()
    }

    /// Columns of the signals at every output.
    fn blocks(&self, entries: &[Entry], signals: &[Track]) -> Vec<Block> {
        let made = |part: &Part, output: usize| {
            let own = self.own(part, output);
            let tracks = &signals[part.signals.clone()];
            let segments = &self.bench.desk.segments;
            let columns = entries[output].columns(part.place, own, part.way, tracks, segments);
            self.base.block(columns, output)
        };
        // What moves every mode by itself does so alike at all responses.
        let modal = &self.aim.parts[0];
        let alike = modal.way == Way::Modal && !self.base.setting().apart;
        let shared = alike.then(|| made(modal, 0));
        (0..self.measured.len())
            .map(|output| {
                let of = |part: &Part| match &shared {
                    Some(block) if part.way == Way::Modal && !self.own(part, output) => {
                        self.base.retargeted(block, output)
                    }
                    _ => made(part, output),
                };
                let first = of(&self.aim.parts[0]);
                let rest = self.aim.parts[1..].iter().filter(|part| part.open);
                rest.fold(first, |all, part| all.beside(&of(part), self.base.segments))
            })
            .collect()
    }

    /// Whether the place of a part is an output itself: what is fed back is, and a response may be.
    fn own(&self, part: &Part, output: usize) -> bool {
        let responses = self.aim.bare.responses;
        let fed = output >= responses && self.aim.fed[output - responses] == part.place;
        fed || (output < responses && self.bench.is_itself(part.place, part.way, output))
    }

    /// The forward model of coefficients fitted to all groups but one.
    fn forward(&self, entries: &[Entry], blocks: &[Block], held_out: Option<usize>, share: f64) -> Forward {
        let lead = self.base.setting().lags.lead as isize;
        let outputs = (0..blocks.len()).map(|output| {
            let Coefficients { impulses, columns } =
                self.base.coefficients(&blocks[output], output, held_out, self.most);
            let mut at = 0;
            let mut kernels = Vec::new();
            for part in &self.aim.parts {
                if !part.open {
                    kernels.extend(part.signals.clone().map(|_| Kernel::default()));
                    continue;
                }
                let own = self.own(part, output);
                let entry = &entries[output];
                let count = part.signals.len();
                let width = entry.width(part.place, part.way, count);
                let scaled: Vec<f64> = columns[at..at + width].iter().map(|c| share * c).collect();
                kernels.extend(entry.kernels(part.place, own, part.way, count, &scaled));
                at += width;
            }
            let held = |h: &Vec<f64>| Kernel::new(-lead, h);
            let before = (0..impulses.len()).map(|d| self.base.impulse(output, d, self.most));
            Output {
                offset: 0.0,
                offset_before: 0.0,
                linear: impulses.iter().map(held).collect(),
                before: before.map(|h| held(&h)).collect(),
                kernels,
            }
        });
        Forward { outputs: outputs.collect(), ..self.aim.bare.clone() }.trimmed()
    }

    fn course(&self, record: usize) -> Course<'_> {
        let desk = self.bench.desk;
        let drive = &desk.recording.records[record].drive;
        Course {
            whole: drive.channels().iter().map(|u| &u[..desk.used[record]]).collect(),
            thin: desk.drives.iter().map(|d| d[record].as_slice()).collect(),
            clock: desk.clocks[record],
            added: self.aim.added.iter().map(|added| Cow::Borrowed(added[record].as_slice())).collect(),
        }
    }

    /// The forward model of all groups or all but one with its free runs of some records; with less of the law
    /// where the whole runs away.
    fn run(
        &self,
        entries: &[Entry],
        blocks: &[Block],
        signals: &[Track],
        held_out: Option<usize>,
        records: &[usize],
    ) -> Option<(Forward, Vec<Run>)> {
        SHARES.iter().find_map(|share| {
            let mut forward = self.forward(entries, blocks, held_out, *share);
            self.level(&mut forward, signals, held_out);
            let runs: Option<Vec<Run>> = records.iter().map(|&r| forward.run(&self.course(r))).collect();
            runs.map(|runs| (forward, runs))
        })
    }

    /// Sets the outputs' offsets: what is measured less what drives and signals do, on average.
    fn level(&self, forward: &mut Forward, signals: &[Track], held_out: Option<usize>) {
        let segments = self.bench.desk.segments.iter().filter(|s| Some(s.group) != held_out);
        let segments: Vec<&Segment> = segments.collect();
        let mut records: Vec<usize> = segments.iter().map(|s| s.record).collect();
        records.sort_unstable();
        records.dedup();
        let mut sums = vec![[0.0; 3]; forward.outputs.len()];
        for record in records {
            let of_record: Vec<RunningSums> =
                signals.iter().map(|s| RunningSums::new(s[record].iter().copied())).collect();
            for segment in segments.iter().filter(|s| s.record == record) {
                let made = forward.sums_over(&self.bench.desk.sums[record], &of_record, &segment.rows);
                for ((measured, made), sums) in self.measured.iter().zip(made).zip(&mut sums) {
                    let measured: f64 = measured[record][segment.rows.clone()].iter().sum();
                    for (sum, made) in sums.iter_mut().zip(made) {
                        *sum += measured - made;
                    }
                    sums[2] += segment.rows.len() as f64;
                }
            }
        }
        for (output, [sum, before, count]) in forward.outputs.iter_mut().zip(sums) {
            output.offset = sum / f64::max(count, 1.0);
            output.offset_before = before / f64::max(count, 1.0);
        }
    }

    /// Sum over responses of the squares left, relative to the response, over all groups; each counts by its
    /// weight.
    fn error(&self, runs: &[Run]) -> f64 {
        let segments: Vec<&Segment> = self.bench.desk.segments.iter().collect();
        (0..self.measured.len()).map(|output| self.left(output, &segments, |r| Some(&runs[r]))).sum()
    }

    /// Squares left of an output in some segments, relative to its own.
    fn left<'r>(&self, output: usize, segments: &[&Segment], run: impl Fn(usize) -> Option<&'r Run>) -> f64 {
        let (mut left, mut all) = (0.0, 0.0);
        for segment in segments {
            let Some(run) = run(segment.record) else { continue };
            let squares = |signal: &[f64]| -> f64 {
                let rows = match &self.bench.desk.judged {
                    Some(filter) => {
                        let mut rows = filter.at(signal, segment.rows.clone());
                        centre(&mut rows, segment);
                        rows
                    }
                    None => delayed(signal, segment, 0),
                };
                rows.iter().map(|y| y * y).sum()
            };
            let (y, made) = (&self.measured[output][segment.record], &run.outputs[output]);
            left += squares(&y.iter().zip(made).map(|(y, made)| y - made).collect::<Vec<f64>>());
            all += squares(y);
        }
        if all > 0.0 { left / all } else { 0.0 }
    }

    /// Error of each response in a group that the coefficients were not fitted to.
    fn held_out(
        &self,
        entries: &[Entry],
        blocks: &[Block],
        signals: &[Track],
        group: usize,
    ) -> Option<Vec<f64>> {
        let segments: Vec<&Segment> = self.bench.desk.segments.iter().filter(|s| s.group == group).collect();
        let mut records: Vec<usize> = segments.iter().map(|s| s.record).collect();
        records.dedup();
        let (forward, runs) = self.run(entries, blocks, signals, Some(group), &records)?;
        let run = |record: usize| records.iter().position(|r| *r == record).map(|at| &runs[at]);
        Some((0..forward.responses).map(|r| self.left(r, &segments, run).sqrt()).collect())
    }
}
