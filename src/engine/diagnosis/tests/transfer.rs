//! Requests without repeats, as most users send them: the model's own runs, in situ.

use super::rig::{Force, friction, noise_drive, none, request, respond, run};
use crate::diagnosis::numerics::linear::rms;
use crate::diagnosis::{
    Augmented, Effect, Family, Input, Mode, NoiseSource, Report, Run, VerdictKind, diagnose,
};
use crate::progress::unwatched;
use crate::{EngineError, Signal};

/// A spring that stiffens by a few percent over most of its stroke, written with a hyperbolic sine. At the resonance
/// that is enough for the best linear part to leave more than half of the response.
fn stiffening(x: f64, _: f64) -> f64 {
    150.0 * ((1.2 * x).sinh() - 1.2 * x)
}

/// The same kind of spring at a quarter of its strength over half of its stroke.
fn stiffening_a_little(x: f64, v: f64) -> f64 {
    0.25 * stiffening(x, v)
}

/// Four drives at two levels, which the model was fitted to as well.
fn unrepeated(force: Force, noise: f64) -> Input {
    at_level(1.0, force, noise)
}

fn at_level(level: f64, force: Force, noise: f64) -> Input {
    let runs = vec![
        run("a", noise_drive(16.0, level, 1), force, noise, 11),
        run("b", noise_drive(16.0, 0.6 * level, 2), force, noise, 12),
        run("c", noise_drive(16.0, level, 3), force, noise, 13),
        run("d", noise_drive(16.0, 0.6 * level, 4), force, noise, 14),
    ];
    Input {
        baseline: runs.clone(),
        runs,
        repeats: Vec::new(),
        mode: Mode::InSitu,
        sim_is_linear: true,
        ..request(force, noise)
    }
}

fn report(input: &Input) -> Report {
    diagnose(input, &unwatched).unwrap().report
}

#[test]
fn a_hardening_spring_is_named_and_what_it_predicts_bounds_the_noise() {
    let found = diagnose(&at_level(0.5, stiffening_a_little, 0.003), &unwatched).unwrap();
    let (report, verdict) = (&found.report, &found.report.verdict);
    let of_spring = |e: &Effect| e.family() == Family::Stiffness;
    assert!(verdict.kind.blames() && of_spring(&verdict.equivalence_set[0]), "{verdict:?}");
    assert_eq!(verdict.at.as_deref(), Some("disp_x"));
    assert!(verdict.in_words.contains("at disp_x"), "{}", verdict.in_words);
    assert_eq!(report.noise_floor_source, NoiseSource::Bounded);
    assert!(report.gap.systematic_at_least > 0.01, "{:?}", report.gap);
    assert!(report.gap.systematic_at_least <= report.gap.systematic_at_most);
    let first = &report.hypotheses[0];
    assert!(first.held_out.closure > 0.3, "{:?}", first.held_out);
    assert!(first.transfer.len() > 1 && first.transfer.iter().any(|row| row.rms_after < row.rms_before));
    assert_eq!(first.strength.as_ref().map(|s| s.as_drive.as_str()), Some("drive_x"));
    let shape = first.shape.as_ref().expect("a spring is a curve");
    assert_eq!([shape.force.len(), shape.low.len(), shape.high.len()], [shape.x.len(); 3]);
    assert!(shape.force.iter().any(|f| *f != 0.0) && shape.x.windows(2).all(|x| x[0] < x[1]), "{shape:?}");
    assert!((0..shape.x.len()).all(|k| shape.low[k] <= shape.high[k]));
}

#[test]
fn a_law_is_not_held_against_what_a_model_leaves_of_runs_that_it_was_fitted_to() {
    // So short that a model fits much of what only these runs have.
    let runs: Vec<_> = (0..3)
        .map(|i| run(&format!("r{i}"), noise_drive(3.0, 0.5, 21 + i), stiffening_a_little, 0.05, 31 + i))
        .collect();
    let input = Input {
        baseline: runs.clone(),
        runs,
        repeats: Vec::new(),
        ..at_level(0.5, stiffening_a_little, 0.05)
    };
    let found = report(&input);
    let by_transfer = found.hypotheses.iter().find(|h| h.effect.family() != Family::Stiffness).unwrap();
    let of_linear = by_transfer.transfer.iter().map(|row| row.rms_before).fold(0.0, f64::max);
    assert!(by_transfer.held_out.rms_before > 0.9 * of_linear, "{by_transfer:?}");
    assert!(found.hypotheses[0].held_out.closure > 0.3, "{:?}", found.hypotheses[0].held_out);
}

#[test]
fn a_spring_that_moves_its_resonance_far_is_among_the_named() {
    let verdict = report(&unrepeated(stiffening, 0.003)).verdict;
    let of_spring = |e: &Effect| e.family() == Family::Stiffness;
    assert!(verdict.kind.blames() && verdict.equivalence_set.iter().any(of_spring), "{verdict:?}");
    assert_eq!(verdict.at.as_deref(), Some("disp_x"));
}

#[test]
fn a_law_found_by_transfer_survives_storage_and_refuses_what_does_not_fit_it() {
    let found = diagnose(&unrepeated(stiffening, 0.003), &unwatched).unwrap();
    // The first was fitted again with the whole linear part, and is none by transfer any more.
    let by_transfer = &found.augmented[1];
    let stored = serde_json::to_value(by_transfer).unwrap();
    let loaded: Augmented = serde_json::from_value(stored.clone()).unwrap();
    assert_eq!(loaded, *by_transfer);
    assert!(loaded.check(1, 1, super::rig::RATE).is_ok());
    assert!(matches!(loaded.check(2, 1, super::rig::RATE), Err(EngineError::Weights(_))));
    assert!(matches!(loaded.check(1, 1, 100.0), Err(EngineError::Weights(_))));
    let mut broken = stored;
    broken["added"]["forward"]["outputs"][0]["offset"] = serde_json::json!(1e300);
    let broken: Augmented = serde_json::from_value(broken).unwrap();
    assert!(matches!(broken.check(1, 1, super::rig::RATE), Err(EngineError::Weights(_))));
    let of = |samples: usize| Signal::new(super::rig::RATE, vec![vec![0.0; samples]]).unwrap();
    assert!(matches!(loaded.apply(&of(20), &of(10), None), Err(EngineError::UnequalLength { .. })));
}

#[test]
fn the_sim_with_the_named_law_predicts_a_run_that_nobody_saw() {
    let found = diagnose(&unrepeated(stiffening, 0.003), &unwatched).unwrap();
    let first = &found.report.hypotheses[0];
    assert_eq!(found.report.verdict.effect, Some(first.effect), "{:?}", found.report.verdict);
    assert!(first.held_out.closure > 0.95 && first.held_out.closure <= 1.0, "{:?}", first.held_out);
    assert!(first.strength.is_some() && !first.transfer.is_empty(), "what transfer tells stays");
    assert!(first.held_out.noise_rms == 0.0, "nothing tells the noise: {:?}", first.held_out);

    let drive = noise_drive(12.0, 0.8, 77);
    let truth = respond(&drive, stiffening);
    let linear = respond(&drive, none);
    let input = Signal::new(super::rig::RATE, vec![drive]).unwrap();
    let sim = Signal::new(super::rig::RATE, vec![linear]).unwrap();
    let made = found.augmented[0].apply(&input, &sim, None).unwrap();
    let error = |y: &[f64]| {
        let (left, all): (f64, f64) = truth[1000..]
            .iter()
            .zip(&y[1000..])
            .fold((0.0, 0.0), |(left, all), (t, y)| (left + (t - y).powi(2), all + t * t));
        (left / all).sqrt()
    };
    let (with, without) = (error(made.channel(0)), error(sim.channel(0)));
    assert!(with < 0.25 * without, "{with} {without}");
}

#[test]
fn drives_run_twice_name_the_effect_of_a_model_that_was_fitted_on_the_rig() {
    let mut input = super::rig::request(friction, 0.01);
    input.baseline = vec![run("low", noise_drive(25.0, 0.4, 3), friction, 0.01, 10)];
    (input.mode, input.sim_is_linear) = (Mode::InSitu, true);
    let found = report(&input);
    assert_eq!(found.verdict.family, Some(Family::FrictionHysteresis), "{:?}", found.verdict);
    assert_eq!(found.noise_floor_source, NoiseSource::Repeats);
}

#[test]
fn taps_go_apart_from_the_rest_of_a_law_and_come_back() {
    let found = diagnose(&unrepeated(stiffening, 0.003), &unwatched).unwrap();
    let whole = &found.augmented[1];
    let mut text = whole.clone();
    let mut taps = text.detach_taps();
    assert!(taps.len() > 50 && text.lacks_taps());
    let short = serde_json::to_string(&text).unwrap();
    assert!(
        short.len() < 8000 && short.len() * 2 < serde_json::to_string(whole).unwrap().len(),
        "{}",
        short.len()
    );
    let mut back: crate::diagnosis::Augmented = serde_json::from_str(&short).unwrap();
    back.attach_taps(&taps).unwrap();
    assert_eq!(&back, whole);
    for wrong in [1, -1] {
        if wrong > 0 {
            taps.push(0.0)
        } else {
            taps.truncate(taps.len() - 2)
        }
        let mut back: crate::diagnosis::Augmented = serde_json::from_str(&short).unwrap();
        assert!(matches!(back.attach_taps(&taps), Err(EngineError::Weights(_))));
    }
}

/// The same rig with so many sensors, of which one is where the spring stiffens; the others feel a linear one, as the sim does.
fn of_many_sensors(input: Input, count: usize, at: usize) -> Input {
    let more = |run: Run, seed: u64| {
        let drive = run.drive.channel(0).to_vec();
        let bare = respond(&drive, none);
        let sensor = |r: usize| match r == at {
            true => run.response.channel(0).to_vec(),
            false => {
                self::run("", drive.clone(), none, 0.003, 100 * seed + r as u64).response.channel(0).to_vec()
            }
        };
        let signal = |channels| Signal::new(super::rig::RATE, channels).unwrap();
        let response = signal((0..count).map(sensor).collect());
        Run { response, simulated: Some(signal(vec![bare; count])), ..run }
    };
    let channel = |r: usize| {
        let [own] = &input.responses[..] else { panic!("one sensor") };
        crate::diagnosis::Channel { name: format!("disp_{r}"), axis: None, ..own.clone() }
    };
    let responses = (0..count).map(channel).collect();
    let runs: Vec<Run> = (1..).zip(input.runs).map(|(seed, run)| more(run, seed)).collect();
    Input { baseline: runs.clone(), runs, responses, ..input }
}

#[test]
fn of_too_many_responses_without_repeats_the_foremost_are_screened_and_their_law_runs_on_all() {
    let input = of_many_sensors(at_level(0.5, stiffening_a_little, 0.003), 18, 5);
    let found = diagnose(&input, &unwatched).unwrap();
    let (verdict, warnings) = (&found.report.verdict, &found.report.warnings);
    // Nothing tells the noise, which all of them err by more than what is nothing.
    assert!(warnings.contains(&"responses_left_out: 10".to_owned()), "{warnings:?}");
    // The sensors beside it move as the linear part does: over which of them the law is told is open.
    assert!(verdict.kind.blames(), "{verdict:?}");
    assert_eq!(verdict.channel.as_deref(), Some("disp_5"));
    let law = &found.augmented[0];
    assert_eq!(law.response(), 5);
    law.check(1, 18, super::rig::RATE).unwrap();
    let run = &input.runs[0];
    let sim = run.simulated.as_ref().unwrap();
    let made = law.apply(&run.drive, sim, None).unwrap();
    let left = |of: &Signal| {
        let errors = of.channel(5).iter().zip(run.response.channel(5)).skip(1000).map(|(a, b)| a - b);
        rms(&errors.collect::<Vec<f64>>())
    };
    assert!(left(&made) < 0.5 * left(sim), "{} of {}", left(&made), left(sim));
    assert!((0..18).filter(|&r| made.channel(r) == sim.channel(r)).count() >= 10, "those left out");
}

/// A run whose actuator does nothing with a command of less than 0.6.
fn through_a_dead_zone(name: &str, command: Vec<f64>, seed: u64) -> Run {
    let moved = command.iter().map(|u| u - u.clamp(-0.6, 0.6)).collect();
    let driven = run(name, moved, none, 0.003, seed);
    Run { drive: Signal::new(super::rig::RATE, vec![command]).unwrap(), ..driven }
}

#[test]
fn a_dead_zone_that_a_fitted_model_has_taken_in_is_found_at_its_own_width() {
    let levels = [1.0, 0.6, 1.0, 0.6];
    let runs: Vec<Run> = (0..4)
        .map(|i| {
            let command = noise_drive(16.0, levels[i], 40 + i as u64);
            through_a_dead_zone(&i.to_string(), command, 50 + i as u64)
        })
        .collect();
    let input = Input { baseline: runs.clone(), runs, ..unrepeated(none, 0.003) };
    let found = diagnose(&input, &unwatched).unwrap();
    let (verdict, first) = (&found.report.verdict, &found.report.hypotheses[0]);
    assert_eq!(
        (verdict.kind, verdict.effect),
        (VerdictKind::Identified, Some(Effect::DeadZone)),
        "{verdict:?}"
    );
    assert!(first.held_out.closure > 0.98, "{:?}", first.held_out);
    let width = first.parameters.iter().find(|p| p.name == "half_width").expect("its width");
    assert!((width.value - 0.6).abs() < 0.02, "{width:?}");
    assert!(first.parameters.iter().all(|p| p.value.is_finite()));

    let stored = serde_json::to_value(&found.augmented[0]).unwrap();
    let loaded: Augmented = serde_json::from_value(stored.clone()).unwrap();
    assert!(loaded == found.augmented[0] && loaded.check(1, 1, super::rig::RATE).is_ok());
    let text = stored.to_string();
    let nested = text.replace(r#"{"Scaled":"DeadZone"}"#, r#"{"Scaled":{"Scaled":"DeadZone"}}"#);
    assert_ne!(text, nested);
    let nested: Augmented = serde_json::from_str(&nested).unwrap();
    assert!(matches!(nested.check(1, 1, super::rig::RATE), Err(EngineError::Weights(_))));
}

/// Four runs an hour apart at some levels, of a rig that becomes stiffer from each to the next.
fn stiffer_each_time(levels: [f64; 4]) -> Input {
    let springs: [Force; 4] = [none, |x, _| 60.0 * x, |x, _| 120.0 * x, |x, _| 180.0 * x];
    let runs: Vec<Run> = (0..4)
        .map(|i| {
            let drive = noise_drive(16.0, levels[i], 60 + i as u64);
            let done = run(&i.to_string(), drive, springs[i], 0.003, 70 + i as u64);
            Run { started_s: 3600.0 * i as f64, ..done }
        })
        .collect();
    Input { baseline: runs.clone(), runs, ..unrepeated(none, 0.003) }
}

#[test]
fn what_changes_with_time_is_told_alone_only_where_the_level_does_not_follow_the_clock() {
    let told = report(&stiffer_each_time([0.5, 0.9, 0.4, 0.8])).verdict;
    assert_eq!(told.effect, Some(Effect::StiffnessDrift), "{told:?}");
    let found = report(&stiffer_each_time([0.4, 0.5, 0.8, 0.9]));
    let one = &found.verdict;
    assert_eq!(one.kind, VerdictKind::NotDistinguishable, "{one:?}");
    assert!(one.equivalence_set.contains(&Effect::StiffnessDrift), "{one:?}");
    assert!(one.because.iter().any(|b| b.contains("follows the clock")), "{one:?}");
    assert_eq!(found.next_experiment.expect("a run").drive.kind, "same_drive_again");
}

#[test]
fn friction_is_a_family_of_its_own() {
    let verdict = report(&unrepeated(friction, 0.003)).verdict;
    let of_friction = |e: &Effect| e.family() == Family::FrictionHysteresis;
    assert!(verdict.kind.blames() && verdict.equivalence_set.iter().any(of_friction), "{verdict:?}");
}

#[test]
fn a_linear_rig_is_blamed_for_nothing_and_reassured_only_where_all_that_is_left_is_small() {
    let quiet = report(&unrepeated(none, 0.001)).verdict;
    assert_eq!(quiet.kind, VerdictKind::NoMaterialGap, "{quiet:?}");
    let loud = report(&unrepeated(none, 0.05));
    assert_eq!(loud.verdict.kind, VerdictKind::Undecided, "{:?}", loud.verdict);
    let next = loud.next_experiment.expect("a run that would settle it").drive;
    assert_eq!(next.kind, "same_drive_again");
}

#[test]
fn a_gap_whose_drives_are_all_one_is_undecided() {
    let mut input = unrepeated(stiffening, 0.003);
    let drive = noise_drive(4.0, 1.0, 1).repeat(6);
    input.runs = vec![run("a", drive, stiffening, 0.01, 21)];
    input.baseline = input.runs.clone();
    let found = report(&input);
    assert_eq!(found.verdict.kind, VerdictKind::Undecided, "{:?}", found.verdict);
    assert_eq!(found.noise_floor_source, NoiseSource::FoundRepeats);
    assert!(found.gap.systematic_at_least > 10.0 * found.gap.noise_rms_rel, "{:?}", found.gap);
    assert!(found.warnings.contains(&"one_drive".to_owned()));
    let next = found.next_experiment.expect("another realisation").drive;
    assert_eq!((next.kind.as_str(), next.level_rel), ("noise", 1.0));
}

#[test]
fn a_model_that_errs_on_a_linear_rig_is_no_effect() {
    let mut input = unrepeated(none, 0.001);
    input.sim_is_linear = false;
    for run in &mut input.runs {
        let wrong = run.response.channel(0).iter().map(|y| 0.8 * y).collect();
        run.simulated = Some(Signal::new(super::rig::RATE, vec![wrong]).unwrap());
    }
    let verdict = report(&input).verdict;
    assert_eq!(verdict.kind, VerdictKind::NoneOfCatalogue, "{verdict:?}");
    assert!(verdict.because.iter().any(|b| b.contains("the model errs")), "{verdict:?}");
}

#[test]
fn an_offset_that_drifts_is_seen_in_the_means() {
    let mut input = unrepeated(none, 0.001);
    let level = rms(input.runs[0].response.channel(0));
    let all = input.runs.iter().map(|run| run.drive.duration_s()).sum::<f64>();
    let mut started_s = 0.0;
    for run in &mut input.runs {
        run.started_s = started_s;
        let at = |t: usize| (started_s + t as f64 / super::rig::RATE) / all;
        let y = run.response.channel(0).iter().enumerate();
        let drifted = y.map(|(t, y)| y + 0.5 * level * at(t)).collect();
        run.response = Signal::new(super::rig::RATE, vec![drifted]).unwrap();
        started_s += run.drive.duration_s();
    }
    let found = report(&input);
    let verdict = &found.verdict;
    assert!(verdict.kind.blames() && verdict.effect == Some(Effect::OffsetDrift), "{verdict:?}");
    assert!(found.hypotheses[0].held_out.closure > 0.8, "{:?}", found.hypotheses[0].held_out);
    // Where it may not be named nothing else is.
    input.catalogue.retain(|effect| *effect != Effect::OffsetDrift);
    assert!(!report(&input).verdict.kind.blames());
}

#[test]
fn a_baseline_of_before_a_change_is_left_out_of_what_laws_have_to_explain() {
    let mut input = at_level(0.5, stiffening_a_little, 0.003);
    input.baseline = vec![
        run("before", noise_drive(16.0, 0.5, 5), friction, 0.003, 15),
        run("before too", noise_drive(16.0, 0.3, 6), friction, 0.003, 16),
    ];
    let found = report(&input);
    let of_spring = |e: &Effect| e.family() == Family::Stiffness;
    assert!(of_spring(&found.verdict.equivalence_set[0]), "{:?}", found.verdict);
    assert!(found.warnings.contains(&"rig_changed".to_owned()), "{:?}", found.warnings);
    // Runs of the same rig stay, whatever their level.
    input.baseline = vec![run("low", noise_drive(16.0, 0.2, 5), stiffening_a_little, 0.003, 15)];
    assert!(!report(&input).warnings.contains(&"rig_changed".to_owned()));
}

/// A stiffer rig.
fn stiffer(x: f64, _: f64) -> f64 {
    60.0 * x
}

#[test]
fn a_rig_that_was_changed_since_its_model_was_fitted_is_blamed_on_no_drift() {
    let mut input = unrepeated(stiffer, 0.01);
    input.baseline = vec![run("before", noise_drive(32.0, 1.0, 5), none, 0.01, 15)];
    input.baseline[0].started_s = -1e5;
    let found = report(&input);
    assert!(!found.verdict.kind.blames(), "{:?}", found.verdict);
    assert!(found.warnings.contains(&"rig_changed".to_owned()), "{:?}", found.warnings);
}

#[test]
fn what_repeats_differ_by_because_a_spring_drifts_is_no_noise() {
    // Each run a little stiffer than the one before; both drives twice.
    let springs: [Force; 4] = [none, |x, _| 25.0 * x, |x, _| 50.0 * x, |x, _| 75.0 * x];
    let drives = [(1.0, 1), (0.6, 2), (1.0, 1), (0.6, 2)];
    let runs: Vec<Run> = springs
        .into_iter()
        .zip(drives)
        .enumerate()
        .map(|(k, (spring, (level, seed)))| {
            let name = format!("run {k}");
            run(&name, noise_drive(16.0, level, seed), spring, 0.003, 11 + k as u64)
        })
        .collect();
    let input = Input { baseline: runs.clone(), runs, ..unrepeated(none, 0.003) };
    let found = report(&input);
    assert_eq!(found.noise_floor_source, NoiseSource::FoundRepeats);
    assert_ne!(found.verdict.kind, VerdictKind::NoMaterialGap, "{:?}", found.verdict);
    assert_eq!(found.verdict.effect, Some(Effect::StiffnessDrift), "{:?}", found.verdict);
    assert!(found.gap.systematic_at_most > 2.0 * found.gap.noise_rms_rel, "{:?}", found.gap);
}

/// A spring and dry friction at the same place.
fn stiffening_and_sliding(x: f64, v: f64) -> f64 {
    stiffening_a_little(x, v) + 60.0 * (2.0 * v).tanh()
}

/// The rig's response with the spring alone, what the spring adds to the linear rig, and the rig's with both.
fn of_two(drive: &[f64]) -> [Signal; 3] {
    let signal = |y: Vec<f64>| Signal::new(super::rig::RATE, vec![y]).unwrap();
    let [linear, spring, both] =
        [none, stiffening_a_little, stiffening_and_sliding as Force].map(|force| respond(drive, force));
    let added = spring.iter().zip(&linear).map(|(s, l)| s - l).collect();
    [signal(spring), signal(added), signal(both)]
}

#[test]
fn a_second_effect_is_sought_beside_an_adopted_one_without_repeats() {
    let mut input = at_level(0.5, stiffening_and_sliding, 0.002);
    for run in input.runs.iter_mut().chain(&mut input.baseline) {
        let [spring, added, _] = of_two(run.drive.channel(0));
        (run.simulated, run.added) = (Some(spring), Some(added));
    }
    let found = diagnose(&input, &unwatched).unwrap();
    let verdict = &found.report.verdict;
    assert!(verdict.kind.blames(), "{verdict:?}");
    assert_eq!(verdict.equivalence_set[0].family(), Family::FrictionHysteresis, "{verdict:?}");
    let second = &found.augmented[0];
    assert!(second.on_effects());
    let stored = serde_json::to_value(second).unwrap();
    assert_eq!(serde_json::from_value::<Augmented>(stored.clone()).unwrap(), *second);
    assert!(second.check(1, 1, super::rig::RATE).is_ok());

    let drive = noise_drive(12.0, 0.5, 78);
    let [spring, added, both] = of_two(&drive);
    let drive = Signal::new(super::rig::RATE, vec![drive]).unwrap();
    let error = |y: &Signal| -> f64 {
        let pairs = both.channel(0)[1000..].iter().zip(&y.channel(0)[1000..]);
        pairs.map(|(t, y)| (t - y).powi(2)).sum::<f64>().sqrt()
    };
    let of_both = error(&second.apply(&drive, &spring, Some(&added)).unwrap());
    assert!(of_both < 0.4 * error(&spring), "{of_both} of {}", error(&spring));
    // The law slides in the motion that the spring has part in.
    assert!(of_both < error(&second.apply(&drive, &spring, None).unwrap()));

    let mut broken = stored;
    broken["added"]["forward"]["seen"][0]["place"]["response"] = serde_json::json!(1);
    let broken: Augmented = serde_json::from_value(broken).unwrap();
    assert!(matches!(broken.check(1, 1, super::rig::RATE), Err(EngineError::Weights(_))));
}
