//! The fit of the local scale of residuals: squares that add up.

/// The floor is at least this share of the residuals' mean square: a scale of zero says nothing.
const LEAST_FLOOR: f64 = 1e-4;

/// Largest coefficient but the first. A signal of which the residual is more than twice has nothing to do with it: a network
/// that hardly changes an FRF would else make any change that it does make elsewhere look like a large error.
const MOST: f64 = 4.0;

/// Rounds in which the rows are weighted by the scale itself.
const ROUNDS: usize = 6;

/// What the mean square of a residual over a window is told by, the first of it 1; and the mean square.
pub(super) type Row<const N: usize> = ([f64; N], f64);

/// The coefficients, none below zero, the first of them above it and the others at most [`MOST`], that fit the rows best in
/// relative terms.
pub(super) fn fit<const N: usize>(rows: &[Row<N>]) -> [f64; N] {
    let n = rows.len().max(1) as f64;
    let mean = rows.iter().map(|(_, square)| square).sum::<f64>() / n;
    if mean <= 0.0 {
        return [0.0; N];
    }
    let mut found = [0.0; N];
    found[0] = mean;
    for _ in 0..ROUNDS {
        let expected = |x: &[f64; N]| {
            let fitted: f64 = x.iter().zip(&found).map(|(x, f)| x * f).sum();
            fitted.max(LEAST_FLOOR * mean)
        };
        let weighted: Vec<Row<N>> =
            rows.iter().map(|(x, square)| (x.map(|v| v / expected(x)), square / expected(x))).collect();
        found = non_negative(&weighted);
    }
    found[0] = found[0].max(LEAST_FLOOR * mean);
    found
}

/// Least squares with coefficients that are not negative and not too large: the best of all choices of columns.
fn non_negative<const N: usize>(rows: &[Row<N>]) -> [f64; N] {
    let mut gram = [[0.0; N]; N];
    let mut right = [0.0; N];
    for (x, y) in rows {
        for i in 0..N {
            right[i] += x[i] * y;
            (0..N).for_each(|j| gram[i][j] += x[i] * x[j]);
        }
    }
    let mut best = ([0.0; N], 0.0);
    for chosen in 1..1_usize << N {
        let columns: Vec<usize> = (0..N).filter(|i| chosen >> i & 1 == 1).collect();
        let Some(found) = solve(&gram, &right, &columns) else { continue };
        // By how much it lowers the sum of squares.
        let gain: f64 = found.iter().zip(&right).map(|(f, r)| f * r).sum();
        let possible = found[0] >= 0.0 && found[1..].iter().all(|f| (0.0..=MOST).contains(f));
        if possible && gain > best.1 {
            best = (found, gain);
        }
    }
    best.0
}

/// Solves the normal equations of some columns by elimination; the others are zero. `None` where columns say the same.
fn solve<const N: usize>(gram: &[[f64; N]; N], right: &[f64; N], columns: &[usize]) -> Option<[f64; N]> {
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
    let mut found = [0.0; N];
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
    fn coefficients_that_add_up_are_found_and_those_of_no_use_are_zero() {
        let row = |t: usize| {
            let (a, b) = (f64::from(t as u32 % 7), f64::from(t as u32 % 11));
            ([1.0, a, b, a * b], 0.2 + 3.0 * b)
        };
        let rows: Vec<Row<4>> = (0..500).map(row).collect();
        let found = fit(&rows);
        let expected = [0.2, 0.0, 3.0, 0.0];
        assert!(found.iter().zip(expected).all(|(f, e)| (f - e).abs() < 1e-9), "{found:?}");
        // A column twice, and one that would have to be subtracted.
        let rows: Vec<Row<3>> = rows.iter().map(|(x, y)| ([1.0, x[2], x[2]], 40.0 - y)).collect();
        let found = fit(&rows);
        assert!(found[0] > 1.0 && found[1] == 0.0 && found[2] == 0.0, "{found:?}");
    }

    #[test]
    fn a_signal_much_smaller_than_the_residual_tells_nothing_of_it() {
        let rows: Vec<Row<2>> =
            (0..500_u32).map(|t| ([1.0, 1e-12 * f64::from(t % 7)], 1.0 + f64::from(t % 7))).collect();
        let found = fit(&rows);
        assert!(found[1] == 0.0 && (2.0..6.0).contains(&found[0]), "{found:?}");
    }

    #[test]
    fn residuals_of_zero_have_no_scale() {
        assert_eq!(fit(&[([1.0, 2.0], 0.0), ([1.0, 3.0], 0.0)]), [0.0; 2]);
        assert_eq!(fit::<3>(&[]), [0.0; 3]);
    }
}
