//! A drive less the response that follows it.
//!
//! A controller acts on the command less what its sensor reads, and what stands on a table feels its own motion less the
//! table's. Both are the same signal; how the response follows tells which it is. Of each drive the response that
//! follows it best is taken: others follow it through the same.

use realfft::num_complex::Complex64;

use super::arguments::Measured;
use super::input::Channel;
use super::motion::{Limits, Motion, beside, motion};
use super::place::{Argument, Place, argument, less};
use crate::Quantity;
use crate::diagnosis::numerics::hann::Hann;
use crate::diagnosis::numerics::linear::{dot, mean};

/// Highest peak of a loop, the response over its command: one that is tuned well has about 1.25, a poor one more than 4
/// (Skogestad and Postlethwaite, Multivariable Feedback Control, 2.4). What stands on a table resonates.
const PEAK: f64 = 2.0;
/// Lines of a drive with less than this share of its strongest tell no peak.
const QUIET: f64 = 0.01;
/// Segments of the shortest record in which the peak is sought, and the longest of them, samples.
const SEGMENTS: usize = 16;
const LONGEST: usize = 4096;

/// The drive less the response that follows it best; `None` where none is of its kind, or none follows it.
pub(super) fn relative(measured: &Measured<'_>, drive: usize, sensors: &[Argument]) -> Option<Argument> {
    let own = &measured.recording.drives[drive];
    let of = |(r, response): (usize, &Channel)| -> Option<(f64, Less, Argument)> {
        let factor = own.to_unit_of(response)?;
        let alike = own.quantity == response.quantity && own.quantity != Quantity::Other;
        let error = alike
            && response.quantity != Quantity::Acceleration
            && factor.recip() * peak(measured, drive, r) < PEAK;
        let (place, quantities) = match (error, comparable(own, response)) {
            // A controller takes its error as it is, whatever it is an error of.
            (true, _) => (Place::Error(drive, r), [Quantity::Other; 2]),
            (false, true) => (Place::OnTable(drive, r), [own.quantity, response.quantity]),
            (false, false) => return None,
        };
        let less = Less { place, drive, response: r, factor, quantities };
        let sensor = sensors.iter().find(|s| s.place == Place::Response(r));
        let (follows, found) = less.within(measured, sensor.map_or(measured.limits, |s| s.limits))?;
        (follows > 0.0).then_some((follows, less, found))
    };
    let all = measured.recording.responses.iter().enumerate().filter_map(of);
    let (_, best, found) = all.max_by(|a, b| a.0.total_cmp(&b.0))?;
    // What moves with the table leaves the noise of its sensor.
    let apart = |record, limits| best.motion(measured, record, limits).d;
    let inside = measured.explained(found.quantity, found.limits, apart);
    if inside == found.limits { Some(found) } else { best.within(measured, inside).map(|(_, found)| found) }
}

/// A drive less a response.
struct Less {
    place: Place,
    drive: usize,
    response: usize,
    /// From the drive's unit to the response's.
    factor: f64,
    /// What drive and response are taken for.
    quantities: [Quantity; 2],
}

impl Less {
    /// How the response goes with the drive, from -1 to 1, and the one less the other.
    fn within(&self, measured: &Measured<'_>, limits: Limits) -> Option<(f64, Argument)> {
        let (mut with, mut u2, mut y2) = (0.0, 0.0, 0.0);
        let mut motions = Vec::new();
        for record in 0..measured.records() {
            let [u, y] = self.motions(measured, record, limits);
            let (a, b) = (about_mean(&u), about_mean(&y));
            with += dot(&a, &b);
            u2 += dot(&a, &a);
            y2 += dot(&b, &b);
            motions.push(less(&u, &y, 1.0));
        }
        let found = argument(self.place, self.quantities[1], limits, motions)?;
        Some((with / (u2 * y2).sqrt(), found))
    }

    fn motion(&self, measured: &Measured<'_>, record: usize, limits: Limits) -> Motion {
        let [u, y] = self.motions(measured, record, limits);
        less(&u, &y, 1.0)
    }

    /// Motions of both, in the unit of the response.
    fn motions(&self, measured: &Measured<'_>, record: usize, limits: Limits) -> [Motion; 2] {
        let (rate, [of_drive, of_response]) = (measured.rate_hz(), self.quantities);
        let u: Vec<f64> = measured.drive(record, self.drive).iter().map(|u| self.factor * u).collect();
        // What is integrated has a lower limit, and so has all that it is compared with: the other, and its own rate.
        let inside = |x: &[f64]| beside(x, of_response, rate, limits);
        [
            motion(&inside(&u), of_drive, rate, limits),
            motion(&inside(measured.response(record, self.response)), of_response, rate, limits),
        ]
    }
}

/// Whether the one less the other is a motion: a drive that is integrated no more than the response.
fn comparable(drive: &Channel, response: &Channel) -> bool {
    let [drive, response] = [drive.quantity, response.quantity];
    drive.is_motion() && response.is_motion() && drive.integrals() <= response.integrals()
}

/// Largest ratio of a response to a drive, by H1 of Hann segments, half overlapping, where the drive has power.
fn peak(measured: &Measured<'_>, drive: usize, response: usize) -> f64 {
    let pairs: Vec<[&[f64]; 2]> = (0..measured.records())
        .map(|record| [measured.drive(record, drive), measured.response(record, response)])
        .collect();
    let shortest = pairs.iter().map(|[u, _]| u.len()).min().unwrap_or(0);
    let size = (1 << (shortest / SEGMENTS).max(16).ilog2()).min(LONGEST);
    let hann = Hann::new(size);
    let mut lines = vec![(0.0, Complex64::default()); size / 2 + 1];
    for [u, y] in pairs {
        for rows in hann.segments(u.len()) {
            let (of_drive, of_response) = (hann.lines(&u[rows.clone()]), hann.lines(&y[rows]));
            for ((own, cross), (u, y)) in lines.iter_mut().zip(of_drive.iter().zip(&of_response)) {
                *own += u.norm_sqr();
                *cross += u.conj() * y;
            }
        }
    }
    let most = lines.iter().map(|line| line.0).fold(0.0, f64::max);
    let loud = lines.iter().filter(|line| line.0 > QUIET * most);
    loud.map(|(own, cross)| cross.norm() / own).fold(0.0, f64::max)
}

fn about_mean(motion: &Motion) -> Vec<f64> {
    let centre = mean(&motion.d);
    motion.d.iter().map(|d| d - centre).collect()
}
