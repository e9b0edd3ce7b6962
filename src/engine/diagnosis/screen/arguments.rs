//! All motions that a law may act over, as they were measured.

use std::sync::OnceLock;

use rayon::prelude::*;

use super::drift::Drives;
use super::input::{Channel, Recording};
use super::motion::{Limits, Motion, displacement, motion};
use super::place::{Argument, Place, argument, less};
use super::relative::relative;
use crate::Quantity;

/// All places but the outputs, by the first `used` samples of each record.
pub(super) fn arguments(recording: &Recording, limits: Limits, used: &[usize]) -> Vec<Argument> {
    let measured = Measured { recording, limits, used, explained: OnceLock::new() };
    let sensors = measured.sensors();
    let pairs: Vec<[&Argument; 2]> =
        sensors.iter().enumerate().flat_map(|(i, a)| sensors[..i].iter().map(move |b| [a, b])).collect();
    let between: Vec<Argument> = pairs.into_par_iter().filter_map(|pair| measured.between(pair)).collect();
    let over_drives: Vec<Argument> = (0..recording.drives.len())
        .into_par_iter()
        .filter_map(|d| relative(&measured, d, &sensors))
        .collect();
    [measured.drives(), sensors, between, over_drives].concat()
}

/// The samples that count.
pub(super) struct Measured<'a> {
    pub recording: &'a Recording,
    pub limits: Limits,
    used: &'a [usize],
    explained: OnceLock<Drives<'a>>,
}

impl<'a> Measured<'a> {
    fn drives(&self) -> Vec<Argument> {
        let of = |(d, channel): (usize, &Channel)| {
            let motion = self.motion(|record| self.drive(record, d), channel.quantity, self.limits);
            argument(Place::Drive(d), channel.quantity, self.limits, motion)
        };
        self.recording.drives.iter().enumerate().filter_map(of).collect()
    }

    /// Responses that move; where no channel does, all of them.
    fn sensors(&self) -> Vec<Argument> {
        let moving = |c: &Channel| c.quantity.is_motion();
        let some = self.recording.drives.iter().chain(&self.recording.responses).any(moving);
        let of = |(r, channel): (usize, &Channel)| {
            let quantity = channel.quantity;
            let inside = self.explained(quantity, self.limits, |record, limits| {
                displacement(self.response(record, r), quantity, self.rate_hz(), limits)
            });
            let motion = self.motion(|record| self.response(record, r), quantity, inside);
            argument(Place::Response(r), quantity, inside, motion)
        };
        let responses = self.recording.responses.iter().enumerate();
        responses.filter(|(_, c)| moving(c) || !some).filter_map(of).collect()
    }

    /// One sensor less another of its quantity, in its unit.
    fn between(&self, [a, b]: [&Argument; 2]) -> Option<Argument> {
        let (Place::Response(i), Place::Response(j)) = (a.place, b.place) else { return None };
        let [first, other] = [i, j].map(|r| &self.recording.responses[r]);
        let factor = other.to_unit_of(first).filter(|_| a.quantity == b.quantity)?;
        let both = Limits { low_hz: a.limits.low_hz.max(b.limits.low_hz), ..self.limits };
        let quantity = a.quantity;
        // Two that move together leave the noise of both.
        let apart = |record, limits| -> Vec<f64> {
            let of = |r| displacement(self.response(record, r), quantity, self.rate_hz(), limits);
            of(i).iter().zip(of(j)).map(|(x, y)| x - factor * y).collect()
        };
        let inside = self.explained(quantity, both, apart);
        let cut = |argument: &Argument, r: usize| {
            if argument.limits == inside {
                return argument.motion.clone();
            }
            self.motion(|record| self.response(record, r), quantity, inside)
        };
        let motion = cut(a, i).iter().zip(cut(b, j)).map(|(x, y)| less(x, &y, factor)).collect();
        let found = argument(Place::Between(i, j), quantity, inside, motion)?;
        Some(Argument { factor, ..found })
    }

    /// The limits inside which a displacement that was integrated is the drives' doing. `displacement` says it of a record
    /// inside limits.
    pub fn explained(
        &self,
        quantity: Quantity,
        limits: Limits,
        displacement: impl Fn(usize, Limits) -> Vec<f64>,
    ) -> Limits {
        if quantity.integrals() == 0 {
            return limits;
        }
        let drives = self.explained.get_or_init(|| Drives::new(self.recording, self.used, limits.high_hz));
        Limits { low_hz: drives.explain_from(quantity, limits, displacement), ..limits }
    }

    fn motion<'s>(
        &self,
        samples: impl Fn(usize) -> &'s [f64],
        quantity: Quantity,
        limits: Limits,
    ) -> Vec<Motion> {
        (0..self.used.len()).map(|r| motion(samples(r), quantity, self.rate_hz(), limits)).collect()
    }

    /// Number of records.
    pub fn records(&self) -> usize {
        self.used.len()
    }

    /// Samples of a drive in a record.
    pub fn drive(&self, record: usize, drive: usize) -> &'a [f64] {
        &self.recording.records[record].drive.channel(drive)[..self.used[record]]
    }

    /// Samples of a response in a record.
    pub fn response(&self, record: usize, response: usize) -> &'a [f64] {
        &self.recording.records[record].response.channel(response)[..self.used[record]]
    }

    pub fn rate_hz(&self) -> f64 {
        self.recording.sample_rate_hz()
    }
}
