//! What the best linear frame leaves of a response.

use super::super::retune::least_squares;
use super::super::rig::{COARSE, rms};
use super::body::{Beyond, Control, Frame, Stretch};

/// Rounds of the fit, and the most that a round moves a number, as a share of it.
const ROUNDS: usize = 3;
const STEP: f64 = 0.3;
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

/// The linear frame on some drives, and what moves there with each of its numbers and each sensor's gain.
pub struct Nearby {
    frame: Frame,
    drives: Vec<Vec<f64>>,
    moves: Moves,
}

struct Moves {
    linear: Vec<f64>,
    /// `[number][sample]`, a whole share of it each.
    columns: Vec<Vec<f64>>,
}

impl Nearby {
    pub fn new(frame: &Frame, drives: &[Vec<f64>]) -> Self {
        let moves = Moves::of(frame, drives);
        Self { frame: frame.clone(), drives: drives.to_vec(), moves }
    }

    /// The share that a linear frame near this one leaves of the responses to what is beyond, the largest over the
    /// sensors.
    pub fn left(&self, beyond: &Beyond) -> f64 {
        self.moves.fit(&self.responses(beyond), self.frame.sensors.len()).1
    }

    /// The same of the best linear frame, which may be farther away.
    pub fn left_by_the_best(&self, beyond: &Beyond) -> f64 {
        let target = self.responses(beyond);
        let mut frame = self.frame.clone();
        let mut least = f64::INFINITY;
        for _ in 0..ROUNDS {
            let (shares, left) = Moves::of(&frame, &self.drives).fit(&target, frame.sensors.len());
            least = least.min(left);
            frame = frame.moved(&shares);
        }
        least
    }

    fn responses(&self, beyond: &Beyond) -> Vec<f64> {
        joined(self.frame.respond(Stretch { drives: &self.drives, process: None, steps: COARSE }, beyond))
    }
}

impl Moves {
    fn of(frame: &Frame, drives: &[Vec<f64>]) -> Self {
        let respond = |frame: &Frame| {
            joined(frame.respond(Stretch { drives, process: None, steps: COARSE }, &Beyond::NONE))
        };
        let linear = respond(frame);
        let count = frame.clone().numbers().len();
        let moved = |i: usize| {
            let shares: Vec<f64> = (0..count).map(|j| if i == j { TRIAL } else { 0.0 }).collect();
            let there = respond(&frame.moved(&shares));
            there.iter().zip(&linear).map(|(a, b)| (a - b) / TRIAL).collect()
        };
        let mut columns: Vec<Vec<f64>> = (0..count).map(moved).collect();
        let n = linear.len() / frame.sensors.len();
        for sensor in 0..frame.sensors.len() {
            let own = sensor * n..(sensor + 1) * n;
            let gain = linear.iter().enumerate().map(|(i, y)| if own.contains(&i) { *y } else { 0.0 });
            columns.push(gain.collect());
        }
        Self { linear, columns }
    }

    /// Shares by which to move each number, and what is then left of the target, the largest over the sensors.
    fn fit(&self, target: &[f64], sensors: usize) -> (Vec<f64>, f64) {
        let mut rest: Vec<f64> = target.iter().zip(&self.linear).map(|(a, b)| a - b).collect();
        let shares = least_squares(&self.columns, &rest);
        for (column, share) in self.columns.iter().zip(&shares) {
            rest.iter_mut().zip(column).for_each(|(r, c)| *r -= share * c);
        }
        let n = target.len() / sensors;
        let of = |i: usize| rms(&rest[i * n..(i + 1) * n]) / rms(&target[i * n..(i + 1) * n]);
        let left = (0..sensors).map(of).fold(0.0, f64::max);
        let bounded = shares[..shares.len() - sensors].iter().map(|s| s.clamp(-STEP, STEP)).collect();
        (bounded, if left.is_finite() { left } else { f64::INFINITY })
    }
}
