//! A sim that was fitted on the rig itself: its linear parameters follow the low-level run, flaw included.

use super::rig::{COARSE, Rig, Span};

/// Rounds of the fit, and the most that a round moves a number, percent.
const ROUNDS: usize = 3;
const STEP: f64 = 30.0;

/// A rig whose linear numbers are fitted to the first response `low` to `drives`, and that response's
/// mean beside it.
pub fn retuned(rig: &Rig, drives: &[Vec<f64>], low: &[f64]) -> (Rig, f64) {
    let mut found = (rig.clone(), 0.0);
    for _ in 0..ROUNDS {
        let moves = Moves::new(&found.0, drives);
        let weights = moves.fit(low);
        let (mean, percent) = weights.split_last().expect("the mean is always among them");
        let percent: Vec<f64> = percent.iter().map(|p| p.clamp(-STEP, STEP)).collect();
        found = (found.0.moved(&percent), *mean);
    }
    found
}

/// Sensitivity of the first response of a linear rig to each of its parameters, and to a mean.
pub struct Moves {
    linear: Vec<f64>,
    /// `[number][sample]`, per percent; the mean last.
    columns: Vec<Vec<f64>>,
}

impl Moves {
    /// On drives `[drive][sample]`.
    pub fn new(rig: &Rig, drives: &[Vec<f64>]) -> Self {
        let first =
            |rig: &Rig| rig.respond(Span { drives, time: [0.0, 0.0], steps: COARSE }, &[]).swap_remove(0);
        let linear = first(rig);
        let n = rig.numbers();
        let mut columns: Vec<Vec<f64>> = (0..n)
            .map(|i| {
                let one: Vec<f64> = (0..n).map(|j| if i == j { 1.0 } else { 0.0 }).collect();
                first(&rig.moved(&one)).iter().zip(&linear).map(|(a, b)| a - b).collect()
            })
            .collect();
        columns.push(vec![1.0; linear.len()]);
        Self { linear, columns }
    }

    /// Percent of each number, and the mean, with which a response is met best.
    pub fn fit(&self, response: &[f64]) -> Vec<f64> {
        let target: Vec<f64> = response.iter().zip(&self.linear).map(|(a, b)| a - b).collect();
        least_squares(&self.columns, &target)
    }

    /// The response with the numbers moved so.
    pub fn response(&self, percent: &[f64]) -> Vec<f64> {
        let mut out = self.linear.clone();
        for (column, p) in self.columns.iter().zip(percent) {
            out.iter_mut().zip(column).for_each(|(o, c)| *o += p * c);
        }
        out
    }
}

/// Weights of the columns that sum to the target best, with a trace of a ridge.
pub fn least_squares(columns: &[Vec<f64>], target: &[f64]) -> Vec<f64> {
    ridged(columns, target, 1e-9)
}

/// The same with a ridge, relative to each column's square: normal equations, by elimination.
pub fn ridged(columns: &[Vec<f64>], target: &[f64], ridge: f64) -> Vec<f64> {
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let n = columns.len();
    let norms: Vec<f64> = columns.iter().map(|c| dot(c, c).sqrt().max(f64::MIN_POSITIVE)).collect();
    let mut rows: Vec<Vec<f64>> = (0..n)
        .map(|i| {
            let mut row: Vec<f64> =
                (0..n).map(|j| dot(&columns[i], &columns[j]) / (norms[i] * norms[j])).collect();
            row[i] += ridge;
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
