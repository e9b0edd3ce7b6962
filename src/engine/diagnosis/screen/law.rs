//! The catalogue's laws as signals of a motion.
//!
//! Lengths and velocities in a law are in deviations of its argument over all groups. A signal that a linear
//! part can add is not part of a law: a clearance and a clip of one kink span the same space beside the
//! displacement itself, as do a slider and a play; the sign of their coefficient names them.

use serde::{Deserialize, Serialize};

use super::front::Front;
use super::memory::{Memory, slide, yielding};
use super::motion::Motion;
use super::place::Argument;

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
    /// `d - clip(d, +-at)`: the same, where no linear part takes what is missing.
    Gap {
        /// Displacement of the kink.
        at: f64,
    },
    /// `max(d - at, 0)`: another slope beyond `at` on one side.
    OneSided {
        /// Displacement of the kink, either sign.
        at: f64,
    },
    /// `min(d - at, 0)`: the same as beyond a place on one side, where no linear part takes what is missing.
    OneSidedBelow {
        /// Displacement of the kink.
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
        /// 0: it is unloaded along a straight line; below 0 more steeply, and below -1 it stiffens as it is loaded; see
        /// `yielding` in `memory.rs`.
        #[serde(default)]
        unloading: f64,
    },
    /// `v |v|`.
    QuadraticDamping,
    /// `v |v|^(exponent - 1)`.
    PowerDamping {
        /// Power of the velocity.
        exponent: f64,
    },
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
    /// `min(v - at, 0)`: the same as beyond a velocity on one side, where no linear part takes what is missing.
    OneSidedDampingBelow {
        /// Velocity of the kink.
        at: f64,
    },
    /// `v - clip(v, +-at)`: the same as damping that gives way, where no linear part takes what is missing.
    DampingBeyond {
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
    /// A drive that is filtered, bent and filtered again (Wiener and Hammerstein).
    Block {
        /// The filter ahead of the bend.
        front: Front,
        /// Number of kinks of the bend.
        kinks: usize,
    },
    /// The same with a bend that is known, as far as a straight line can be added.
    Bent {
        /// The filter ahead of the bend.
        front: Front,
        /// What the slope changes by at each kink.
        bend: [f64; KINKS_OF_BEND],
    },
}

/// Kinks of a bend that is known.
pub(super) const KINKS_OF_BEND: usize = 25;

/// How signals over a drive reach a response; elsewhere there is one way.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Way {
    /// Directly, and through the drive's impulse response.
    Plain,
    /// The signals hold a response too, and enter through the drive's dynamics only.
    Loaded,
    /// The signals are behind a filter, and leave through what the drive's impulse response has beyond it.
    Behind,
    /// The signal is all of the law, and leaves through a filter of its own that is set as the linear part is.
    Free,
    /// The signals move every mode of the linear part by factors of their own, as a force does that acts elsewhere than
    /// the drives.
    Modal,
}

/// What a law sees at one instant.
#[derive(Debug, Clone, Copy)]
pub(super) struct Instant {
    /// Displacement about its centre, in deviations.
    pub d: f64,
    /// Velocity in deviations.
    pub v: f64,
    /// The other place's displacement, of a law of two.
    pub x: f64,
    /// Time of the programme, from 0 to 1.
    pub t: f64,
}

/// Deviations and centre of an argument over all groups.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(super) struct Scale {
    pub centre: f64,
    pub d: f64,
    pub v: f64,
}

/// Where free shapes have their kinks, in deviations.
const KINKS: [f64; 5] = [-1.5, -0.6, 0.0, 0.6, 1.5];
/// Outermost kinks of a bend behind a filter, in deviations: of one of few, and of one of more.
const OUTERMOST: [f64; 2] = [2.2, 3.2];
/// Its kinks while filters are tried.
const FEW_KINKS: usize = 5;
/// Powers of a damper's velocity: at 1 it is linear.
const LEAST_POWER: f64 = 1.2;
const MOST_POWER: f64 = 5.0;
/// How a hysteresis is unloaded: along a straight line, as steeply as it yields, and so that it stiffens.
const UNLOADING: [f64; 3] = [0.0, -0.5, -1.2];
/// Where several sliders slip.
const LIMITS: [f64; 4] = [0.1, 0.35, 1.0, 2.5];

impl Law {
    /// Number of its signals.
    pub(in crate::diagnosis) fn count(self) -> usize {
        match self {
            Self::FreeStiffness | Self::FreeDamping => KINKS.len(),
            Self::FreeHysteresis => LIMITS.len(),
            Self::Sandwich => 3,
            Self::Block { kinks, .. } => kinks,
            Self::Polynomial | Self::Stribeck { .. } | Self::ValveFlow | Self::CrossAxisKinematic => 2,
            _ => 1,
        }
    }

    /// Its signals at one instant.
    pub(super) fn at(self, now: Instant, memory: &mut Memory, out: &mut [f64]) {
        let Instant { d, v, x, t } = now;
        let step = memory.step(d);
        match self {
            Self::Cubic => out[0] = d * d * d,
            Self::Quadratic => out[0] = d * d,
            Self::Polynomial => out.copy_from_slice(&[d * d, d * d * d]),
            Self::Kink { at } => out[0] = d.clamp(-at, at),
            Self::Gap { at } => out[0] = d - d.clamp(-at, at),
            Self::OneSided { at } => out[0] = (d - at).max(0.0),
            Self::OneSidedBelow { at } => out[0] = (d - at).min(0.0),
            Self::FreeStiffness => out.iter_mut().zip(KINKS).for_each(|(out, at)| *out = (d - at).max(0.0)),
            Self::Coulomb { smooth } => out[0] = (v / smooth).tanh(),
            Self::Stribeck { smooth, decay } => {
                out[0] = (v / smooth).tanh();
                out[1] = out[0] * (-v.abs() / decay).exp();
            }
            Self::Slider { limit } => out[0] = slide(&mut memory.z[0], step, limit),
            Self::FreeHysteresis => {
                let stops = memory.z.iter_mut().zip(LIMITS);
                out.iter_mut().zip(stops).for_each(|(out, (z, limit))| *out = slide(z, step, limit));
            }
            Self::BoucWen { limit, unloading } => {
                out[0] = yielding(&mut memory.z[0], step, limit, unloading);
            }
            Self::QuadraticDamping => out[0] = v * v.abs(),
            Self::PowerDamping { exponent } => out[0] = v.signum() * v.abs().powf(exponent),
            Self::OneSidedDamping { at } => out[0] = (v - at).max(0.0),
            Self::OneSidedDampingBelow { at } => out[0] = (v - at).min(0.0),
            Self::KinkedDamping { at } => out[0] = v.clamp(-at, at),
            Self::DampingBeyond { at } => out[0] = v - v.clamp(-at, at),
            Self::FreeDamping => out.iter_mut().zip(KINKS).for_each(|(out, at)| *out = (v - at).max(0.0)),
            Self::RateLimit { limit } => out[0] = memory.follow(d, limit),
            Self::ValveFlow => out.copy_from_slice(&[d.abs() * x, d * x * x]),
            Self::CrossAxisKinematic => out.copy_from_slice(&[x * x, d * x]),
            Self::StiffnessDrift => out[0] = t * d,
            Self::Sandwich => out.copy_from_slice(&[d * d, d.max(0.0), d.clamp(-1.0, 1.0)]),
            Self::Block { front, kinks } => {
                let x = memory.filtered(front, d);
                for (k, out) in out.iter_mut().enumerate() {
                    *out = (x - kink(k, kinks)).max(0.0);
                }
            }
            Self::Bent { front, bend } => {
                let x = memory.filtered(front, d);
                let part = |(k, change): (usize, &f64)| change * (x - kink(k, bend.len())).max(0.0);
                out[0] = bend.iter().enumerate().map(part).sum();
            }
        }
    }

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
        let n = motion.d.len();
        let pace = (clock[1] - clock[0]) / n.max(1) as f64;
        let mut memory = Memory::new(scale, rate_hz);
        let mut out = vec![vec![0.0; n]; self.count()];
        let mut now = vec![0.0; self.count()];
        for k in 0..n {
            let instant = Instant {
                d: (motion.d[k] - scale.centre) / scale.d,
                v: motion.v[k] / scale.v,
                x: other.map_or(0.0, |x| x[k]),
                t: clock[0] + pace * k as f64,
            };
            self.at(instant, &mut memory, &mut now);
            out.iter_mut().zip(&now).for_each(|(out, now)| out[k] = *now);
        }
        out
    }

    /// Whether it is a function of its argument's rate alone.
    pub(super) fn is_over_rate(self) -> bool {
        matches!(
            self,
            Self::Coulomb { .. }
                | Self::Stribeck { .. }
                | Self::QuadraticDamping
                | Self::PowerDamping { .. }
                | Self::OneSidedDamping { .. }
                | Self::OneSidedDampingBelow { .. }
                | Self::KinkedDamping { .. }
                | Self::DampingBeyond { .. }
                | Self::FreeDamping
        )
    }

    /// Laws whose numbers are larger or smaller by a factor; none of a law without numbers. Filters stay below `high`
    /// cycles a sample.
    pub(super) fn nearby(self, factor: f64, high: f64) -> Vec<Self> {
        match self {
            Self::Block { front, kinks } => {
                let inside = front.nearby(factor).into_iter().filter(|front| front.filters_below(high));
                inside.map(|front| Self::Block { front, kinks }).collect()
            }
            Self::BoucWen { limit, unloading } => {
                let (more, less) = (unloading + factor - 1.0, unloading - factor + 1.0);
                let of = |limit, unloading| Self::BoucWen { limit, unloading };
                vec![
                    of(limit * factor, unloading),
                    of(limit / factor, unloading),
                    of(limit, more),
                    of(limit, less),
                ]
            }
            _ => [factor, 1.0 / factor].iter().filter_map(|f| self.scaled(*f)).collect(),
        }
    }

    /// The law with its number `factor` times as large; `None` of a law without one, or with more.
    fn scaled(self, factor: f64) -> Option<Self> {
        Some(match self {
            Self::Kink { at } => Self::Kink { at: at * factor },
            Self::Gap { at } => Self::Gap { at: at * factor },
            Self::OneSided { at } => Self::OneSided { at: at * factor },
            Self::OneSidedBelow { at } => Self::OneSidedBelow { at: at * factor },
            Self::Coulomb { smooth } => Self::Coulomb { smooth: smooth * factor },
            Self::Stribeck { smooth, decay } => Self::Stribeck { smooth, decay: decay * factor },
            Self::Slider { limit } => Self::Slider { limit: limit * factor },
            Self::PowerDamping { exponent } => {
                Self::PowerDamping { exponent: (exponent * factor).clamp(LEAST_POWER, MOST_POWER) }
            }
            Self::OneSidedDamping { at } => Self::OneSidedDamping { at: at * factor },
            Self::OneSidedDampingBelow { at } => Self::OneSidedDampingBelow { at: at * factor },
            Self::KinkedDamping { at } => Self::KinkedDamping { at: at * factor },
            Self::DampingBeyond { at } => Self::DampingBeyond { at: at * factor },
            Self::RateLimit { limit } => Self::RateLimit { limit: limit * factor },
            _ => return None,
        })
    }

    /// The law as it is beside a linear part that takes nothing of its argument: one of a kink is nothing before it.
    pub(super) fn apart(self) -> Self {
        match self {
            Self::Kink { at } => Self::Gap { at },
            Self::OneSided { at } if at < 0.0 => Self::OneSidedBelow { at },
            Self::OneSidedDamping { at } if at < 0.0 => Self::OneSidedDampingBelow { at },
            Self::KinkedDamping { at } => Self::DampingBeyond { at },
            law => law,
        }
    }

    /// The law over an argument: a filter's output is counted in its own deviations there.
    pub(super) fn over(self, argument: &Argument) -> Self {
        let Self::Block { front, kinks } = self else { return self };
        let drive = argument.motion.iter().map(|m| m.d.as_slice());
        Self::Block { front: front.levelled(drive, argument.scale.centre, argument.scale.d), kinks }
    }

    /// Its numbers, in deviations.
    pub(super) fn values(self) -> Vec<f64> {
        match self {
            Self::Kink { at } | Self::Gap { at } | Self::OneSided { at } | Self::OneSidedBelow { at } => {
                vec![at]
            }
            Self::OneSidedDamping { at } | Self::OneSidedDampingBelow { at } => vec![at],
            Self::KinkedDamping { at } | Self::DampingBeyond { at } => vec![at],
            Self::Coulomb { smooth } => vec![smooth],
            Self::PowerDamping { exponent } => vec![exponent],
            Self::Stribeck { smooth, decay } => vec![smooth, decay],
            Self::Slider { limit } | Self::RateLimit { limit } => vec![limit],
            Self::BoucWen { limit, unloading } => vec![limit, unloading],
            Self::Block { front, .. } => front.values(),
            Self::Bent { front, bend } => front.values().into_iter().chain(bend).collect(),
            _ => Vec::new(),
        }
    }

    /// How its signals reach a response.
    pub(super) fn way(self) -> Way {
        match self {
            Self::ValveFlow => Way::Loaded,
            Self::Block { .. } => Way::Behind,
            Self::Bent { .. } => Way::Free,
            _ => Way::Plain,
        }
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
        for unloading in UNLOADING {
            laws.extend([0.1, 0.3, 1.0].map(|limit| Self::BoucWen { limit, unloading }));
        }
        laws
    }

    /// Laws of damping.
    pub(super) fn damping() -> Vec<Self> {
        let mut laws = vec![Self::QuadraticDamping, Self::FreeDamping];
        laws.extend([1.5, 3.0].map(|exponent| Self::PowerDamping { exponent }));
        laws.extend([-1.0, 0.0, 1.0].map(|at| Self::OneSidedDamping { at }));
        laws.extend([0.5, 1.0, 1.8].map(|at| Self::KinkedDamping { at }));
        laws
    }

    /// Bends behind filters with corners inside a band, Hz, of signals at a rate.
    pub(super) fn blocks(low_hz: f64, high_hz: f64, rate_hz: f64) -> Vec<Self> {
        let of = |front| Self::Block { front, kinks: FEW_KINKS };
        Front::grid(low_hz, high_hz, rate_hz).into_iter().map(of).collect()
    }

    /// Limits of rate.
    pub(super) fn rate_limits() -> Vec<Self> {
        [0.4, 0.7, 1.0, 1.4, 1.9, 2.6].map(|limit| Self::RateLimit { limit }).to_vec()
    }
}

/// Place of a kink of a bend behind a filter, in deviations.
fn kink(k: usize, of: usize) -> f64 {
    OUTERMOST[usize::from(of > FEW_KINKS)] * (2.0 * k as f64 / (of.max(2) - 1) as f64 - 1.0)
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
        assert_eq!(signals(Law::Gap { at: 0.5 }, &d, &v, None), [[0.0, 0.5, -1.5]]);
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
