//! What the model lacks, worked back through a path of the core: measured, not fitted.
//!
//! The gap is divided by the frequency response of the path on which the effect acts (Wiener's
//! inverse, so that noise is not blown up where the path passes little). What comes out is the
//! missing force, or change of drive, as the measurement shows it; the fitted law is drawn beside
//! it. Without a fitted effect the path is that of the drive which moves the response most.

use serde::{Deserialize, Serialize};

use super::inverse::{SPOILT, divided};
use super::{short, shorten};
use crate::diagnosis::data::noise::Noise;
use crate::diagnosis::data::prepare::Prepared;
use crate::diagnosis::data::problem::{Problem, Stretch};
use crate::diagnosis::effects::candidate::Part;
use crate::diagnosis::effects::input_map::InputMap;
use crate::diagnosis::effects::kernel::{Clock, along};
use crate::diagnosis::effects::law::{self, Instant, Memory};
use crate::diagnosis::effects::output_map::OutputMap;
use crate::diagnosis::fit::fitting::Fitted;
use crate::diagnosis::input::Input;
use crate::diagnosis::numerics::linear::{dot, rms};
use crate::diagnosis::numerics::rows::fast_len;
use crate::diagnosis::numerics::smooth::smooth;
use crate::diagnosis::search::catalogue::own_drive;

/// Points of the cloud.
const POINTS: usize = 1500;
/// Points of a law's curve.
const CURVE: usize = 161;

/// Where the missing piece acts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Path {
    /// On the specimen: a restoring force, as large as the change of drive that does as much.
    Force,
    /// On the drive: what is added to it.
    Drive,
    /// On the sensor: what is added to the response.
    Sensor,
}

/// What a law is a function of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Argument {
    /// The response.
    Response,
    /// Its change per second.
    Velocity,
    /// The drive.
    Drive,
}

/// The fitted law over one argument.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Law {
    /// What it is a function of.
    pub over: Argument,
    /// The argument, in its unit.
    pub at: Vec<f64>,
    /// The law, in the cloud's unit.
    pub value: Vec<f64>,
}

/// A cloud of the missing force over response, velocity and drive on the test stretches.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ForceView {
    /// Where it acts.
    pub path: Path,
    /// Response.
    pub channel: String,
    /// Unit of `response`; that of `velocity` is per second.
    pub channel_unit: String,
    /// Drive whose unit the force has.
    pub drive: String,
    /// Unit of `drive_at`.
    pub drive_unit: String,
    /// Unit of `force`.
    pub unit: String,
    /// Response at each point.
    pub response: Vec<f64>,
    /// Velocity at each point, unit/s.
    pub velocity: Vec<f64>,
    /// Drive at each point.
    pub drive_at: Vec<f64>,
    /// What the measurement says is missing.
    pub force: Vec<f64>,
    /// What the fitted law says at each point; none without a law.
    pub fitted: Option<Vec<f64>>,
    /// The fitted law, where it is a function of one argument.
    pub law: Option<Law>,
}

/// One stretch seen through one path.
struct Seen {
    response: Vec<f64>,
    drive: Vec<f64>,
    force: Vec<f64>,
    fitted: Option<Vec<f64>>,
}

/// What stands on the path: nothing known, or one law of the fitted effect.
enum Acting<'a> {
    Unknown,
    Force { law: &'a law::Law, shape: &'a [f64], path: &'a [f64] },
    Drive { map: &'a InputMap, p: &'a [f64] },
    Sensor { map: OutputMap, p: &'a [f64] },
}

impl<'a> Acting<'a> {
    /// The one law of the first part, if it has just one and that sees nothing but response or drive.
    fn of(problem: &Problem, best: Option<&'a Fitted>) -> Self {
        let Some(best) = best else { return Self::Unknown };
        let Some(part) = best.candidate.parts.first() else { return Self::Unknown };
        let order = problem.core.modes.order();
        match part {
            Part { input: Some(map), .. } => Self::Drive { map, p: &best.p[..map.parameters()] },
            Part { output: Some(map), .. } => Self::Sensor { map: *map, p: &best.p[..map.parameters()] },
            Part { forces, other: None, .. } if forces.len() == 1 => {
                let (shape, rest) = best.p.split_at(forces[0].shapes());
                Self::Force { law: &forces[0], shape, path: &rest[..order] }
            }
            _ => Self::Unknown,
        }
    }

    fn path(&self) -> Path {
        match self {
            Self::Unknown | Self::Force { .. } => Path::Force,
            Self::Drive { .. } => Path::Drive,
            Self::Sensor { .. } => Path::Sensor,
        }
    }
}

/// The view of `problem`'s test stretches; none where there is nothing to see.
pub(super) fn view(
    input: &Input,
    prepared: &Prepared,
    problem: &Problem,
    best: Option<&Fitted>,
) -> Option<ForceView> {
    let rate = input.sample_rate_hz();
    let acting = Acting::of(problem, best);
    let own = own_drive(problem)?;
    let drive = match (&acting, best) {
        (Acting::Drive { .. }, Some(best)) => best.candidate.parts[0].drive,
        _ => own,
    };
    let noise = &prepared.noises[problem.response];
    let scale = scale(problem, &acting, drive);
    let seen: Vec<Seen> =
        problem.test.iter().filter_map(|s| look(problem, s, &acting, best, drive, scale, noise)).collect();
    let total: usize = seen.iter().map(|s| s.force.len().saturating_sub(1)).sum();
    let step = total.div_ceil(POINTS).max(1);
    let channel = &input.responses[problem.response];
    let commanded = &input.drives[drive];
    let mut out = ForceView {
        path: acting.path(),
        channel: channel.name.clone(),
        channel_unit: channel.unit.clone(),
        drive: commanded.name.clone(),
        drive_unit: commanded.unit.clone(),
        unit: if acting.path() == Path::Sensor { channel.unit.clone() } else { commanded.unit.clone() },
        response: Vec::new(),
        velocity: Vec::new(),
        drive_at: Vec::new(),
        force: Vec::new(),
        fitted: seen.first()?.fitted.as_ref().map(|_| Vec::new()),
        law: None,
    };
    for seen in &seen {
        for k in (0..seen.force.len().saturating_sub(1)).step_by(step) {
            // A force acts from one sample to the next, a drive or a sensor at the sample.
            let between = acting.path() == Path::Force;
            let next = seen.response[k + 1];
            out.response.push(short(if between {
                0.5 * (seen.response[k] + next)
            } else {
                seen.response[k]
            }));
            out.velocity.push(short((next - seen.response[k]) * rate));
            out.drive_at.push(short(seen.drive[k]));
            out.force.push(short(seen.force[k]));
            if let (Some(out), Some(fitted)) = (&mut out.fitted, &seen.fitted) {
                out.push(short(fitted[k]));
            }
        }
    }
    out.law = curve(problem, &acting, drive, scale, rate, &out);
    (!out.force.is_empty()).then_some(out)
}

/// Factor that turns the law's own number into the unit of the view. A force becomes as large as
/// the change of drive that moves the response as much, and opposes it.
fn scale(problem: &Problem, acting: &Acting<'_>, drive: usize) -> f64 {
    match acting {
        Acting::Unknown => -1.0,
        Acting::Sensor { .. } => problem.scales.y,
        Acting::Drive { .. } => problem.drive_peak[drive],
        Acting::Force { law, shape, path } => {
            let (mut own, mut of_drive, mut both) = (0.0, 0.0, 0.0);
            for stretch in &problem.test {
                let values = law_along(problem, stretch, law, shape);
                let (a, b) = (problem.core.modes.filter(path, &values), problem.core.path(drive, &values));
                own += dot(&a, &a);
                of_drive += dot(&b, &b);
                both += dot(&a, &b);
            }
            if of_drive > 0.0 { -(own / of_drive).sqrt().copysign(both) } else { -1.0 }
        }
    }
}

fn law_along(problem: &Problem, stretch: &Stretch, law: &law::Law, shape: &[f64]) -> Vec<f64> {
    let y = smooth(&stretch.measured, problem.band_end);
    along(law, shape, &y, &[], problem.scales, stretch.clock)
}

/// One stretch through the path; `None` where it is too short to be divided.
fn look(
    problem: &Problem,
    stretch: &Stretch,
    acting: &Acting<'_>,
    best: Option<&Fitted>,
    drive: usize,
    scale: f64,
    noise: &Noise,
) -> Option<Seen> {
    let measured = smooth(&stretch.measured, problem.band_end);
    let retuned = best.map_or_else(|| vec![0.0; measured.len()], |b| retune(problem, stretch, b, &measured));
    let gap: Vec<f64> = stretch.gap(problem.response).iter().zip(&retuned).map(|(g, r)| g - r).collect();
    let n = fast_len(gap.len() - stretch.lead);
    let (from, to) = (stretch.lead, stretch.lead + n);
    let spoilt = (n as f64 * SPOILT) as usize + 1;
    if n < 4 * spoilt || n < 64 {
        return None;
    }
    let impulse: Vec<f64> = std::iter::once(1.0).chain(std::iter::repeat_n(0.0, n - 1)).collect();
    let simulated = &stretch.simulated[problem.response];
    let (answer, arguments, fitted) = match acting {
        Acting::Unknown => (problem.core.path(drive, &impulse), &measured, None),
        Acting::Force { law, shape, path } => {
            let values = along(law, shape, &measured, &[], problem.scales, stretch.clock);
            (problem.core.modes.filter(path, &impulse), &measured, Some(values))
        }
        Acting::Drive { map, p } => {
            let peak = problem.drive_peak[drive];
            let commanded: Vec<f64> = stretch.drives[drive].iter().map(|u| u / peak).collect();
            let answer = problem.core.path(drive, &impulse).iter().map(|y| y * peak).collect();
            (answer, &measured, Some(map.change(p, &commanded)))
        }
        Acting::Sensor { map, p } => {
            let level: Vec<f64> =
                simulated.iter().map(|y| (y - problem.scales.y_mean) / problem.scales.y).collect();
            let mut mapped = level.clone();
            map.apply(p, &mut mapped, |k| stretch.clock.start + stretch.clock.step * k as f64);
            let change = mapped.iter().zip(&level).map(|(m, y)| m - y).collect();
            (impulse.iter().map(|x| x * problem.scales.y).collect(), simulated, Some(change))
        }
    };
    let kept = spoilt..n - spoilt;
    let missing = divided(&gap[from..to], &answer, &noise.ar, problem.band_end);
    let cut = |x: &[f64]| x[from..to][kept.clone()].to_vec();
    Some(Seen {
        response: cut(arguments),
        drive: cut(&stretch.drives[drive]),
        force: missing[kept.clone()].iter().map(|f| f * scale).collect(),
        fitted: fitted.map(|f| cut(&f).iter().map(|f| f * scale).collect()),
    })
}

/// What the linear retune of a candidate does along the measured response: it is no part of the law.
fn retune(problem: &Problem, stretch: &Stretch, best: &Fitted, measured: &[f64]) -> Vec<f64> {
    let mut out = vec![0.0; measured.len()];
    let count = best.candidate.retuned(problem);
    if count == 0 {
        return out;
    }
    let (modes, order) = (&problem.core.modes, problem.core.modes.order());
    let (feedback, mut rest) = best.p[best.p.len() - count..].split_at(order);
    let still = Clock { start: 0.0, step: 0.0 };
    let levels = along(&law::Law::Linear, &[], measured, &[], problem.scales, still);
    let mut add = |y: &[f64]| out.iter_mut().zip(y).for_each(|(o, y)| *o += y);
    add(&modes.filter(feedback, &levels));
    for (d, drive) in stretch.drives.iter().enumerate() {
        let (path, later) = rest.split_at(order);
        let moved: Vec<f64> = drive.iter().map(|u| u - problem.core.drive_mean[d]).collect();
        add(&modes.filter(path, &moved));
        add(&moved.iter().map(|u| later[0] * u).collect::<Vec<f64>>());
        rest = &later[1..];
    }
    out
}

/// The law over its argument, where it has just one.
fn curve(
    problem: &Problem,
    acting: &Acting<'_>,
    drive: usize,
    scale: f64,
    rate: f64,
    seen: &ForceView,
) -> Option<Law> {
    let over = match acting {
        Acting::Unknown => return None,
        Acting::Force { law, .. } => argument(law)?,
        Acting::Drive { map, .. } if map.is_instant() => Argument::Drive,
        Acting::Drive { .. } | Acting::Sensor { map: OutputMap::Drift, .. } => return None,
        Acting::Sensor { .. } => Argument::Response,
    };
    let axis = match over {
        Argument::Response => &seen.response,
        Argument::Velocity => &seen.velocity,
        Argument::Drive => &seen.drive_at,
    };
    let low = axis.iter().copied().fold(f64::INFINITY, f64::min);
    let high = axis.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    if low >= high || rms(axis) == 0.0 {
        return None;
    }
    let at: Vec<f64> = (0..CURVE).map(|k| low + (high - low) * k as f64 / (CURVE - 1) as f64).collect();
    let (mean, y, dy) = (problem.scales.y_mean, problem.scales.y, problem.scales.dy);
    let value: Vec<f64> = match acting {
        Acting::Unknown => return None,
        Acting::Force { law, shape, .. } => at
            .iter()
            .map(|&x| {
                let v = if over == Argument::Velocity { x / rate } else { 0.0 };
                let level = if over == Argument::Response { (x - mean) / y } else { 0.0 };
                let instant = Instant { y: level, dy: v / y, v: v / dy, t: 0.0, aux: 0.0 };
                law.at(shape, instant, &mut Memory::default())
            })
            .collect(),
        Acting::Drive { map, p } => {
            let peak = problem.drive_peak[drive];
            map.change(p, &at.iter().map(|u| u / peak).collect::<Vec<f64>>())
        }
        Acting::Sensor { map, p } => {
            let level: Vec<f64> = at.iter().map(|x| (x - mean) / y).collect();
            let mut mapped = level.clone();
            map.apply(p, &mut mapped, |_| 0.0);
            mapped.iter().zip(&level).map(|(m, l)| m - l).collect()
        }
    };
    Some(Law { over, at: shorten(at), value: shorten(value.into_iter().map(|f| f * scale)) })
}

/// The one argument of a law without memory.
fn argument(law: &law::Law) -> Option<Argument> {
    match law {
        law::Law::Linear
        | law::Law::Cubic
        | law::Law::Quadratic
        | law::Law::BumpStop
        | law::Law::OneSided(_)
        | law::Law::Clearance
        | law::Law::FreeStiffness(_) => Some(Argument::Response),
        law::Law::Coulomb | law::Law::Stribeck | law::Law::QuadraticDamping | law::Law::FreeDamping(_) => {
            Some(Argument::Velocity)
        }
        _ => None,
    }
}
