use super::systems::{RATE_HZ, acceleration, hysteretic, noise, oscillator, pair, recording, run, servo};
use crate::diagnosis::screen::{Place, Recording, Screening, Standing, group, screen};
use crate::diagnosis::{Effect, Family};
use crate::progress::unwatched;
use crate::{EngineError, Quantity, Signal};

const N: usize = 2400;

fn screened(recording: &Recording) -> Screening {
    screen(recording, &group(recording, &[]), &unwatched).unwrap()
}

/// The first standing, which has to lead the next family clearly.
fn leader(screening: &Screening, lead: f64) -> &Standing {
    let foremost = screening.foremost();
    let told = || foremost.iter().map(|s| (s.ratio, s.law, s.place)).collect::<Vec<_>>();
    // A bend behind a filter that is the rig itself does nearly as well by regression; its free run tells.
    let (blocks, others): (Vec<&Standing>, Vec<&Standing>) =
        foremost[1..].iter().copied().partition(|s| s.family == Family::BlockStructure);
    assert!(foremost[0].ratio < lead * others[0].ratio, "{:?}", told());
    let left = |s: &Standing| s.free.as_ref().map_or(f64::INFINITY, |free| free.ratio);
    assert!(blocks.iter().all(|block| left(foremost[0]) < left(block)), "{:?}", told());
    foremost[0]
}

#[test]
fn a_stiffening_spring_is_named_over_its_displacement_and_asks_the_same_of_every_stretch() {
    let screening = screened(&run(4000, 1.0, |y, _| 0.003 * y * y * y));
    let first = leader(&screening, 0.8);
    assert_eq!((first.effect, first.place), (Effect::CubicStiffness, Place::Response(0)));
    assert!(first.ratio < 0.5 && first.worst < 0.7, "{first:?}");
    assert!(first.spread().unwrap() < 0.2, "{first:?}");
}

/// Runs of three levels, whose springs stiffen so that a linear part leaves most of the response.
fn of_a_strong_spring() -> Recording {
    let runs = [0.5, 0.75, 1.0].iter().enumerate().map(|(i, level)| {
        let u: Vec<f64> = noise(3000, 40 + i as u64).iter().map(|u| level * u).collect();
        let y = oscillator(&u, |y, _| 0.02 * y * y * y);
        (vec![u], vec![y])
    });
    recording(&[Quantity::Force], &[Quantity::Displacement], runs.collect())
}

#[test]
fn a_spring_that_has_moved_the_modes_is_named_beside_modes_that_are_found_beside_it() {
    let screening = screened(&of_a_strong_spring());
    assert!(screening.apart && screening.linear.errors[0].iter().all(|e| *e > 0.4), "{screening:?}");
    let first = screening.foremost()[0];
    assert_eq!((first.effect, first.place), (Effect::CubicStiffness, Place::Response(0)));
    let free = first.free.as_ref().unwrap();
    assert!(free.ratio < 0.2 && free.worst < 0.4, "{} {}", free.ratio, free.worst);
}

#[test]
fn a_joint_that_stiffens_strongly_is_named_beside_modes_that_are_found_beside_its_bends() {
    // Slow motion is most of a displacement: the linear part leaves little of it, however strong the joint is.
    let runs = [0.5, 1.0, 1.6].iter().enumerate().map(|(i, level)| {
        let u: Vec<f64> = noise(3000, 60 + i as u64).iter().map(|u| level * u).collect();
        let motions = pair(&u, |d, _| 0.3 * d * d * d);
        (vec![u], motions.to_vec())
    });
    let recording = recording(&[Quantity::Force], &[Quantity::Displacement; 2], runs.collect());
    let screening = screened(&recording);
    assert!(screening.apart, "{:?}", screening.linear);
    let first = screening.foremost()[0];
    assert_eq!((first.effect, first.place), (Effect::CubicStiffness, Place::Between(1, 0)));
    let free = first.free.as_ref().unwrap();
    assert!(free.ratio < 0.15, "{} {}", free.ratio, free.worst);
}

#[test]
fn a_stop_in_a_joint_is_named_whichever_side_it_is_on() {
    // Turned over, drive and motion are the same rig with the stop on the other side.
    let of = |side: f64| {
        let runs = [0.5, 1.0, 1.6].iter().enumerate().map(|(i, level)| {
            let u: Vec<f64> = noise(3000, 60 + i as u64).iter().map(|u| side * level * u).collect();
            let motions = pair(&u, |d, _| 3.0 * side * (side * d - 0.5).max(0.0));
            (vec![u], motions.to_vec())
        });
        screened(&recording(&[Quantity::Force], &[Quantity::Displacement; 2], runs.collect()))
    };
    let left = [1.0, -1.0].map(|side| {
        let screening = of(side);
        let first = screening.foremost()[0];
        let told = (first.law, first.ratio, first.gain);
        assert_eq!(
            (first.effect, first.place),
            (Effect::OneSidedStop, Place::Between(1, 0)),
            "{side}: {told:?}"
        );
        assert!(first.apart, "{side}: {told:?}");
        first.free.as_ref().unwrap().ratio
    });
    assert!(left.iter().all(|left| *left < 0.4) && (left[0] / left[1] - 1.0).abs() < 0.3, "{left:?}");
}

#[test]
fn a_linear_rig_in_much_noise_has_no_modes_beside_bends() {
    let mut recording = run(6000, 1.0, |_, _| 0.0);
    let noisy = {
        let y = recording.records[0].response.channel(0);
        // A force that nothing measures.
        let other: Vec<f64> = noise(y.len(), 99).iter().map(|u| 0.6 * u).collect();
        y.iter().zip(oscillator(&other, |_, _| 0.0)).map(|(y, e)| y + e).collect()
    };
    recording.records[0].response = Signal::new(RATE_HZ, vec![noisy]).unwrap();
    let screening = screened(&recording);
    assert!(screening.linear.errors[0].iter().all(|e| *e > 0.3), "{:?}", screening.linear);
    assert!(!screening.apart);
    assert!(screening.standings.iter().all(|s| s.free.as_ref().is_none_or(|free| free.ratio > 0.8)));
}

#[test]
fn of_many_rows_a_first_look_by_few_keeps_the_right_law() {
    let force = |y: f64, _: f64| 0.003 * y * y * y;
    let (long, short) = (screened(&run(150_000, 1.0, force)), screened(&run(20_000, 1.0, force)));
    let first = leader(&long, 0.8);
    assert_eq!((first.effect, first.place), (Effect::CubicStiffness, Place::Response(0)));
    let of_short = leader(&short, 0.8);
    assert!(first.ratio < 1.1 * of_short.ratio, "{} {}", first.ratio, of_short.ratio);
    // Each family of the whole list is there, by few of its laws.
    let families = |of: &Screening| -> std::collections::BTreeSet<Family> {
        of.standings.iter().map(|s| s.family).collect()
    };
    assert_eq!(families(&long), families(&short));
    assert!(2 * long.standings.len() < short.standings.len(), "{}", long.standings.len());
}

#[test]
fn dry_friction_is_named_over_its_velocity() {
    let screening = screened(&run(N, 1.0, |_, v| 0.25 * (v / 0.5).tanh()));
    let first = leader(&screening, 0.9);
    assert_eq!((first.family, first.place), (Family::FrictionHysteresis, Place::Response(0)));
    assert!(first.ratio < 0.5, "{first:?}");
}

#[test]
fn a_gap_that_the_rig_rattles_through_is_a_clearance() {
    let screening = screened(&run(N, 1.0, |y, _| -0.8 * y.clamp(-0.5, 0.5)));
    let first = leader(&screening, 0.9);
    assert_eq!((first.effect, first.place), (Effect::Clearance, Place::Response(0)));
}

#[test]
fn a_joint_that_no_drive_acts_on_is_found_by_a_way_of_its_own_into_every_mode() {
    let u = noise(6000, 7);
    let motions = pair(&u, |d, _| 0.5 * d * d * d);
    let recording =
        recording(&[Quantity::Force], &[Quantity::Displacement; 2], vec![(vec![u], motions.to_vec())]);
    let screening = screened(&recording);
    let first = screening.foremost()[0];
    assert_eq!((first.family, first.place), (Family::Stiffness, Place::Between(1, 0)));
    let free = first.free.as_ref().unwrap();
    assert!(free.ratio < 0.2, "{}", free.ratio);
}

#[test]
fn a_joint_between_sensors_of_two_units_is_found_where_the_units_are_known() {
    let u = noise(6000, 7);
    let [first, second] = pair(&u, |d, _| 0.5 * d * d * d);
    let in_mm = second.iter().map(|y| 1000.0 * y).collect();
    let mut recording =
        recording(&[Quantity::Force], &[Quantity::Displacement; 2], vec![(vec![u], vec![first, in_mm])]);
    (recording.responses[0].size, recording.responses[1].size) = (Some(1.0), Some(1e-3));
    let screening = screened(&recording);
    let first = screening.foremost()[0];
    assert_eq!((first.family, first.place), (Family::Stiffness, Place::Between(1, 0)));
    assert!(first.free.as_ref().is_some_and(|free| free.ratio < 0.2), "{first:?}");
    // Of one that is not known nothing can be taken away.
    recording.responses[1].size = None;
    let screening = screened(&recording);
    assert!(screening.standings.iter().all(|s| !matches!(s.place, Place::Between(..))));
}

#[test]
fn a_valve_that_opens_late_is_a_dead_zone_of_the_error_and_not_of_the_command() {
    let dead = |error: f64| error - error.clamp(-0.15, 0.15);
    for quantity in [Quantity::Displacement, Quantity::Force] {
        let runs = [(1.0, 21), (0.5, 22)].map(|(level, seed)| {
            let u: Vec<f64> = noise(4000, seed).iter().map(|u| level * u).collect();
            let y = servo(&u, dead);
            (vec![u], vec![y])
        });
        let screening = screened(&recording(&[quantity], &[quantity], runs.into()));
        let first = leader(&screening, 0.9);
        let told = (first.ratio, first.law, first.free.as_ref().map(|free| free.ratio));
        assert_eq!((first.effect, first.place), (Effect::DeadZone, Place::Error(0, 0)), "{told:?}");
        assert!(first.free.as_ref().is_some_and(|free| free.ratio < 0.5), "{told:?}");
    }
}

#[test]
fn what_stands_on_a_table_bends_over_its_own_motion_less_the_tables() {
    let shaken = |displaced: bool| {
        let runs = [(1.0, 21), (0.5, 22)].map(|(level, seed)| {
            let table: Vec<f64> = noise(4000, seed).iter().map(|u| level * u).collect();
            let moving = acceleration(&table);
            // The oscillator's drive stretches its spring by one.
            let inertia: Vec<f64> = moving.iter().map(|a| -a / 625.0).collect();
            let over = oscillator(&inertia, |z, _| 0.003 * z * z * z);
            let mass: Vec<f64> = over.iter().zip(&table).map(|(z, u)| z + u).collect();
            if displaced { (vec![table], vec![mass]) } else { (vec![moving], vec![acceleration(&mass)]) }
        });
        let quantity = if displaced { Quantity::Displacement } else { Quantity::Acceleration };
        screened(&recording(&[quantity], &[quantity], runs.into()))
    };
    for displaced in [false, true] {
        let screening = shaken(displaced);
        let first = screening.foremost()[0];
        let told = (first.ratio, first.law, first.free.as_ref().map(|free| free.ratio));
        assert_eq!((first.family, first.place), (Family::Stiffness, Place::OnTable(0, 0)), "{told:?}");
        assert!(first.free.as_ref().is_some_and(|free| free.ratio < 0.4), "{told:?}");
    }
}

#[test]
fn accelerations_tell_a_damper() {
    let u = noise(6000, 9);
    let measured = acceleration(&oscillator(&u, |_, v| 0.0005 * v * v.abs()));
    let recording = recording(&[Quantity::Force], &[Quantity::Acceleration], vec![(vec![u], vec![measured])]);
    let screening = screened(&recording);
    let first = screening.foremost()[0];
    assert_eq!((first.family, first.place), (Family::Damping, Place::Response(0)));
    let free = first.free.as_ref().map(|free| free.ratio);
    assert!(first.ratio < 0.3 && free.is_some_and(|free| free < 0.6), "{} {free:?}", first.ratio);
    // So does the motion that the linear part predicts.
    let predicted = screening.standings.iter().find(|s| s.predicted).unwrap();
    assert_eq!((predicted.family, predicted.place), (Family::Damping, Place::Response(0)));
    assert!(predicted.ratio < 0.6, "{}", predicted.ratio);
}

#[test]
fn a_hysteresis_that_stiffens_is_no_spring_by_its_displacement_nor_by_its_acceleration() {
    let runs: Vec<(Vec<f64>, Vec<f64>)> = [(1.0, 21), (0.5, 22)]
        .map(|(level, seed)| {
            let u: Vec<f64> = noise(4000, seed).iter().map(|u| level * u).collect();
            let y = hysteretic(&u);
            (u, y)
        })
        .into();
    let of = |quantity, measured: &dyn Fn(&[f64]) -> Vec<f64>| {
        let runs = runs.iter().map(|(u, y)| (vec![u.clone()], vec![measured(y)])).collect();
        screened(&recording(&[Quantity::Force], &[quantity], runs))
    };
    for screening in [of(Quantity::Displacement, &<[f64]>::to_vec), of(Quantity::Acceleration, &acceleration)]
    {
        let first = screening.foremost()[0];
        let told = (first.ratio, first.law, first.free.as_ref().map(|free| free.ratio));
        assert_eq!((first.effect, first.place), (Effect::BoucWenHysteresis, Place::Response(0)), "{told:?}");
        assert!(first.free.as_ref().is_some_and(|free| free.ratio < 0.6), "{told:?}");
    }
}

#[test]
fn on_a_linear_rig_nothing_gains() {
    let screening = screened(&run(N, 1.0, |_, _| 0.0));
    assert!(screening.standings[0].ratio > 0.97, "{:?}", screening.standings[0]);
    assert!(screening.linear.errors[0].iter().all(|e| *e < 0.01), "{:?}", screening.linear);
}

/// Force of a specimen on a rig in displacement control: a spring, and friction that a spring holds.
fn specimen(x: &[f64]) -> Vec<f64> {
    let mut held = 0.0;
    let mut last = x[0];
    x.iter()
        .map(|&x| {
            held = f64::clamp(held + 3.0 * (x - last), -0.5, 0.5);
            last = x;
            x + held
        })
        .collect()
}

#[test]
fn on_a_rig_in_displacement_control_friction_acts_over_the_drive() {
    let x = noise(N, 11);
    let f = specimen(&x);
    let recording = recording(&[Quantity::Displacement], &[Quantity::Force], vec![(vec![x], vec![f])]);
    let screening = screened(&recording);
    let first = leader(&screening, 0.7);
    assert_eq!((first.family, first.place), (Family::FrictionHysteresis, Place::Drive(0)));
    assert!(first.gain > 0.0 && first.ratio < 0.4, "{first:?}");
}

#[test]
fn a_short_record_of_next_to_one_frequency_still_tells_friction_by_its_corners() {
    let x: Vec<f64> = (0..1000)
        .map(|k| {
            let t = f64::from(k) / RATE_HZ;
            (0.4 + 0.12 * t) * (3.0 * t).sin()
        })
        .collect();
    let f = specimen(&x);
    let recording = recording(&[Quantity::Displacement], &[Quantity::Force], vec![(vec![x], vec![f])]);
    let screening = screened(&recording);
    let first = screening.foremost()[0];
    assert_eq!((first.family, first.place), (Family::FrictionHysteresis, Place::Drive(0)));
}

#[test]
fn a_clipped_drive_and_play_of_a_drive_are_told_by_their_sign() {
    let u = noise(N, 7);
    let clipped: Vec<f64> = u.iter().map(|u| u.clamp(-1.1, 1.1)).collect();
    let mut w = 0.0;
    let played: Vec<f64> = u
        .iter()
        .map(|u| {
            w = f64::clamp(w, u - 0.4, u + 0.4);
            w
        })
        .collect();
    for (bent, effect) in [(clipped, Effect::DriveSaturation), (played, Effect::Backlash)] {
        let y = oscillator(&bent, |_, _| 0.0);
        let recording =
            recording(&[Quantity::Force], &[Quantity::Displacement], vec![(vec![u.clone()], vec![y])]);
        let screening = screened(&recording);
        let first = leader(&screening, 0.9);
        assert_eq!((first.family, first.place), (effect.family(), Place::Drive(0)));
        // A free map holds a clip and may do as well.
        let named = screening.standings.iter().find(|s| s.effect == effect).unwrap();
        assert!(named.ratio < 1.2 * first.ratio, "{named:?} {first:?}");
    }
}

#[test]
fn a_bend_between_two_filters_is_told_with_its_filters() {
    let u = noise(4 * N, 7);
    // A pair of poles at 5 Hz ahead of a bend of one side, the oscillator behind it.
    let (omega, damping) = (std::f64::consts::TAU * 5.0, 0.4);
    let fine = 20;
    let h = 1.0 / (RATE_HZ * f64::from(fine));
    let (mut x, mut v) = (0.0, 0.0);
    let bent: Vec<f64> = u
        .iter()
        .map(|u| {
            for _ in 0..fine {
                v += h * (omega * omega * (u - x) - 2.0 * damping * omega * v);
                x += h * v;
            }
            x + 0.6 * f64::max(x - 0.3, 0.0)
        })
        .collect();
    let y = oscillator(&bent, |_, _| 0.0);
    let recording = recording(&[Quantity::Force], &[Quantity::Displacement], vec![(vec![u], vec![y])]);
    let screening = screened(&recording);
    let first = leader(&screening, 0.8);
    assert_eq!((first.effect, first.place), (Effect::Sandwich, Place::Drive(0)), "{first:?}");
    let free = first.free.as_ref().unwrap();
    assert!(free.ratio < 0.15 && free.worst < 0.3, "{} {} {:?}", free.ratio, free.worst, first.law);
    let numbers = free.forward.numbers();
    let number = |name| numbers.iter().find(|n| n.name == name).unwrap().value;
    assert!((number("front_frequency") - 5.0).abs() < 0.5, "{numbers:?}");
    assert!((number("front_damping") - damping).abs() < 0.1, "{numbers:?}");
}

#[test]
fn a_joint_between_two_sensors_is_found_between_them() {
    // Two masses; what binds the second to the first stiffens.
    let u = noise(N, 7);
    let h = 1.0 / (8.0 * RATE_HZ);
    let mut q = [0.0_f64; 4];
    let (mut first, mut second) = (Vec::new(), Vec::new());
    for w in u.windows(2).map(|w| [w[0], w[1]]).chain([[u[N - 1]; 2]]) {
        first.push(q[0]);
        second.push(q[1]);
        for step in 0..8 {
            let drive = w[0] + (w[1] - w[0]) * f64::from(step) / 8.0;
            let s = q[1] - q[0];
            let joint = 400.0 * s + 2000.0 * s * s * s + 1.5 * (q[3] - q[2]);
            q[2] += h * (600.0 * (drive - q[0]) - 2.0 * q[2] + joint);
            q[3] -= h * joint;
            q[0] += h * q[2];
            q[1] += h * q[3];
        }
    }
    let lengths = [Quantity::Displacement; 2];
    let recording = recording(&[Quantity::Force], &lengths, vec![(vec![u], vec![first, second])]);
    let screening = screened(&recording);
    let found = &screening.standings[0];
    assert_eq!((found.family, found.place), (Family::Stiffness, Place::Between(1, 0)), "{found:?}");
    assert_eq!(found.ratios.len(), 2);
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    let recording = run(900, 1.0, |y, _| 0.01 * y * y * y);
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| screened(&recording))
    };
    assert_eq!(with(1), with(3));
}

#[test]
fn records_that_tell_nothing_are_refused_with_the_reason() {
    let short = run(120, 1.0, |_, _| 0.0);
    assert!(matches!(screen(&short, &group(&short, &[]), &unwatched), Err(EngineError::TooShort { .. })));
    let mut still = run(900, 1.0, |_, _| 0.0);
    still.records[0].drive = Signal::new(RATE_HZ, vec![vec![1.0; 900]]).unwrap();
    assert!(matches!(screen(&still, &group(&still, &[]), &unwatched), Err(EngineError::DeadChannel { .. })));
    let mut odd = run(900, 1.0, |_, _| 0.0);
    odd.responses.pop();
    assert!(matches!(screen(&odd, &group(&odd, &[]), &unwatched), Err(EngineError::ChannelCount { .. })));
}

#[test]
fn a_constant_response_and_a_dead_second_drive_give_finite_standings() {
    let u = noise(900, 7);
    let y = oscillator(&u, |y, _| 0.01 * y * y * y);
    let responses = [Quantity::Displacement, Quantity::Displacement];
    let runs = vec![(vec![u, vec![0.0; 900]], vec![y, vec![2.0; 900]])];
    let mut recording = recording(&[Quantity::Force; 2], &responses, runs);
    let mut channels = recording.records[0].response.channels().to_vec();
    channels[1] = vec![2.0; 900];
    recording.records[0].response = Signal::new(RATE_HZ, channels).unwrap();
    let screening = screened(&recording);
    assert!(
        screening.standings.iter().all(|s| s.ratio.is_finite() && s.gain.is_finite() && s.worst.is_finite())
    );
    assert_eq!(screening.standings[0].family, Family::Stiffness);
}
