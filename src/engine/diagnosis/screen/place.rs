//! Where a law may act, and over which motion.

use serde::{Deserialize, Serialize};

use super::arguments::arguments;
use super::band::Band;
use super::input::{Record, Recording};
use super::law::Scale;
use super::motion::{Limits, Motion, beside, displacement};
use crate::Quantity;

/// The argument of a law.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Place {
    /// A drive: the specimen's or actuator's laws on a rig in displacement control, the actuator's on others.
    Drive(usize),
    /// A response.
    Response(usize),
    /// The first response less the second: a joint between two sensors.
    Between(usize, usize),
    /// A drive less the response that follows it: the error that a controller acts on.
    Error(usize, usize),
    /// A table's drive less a response: the motion of what stands on it.
    OnTable(usize, usize),
    /// The linear part's own prediction of a response: its sensor, or a static law behind all dynamics.
    Output(usize),
}

/// A place with its motion at the recording's own rate.
#[derive(Clone)]
pub(super) struct Argument {
    pub place: Place,
    pub quantity: Quantity,
    /// `[record]`.
    pub motion: Vec<Motion>,
    pub scale: Scale,
    /// Limits of what was integrated and differentiated.
    pub limits: Limits,
    /// Factor of what is taken away in a difference of two responses, from its unit to the first's; else 1.
    pub factor: f64,
    /// Whether it is what the linear part makes of the drives, at the rate of the analysis, and not what was measured.
    pub predicted: bool,
}

impl Place {
    /// Whether it is a motion of the structure.
    pub fn is_of_structure(self) -> bool {
        matches!(self, Self::Response(_) | Self::Between(..))
    }

    /// Whether its argument follows from what a law there does.
    pub fn is_fed_back(self) -> bool {
        self.is_of_structure() || self.is_less_a_response()
    }

    /// Whether it is a drive less a response.
    pub fn is_less_a_response(self) -> bool {
        matches!(self, Self::Error(..) | Self::OnTable(..))
    }

    /// Whether its channels are among so many drives and responses.
    pub(super) fn is_among(self, drives: usize, responses: usize) -> bool {
        match self {
            Self::Drive(d) => d < drives,
            Self::Response(r) | Self::Output(r) => r < responses,
            Self::Between(a, b) => a < responses && b < responses,
            Self::Error(d, r) | Self::OnTable(d, r) => d < drives && r < responses,
        }
    }

    /// The same of a rig of which the responses were `kept`.
    pub(super) fn among(self, kept: &[usize]) -> Self {
        match self {
            Self::Drive(_) => self,
            Self::Response(r) => Self::Response(kept[r]),
            Self::Output(r) => Self::Output(kept[r]),
            Self::Between(a, b) => Self::Between(kept[a], kept[b]),
            Self::Error(d, r) => Self::Error(d, kept[r]),
            Self::OnTable(d, r) => Self::OnTable(d, kept[r]),
        }
    }
}

/// What responses add to the displacement at a place.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(super) struct Seen {
    place: Place,
    quantity: Quantity,
    limits: Limits,
    #[serde(default = "one")]
    factor: f64,
}

fn one() -> f64 {
    1.0
}

impl Seen {
    /// That of an argument.
    pub fn of(argument: &Argument) -> Self {
        let Argument { place, quantity, limits, factor, .. } = *argument;
        Self { place, quantity, limits, factor }
    }

    /// The displacement, at the rate of the responses.
    pub fn displacement(&self, responses: &[&[f64]], rate_hz: f64) -> Vec<f64> {
        let of = |r: usize| displacement(responses[r], self.quantity, rate_hz, self.limits);
        match self.place {
            Place::Drive(_) => Vec::new(),
            Place::Response(r) | Place::Output(r) => of(r),
            Place::Between(a, b) => of(a).iter().zip(of(b)).map(|(x, y)| x - self.factor * y).collect(),
            Place::Error(_, r) | Place::OnTable(_, r) => of(r).iter().map(|x| -x).collect(),
        }
    }

    /// The same of a rig of which the responses were `kept`.
    pub fn among(self, kept: &[usize]) -> Self {
        Self { place: self.place.among(kept), ..self }
    }

    /// Whether it is a place among so many channels.
    pub fn is_among(&self, drives: usize, responses: usize) -> bool {
        self.place.is_fed_back() && self.place.is_among(drives, responses)
    }
}

/// The motion at a place, and the drives as far as they go with it.
#[derive(Debug, Clone, PartialEq)]
pub struct Moved {
    /// The displacement at a place of the structure; of an output the response as it was measured. `[record][sample]`.
    pub d: Vec<Vec<f64>>,
    /// The drives inside the limits that the displacement was integrated in, so that one follows from the other by
    /// linear parts as before. `[record][drive][sample]`.
    pub drives: Vec<Vec<Vec<f64>>>,
}

/// What moves at places of the structure and at outputs; `None` where nothing does.
pub fn moved(recording: &Recording, places: &[Place]) -> Vec<Option<Moved>> {
    let rate = recording.sample_rate_hz();
    let whole: Vec<usize> = recording.records.iter().map(|r| r.drive.n_samples()).collect();
    let arguments = arguments(recording, limits(recording, Band::of(recording)), &whole);
    let drives = |of: &dyn Fn(&Vec<f64>) -> Vec<f64>| -> Vec<Vec<Vec<f64>>> {
        recording.records.iter().map(|r| r.drive.channels().iter().map(of).collect()).collect()
    };
    let of = |place: &Place| match *place {
        Place::Drive(_) => None,
        Place::Output(r) => {
            let of_record = |record: &Record| record.response.channel(r).to_vec();
            let d = recording.records.iter().map(of_record).collect();
            Some(Moved { d, drives: drives(&Vec::clone) })
        }
        Place::Response(_) | Place::Between(..) | Place::Error(..) | Place::OnTable(..) => {
            let argument = arguments.iter().find(|a| a.place == *place)?;
            let within = |u: &Vec<f64>| beside(u, argument.quantity, rate, argument.limits);
            let d = argument.motion.iter().map(|m| m.d.clone()).collect();
            Some(Moved { d, drives: drives(&within) })
        }
    };
    places.iter().map(of).collect()
}

/// Limits of what is integrated and differentiated.
pub(super) fn limits(recording: &Recording, band: Band) -> Limits {
    let rate = recording.sample_rate_hz();
    let shortest = recording.records.iter().map(|r| r.drive.n_samples()).min().unwrap_or(1);
    let low_hz = (0.5 * band.low_hz).max(2.0 * rate / shortest as f64);
    Limits { low_hz, high_hz: (rate / band.step as f64).max(band.high_hz) }
}

/// One motion less another, which comes in another unit.
pub(super) fn less(x: &Motion, y: &Motion, factor: f64) -> Motion {
    let of = |x: &[f64], y: &[f64]| x.iter().zip(y).map(|(x, y)| x - factor * y).collect();
    Motion { d: of(&x.d, &y.d), v: of(&x.v, &y.v) }
}

/// A place that moves, with its scale; `None` of one that is at rest.
pub(super) fn argument(
    place: Place,
    quantity: Quantity,
    limits: Limits,
    motion: Vec<Motion>,
) -> Option<Argument> {
    let all = |f: fn(&Motion) -> &[f64]| motion.iter().flat_map(f).copied();
    let n = motion.iter().map(|m| m.d.len()).sum::<usize>().max(1) as f64;
    let mean = all(|m| &m.d).sum::<f64>() / n;
    let d = (all(|m| &m.d).map(|d| (d - mean).powi(2)).sum::<f64>() / n).sqrt();
    let v = (all(|m| &m.v).map(|v| v * v).sum::<f64>() / n).sqrt();
    let (low, high) =
        all(|m| &m.d).fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), d| (l.min(d), h.max(d)));
    // A commanded zero is one of the rig; a sensor's is not.
    let of_rig = matches!(place, Place::Drive(_)) && low < 0.0 && high > 0.0;
    let moves = d > 1e-12 * high.abs().max(low.abs()) && v > 0.0 && d.is_finite() && v.is_finite();
    moves.then_some(Argument {
        place,
        quantity,
        motion,
        scale: Scale { centre: if of_rig { 0.0 } else { mean }, d, v },
        limits,
        factor: 1.0,
        predicted: false,
    })
}
