//! The local scale of residuals: mean squares over a window, and their fit by squares that add up.

/// The floor is at least this share of the residuals' mean square: a scale of zero says nothing.
const LEAST_FLOOR: f64 = 1e-4;

/// Rounds in which the rows are weighted by the scale itself.
const ROUNDS: usize = 6;

/// Mean of the squares over up to `window` samples about each one; fewer at the ends.
pub(super) fn moving_mean_square(values: impl Iterator<Item = f64>, window: usize) -> Vec<f64> {
    let mut sums = vec![0.0];
    sums.extend(values.scan(0.0, |sum, v| {
        *sum += v * v;
        Some(*sum)
    }));
    let n = sums.len() - 1;
    let (before, after) = (window / 2, window - window / 2);
    (0..n)
        .map(|t| {
            let (from, to) = (t.saturating_sub(before), n.min(t + after));
            ((sums[to] - sums[from]) / (to - from) as f64).max(0.0)
        })
        .collect()
}

/// Squares of floor, level and correction, none below zero, that fit the rows `(features, mean square)` best in relative
/// terms.
pub(super) fn fit(rows: &[([f64; 3], f64)]) -> [f64; 3] {
    let n = rows.len().max(1) as f64;
    let mean = rows.iter().map(|(_, square)| square).sum::<f64>() / n;
    if mean <= 0.0 {
        return [0.0; 3];
    }
    let mut found = [mean, 0.0, 0.0];
    for _ in 0..ROUNDS {
        let expected = |x: &[f64; 3]| {
            let fitted: f64 = x.iter().zip(&found).map(|(x, f)| x * f).sum();
            fitted.max(LEAST_FLOOR * mean)
        };
        let weighted: Vec<([f64; 3], f64)> =
            rows.iter().map(|(x, square)| (x.map(|v| v / expected(x)), square / expected(x))).collect();
        found = non_negative(&weighted);
    }
    found[0] = found[0].max(LEAST_FLOOR * mean);
    found
}

/// Least squares with coefficients that are not negative: the best of all choices of columns.
fn non_negative(rows: &[([f64; 3], f64)]) -> [f64; 3] {
    let mut gram = [[0.0; 3]; 3];
    let mut right = [0.0; 3];
    for (x, y) in rows {
        for i in 0..3 {
            right[i] += x[i] * y;
            (0..3).for_each(|j| gram[i][j] += x[i] * x[j]);
        }
    }
    let mut best = ([0.0; 3], 0.0);
    for chosen in 1..8_usize {
        let columns: Vec<usize> = (0..3).filter(|i| chosen >> i & 1 == 1).collect();
        let Some(found) = solve(&gram, &right, &columns) else { continue };
        // By how much it lowers the sum of squares.
        let gain: f64 = found.iter().zip(&right).map(|(f, r)| f * r).sum();
        if found.iter().all(|f| *f >= 0.0) && gain > best.1 {
            best = (found, gain);
        }
    }
    best.0
}

/// Solves the normal equations of some columns by elimination; the others are zero. `None` where columns say the same.
fn solve(gram: &[[f64; 3]; 3], right: &[f64; 3], columns: &[usize]) -> Option<[f64; 3]> {
    // Scaled so that the diagonal is one.
    let size = |i: usize| gram[i][i].sqrt();
    if columns.iter().any(|&i| size(i) <= 0.0) {
        return None;
    }
    let n = columns.len();
    let mut rows: Vec<Vec<f64>> = columns
        .iter()
        .map(|&i| {
            let left = columns.iter().map(|&j| gram[i][j] / size(i) / size(j));
            left.chain([right[i] / size(i)]).collect()
        })
        .collect();
    for pivot in 0..n {
        if rows[pivot][pivot] < 1e-9 {
            return None;
        }
        let (above, below) = rows.split_at_mut(pivot + 1);
        for row in below {
            let factor = row[pivot] / above[pivot][pivot];
            row.iter_mut().zip(&above[pivot]).for_each(|(v, p)| *v -= factor * p);
        }
    }
    let mut found = [0.0; 3];
    let mut solved = vec![0.0; n];
    for pivot in (0..n).rev() {
        let known: f64 = (pivot + 1..n).map(|column| rows[pivot][column] * solved[column]).sum();
        solved[pivot] = (rows[pivot][n] - known) / rows[pivot][pivot];
        found[columns[pivot]] = solved[pivot] / size(columns[pivot]);
    }
    Some(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_window_lies_about_its_sample_and_is_shorter_at_the_ends() {
        let found = moving_mean_square([1.0, 0.0, 2.0, 0.0].into_iter(), 2);
        assert_eq!(found, [1.0, 0.5, 2.0, 2.0]);
        assert_eq!(moving_mean_square([3.0].into_iter(), 256), [9.0]);
        assert!(moving_mean_square(std::iter::empty(), 256).is_empty());
    }
}
