use crate::diagnosis::screen::forward::{Course, Forward, Output, Source};
use crate::diagnosis::screen::kernel::{HeldSums, Kernel, RunningSums};
use crate::diagnosis::screen::law::{Law, Scale};
use crate::diagnosis::screen::motion::Limits;
use crate::diagnosis::screen::place::Place;

const UNIT: Scale = Scale { centre: 0.0, d: 1.0, v: 1.0 };

/// One drive and one response, with impulse responses of the drive and of each signal into each output.
fn forward(law: Law, argument: Source, step: usize, outputs: Vec<(Vec<f64>, Vec<Kernel>)>) -> Forward {
    let output = |(linear, kernels): (Vec<f64>, Vec<Kernel>)| Output {
        offset: 0.0,
        offset_before: 0.0,
        before: vec![Kernel::new(0, &linear)],
        linear: vec![Kernel::new(0, &linear)],
        kernels,
    };
    Forward {
        law,
        place: Place::Response(0),
        other: None,
        argument: (argument, UNIT),
        second: None,
        rate_hz: 100.0,
        step,
        limits: Limits { low_hz: 0.0, high_hz: 50.0 },
        drive_mean: vec![0.0],
        responses: 1,
        outputs: outputs.into_iter().map(output).collect(),
        seen: Vec::new(),
    }
}

fn drive(n: usize) -> Vec<f64> {
    (0..n).map(|k| (0.05 * k as f64).sin() + 0.4 * (0.013 * k as f64).sin()).collect()
}

#[test]
fn a_law_of_a_drive_and_of_a_response_goes_with_both_at_the_rate_of_the_analysis() {
    let (step, n) = (4, 2000);
    let nothing = || vec![Kernel::default(); 4];
    let law = vec![Kernel::new(0, &[1.0]), Kernel::default(), Kernel::default(), Kernel::default()];
    let drive_0 = Source::Drive { channel: 0, quantity: crate::Quantity::Force };
    let bare = forward(Law::ValveFlow, drive_0, step, vec![(vec![0.5], law), (vec![0.5], nothing())]);
    let valve = Forward {
        place: Place::Drive(0),
        other: Some(Place::Response(0)),
        second: Some((Source::Linear(1), UNIT)),
        ..bare
    };
    let u = drive(n);
    let found = valve.simulate(std::slice::from_ref(&u), None).unwrap().swap_remove(0);
    assert_eq!(found.augmented.len(), n);
    for k in (100..n - 100).step_by(37) {
        let expected = 0.5 * u[k] + u[k].abs() * 0.5 * u[k];
        assert!((found.augmented[k] - expected).abs() < 0.02, "{k}: {} for {expected}", found.augmented[k]);
    }
}

#[test]
fn friction_on_a_rate_that_is_an_output_needs_no_displacement() {
    // v(t + 1) = 0.9 v(t) + u(t) - 0.3 tanh(v(t) / 0.1), with no spring that a displacement would come back to.
    let (n, smooth) = (3000, 0.1);
    let ring: Vec<f64> = (0..400).map(|k| 0.9_f64.powi(k)).collect();
    let ways = || vec![Kernel::new(1, &ring.iter().map(|h| -0.3 * h).collect::<Vec<_>>()), Kernel::default()];
    let late: Vec<f64> = std::iter::once(0.0).chain(ring.iter().copied()).collect();
    let axis = forward(
        Law::Coulomb { smooth },
        Source::OutputRate(1),
        1,
        vec![(late.clone(), ways()), (late, ways())],
    );
    axis.check(1, 1, 100.0).unwrap();
    // A drive that is at rest before it begins.
    let u: Vec<f64> = drive(n).iter().map(|u| 0.4 * u).collect();
    let found = axis.simulate(std::slice::from_ref(&u), None).unwrap().swap_remove(0).augmented;
    let mut v = 0.0_f64;
    for (k, (u, found)) in u.iter().zip(&found).enumerate() {
        assert!((found - v).abs() < 1e-6 * (1.0 + v.abs()), "{k}: {found} for {v}");
        v = 0.9 * v + u - 0.3 * (v / smooth).tanh();
    }
    let spring = Forward { law: Law::Cubic, ..axis };
    assert!(spring.check(1, 1, 100.0).is_err(), "a spring has no law over a rate");
}

#[test]
fn sums_of_what_a_filter_makes_are_those_of_its_samples() {
    let (n, mean) = (500, 0.3);
    let (u, x) = (drive(n).iter().map(|u| u + 0.7).collect::<Vec<f64>>(), drive(n));
    let linear: Vec<f64> = (0..40).map(|k| 0.93_f64.powi(k)).collect();
    // Ahead of its signal, and behind it.
    let kernels = vec![Kernel::new(-5, &linear), Kernel::new(3, &[2.0, -0.5])];
    let mut model = forward(Law::Cubic, Source::Output(0), 1, vec![(linear, kernels)]);
    model.drive_mean = vec![mean];
    let signals = [x.clone(), u.clone()];
    let course =
        Course { whole: vec![u.as_slice()], thin: vec![u.as_slice()], clock: [0.0, 1.0], added: Vec::new() };
    let made = model.outputs_of(&course, &signals).swap_remove(0);
    let alone = model.linear(&model.outputs[0].before, &course);
    let of_signals = signals.map(|x| RunningSums::new(x.iter().copied()));
    for rows in [0..n, 0..20, 30..35, n - 8..n] {
        let [found, before] = model.sums_over(&[HeldSums::new(&u)], &of_signals, &rows)[0];
        let (expected, linear): (f64, f64) =
            (made[rows.clone()].iter().sum(), alone[rows.clone()].iter().sum());
        assert!((found - expected).abs() < 1e-9 * (1.0 + expected.abs()), "{rows:?}: {found} {expected}");
        assert!((before - linear).abs() < 1e-9 * (1.0 + linear.abs()), "{rows:?}: {before} {linear}");
    }
}
