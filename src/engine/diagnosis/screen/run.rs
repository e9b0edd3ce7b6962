//! The screen from records to standings.

use std::borrow::Cow;
use std::ops::Range;

use rayon::prelude::*;

use super::candidates;
use super::desk::Desk;
use super::entry::Entry;
use super::free_run::FreeRun;
use super::groups::Grouping;
use super::input::Recording;
use super::judge::{Base, Block, HeldOut};
use super::law::{Law, Way};
use super::modes::Poles;
use super::motion::{Limits, Motion, motion};
use super::naming;
use super::place::{Argument, Place, argument, arguments};
use super::report::{LinearPart, Screening, Standing};
use super::track::{Track, mean};
use crate::progress::{Watch, report, within};
use crate::{EngineError, Quantity};

/// Fewest samples in all: with fewer no linear part can be told from a law.
const FEWEST: usize = 300;
/// A family is run freely where it leaves no more than so many times what the best leaves, and less than this of
/// the linear part's error; at most so many are.
const BEHIND: f64 = 2.0;
const NOTHING: f64 = 0.97;
const CONFIRMED: usize = 6;
/// Places at which a family is run freely at most, and how much more than the best law may be left at others.
const PLACES: usize = 3;
const ELSEWHERE: f64 = 1.3;
/// Share of what a family leaves at its first place below which another place stands.
const CLEARLY: f64 = 0.85;
/// Stages, and the share of the first.
const STAGE: &str = "laws by transfer";
const FREE_STAGE: &str = "free runs";
const SCREENED: f64 = 0.6;
/// Predicted motions over which all laws are tried at most, and the laws by which they are chosen.
const MOST_PREDICTED: usize = 6;
const PROBES: [Law; 5] = [
    Law::Cubic,
    Law::Kink { at: 0.7 },
    Law::OneSided { at: 0.0 },
    Law::Slider { limit: 0.15 },
    Law::QuadraticDamping,
];
/// Factors by which the numbers of laws are moved between the grid's.
const FINER: [f64; 3] = [1.18, 1.09, 1.04];
/// A bend behind a filter that leaves more than this is not searched further: the best of many filters leaves a little
/// less than the linear part by chance.
const WORTH_A_SEARCH: f64 = 0.9;
/// Highest corner of a filter ahead of a bend, as a multiple of the band's: one beyond filters nothing, and the bend is
/// the drive's own.
const HIGHEST_FRONT: f64 = 2.0;
/// Share of what the best law of the drive as it is leaves, below which a filter ahead of the bend has gained something.
const FILTER_GAINS: f64 = 0.85;
/// The same of filters ahead of a bend, and how often each is tried in turn.
const FINER_FILTERS: [f64; 2] = [1.4, 1.15];
const PASSES: usize = 4;

/// Ranks the laws of the catalogue over all places by what they leave in groups that they were not fitted to.
///
/// # Errors
/// Signals that do not belong together, too few samples, drives that do not move, a grouping of other records or
/// of fewer than two groups, a linear part that is singular; [`EngineError::Cancelled`].
pub fn screen(
    recording: &Recording,
    grouping: &Grouping,
    watch: Watch<'_>,
) -> Result<Screening, EngineError> {
    recording.check(FEWEST)?;
    if let Some(other) = grouping.stretches.iter().find(|s| s.record >= recording.records.len()) {
        return Err(EngineError::Setting {
            setting: "runs",
            found: other.record.to_string(),
            limit: "a grouping of these runs".into(),
        });
    }
    let desk = Desk::new(recording, grouping);
    let groups = desk.segments.iter().map(|s| s.group + 1).max().unwrap_or(0);
    if groups < 2 {
        return Err(EngineError::TooShort { what: "groups of runs of the screen", needed: 2, found: groups });
    }
    let arguments = arguments(recording, desk.limits, &desk.used);
    let bases = desk.bases();
    let ways: Vec<Ways> = bases.iter().map(|base| Ways::new(&desk, base, &arguments)).collect();
    let benches = bases.iter().zip(&ways).map(|(base, ways)| Bench {
        desk: &desk,
        base,
        entries: &ways.entries,
        linear: &ways.linear,
        predicted: &ways.predicted,
    });
    // The linear part is the one beside which some law leaves least.
    let left = |s: &Screening| s.standings.iter().map(|s| s.error).fold(f64::INFINITY, f64::min);
    let mut best: Option<(Screening, Bench<'_>)> = None;
    for (at, bench) in benches.enumerate() {
        let progress =
            SCREENED * at as f64 / bases.len() as f64..SCREENED * (at + 1) as f64 / bases.len() as f64;
        let screening = bench.screening(grouping, &arguments, watch, &progress)?;
        if best.as_ref().is_none_or(|b| left(&screening) < left(&b.0)) {
            best = Some((screening, bench));
        }
    }
    let (mut screening, bench) = best.ok_or(EngineError::NonFiniteResult {
        what: "linear part of the screen",
        channel: 0,
        sample: 0,
    })?;
    bench.run_free(&arguments, &mut screening.standings, watch)?;
    Ok(screening)
}

/// How signals enter beside a linear part, what that leaves alone, and the motions that it predicts.
struct Ways {
    entries: Vec<Entry>,
    linear: Vec<HeldOut>,
    predicted: Vec<Argument>,
}

impl Ways {
    fn new(desk: &Desk<'_>, base: &Base<'_>, arguments: &[Argument]) -> Self {
        let responses = desk.responses.len();
        let entries = Entry::all(base, responses, &desk.drives);
        let predicted = predicted(desk, base, arguments);
        Self { entries, linear: (0..responses).map(|r| base.linear(r)).collect(), predicted }
    }
}

/// All that judges a candidate beside one linear part.
pub(super) struct Bench<'a> {
    pub desk: &'a Desk<'a>,
    pub base: &'a Base<'a>,
    pub entries: &'a [Entry],
    pub linear: &'a [HeldOut],
    /// Motions of the structure as the linear part predicts them.
    pub predicted: &'a [Argument],
}

/// What a law leaves at one response.
struct AtResponse {
    response: usize,
    ratios: Vec<f64>,
    errors: Vec<f64>,
    block: Block,
    width: usize,
}

impl Bench<'_> {
    /// All laws at all places beside this linear part.
    fn screening(
        &self,
        grouping: &Grouping,
        arguments: &[Argument],
        watch: Watch<'_>,
        progress: &Range<f64>,
    ) -> Result<Screening, EngineError> {
        let mut standings: Vec<Standing> = Vec::new();
        for at in 0..arguments.len() {
            report(watch, STAGE, within(at as f64 / arguments.len() as f64, progress))?;
            standings.extend(self.over(arguments, at));
        }
        for at in self.promising() {
            standings.extend(self.over(self.predicted, at));
        }
        for response in 0..self.entries.len() {
            standings.extend(self.over_output(response));
        }
        standings.sort_by(|a, b| a.ratio.total_cmp(&b.ratio));
        self.refine(arguments, &mut standings);
        leave_out_bends_of_the_drive(&mut standings);
        self.confirm(arguments, &mut standings);
        let setting = self.base.setting();
        let rate = self.desk.rate_hz();
        let longest = self.desk.lengths().into_iter().max().unwrap_or(1);
        Ok(Screening {
            transfer: grouping.transfer,
            groups: self.base.n_groups(),
            linear: LinearPart {
                sample_rate_hz: rate,
                modes: setting.poles.as_ref().map(Poles::states),
                memory_s: setting.memory(longest) as f64 / rate,
                lead_s: setting.lags.lead as f64 / rate,
                ridge: setting.ridge,
                errors: self.linear.iter().map(|l| l.errors.clone()).collect(),
            },
            standings,
        })
    }

    /// Runs the foremost of each family freely, as far as they may be the right one, and its rivals at other places; of
    /// a family one that leaves clearly less then comes first.
    fn run_free(
        &self,
        arguments: &[Argument],
        standings: &mut [Standing],
        watch: Watch<'_>,
    ) -> Result<(), EngineError> {
        let best = standings.first().map_or(1.0, |s| s.ratio);
        let of_families = contenders(standings);
        let near = |of: &&Vec<usize>| standings[of[0]].ratio < (BEHIND * best).min(NOTHING);
        let chosen: Vec<usize> = of_families.iter().filter(near).take(CONFIRMED).flatten().copied().collect();
        let found: Vec<(usize, Option<FreeRun>)> = chosen
            .into_par_iter()
            .map(|at| {
                report(watch, FREE_STAGE, SCREENED)?;
                Ok((at, self.free_run(arguments, &standings[at])))
            })
            .collect::<Result<_, EngineError>>()?;
        for (at, free) in found {
            standings[at].free = free;
        }
        let left = |at: usize| standings[at].free.as_ref().map_or(f64::INFINITY, |free| free.ratio);
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
        report(watch, FREE_STAGE, 1.0)
    }

    /// Standings of all laws over one argument, at all responses.
    fn over(&self, arguments: &[Argument], at: usize) -> Vec<Standing> {
        let argument = &arguments[at];
        let companions = self.companions_of(argument);
        self.laws(arguments, at)
            .into_par_iter()
            .map(|(law, other)| {
                let law = law.over(argument);
                let other = other.map(|o| &arguments[o]);
                let signals = self.signals(law, argument, other);
                let Some(other) = other else {
                    return self.standing(law, argument, None, &signals, &companions);
                };
                let both = self.beside_other(&companions, other);
                self.standing(law, argument, Some(other.place), &signals, &both)
            })
            .collect()
    }

    /// Predicted motions that are worth all laws: those over which one of a few leaves least.
    fn promising(&self) -> Vec<usize> {
        let all: Vec<usize> = (0..self.predicted.len()).collect();
        if all.len() <= MOST_PREDICTED {
            return all;
        }
        let least = |at: usize| {
            let argument = &self.predicted[at];
            let companions = self.companions_of(argument);
            let of = |law: &Law| {
                let signals = self.signals(*law, argument, None);
                self.standing(*law, argument, None, &signals, &companions).ratio
            };
            PROBES.iter().map(of).fold(1.0, f64::min)
        };
        let mut ranked: Vec<(f64, usize)> = all.into_par_iter().map(|at| (least(at), at)).collect();
        ranked.sort_by(|a, b| a.0.total_cmp(&b.0));
        ranked.into_iter().take(MOST_PREDICTED).map(|(_, at)| at).collect()
    }

    /// Laws over an argument, bends behind filters of the band among them.
    fn laws(&self, arguments: &[Argument], at: usize) -> Vec<(Law, Option<usize>)> {
        let mut laws = candidates::laws(arguments, at);
        if matches!(arguments[at].place, Place::Drive(_)) {
            let band = self.desk.band;
            let blocks = Law::blocks(band.low_hz, band.high_hz, self.desk.recording.sample_rate_hz());
            laws.extend(blocks.into_iter().map(|law| (law, None)));
        }
        laws
    }

    /// Standings of the laws of one response's sensor.
    fn over_output(&self, response: usize) -> Vec<Standing> {
        let Some(argument) = self.output(response) else { return Vec::new() };
        let place = argument.place;
        let companions = self.companions(place, &[self.unbent(&argument)], &[response]);
        candidates::laws(std::slice::from_ref(&argument), 0)
            .into_par_iter()
            .map(|(law, _)| {
                let signals = self.signals(law, &argument, None);
                self.standing(law, &argument, None, &signals, &companions)
            })
            .collect()
    }

    /// The argument at a place; of an output it is made here.
    pub(super) fn argument<'b>(
        &'b self,
        arguments: &'b [Argument],
        of: &Standing,
    ) -> Option<Cow<'b, Argument>> {
        match of.place {
            Place::Output(response) => self.output(response).map(Cow::Owned),
            place => self.among(arguments, of).iter().find(|a| a.place == place).map(Cow::Borrowed),
        }
    }

    /// The arguments among which that of a standing is.
    pub(super) fn among<'b>(&'b self, measured: &'b [Argument], of: &Standing) -> &'b [Argument] {
        if of.predicted { self.predicted } else { measured }
    }

    /// The linear part's prediction as an argument, at the rate of the analysis.
    pub(super) fn output(&self, response: usize) -> Option<Argument> {
        let moving = |d: &Vec<f64>| Motion {
            v: std::iter::once(0.0).chain(d.windows(2).map(|w| w[1] - w[0])).collect(),
            d: d.clone(),
        };
        let motion = self.entries[response].output.iter().map(moving).collect();
        let found = argument(Place::Output(response), Quantity::Other, motion)?;
        Some(Argument { predicted: true, ..found })
    }

    /// The signals of a law at the rate of the analysis.
    pub(super) fn signals(&self, law: Law, argument: &Argument, other: Option<&Argument>) -> Vec<Track> {
        let desk = self.desk;
        let rate = if argument.predicted { desk.rate_hz() } else { desk.recording.sample_rate_hz() };
        let mut signals: Vec<Track> = Vec::new();
        for (record, motion) in argument.motion.iter().enumerate() {
            let beside: Option<Vec<f64>> = other.map(|o| {
                let scale = o.scale;
                o.motion[record].d.iter().map(|d| (d - scale.centre) / scale.d).collect()
            });
            let clock = desk.clocks[record];
            let of_record = law.signals(motion, argument.scale, rate, clock, beside.as_deref());
            signals.resize_with(of_record.len(), Vec::new);
            for (signal, samples) in signals.iter_mut().zip(of_record) {
                signal.push(if argument.predicted { samples } else { desk.thinner.thin(&samples) });
            }
        }
        signals
    }

    /// Companions at all responses.
    fn companions_of(&self, argument: &Argument) -> Vec<(usize, Block, HeldOut)> {
        let responses: Vec<usize> = (0..self.entries.len()).collect();
        self.companions(argument.place, &[self.unbent(argument)], &responses)
    }

    /// The linear signal at a place, let in as a law's signal is, at each response, and its held-out errors.
    fn companions(
        &self,
        place: Place,
        unbent: &[Track],
        responses: &[usize],
    ) -> Vec<(usize, Block, HeldOut)> {
        responses
            .par_iter()
            .map(|&response| {
                let block = self.block(place, Way::Plain, unbent, response);
                let errors = self.base.judge(&block, response);
                (response, block, errors)
            })
            .collect()
    }

    /// Companions with the linear signal of another place beside them.
    fn beside_other(
        &self,
        companions: &[(usize, Block, HeldOut)],
        other: &Argument,
    ) -> Vec<(usize, Block, HeldOut)> {
        let unbent = [self.unbent(other)];
        companions
            .iter()
            .map(|(response, block, _)| {
                let further = self.block(other.place, Way::Plain, &unbent, *response);
                let both = block.beside(&further, self.base.segments);
                let errors = self.base.judge(&both, *response);
                (*response, both, errors)
            })
            .collect()
    }

    /// How the signals of a law over an argument reach a response.
    pub(super) fn way(&self, law: Law, argument: &Argument) -> Way {
        let modes = self.base.setting().poles.is_some();
        if modes && argument.predicted && argument.place.is_of_structure() { Way::Modal } else { law.way() }
    }

    pub(super) fn block(&self, place: Place, way: Way, signals: &[Track], response: usize) -> Block {
        // What is predicted holds nothing of the response that it enters.
        let own = place == Place::Response(response) && way != Way::Modal;
        let columns = self.entries[response].columns(place, own, way, signals, &self.desk.segments);
        self.base.block(columns, response)
    }

    fn standing(
        &self,
        law: Law,
        argument: &Argument,
        other: Option<Place>,
        signals: &[Track],
        companions: &[(usize, Block, HeldOut)],
    ) -> Standing {
        let way = self.way(law, argument);
        let shared = (way == Way::Modal).then(|| self.block(argument.place, way, signals, 0));
        let mut ratios = vec![1.0; self.entries.len()];
        let mut best: Option<AtResponse> = None;
        let (mut left, mut before, mut error) = (0.0, 0.0, 0.0);
        for (response, linear) in self.linear.iter().enumerate() {
            before += mean_square(&linear.errors);
            let Some((_, companion, unbent)) = companions.iter().find(|(r, ..)| *r == response) else {
                left += mean_square(&linear.errors);
                error += mean_square(&linear.errors);
                continue;
            };
            // What moves every mode by itself does so alike at all responses.
            let law = match &shared {
                Some(block) => self.base.retargeted(block, response),
                None => self.block(argument.place, way, signals, response),
            };
            let width = law.width();
            let block = law.beside(companion, self.base.segments);
            let found = self.base.judge(&block, response);
            let of_groups: Vec<f64> = (0..self.base.n_groups())
                .filter(|&g| self.base.moves(response, g))
                .map(|g| found.errors[g] / unbent.errors[g].min(linear.errors[g]))
                .collect();
            let ratio = geometric_mean(&of_groups);
            ratios[response] = ratio;
            error += mean_square(&found.errors).min(mean_square(&linear.errors));
            left += ratio * ratio * mean_square(&linear.errors);
            if best.as_ref().is_none_or(|b| ratio < geometric_mean(&b.ratios)) {
                best = Some(AtResponse { response, ratios: of_groups, errors: found.errors, block, width });
            }
        }
        let error = (error / self.entries.len().max(1) as f64).sqrt();
        let ratio = if before > 0.0 { f64::sqrt(left / before) } else { 1.0 };
        let (response, worst, errors, gain, second) = match &best {
            Some(b) => {
                let worst = b.ratios.iter().copied().fold(0.0, f64::max);
                let direct = matches!(argument.place, Place::Drive(_) | Place::Output(_));
                let gain = if let Some(block) = shared.as_ref().filter(|_| ratio < NOTHING) {
                    self.gain_of_modes(law, argument, signals, block)
                } else {
                    self.base.relative_gain(&b.block, b.width, direct, b.response)
                };
                let second = match law {
                    Law::Stribeck { .. } => self.base.second_by_first(&b.block, b.width, b.response),
                    _ => 0.0,
                };
                (b.response, worst, b.errors.clone(), gain, second)
            }
            None => (0, 1.0, Vec::new(), 0.0, 0.0),
        };
        let quantity = self.desk.recording.responses[response].quantity;
        let effect = naming::effect(law, argument.place, argument.quantity, quantity, gain, second);
        let (place, family) = (argument.place, effect.family());
        Standing {
            law,
            place,
            other,
            predicted: argument.predicted,
            effect,
            family,
            ratio,
            worst,
            error,
            response,
            ratios,
            errors,
            gain,
            gains: Vec::new(),
            free: None,
        }
    }

    /// From -1, where a law over a predicted motion resists it in every mode, to 1, where it gives way.
    fn gain_of_modes(&self, law: Law, argument: &Argument, signals: &[Track], block: &Block) -> f64 {
        let setting = self.base.setting();
        let Some(poles) = &setting.poles else { return 0.0 };
        let width = 1 + poles.states();
        // How far each signal goes with the motion or its rate.
        let slopes: Vec<f64> = signals
            .iter()
            .map(|signal| {
                let level = mean(signal);
                let with = |of: fn(&Motion) -> &[f64]| -> f64 {
                    let pairs = signal.iter().zip(&argument.motion).flat_map(|(s, m)| s.iter().zip(of(m)));
                    pairs.map(|(s, x)| (s - level) * x).sum()
                };
                if law.is_over_rate() {
                    with(|m| &m.v) / argument.scale.v
                } else {
                    with(|m| &m.d) / argument.scale.d
                }
            })
            .collect();
        let follows = |response: usize| -> f64 {
            let rates = match self.desk.recording.responses[response].quantity {
                Quantity::Velocity => 1,
                Quantity::Acceleration => 2,
                _ => 0,
            };
            let block = self.base.retargeted(block, response);
            let found = self.base.coefficients(&block, response, None, 1).columns;
            let mut of_all = vec![0.0; poles.states()];
            for (own, slope) in found.chunks_exact(width).zip(&slopes) {
                of_all.iter_mut().zip(&own[1..]).for_each(|(all, c)| *all += slope * c);
            }
            poles.follows(&of_all, rates)
        };
        match argument.place {
            Place::Between(a, b) => 0.5 * (follows(a) - follows(b)),
            Place::Response(r) => follows(r),
            _ => 0.0,
        }
    }

    /// Moves the numbers of each family's foremost law that has one between the grid's.
    fn refine(&self, arguments: &[Argument], standings: &mut [Standing]) {
        let mut seen = Vec::new();
        let mut foremost: Vec<usize> = Vec::new();
        for (at, standing) in standings.iter().enumerate() {
            let bend = standing.law.way() == Way::Behind;
            if bend && standing.ratio > WORTH_A_SEARCH {
                continue;
            }
            if !standing.law.values().is_empty() && !seen.contains(&standing.family) {
                seen.push(standing.family);
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

    /// The linear signal at a place at the rate of the analysis.
    pub(super) fn unbent(&self, argument: &Argument) -> Track {
        let d: Vec<Vec<f64>> = argument.motion.iter().map(|m| m.d.clone()).collect();
        if argument.predicted { d } else { self.desk.thinned(&d) }
    }

    /// Fits the foremost laws of each family to each group alone.
    fn confirm(&self, arguments: &[Argument], standings: &mut [Standing]) {
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
}

/// Motions of the structure as a linear part predicts them: without noise, and without what laws add to them.
fn predicted(desk: &Desk<'_>, base: &Base<'_>, measured: &[Argument]) -> Vec<Argument> {
    let responses: Vec<&Argument> =
        measured.iter().filter(|a| matches!(a.place, Place::Response(_))).collect();
    let tracks: Vec<Track> = responses
        .iter()
        .map(|a| desk.thinned(&a.motion.iter().map(|m| m.d.clone()).collect::<Vec<_>>()))
        .collect();
    if tracks.is_empty() {
        return Vec::new();
    }
    let Some(with_motions) = desk.rebased(base.setting(), &tracks) else { return Vec::new() };
    let first = desk.responses.len();
    let linear: Vec<Track> = (0..tracks.len())
        .into_par_iter()
        .map(|at| {
            let mut d = Entry::new(&with_motions, first + at, &desk.drives).output;
            let level = mean(&tracks[at]) - mean(&d);
            d.iter_mut().flatten().for_each(|d| *d += level);
            d
        })
        .collect();
    let rate = desk.rate_hz();
    let limits = Limits { low_hz: 0.0, high_hz: rate };
    let moving = |place: Place, quantity: Quantity, d: &Track| {
        let motion = d.iter().map(|d| motion(d, Quantity::Displacement, rate, limits)).collect();
        argument(place, quantity, motion).map(|found| Argument { predicted: true, ..found })
    };
    let at = |r: usize| responses.iter().position(|a| a.place == Place::Response(r));
    measured
        .iter()
        .filter_map(|a| match a.place {
            Place::Response(r) => moving(a.place, a.quantity, &linear[at(r)?]),
            Place::Between(i, j) => {
                let less = |(x, y): (&Vec<f64>, &Vec<f64>)| x.iter().zip(y).map(|(x, y)| x - y).collect();
                let d: Track = linear[at(i)?].iter().zip(&linear[at(j)?]).map(less).collect();
                moving(a.place, a.quantity, &d)
            }
            _ => None,
        })
        .collect()
}

/// Of each family the foremost standing, then those of other places of the structure that do nearly as well as the best
/// of all.
fn contenders(standings: &[Standing]) -> Vec<Vec<usize>> {
    let best = standings.first().map_or(1.0, |s| s.ratio);
    let mut of_families: Vec<Vec<usize>> = Vec::new();
    for (at, standing) in standings.iter().enumerate() {
        match of_families.iter_mut().find(|of| standings[of[0]].family == standing.family) {
            None => of_families.push(vec![at]),
            Some(of) => {
                let seen = of.iter().any(|&other| standings[other].place == standing.place);
                let near = standing.ratio < ELSEWHERE * best;
                if standing.place.is_of_structure() && near && !seen && of.len() < PLACES {
                    of.push(at);
                }
            }
        }
    }
    of_families
}

/// Leaves out bends behind filters where a law of the same drive as it is does nearly as well: the bend is the drive's
/// own.
fn leave_out_bends_of_the_drive(standings: &mut Vec<Standing>) {
    let unfiltered: Vec<(Place, f64)> = standings
        .iter()
        .filter(|s| matches!(s.place, Place::Drive(_)) && s.law.way() == Way::Plain)
        .map(|s| (s.place, s.ratio))
        .collect();
    let least = |place| unfiltered.iter().filter(|u| u.0 == place).map(|u| u.1).fold(1.0, f64::min);
    standings.retain(|s| s.law.way() != Way::Behind || s.ratio < FILTER_GAINS * least(s.place));
}

pub(super) fn mean_square(errors: &[f64]) -> f64 {
    errors.iter().map(|e| e * e).sum::<f64>() / errors.len().max(1) as f64
}

pub(super) fn geometric_mean(ratios: &[f64]) -> f64 {
    if ratios.is_empty() {
        return 1.0;
    }
    (ratios.iter().map(|r| r.ln()).sum::<f64>() / ratios.len() as f64).exp()
}
