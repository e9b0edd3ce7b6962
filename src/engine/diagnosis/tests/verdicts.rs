use super::rig::{RATE, few, friction, hardening, none, request};
use crate::Signal;
use crate::diagnosis::{Effect, Family, Input, Mode, NoiseSource, Verdict, VerdictKind, diagnose};
use crate::progress::unwatched;

#[test]
fn a_hardening_spring_is_named_and_closes_the_gap_on_unseen_stretches() {
    let found = diagnose(&request(hardening, 0.01), &unwatched).unwrap();
    let verdict = &found.report.verdict;
    // A hyperbolic sine is no law of the catalogue: its family's free shape stands for it.
    assert_eq!(verdict.kind, VerdictKind::FamilyOnly, "{verdict:?}");
    assert_eq!(verdict.family, Some(Family::Stiffness), "{verdict:?}");
    let held_out = &found.report.hypotheses[0].held_out;
    assert!(held_out.chi2_before > 20.0 && held_out.closure > 0.97, "{held_out:?}");
    assert!(held_out.closure_ci90[0] <= held_out.closure && held_out.closure <= held_out.closure_ci90[1]);
    assert!(found.report.hypotheses[0].stable_over_envelope);
}

#[test]
fn a_catalogue_of_free_shapes_alone_states_a_probability() {
    let request =
        Input { catalogue: vec![Effect::FreeStiffness, Effect::FreeDamping], ..request(hardening, 0.01) };
    let found = diagnose(&request, &unwatched).unwrap();
    let verdict = &found.report.verdict;
    assert_eq!(
        (verdict.kind, verdict.family),
        (VerdictKind::FamilyOnly, Some(Family::Stiffness)),
        "{verdict:?}"
    );
    assert!(found.report.hypotheses.iter().all(|h| h.probability.is_finite()));
    assert!((0.5..=1.0).contains(&verdict.probability));
}

#[test]
fn dry_friction_is_named_with_its_axis() {
    let found = diagnose(&request(friction, 0.01), &unwatched).unwrap();
    let verdict = &found.report.verdict;
    assert_eq!(verdict.family, Some(Family::FrictionHysteresis), "{verdict:?}");
    assert_eq!(verdict.axis.as_deref(), Some("x"));
    assert!(verdict.equivalence_set.contains(&Effect::CoulombFriction), "{verdict:?}");
    // Friction does not grow with the drive.
    let exponent = found.report.fingerprints.gap_level_exponent.unwrap();
    assert!(exponent < 0.8, "{exponent}");
}

#[test]
fn a_rig_like_its_model_has_no_material_gap() {
    let found = diagnose(&request(none, 0.01), &unwatched).unwrap();
    assert_eq!(found.report.verdict.kind, VerdictKind::NoMaterialGap);
    assert!(found.report.gap.chi2_select < 1.3);
    assert!(found.report.hypotheses.is_empty() && found.augmented.is_empty());
}

#[test]
fn without_repeats_a_verdict_is_partial_at_most() {
    let request = Input { repeats: Vec::new(), catalogue: few(), ..request(friction, 0.01) };
    let found = diagnose(&request, &unwatched).unwrap();
    assert_eq!(found.report.verdict.kind, VerdictKind::Partial, "{:?}", found.report.verdict);
    assert_eq!(found.report.noise_floor_source, NoiseSource::Assumed);
    assert!(found.report.warnings.contains(&"noise_floor_assumed".to_owned()));
}

#[test]
fn an_effect_that_acts_in_one_quarter_alone_is_called_partial_and_in_two_that_are_not_fitted_is_identified() {
    let stop = |x: f64, _: f64| 3000.0 * (x.abs() - 9.0).max(0.0).copysign(x);
    // Half of a run is fitted to, the next quarter is chosen on; a late stop is still heard in the last quarter.
    for (tall_s, alone) in [(1.0, true), (9.0, false)] {
        let mut request = request(none, 0.01);
        request.catalogue = [few(), vec![Effect::BumpStop]].concat();
        for (k, run) in request.runs.iter_mut().enumerate() {
            let mut drive = run.drive.channel(0).to_vec();
            let tall = (tall_s * RATE) as usize..((tall_s + 1.5) * RATE) as usize;
            drive.iter_mut().for_each(|u| *u *= 0.6);
            // The two at full level are repeats.
            if k % 3 == 0 {
                drive[tall].iter_mut().for_each(|u| *u *= 8.0);
            }
            *run = super::rig::run(&run.name, drive, stop, 0.01, 11 + k as u64);
        }
        let found = diagnose(&request, &unwatched).unwrap().report;
        assert_eq!(found.warnings.contains(&"acts_seldom".to_owned()), alone, "{tall_s}: {:?}", found.gap);
        let kind = if alone { VerdictKind::Partial } else { VerdictKind::Identified };
        assert_eq!(found.verdict.kind, kind, "{tall_s}: {:?}", found.verdict);
        assert_eq!(found.verdict.effect, Some(Effect::BumpStop), "{tall_s}: {:?}", found.verdict);
    }
}

#[test]
fn what_the_catalogue_lacks_is_not_blamed_on_something_else() {
    let catalogue = vec![Effect::Gain, Effect::Delay, Effect::DriveSaturation, Effect::Offset];
    let request = Input { catalogue, ..request(friction, 0.01) };
    let found = diagnose(&request, &unwatched).unwrap();
    assert_eq!(found.report.verdict.kind, VerdictKind::NoneOfCatalogue, "{:?}", found.report.verdict);
    assert_eq!(found.report.verdict.effect, None);
}

/// An FRF that was estimated at another level of a rig that bends lacked more than the change before it.
#[test]
fn that_the_catalogue_lacks_a_cause_is_not_sure_where_a_linear_sim_is_another_than_the_core() {
    let catalogue = vec![Effect::Gain, Effect::Delay, Effect::DriveSaturation, Effect::Offset];
    let of = |gain: f64| {
        let mut request =
            Input { catalogue: catalogue.clone(), sim_is_linear: true, ..request(friction, 0.01) };
        for run in &mut request.runs {
            let sim = super::rig::respond(run.drive.channel(0), none).iter().map(|y| gain * y).collect();
            run.simulated = Some(Signal::new(RATE, vec![sim]).unwrap());
        }
        diagnose(&request, &unwatched).unwrap().report.verdict
    };
    let [like, unlike] = [1.0, 1.1].map(of);
    for verdict in [&like, &unlike] {
        assert_eq!(verdict.kind, VerdictKind::NoneOfCatalogue, "{verdict:?}");
        assert_eq!(verdict.in_words, "No effect of the catalogue alone explains what the model leaves.");
    }
    let said =
        |verdict: &Verdict| verdict.because.iter().any(|b| b.contains("fit a model that follows the rig"));
    assert!(like.probability > 0.8 && !said(&like), "{like:?}");
    assert!(unlike.probability <= 0.5 && said(&unlike), "{unlike:?}");
}

#[test]
fn what_mimics_a_cause_that_the_catalogue_lacks_is_not_blamed_for_it() {
    let cases: [(super::rig::Force, &[Effect]); 2] = [
        // Stops that touch at rest, gaps that are never left: each is a straight line.
        (|x, _| 150.0 * x, &[Effect::BumpStop, Effect::OneSidedStop, Effect::Clearance]),
        // Friction that drives.
        (
            |_, v| -2.0 * v * (-(v / 30.0).powi(2)).exp(),
            &[Effect::CoulombFriction, Effect::StribeckFriction, Effect::Clearance],
        ),
    ];
    for (k, (force, catalogue)) in cases.into_iter().enumerate() {
        let request = Input { catalogue: catalogue.to_vec(), ..request(force, 0.01) };
        let report = diagnose(&request, &unwatched).unwrap().report;
        let first = &report.hypotheses[0];
        println!("{k}: {:?} {:?} {:?}", report.gap, report.verdict, first.held_out);
        assert_eq!(report.verdict.kind, VerdictKind::NoneOfCatalogue, "{k}: {:?}", report.verdict);
        // Nor is it for want of closing.
        assert!(first.held_out.closure > 0.8, "{k}: {:?}", first.held_out);
    }
}

#[test]
fn friction_that_weakens_nowhere_stands_alone_beside_the_law_that_holds_it() {
    let catalogue = vec![Effect::CoulombFriction, Effect::StribeckFriction, Effect::QuadraticDamping];
    let dry: super::rig::Force = |_, v| 400.0 * (v / 1.5).tanh();
    let report = diagnose(&Input { catalogue, ..request(dry, 0.01) }, &unwatched).unwrap().report;
    let verdict = &report.verdict;
    assert_eq!(verdict.equivalence_set, [Effect::CoulombFriction], "{verdict:?}");
    // It is listed all the same, and fits as well.
    let of = |effect| report.hypotheses.iter().find(|h| h.effect == effect).unwrap().held_out.chi2_after;
    let (dry, weaker) = (of(Effect::CoulombFriction), of(Effect::StribeckFriction));
    assert!((dry / weaker - 1.0).abs() < 0.1, "{dry} {weaker}");
}

/// What a shape that bends to whatever it meets closes as well as two effects is told as the two.
#[test]
fn friction_beside_an_offset_is_no_free_shape() {
    let mut request = request(friction, 0.01);
    for run in &mut request.runs {
        let shifted = run.response.channel(0).iter().map(|y| y + 0.3).collect();
        run.response = Signal::new(RATE, vec![shifted]).unwrap();
    }
    request.catalogue = [few(), vec![Effect::Offset, Effect::FreeDamping, Effect::Sandwich]].concat();
    let found = diagnose(&request, &unwatched).unwrap().report;
    let second = found.remaining.second_effect.as_ref().map(|s| s.effect);
    let both = [found.verdict.effect, second];
    assert_eq!(found.verdict.kind, VerdictKind::Partial, "{:?}", found.verdict);
    assert_eq!(found.hypotheses.first().map(|h| h.effect), found.verdict.effect);
    for effect in [Effect::CoulombFriction, Effect::Offset] {
        assert!(both.contains(&Some(effect)), "{both:?}");
    }
}

#[test]
fn a_linear_sim_that_is_not_the_core_is_said_to_be_stood_for() {
    for (gain, warned) in [(1.0, false), (1.1, true)] {
        let mut request = request(hardening, 0.01);
        (request.mode, request.sim_is_linear, request.catalogue) = (Mode::InSitu, true, few());
        for run in &mut request.runs {
            let linear = super::rig::respond(run.drive.channel(0), none);
            let simulated = linear.iter().map(|y| gain * y).collect();
            run.simulated = Some(Signal::new(RATE, vec![simulated]).unwrap());
        }
        let found = diagnose(&request, &unwatched).unwrap().report;
        let warning = "core_stands_for_sim: disp_x".to_owned();
        assert_eq!(found.warnings.contains(&warning), warned, "{gain}: {:?}", found.warnings);
    }
}

#[test]
fn an_effect_that_the_sim_has_half_absorbed_is_named_too() {
    let mut request = request(hardening, 0.01);
    let low = super::rig::noise_drive(25.0, 0.4, 3);
    request.baseline = vec![super::rig::run("low", low, hardening, 0.01, 10)];
    request.mode = Mode::InSitu;
    request.catalogue = few();
    let found = diagnose(&request, &unwatched).unwrap();
    assert_eq!(found.report.verdict.family, Some(Family::Stiffness), "{:?}", found.report.verdict);
}

#[test]
fn the_report_has_the_contracts_fields_and_finite_numbers() {
    let request = Input { catalogue: few(), ..request(friction, 0.01) };
    let found = diagnose(&request, &unwatched).unwrap();
    let json = serde_json::to_value(&found.report).unwrap();
    for field in [
        "schema",
        "mode",
        "noise_floor_source",
        "verdict",
        "gap",
        "where",
        "fingerprints",
        "hypotheses",
        "remaining",
    ] {
        assert!(json.get(field).is_some(), "{field}");
    }
    assert_eq!(json["schema"], "gap-diagnosis/1");
    assert_eq!(json["mode"], "external");
    // What is not finite becomes null: only what may be absent is.
    for hypothesis in json["hypotheses"].as_array().unwrap() {
        for number in hypothesis["held_out"].as_object().unwrap().values() {
            assert!(!number.is_null(), "{hypothesis}");
        }
    }
    for bands in json["where"]["bands"].as_array().unwrap() {
        assert!(bands["systematic_db"].is_number() && bands["noise_db"].is_number(), "{bands}");
    }
    let shares: f64 = found.report.location.bands.iter().map(|b| b.share_of_gap).sum();
    assert!((shares - 1.0).abs() < 1e-9);
}
