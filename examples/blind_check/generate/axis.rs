//! One axis of a rig: a row of masses behind an actuator.

use rand::{Rng, RngExt};

use super::flaw::{Flaw, Placed};

/// Most masses in a row.
pub const MASSES: usize = 3;

pub const LAG: usize = 2 * MASSES;
pub const HYSTERESIS: usize = LAG + 1;
pub const INNER: usize = HYSTERESIS + 1;
pub const POLE: usize = INNER + 2;
pub const TWIST: usize = POLE + 1;
/// States of one axis.
pub const STATES: usize = TWIST + 1;

/// A row of masses with an actuator.
#[derive(Debug, Clone)]
pub struct Axis {
    pub masses: usize,
    pub mass: [f64; MASSES],
    pub stiffness: [f64; MASSES],
    pub damping: [f64; MASSES],
    pub driven: usize,
    pub seen: usize,
    pub lag_hz: Option<f64>,
    /// Corner of a second-order filter before the row, of rigs that may be a sandwich.
    pub before_hz: Option<f64>,
    /// Gain of each other drive on this axis.
    pub coupling: Vec<f64>,
    /// RMS of the seen displacement, its velocity, its elastic force and the measured force.
    pub level: [f64; 4],
}

impl Axis {
    pub fn draw(rng: &mut impl Rng, drives: usize, own: usize, flaw: Flaw) -> Self {
        let masses = [1, 2, 2, 3][rng.random_range(0..4)];
        let lowest = rng.random_range(4.0..12.0);
        let filtered = matches!(flaw, Flaw::Sandwich { .. });
        // Coupled already, a stronger coupling would be the second drive's gain.
        let most = if flaw == Flaw::CrossLinear { 1e-9 } else { 0.3 };
        let mut axis = Self {
            masses,
            mass: [1.0; MASSES],
            stiffness: [0.0; MASSES],
            damping: [0.0; MASSES],
            driven: rng.random_range(0..masses),
            seen: 0,
            lag_hz: rng.random_bool(0.5).then(|| rng.random_range(20.0..80.0)),
            before_hz: filtered.then(|| rng.random_range(6.0..20.0)),
            coupling: (0..drives).map(|d| if d == own { 1.0 } else { rng.random_range(0.0..most) }).collect(),
            level: [1.0; 4],
        };
        axis.seen = if rng.random_bool(0.6) { axis.driven } else { rng.random_range(0..masses) };
        for i in 0..masses {
            axis.mass[i] = rng.random_range(0.4..1.6);
            let hz = lowest * if i == 0 { 1.3 } else { rng.random_range(1.0..2.5) };
            [axis.stiffness[i], axis.damping[i]] =
                spring_and_damper(axis.mass[i], hz, rng.random_range(0.015..0.08));
        }
        axis
    }

    /// Force in the spring and damper below mass `i`.
    pub fn below(&self, q: &[f64], i: usize) -> f64 {
        let (xp, vp) = if i == 0 { (0.0, 0.0) } else { (q[i - 1], q[MASSES + i - 1]) };
        self.stiffness[i] * (q[i] - xp) + self.damping[i] * (q[MASSES + i] - vp)
    }

    /// Number of natural frequencies below `hz`: Sturm's count of the row's matrix.
    pub fn modes_below(&self, hz: f64) -> usize {
        let w2 = (std::f64::consts::TAU * hz).powi(2);
        let (mut below, mut pivot) = (0, 1.0_f64);
        for i in 0..self.masses {
            let above = if i + 1 < self.masses { self.stiffness[i + 1] } else { 0.0 };
            let beside = if i == 0 { 0.0 } else { self.stiffness[i].powi(2) };
            pivot = self.stiffness[i] + above - w2 * self.mass[i] - beside / pivot;
            below += usize::from(pivot < 0.0);
        }
        below
    }
}

/// Stiffness and damping below a mass that has this natural frequency and ratio of damping on them.
pub fn spring_and_damper(mass: f64, hz: f64, ratio: f64) -> [f64; 2] {
    let w = std::f64::consts::TAU * hz;
    [mass * w * w, 2.0 * ratio * mass * w]
}

/// The response of an actuator to its command.
pub fn actuator<'a>(
    axis: &Axis,
    q: &[f64],
    d: &mut [f64],
    command: f64,
    flaws: impl Iterator<Item = &'a Placed> + Clone,
) -> f64 {
    let tau = std::f64::consts::TAU;
    let y = q[axis.seen] / axis.level[0];
    let mut u = command;
    for p in flaws.clone().filter(|p| p.flaw == Flaw::ExtraPole) {
        let w = tau * 200.0 / (1.0 + 100.0 * p.strength);
        d[POLE] = w * (u - q[POLE]);
        u = q[POLE];
    }
    if let Some(hz) = axis.before_hz {
        let w = tau * hz;
        d[INNER] = q[INNER + 1];
        d[INNER + 1] = w * w * (u - q[INNER]) - 2.0 * 0.4 * w * q[INNER + 1];
        u = q[INNER];
    }
    for p in flaws {
        let s = p.strength;
        let flow = |u: f64| u * (1.0 - (s * y * u.signum()).clamp(-3.0, 0.98)).sqrt();
        match p.flaw {
            Flaw::Sandwich { odd: true } => u -= s * u.powi(3) / (1.0 + u * u),
            Flaw::Sandwich { odd: false } => u += s * u * u,
            Flaw::ValveFlow => u = flow(u),
            Flaw::LeakingFlow { leak } => u = flow(u) - leak * s * y,
            _ => {}
        }
    }
    if let Some(hz) = axis.lag_hz {
        d[LAG] = tau * hz * (u - q[LAG]);
        u = q[LAG];
    }
    u
}
