//! The likeliest laws once more, fitted together with the linear part.
//!
//! The free runs of the screen take their linear part from regressions, which a strong law has disturbed: right and
//! wrong laws then leave nearly the same. Here the displacement at a place, or a response as it was measured, is fitted
//! by each law of the families that may be right, with all poles and zeros free beside it. What the right law leaves
//! then is small, and others do not follow.

use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use super::alternatives::laws;
use crate::diagnosis::data::overview::Overview;
use crate::diagnosis::data::prepare::prepare_down_to;
use crate::diagnosis::effects::effect::{Effect, Family};
use crate::diagnosis::input::{self, Input, Mode, Run};
use crate::diagnosis::screen::{
    Grouping, Moved, Place, Record, Recording, Screening, Standing, Transfer, moved,
};
use crate::diagnosis::search::contest::contest;
use crate::progress::{Progress, Watch};
use crate::{EngineError, Quantity, Signal};

/// Share of the power that the linear part leaves down to which laws are told apart.
pub(in crate::diagnosis) const FLOOR: f64 = 0.002;
/// Samples of all records that are fitted, of each the beginning: more tell the laws apart no better.
const SAMPLES: usize = 60_000;
/// A family is fitted again where its free run leaves no more than so many times what the best leaves.
const BEHIND: f64 = 3.0;
/// Places of the structure at which families are fitted again, at most.
const PLACES: usize = 3;
/// A law whose free run runs away leaves less than this by regression, or is none.
const NOTHING: f64 = 0.9;
/// A gap below this matters to nothing here.
const MATERIAL: f64 = 1e-6;

/// What laws leave where they are fitted together with the linear part.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Refits(Vec<Refit>);

/// One law at one place.
#[derive(Debug, Clone, PartialEq)]
pub struct Refit {
    place: Place,
    effect: Effect,
    /// What it leaves of the linear part's error on stretches that it was not fitted to.
    left: f64,
}

/// One signal with the effects that are fitted to it.
struct Task {
    place: Place,
    effects: Vec<Effect>,
}

impl Refits {
    /// What the best law of a family leaves; over a drive less a response it is another law than elsewhere.
    pub fn left(&self, family: Family, place: Place) -> Option<f64> {
        let alike = |refit: &&Refit| refit.place.is_less_a_response() == place.is_less_a_response();
        least(self.0.iter().filter(|refit| refit.effect.family() == family).filter(alike))
    }

    /// The place at which a law of a family leaves least, where that is less than `share` of what the family leaves at
    /// `place`.
    pub fn elsewhere(&self, family: Family, place: Place, share: f64) -> Option<Place> {
        let of_family = || self.0.iter().filter(|refit| refit.effect.family() == family);
        let here = least(of_family().filter(|refit| refit.place == place))?;
        let best = of_family().min_by(|a, b| a.left.total_cmp(&b.left))?;
        (best.left < share * here).then_some(best.place)
    }

    /// What the best law of any other family leaves.
    pub fn left_by_others(&self, family: Family) -> Option<f64> {
        least(self.0.iter().filter(|refit| refit.effect.family() != family))
    }
}

fn least<'a>(of: impl Iterator<Item = &'a Refit>) -> Option<f64> {
    of.map(|refit| refit.left).min_by(f64::total_cmp)
}

/// Fits the families that may be right once more, at the places of the structure where they do best and at the
/// response that they help most. None are where one drive tells nothing, where known effects act already, or where a strong
/// law has moved the modes that a fit would begin with.
///
/// # Errors
/// [`EngineError::Cancelled`].
pub fn refits(
    recording: &Recording,
    grouping: &Grouping,
    screening: &Screening,
    catalogue: &[Effect],
    watch: Watch<'_>,
) -> Result<Refits, EngineError> {
    let known = recording.records.iter().any(|r| r.added.is_some());
    // A fit begins with the linear part of the signals as they are. Where a strong law has moved its modes, a fit may end
    // anywhere.
    if screening.transfer == Transfer::OneDrive || known || screening.apart {
        return Ok(Refits::default());
    }
    let tasks = tasks(recording, screening, catalogue);
    let recording = beginnings(recording);
    let places: Vec<Place> = tasks.iter().map(|task| task.place).collect();
    // The tasks run side by side: what one of them has done is no progress of all.
    let done = AtomicUsize::new(0);
    let of_one = |_: Progress<'_>| {
        watch(Progress::new("refit", done.load(Ordering::Relaxed) as f64 / tasks.len() as f64))
    };
    let of_tasks: Vec<Vec<Refit>> = tasks
        .par_iter()
        .zip(moved(&recording, &places))
        .map(|(task, moved)| {
            let Some(moved) = moved else { return Ok(Vec::new()) };
            let left = fitted(&recording, grouping, task, moved, &of_one)?;
            done.fetch_add(1, Ordering::Relaxed);
            Ok(left)
        })
        .collect::<Result<_, EngineError>>()?;
    Ok(Refits(of_tasks.concat()))
}

/// Where which effects are fitted.
fn tasks(recording: &Recording, screening: &Screening, catalogue: &[Effect]) -> Vec<Task> {
    // A law whose free run runs away at the screen's rate may run well at the rig's.
    let left = |standing: &Standing| standing.free.as_ref().map_or(standing.ratio, |free| free.ratio);
    let mut near: Vec<&Standing> =
        laws(screening).filter(|s| s.free.is_some() || s.ratio < NOTHING).collect();
    near.sort_by(|a, b| left(a).total_cmp(&left(b)));
    let least = near.iter().filter_map(|s| s.free.as_ref()).map(|free| free.ratio).fold(1.0, f64::min);
    near.retain(|standing| left(standing) < BEHIND * least);
    let may = |effect: &Effect| {
        let same = |family| family == effect.family();
        let of_structure = near.iter().filter(|s| s.place.is_fed_back()).map(|s| s.family);
        if effect.family().is_of_structure() {
            of_structure.into_iter().any(same)
        } else {
            near.iter().any(|s| same(s.family))
        }
    };
    let may: Vec<Effect> = catalogue.iter().copied().filter(may).collect();
    let mut tasks: Vec<Task> = Vec::new();
    let of_structure: Vec<Effect> =
        may.iter().copied().filter(|e| e.family().is_of_structure() || *e == Effect::ValveFlow).collect();
    let of_errors: Vec<Effect> = catalogue
        .iter()
        .copied()
        .filter(|e| of_an_error(*e).is_some_and(|e| near.iter().any(|s| s.family == e.family())))
        .collect();
    for standing in near.iter().filter(|s| s.place.is_fed_back()) {
        if tasks.len() < PLACES && tasks.iter().all(|task| task.place != standing.place) {
            let effects = if matches!(standing.place, Place::Error(..)) {
                of_errors.clone()
            } else {
                of_structure.clone()
            };
            tasks.push(Task { place: standing.place, effects });
        }
    }
    let of_channels: Vec<Effect> = may.into_iter().filter(|e| of_channel(*e)).collect();
    if let Some(standing) = near.first().filter(|_| !of_channels.is_empty()) {
        let r = standing.response;
        // What measures a displacement is one signal.
        let integrated = recording.responses[r].quantity.integrals() > 0;
        let place = if integrated { Place::Output(r) } else { Place::Response(r) };
        match tasks.iter_mut().find(|task| task.place == place) {
            Some(task) => task.effects.extend(of_channels),
            None => tasks.push(Task { place: Place::Output(r), effects: of_channels }),
        }
    }
    tasks.retain(|task| !task.effects.is_empty());
    tasks
}

/// What a force over an error of control is of the actuator; `None` of what depends on its rate.
fn of_an_error(force: Effect) -> Option<Effect> {
    match force {
        Effect::CubicStiffness | Effect::QuadraticStiffness => Some(Effect::DrivePolynomial),
        Effect::Clearance | Effect::BumpStop => Some(Effect::DeadZone),
        Effect::OneSidedStop | Effect::FreeStiffness => Some(Effect::FreeDriveMap),
        Effect::BoucWenHysteresis | Effect::FreeHysteresis => Some(Effect::Backlash),
        _ => None,
    }
}

/// Whether an effect is one of a drive, or of a response's sensor.
fn of_channel(effect: Effect) -> bool {
    effect != Effect::ValveFlow && effect.family().is_of_channel()
}

/// The beginnings of all records.
fn beginnings(recording: &Recording) -> Recording {
    let whole: usize = recording.records.iter().map(|r| r.drive.n_samples()).sum();
    let share = (SAMPLES as f64 / whole.max(1) as f64).min(1.0);
    let kept = |record: &Record| (record.drive.n_samples() as f64 * share).ceil() as usize;
    let records = recording.records.iter().map(|record| record.piece(0..kept(record)));
    let (drives, responses) = (recording.drives.clone(), recording.responses.clone());
    Recording { drives, responses, records: records.collect() }
}

/// How many integrals of what was measured the motion at a place is.
fn integrals(recording: &Recording, place: Place) -> usize {
    match place {
        Place::Response(r) | Place::Between(r, _) | Place::OnTable(_, r) => {
            recording.responses[r].quantity.integrals()
        }
        Place::Drive(_) | Place::Output(_) | Place::Error(..) => 0,
    }
}

/// What each law leaves at one place; nothing where they cannot be fitted there.
fn fitted(
    recording: &Recording,
    grouping: &Grouping,
    task: &Task,
    moved: Moved,
    watch: Watch<'_>,
) -> Result<Vec<Refit>, EngineError> {
    let Ok(input) = input(recording, grouping, task, moved) else { return Ok(Vec::new()) };
    let Ok(prepared) = prepare_down_to(FLOOR, integrals(recording, task.place), &input) else {
        return Ok(Vec::new());
    };
    let overview = Overview::new(&input, &prepared);
    if overview.seen.is_empty() {
        return Ok(Vec::new());
    }
    let outcome = contest(&input, &task.effects, &prepared, &overview, watch)?;
    let error = matches!(task.place, Place::Error(..));
    let named = |effect: Effect| of_an_error(effect).filter(|_| error).unwrap_or(effect);
    let laws = outcome.ranked.iter().map(|ranked| Refit {
        place: task.place,
        effect: named(ranked.scored.effect()),
        left: (ranked.scored.chi2 / outcome.chi2_none).sqrt(),
    });
    Ok(laws.filter(|refit| refit.left.is_finite()).collect())
}

/// One signal as the response to the drives that go with it.
fn input(
    recording: &Recording,
    grouping: &Grouping,
    task: &Task,
    moved: Moved,
) -> Result<Input, EngineError> {
    let rate = recording.sample_rate_hz();
    let channel = |name: &str, quantity| input::Channel {
        name: name.into(),
        axis: None,
        unit: String::new(),
        size: None,
        quantity,
    };
    let runs: Vec<Run> = recording
        .records
        .iter()
        .zip(moved.d.into_iter().zip(moved.drives))
        .enumerate()
        .map(|(i, (record, (d, drives)))| {
            Ok(Run {
                name: i.to_string(),
                drive: Signal::new(rate, drives)?,
                response: Signal::new(rate, vec![d])?,
                simulated: None,
                added: None,
                started_s: record.started_s,
            })
        })
        .collect::<Result<_, EngineError>>()?;
    Ok(Input {
        drives: recording.drives.iter().map(|c| channel(&c.name, c.quantity)).collect(),
        responses: vec![channel("d", Quantity::Displacement)],
        baseline: runs.clone(),
        runs,
        roles: None,
        repeats: grouping.repeats.clone(),
        sim_is_linear: true,
        mode: Mode::InSitu,
        catalogue: task.effects.clone(),
        material_gap: MATERIAL,
        drive_limit: None,
        seed: 0,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diagnosis::screen::{group, screen};
    use crate::diagnosis::tests::rig::{Force, noise_drive, request, run};
    use crate::diagnosis::transfer::recording::Runs;
    use crate::progress::unwatched;

    /// A spring that stiffens, written with a hyperbolic sine.
    fn stiffening(x: f64, _: f64) -> f64 {
        150.0 * ((1.2 * x).sinh() - 1.2 * x)
    }

    /// Runs of two levels on a rig with a force.
    fn runs(force: Force) -> Runs {
        let runs = vec![
            run("a", noise_drive(16.0, 1.0, 1), force, 0.003, 11),
            run("b", noise_drive(16.0, 0.6, 2), force, 0.003, 12),
            run("c", noise_drive(16.0, 1.0, 3), force, 0.003, 13),
            run("d", noise_drive(16.0, 0.6, 4), force, 0.003, 14),
        ];
        Runs::without_baseline(&Input { runs, repeats: Vec::new(), ..request(force, 0.003) })
    }

    fn of(recording: &Recording, watch: Watch<'_>) -> Result<Refits, EngineError> {
        let grouping = group(recording, &[]);
        let screening = screen(recording, &grouping, &unwatched)?;
        refits(recording, &grouping, &screening, &Effect::ALL, watch)
    }

    #[test]
    fn beside_a_free_linear_part_the_right_family_leaves_far_less_than_others() {
        let found = of(&runs(stiffening).recording, &unwatched).unwrap();
        let of_spring = found.left(Family::Stiffness, Place::Response(0)).expect("springs were fitted again");
        assert!(of_spring < 0.2, "{found:?}");
        let others = found.0.iter().filter(|refit| refit.effect.family() != Family::Stiffness);
        assert!(others.clone().count() > 0, "{found:?}");
        others.for_each(|refit| assert!(of_spring < 0.5 * refit.left, "{refit:?}: {found:?}"));
    }

    #[test]
    fn nothing_is_fitted_again_where_a_strong_law_has_moved_the_modes() {
        let recording = runs(stiffening).recording;
        let grouping = group(&recording, &[]);
        let mut screening = screen(&recording, &grouping, &unwatched).unwrap();
        screening.apart = true;
        let found = refits(&recording, &grouping, &screening, &Effect::ALL, &unwatched).unwrap();
        assert_eq!(found, Refits::default());
    }

    #[test]
    fn an_integrated_acceleration_tells_the_same() {
        let mut recording = runs(stiffening).recording;
        recording.responses[0].quantity = Quantity::Acceleration;
        for record in &mut recording.records {
            let d = record.response.channel(0);
            let rate = record.response.sample_rate_hz();
            let at = |k: usize| {
                d[k.clamp(1, d.len() - 2) + 1] + d[k.clamp(1, d.len() - 2) - 1]
                    - 2.0 * d[k.clamp(1, d.len() - 2)]
            };
            let a = (0..d.len()).map(|k| at(k) * rate * rate).collect();
            record.response = Signal::new(rate, vec![a]).unwrap();
        }
        let found = of(&recording, &unwatched).unwrap();
        let of_spring = found.left(Family::Stiffness, Place::Response(0)).expect("springs were fitted again");
        let others = found.0.iter().filter(|refit| refit.effect.family() != Family::Stiffness);
        others.for_each(|refit| assert!(of_spring < refit.left, "{refit:?}: {found:?}"));
    }

    #[test]
    fn a_map_of_an_error_of_control_is_fitted_over_the_error() {
        let runs: Vec<Run> = [(1.0, 1), (0.6, 2)]
            .into_iter()
            .map(|(level, seed)| {
                let mut run = run("a", noise_drive(40.0, level, seed), stiffening, 0.003, seed);
                // A valve that opens late, in a loop of position: `y' = 12 (e - clip(e))`, a sixteenth of a sample a step.
                let (rate, mut y) = (run.drive.sample_rate_hz(), 0.0);
                let mut moved = |u: &f64| {
                    for _ in 0..16 {
                        let error = u - y;
                        y += 12.0 / (16.0 * rate) * (error - error.clamp(-0.2, 0.2));
                    }
                    y
                };
                let position = run.drive.channel(0).iter().map(&mut moved).collect();
                run.response = Signal::new(rate, vec![position]).unwrap();
                run
            })
            .collect();
        let mut recording =
            Runs::without_baseline(&Input { runs, repeats: Vec::new(), ..request(stiffening, 0.003) })
                .recording;
        recording.drives[0].quantity = Quantity::Displacement;
        let found = of(&recording, &unwatched).unwrap();
        let at = |place| found.left(Family::DeadbandBacklash, place).unwrap_or(f64::INFINITY);
        assert!(at(Place::Error(0, 0)) < 0.3, "{found:?}");
        assert!(at(Place::Error(0, 0)) < 0.7 * at(Place::Drive(0)), "{found:?}");
    }

    #[test]
    fn beside_known_effects_nothing_is_fitted_again() {
        let mut recording = runs(stiffening).recording;
        for record in &mut recording.records {
            let still = vec![vec![0.0; record.response.n_samples()]];
            record.added = Some(Signal::new(record.response.sample_rate_hz(), still).unwrap());
        }
        assert_eq!(of(&recording, &unwatched).unwrap(), Refits::default());
    }

    #[test]
    fn it_can_be_cancelled() {
        let stop = |_: Progress<'_>| std::ops::ControlFlow::Break(());
        let found = of(&runs(stiffening).recording, &stop);
        assert!(matches!(found, Err(EngineError::Cancelled)), "{found:?}");
    }
}
