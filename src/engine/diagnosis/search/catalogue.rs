//! Which candidates the catalogue gives on one response.

use super::placement::reach;
use crate::diagnosis::data::problem::Problem;
use crate::diagnosis::effects::candidate::{Candidate, Other, Part};
use crate::diagnosis::effects::effect::Effect;
use crate::diagnosis::effects::input_map::InputMap;
use crate::diagnosis::effects::law::Law;
use crate::diagnosis::effects::output_map::OutputMap;
use crate::diagnosis::numerics::spline::Spline;

/// Knots of the free functions.
const KNOTS: usize = 9;

/// All parts that `effects` names on this response. `in_situ` leaves out what the joint linear
/// retune of every candidate already holds, and lets limits of drives come in a size of their own.
pub fn parts(problem: &Problem, effects: &[Effect], in_situ: bool, free: FreeRanges) -> Vec<Part> {
    let drives = problem.drive_peak.len();
    let live: Vec<usize> = (0..drives).filter(|&d| problem.drive_peak[d] > 0.0).collect();
    let own = own_drive(problem);
    let mut parts = Vec::new();
    for &effect in effects {
        if in_situ && effect.linear() && effect != Effect::LinearChange {
            continue;
        }
        let force = |laws: Vec<Law>| vec![Part::force(effect, laws, None)];
        let drive = |map: InputMap| -> Vec<Part> {
            let map = if in_situ { map.beside_fitted() } else { map };
            live.iter().map(|&d| Part::input(effect, d, map.clone())).collect()
        };
        let output = |map| vec![Part::output(effect, map)];
        parts.extend(match effect {
            Effect::Gain => drive(InputMap::Gain),
            Effect::Delay => drive(InputMap::Delay),
            Effect::ExtraPole => drive(InputMap::ExtraPole),
            Effect::LinearChange => vec![Part::linear_change()],
            Effect::CubicStiffness => force(vec![Law::Cubic]),
            Effect::QuadraticStiffness => force(vec![Law::Quadratic]),
            Effect::BumpStop => force(vec![Law::BumpStop]),
            Effect::OneSidedStop => {
                [1.0, -1.0].iter().map(|&side| Part::force(effect, vec![Law::OneSided(side)], None)).collect()
            }
            Effect::Clearance => force(vec![Law::Clearance]),
            Effect::FreeStiffness => force(vec![Law::FreeStiffness(Spline::new(-free.y, free.y, KNOTS))]),
            Effect::CoulombFriction => force(vec![Law::Coulomb]),
            Effect::StribeckFriction => force(vec![Law::Stribeck]),
            Effect::BoucWenHysteresis => force(vec![Law::Hysteretic]),
            Effect::FreeHysteresis => force(vec![Law::FreeHysteresis]),
            Effect::QuadraticDamping => force(vec![Law::QuadraticDamping]),
            Effect::FreeDamping => force(vec![Law::FreeDamping(Spline::new(-free.v, free.v, KNOTS))]),
            Effect::DriveSaturation => drive(InputMap::Saturation),
            Effect::DrivePolynomial => drive(InputMap::Polynomial),
            Effect::RateLimit => drive(InputMap::RateLimit),
            Effect::FreeDriveMap => drive(InputMap::Free(Spline::new(-1.0, 1.0, KNOTS))),
            Effect::DeadZone => drive(InputMap::DeadZone),
            Effect::Backlash => drive(InputMap::Backlash),
            Effect::ValveFlow => {
                live.iter().map(|&d| Part::force(effect, vec![Law::Valve], Some(Other::Drive(d)))).collect()
            }
            Effect::CrossAxisLinear => live
                .iter()
                .filter(|&&d| Some(d) != own)
                .map(|&d| Part::force(effect, vec![Law::Other], Some(Other::Drive(d))))
                .collect(),
            Effect::CrossAxisKinematic => others(problem, &live, own)
                .into_iter()
                .map(|other| Part::force(effect, vec![Law::OtherSquare, Law::OtherTimesY], Some(other)))
                .collect(),
            Effect::StiffnessDrift => force(vec![Law::StiffnessDrift]),
            Effect::OffsetDrift => output(OutputMap::Drift),
            Effect::Offset => output(OutputMap::Offset),
            Effect::SensorGain => output(OutputMap::Gain),
            Effect::SensorSaturation => output(OutputMap::Saturation),
            Effect::SensorNonlinearity => output(OutputMap::Polynomial),
            Effect::Sandwich => live.iter().map(|&d| Part::sandwich(d)).collect(),
            Effect::Quantisation | Effect::PeriodicDisturbance | Effect::RaisedNoise => Vec::new(),
        });
    }
    parts
}

/// Half ranges of the free functions, in units of the argument's RMS.
#[derive(Debug, Clone, Copy)]
pub struct FreeRanges {
    pub y: f64,
    pub v: f64,
}

impl FreeRanges {
    /// What the measured response of the fit stretches covers.
    pub fn of(problem: &Problem, smooth: &[Vec<f64>]) -> Self {
        let scales = problem.scales;
        let (mut y, mut v) = (2.0_f64, 2.0_f64);
        for signal in smooth {
            for w in signal.windows(2) {
                y = y.max((w[0] - scales.y_mean).abs() / scales.y);
                v = v.max((w[1] - w[0]).abs() / scales.dy);
            }
        }
        Self { y, v }
    }
}

impl Candidate {
    /// One part, alone or with the retune.
    pub fn of(part: Part, in_situ: bool) -> Self {
        let retune = in_situ || part.effect == Effect::LinearChange;
        Self { parts: vec![part], retune }
    }
}

/// Drive that moves the response most, through the core, in the fit stretches.
pub fn own_drive(problem: &Problem) -> Option<usize> {
    let share = |d: usize| reach(problem, d);
    (0..problem.drive_peak.len()).max_by(|&a, &b| share(a).total_cmp(&share(b)))
}

/// Signals of other axes: their responses, or without any their drives.
fn others(problem: &Problem, live: &[usize], own: Option<usize>) -> Vec<Other> {
    let responses = problem.other_scale.len();
    if responses > 1 {
        (0..responses)
            .filter(|&r| r != problem.response && problem.other_scale[r] > 0.0)
            .map(Other::Response)
            .collect()
    } else {
        live.iter().filter(|&&d| Some(d) != own).map(|&d| Other::Drive(d)).collect()
    }
}
