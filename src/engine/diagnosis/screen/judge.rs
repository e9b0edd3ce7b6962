//! Held-out errors: the linear part is factored once a group, and a candidate's few columns join it by a Schur
//! complement.

use faer::Mat;
use rayon::prelude::*;
use rigcast_numerics::decompose::Cholesky;

use super::linear_part::Setting;
use super::moments::Moments;
use super::regressors::Regressors;
use super::track::Segment;
use crate::diagnosis::numerics::linear::{dot, from_columns, transposed_times};

/// Ridge of a candidate's columns relative to their power: what the linear part holds already gets nothing.
const RIDGE: f64 = 1e-8;
/// Smallest relative error that a difference of sums of squares can tell.
const FLOOR: f64 = 1e-6;

/// The linear part fitted without a group, for all responses, and what it leaves in that group.
struct Fold {
    factor: Cholesky,
    /// Coefficients, a column a response.
    theta: Mat<f64>,
    /// Lagged drives of the group with what is left of the responses.
    left: Mat<f64>,
    /// Square of what is left.
    rr: Vec<f64>,
}

/// The linear part and its sums, ready for candidates.
pub(super) struct Base<'a> {
    pub segments: &'a [Segment],
    /// Responses of every segment, centred and weighted, `[segment][response]`.
    pub responses: Vec<Vec<Vec<f64>>>,
    regressors: Regressors,
    groups: Vec<Moments>,
    total: Moments,
    folds: Vec<Fold>,
    whole: Fold,
    setting: Setting,
}

/// Columns of a law, or of the linear signal at its place, and their sums group by group.
#[derive(Clone)]
pub(super) struct Block {
    /// `[segment]`: rows by columns.
    columns: Vec<Mat<f64>>,
    /// Lagged drives with the columns.
    cross: Vec<Mat<f64>>,
    /// What of `cross` the linear part without the group takes: coefficients.
    solved: Vec<Mat<f64>>,
    gram: Vec<Mat<f64>>,
    /// Columns with the response.
    target: Vec<Mat<f64>>,
    /// What each column was scaled by.
    norms: Vec<f64>,
}

/// Coefficients of the linear part beside a block, and of the block's columns as they came.
#[derive(Debug, Clone)]
pub(super) struct Coefficients {
    /// Impulse response of each drive, from the lag `-lead` on.
    pub impulses: Vec<Vec<f64>>,
    /// One a column.
    pub columns: Vec<f64>,
}

/// A candidate's held-out errors relative to the response, by group.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct HeldOut {
    pub errors: Vec<f64>,
}

impl HeldOut {
    /// Takes another's error where that is less.
    pub fn lower_to(&mut self, other: &Self) {
        self.errors.iter_mut().zip(&other.errors).for_each(|(own, other)| *own = own.min(*other));
    }
}

impl<'a> Base<'a> {
    /// Factors the linear part without each group. `None` where it is singular to rounding.
    pub fn new(
        moments: &[Moments],
        segments: &'a [Segment],
        responses: Vec<Vec<Vec<f64>>>,
        regressors: Regressors,
        setting: Setting,
    ) -> Option<Self> {
        let n_groups = segments.iter().map(|s| s.group + 1).max()?;
        let groups: Vec<Moments> = (0..n_groups)
            .map(|g| Moments::sum(moments.iter().zip(segments).filter(|(_, s)| s.group == g).map(|(m, _)| m)))
            .collect::<Option<_>>()?;
        let total = Moments::sum(&groups)?;
        let fold = |group: &Moments, others: &Mat<f64>, b: Mat<f64>| -> Option<Fold> {
            let factor = setting.factor(others)?;
            let theta = factor.solve(&b);
            let through = &group.a * &theta;
            let left = &group.b - &through;
            let rr = (0..group.yy.len())
                .map(|r| {
                    let taken: f64 =
                        (0..theta.nrows()).map(|k| theta[(k, r)] * (group.b[(k, r)] + left[(k, r)])).sum();
                    (group.yy[r] - taken).max(FLOOR * FLOOR * group.yy[r])
                })
                .collect();
            Some(Fold { factor, theta, left, rr })
        };
        let folds: Vec<Fold> =
            groups.par_iter().map(|g| fold(g, &(&total.a - &g.a), &total.b - &g.b)).collect::<Option<_>>()?;
        let whole = fold(&total, &total.a, total.b.clone())?;
        Some(Self { segments, responses, regressors, groups, total, folds, whole, setting })
    }

    /// Number of groups.
    pub fn n_groups(&self) -> usize {
        self.groups.len()
    }

    /// How the linear part is set.
    pub fn setting(&self) -> &Setting {
        &self.setting
    }

    /// The impulse response of a response to a drive, fitted to all groups, from the lag `-lead` on; modes ring
    /// for `most` samples at most.
    pub fn impulse(&self, response: usize, drive: usize, most: usize) -> Vec<f64> {
        let width = self.setting.width();
        let theta: Vec<f64> = (0..width).map(|k| self.whole.theta[(drive * width + k, response)]).collect();
        self.setting.impulse(&theta, most)
    }

    /// Whether a response has anything to explain in a group.
    pub fn moves(&self, response: usize, group: usize) -> bool {
        self.groups[group].yy[response] > 1e-24 * self.total.yy[response] && self.total.yy[response] > 0.0
    }

    /// Error of the linear part in each group, relative to the response.
    pub fn linear(&self, response: usize) -> HeldOut {
        let error = |(fold, group): (&Fold, &Moments)| relative(fold.rr[response], group.yy[response]);
        HeldOut { errors: self.folds.iter().zip(&self.groups).map(error).collect() }
    }

    /// The sums of columns, `[segment][column][row]`, centred and weighted; each column is scaled to unit power.
    pub fn block(&self, columns: Vec<Vec<Vec<f64>>>, response: usize) -> Block {
        let p = self.total.a.nrows();
        let m = columns.first().map_or(0, Vec::len);
        let norms: Vec<f64> = (0..m)
            .map(|c| columns.iter().flat_map(|s| &s[c]).map(|x| x * x).sum::<f64>().sqrt())
            .map(|norm| if norm > 0.0 && norm.is_finite() { 1.0 / norm } else { 0.0 })
            .collect();
        let scaled: Vec<Mat<f64>> = columns
            .iter()
            .map(|segment| {
                let rows = segment.first().map_or(0, Vec::len);
                let mut scaled = from_columns(rows, segment);
                for (c, norm) in norms.iter().enumerate() {
                    for x in scaled.col_as_slice_mut(c) {
                        *x = if (*x * norm).is_finite() { *x * norm } else { 0.0 };
                    }
                }
                scaled
            })
            .collect();
        drop(columns);
        let mut cross = vec![Mat::zeros(p, m); self.n_groups()];
        let mut gram = vec![Mat::zeros(m, m); self.n_groups()];
        let mut target = vec![Mat::zeros(m, 1); self.n_groups()];
        for (at, (segment, x)) in self.segments.iter().zip(&scaled).enumerate() {
            for c in 0..m {
                let column = x.col_as_slice(c);
                target[segment.group][(c, 0)] += dot(column, &self.responses[at][response]);
            }
            self.regressors.add(x, at, segment.weight, &mut cross[segment.group]);
            gram[segment.group] += transposed_times(x, x);
        }
        let total = sum(&cross);
        let solved = self.folds.iter().zip(&cross).map(|(f, b)| f.factor.solve(&(&total - b))).collect();
        Block { columns: scaled, cross, solved, gram, target, norms }
    }

    /// The same columns for another response.
    pub fn retargeted(&self, block: &Block, response: usize) -> Block {
        let mut target = vec![Mat::zeros(block.width(), 1); self.n_groups()];
        for (at, (segment, x)) in self.segments.iter().zip(&block.columns).enumerate() {
            for c in 0..x.ncols() {
                let with = dot(x.col_as_slice(c), &self.responses[at][response]);
                target[segment.group][(c, 0)] += with;
            }
        }
        Block { target, ..block.clone() }
    }

    /// Held-out errors of the linear part with a block.
    pub fn judge(&self, block: &Block, response: usize) -> HeldOut {
        let (gram, target, cross) = (sum(&block.gram), sum(&block.target), sum(&block.cross));
        let errors = (0..self.n_groups())
            .map(|g| {
                let (fold, group) = (&self.folds[g], &self.groups[g]);
                let others = Others {
                    gram: &gram - &block.gram[g],
                    target: &target - &block.target[g],
                    cross: &cross - &block.cross[g],
                };
                let gamma = gamma(&others, &block.solved[g], &fold.theta, response);
                relative(self.left(block, g, &gamma, response), group.yy[response])
            })
            .collect();
        HeldOut { errors }
    }

    /// Square of what is left in a group that was held out.
    fn left(&self, block: &Block, g: usize, gamma: &Mat<f64>, response: usize) -> f64 {
        let (fold, group) = (&self.folds[g], &self.groups[g]);
        // The columns' part: X gamma, and what the linear part takes of it, F w.
        let w = &block.solved[g] * gamma;
        let through = &group.a * &w;
        let reached = &block.cross[g] * gamma;
        let dot = |a: &Mat<f64>, b: &Mat<f64>, column: usize| -> f64 {
            (0..a.nrows()).map(|k| a[(k, 0)] * b[(k, column)]).sum()
        };
        let with_left = dot(gamma, &block.target[g], 0)
            - dot(&reached, &fold.theta, response)
            - dot(&w, &fold.left, response);
        let own =
            dot(gamma, &(&block.gram[g] * gamma), 0) - 2.0 * dot(&w, &reached, 0) + dot(&w, &through, 0);
        fold.rr[response] - 2.0 * with_left + own
    }

    /// Coefficients of a block's columns (of unit power) fitted to all groups, beside those of the linear part.
    fn fitted(&self, block: &Block, response: usize) -> Mat<f64> {
        let cross = sum(&block.cross);
        let solved = self.whole.factor.solve(&cross);
        let others = Others { gram: sum(&block.gram), target: sum(&block.target), cross };
        gamma(&others, &solved, &self.whole.theta, response)
    }

    /// Coefficients fitted to all groups but `held_out`; impulse responses of at most `most` samples.
    pub fn coefficients(
        &self,
        block: &Block,
        response: usize,
        held_out: Option<usize>,
        most: usize,
    ) -> Coefficients {
        let (fold, gamma, solved) = match held_out {
            None => {
                let solved = self.whole.factor.solve(&sum(&block.cross));
                (&self.whole, self.fitted(block, response), solved)
            }
            Some(g) => {
                let others = Others {
                    gram: sum(&block.gram) - &block.gram[g],
                    target: sum(&block.target) - &block.target[g],
                    cross: sum(&block.cross) - &block.cross[g],
                };
                let gamma = gamma(&others, &block.solved[g], &self.folds[g].theta, response);
                (&self.folds[g], gamma, block.solved[g].clone())
            }
        };
        let taken = solved * &gamma;
        let width = self.setting.width();
        let drives = taken.nrows() / width.max(1);
        let of_drive = |d: usize| -> Vec<f64> {
            let theta = (d * width..(d + 1) * width).map(|k| fold.theta[(k, response)] - taken[(k, 0)]);
            self.setting.impulse(&theta.collect::<Vec<f64>>(), most)
        };
        Coefficients {
            impulses: (0..drives).map(of_drive).collect(),
            columns: block.norms.iter().enumerate().map(|(k, norm)| gamma[(k, 0)] * norm).collect(),
        }
    }

    /// Gain of a law, whose columns come first in the block: that of its part beside the unbent signal let in by
    /// the first impulse response, or, of a law `direct`ly on the way from drive to response, beside the
    /// response without half of the law's part, which may be all of it (a clip) or take away from it (a play).
    pub fn relative_gain(&self, block: &Block, law: usize, direct: bool, response: usize) -> f64 {
        let gamma = self.fitted(block, response);
        let (gram, target) = (sum(&block.gram), sum(&block.target));
        let beside = |c: usize| -> f64 { (0..law).map(|k| gamma[(k, 0)] * gram[(k, c)]).sum() };
        if direct {
            let with_itself: f64 = (0..law).map(|c| gamma[(c, 0)] * beside(c)).sum();
            let with_response: f64 = (0..law).map(|k| gamma[(k, 0)] * target[(k, 0)]).sum();
            (with_response - 0.5 * with_itself) / self.total.yy[response].max(f64::MIN_POSITIVE)
        } else {
            beside(law) / gram[(law, law)].max(f64::MIN_POSITIVE)
        }
    }

    /// The second signal of a law of two relative to its first, whose `law` columns come first in the block.
    pub fn second_by_first(&self, block: &Block, law: usize, response: usize) -> f64 {
        let gamma = self.fitted(block, response);
        let of = |c: usize| gamma[(c, 0)] * block.norms[c];
        let half = law / 2;
        let size: f64 = (0..half).map(|c| (of(c) / block.norms[c].max(f64::MIN_POSITIVE)).powi(2)).sum();
        let with: f64 =
            (0..half).map(|c| of(c) * of(half + c) / block.norms[c].max(f64::MIN_POSITIVE).powi(2)).sum();
        if size > 0.0 { with / size } else { 0.0 }
    }

    /// How much of a law's part, as fitted to all groups, each group alone asks for beside a linear part of its
    /// own: 1 where the law's numbers hold. `law` counts the last columns of the block.
    pub fn gains(&self, block: &Block, law: usize, response: usize) -> Vec<Option<f64>> {
        let gamma = self.fitted(block, response);
        let m = gamma.nrows();
        // The law's part as one column, and the columns of the unbent signal.
        let mix = Mat::from_fn(m, m - law + 1, |r, c| match (r < law, c) {
            (true, 0) => gamma[(r, 0)],
            (false, 1..) => f64::from(u8::from(r - law + 1 == c)),
            _ => 0.0,
        });
        self.groups
            .par_iter()
            .enumerate()
            .map(|(g, group)| {
                let factor = self.setting.factor(&group.a)?;
                let cross = &block.cross[g] * &mix;
                let alone = Others {
                    gram: mix.transpose() * &block.gram[g] * &mix,
                    target: mix.transpose() * &block.target[g],
                    cross: cross.clone(),
                };
                let theta = factor.solve(&group.b);
                let found = self::gamma(&alone, &factor.solve(&cross), &theta, response);
                Some(found[(0, 0)]).filter(|gain| gain.is_finite())
            })
            .collect()
    }
}

impl Block {
    /// Both blocks' columns side by side.
    pub fn beside(&self, other: &Self, segments: &[Segment]) -> Self {
        let stack = |a: &Mat<f64>, b: &Mat<f64>| {
            Mat::from_fn(a.nrows() + b.nrows(), 1, |r, _| {
                if r < a.nrows() { a[(r, 0)] } else { b[(r - a.nrows(), 0)] }
            })
        };
        let pair =
            |a: &[Mat<f64>], b: &[Mat<f64>]| a.iter().zip(b).map(|(a, b)| wide(a, b)).collect::<Vec<_>>();
        let mut mixed = vec![Mat::zeros(self.width(), other.width()); self.gram.len()];
        for (segment, (a, b)) in segments.iter().zip(self.columns.iter().zip(&other.columns)) {
            mixed[segment.group] += transposed_times(a, b);
        }
        let gram = (0..mixed.len())
            .map(|g| {
                let upper = wide(&self.gram[g], &mixed[g]);
                let lower = wide(&mixed[g].transpose().to_owned(), &other.gram[g]);
                Mat::from_fn(upper.ncols(), upper.ncols(), |r, c| {
                    if r < upper.nrows() { upper[(r, c)] } else { lower[(r - upper.nrows(), c)] }
                })
            })
            .collect();
        Self {
            columns: pair(&self.columns, &other.columns),
            cross: pair(&self.cross, &other.cross),
            solved: pair(&self.solved, &other.solved),
            gram,
            target: self.target.iter().zip(&other.target).map(|(a, b)| stack(a, b)).collect(),
            norms: self.norms.iter().chain(&other.norms).copied().collect(),
        }
    }

    /// Number of columns.
    pub fn width(&self) -> usize {
        self.gram.first().map_or(0, Mat::ncols)
    }
}

/// Sums over the groups that are fitted to.
struct Others {
    gram: Mat<f64>,
    target: Mat<f64>,
    cross: Mat<f64>,
}

/// Coefficients of a block beside the linear part; zero where the columns are linearly dependent.
fn gamma(others: &Others, solved: &Mat<f64>, theta: &Mat<f64>, response: usize) -> Mat<f64> {
    let m = others.gram.nrows();
    let mut schur = &others.gram - others.cross.transpose() * solved;
    for k in 0..m {
        schur[(k, k)] += RIDGE * others.gram[(k, k)] + 1e-14;
    }
    let rhs = Mat::from_fn(m, 1, |k, _| {
        let taken: f64 = (0..theta.nrows()).map(|r| others.cross[(r, k)] * theta[(r, response)]).sum();
        others.target[(k, 0)] - taken
    });
    match Cholesky::new(&schur) {
        Some(factor) => {
            let found = factor.solve(&rhs);
            if (0..m).all(|k| found[(k, 0)].is_finite()) { found } else { Mat::zeros(m, 1) }
        }
        None => Mat::zeros(m, 1),
    }
}

fn wide(a: &Mat<f64>, b: &Mat<f64>) -> Mat<f64> {
    let columns: Vec<&[f64]> =
        [a, b].into_iter().flat_map(|m| (0..m.ncols()).map(|c| m.col_as_slice(c))).collect();
    from_columns(a.nrows(), &columns)
}

fn sum(parts: &[Mat<f64>]) -> Mat<f64> {
    let mut total = parts[0].clone();
    parts[1..].iter().for_each(|p| total += p);
    total
}

/// Root of a ratio of squares, at least [`FLOOR`]; 0 where there is nothing to explain.
fn relative(left: f64, of: f64) -> f64 {
    if of > 0.0 { (left / of).max(FLOOR * FLOOR).sqrt() } else { 0.0 }
}
