//! Levenberg and Marquardt's least squares with difference quotients (Marquardt 1963).

use super::linear::{dot, from_columns, inverse_spd, solve_spd, transposed_times};

/// A fit whose cost falls by more than this share in a round is not where it goes to: it gets so many times the rounds.
const FALLS: f64 = 0.2;
const LONGER: usize = 3;
/// Columns from which on their products are one of matrices: one by one, each column comes from memory as often as there are
/// others.
const MANY: usize = 128;
/// How far a parameter is moved for a difference quotient, in units of its scale.
const STEP: f64 = 1e-3;

/// Where a fit ended.
#[derive(Debug, Clone)]
pub struct Fit {
    /// Parameters.
    pub p: Vec<f64>,
    /// Sum of squares of the rows.
    pub cost: f64,
}

/// Limits of one fit.
#[derive(Debug, Clone, Copy)]
pub struct Limits {
    /// Jacobians; more while the cost still falls fast.
    pub rounds: usize,
    /// Relative fall of the cost below which a round counts as standing still.
    pub still: f64,
    /// Cost at which nothing is left to explain.
    pub enough: f64,
}

/// Minimises the sum of squares of `rows(p)` from `start`; `scale` is the size of a change of each
/// parameter that matters. `rows` answers `None` where there is no answer (a free run ran away), and
/// `derivatives` where it knows none better than difference quotients. `None` if even the start has
/// no rows.
pub fn minimise(
    rows: impl Fn(&[f64]) -> Option<Vec<f64>>,
    derivatives: impl Fn(&[f64]) -> Option<Vec<Column>>,
    start: &[f64],
    scale: &[f64],
    limits: Limits,
) -> Option<Fit> {
    let mut p = start.to_vec();
    let mut now = rows(&p)?;
    let mut cost = dot(&now, &now);
    let mut damping = 1e-3;
    let mut standing = 0;
    let mut falls = false;
    for round in 0..LONGER * limits.rounds {
        if cost <= limits.enough || p.is_empty() || (round >= limits.rounds && !falls) {
            break;
        }
        let jacobian = derivatives(&p).unwrap_or_else(|| quotients(&rows, &p, scale, &now));
        let (normal, gradient) = normal_equations(&jacobian, &now);
        let before = cost;
        for _ in 0..8 {
            let mut damped = normal.clone();
            for (i, row) in damped.iter_mut().enumerate() {
                row[i] += damping;
            }
            let step = solve_spd(&damped, &gradient);
            let tried = step.and_then(|step| {
                let next: Vec<f64> =
                    p.iter().zip(step.iter().zip(&jacobian)).map(|(p, (s, c))| p - s * c.unit).collect();
                let rows = rows(&next)?;
                Some((dot(&rows, &rows), next, rows))
            });
            if let Some((next_cost, next, next_rows)) = tried.filter(|t| t.0 < cost) {
                (cost, p, now) = (next_cost, next, next_rows);
                damping = (damping * 0.2).max(1e-9);
                break;
            }
            damping *= 5.0;
        }
        falls = before - cost > FALLS * before;
        standing = if before - cost < limits.still * before { standing + 1 } else { 0 };
        if standing >= 2 || cost >= before {
            break;
        }
    }
    Some(Fit { p, cost })
}

/// Derivative of all rows by one parameter, scaled to unit length.
pub struct Column {
    /// Unit vector, or zeros.
    pub values: Vec<f64>,
    /// Parameter change that moves the rows by one unit.
    pub unit: f64,
}

/// Difference quotients of the rows at `p`.
pub fn quotients(
    rows: &impl Fn(&[f64]) -> Option<Vec<f64>>,
    p: &[f64],
    scale: &[f64],
    now: &[f64],
) -> Vec<Column> {
    (0..p.len())
        .map(|j| {
            for step in [STEP, -STEP, 0.05 * STEP] {
                let h = step * scale[j];
                let mut moved = p.to_vec();
                moved[j] += h;
                let Some(there) = rows(&moved) else { continue };
                let values: Vec<f64> = there.iter().zip(now).map(|(a, b)| (a - b) / h).collect();
                let length = dot(&values, &values).sqrt();
                if length > 0.0 && length.is_finite() {
                    return Column {
                        values: values.iter().map(|v| v / length).collect(),
                        unit: 1.0 / length,
                    };
                }
            }
            Column { values: vec![0.0; now.len()], unit: 0.0 }
        })
        .collect()
}

/// `J^T J` and `J^T r` of scaled columns; a dead column gets a row of its own.
fn normal_equations(jacobian: &[Column], rows: &[f64]) -> (Vec<Vec<f64>>, Vec<f64>) {
    let n = jacobian.len();
    let mut normal = vec![vec![0.0; n]; n];
    let products = (n > MANY).then(|| {
        let values: Vec<&[f64]> = jacobian.iter().map(|column| column.values.as_slice()).collect();
        let columns = from_columns(rows.len(), &values);
        transposed_times(&columns, &columns)
    });
    for i in 0..n {
        for j in 0..=i {
            let sum = match &products {
                Some(products) => products[(i, j)],
                None => dot(&jacobian[i].values, &jacobian[j].values),
            };
            normal[i][j] = sum;
            normal[j][i] = sum;
        }
        if jacobian[i].unit == 0.0 {
            normal[i][i] = 1.0;
        }
    }
    (normal, jacobian.iter().map(|c| dot(&c.values, rows)).collect())
}

/// Standard errors of the parameters where the rows have variance `variance`; infinite where the
/// rows do not tell a parameter.
pub fn standard_errors(
    rows: impl Fn(&[f64]) -> Option<Vec<f64>>,
    p: &[f64],
    scale: &[f64],
    variance: f64,
) -> Vec<f64> {
    let Some(now) = rows(p) else { return vec![f64::INFINITY; p.len()] };
    let jacobian = quotients(&rows, p, scale, &now);
    let (mut normal, _) = normal_equations(&jacobian, &now);
    for (i, row) in normal.iter_mut().enumerate() {
        row[i] += 1e-12;
    }
    match inverse_spd(&normal) {
        Some(inverse) => jacobian
            .iter()
            .enumerate()
            .map(
                |(i, c)| {
                    if c.unit > 0.0 { (inverse[i][i] * variance).sqrt() * c.unit } else { f64::INFINITY }
                },
            )
            .collect(),
        None => vec![f64::INFINITY; p.len()],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn decay(p: &[f64]) -> Option<Vec<f64>> {
        let ok = p[1] > 0.0;
        ok.then(|| {
            (0..40)
                .map(|k| {
                    let t = f64::from(k) * 0.1;
                    p[0] * 1e6 * (-p[1] * t).exp() - 3e6 * (-0.7 * t).exp()
                })
                .collect()
        })
    }

    #[test]
    fn an_exponential_is_found_from_afar_in_any_unit() {
        let limits = Limits { rounds: 40, still: 1e-12, enough: 0.0 };
        let fit = minimise(decay, |_| None, &[1.0, 3.0], &[1.0, 1.0], limits).unwrap();
        assert!((fit.p[0] - 3.0).abs() < 1e-6 && (fit.p[1] - 0.7).abs() < 1e-6, "{fit:?}");
        assert!(minimise(decay, |_| None, &[1.0, -1.0], &[1.0, 1.0], limits).is_none());
    }

    #[test]
    fn standard_errors_are_those_of_linear_regression() {
        let rows = |p: &[f64]| Some((0..10).map(|k| p[0] * f64::from(k)).collect::<Vec<f64>>());
        let se = standard_errors(rows, &[2.0], &[1.0], 4.0);
        assert!((se[0] / (4.0 / 285.0_f64).sqrt() - 1.0).abs() < 1e-6);
    }

    #[test]
    fn products_of_many_columns_are_those_of_each_pair() {
        let column = |c: usize| Column {
            values: (0..300).map(|r| ((r * (c + 3)) as f64).sin()).collect(),
            unit: f64::from(u8::from(c != 7)),
        };
        let columns: Vec<Column> = (0..MANY + 2).map(column).collect();
        let rows: Vec<f64> = (0..300).map(|r| f64::from(r).cos()).collect();
        let (normal, gradient) = normal_equations(&columns, &rows);
        for (i, a) in columns.iter().enumerate() {
            assert_eq!(gradient[i], dot(&a.values, &rows));
            for (j, b) in columns.iter().enumerate() {
                let expected = if i == j && i == 7 { 1.0 } else { dot(&a.values, &b.values) };
                assert!((normal[i][j] - expected).abs() < 1e-10, "{i} {j}");
            }
        }
    }
}
