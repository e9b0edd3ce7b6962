//! What a rig of the population has beyond its linear part: forces over a motion, and maps of a command or a sensor.
//! Lengths and velocities are in deviations of the motion in the linear rig.

use rand::{Rng, RngExt};
use rigcast::engine::diagnosis::Family;

/// Sliders of Iwan's chain.
pub const SLIDERS: usize = 5;

/// A force over a displacement `y` and its rate.
#[derive(Debug, Clone, Copy)]
pub enum Force {
    Hardening {
        bend: f64,
    },
    Softening {
        bend: f64,
    },
    SoftStops {
        gap: f64,
        width: f64,
    },
    Hertz {
        gap: f64,
    },
    Rattle {
        gap: f64,
    },
    Lopsided {
        bend: f64,
    },
    Arctangent {
        smooth: f64,
    },
    Dahl {
        length: f64,
    },
    Iwan {
        limits: [f64; SLIDERS],
    },
    /// Coleman and Hodgdon's: towards a curve that stiffens.
    Coleman {
        pace: f64,
        bend: f64,
    },
    Weakening {
        smooth: f64,
        peak: f64,
        decay: f64,
    },
    Power {
        exponent: f64,
    },
    Rebound {
        knee: f64,
    },
    BlowOff {
        knee: f64,
    },
    /// Beside the displacement `x` of another axis.
    Square,
    Product,
    Ramp,
    Settling,
    Pulsating {
        pace: f64,
    },
    Cogged {
        pitch: f64,
    },
    Unmeasured {
        pace: f64,
    },
}

/// What a force sees.
pub struct Now {
    pub y: f64,
    /// Rate in units of `y` a sample, and in its own deviations.
    pub rate: f64,
    pub v: f64,
    pub beside: f64,
    /// From 0 to 1 over the programme.
    pub clock: f64,
    pub sample: f64,
}

impl Force {
    /// Its value; `z` are states and `dz` their rates a sample.
    pub fn at(self, now: &Now, z: &[f64], dz: &mut [f64]) -> f64 {
        let Now { y, rate, v, beside, clock, sample } = *now;
        let soft = |t: f64, width: f64| width * (1.0 + (t / width).min(40.0).exp()).ln();
        match self {
            Self::Hardening { bend } => (bend * y).clamp(-6.0, 6.0).sinh() / bend - y,
            Self::Softening { bend } => (bend * y).tanh() / bend - y,
            Self::SoftStops { gap, width } => 3.0 * (soft(y - gap, width) - soft(-y - gap, width)),
            Self::Hertz { gap } => 2.0 * (y - gap).max(0.0).powf(1.5),
            Self::Rattle { gap } => -gap * (y / gap).tanh(),
            Self::Lopsided { bend } => (bend * y).min(4.0).exp_m1() / bend - y,
            Self::Arctangent { smooth } => (v / smooth).atan() / std::f64::consts::FRAC_PI_2,
            Self::Dahl { length } => {
                dz[0] = rate / length * (1.0 - z[0] * rate.signum());
                z[0]
            }
            Self::Iwan { limits } => {
                let mut force = 0.0;
                for ((z, dz), limit) in z.iter().zip(dz).zip(limits) {
                    *dz = if z.abs() >= limit && z * rate > 0.0 { 0.0 } else { rate };
                    force += z.clamp(-limit, limit);
                }
                1.5 * force / SLIDERS as f64
            }
            Self::Coleman { pace, bend } => {
                let curve = (bend * y).clamp(-4.0, 4.0).sinh() / bend;
                dz[0] = pace * rate.abs() * (curve - z[0]) + 0.2 * rate;
                z[0]
            }
            Self::Weakening { smooth, peak, decay } => {
                (v / smooth).atan() / std::f64::consts::FRAC_PI_2 * (1.0 + peak / (1.0 + (v / decay).powi(2)))
            }
            Self::Power { exponent } => v * v.abs().powf(exponent - 1.0),
            Self::Rebound { knee } => soft(v - knee, 0.05),
            Self::BlowOff { knee } => v / (1.0 + v.abs() / knee) - v,
            Self::Square => 1.0 - (1.2 * beside).cos(),
            Self::Product => y * beside.tanh(),
            Self::Ramp => clock.sqrt() * y,
            Self::Settling => (1.0 - (-3.0 * clock).exp()) * y,
            Self::Pulsating { pace } => (pace * sample).sin() * y,
            Self::Cogged { pitch } => (std::f64::consts::TAU * y / pitch).sin(),
            Self::Unmeasured { pace } => (pace * sample + 2.0 * (0.13 * pace * sample).sin()).sin(),
        }
    }

    /// Its family; of those that the catalogue lacks none.
    pub fn family(self) -> Option<Family> {
        match self {
            Self::Hardening { .. } | Self::Softening { .. } | Self::SoftStops { .. } => {
                Some(Family::Stiffness)
            }
            Self::Hertz { .. } | Self::Rattle { .. } | Self::Lopsided { .. } => Some(Family::Stiffness),
            Self::Arctangent { .. } | Self::Dahl { .. } => Some(Family::FrictionHysteresis),
            Self::Iwan { .. } | Self::Coleman { .. } => Some(Family::FrictionHysteresis),
            Self::Weakening { .. } => Some(Family::FrictionHysteresis),
            Self::Power { .. } | Self::Rebound { .. } | Self::BlowOff { .. } => Some(Family::Damping),
            Self::Square | Self::Product => Some(Family::CrossAxis),
            Self::Ramp | Self::Settling => Some(Family::TimeVariance),
            Self::Pulsating { .. } | Self::Cogged { .. } | Self::Unmeasured { .. } => None,
        }
    }

    pub fn stiffness(rng: &mut impl Rng) -> Self {
        match rng.random_range(0..6) {
            0 => Self::Hardening { bend: rng.random_range(0.6..1.4) },
            1 => Self::Softening { bend: rng.random_range(0.6..2.0) },
            2 => Self::SoftStops { gap: rng.random_range(0.6..1.9), width: rng.random_range(0.02..0.2) },
            3 => Self::Hertz { gap: rng.random_range(-0.5..1.6) },
            4 => Self::Rattle { gap: rng.random_range(0.15..1.0) },
            _ => Self::Lopsided { bend: rng.random_range(0.25..0.7) },
        }
    }

    pub fn friction(rng: &mut impl Rng) -> Self {
        match rng.random_range(0..5) {
            0 => Self::Arctangent { smooth: rng.random_range(0.02..0.15) },
            1 => Self::Dahl { length: rng.random_range(0.05..0.6) },
            2 => Self::Iwan { limits: std::array::from_fn(|_| rng.random_range(0.05..1.6)) },
            3 => Self::Coleman { pace: rng.random_range(0.6..3.0), bend: rng.random_range(0.3..0.7) },
            _ => Self::Weakening {
                smooth: rng.random_range(0.02..0.1),
                peak: rng.random_range(0.3..1.5),
                decay: rng.random_range(0.2..0.8),
            },
        }
    }

    pub fn damping(rng: &mut impl Rng) -> Self {
        match rng.random_range(0..3) {
            0 => Self::Power { exponent: rng.random_range(1.6..2.6) },
            1 => Self::Rebound { knee: rng.random_range(-0.5..0.8) },
            _ => Self::BlowOff { knee: rng.random_range(0.4..2.0) },
        }
    }

    pub fn cross_axis(rng: &mut impl Rng) -> Self {
        if rng.random_bool(0.5) { Self::Square } else { Self::Product }
    }

    pub fn drift(rng: &mut impl Rng) -> Self {
        if rng.random_bool(0.5) { Self::Ramp } else { Self::Settling }
    }

    pub fn outside(rng: &mut impl Rng) -> Self {
        match rng.random_range(0..3) {
            0 => Self::Pulsating { pace: rng.random_range(0.05..0.6) },
            1 => Self::Cogged { pitch: rng.random_range(0.4..1.2) },
            _ => Self::Unmeasured { pace: rng.random_range(0.05..0.8) },
        }
    }
}

/// What becomes of a command, sample by sample, in its deviations.
#[derive(Debug, Clone, Copy)]
pub enum Command {
    Plain,
    Bounded { at: f64 },
    OneBound { at: f64 },
    Bent { bend: f64 },
    Slow { rate: f64 },
    Overlap { at: f64 },
    Dead { at: f64, leak: f64 },
    Play { width: f64 },
}

impl Command {
    pub fn apply(self, u: &[f64]) -> Vec<f64> {
        let mut held = u.first().copied().unwrap_or(0.0);
        u.iter().map(|&u| self.at(u, &mut held)).collect()
    }

    /// One sample, with what the map holds.
    pub fn at(self, u: f64, held: &mut f64) -> f64 {
        match self {
            Self::Plain => u,
            Self::Bounded { at } => at * (u / at).tanh(),
            Self::OneBound { at } => u.min(at) + 0.03 * (u - at).max(0.0),
            Self::Bent { bend } => (bend * u).min(4.0).exp_m1() / bend,
            Self::Slow { rate } => {
                *held += rate * ((u - *held) / rate).tanh();
                *held
            }
            Self::Overlap { at } => u - at * (u / at).tanh(),
            Self::Dead { at, leak } => u - (1.0 - leak) * u.clamp(-at, at),
            Self::Play { width } => {
                *held = held.clamp(u - width, u + width);
                *held + 0.05 * (u - *held)
            }
        }
    }

    pub fn family(self) -> Option<Family> {
        match self {
            Self::Plain => None,
            Self::Bounded { .. } | Self::OneBound { .. } | Self::Bent { .. } | Self::Slow { .. } => {
                Some(Family::Actuator)
            }
            Self::Overlap { .. } | Self::Dead { .. } | Self::Play { .. } => Some(Family::DeadbandBacklash),
        }
    }

    /// `step` is the deviation of the command's differences.
    pub fn actuator(step: f64, rng: &mut impl Rng) -> Self {
        match rng.random_range(0..4) {
            0 => Self::Bounded { at: rng.random_range(0.8..2.5) },
            1 => Self::OneBound { at: rng.random_range(0.5..1.8) },
            2 => Self::Bent { bend: rng.random_range(0.1..0.5) },
            _ => Self::Slow { rate: step * rng.random_range(0.6..1.8) },
        }
    }

    /// Of a valve, which holds nothing.
    pub fn valve(rng: &mut impl Rng) -> Self {
        match rng.random_range(0..5) {
            0 => Self::Bounded { at: rng.random_range(0.8..2.5) },
            1 => Self::OneBound { at: rng.random_range(0.5..1.8) },
            2 => Self::Bent { bend: rng.random_range(0.1..0.5) },
            3 => Self::Overlap { at: rng.random_range(0.1..0.8) },
            _ => Self::Dead { at: rng.random_range(0.1..0.8), leak: rng.random_range(0.0..0.2) },
        }
    }

    pub fn deadband(rng: &mut impl Rng) -> Self {
        match rng.random_range(0..3) {
            0 => Self::Overlap { at: rng.random_range(0.05..0.5) },
            1 => Self::Dead { at: rng.random_range(0.05..0.5), leak: rng.random_range(0.0..0.2) },
            _ => Self::Play { width: rng.random_range(0.05..0.5) },
        }
    }
}

/// What becomes of a response in its sensor, in its deviations.
#[derive(Debug, Clone, Copy)]
pub enum Sensor {
    Plain,
    Compressed { at: f64 },
    Cut { at: f64 },
    Bowed { bend: f64 },
}

impl Sensor {
    pub fn apply(self, y: f64) -> f64 {
        match self {
            Self::Plain => y,
            Self::Compressed { at } => at * (y / at).atan(),
            Self::Cut { at } => y.min(at),
            Self::Bowed { bend } => y + bend * y * y / (1.0 + 0.05 * y * y),
        }
    }

    pub fn family(self) -> Option<Family> {
        (!matches!(self, Self::Plain)).then_some(Family::Sensor)
    }

    pub fn some(rng: &mut impl Rng) -> Self {
        match rng.random_range(0..3) {
            0 => Self::Compressed { at: rng.random_range(1.0..3.0) },
            1 => Self::Cut { at: rng.random_range(0.8..2.0) },
            _ => Self::Bowed { bend: rng.random_range(0.05..0.4) },
        }
    }
}
