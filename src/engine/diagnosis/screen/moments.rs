//! Normal equations of lagged drives, segment by segment, without ever writing the lags out.
//!
//! Of two lagged signals the sums for lags `(i + 1, j + 1)` follow from those for `(i, j)` by two products at
//! the ends of the segment, so that only the first row and column are summed over all samples.

use faer::Mat;
use rayon::prelude::*;

use super::track::{Segment, Track, delayed};
use crate::diagnosis::numerics::linear::dot;

/// Lags of every drive: from `-lead` on, `span` of them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Lags {
    pub lead: usize,
    pub span: usize,
}

/// Sums over the rows of one segment, about their means and weighted.
#[derive(Debug, Clone)]
pub(super) struct Moments {
    /// Lagged drives with lagged drives, drive by drive.
    pub a: Mat<f64>,
    /// Lagged drives with responses, a column a response.
    pub b: Mat<f64>,
    /// Responses with themselves.
    pub yy: Vec<f64>,
}

impl Moments {
    /// The sums of every segment.
    pub fn of(drives: &[Track], responses: &[Track], segments: &[Segment], lags: Lags) -> Vec<Self> {
        segments.par_iter().map(|segment| Self::of_segment(drives, responses, segment, lags)).collect()
    }

    fn of_segment(drives: &[Track], responses: &[Track], segment: &Segment, lags: Lags) -> Self {
        let span = lags.span;
        let (n, p) = (segment.rows.len(), drives.len() * span);
        // Sample `t` of the segment at lag `-lead + k` is `padded[span - 1 - k + t]`.
        let padded: Vec<Vec<f64>> =
            drives.iter().map(|d| padded(&d[segment.record], segment, lags)).collect();
        let at = |drive: usize, k: usize| &padded[drive][span - 1 - k..span - 1 - k + n];
        let means: Vec<f64> = (0..p).map(|c| at(c / span, c % span).iter().sum::<f64>() / n as f64).collect();
        let mut a = Mat::zeros(p, p);
        for i in 0..drives.len() {
            for j in 0..=i {
                let (row, column) = (i * span, j * span);
                for k in 0..span {
                    a[(row, column + k)] = dot(at(i, 0), at(j, k));
                    a[(row + k, column)] = dot(at(i, k), at(j, 0));
                }
                for k in 1..span {
                    for l in 1..span {
                        let (first_i, first_j) = (padded[i][span - 1 - k], padded[j][span - 1 - l]);
                        let (past_i, past_j) = (padded[i][span - 1 - k + n], padded[j][span - 1 - l + n]);
                        a[(row + k, column + l)] =
                            a[(row + k - 1, column + l - 1)] + first_i * first_j - past_i * past_j;
                    }
                }
            }
        }
        let weight = segment.weight * segment.weight;
        for r in 0..p {
            for c in 0..=r {
                let value = if r / span == c / span && c > r { 0.0 } else { a[(r, c)] };
                let centred = weight * (value - n as f64 * means[r] * means[c]);
                a[(r, c)] = centred;
                a[(c, r)] = centred;
            }
        }
        let centred: Vec<Vec<f64>> =
            responses.iter().map(|y| delayed(&y[segment.record], segment, 0)).collect();
        let b = Mat::from_fn(p, responses.len(), |r, c| {
            segment.weight * dot(at(r / span, r % span), &centred[c])
        });
        let yy = centred.iter().map(|y| dot(y, y)).collect();
        Self { a, b, yy }
    }

    /// The sums of columns that are written out, a matrix a segment.
    pub fn of_columns(columns: &[Mat<f64>], responses: &[Track], segments: &[Segment]) -> Vec<Self> {
        segments
            .par_iter()
            .zip(columns)
            .map(|(segment, x)| {
                let y: Vec<Vec<f64>> =
                    responses.iter().map(|y| delayed(&y[segment.record], segment, 0)).collect();
                let b = Mat::from_fn(x.ncols(), y.len(), |r, c| dot(x.col_as_slice(r), &y[c]));
                Self { a: x.transpose() * x, b, yy: y.iter().map(|y| dot(y, y)).collect() }
            })
            .collect()
    }

    /// The same for some lags of each drive only.
    pub fn select(&self, from: Lags, to: Lags) -> Self {
        let drives = self.a.nrows() / from.span.max(1);
        let skip = from.lead - to.lead;
        let of: Vec<usize> =
            (0..drives).flat_map(|d| (0..to.span).map(move |k| d * from.span + skip + k)).collect();
        Self {
            a: Mat::from_fn(of.len(), of.len(), |r, c| self.a[(of[r], of[c])]),
            b: Mat::from_fn(of.len(), self.b.ncols(), |r, c| self.b[(of[r], c)]),
            yy: self.yy.clone(),
        }
    }

    /// Sums over several segments; `None` of none.
    pub fn sum<'a>(parts: impl IntoIterator<Item = &'a Self>) -> Option<Self> {
        let mut parts = parts.into_iter();
        let mut sum = parts.next()?.clone();
        for part in parts {
            sum.a += &part.a;
            sum.b += &part.b;
            sum.yy.iter_mut().zip(&part.yy).for_each(|(s, p)| *s += p);
        }
        Some(sum)
    }
}

/// The samples that the lags of a segment reach, held at the ends of the record.
pub(super) fn padded(samples: &[f64], segment: &Segment, lags: Lags) -> Vec<f64> {
    let last = samples.len() as isize - 1;
    let from = segment.rows.start as isize + lags.lead as isize + 1 - lags.span as isize;
    let to = segment.rows.end as isize + lags.lead as isize;
    (from..to).map(|t| samples[t.clamp(0, last) as usize]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_by_recursion_are_those_of_lags_written_out() {
        let track = |f: f64| -> Track {
            vec![(0..90).map(|k| (f * f64::from(k)).sin() + 0.01 * f64::from(k * k % 17)).collect()]
        };
        let (drives, responses) = ([track(0.3), track(1.1)], [track(0.7)]);
        let segment = Segment { record: 0, rows: 3..80, group: 0, part: 0, unit: 0, weight: 0.5 };
        let lags = Lags { lead: 2, span: 7 };
        let found = &Moments::of(&drives, &responses, std::slice::from_ref(&segment), lags)[0];
        let column = |c: usize| delayed(&drives[c / 7][0], &segment, (c % 7) as isize - 2);
        let y = delayed(&responses[0][0], &segment, 0);
        for r in 0..14 {
            for c in 0..14 {
                let expected = dot(&column(r), &column(c));
                assert!((found.a[(r, c)] - expected).abs() < 1e-10, "{r} {c}");
            }
            assert!((found.b[(r, 0)] - dot(&column(r), &y)).abs() < 1e-10, "{r}");
        }
        let fewer = found.select(lags, Lags { lead: 0, span: 3 });
        assert_eq!(fewer.a[(3, 1)], found.a[(9, 3)]);
    }
}
