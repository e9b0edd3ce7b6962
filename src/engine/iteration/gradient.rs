//! Steps by the model's own gradient, for where its FRF leads no further.
//!
//! The gradient of the weighted square error `sum_t w_t |e_t|^2` by the drive is `g = -2 J^T W e`. Its preconditioner is
//! `M = C (2 W)^-1 C^T`, with `C` the inverse FRF on the lines that corrections reach: the inverse of the Gauss-Newton matrix
//! `2 J^T W J` of a model that is its FRF, so that a step of length 1 is the linear correction there. Directions are
//! conjugate by Polak and Ribiere's rule, and lengths come from parabolas (Nocedal and Wright, Numerical Optimization,
//! sections 3.5 and 5.2).

use super::correction::Reachable;
use crate::{EngineError, Signal};

/// Factor by which the first length of a step may be above or below the last good one.
const MOST_CHANGE: f64 = 4.0;

/// Shares between which a length that made it worse is shortened.
const SHORTER: [f64; 2] = [0.1, 0.5];

/// Share of the square error that a step must promise to take away.
const WORTH: f64 = 0.01;

/// The search along the model's gradient.
pub(super) struct Descent {
    reachable: Reachable,
    taper: Vec<f64>,
    line: Option<Line>,
    /// Whether the line begins at the best drive.
    aimed: bool,
    length: f64,
}

/// A line of drives, and the gradient that it comes from.
struct Line {
    gradient: Signal,
    /// The gradient times the preconditioner.
    conditioned: Signal,
    direction: Signal,
    /// Change of the square error per length at the line's beginning, negative.
    slope: f64,
}

impl Descent {
    /// Corrections are multiplied by `taper`, sample by sample.
    pub fn new(reachable: Reachable, taper: Vec<f64>) -> Self {
        Self { reachable, taper, line: None, aimed: false, length: 1.0 }
    }

    /// Length of the next step; 1 is the linear correction where the model is its FRF.
    pub fn length(&self) -> f64 {
        self.length
    }

    /// Whether [`Descent::step`] needs the gradient at the best drive first.
    pub fn needs_gradient(&self) -> bool {
        !self.aimed
    }

    /// Takes the gradient of the square error at the best drive, `[drive, sample]`, and that error. False where a step
    /// is not worth its time: the Gauss-Newton model promises next to nothing, half of the slope at length 1.
    ///
    /// # Errors
    /// A result that is not finite.
    pub fn aim(&mut self, gradient: Signal, square: f64) -> Result<bool, EngineError> {
        let conditioned = self.reachable.precondition(&gradient, &self.taper)?;
        let steepest = product(&gradient, &conditioned);
        if steepest <= 0.0 {
            return Ok(false);
        }
        let straight = || sum(&conditioned, -1.0, None);
        let direction = match &self.line {
            None => straight()?,
            Some(last) => {
                let before = product(&last.gradient, &last.conditioned);
                let turn = ((steepest - product(&last.gradient, &conditioned)) / before).max(0.0);
                let turned = sum(&conditioned, -1.0, Some((&last.direction, turn)))?;
                if product(&gradient, &turned) < 0.0 { turned } else { straight()? }
            }
        };
        let slope = product(&gradient, &direction);
        self.line = Some(Line { gradient, conditioned, direction, slope });
        self.aimed = true;
        Ok(-0.5 * slope > WORTH * square)
    }

    /// The drive one step from the best one.
    ///
    /// # Errors
    /// A drive that is not finite.
    ///
    /// # Panics
    /// Where the gradient is needed first.
    pub fn step(&self, best: &Signal) -> Result<Signal, EngineError> {
        let line = self.line.as_ref().filter(|_| self.aimed).expect("the gradient comes first");
        sum(best, 1.0, Some((&line.direction, self.length)))
    }

    /// Learns the next length from the square errors before and after a step; a step that was `kept` ends its line.
    pub fn learn(&mut self, before: f64, after: f64, kept: bool) {
        let slope = self.line.as_ref().map_or(0.0, |line| line.slope);
        let bend = after - before - slope * self.length;
        // The lowest point of the parabola through both errors with the slope; without one, as far as allowed.
        let lowest = if bend > 0.0 { -slope * self.length / (2.0 * bend) } else { f64::INFINITY };
        let [least, most] = if kept { [1.0 / MOST_CHANGE, MOST_CHANGE] } else { SHORTER };
        self.length *= lowest.clamp(least, most);
        self.aimed &= !kept;
    }

    /// Shortens the step after a drive that the model has no answer to.
    pub fn shorten(&mut self) {
        self.length *= SHORTER[0];
    }
}

fn product(a: &Signal, b: &Signal) -> f64 {
    let of = |(a, b): (&Vec<f64>, &Vec<f64>)| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    a.channels().iter().zip(b.channels()).map(of).sum()
}

/// `share a + other share * other`.
fn sum(a: &Signal, share: f64, other: Option<(&Signal, f64)>) -> Result<Signal, EngineError> {
    let of = |(channel, a): (usize, &Vec<f64>)| match other {
        None => a.iter().map(|a| share * a).collect(),
        Some((b, of_b)) => a.iter().zip(b.channel(channel)).map(|(a, b)| share * a + of_b * b).collect(),
    };
    let channels = a.channels().iter().enumerate().map(of).collect();
    Signal::new(a.sample_rate_hz(), channels).map_err(EngineError::of_result)
}
