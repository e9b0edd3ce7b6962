//! What a sim fitted on the rig itself leaves of a flaw: its linear numbers follow the low-level run.

use super::rig::{COARSE, Rig, Span};

/// A linear rig and how its responses move with each of its numbers, on a low-level run and on a
/// stretch of the programme.
pub struct Retune {
    linear: [Vec<f64>; 2],
    /// `[number][sample]` of either run.
    moves: [Vec<Vec<f64>>; 2],
}

impl Retune {
    /// For the first response on `low` and on `long`, drives `[drive][sample]`.
    pub fn new(rig: &Rig, low: &[Vec<f64>], long: &[Vec<f64>]) -> Self {
        let first = |rig: &Rig, drives: &[Vec<f64>]| {
            rig.respond(Span { drives, time: [0.0, 0.0], steps: COARSE }, &[]).swap_remove(0)
        };
        let linear = [first(rig, low), first(rig, long)];
        let varied = rig.varied();
        let moves = [low, long].map(|drives| {
            let base = first(rig, drives);
            let mut moves: Vec<Vec<f64>> = varied
                .iter()
                .map(|other| first(other, drives).iter().zip(&base).map(|(a, b)| a - b).collect())
                .collect();
            moves.push(vec![1.0; base.len()]);
            moves
        });
        Self { linear, moves }
    }

    /// The sim's response on the long run, after its numbers were moved to fit `low`, the response
    /// there with the flaw.
    pub fn sim(&self, low: &[f64]) -> Vec<f64> {
        let target: Vec<f64> = low.iter().zip(&self.linear[0]).map(|(a, b)| a - b).collect();
        let weights = least_squares(&self.moves[0], &target);
        let mut sim = self.linear[1].clone();
        for (column, w) in self.moves[1].iter().zip(weights) {
            sim.iter_mut().zip(column).for_each(|(s, c)| *s += w * c);
        }
        sim
    }
}

/// Weights of the columns that sum to the target best: normal equations with a trace of a ridge, by
/// elimination.
fn least_squares(columns: &[Vec<f64>], target: &[f64]) -> Vec<f64> {
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let n = columns.len();
    let norms: Vec<f64> = columns.iter().map(|c| dot(c, c).sqrt().max(f64::MIN_POSITIVE)).collect();
    let mut rows: Vec<Vec<f64>> = (0..n)
        .map(|i| {
            let mut row: Vec<f64> =
                (0..n).map(|j| dot(&columns[i], &columns[j]) / (norms[i] * norms[j])).collect();
            row[i] += 1e-9;
            row.push(dot(&columns[i], target) / norms[i]);
            row
        })
        .collect();
    for i in 0..n {
        for j in i + 1..n {
            let factor = rows[j][i] / rows[i][i];
            let pivot = rows[i].clone();
            rows[j].iter_mut().zip(&pivot).for_each(|(x, p)| *x -= factor * p);
        }
    }
    let mut x = vec![0.0; n];
    for i in (0..n).rev() {
        let known: f64 = (i + 1..n).map(|j| rows[i][j] * x[j]).sum();
        x[i] = (rows[i][n] - known) / rows[i][i];
    }
    x.iter().zip(&norms).map(|(x, norm)| x / norm).collect()
}
