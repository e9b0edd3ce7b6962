//! Random frames.

use rand::{Rng, RngExt};

use super::super::axis::spring_and_damper;
use super::super::suites::Suite;
use super::body::{Control, Frame, MASSES, Quantity, Sensor, Site};

/// What a frame of a suite has to have.
#[derive(Debug, Clone, Copy)]
pub struct Wanted {
    pub suite: Suite,
    /// Whether its law acts where no sensor is.
    pub elsewhere: bool,
    pub looped: bool,
}

/// A frame without units yet.
pub fn frame(wanted: Wanted, rng: &mut impl Rng) -> Frame {
    if wanted.suite == Suite::ForceOverDisplacement {
        return specimen(rng);
    }
    let masses = if wanted.suite == Suite::Place || wanted.elsewhere {
        rng.random_range(2..4)
    } else {
        rng.random_range(1..4)
    };
    let lowest = rng.random_range(4.0..12.0);
    let mut frame = Frame {
        control: Control::Force,
        masses,
        mass: [1.0; MASSES],
        stiffness: [0.0; MASSES],
        damping: [0.0; MASSES],
        driven: vec![rng.random_range(0..masses)],
        lag_hz: rng.random_bool(0.5).then(|| rng.random_range(20.0..80.0)),
        sensors: Vec::new(),
        site: Site { mass: rng.random_range(0..masses), joint: rng.random_bool(0.5) },
        specimen: [0.0; 2],
        level: [1.0; 3],
        levels: Vec::new(),
    };
    for i in 0..masses {
        frame.mass[i] = rng.random_range(0.4..1.6);
        let hz = lowest * if i == 0 { 1.2 } else { rng.random_range(1.0..2.3) };
        [frame.stiffness[i], frame.damping[i]] =
            spring_and_damper(frame.mass[i], hz, rng.random_range(0.015..0.09));
    }
    if rng.random_bool(0.4) {
        frame.driven.push(rng.random_range(0..masses));
    }
    if wanted.looped {
        frame.control = Control::Loop {
            gain: std::f64::consts::TAU * rng.random_range(8.0..25.0),
            integral: if rng.random_bool(0.5) {
                std::f64::consts::TAU * rng.random_range(0.05..0.4)
            } else {
                0.0
            },
            spring: rng.random_range(0.5..2.0),
        };
        frame.lag_hz = None;
    }
    // Velocities would be of neither kind of rig that labs have most.
    let quantity = if rng.random_bool(0.6) { Quantity::Displacement } else { Quantity::Acceleration };
    let site = frame.site;
    let touched = |mass: usize| mass == site.mass || (site.joint && site.mass > 0 && mass == site.mass - 1);
    let sensed = |mass: &usize| match wanted.suite {
        Suite::Place => true,
        _ if wanted.elsewhere => !touched(*mass),
        _ => touched(*mass),
    };
    frame.sensors = (0..masses).filter(sensed).map(|mass| Sensor { mass, quantity }).collect();
    if frame.sensors.is_empty() {
        // A row of two that is joined has no mass elsewhere: one of the two is seen, their difference is not.
        frame.sensors.push(Sensor { mass: site.mass, quantity });
    }
    frame
}

/// A spring and a damper, or little more than a damper, between an actuator and a load cell.
fn specimen(rng: &mut impl Rng) -> Frame {
    let tau = std::f64::consts::TAU;
    let cell_hz = tau * rng.random_range(70.0..150.0);
    let stiffness = cell_hz * cell_hz * rng.random_range(0.01..0.1);
    // The frequency from which on the damper is the stronger part.
    let corner = tau * rng.random_range(2.0..40.0);
    Frame {
        control: Control::Specimen,
        masses: 1,
        mass: [1.0; MASSES],
        stiffness: [cell_hz * cell_hz; MASSES],
        damping: [2.0 * rng.random_range(0.02..0.1) * cell_hz; MASSES],
        driven: vec![0],
        // The displacement is measured: the specimen's end is nearly where it says.
        lag_hz: Some(rng.random_range(120.0..200.0)),
        sensors: vec![Sensor { mass: 0, quantity: Quantity::Force }],
        site: Site { mass: 0, joint: true },
        specimen: [stiffness, stiffness / corner],
        level: [1.0; 3],
        levels: Vec::new(),
    }
}
