//! A drive less the response that follows it.
//!
//! A controller acts on the command less what its sensor reads, and what stands on a table feels its own motion less the
//! table's. Both are the same signal; how the response follows tells which it is. Of each drive the response that
//! follows it best is taken: others follow it through the same.

use realfft::num_complex::Complex64;

use super::input::{Channel, Recording};
use super::motion::{Limits, Motion, beside, motion};
use super::place::{Argument, Place, argument, less};
use crate::Quantity;
use crate::diagnosis::numerics::hann::Hann;
use crate::diagnosis::numerics::linear::{dot, mean};

/// A response that moves, its quantity, and the limits that it is integrated in.
pub(super) type Sensor = (usize, Quantity, Limits);

/// Highest peak of a loop, the response over its command: one that is tuned well has about 1.25, a poor one more than 4
/// (Skogestad and Postlethwaite, Multivariable Feedback Control, 2.4). What stands on a table resonates.
const PEAK: f64 = 2.0;
/// Lines of a drive with less than this share of its strongest tell no peak.
const QUIET: f64 = 0.01;
/// Segments of the shortest record in which the peak is sought, and the longest of them, samples.
const SEGMENTS: usize = 16;
const LONGEST: usize = 4096;

/// The drive less the response that follows it best; `None` where none is of its kind, or none follows it.
pub(super) fn relative(
    recording: &Recording,
    drive: usize,
    seen: &[Sensor],
    limits: Limits,
    used: &[usize],
) -> Option<Argument> {
    let rate = recording.sample_rate_hz();
    let own = &recording.drives[drive];
    let of = |(r, response): (usize, &Channel)| -> Option<(f64, Argument)> {
        let factor = own.to_unit_of(response)?;
        let alike = own.quantity == response.quantity && own.quantity != Quantity::Other;
        let error = alike
            && response.quantity != Quantity::Acceleration
            && factor.recip() * peak(recording, drive, r, used) < PEAK;
        let (place, of_drive, of_response) = match (error, comparable(own, response)) {
            // A controller takes its error as it is, whatever it is an error of.
            (true, _) => (Place::Error(drive, r), Quantity::Other, Quantity::Other),
            (false, true) => (Place::OnTable(drive, r), own.quantity, response.quantity),
            (false, false) => return None,
        };
        let inside = seen.iter().find(|s| s.0 == r).map_or(limits, |s| s.2);
        let (mut with, mut u2, mut y2) = (0.0, 0.0, 0.0);
        let mut motions = Vec::new();
        for (record, &used) in recording.records.iter().zip(used) {
            // What is integrated has a lower limit, and the other then has it too.
            let u: Vec<f64> = record.drive.channel(drive)[..used].iter().map(|u| factor * u).collect();
            let u = beside(&u, of_response, rate, inside);
            let u = motion(&u, of_drive, rate, inside);
            let y = motion(&record.response.channel(r)[..used], of_response, rate, inside);
            let (a, b) = (about_mean(&u), about_mean(&y));
            with += dot(&a, &b);
            u2 += dot(&a, &a);
            y2 += dot(&b, &b);
            motions.push(less(&u, &y, 1.0));
        }
        let follows = with / (u2 * y2).sqrt();
        let found = argument(place, of_response, inside, motions)?;
        (follows > 0.0).then_some((follows, found))
    };
    let all = recording.responses.iter().enumerate().filter_map(of);
    all.max_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, argument)| argument)
}

/// Whether the one less the other is a motion: a drive that is integrated no more than the response.
fn comparable(drive: &Channel, response: &Channel) -> bool {
    let [drive, response] = [drive.quantity, response.quantity];
    drive.is_motion() && response.is_motion() && drive.integrals() <= response.integrals()
}

/// Largest ratio of a response to a drive, by H1 of Hann segments, half overlapping, where the drive has power.
fn peak(recording: &Recording, drive: usize, response: usize, used: &[usize]) -> f64 {
    let shortest = used.iter().copied().min().unwrap_or(0);
    let size = (1 << (shortest / SEGMENTS).max(16).ilog2()).min(LONGEST);
    let hann = Hann::new(size);
    let mut lines = vec![(0.0, Complex64::default()); size / 2 + 1];
    for (record, &used) in recording.records.iter().zip(used) {
        let (u, y) = (&record.drive.channel(drive)[..used], &record.response.channel(response)[..used]);
        for rows in hann.segments(used) {
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
