//! Diagnosing a sim that has an adopted effect already: it is part of the sim, and not found again.

use super::rig::{Force, RATE, few, noise_drive, none, request, respond, run};
use crate::Signal;
use crate::diagnosis::{Augmented, Diagnosis, Effect, Input, Mode, Verdict, VerdictKind, diagnose};
use crate::model::{AddedEffect, apply_effects};
use crate::progress::unwatched;

fn signal(y: &[f64]) -> Signal {
    Signal::new(RATE, vec![y.to_vec()]).unwrap()
}

/// An FRF's estimate of the rig without its effects: 2 % off.
fn estimate(drive: &[f64]) -> Signal {
    signal(&respond(drive, none).iter().map(|y| 1.02 * y).collect::<Vec<_>>())
}

/// The request with that FRF as its sim, and these effects on top of it.
fn with_sim(mut request: Input, effects: &[Augmented]) -> Input {
    let effects: Vec<AddedEffect> = effects
        .iter()
        .map(|augmented| AddedEffect { drives: vec![0], augmented: augmented.clone() })
        .collect();
    request.sim_is_linear = true;
    request.catalogue = few();
    for run in &mut request.runs {
        let base = estimate(run.drive.channel(0));
        let (simulated, added) = apply_effects(&effects, &run.drive, base).unwrap();
        (run.simulated, run.added) = (Some(simulated), added);
    }
    request
}

/// In situ the low-level runs, too, are of the rig with the effect.
fn in_mode(mut request: Input, mode: Mode, force: Force) -> Input {
    request.mode = mode;
    if mode == Mode::InSitu {
        request.baseline = vec![run("low", noise_drive(25.0, 0.4, 3), force, 0.01, 10)];
    }
    request
}

fn found(input: &Input) -> Diagnosis {
    diagnose(input, &unwatched).unwrap()
}

/// A cubic spring, as the catalogue has it.
fn cubic(x: f64, _: f64) -> f64 {
    260.0 * x * x * x
}

/// Dry friction, as the catalogue has it.
fn sliding(_: f64, v: f64) -> f64 {
    400.0 * v.tanh()
}

#[test]
fn an_adopted_effect_is_not_found_again_in_either_mode() {
    for (force, effect) in [(cubic as Force, Effect::CubicStiffness), (sliding, Effect::CoulombFriction)] {
        for mode in [Mode::External, Mode::InSitu] {
            let input = || in_mode(request(force, 0.01), mode, force);
            let first = found(&with_sim(input(), &[]));
            assert!(first.report.verdict.kind.blames(), "{effect:?}, {mode:?}: {:?}", first.report.verdict);
            for again in [Mode::External, Mode::InSitu] {
                let input = in_mode(with_sim(input(), &first.augmented[..1]), again, force);
                let Diagnosis { report, .. } = found(&input);
                let Verdict { kind, .. } = report.verdict;
                assert_eq!(
                    kind,
                    VerdictKind::NoMaterialGap,
                    "{effect:?} {mode:?} {again:?}: {:?}",
                    report.verdict
                );
                assert!(report.gap.systematic_rms_rel < input.material_gap, "{:?}", report.gap);
            }
        }
    }
}
