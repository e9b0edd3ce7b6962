//! What a frame has beyond its linear part: three equations or more for each effect, none as the catalogue writes it.

use std::f64::consts::TAU;

use rand::{Rng, RngExt};

/// Inner states of a law.
pub const MEMORY: usize = 4;

/// A law; forces are in units of the elastic force at its place, motions in units of their deviations there.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Law {
    Nothing,
    // Forces of a motion.
    Quintic,
    Sinh {
        sharpness: f64,
    },
    Softening,
    SoftStop {
        gap: f64,
        width: f64,
    },
    HertzStop {
        gap: f64,
    },
    OneSidedStop {
        gap: f64,
        width: f64,
        side: f64,
    },
    SmoothGap {
        gap: f64,
    },
    RationalGap {
        gap: f64,
    },
    TanhFriction {
        width: f64,
    },
    RationalFriction {
        width: f64,
        peak: f64,
    },
    Dahl {
        length: f64,
    },
    /// Springs that slip, side by side.
    Iwan {
        length: f64,
    },
    CubicDamping,
    Orifice {
        power: f64,
    },
    BumpAndRebound {
        ratio: f64,
    },
    // Laws of a command.
    SoftLimit {
        skew: f64,
    },
    EarlyLimit {
        power: f64,
    },
    ExponentialLimit,
    /// The flow through a valve falls with the load.
    LoadedFlow {
        leak: f64,
    },
    LoadedFlowBoth,
    SmoothDeadZone {
        width: f64,
    },
    RationalDeadZone,
    ElasticBacklash {
        rate: f64,
    },
    // Laws of a sensor.
    SensorArctan,
    SensorExponential,
    SensorPolynomial {
        even: f64,
    },
}

/// A law with the contract's name of the effect that it is nearest to.
#[derive(Debug, Clone, Copy)]
pub struct Named {
    pub law: Law,
    pub effect: &'static str,
    pub family: Option<&'static str>,
}

/// No law.
pub const NOTHING: Named = Named { law: Law::Nothing, effect: "nothing", family: None };

fn named(family: &'static str, effect: &'static str, law: Law) -> Named {
    Named { law, effect, family: Some(family) }
}

/// Laws of a structure: stiffness, friction and damping.
pub fn of_structure(rng: &mut impl Rng) -> Vec<Named> {
    let gap = rng.random_range(0.5..1.4);
    let width = rng.random_range(0.05..0.2);
    let side = if rng.random_bool(0.5) { 1.0 } else { -1.0 };
    let small = rng.random_range(0.05..0.3);
    let stiffness = |effect, law| named("stiffness", effect, law);
    let friction = |effect, law| named("friction_hysteresis", effect, law);
    let damping = |law| named("damping", "quadratic_damping", law);
    vec![
        stiffness("cubic_stiffness", Law::Quintic),
        friction("coulomb_friction", Law::TanhFriction { width: rng.random_range(0.03..0.2) }),
        stiffness("clearance", Law::SmoothGap { gap: 0.7 * gap }),
        damping(Law::Orifice { power: rng.random_range(1.5..1.8) }),
        friction("bouc_wen_hysteresis", Law::Iwan { length: rng.random_range(0.3..1.2) }),
        stiffness("bump_stop", Law::SoftStop { gap, width }),
        damping(Law::CubicDamping),
        friction("bouc_wen_hysteresis", Law::Dahl { length: small }),
        stiffness("cubic_stiffness", Law::Softening),
        stiffness("one_sided_stop", Law::OneSidedStop { gap, width, side }),
        friction(
            "stribeck_friction",
            Law::RationalFriction { width: rng.random_range(0.02..0.08), peak: rng.random_range(0.3..1.2) },
        ),
        stiffness("clearance", Law::RationalGap { gap: 0.7 * gap }),
        damping(Law::BumpAndRebound { ratio: rng.random_range(1.5..4.0) }),
        stiffness("cubic_stiffness", Law::Sinh { sharpness: rng.random_range(0.8..1.5) }),
        stiffness("bump_stop", Law::HertzStop { gap }),
    ]
}

/// Laws of a drive and of a sensor.
pub fn of_drives_and_sensors(rng: &mut impl Rng) -> Vec<Named> {
    let actuator = |effect, law| named("actuator", effect, law);
    let deadband = |effect, law| named("deadband_backlash", effect, law);
    let sensor = |effect, law| named("sensor", effect, law);
    vec![
        actuator("drive_saturation", Law::SoftLimit { skew: rng.random_range(0.6..1.5) }),
        deadband("dead_zone", Law::SmoothDeadZone { width: rng.random_range(0.05..0.2) }),
        sensor("sensor_saturation", Law::SensorArctan),
        actuator("valve_flow", Law::LoadedFlow { leak: rng.random_range(0.0..0.3) }),
        deadband("backlash", Law::ElasticBacklash { rate: rng.random_range(0.3..0.8) }),
        sensor("sensor_nonlinearity", Law::SensorPolynomial { even: rng.random_range(-1.0..1.0) }),
        actuator("drive_saturation", Law::EarlyLimit { power: rng.random_range(1.5..4.0) }),
        deadband("dead_zone", Law::RationalDeadZone),
        sensor("sensor_saturation", Law::SensorExponential),
        actuator("valve_flow", Law::LoadedFlowBoth),
        actuator("drive_saturation", Law::ExponentialLimit),
    ]
}

impl Law {
    /// Whether it is a force between two points of the frame.
    pub fn is_force(self) -> bool {
        !self.is_of_command() && !self.is_of_sensor() && self != Self::Nothing
    }

    /// Whether it acts on a command.
    pub fn is_of_command(self) -> bool {
        self.is_static_of_command() || self.is_of_flow() || matches!(self, Self::ElasticBacklash { .. })
    }

    fn is_static_of_command(self) -> bool {
        matches!(
            self,
            Self::SoftLimit { .. }
                | Self::EarlyLimit { .. }
                | Self::ExponentialLimit
                | Self::SmoothDeadZone { .. }
                | Self::RationalDeadZone
        )
    }

    /// Whether it is a valve's flow under load.
    pub fn is_of_flow(self) -> bool {
        matches!(self, Self::LoadedFlow { .. } | Self::LoadedFlowBoth)
    }

    fn is_of_sensor(self) -> bool {
        matches!(self, Self::SensorArctan | Self::SensorExponential | Self::SensorPolynomial { .. })
    }

    /// Force of the displacement `y` and the velocity `v`, each in units of its deviation; `rate` is the velocity in
    /// deviations of the displacement a second. `z` are the inner states, `dz` their slopes.
    pub fn force(self, y: f64, v: f64, rate: f64, z: &[f64; MEMORY], dz: &mut [f64; MEMORY]) -> f64 {
        let softplus = |x: f64, w: f64| w * if x > 30.0 * w { x / w } else { (x / w).exp().ln_1p() };
        match self {
            Self::Quintic => y.powi(5) / 6.0,
            Self::Sinh { sharpness } => ((sharpness * y).sinh() / sharpness - y).clamp(-50.0, 50.0),
            Self::Softening => y.tanh() - y,
            Self::SoftStop { gap, width } => 3.0 * (softplus(y - gap, width) - softplus(-y - gap, width)),
            Self::HertzStop { gap } => 4.0 * (y.abs() - gap).max(0.0).powf(1.5) * y.signum(),
            Self::OneSidedStop { gap, width, side } => 4.0 * side * softplus(side * y - gap, width),
            Self::SmoothGap { gap } => -gap * (y / gap).tanh(),
            Self::RationalGap { gap } => -y / (1.0 + (y / gap).powi(2)).sqrt(),
            Self::TanhFriction { width } => (v / width).tanh(),
            Self::RationalFriction { width, peak } => {
                v / (v.abs() + width) * (1.0 + peak / (1.0 + (v / 0.4).powi(2)))
            }
            Self::Dahl { length } => {
                dz[0] = rate / length * (1.0 - z[0] * rate.signum());
                z[0]
            }
            Self::Iwan { length } => {
                let mut sum = 0.0;
                for (i, limit) in [0.25, 0.6, 1.1, 2.0].into_iter().enumerate() {
                    let slips = z[i].abs() >= limit && z[i] * rate > 0.0;
                    dz[i] = if slips { 0.0 } else { rate / length };
                    sum += 0.25 * z[i].clamp(-limit, limit);
                }
                sum
            }
            Self::CubicDamping => v.powi(3) / 3.0,
            Self::Orifice { power } => v.signum() * v.abs().powf(power),
            Self::BumpAndRebound { ratio } => {
                if v > 0.0 {
                    ratio * v
                } else {
                    v
                }
            }
            _ => 0.0,
        }
    }

    /// A command with the law's bend of strength `s`; in units of its deviation.
    pub fn command(self, u: f64, s: f64) -> f64 {
        match self {
            Self::SoftLimit { skew } => {
                let limit = if u > 0.0 { 3.0 / (1.0 + 4.0 * s) } else { 3.0 * skew / (1.0 + 4.0 * s) };
                limit * (u / limit).atan()
            }
            Self::EarlyLimit { power } => {
                u / (1.0 + (0.3 * (1.0 + 3.0 * s) * u.abs()).powf(power)).powf(1.0 / power)
            }
            Self::ExponentialLimit => u.signum() * (1.0 - (-s * u.abs()).exp()) / s.max(1e-9),
            Self::SmoothDeadZone { width } => u - s * (u / (width + s)).tanh(),
            Self::RationalDeadZone => u - s * u / (u.abs() + 0.3 * s),
            _ => u,
        }
    }

    /// Slope of what follows the command `u` through an elastic play of half-width `s`, at `w`.
    pub fn follows(self, u: f64, w: f64, s: f64, samples_a_second: f64) -> Option<f64> {
        let Self::ElasticBacklash { rate } = self else { return None };
        let apart = u - w;
        Some(rate * samples_a_second * (apart - apart.clamp(-s, s)))
    }

    /// Flow of a valve whose opening is `e`, under the load `f`, in units of their deviations.
    pub fn flow(self, e: f64, f: f64, s: f64) -> f64 {
        match self {
            Self::LoadedFlow { leak } => {
                e * (1.0 - (0.5 * s * f * e.signum()).clamp(-3.0, 0.97)).sqrt() - leak * s * f
            }
            Self::LoadedFlowBoth => e * (1.0 - (0.3 * s * f * e.signum()).tanh()).sqrt(),
            _ => e,
        }
    }

    /// What a sensor makes of a response, both in units of its deviation.
    pub fn sensed(self, y: f64, s: f64) -> f64 {
        match self {
            Self::SensorArctan => (s * y).atan() / s.max(1e-9),
            Self::SensorExponential => y.signum() * (1.0 - (-s * y.abs()).exp()) / s.max(1e-9),
            Self::SensorPolynomial { even } => {
                y + 0.3 * s * (even * y * y.abs().sqrt() * y.signum() + (TAU * y / 9.0).sin())
            }
            _ => y,
        }
    }
}
