//! The catalogue's laws as signals of a motion.
//!
//! Lengths and velocities in a law are in deviations of its argument over all groups. A signal that a linear
//! part can add is not part of a law: a clearance and a clip of one kink span the same space beside the
//! displacement itself, as do a slider and a play; the sign of their coefficient names them.

use serde::{Deserialize, Serialize};

use super::memory::{bouc_wen, slew, slider};
use super::motion::Motion;

/// A law with its numbers.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Law {
    /// `d^3`.
    Cubic,
    /// `d^2`.
    Quadratic,
    /// `d^2` and `d^3`.
    Polynomial,
    /// `clip(d, +-at)`: another slope inside `at` than outside.
    Kink {
        /// Displacement of the kink.
        at: f64,
    },
    /// `max(d - at, 0)`: another slope beyond `at` on one side.
    OneSided {
        /// Displacement of the kink, either sign.
        at: f64,
    },
    /// Kinks at five places, each with a slope of its own.
    FreeStiffness,
    /// `tanh(v / smooth)`.
    Coulomb {
        /// Velocity at which friction is nearly whole.
        smooth: f64,
    },
    /// Coulomb's friction and another that falls off with velocity, `tanh(v / smooth) exp(-|v| / decay)`.
    Stribeck {
        /// Velocity at which friction is nearly whole.
        smooth: f64,
        /// Velocity over which the second part falls off.
        decay: f64,
    },
    /// Spring and dry friction in series (Jenkins), the stop operator.
    Slider {
        /// Displacement at which it slips.
        limit: f64,
    },
    /// Several sliders (Prandtl and Ishlinskii).
    FreeHysteresis,
    /// The hysteretic displacement of Bouc and Wen.
    BoucWen {
        /// Displacement at which it yields.
        limit: f64,
    },
    /// `v |v|`.
    QuadraticDamping,
    /// `max(v - at, 0)`: another damping beyond a velocity on one side.
    OneSidedDamping {
        /// Velocity of the kink, either sign.
        at: f64,
    },
    /// `clip(v, +-at)`: damping that gives way beyond a velocity.
    KinkedDamping {
        /// Velocity of the kink.
        at: f64,
    },
    /// Kinks at five velocities, each with a damping of its own.
    FreeDamping,
    /// Follows the argument at a limited rate.
    RateLimit {
        /// Largest rate.
        limit: f64,
    },
    /// What a valve's square-root flow loses to the load, to second order: `|u| y` and `u y^2`; the argument
    /// is the drive, the other place the load's.
    ValveFlow,
    /// `x^2` and `y x` of another place's displacement `x`.
    CrossAxisKinematic,
    /// `t d`: a stiffness or gain that drifts.
    StiffnessDrift,
    /// The linear part's output bent by a kink at either side or squared, and filtered again
    /// (linear, static, linear).
    Sandwich,
}

/// Deviations and centre of an argument over all groups.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Scale {
    pub centre: f64,
    pub d: f64,
    pub v: f64,
}

/// Where free shapes have their kinks, in deviations.
const KINKS: [f64; 5] = [-1.5, -0.6, 0.0, 0.6, 1.5];
/// Where several sliders slip.
const LIMITS: [f64; 4] = [0.1, 0.35, 1.0, 2.5];

impl Law {
    /// Signals over one record. `clock` goes from the first of all samples, 0, to the last, 1; `other` is the
    /// other place's displacement of a law of two, in its own deviations.
    pub(super) fn signals(
        self,
        motion: &Motion,
        scale: Scale,
        rate_hz: f64,
        clock: [f64; 2],
        other: Option<&[f64]>,
    ) -> Vec<Vec<f64>> {
        let d: Vec<f64> = motion.d.iter().map(|d| (d - scale.centre) / scale.d).collect();
        let v = || motion.v.iter().map(|v| v / scale.v);
        let of_d = |f: &dyn Fn(f64) -> f64| vec![d.iter().map(|d| f(*d)).collect::<Vec<f64>>()];
        let of_v = |f: &dyn Fn(f64) -> f64| vec![v().map(f).collect::<Vec<f64>>()];
        let beside = other.unwrap_or(&[]);
        let product = |f: &dyn Fn(f64, f64) -> f64| -> Vec<f64> {
            d.iter().zip(beside).map(|(d, x)| f(*d, *x)).collect()
        };
        match self {
            Self::Cubic => of_d(&|d| d * d * d),
            Self::Quadratic => of_d(&|d| d * d),
            Self::Polynomial => [of_d(&|d| d * d), of_d(&|d| d * d * d)].concat(),
            Self::Kink { at } => of_d(&|d| d.clamp(-at, at)),
            Self::OneSided { at } => of_d(&|d| (d - at).max(0.0)),
            Self::FreeStiffness => KINKS.iter().flat_map(|at| of_d(&|d| (d - at).max(0.0))).collect(),
            Self::Coulomb { smooth } => of_v(&|v| (v / smooth).tanh()),
            Self::Stribeck { smooth, decay } => {
                let falling = |v: f64| (v / smooth).tanh() * (-v.abs() / decay).exp();
                [of_v(&|v| (v / smooth).tanh()), of_v(&falling)].concat()
            }
            Self::Slider { limit } => vec![slider(&d, limit)],
            Self::FreeHysteresis => LIMITS.iter().map(|limit| slider(&d, *limit)).collect(),
            Self::BoucWen { limit } => vec![bouc_wen(&d, limit)],
            Self::QuadraticDamping => of_v(&|v| v * v.abs()),
            Self::OneSidedDamping { at } => of_v(&|v| (v - at).max(0.0)),
            Self::KinkedDamping { at } => of_v(&|v| v.clamp(-at, at)),
            Self::FreeDamping => KINKS.iter().flat_map(|at| of_v(&|v| (v - at).max(0.0))).collect(),
            Self::RateLimit { limit } => vec![slew(&d, limit * scale.v / (scale.d * rate_hz))],
            Self::ValveFlow => vec![product(&|u, y| u.abs() * y), product(&|u, y| u * y * y)],
            Self::CrossAxisKinematic => vec![product(&|_, x| x * x), product(&|y, x| y * x)],
            Self::StiffnessDrift => {
                let step = (clock[1] - clock[0]) / d.len().max(1) as f64;
                vec![d.iter().enumerate().map(|(k, d)| d * (clock[0] + step * k as f64)).collect()]
            }
            Self::Sandwich => {
                [of_d(&|d| d * d), of_d(&|d| d.max(0.0)), of_d(&|d| d.clamp(-1.0, 1.0))].concat()
            }
        }
    }

    /// The law with its number `factor` times as large; `None` of a law without one.
    pub(super) fn scaled(self, factor: f64) -> Option<Self> {
        Some(match self {
            Self::Kink { at } => Self::Kink { at: at * factor },
            Self::OneSided { at } => Self::OneSided { at: at * factor },
            Self::Coulomb { smooth } => Self::Coulomb { smooth: smooth * factor },
            Self::Stribeck { smooth, decay } => Self::Stribeck { smooth, decay: decay * factor },
            Self::Slider { limit } => Self::Slider { limit: limit * factor },
            Self::BoucWen { limit } => Self::BoucWen { limit: limit * factor },
            Self::OneSidedDamping { at } => Self::OneSidedDamping { at: at * factor },
            Self::KinkedDamping { at } => Self::KinkedDamping { at: at * factor },
            Self::RateLimit { limit } => Self::RateLimit { limit: limit * factor },
            _ => return None,
        })
    }

    /// Whether its signals hold a response beside the drive that it acts on.
    pub(super) fn loaded(self) -> bool {
        self == Self::ValveFlow
    }

    /// Laws of a displacement that are forces.
    pub(super) fn stiffness() -> Vec<Self> {
        let mut laws = vec![Self::Cubic, Self::Quadratic, Self::Polynomial, Self::FreeStiffness];
        laws.extend([0.06, 0.12, 0.22, 0.35, 0.5, 0.7, 1.0, 1.35, 1.8, 2.4, 3.2].map(|at| Self::Kink { at }));
        laws.extend([-2.2, -1.4, -0.7, -0.3, 0.0, 0.3, 0.7, 1.4, 2.2].map(|at| Self::OneSided { at }));
        laws
    }

    /// Laws of dry friction and hysteresis.
    pub(super) fn friction() -> Vec<Self> {
        let mut laws: Vec<Self> = Self::sliding();
        laws.extend([0.01, 0.03, 0.1, 0.25].map(|smooth| Self::Coulomb { smooth }));
        laws.extend([0.2, 0.7].map(|decay| Self::Stribeck { smooth: 0.04, decay }));
        laws
    }

    /// Laws of hysteresis, which need no velocity.
    pub(super) fn sliding() -> Vec<Self> {
        let mut laws = vec![Self::FreeHysteresis];
        laws.extend([0.02, 0.06, 0.15, 0.35, 0.8, 1.5, 2.5].map(|limit| Self::Slider { limit }));
        laws.extend([0.1, 0.3, 1.0].map(|limit| Self::BoucWen { limit }));
        laws
    }

    /// Laws of damping.
    pub(super) fn damping() -> Vec<Self> {
        let mut laws = vec![Self::QuadraticDamping, Self::FreeDamping];
        laws.extend([-1.0, 0.0, 1.0].map(|at| Self::OneSidedDamping { at }));
        laws.extend([0.5, 1.0, 1.8].map(|at| Self::KinkedDamping { at }));
        laws
    }

    /// Limits of rate.
    pub(super) fn rate_limits() -> Vec<Self> {
        [0.4, 0.7, 1.0, 1.4, 1.9, 2.6].map(|limit| Self::RateLimit { limit }).to_vec()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn signals(law: Law, d: &[f64], v: &[f64], other: Option<&[f64]>) -> Vec<Vec<f64>> {
        let motion = Motion { d: d.to_vec(), v: v.to_vec() };
        law.signals(&motion, Scale { centre: 1.0, d: 2.0, v: 4.0 }, 10.0, [0.5, 1.0], other)
    }

    #[test]
    fn laws_see_the_argument_about_its_centre_and_in_its_deviations() {
        let (d, v) = ([1.0, 3.0, -3.0], [0.0, 8.0, -2.0]);
        assert_eq!(signals(Law::Cubic, &d, &v, None), [[0.0, 1.0, -8.0]]);
        assert_eq!(signals(Law::Kink { at: 0.5 }, &d, &v, None), [[0.0, 0.5, -0.5]]);
        assert_eq!(signals(Law::OneSided { at: -1.0 }, &d, &v, None), [[1.0, 2.0, 0.0]]);
        assert_eq!(signals(Law::QuadraticDamping, &d, &v, None), [[0.0, 4.0, -0.25]]);
        assert_eq!(
            signals(Law::ValveFlow, &d, &v, Some(&[1.0, 2.0, 3.0])),
            [[0.0, 2.0, 6.0], [0.0, 4.0, -18.0]]
        );
        let drift = &signals(Law::StiffnessDrift, &d, &v, None)[0];
        assert!(
            (drift[1] - 2.0 / 3.0).abs() < 1e-12 && (drift[2] + 2.0 * 5.0 / 6.0).abs() < 1e-12,
            "{drift:?}"
        );
    }

    #[test]
    fn a_rate_limit_counts_in_deviations_of_the_rate() {
        let limited = &signals(Law::RateLimit { limit: 1.0 }, &[1.0, 5.0, 5.0], &[0.0; 3], None)[0];
        // 4 a second in units of 2 at 10 Hz.
        assert!((limited[1] - 0.2).abs() < 1e-12 && (limited[2] - 0.4).abs() < 1e-12, "{limited:?}");
    }
}
