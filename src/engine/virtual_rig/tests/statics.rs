//! The static characteristic, measured as in the paper: one axis loaded slowly, the others held at zero.

use super::*;

/// Forces and travels (kN, mm) of one branch of the hysteresis loop, in the order measured.
struct Branch {
    force: Vec<f64>,
    travel: Vec<f64>,
}

impl Branch {
    /// First sample at which the branch has passed `level`, whichever way it runs.
    fn crossing(&self, level: f64) -> usize {
        let below = |v: &f64| *v < level;
        let first = below(&self.force[0]);
        self.force.iter().position(|v| below(v) != first).expect("the branch passes every level asked for")
    }

    /// Mean slope between two forces, kN/mm.
    fn slope(&self, from: f64, to: f64) -> f64 {
        let (a, b) = (self.crossing(from), self.crossing(to));
        (self.force[b] - self.force[a]) / (self.travel[b] - self.travel[a])
    }
}

/// One axis loaded at 1 kN/s from 0 to the peak, to the opposite peak and back to the peak: the way down and
/// the way up. Both start at an end, where friction slips, so that they are the closed loop.
fn characteristic(rig: &VirtualRig, axis: usize, peak_kn: f64) -> [Branch; 2] {
    let quarter = (peak_kn * 1000.0) as usize;
    let loaded: Vec<f64> = (0..=5 * quarter)
        .map(|k| {
            let phase = k as f64 / quarter as f64;
            peak_kn
                * if phase < 1.0 {
                    phase
                } else if phase < 3.0 {
                    2.0 - phase
                } else {
                    phase - 4.0
                }
        })
        .collect();
    let mut channels = vec![vec![0.0; loaded.len()]; 3];
    channels[axis] = loaded;
    let response = rig.simulate(&Signal::new(1000.0, channels).unwrap(), 0).unwrap();
    [quarter..3 * quarter, 3 * quarter..5 * quarter].map(|part| Branch {
        force: response.channel(3 + axis)[part.clone()].to_vec(),
        travel: response.channel(axis)[part].to_vec(),
    })
}

/// Difference in travel at zero force between the way down and the way up.
fn hysteresis_mm([down, up]: &[Branch; 2]) -> f64 {
    down.travel[down.crossing(0.0)] - up.travel[up.crossing(0.0)]
}

#[test]
fn stiffness_is_flat_in_the_middle_and_rises_towards_both_ends() {
    for seed in 0..3 {
        let rig = quiet(&VirtualRig::draw(seed));
        for axis in 0..3 {
            for branch in characteristic(&rig, axis, 6.0) {
                let middle = branch.slope(-0.5, 0.5);
                for (from, to) in [(-1.2, -0.2), (0.2, 1.2)] {
                    let ratio = branch.slope(from, to) / middle;
                    assert!((0.8..1.25).contains(&ratio), "seed {seed}, axis {axis}: {ratio} from {from} kN");
                }
                for (from, to) in [(-5.5, -4.8), (4.8, 5.5)] {
                    let ratio = branch.slope(from, to) / middle;
                    assert!((2.0..5.0).contains(&ratio), "seed {seed}, axis {axis}: {ratio} from {from} kN");
                }
            }
        }
    }
}

#[test]
fn friction_makes_the_hysteresis() {
    let rig = quiet(&VirtualRig::draw(1));
    let smooth = rig.with_effects(Effects { friction: 0.0, ..rig.effects() }).unwrap();
    for axis in 0..3 {
        let parameters = &rig.axes()[axis];
        let width = hysteresis_mm(&characteristic(&rig, axis, 3.0));
        // Twice the slip force over the stiffness around it.
        let expected = 2.0 * parameters.friction_force_n / parameters.stiffness_n_per_mm;
        assert!((0.7..1.3).contains(&(width / expected)), "axis {axis}: {width} mm for {expected} mm");
        let rest = hysteresis_mm(&characteristic(&smooth, axis, 3.0));
        // What is left is the lag of oil and rubber at 1 kN/s.
        assert!(rest.abs() < 0.35 * width, "axis {axis}: {rest} mm without friction, {width} mm with");
    }
}

#[test]
fn without_stops_and_friction_the_characteristic_is_straight() {
    let rig = VirtualRig::draw(2).with_effects(Effects::none()).unwrap();
    let [_, up] = characteristic(&rig, 0, 6.0);
    let ratio = up.slope(4.8, 5.5) / up.slope(-0.5, 0.5);
    assert!((ratio - 1.0).abs() < 0.01, "slope at the end is {ratio} of that in the middle");
}

#[test]
fn pendulum_kinematics_couple_the_axes_unevenly() {
    let rig = VirtualRig::draw(3);
    let coupled = rig.with_effects(Effects { pendulum: 1.0, ..Effects::none() }).unwrap();
    let travel_y = |rig: &VirtualRig, x_kn: f64| {
        let drive = Signal::new(1000.0, vec![vec![x_kn], vec![2.0], vec![0.0]]).unwrap();
        rig.simulate(&drive, 0).unwrap().channel(1)[0]
    };
    // An x force tilts with y travel, so its pull on y depends on both.
    let plain = rig.with_effects(Effects::none()).unwrap();
    let [linear, bent] =
        [&plain, &coupled].map(|r| travel_y(r, 4.0) + travel_y(r, -4.0) - 2.0 * travel_y(r, 0.0));
    assert!(linear.abs() < 1e-9, "{linear}");
    assert!(bent.abs() > 0.01, "{bent} mm");
}
