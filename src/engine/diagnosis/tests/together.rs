//! Two effects on one response: they are named, weighed, simulated and adopted together.

use super::rig::{Force, RATE, few, noise_drive, none, request, respond};
use crate::Signal;
use crate::diagnosis::{Augmented, Diagnosis, Effect, Input, VerdictKind, diagnose};
use crate::progress::unwatched;

/// A cubic spring and dry friction, as the catalogue has them.
fn spring_and_friction(x: f64, v: f64) -> f64 {
    260.0 * x * x * x + 300.0 * v.tanh()
}

fn found(force: Force) -> Diagnosis {
    diagnose(&Input { catalogue: few(), ..request(force, 0.01) }, &unwatched).unwrap()
}

#[test]
fn two_effects_are_one_hypothesis_that_says_what_falls_to_each() {
    let report = found(spring_and_friction).report;
    let (verdict, best) = (&report.verdict, &report.hypotheses[0]);
    assert_eq!(verdict.kind, VerdictKind::Partial, "{verdict:?}");
    let mut named: Vec<Effect> = verdict.effects.iter().map(|e| e.effect).collect();
    assert_eq!(verdict.effect, Some(named[0]), "{verdict:?}");
    assert_eq!(verdict.effects, best.effects);
    named.sort();
    assert_eq!(named, [Effect::CubicStiffness, Effect::CoulombFriction], "{verdict:?}");
    assert!(best.effects.iter().all(|e| e.at.as_deref() == Some("disp_x")), "{:?}", best.effects);
    // What each closes beside those before it adds up to all that is closed.
    let shares: Vec<f64> = best.effects.iter().map(|e| e.share_of_gap).collect();
    assert!(shares.iter().all(|s| (0.02..1.0).contains(s)), "{shares:?}");
    let closed: f64 = shares.iter().sum();
    assert!((closed + best.remaining_share - 1.0).abs() < 0.01, "{shares:?} {}", best.remaining_share);
    assert!(best.remaining_share < 0.02 && best.held_out.closure > 0.98, "{best:?}");
    assert_eq!(report.remaining.second_effect.map(|s| s.effect), Some(verdict.effects[1].effect));
    assert!(report.remaining.chi2 < 0.02 * report.gap.chi2_select, "of both: {}", report.remaining.chi2);
    assert!(verdict.in_words.contains("together they explain"), "{}", verdict.in_words);
    // The numbers of each are told apart by its name.
    let names: Vec<&str> = best.parameters.iter().map(|p| p.name.as_str()).collect();
    assert!(names.contains(&"coulomb_friction.transition_velocity"), "{names:?}");
    // Each alone stays in the list where it was fitted well.
    assert!(report.hypotheses[1..].iter().all(|h| h.effects.len() == 1 && h.effects[0].effect == h.effect));
}

#[test]
fn what_is_adopted_has_both_effects() {
    let both = found(spring_and_friction).augmented.swap_remove(0);
    let mut effects = both.effects();
    effects.sort();
    assert_eq!(effects, [(Effect::CubicStiffness, 0), (Effect::CoulombFriction, 0)]);
    assert!(both.check(1, 1, RATE).is_ok());
    let stored = serde_json::to_string(&both).unwrap();
    let both: Augmented = serde_json::from_str(&stored).unwrap();
    // A level between those of the runs.
    let drive = noise_drive(12.0, 0.8, 77);
    let signal = |y: &[f64]| Signal::new(RATE, vec![y.to_vec()]).unwrap();
    let (truth, linear) = (respond(&drive, spring_and_friction), respond(&drive, none));
    let predicted = both.apply(&signal(&drive), &signal(&linear), None).unwrap();
    let error = |y: &[f64]| -> f64 { truth.iter().zip(y).map(|(t, y)| (t - y).powi(2)).sum() };
    let (before, after) = (error(&linear), error(predicted.channel(0)));
    assert!(after < 0.002 * before, "{after} of {before}");
}

#[test]
fn one_effect_alone_is_the_whole_of_its_hypothesis() {
    let report = found(|x, _| 260.0 * x * x * x).report;
    let (verdict, best) = (&report.verdict, &report.hypotheses[0]);
    assert_eq!((verdict.effect, best.effects.len()), (Some(Effect::CubicStiffness), 1), "{verdict:?}");
    assert_eq!(verdict.effects, best.effects);
    assert!(best.effects[0].share_of_gap > 0.98, "{:?}", best.effects);
    assert!(verdict.in_words.contains("; it explains"), "{}", verdict.in_words);
}
