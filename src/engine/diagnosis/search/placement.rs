//! At which responses an effect is sought: a force's argument is the displacement on its axis, where
//! there is one, and other responses only feel what it does there.

use super::catalogue::own_drive;
use crate::Quantity;
use crate::diagnosis::data::overview::Overview;
use crate::diagnosis::data::prepare::Prepared;
use crate::diagnosis::data::problem::Problem;
use crate::diagnosis::effects::effect::Effect;
use crate::diagnosis::input::Input;
use crate::diagnosis::numerics::linear::rms;

/// Responses at which effects are sought, among those with a systematic gap.
pub struct Placement {
    /// Of stiffness, friction, damping and all else that acts on the axis' own motion.
    pub motion: Vec<usize>,
    /// Of each drive's effects: the response that hears the drive best.
    pub of_drive: Vec<usize>,
    /// Of each drive's new path to other axes: where the gap is largest among them.
    pub across: Vec<Option<usize>>,
    /// Of changes of the whole linear part: where the gap is largest.
    pub leading: usize,
}

/// How close a quantity is to the displacement that stiffness and friction act on.
fn rank(quantity: Quantity) -> usize {
    match quantity {
        Quantity::Displacement => 0,
        Quantity::Velocity => 1,
        Quantity::Acceleration => 2,
        Quantity::Other => 3,
        Quantity::Force => 4,
    }
}

impl Placement {
    /// Placement of a request of which `overview.seen` is not empty.
    pub fn of(input: &Input, prepared: &Prepared, overview: &Overview) -> Self {
        let of_axis = |r: usize| match &input.responses[r].axis {
            Some(axis) => (0..input.responses.len())
                .filter(|&o| input.responses[o].axis.as_ref() == Some(axis))
                .collect(),
            None => vec![r],
        };
        let mut motion = Vec::new();
        for &r in &overview.seen {
            let mut group: Vec<usize> = of_axis(r);
            group.retain(|o| overview.seen.contains(o));
            let best = group.iter().map(|&o| rank(input.responses[o].quantity)).min();
            if Some(rank(input.responses[r].quantity)) == best {
                motion.push(r);
            }
        }
        let heard = |r: usize, d: usize| {
            let problem = &prepared.problems[r];
            let noise = prepared.noises[r].ar.mean_power(prepared.band).sqrt();
            reach(problem, d) / noise.max(f64::MIN_POSITIVE)
        };
        let loudest = |d: usize| {
            motion.iter().copied().max_by(|&a, &b| heard(a, d).total_cmp(&heard(b, d))).unwrap_or(0)
        };
        let of_drive = (0..input.drives.len()).map(loudest).collect();
        let chi2 = |r: usize| overview.chi2_select[r];
        let largest = |drive: Option<usize>| {
            let others = motion.iter().copied();
            others
                .filter(|&r| drive.is_none() || own_drive(&prepared.problems[r]) != drive)
                .max_by(|&a, &b| chi2(a).total_cmp(&chi2(b)))
        };
        let across = (0..input.drives.len()).map(|d| largest(Some(d))).collect();
        let leading = largest(None).unwrap_or(0);
        Self { motion, of_drive, across, leading }
    }

    /// Whether an effect, of a drive if it is one of a drive, is sought at response `r`.
    pub fn seek(&self, effect: Effect, drive: usize, r: usize) -> bool {
        match effect {
            Effect::LinearChange => r == self.leading,
            Effect::CrossAxisLinear => self.across[drive] == Some(r),
            Effect::OffsetDrift
            | Effect::Offset
            | Effect::SensorGain
            | Effect::SensorSaturation
            | Effect::SensorNonlinearity => true,
            effect if effect.on_drive() || effect == Effect::Sandwich => r == self.of_drive[drive],
            _ => self.motion.contains(&r),
        }
    }
}

/// RMS of what a drive does to a response through the core, in the first fit stretch.
pub fn reach(problem: &Problem, drive: usize) -> f64 {
    let Some(stretch) = problem.fit.first() else { return 0.0 };
    let mean = problem.core.drive_mean[drive];
    let moved: Vec<f64> = stretch.drives[drive].iter().map(|u| u - mean).collect();
    rms(&problem.core.path(drive, &moved))
}
