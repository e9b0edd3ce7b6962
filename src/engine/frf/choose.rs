//! Choice of segment length and ridge by the prediction of held-out data: of whole runs where there are
//! several, else of a part of the run.

use std::ops::Range;

use super::data::{Data, means};
use super::estimate::{Means, solve};
use super::lines::Lines;
use super::{Estimator, FrfFilter, FrfSettings};
use crate::progress::{Watch, report, within};
use crate::spectral::{PART_BYTES, PARTS, Record, cross_spectra};
use crate::{EngineError, Signal};

/// Ridges tried when none is given.
const RIDGES: [f64; 6] = [0.0, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2];
/// Ridges tried with every segment length of long data.
const FIRST_RIDGES: [f64; 2] = [0.0, 1e-4];
/// Ridge when there is too little data to hold any out.
const CAUTIOUS_RIDGE: f64 = 1e-4;
/// Averages per input below which coherence and confidence mean little.
pub(super) const ENOUGH_AVERAGES: usize = 4;
/// Shortest segment tried.
const SHORTEST: usize = 32;
/// Spectral matrices of one estimate may take this much when the length is ours to choose.
const MAX_BYTES: usize = 1 << 29;
/// Held out of a single run is one part in so many: the last one, or
const FOLDS: usize = 8;
/// The last part of each run is held out, or each part in turn when all runs together have no more samples
/// than this: one eighth of two seconds is too little for a comparison, and short data cost little.
const SHORT_DATA: usize = 30_000;
/// A run that is held out of long data has at least one in so many of all samples, and half at most.
const SHORTEST_HELD_OUT: usize = 20;

/// Settings of which none is left open.
pub(super) struct Choice {
    pub segment_len: usize,
    pub ridge: f64,
    pub warnings: Vec<String>,
}

/// Data that are held out together.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Fold {
    /// One part in [`FOLDS`] of each run.
    Stretch(usize),
    /// Whole runs.
    Runs(Vec<usize>),
}

impl Fold {
    /// The samples that are held out of a run of `n_samples`.
    fn range(&self, run: usize, n_samples: usize) -> Range<usize> {
        match self {
            Self::Stretch(fold) => fold * n_samples / FOLDS..(fold + 1) * n_samples / FOLDS,
            Self::Runs(runs) if runs.contains(&run) => 0..n_samples,
            Self::Runs(_) => 0..0,
        }
    }

    /// The folds for runs of these lengths: of several runs whole ones, because the end of a run is too much
    /// like its beginning to tell what another run will show.
    fn all(lengths: &[usize]) -> Vec<Self> {
        let total: usize = lengths.iter().sum();
        let short = total <= SHORT_DATA;
        let half = |run: &usize| 2 * lengths[*run] <= total && SHORTEST_HELD_OUT * lengths[*run] >= total;
        if lengths.len() > 1 && short {
            let groups = lengths.len().min(FOLDS);
            let group = |fold: usize| (fold..lengths.len()).step_by(groups).collect();
            return (0..groups).map(|fold| Self::Runs(group(fold))).collect();
        }
        if lengths.len() > 1
            && let Some(latest) = (0..lengths.len()).rev().find(half)
        {
            return vec![Self::Runs(vec![latest])];
        }
        if short { (0..FOLDS).map(Self::Stretch).collect() } else { vec![Self::Stretch(FOLDS - 1)] }
    }
}

/// Fills the values that `settings` leave open.
///
/// # Errors
/// [`EngineError::TooFewAverages`] when no segment length leaves more averages than inputs.
pub(super) fn choose(
    data: &Data<'_>,
    settings: &FrfSettings,
    watch: Watch<'_>,
) -> Result<Choice, EngineError> {
    if let (Some(segment_len), Some(ridge)) = (settings.segment_len, settings.ridge) {
        return Ok(Choice { segment_len, ridge, warnings: Vec::new() });
    }
    let lengths: Vec<usize> = match settings.segment_len {
        Some(len) => vec![len],
        None => candidates(data, settings),
    };
    let ridges: &[f64] = match &settings.ridge {
        Some(ridge) => std::slice::from_ref(ridge),
        None if settings.estimator != Estimator::H1 => &RIDGES[..1],
        None => &RIDGES,
    };
    let short = data.total_samples() <= SHORT_DATA;
    let run_lengths: Vec<usize> = (0..data.runs.len()).map(|run| data.n_samples(run)).collect();
    // Of long data, half overlap uses all but a few percent, in half the time.
    let comparing = &FrfSettings {
        overlap: if short { settings.overlap } else { settings.overlap.min(0.5) },
        ..settings.clone()
    };
    let held_out: Vec<HeldOut<'_>> =
        Fold::all(&run_lengths).into_iter().map(|fold| HeldOut::new(data, fold)).collect();
    let comparable: Vec<usize> = lengths
        .iter()
        .copied()
        .filter(|&len| held_out.iter().all(|h| h.leaves_enough(comparing, len)))
        .collect();
    if comparable.is_empty() {
        return cautious(data, settings);
    }

    let longest = comparable[comparable.len() - 1];
    let mut search = Search { data, settings: comparing, held_out: &held_out, longest, watch, best: None };
    // Every pair where that is cheap. Elsewhere the length first, with and without a ridge, since
    // the two hardly depend on each other; then the ridge.
    if short || ridges.len() == 1 {
        search.over(&comparable, ridges, 0.0..0.9)?;
    } else {
        search.over(&comparable, &FIRST_RIDGES, 0.0..0.8)?;
        if let Some((_, len, _)) = search.best {
            search.over(&[len], ridges, 0.8..0.9)?;
        }
    }
    // Nothing to compare when no ridge is allowed that dependent inputs need: the estimate says so.
    let (_, segment_len, ridge) = search.best.unwrap_or((0.0, comparable[0], ridges[0]));
    Ok(Choice { segment_len, ridge, warnings: Vec::new() })
}

/// The choice when no data can be held out: the longest segment that gives more averages than inputs, and
/// a ridge.
fn cautious(data: &Data<'_>, settings: &FrfSettings) -> Result<Choice, EngineError> {
    let averages = |len: usize| data.n_averages(&settings.welch(len));
    let longest = (0..usize::BITS - 1)
        .map(|bit| 1_usize << bit)
        .skip_while(|&len| len < FrfSettings::MIN_SEGMENT_LEN)
        .take_while(|&len| averages(len) > data.n_inputs)
        .last();
    let segment_len = settings.segment_len.or(longest).unwrap_or(FrfSettings::MIN_SEGMENT_LEN);
    if averages(segment_len) <= data.n_inputs {
        let (averages, drives) = (averages(segment_len), data.n_inputs);
        return Err(EngineError::TooFewAverages { averages, drives });
    }
    let ridge = settings.ridge.unwrap_or(match settings.estimator {
        Estimator::H1 => CAUTIOUS_RIDGE,
        Estimator::Ratio | Estimator::Auto => 0.0,
    });
    let chosen = format!(
        "too few samples to compare settings on a held-out stretch: frf.segment_len {segment_len}, frf.ridge {ridge:e}"
    );
    Ok(Choice { segment_len, ridge, warnings: vec![chosen] })
}

/// The state of the comparison.
struct Search<'a> {
    data: &'a Data<'a>,
    settings: &'a FrfSettings,
    held_out: &'a [HeldOut<'a>],
    /// Longest candidate: all are scored on the same samples.
    longest: usize,
    watch: Watch<'a>,
    /// Least error, its segment length and ridge.
    best: Option<(f64, usize, f64)>,
}

impl Search<'_> {
    /// Tries all pairs; `progress` is the share of the estimate that this is.
    fn over(&mut self, lengths: &[usize], ridges: &[f64], progress: Range<f64>) -> Result<(), EngineError> {
        let steps = (lengths.len() * self.held_out.len()) as f64;
        for (done, &len) in lengths.iter().enumerate() {
            let mut scores = vec![Some(Score::new(self.data.n_outputs)); ridges.len()];
            for (fold, held_out) in self.held_out.iter().enumerate() {
                let step = (done * self.held_out.len() + fold) as f64;
                report(self.watch, "FRF", within(step / steps, &progress))?;
                held_out.score(self.settings, len, self.longest, ridges, &mut scores)?;
            }
            for (score, &ridge) in scores.iter().zip(ridges) {
                let Some(error) = score.as_ref().map(Score::error) else { continue };
                // Ties go to the shorter segment and the smaller ridge.
                if self.best.is_none_or(|(least, ..)| error < least) {
                    self.best = Some((error, len, ridge));
                }
            }
        }
        Ok(())
    }
}

/// Powers of two that leave [`ENOUGH_AVERAGES`] a drive and fit into memory.
fn candidates(data: &Data<'_>, settings: &FrfSettings) -> Vec<usize> {
    let averages = |len| data.n_averages(&settings.welch(len));
    lengths(data.n_inputs, data.n_outputs, averages).collect()
}

fn lengths(
    n_inputs: usize,
    n_outputs: usize,
    averages: impl Fn(usize) -> usize,
) -> impl Iterator<Item = usize> {
    (0..usize::BITS - 1).map(|bit| 1_usize << bit).skip_while(|&len| len < SHORTEST).take_while(move |&len| {
        averages(len) >= ENOUGH_AVERAGES * n_inputs && matrix_bytes(n_inputs, n_outputs, len) <= MAX_BYTES
    })
}

/// The spectral matrices of one estimate with segments of `len` samples.
fn matrix_bytes(n_inputs: usize, n_outputs: usize, len: usize) -> usize {
    let per_line = n_inputs * (n_inputs + 2 * n_outputs) + n_outputs;
    (len / 2 + 1).saturating_mul(16 * per_line)
}

/// Memory of an estimate from runs of so many samples, the runs themselves left out: matrices of the longest segment as
/// sums, as spectra, decomposed for two scalings, as `H` and as a filter, and the parts of the sums.
pub fn estimate_bytes(settings: &FrfSettings, [n_inputs, n_outputs]: [usize; 2], runs: &[usize]) -> usize {
    let averages = |len: usize| {
        let welch = settings.welch(len);
        runs.iter().map(|n| welch.n_segments(*n)).sum()
    };
    let longest =
        settings.segment_len.or_else(|| lengths(n_inputs, n_outputs, averages).last()).unwrap_or(SHORTEST);
    let matrices = matrix_bytes(n_inputs, n_outputs, longest);
    matrices.saturating_mul(4).saturating_add(matrices.saturating_mul(PARTS).min(PART_BYTES))
}

/// Sums of squares per output over the held-out data of all runs.
#[derive(Clone)]
struct Score {
    error: Vec<f64>,
    /// About the working point.
    power: Vec<f64>,
}

impl Score {
    fn new(n_outputs: usize) -> Self {
        Self { error: vec![0.0; n_outputs], power: vec![0.0; n_outputs] }
    }

    /// Mean logarithm of the relative error: a percent less counts the same at each output.
    fn error(&self) -> f64 {
        let relative = |(error, power): (&f64, &f64)| (error / power).max(f64::MIN_POSITIVE).ln();
        let moving = self.error.iter().zip(&self.power).filter(|(_, power)| **power > 0.0);
        let (sum, n) = moving.fold((0.0, 0_usize), |(sum, n), pair| (sum + relative(pair), n + 1));
        sum / n.max(1) as f64
    }
}

/// What is held out, and the working point of the rest.
struct HeldOut<'a> {
    data: &'a Data<'a>,
    fold: Fold,
    means: Means,
}

impl<'a> HeldOut<'a> {
    fn new(data: &'a Data<'a>, fold: Fold) -> Self {
        let means = means(&data.without(|run, n| fold.range(run, n)));
        Self { data, fold, means }
    }

    /// The data without it.
    fn rest(&self) -> Vec<Record<'a>> {
        self.data.without(|run, n| self.fold.range(run, n))
    }

    /// Whether the rest gives more averages than inputs.
    fn leaves_enough(&self, settings: &FrfSettings, len: usize) -> bool {
        let (welch, rest) = (settings.welch(len), self.rest());
        let averages: usize = rest.iter().map(|s| welch.n_segments(s.x[0].len())).sum();
        averages > self.data.n_inputs
    }

    /// Estimates on the rest, predicts this part, and adds to the score of each ridge; `None` where
    /// a ridge cannot separate the inputs. The spectra of one segment length serve all ridges.
    fn score(
        &self,
        settings: &FrfSettings,
        len: usize,
        longest: usize,
        ridges: &[f64],
        scores: &mut [Option<Score>],
    ) -> Result<(), EngineError> {
        let data = self.data;
        let rest = self.rest();
        let spectra = cross_spectra(&rest, &self.means, &settings.welch(len), data.sample_rate_hz)?;
        let lines = Lines::new(&spectra, &data.x_scale)?;
        for (&ridge, score) in ridges.iter().zip(scores) {
            let frf = match solve(data, &lines, &self.means, settings.estimator, ridge, len) {
                Ok((frf, _)) => frf,
                // A larger ridge may tell them apart.
                Err(EngineError::DependentInputs { .. }) => {
                    *score = None;
                    continue;
                }
                Err(error) => return Err(error),
            };
            let Some(score) = score else { continue };
            let filter = frf.filter()?;
            for run in 0..data.runs.len() {
                self.add(&filter, run, longest, score)?;
            }
        }
        Ok(())
    }

    /// Adds one run. Where the part begins or ends with the run, half of the longest candidate is
    /// not scored (but no more than a quarter of the part): there a prediction is judged by the
    /// values held beyond the ends, a long segment more than a short one.
    fn add(
        &self,
        filter: &FrfFilter,
        run: usize,
        longest: usize,
        score: &mut Score,
    ) -> Result<(), EngineError> {
        let (Record { x, y }, n) = (&self.data.runs[run], self.data.n_samples(run));
        let Range { start, end } = self.fold.range(run, n);
        let margin = (longest / 2).min((end - start) / 4);
        let scored = start + if start == 0 { margin } else { 0 }..end - if end == n { margin } else { 0 };
        if scored.is_empty() {
            return Ok(());
        }
        let reach = filter.taps() / 2;
        let known = start.saturating_sub(reach)..n.min(end + reach);
        let known_x = x.iter().map(|channel| channel[known.clone()].to_vec()).collect();
        let predicted = filter.apply(&Signal::of_checked(self.data.sample_rate_hz, known_x))?;
        for (o, mean) in self.means.y.iter().enumerate() {
            let measured = &y[o][scored.clone()];
            let found = &predicted.channel(o)[scored.start - known.start..scored.end - known.start];
            score.error[o] += measured.iter().zip(found).map(|(m, f)| (m - f).powi(2)).sum::<f64>();
            score.power[o] += measured.iter().map(|m| (m - mean).powi(2)).sum::<f64>();
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_several_runs_whole_ones_are_held_out_and_of_one_a_stretch() {
        assert_eq!(Fold::all(&[20_000]).len(), FOLDS);
        assert_eq!(Fold::all(&[100_000]), [Fold::Stretch(FOLDS - 1)]);
        assert_eq!(Fold::all(&[5_000, 6_000]), [Fold::Runs(vec![0]), Fold::Runs(vec![1])]);
        assert_eq!(Fold::all(&[1_000; 10])[0], Fold::Runs(vec![0, 8]));
        assert_eq!(Fold::all(&[100_000; 3]), [Fold::Runs(vec![2])]);
        // The last run alone would say little, the first would leave little.
        assert_eq!(Fold::all(&[200_000, 50_000, 1_000]), [Fold::Runs(vec![1])]);
        assert_eq!(Fold::all(&[200_000, 1_000]), [Fold::Stretch(FOLDS - 1)]);
    }

    #[test]
    fn a_fold_takes_whole_runs_or_a_part_of_each() {
        let runs = Fold::Runs(vec![1]);
        assert_eq!((runs.range(0, 80), runs.range(1, 80)), (0..0, 0..80));
        assert_eq!(Fold::Stretch(7).range(0, 80), 70..80);
    }
}
