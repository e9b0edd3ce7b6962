//! Forces of flaws on the seen mass of an axis.

use super::axis::{Axis, HYSTERESIS, MASSES, TWIST};
use super::flaw::{Flaw, Placed};

/// The inputs of the rig at one time.
pub struct Moment {
    pub drives: Vec<f64>,
    pub clock: f64,
    pub seconds: f64,
}

/// Further force below the seen mass, of a changed spring and damper.
pub fn changed(axis: &Axis, q: &[f64], s: f64, stiffness: f64, damping: f64) -> f64 {
    let i = axis.seen;
    let (xp, vp) = if i == 0 { (0.0, 0.0) } else { (q[i - 1], q[MASSES + i - 1]) };
    let k = axis.stiffness[i] * s * stiffness;
    let c = axis.damping[i] * ((1.0 + 2.0 * s * damping).max(0.2) - 1.0);
    k * (q[i] - xp) + c * (q[MASSES + i] - vp)
}

/// Force of a flaw on the seen mass, in units of its elastic force.
pub fn law(axis: &Axis, q: &[f64], d: &mut [f64], beside: f64, input: &Moment, placed: &Placed) -> f64 {
    let tau = std::f64::consts::TAU;
    let s = placed.strength;
    let y = q[axis.seen] / axis.level[0];
    let rate = q[MASSES + axis.seen] / axis.level[0];
    let v = q[MASSES + axis.seen] / axis.level[1];
    match placed.flaw {
        Flaw::CubicStiffness { bend } => s * y.powi(3) / (1.0 + bend * y * y),
        Flaw::QuadraticStiffness => s * y * y,
        Flaw::BumpStop { gap } => 3.0 * s * (y.abs() - gap).max(0.0) * y.signum(),
        Flaw::OneSidedStop { gap, side } => 3.0 * s * side * (side * y - gap).max(0.0),
        Flaw::Clearance { gap } => -s * y.clamp(-gap, gap),
        Flaw::Coulomb { smooth } => s * v / (v * v + smooth * smooth).sqrt(),
        Flaw::Stribeck { smooth, peak, decay } => {
            s * v / (v * v + smooth * smooth).sqrt() * (1.0 + peak * (-v.abs() / decay).exp())
        }
        Flaw::BoucWen { yielding, sharpness } => {
            let (z, rate) = (q[HYSTERESIS], rate / yielding);
            d[HYSTERESIS] = rate
                - 0.5 * rate.abs() * z * z.abs().powf(sharpness - 1.0)
                - 0.5 * rate * z.abs().powf(sharpness);
            s * z
        }
        Flaw::LuGre { smooth } => {
            let z = q[TWIST];
            let limit = smooth * (1.0 + 0.3 * (-(v / 0.3).powi(2)).exp());
            d[TWIST] = rate - rate.abs() * z / limit;
            s * (z / smooth + 0.003 * d[TWIST] / smooth)
        }
        Flaw::QuadraticDamping => s * v * v.abs(),
        Flaw::CrossLinear => -s * beside,
        Flaw::CrossKinematic { mixed } => s * (beside * beside + mixed * y * beside),
        Flaw::StiffnessDrift => s * input.clock * y,
        Flaw::Quintic => s * y.powi(5) / 5.0,
        Flaw::TwoStageStop { gap } => {
            3.0 * s * y.signum() * ((y.abs() - gap).max(0.0) + 2.0 * (y.abs() - 1.6 * gap).max(0.0))
        }
        Flaw::Cogging { pitch } => s * (tau * y / pitch).sin(),
        Flaw::UnmeasuredForce => {
            let t = input.seconds + 1000.0 * input.clock;
            s * ((tau * 5.3 * t).sin() + (tau * 9.1 * t + 3.0 * (0.7 * t).sin()).sin())
        }
        Flaw::Parametric { hz } => s * (tau * hz * input.seconds).sin() * y,
        Flaw::NegativeDamping { width } => -s * v / (1.0 + (v / width).powi(4)),
        _ => 0.0,
    }
}
