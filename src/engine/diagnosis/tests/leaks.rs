use super::rig::{few, hardening, noise_drive, request, respond, run};
use crate::Signal;
use crate::diagnosis::{Augmented, Effect, Family, Input, Report, Role, Verdict, VerdictKind, diagnose};
use crate::progress::unwatched;

/// Whole runs with given roles, one repeat each, so that the test runs stand alone.
fn with_roles() -> Input {
    let mut request = Input { catalogue: few(), ..request(hardening, 0.01) };
    for (k, seed) in [(0, 21), (1, 22)] {
        let drive = noise_drive(12.0, 1.0 - 0.3 * f64::from(k), 30 + seed);
        request.runs.push(run("select", drive.clone(), hardening, 0.01, seed));
        request.runs.push(run("test", drive, hardening, 0.01, seed + 5));
    }
    request.roles = Some(vec![
        Role::Fit,
        Role::Fit,
        Role::Fit,
        Role::Fit,
        Role::Select,
        Role::Test,
        Role::Select,
        Role::Test,
    ]);
    request
}

#[test]
fn measured_test_responses_change_no_choice_and_no_prediction() {
    let request = with_roles();
    let mut shuffled = request.clone();
    for k in [5, 7] {
        let mut response = request.runs[k].response.channel(0).to_vec();
        response.reverse();
        shuffled.runs[k].response = Signal::new(request.sample_rate_hz(), vec![response]).unwrap();
    }
    let (a, b) = (diagnose(&request, &unwatched).unwrap(), diagnose(&shuffled, &unwatched).unwrap());
    assert_eq!(a.augmented, b.augmented);
    // The sentence tells the closure, which is of the test runs.
    let chosen =
        |d: &crate::diagnosis::Diagnosis| Verdict { in_words: String::new(), ..d.report.verdict.clone() };
    assert_eq!(chosen(&a), chosen(&b));
    let closures = |d: &crate::diagnosis::Diagnosis| d.report.hypotheses[0].held_out.closure;
    assert!(closures(&a) > 0.95 && closures(&b) < 0.8, "{} {}", closures(&a), closures(&b));
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    let request = Input { catalogue: few(), ..request(hardening, 0.01) };
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| diagnose(&request, &unwatched).unwrap())
    };
    let (one, three) = (on(1), on(3));
    assert_eq!(one.report, three.report);
    assert_eq!(one.augmented, three.augmented);
}

#[test]
fn the_augmented_sim_predicts_a_run_nobody_saw_and_survives_storage() {
    let found = diagnose(&Input { catalogue: few(), ..request(hardening, 0.01) }, &unwatched).unwrap();
    let best = &found.augmented[0];
    let stored = serde_json::to_string(best).unwrap();
    let loaded: Augmented = serde_json::from_str(&stored).unwrap();
    assert_eq!(*best, loaded);

    let drive = noise_drive(10.0, 0.9, 77);
    let truth = respond(&drive, hardening);
    let linear = respond(&drive, super::rig::none);
    let drive = Signal::new(super::rig::RATE, vec![drive]).unwrap();
    // The sim is another one than the core: the effect is added to whatever the sim says.
    let simulated = Signal::new(super::rig::RATE, vec![linear.clone()]).unwrap();
    let predicted = loaded.apply(&drive, &simulated, None).unwrap();
    let error = |y: &[f64]| -> f64 { truth.iter().zip(y).map(|(t, y)| (t - y).powi(2)).sum() };
    let (before, after) = (error(&linear), error(predicted.channel(0)));
    assert!(after < 0.05 * before, "{before} {after}");
    assert!(loaded.apply(&drive, &Signal::new(super::rig::RATE, vec![vec![0.0; 5]]).unwrap(), None).is_err());
}

#[test]
fn an_frf_as_sim_is_stood_for_by_the_core_and_what_it_misses_is_no_gap() {
    // An FRF's estimate errs: here by a few per cent, on a rig that has not changed.
    let mut request = Input { catalogue: few(), sim_is_linear: true, ..request(super::rig::none, 0.01) };
    let off = |run: &mut crate::diagnosis::Run| {
        let estimate: Vec<f64> =
            respond(run.drive.channel(0), super::rig::none).iter().map(|y| 1.04 * y).collect();
        run.simulated = Some(Signal::new(super::rig::RATE, vec![estimate]).unwrap());
    };
    request.runs.iter_mut().for_each(off);
    let found = diagnose(&request, &unwatched).unwrap();
    assert_eq!(found.report.verdict.kind, VerdictKind::NoMaterialGap, "{:?}", found.report.verdict);

    // Of a rig that has, the augmented core alone is the better prediction.
    let mut request = Input { sim_is_linear: true, ..self::request(hardening, 0.01) };
    request.catalogue = few();
    request.runs.iter_mut().for_each(off);
    let found = diagnose(&request, &unwatched).unwrap();
    let drive = noise_drive(10.0, 0.9, 78);
    let truth = respond(&drive, hardening);
    let estimate: Vec<f64> = respond(&drive, super::rig::none).iter().map(|y| 1.04 * y).collect();
    let signal = |y: &[f64]| Signal::new(super::rig::RATE, vec![y.to_vec()]).unwrap();
    let predicted = found.augmented[0].apply(&signal(&drive), &signal(&estimate), None).unwrap();
    let error = |y: &[f64]| -> f64 { truth.iter().zip(y).map(|(t, y)| (t - y).powi(2)).sum() };
    assert!(error(predicted.channel(0)) < 0.05 * error(&estimate));
}

#[test]
fn a_sim_that_errs_on_its_own_baseline_is_stood_for_by_the_core_and_said_to_err() {
    let of = |force, errs: f64| {
        let mut request = Input { catalogue: few(), ..request(force, 0.01) };
        for run in request.baseline.iter_mut().chain(&mut request.runs) {
            let sim =
                respond(run.drive.channel(0), super::rig::none).iter().map(|y| (1.0 + errs) * y).collect();
            run.simulated = Some(Signal::new(super::rig::RATE, vec![sim]).unwrap());
        }
        diagnose(&request, &unwatched).unwrap().report
    };
    let nothing = of(super::rig::none, 0.06);
    assert_eq!(nothing.verdict.kind, VerdictKind::NoneOfCatalogue, "{:?}", nothing.verdict);
    assert!(
        nothing.verdict.because.iter().any(|b| b.contains("the model itself errs by")),
        "{:?}",
        nothing.verdict
    );
    assert!(nothing.verdict.in_words.contains("the model itself errs"), "{:?}", nothing.verdict);
    assert!(nothing.warnings.contains(&"core_stands_for_sim: disp_x".to_owned()), "{:?}", nothing.warnings);
    let bent = of(hardening, 0.06);
    assert_eq!(bent.verdict.family, Some(Family::Stiffness), "{:?}", bent.verdict);
    let good = of(super::rig::none, 0.0);
    assert_eq!(good.verdict.kind, VerdictKind::NoMaterialGap, "{:?}", good.verdict);
}

/// The rig stiffens by itself, and the sim with it, which errs by a little more than what matters.
#[test]
fn a_sim_that_errs_but_bends_with_the_rig_stays() {
    fn stiffening(x: f64, _: f64) -> f64 {
        12.0 * ((1.2 * x).sinh() - 1.2 * x)
    }
    let catalogue: Vec<Effect> = few().into_iter().chain([Effect::DeadZone]).collect();
    // Of a drive that does nothing below a command of `dead`.
    let of = |dead: f64| {
        let through =
            |drive: &[f64]| -> Vec<f64> { drive.iter().map(|u| u - u.clamp(-dead, dead)).collect() };
        let mut request = Input { catalogue: catalogue.clone(), ..request(stiffening, 0.003) };
        let low = noise_drive(25.0, 0.1, 3);
        request.baseline = vec![super::rig::run("low", low, stiffening, 0.0003, 10)];
        for (seed, run) in (11..).zip(&mut request.runs) {
            let worn = through(run.drive.channel(0));
            run.response = super::rig::run("", worn, stiffening, 0.003, seed).response;
        }
        for run in request.baseline.iter_mut().chain(&mut request.runs) {
            let sim = respond(run.drive.channel(0), stiffening).iter().map(|y| 1.012 * y).collect();
            run.simulated = Some(Signal::new(super::rig::RATE, vec![sim]).unwrap());
        }
        diagnose(&request, &unwatched).unwrap().report
    };
    let stays = |report: &Report| {
        let said = report.verdict.because.iter().any(|b| b.contains("it follows these runs far better"));
        said && report.warnings.iter().all(|w| !w.starts_with("core_stands_for_sim"))
    };
    // The dead zone is no answer: a law goes through the linear part of low level. But nothing else is blamed for the bend.
    let changed = of(0.03);
    assert!(stays(&changed), "{:?}", changed.verdict);
    assert_ne!(changed.verdict.family, Some(Family::Stiffness), "{:?}", changed.verdict);
    let same = of(0.0);
    assert!(stays(&same), "{:?}", same.verdict);
    assert_eq!(same.verdict.kind, VerdictKind::NoneOfCatalogue, "{:?}", same.verdict);
    assert!(same.verdict.in_words.contains("the model itself errs"), "{:?}", same.verdict);
}
