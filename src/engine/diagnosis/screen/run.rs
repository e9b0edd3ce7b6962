//! The screen from records to standings.

use std::borrow::Cow;
use std::ops::Range;

use rayon::prelude::*;

use super::arguments;
use super::band::Band;
use super::candidates;
use super::desk::Desk;
use super::entry::Entry;
use super::first_look::{self, Chosen, FirstLook};
use super::foremost::{BEHIND, NOTHING};
use super::free_run::left;
use super::groups::Grouping;
use super::input::Recording;
use super::judge::{Base, Block, HeldOut};
use super::law::{Law, Way};
use super::linear_part::Setting;
use super::modes::Poles;
use super::motion::Motion;
use super::moved;
use super::naming;
use super::pieces::{MOST_ROWS, Pieces};
use super::place::{Argument, Place};
use super::predicted::predicted;
use super::report::{LinearPart, Screening, Standing};
use super::track::Track;
use crate::EngineError;
use crate::progress::{Progress, Watch, report, within};

/// Fewest samples in all: with fewer no linear part can be told from a law.
const FEWEST: usize = 300;
/// The stage, and its share.
const STAGE: &str = "laws by transfer";
pub(super) const SCREENED: f64 = 0.6;
/// Share of a first look in what follows it.
const LOOKED: f64 = 0.6;
/// Share of the laws beside modes that are found alone.
const ALONE: f64 = 0.7;
/// Rows beside bends, at the rate of strong laws.
const ROWS_BESIDE_BENDS: usize = first_look::WORTH * first_look::ROWS;
/// Free runs beside modes that were found beside bends leave no more than this share of what others leave, where they
/// count.
const CLEARLY: f64 = 0.7;
/// And no more than this share of what the linear part leaves.
const MOSTLY: f64 = 0.5;
/// Share of what the best law of the drive as it is leaves, below which a filter ahead of the bend has gained something.
const FILTER_GAINS: f64 = 0.85;

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
    let band = Band::of(recording);
    let pieces = Pieces::of(recording, grouping, band, MOST_ROWS);
    let desk = Desk::new(&pieces);
    let groups = desk.groups();
    if groups < 2 {
        return Err(EngineError::TooShort { what: "groups of runs of the screen", needed: 2, found: groups });
    }
    let over = arguments::arguments(desk.recording, desk.limits, &desk.used);
    let bases = desk.bases();
    let few = (desk.rows() > first_look::WORTH * first_look::ROWS).then(|| pieces.fewer(first_look::ROWS));
    let few = few.as_ref().map(Desk::new);
    let over_few = few.as_ref().map(|few| arguments::arguments(few.recording, few.limits, &few.used));
    let look = few.as_ref().zip(over_few.as_ref()).map(|(desk, arguments)| FirstLook { desk, arguments });
    let first = |p: Progress<'_>| watch(p.within(&(0.0..ALONE)));
    let screening = beside(&desk, &bases, None, (grouping, &over), look.as_ref(), &first)?;
    let setting = bases[0].setting();
    let beside_bends = beside_bends(&pieces, setting, grouping, &screening, watch)?;
    report(watch, STAGE, 1.0)?;
    Ok(match beside_bends {
        Some(anew) => merged(anew, screening),
        None => screening,
    })
}

/// The laws at the places where one may have moved the modes, once more beside modes that are found beside bends there;
/// `None` where there are none, or it explains no more.
fn beside_bends(
    pieces: &Pieces<'_>,
    setting: &Setting,
    grouping: &Grouping,
    screening: &Screening,
    watch: Watch<'_>,
) -> Result<Option<Screening>, EngineError> {
    let places = moved::places(screening);
    if places.is_empty() {
        return Ok(None);
    }
    report(watch, "modes beside bends", ALONE)?;
    let band = pieces.band.finer(pieces.recording.sample_rate_hz());
    let coarse = pieces.band.step;
    let pieces = pieces.at(band, ROWS_BESIDE_BENDS);
    let desk = Desk::judged_as(&pieces, coarse);
    // Of fewer rows no group may be left out.
    if desk.groups() != screening.groups {
        return Ok(None);
    }
    let mut over = arguments::arguments(desk.recording, desk.limits, &desk.used);
    over.retain(|argument| places.contains(&argument.place));
    if over.is_empty() {
        return Ok(None);
    }
    // The lead is a time.
    let lead = (setting.lags.lead * coarse).div_ceil(desk.band.step);
    let Some(apart) = desk.base_beside_bends(lead, &over) else { return Ok(None) };
    let second = |p: Progress<'_>| watch(p.within(&(ALONE..1.0)));
    // What laws leave counts against the linear part that predicts best.
    let linear: Vec<HeldOut> =
        screening.linear.errors.iter().map(|errors| HeldOut { errors: errors.clone() }).collect();
    let anew = beside(&desk, &[apart], Some(&linear), (grouping, &over), None, &second)?;
    let left = left_by_free_runs(&anew);
    let explains = left < MOSTLY * mean_error(&anew.linear.errors);
    Ok(Some(anew).filter(|_| explains && left < CLEARLY * left_by_free_runs(screening)))
}

/// Standings beside modes that were found beside bends, and those of other places beside the modes that were found alone.
fn merged(anew: Screening, alone: Screening) -> Screening {
    let again = |s: &Standing| anew.standings.iter().any(|a| a.place == s.place && a.other == s.other);
    let mut standings: Vec<Standing> = alone.standings.into_iter().filter(|s| !again(s)).collect();
    standings.extend(anew.standings);
    // By a way of its own into every mode a response predicts itself: what runs freely tells laws apart.
    let left = |s: &Standing| left(s.free.as_ref());
    standings.sort_by(|a, b| left(a).total_cmp(&left(b)).then(a.ratio.total_cmp(&b.ratio)));
    Screening { standings, apart: true, ..alone }
}

/// All laws beside the linear part beside which some law leaves least, and the free runs of the foremost. They count
/// against what their linear part leaves, or what another does.
fn beside(
    desk: &Desk<'_>,
    bases: &[Base<'_>],
    linear: Option<&[HeldOut]>,
    (grouping, over): (&Grouping, &[Argument]),
    look: Option<&FirstLook<'_>>,
    watch: Watch<'_>,
) -> Result<Screening, EngineError> {
    let ways: Vec<Ways> = bases.iter().map(|base| Ways::new(desk, base, over)).collect();
    let benches = bases.iter().zip(&ways).map(|(base, ways)| {
        let own = ways.bench(desk, base);
        Bench { linear: linear.unwrap_or(own.linear), ..own }
    });
    let least = |s: &Screening| s.standings.iter().map(|s| s.error).fold(f64::INFINITY, f64::min);
    let mut best: Option<(Screening, Bench<'_>)> = None;
    for (at, bench) in benches.enumerate() {
        let progress =
            SCREENED * at as f64 / bases.len() as f64..SCREENED * (at + 1) as f64 / bases.len() as f64;
        let screening = bench.screening(grouping, over, look, watch, &progress)?;
        if best.as_ref().is_none_or(|b| least(&screening) < least(&b.0)) {
            best = Some((screening, bench));
        }
    }
    let (mut screening, bench) = best.ok_or(EngineError::NonFiniteResult {
        what: "linear part of the screen",
        channel: 0,
        sample: 0,
    })?;
    bench.run_free(over, &mut screening.standings, watch)?;
    Ok(screening)
}

/// What the best free run leaves of all responses and groups, relative to them: a geometric mean.
pub(super) fn left_by_free_runs(screening: &Screening) -> f64 {
    let free = screening.standings.iter().filter_map(|s| s.free.as_ref());
    free.map(|run| mean_error(&run.errors)).fold(mean_error(&screening.linear.errors), f64::min)
}

/// Geometric mean over responses and groups, `[response][group]`.
pub(super) fn mean_error(errors: &[Vec<f64>]) -> f64 {
    let moving: Vec<f64> = errors.iter().flatten().copied().filter(|e| *e > 0.0).collect();
    geometric_mean(&moving)
}

/// How signals enter beside a linear part, what that leaves alone, and the motions that it predicts.
pub(super) struct Ways {
    entries: Vec<Entry>,
    linear: Vec<HeldOut>,
    predicted: Vec<Argument>,
}

impl Ways {
    pub fn new(desk: &Desk<'_>, base: &Base<'_>, arguments: &[Argument]) -> Self {
        let responses = desk.responses.len();
        let entries = Entry::all(base, responses, &desk.drives);
        // A linear part that leaves so much predicts no motion.
        let predicted = if base.setting().apart { Vec::new() } else { predicted(desk, base, arguments) };
        Self { entries, linear: (0..responses).map(|r| base.linear(r)).collect(), predicted }
    }

    pub fn bench<'a>(&'a self, desk: &'a Desk<'a>, base: &'a Base<'a>) -> Bench<'a> {
        Bench { desk, base, entries: &self.entries, linear: &self.linear, predicted: &self.predicted }
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
    /// All laws at all places beside this linear part, or those that a first look finds worth it.
    fn screening(
        &self,
        grouping: &Grouping,
        arguments: &[Argument],
        look: Option<&FirstLook<'_>>,
        watch: Watch<'_>,
        progress: &Range<f64>,
    ) -> Result<Screening, EngineError> {
        let looked = look.map_or(0.0, |_| LOOKED);
        let step = |share: f64| report(watch, STAGE, within(share, progress));
        let chosen = match look {
            Some(look) => look.chosen(self, |share| step(looked * share))?,
            None => None,
        };
        let mut standings: Vec<Standing> = Vec::new();
        for at in 0..arguments.len() {
            step(looked + (1.0 - looked) * at as f64 / arguments.len() as f64)?;
            standings.extend(self.over(arguments, at, chosen.as_ref()));
        }
        let promising = match &chosen {
            Some(chosen) => self.known(chosen),
            None => self.promising(),
        };
        for at in promising {
            standings.extend(self.over(self.predicted, at, chosen.as_ref()));
        }
        // Beside bends only laws that may have moved the modes are tried again.
        let outputs = if self.base.setting().apart { 0 } else { self.entries.len() };
        for response in 0..outputs {
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
            apart: setting.apart,
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

    /// Predicted motions that a first look has tried.
    fn known(&self, chosen: &Chosen) -> Vec<usize> {
        (0..self.predicted.len()).filter(|&at| chosen.over(&self.predicted[at]).is_some()).collect()
    }

    /// Standings of the laws over one argument at all responses, of those that are `chosen` if some are.
    pub(super) fn over(&self, arguments: &[Argument], at: usize, chosen: Option<&Chosen>) -> Vec<Standing> {
        let argument = &arguments[at];
        let companions = self.companions_of(argument);
        let mut laws = self.laws(arguments, at);
        // A law of two places has as many others as move there.
        if let Some(worth) = chosen.and_then(|c| c.over(argument)).filter(|worth| worth.len() == laws.len()) {
            let mut worth = worth.iter();
            laws.retain(|_| worth.next().copied().unwrap_or(true));
        }
        laws.into_par_iter()
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

    /// Laws over an argument, bends behind filters of the band among them.
    pub(super) fn laws(&self, arguments: &[Argument], at: usize) -> Vec<(Law, Option<usize>)> {
        let mut laws = candidates::laws(arguments, at);
        if matches!(arguments[at].place, Place::Drive(_)) {
            let band = self.desk.band;
            let blocks = Law::blocks(band.low_hz, band.high_hz, self.desk.recording.sample_rate_hz());
            laws.extend(blocks.into_iter().map(|law| (law, None)));
        }
        if self.base.setting().apart {
            laws.iter_mut().for_each(|(law, _)| *law = law.apart());
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
    pub(super) fn companions_of(&self, argument: &Argument) -> Vec<(usize, Block, HeldOut)> {
        let responses: Vec<usize> = (0..self.entries.len()).collect();
        self.companions(argument.place, &[self.unbent(argument)], &responses)
    }

    /// The linear signal at a place, let in as a law's signal is, at each response, and its held-out errors.
    pub(super) fn companions(
        &self,
        place: Place,
        unbent: &[Track],
        responses: &[usize],
    ) -> Vec<(usize, Block, HeldOut)> {
        responses
            .par_iter()
            .map(|&response| {
                let block = self.block(place, Way::Plain, unbent, response);
                let mut errors = self.base.judge(&block, response);
                if self.base.setting().apart && place.is_of_structure() {
                    // By a way of its own into every mode a response predicts itself, whatever the law.
                    let apart = self.base.judge(&self.block(place, Way::Modal, unbent, response), response);
                    errors.lower_to(&apart);
                }
                (response, block, errors)
            })
            .collect()
    }

    /// Companions with the linear signal of another place beside them.
    pub(super) fn beside_other(
        &self,
        companions: &[(usize, Block, HeldOut)],
        other: &Argument,
    ) -> Vec<(usize, Block, HeldOut)> {
        let unbent = [self.unbent(other)];
        companions
            .iter()
            .map(|(response, block, alone)| {
                let further = self.block(other.place, Way::Plain, &unbent, *response);
                let both = block.beside(&further, self.base.segments);
                let mut errors = self.base.judge(&both, *response);
                if self.base.setting().apart {
                    errors.lower_to(alone);
                }
                (*response, both, errors)
            })
            .collect()
    }

    /// How the signals of a law over an argument reach a response.
    pub(super) fn way(&self, law: Law, argument: &Argument) -> Way {
        let setting = self.base.setting();
        let by_modes = setting.poles.is_some() && (argument.predicted || setting.apart);
        if by_modes && argument.place.is_of_structure() { Way::Modal } else { law.way() }
    }

    /// Whether the signals at a place are of the response that they enter: what it does to itself takes a sample. What is
    /// predicted holds nothing of it, and of an acceleration the displacement is another signal: a force moves it at once.
    pub(super) fn is_itself(&self, place: Place, way: Way, response: usize) -> bool {
        let integrated = self.desk.recording.responses[response].quantity.integrals() > 0;
        let of_it = match place {
            Place::Response(r) | Place::Error(_, r) | Place::OnTable(_, r) => r == response,
            _ => false,
        };
        of_it && !integrated && (way != Way::Modal || self.base.setting().apart)
    }

    pub(super) fn block(&self, place: Place, way: Way, signals: &[Track], response: usize) -> Block {
        let own = self.is_itself(place, way, response);
        let columns = self.entries[response].columns(place, own, way, signals, &self.desk.segments);
        self.base.block(columns, response)
    }

    pub(super) fn standing(
        &self,
        law: Law,
        argument: &Argument,
        other: Option<Place>,
        signals: &[Track],
        companions: &[(usize, Block, HeldOut)],
    ) -> Standing {
        let way = self.way(law, argument);
        let alike = way == Way::Modal && !self.base.setting().apart;
        let shared = alike.then(|| self.block(argument.place, way, signals, 0));
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
                let worth = if self.base.setting().apart { BEHIND } else { NOTHING };
                let gain = if way == Way::Modal && ratio < worth {
                    self.gain_of_modes(law, argument, signals, shared.as_ref())
                } else {
                    self.base.relative_gain(&b.block, b.width, direct, b.response)
                };
                let second = match law {
                    Law::Stribeck { .. } | Law::Polynomial => {
                        self.base.second_by_first(&b.block, b.width, b.response)
                    }
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
            apart: self.base.setting().apart,
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

    /// The linear signal at a place at the rate of the analysis.
    pub(super) fn unbent(&self, argument: &Argument) -> Track {
        self.of_motion(argument, |m| &m.d)
    }

    /// Its rate at the rate of the analysis.
    pub(super) fn rate(&self, argument: &Argument) -> Track {
        self.of_motion(argument, |m| &m.v)
    }

    fn of_motion(&self, argument: &Argument, part: fn(&Motion) -> &[f64]) -> Track {
        let of: Vec<Vec<f64>> = argument.motion.iter().map(|m| part(m).to_vec()).collect();
        if argument.predicted { of } else { self.desk.thinned(&of) }
    }
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

fn mean_square(errors: &[f64]) -> f64 {
    errors.iter().map(|e| e * e).sum::<f64>() / errors.len().max(1) as f64
}

pub(super) fn geometric_mean(ratios: &[f64]) -> f64 {
    if ratios.is_empty() {
        return 1.0;
    }
    (ratios.iter().map(|r| r.ln()).sum::<f64>() / ratios.len() as f64).exp()
}
