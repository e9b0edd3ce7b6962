//! Force laws: what an effect does at one instant, without its strength and its path.
//!
//! Arguments come in units of the channel's own level (root mean square of the response and of its
//! velocity, peak of the drive), so that shapes mean the same on every rig.

use serde::{Deserialize, Serialize};

use crate::diagnosis::numerics::spline::Spline;

/// What a law sees, midway between two samples.
#[derive(Debug, Clone, Copy)]
pub struct Instant {
    /// Response about its working point, in units of its RMS.
    pub y: f64,
    /// Change of the response since the last sample, in units of its RMS.
    pub dy: f64,
    /// Velocity, in units of its RMS.
    pub v: f64,
    /// Time since the first run began, in units of the whole programme.
    pub t: f64,
    /// A signal that does not depend on the response (a drive, another axis).
    pub aux: f64,
}

/// Hidden states of a law with memory.
pub type Memory = [f64; 6];

/// Elements of the Prandtl-Ishlinskii operator and their stop limits, in units of the response's
/// RMS: from pre-sliding to the whole stroke.
const STOPS: [f64; 6] = [0.03, 0.1, 0.3, 0.7, 1.3, 2.2];

// Beyond these a law is a straight line over the whole stroke and names nothing that a linear change
// does not.
/// Largest bend of a cubic spring: it is a line where the response is above its inverse.
const BEND: f64 = 1.0;
/// Narrowest gap of a bump stop: one that is met for three quarters of the time is a stiffer spring.
const NARROWEST: f64 = 0.3;
/// Widest clearance: noise hardly leaves more.
const WIDEST: f64 = 2.5;
/// Largest logarithm of the velocity below which dry friction does not slide.
const SLIDES: f64 = -0.5;
/// Largest logarithm of a yield displacement.
const YIELDS: f64 = 0.7;
/// Largest share by which a hysteresis is unloaded more steeply or less.
const UNLOADS: f64 = 3.0;
/// Furthest that a hysteretic displacement goes: no response does.
const FAR: f64 = 30.0;
/// Largest excess of breakaway over sliding friction: dry pairs have at most about three.
const BREAKAWAY: f64 = 3.0;
/// Furthest start of a drift from that of the first run, in programmes.
pub const EARLIEST: f64 = 1.0;

/// A law `phi`; its shape numbers are handed in with every call.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum Law {
    /// `y`
    Linear,
    /// `y^3 / (1 + a^2 y^2)`; shape `a`
    Cubic,
    /// `y^2`
    Quadratic,
    /// `sgn(y) (|y| - d)+`; shape `d`
    BumpStop,
    /// `(y - d)+`, or the same on the other side; shape `d`
    OneSided(f64),
    /// Stiffness missing inside `|y| < d`; shape `d`
    Clearance,
    /// Free function of `y`; shape: its values at the knots
    FreeStiffness(Spline),
    /// `tanh(v / ve)`; shape `ln ve`
    Coulomb,
    /// `tanh(v / ve) (1 + a exp(-(v / vs)^2))`; shape `ln ve, a, ln vs`
    Stribeck,
    /// `dz = dy (1 - (|z| / zy)^n where dy z > 0)`, `z / zy`; shape `ln zy, ln n`: of versions that are stored
    BoucWen,
    /// The same in general, `dz = dy (1 - b (|z| / zy)^n)` with `b = q` where `dy z < 0` and `1 + q` where it is not; shape
    /// `ln zy, ln n, q`. In the words of Bouc and Wen `beta + gamma = (1 + q) / zy^n`, `gamma - beta = q / zy^n`
    Hysteretic,
    /// Sum of elastic stops (Prandtl-Ishlinskii); shape: their weights
    FreeHysteresis,
    /// `v |v|`
    QuadraticDamping,
    /// Free function of `v`; shape: its values at the knots
    FreeDamping(Spline),
    /// `(t + t0) y`; shape `t0`
    StiffnessDrift,
    /// `u (sqrt(1 - k sgn(u) y) - 1)`: orifice flow against the load; shape `k`
    Valve,
    /// The other signal itself
    Other,
    /// The other signal's square
    OtherSquare,
    /// `y` times the other signal
    OtherTimesY,
    /// A law of an effect at another response, as its free run has it; the index counts the effect's
    /// laws
    Carried(usize),
}

impl Law {
    /// Number of shape numbers.
    pub fn shapes(&self) -> usize {
        match self {
            Self::Linear | Self::Quadratic | Self::QuadraticDamping => 0,
            Self::Other | Self::OtherSquare | Self::OtherTimesY | Self::Carried(_) => 0,
            Self::Cubic | Self::BumpStop | Self::OneSided(_) | Self::Clearance => 1,
            Self::Coulomb | Self::StiffnessDrift | Self::Valve => 1,
            Self::BoucWen => 2,
            Self::Stribeck | Self::Hysteretic => 3,
            Self::FreeStiffness(spline) | Self::FreeDamping(spline) => spline.knots(),
            Self::FreeHysteresis => STOPS.len(),
        }
    }

    /// Numbers of the law's path into a core of `order` states. What is carried from elsewhere may
    /// reach a response at once, as a spring's force does: one more, for that.
    pub fn path(&self, order: usize) -> usize {
        order + usize::from(matches!(self, Self::Carried(_)))
    }

    /// Number of hidden states.
    pub fn memories(&self) -> usize {
        match self {
            Self::BoucWen | Self::Hysteretic => 1,
            Self::FreeHysteresis => STOPS.len(),
            _ => 0,
        }
    }

    /// Whether the law needs the response: then the free run is a loop.
    pub fn closed(&self) -> bool {
        !matches!(self, Self::Other | Self::OtherSquare | Self::Carried(_))
    }

    /// Whether the law is a weighted sum of its shape numbers.
    pub fn linear_in_shape(&self) -> bool {
        matches!(self, Self::FreeStiffness(_) | Self::FreeDamping(_) | Self::FreeHysteresis)
    }

    /// Value at one instant; `memory` moves on.
    #[inline]
    pub fn at(&self, shape: &[f64], i: Instant, memory: &mut Memory) -> f64 {
        match self {
            Self::Linear => i.y,
            Self::Cubic => {
                let bend = shape[0].clamp(-BEND, BEND);
                i.y * i.y * i.y / (1.0 + bend * bend * i.y * i.y)
            }
            Self::Quadratic => i.y * i.y,
            Self::BumpStop => {
                let gap = shape[0].abs().max(NARROWEST);
                i.y - i.y.clamp(-gap, gap)
            }
            Self::OneSided(side) => side * (side * i.y - shape[0].max(0.0)).max(0.0),
            Self::Clearance => {
                let gap = shape[0].abs().min(WIDEST);
                i.y.clamp(-gap, gap)
            }
            Self::FreeStiffness(spline) => spline.at(shape, i.y),
            Self::Coulomb => (i.v / shape[0].min(SLIDES).exp()).tanh(),
            Self::Stribeck => {
                let x = i.v / shape[2].exp();
                let peak = shape[1].clamp(0.0, BREAKAWAY);
                (i.v / shape[0].min(SLIDES).exp()).tanh() * (1.0 + peak * (-x * x).exp())
            }
            Self::BoucWen | Self::Hysteretic => {
                let (limit, sharpness) = (shape[0].min(YIELDS).exp(), shape[1].clamp(-1.0, 2.5).exp());
                let unloading = if *self == Self::BoucWen { 0.0 } else { shape[2].clamp(-UNLOADS, UNLOADS) };
                // Beyond it nothing that yields goes; what stiffens has no end.
                let most =
                    if unloading > -1.0 { limit * (1.0 + unloading).powf(-1.0 / sharpness) } else { FAR };
                let most = most.min(FAR);
                let z = memory[0];
                let slope = |z: f64| {
                    let less = if i.dy * z > 0.0 { 1.0 + unloading } else { unloading };
                    1.0 - less * (z.abs() / limit).powf(sharpness)
                };
                let half = (z + 0.5 * i.dy * slope(z)).clamp(-most, most);
                let next = (z + i.dy * slope(half)).clamp(-most, most);
                memory[0] = next;
                0.5 * (z + next) / limit
            }
            Self::FreeHysteresis => {
                let mut sum = 0.0;
                for ((z, limit), weight) in memory.iter_mut().zip(STOPS).zip(shape) {
                    let next = (*z + i.dy).clamp(-limit, limit);
                    sum += weight * 0.5 * (*z + next) / limit;
                    *z = next;
                }
                sum
            }
            Self::QuadraticDamping => i.v * i.v.abs(),
            Self::FreeDamping(spline) => spline.at(shape, i.v),
            Self::StiffnessDrift => (i.t + shape[0].clamp(-EARLIEST, EARLIEST)) * i.y,
            Self::Valve => {
                let pressure = 1.0 - shape[0] * i.y.copysign(i.y * i.aux);
                i.aux * (pressure.max(0.0).sqrt() - 1.0)
            }
            Self::Other | Self::Carried(_) => i.aux,
            Self::OtherSquare => i.aux * i.aux,
            Self::OtherTimesY => i.aux * i.y,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(y: f64, dy: f64, v: f64) -> Instant {
        Instant { y, dy, v, t: 0.0, aux: 0.5 }
    }

    #[test]
    fn stops_and_gaps_act_where_they_should() {
        let m = &mut [0.0; 6];
        assert_eq!(Law::BumpStop.at(&[1.0], at(1.5, 0.0, 0.0), m), 0.5);
        assert_eq!(Law::BumpStop.at(&[1.0], at(-1.5, 0.0, 0.0), m), -0.5);
        assert_eq!(Law::OneSided(1.0).at(&[1.0], at(-1.5, 0.0, 0.0), m), 0.0);
        assert_eq!(Law::OneSided(-1.0).at(&[1.0], at(-1.5, 0.0, 0.0), m), -0.5);
        assert_eq!(Law::Clearance.at(&[1.0], at(0.4, 0.0, 0.0), m), 0.4);
    }

    #[test]
    fn flow_falls_when_the_load_opposes_it_and_rises_when_it_helps() {
        let m = &mut [0.0; 6];
        let flow =
            |y: f64, u: f64| Law::Valve.at(&[0.5], Instant { aux: u, ..at(y, 0.0, 0.0) }, &mut [0.0; 6]);
        assert!(flow(0.5, 1.0) < 0.0 && flow(-0.5, 1.0) > 0.0);
        assert!(flow(-0.5, -1.0) > 0.0 && flow(0.5, -1.0) < 0.0);
        assert_eq!(Law::Valve.at(&[0.5], at(0.0, 0.0, 0.0), m), 0.0);
    }

    #[test]
    fn hysteresis_dissipates_over_a_closed_cycle_and_a_spring_does_not() {
        let work = |law: &Law, shape: &[f64]| {
            let mut memory = [0.0; 6];
            let (n, mut y, mut sum) = (400, 0.0, 0.0);
            for cycle in 0..3 {
                for k in 0..n {
                    let next = 2.0 * (std::f64::consts::TAU * f64::from(k + 1) / f64::from(n)).sin();
                    let force = law.at(shape, at(0.5 * (y + next), next - y, 0.0), &mut memory);
                    if cycle == 2 {
                        sum += force * (next - y);
                    }
                    y = next;
                }
            }
            sum
        };
        let limit = (0.3_f64).ln();
        let straight = work(&Law::BoucWen, &[limit, 0.0]);
        assert!(straight > 5.0);
        assert!((work(&Law::Hysteretic, &[limit, 0.0, 0.0]) - straight).abs() < 1e-9);
        assert!(work(&Law::Hysteretic, &[limit, 0.0, -0.5]) > 5.0);
        assert!(work(&Law::Hysteretic, &[limit, 0.0, -1.2]) > 5.0, "also where it stiffens");
        assert!(work(&Law::FreeHysteresis, &[1.0, 1.0, 0.0, 0.0, 0.0, 0.0]) > 10.0);
        assert!(work(&Law::Cubic, &[0.0]).abs() < 1e-9);
    }
}
