//! What the best linear frame leaves of a response.

use super::super::retune::{least_squares, ridged};
use super::super::rig::{COARSE, rms};
use super::body::{Beyond, Control, Frame, Stretch};

/// Rounds of the fit at most, and the most that a round moves a number, as a share of it.
const ROUNDS: usize = 8;
const STEP: f64 = 0.3;
/// Ridges by which a step is bounded, relative to each column's square (Levenberg and Marquardt).
const RIDGES: [f64; 4] = [1e-6, 1e-4, 1e-2, 1.0];
/// Share of what was left that a round leaves at least where the best is found.
const SETTLED: f64 = 0.97;
/// Taps of the filter through which each drive reaches each sensor beside the frame: its gain, its delay, its lag.
const TAPS: usize = 4;
/// Share by which a number is moved to see what it does.
const TRIAL: f64 = 0.01;

impl Frame {
    /// The frame's linear numbers.
    fn numbers(&mut self) -> Vec<&mut f64> {
        let n = self.masses;
        let mut all: Vec<&mut f64> = Vec::new();
        all.extend(&mut self.stiffness[..n]);
        all.extend(&mut self.damping[..n]);
        // The driven masses' forces follow their stiffness, so that masses are free too.
        all.extend(&mut self.mass[..n]);
        all.extend(&mut self.lag_hz);
        match &mut self.control {
            Control::Loop { gain, integral, spring } => all.extend([gain, integral, spring]),
            Control::Specimen => all.extend(&mut self.specimen),
            Control::Force => {}
        }
        all
    }

    fn moved(&self, shares: &[f64]) -> Self {
        let mut moved = self.clone();
        moved.numbers().into_iter().zip(shares).for_each(|(number, share)| *number *= 1.0 + share);
        moved
    }
}

/// Signals of all sensors, one after the other, each without its mean.
fn joined(responses: Vec<Vec<f64>>) -> Vec<f64> {
    let centred = responses.into_iter().flat_map(|y| {
        let mean = y.iter().sum::<f64>() / y.len() as f64;
        y.into_iter().map(move |y| y - mean)
    });
    centred.collect()
}

/// The linear frame on some drives, and what moves there with each of its numbers and with filters of a few taps from each
/// drive to each sensor.
pub struct Nearby {
    frame: Frame,
    drives: Vec<Vec<f64>>,
    moves: Moves,
}

/// A linear frame's responses, and what the filters add to them.
struct Filtered {
    linear: Vec<f64>,
    /// Of each tap from each drive to each sensor.
    columns: Vec<Vec<f64>>,
}

/// The same with what moves with each number.
struct Moves {
    filtered: Filtered,
    /// `[number][sample]`, a whole share of it each; those of the filters last.
    columns: Vec<Vec<f64>>,
    /// Number of those that are of no filter.
    numbers: usize,
}

/// The share of a target that is left, the largest over the sensors.
fn largest(rest: &[f64], target: &[f64], sensors: usize) -> f64 {
    let n = target.len() / sensors;
    let of = |i: usize| rms(&rest[i * n..(i + 1) * n]) / rms(&target[i * n..(i + 1) * n]);
    (0..sensors).map(of).fold(0.0, f64::max)
}

impl Nearby {
    pub fn new(frame: &Frame, drives: &[Vec<f64>]) -> Self {
        let moves = Moves::of(frame, drives, Filtered::of(frame, drives));
        Self { frame: frame.clone(), drives: drives.to_vec(), moves }
    }

    /// The share that a linear frame near this one leaves of the responses to what is beyond, the largest over the
    /// sensors.
    pub fn left(&self, beyond: &Beyond) -> f64 {
        self.moves.left(&self.responses(beyond), self.frame.sensors.len())
    }

    /// The same of the best linear frame, which may be farther away.
    pub fn left_by_the_best(&self, beyond: &Beyond) -> f64 {
        self.left_by_the_best_of(&self.responses(beyond))
    }

    fn left_by_the_best_of(&self, target: &[f64]) -> f64 {
        let sensors = self.frame.sensors.len();
        let mut frame = self.frame.clone();
        let mut filtered = Filtered::of(&frame, &self.drives);
        let mut rest = filtered.rest(target);
        for _ in 0..ROUNDS {
            let moves = Moves::of(&frame, &self.drives, filtered);
            let steps = RIDGES.iter().map(|ridge| {
                let there = frame.moved(&moves.step(target, *ridge));
                let filtered = Filtered::of(&there, &self.drives);
                let left = filtered.rest(target);
                (there, filtered, left)
            });
            let best = steps.min_by(|a, b| rms(&a.2).total_cmp(&rms(&b.2)));
            let Some(best) = best.filter(|best| rms(&best.2) < rms(&rest)) else { break };
            let settled = rms(&best.2) > SETTLED * rms(&rest);
            (frame, filtered, rest) = best;
            if settled {
                break;
            }
        }
        largest(&rest, target, sensors)
    }

    fn responses(&self, beyond: &Beyond) -> Vec<f64> {
        joined(self.frame.respond(Stretch { drives: &self.drives, process: None, steps: COARSE }, beyond))
    }
}

/// Responses of a linear frame to drives, from rest.
fn respond(frame: &Frame, drives: &[Vec<f64>]) -> Vec<f64> {
    joined(frame.respond(Stretch { drives, process: None, steps: COARSE }, &Beyond::NONE))
}

impl Filtered {
    fn of(frame: &Frame, drives: &[Vec<f64>]) -> Self {
        let linear = respond(frame, drives);
        let n = linear.len() / frame.sensors.len();
        let mut columns = Vec::new();
        for driven in 0..drives.len() {
            let alone = |(d, u): (usize, &Vec<f64>)| if d == driven { u.clone() } else { vec![0.0; u.len()] };
            let by_drive = respond(frame, &drives.iter().enumerate().map(alone).collect::<Vec<_>>());
            for sensor in 0..frame.sensors.len() {
                for tap in 0..TAPS {
                    let mut column = vec![0.0; linear.len()];
                    column[sensor * n + tap..(sensor + 1) * n]
                        .copy_from_slice(&by_drive[sensor * n..(sensor + 1) * n - tap]);
                    columns.push(column);
                }
            }
        }
        Self { linear, columns }
    }

    /// What the frame leaves of a target.
    fn beyond(&self, target: &[f64]) -> Vec<f64> {
        target.iter().zip(&self.linear).map(|(a, b)| a - b).collect()
    }

    /// What it leaves beside its filters.
    fn rest(&self, target: &[f64]) -> Vec<f64> {
        let beyond = self.beyond(target);
        let shares = least_squares(&self.columns, &beyond);
        without(beyond, &self.columns, &shares)
    }
}

impl Moves {
    fn of(frame: &Frame, drives: &[Vec<f64>], filtered: Filtered) -> Self {
        let numbers = frame.clone().numbers().len();
        let moved = |i: usize| -> Vec<f64> {
            let shares: Vec<f64> = (0..numbers).map(|j| if i == j { TRIAL } else { 0.0 }).collect();
            let there = respond(&frame.moved(&shares), drives);
            there.iter().zip(&filtered.linear).map(|(a, b)| (a - b) / TRIAL).collect()
        };
        let columns = (0..numbers).map(moved).chain(filtered.columns.iter().cloned()).collect();
        Self { filtered, columns, numbers }
    }

    /// Shares by which to move each number.
    fn step(&self, target: &[f64], ridge: f64) -> Vec<f64> {
        let shares = ridged(&self.columns, &self.filtered.beyond(target), ridge);
        shares[..self.numbers].iter().map(|s| s.clamp(-STEP, STEP)).collect()
    }

    /// What is left of the target as far as all moves are straight, the largest over the sensors.
    fn left(&self, target: &[f64], sensors: usize) -> f64 {
        let beyond = self.filtered.beyond(target);
        let shares = least_squares(&self.columns, &beyond);
        let left = largest(&without(beyond, &self.columns, &shares), target, sensors);
        if left.is_finite() { left } else { f64::INFINITY }
    }
}

/// What is left of a signal without columns in their shares.
fn without(mut rest: Vec<f64>, columns: &[Vec<f64>], shares: &[f64]) -> Vec<f64> {
    for (column, share) in columns.iter().zip(shares) {
        rest.iter_mut().zip(column).for_each(|(r, c)| *r -= share * c);
    }
    rest
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::super::super::drives;
    use super::super::super::suites::Suite;
    use super::super::draw::{self, Wanted};
    use super::*;

    #[test]
    fn the_best_linear_frame_of_another_linear_frame_leaves_nothing() {
        let rng = &mut ChaCha8Rng::seed_from_u64(5);
        let wanted = Wanted { suite: Suite::Place, elsewhere: false, looped: false };
        let frame = draw::frame(wanted, rng);
        let drives: Vec<Vec<f64>> = frame.driven.iter().map(|_| drives::noise(8.0, 30.0, rng)).collect();
        let frame = frame.scaled(&drives);
        let mut other = frame.clone();
        other.numbers().into_iter().zip([1.1, 0.95].iter().cycle()).for_each(|(number, by)| *number *= by);
        let target = Nearby::new(&other, &drives).responses(&Beyond::NONE);
        let nearby = Nearby::new(&frame, &drives);
        let before = largest(&nearby.moves.filtered.rest(&target), &target, frame.sensors.len());
        let after = nearby.left_by_the_best_of(&target);
        assert!(before > 0.1 && after < 0.02, "{before} {after}");
    }
}
