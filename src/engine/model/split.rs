//! How the samples of a fit are divided: some shape the weights, some stop the training, some compare
//! models. Data that stop a training (its epoch, seed, recombination) never compare it with another
//! model, because a choice among many looks better on the data that it was made on than it is.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use super::ModelKind;

/// Where the data that stop a training and compare models come from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum FitSplit {
    /// The first half of each validation run stops, the second half compares.
    ValidationHalves,
    /// Validation runs stop and choose, as in the paper (section 3.3); nothing compares.
    ValidationStops,
    /// Whole training runs are left out, by their place among the training runs; afterwards the winner is
    /// fitted again on all training runs.
    LeftOut {
        /// Runs that compare models.
        comparison: Vec<usize>,
        /// Runs that stop the training; empty: the last tenth of each run that is trained on.
        stopping: Vec<usize>,
    },
    /// Of each training run the last tenth compares and the tenth before it stops.
    LastTenths,
}

/// The word of the contract for a [`FitSplit`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SplitRule {
    /// [`FitSplit::ValidationHalves`].
    ValidationHalves,
    /// [`FitSplit::ValidationStops`].
    ValidationStops,
    /// [`FitSplit::LeftOut`].
    LeftOutRuns,
    /// [`FitSplit::LastTenths`].
    LastTenths,
}

impl FitSplit {
    /// The word of the contract.
    pub fn rule(&self) -> SplitRule {
        match self {
            Self::ValidationHalves => SplitRule::ValidationHalves,
            Self::ValidationStops => SplitRule::ValidationStops,
            Self::LeftOut { .. } => SplitRule::LeftOutRuns,
            Self::LastTenths => SplitRule::LastTenths,
        }
    }
}

/// Consecutive samples of one run, by the run's place in a list.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Section {
    /// Place of the run.
    pub run: usize,
    /// Its samples.
    pub samples: Range<usize>,
}

/// Data of an FRF part with runs of its own, by their places, when a network is trained on `training`, which is
/// of the first `n_training` runs: of a training run the same sections, of any other run all `length` samples.
pub fn own_frf_sections(
    own: &[usize],
    training: &[Section],
    n_training: usize,
    length: impl Fn(usize) -> usize,
) -> Vec<Section> {
    let sections = |&run: &usize| {
        if run < n_training {
            training.iter().filter(|section| section.run == run).cloned().collect()
        } else {
            vec![Section { run, samples: 0..length(run) }]
        }
    };
    own.iter().flat_map(sections).collect()
}

/// A [`FitSplit`] carried out on runs of known length. A run's place counts the training runs first, then
/// the validation runs.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Sections {
    /// Shape the weights of the model that is compared.
    pub training: Vec<Section>,
    /// Stop its training; empty for an FRF, which nothing has to stop.
    pub stopping: Vec<Section>,
    /// Compare it with other models.
    pub comparison: Vec<Section>,
    /// Whether the winner is fitted again on all training runs.
    pub refit: bool,
}

/// Lengths of the runs of a fit, samples.
#[derive(Debug, Clone, Copy)]
pub struct RunLengths<'a> {
    /// Training runs.
    pub training: &'a [usize],
    /// Validation runs.
    pub validation: &'a [usize],
}

impl Sections {
    /// Divides the runs. `window_len` keeps the windows of stopping and comparison apart where both lie
    /// in one run.
    pub fn of(split: &FitSplit, kind: ModelKind, lengths: RunLengths<'_>, window_len: usize) -> Self {
        let stops = kind != ModelKind::Frf;
        let whole = |run: usize| Section { run, samples: 0..length(lengths, run) };
        let n = lengths.training.len();
        let training_runs = 0..n;
        let validation_runs = n..n + lengths.validation.len();
        let mut sections = Self::default();
        match split {
            FitSplit::ValidationHalves => {
                sections.training = training_runs.map(whole).collect();
                for run in validation_runs {
                    let samples = length(lengths, run);
                    sections.halve(run, 0..samples, samples / 2, stops.then_some(window_len));
                }
            }
            FitSplit::ValidationStops => {
                sections.training = training_runs.map(whole).collect();
                let validation = validation_runs.map(whole).collect();
                if stops {
                    sections.stopping = validation;
                } else {
                    sections.comparison = validation;
                }
            }
            FitSplit::LeftOut { comparison, stopping } => {
                sections.refit = true;
                sections.comparison = comparison.iter().copied().map(whole).collect();
                for run in training_runs.filter(|run| !comparison.contains(run)) {
                    let samples = length(lengths, run);
                    let tail = if stopping.is_empty() { samples - samples / 10 } else { samples };
                    if !stops {
                        sections.training.push(whole(run));
                    } else if stopping.contains(&run) {
                        sections.stopping.push(whole(run));
                    } else {
                        sections.training.push(Section { run, samples: 0..tail });
                        sections.stopping.push(Section { run, samples: tail..samples });
                    }
                }
            }
            FitSplit::LastTenths => {
                for run in training_runs {
                    let samples = length(lengths, run);
                    let compared_from = samples - samples / 10;
                    let kept = if stops { compared_from - samples / 10 } else { compared_from };
                    sections.training.push(Section { run, samples: 0..kept });
                    sections.halve(run, kept..samples, compared_from, stops.then_some(window_len));
                }
            }
        }
        for list in [&mut sections.training, &mut sections.stopping, &mut sections.comparison] {
            list.retain(|section| !section.samples.is_empty());
        }
        sections
    }

    /// Gives what is before `middle` to stopping, less a gap of one window (a quarter of it at most), and
    /// the rest to comparison. Without a window nothing stops.
    fn halve(&mut self, run: usize, samples: Range<usize>, middle: usize, window_len: Option<usize>) {
        if let Some(window_len) = window_len {
            let gap = window_len.min((middle - samples.start) / 4);
            self.stopping.push(Section { run, samples: samples.start..middle - gap });
        }
        self.comparison.push(Section { run, samples: middle..samples.end });
    }
}

fn length(lengths: RunLengths<'_>, run: usize) -> usize {
    let validation = |run: usize| lengths.validation[run - lengths.training.len()];
    lengths.training.get(run).copied().unwrap_or_else(|| validation(run))
}

#[cfg(test)]
mod tests {
    use super::*;

    const ALL: [FitSplit; 4] = [
        FitSplit::ValidationHalves,
        FitSplit::ValidationStops,
        FitSplit::LeftOut { comparison: Vec::new(), stopping: Vec::new() },
        FitSplit::LastTenths,
    ];

    fn sections(split: &FitSplit, kind: ModelKind, training: &[usize], validation: &[usize]) -> Sections {
        Sections::of(split, kind, RunLengths { training, validation }, 64)
    }

    fn section(run: usize, samples: Range<usize>) -> Section {
        Section { run, samples }
    }

    #[test]
    fn what_stops_a_training_never_compares_models_nor_shapes_weights() {
        let mut splits = ALL.to_vec();
        splits[2] = FitSplit::LeftOut { comparison: vec![1], stopping: vec![] };
        splits.push(FitSplit::LeftOut { comparison: vec![1], stopping: vec![3] });
        for split in splits {
            for kind in [ModelKind::Frf, ModelKind::Lstm] {
                let s = sections(&split, kind, &[1000, 990, 7, 400], &[900, 31]);
                let mut all = [s.training, s.stopping, s.comparison].concat();
                all.sort_by_key(|s| (s.run, s.samples.start));
                for pair in all.windows(2) {
                    let apart = pair[0].run < pair[1].run || pair[0].samples.end <= pair[1].samples.start;
                    assert!(apart, "{split:?} {kind:?}: {pair:?}");
                }
            }
        }
    }

    #[test]
    fn whole_runs_are_left_out_and_everything_is_fitted_again() {
        let split = FitSplit::LeftOut { comparison: vec![2], stopping: vec![] };
        let s = sections(&split, ModelKind::Lstm, &[1000, 500, 800], &[]);
        assert_eq!(s.training, [section(0, 0..900), section(1, 0..450)]);
        assert_eq!(s.stopping, [section(0, 900..1000), section(1, 450..500)]);
        assert_eq!((s.comparison, s.refit), (vec![section(2, 0..800)], true));
        let s = sections(&split, ModelKind::Frf, &[1000, 500, 800], &[]);
        assert_eq!(s.training, [section(0, 0..1000), section(1, 0..500)]);
        let split = FitSplit::LeftOut { comparison: vec![2], stopping: vec![1] };
        let s = sections(&split, ModelKind::Hybrid2, &[1000, 500, 800], &[]);
        assert_eq!((s.training, s.stopping), (vec![section(0, 0..1000)], vec![section(1, 0..500)]));
    }

    #[test]
    fn of_a_single_run_the_last_tenth_compares_and_no_window_is_shared() {
        let s = sections(&FitSplit::LastTenths, ModelKind::Hybrid2, &[10_000], &[]);
        assert_eq!(s.training, [section(0, 0..8000)]);
        assert_eq!(s.stopping, [section(0, 8000..9000 - 64)]);
        assert_eq!((s.comparison, s.refit), (vec![section(0, 9000..10_000)], false));
        let s = sections(&FitSplit::LastTenths, ModelKind::Frf, &[10_000], &[]);
        assert_eq!((s.training, s.stopping), (vec![section(0, 0..9000)], vec![]));
    }

    #[test]
    fn validation_runs_stop_with_their_first_half_and_compare_with_their_second() {
        let s = sections(&FitSplit::ValidationHalves, ModelKind::Lstm, &[500], &[1000, 300]);
        assert_eq!(s.training, [section(0, 0..500)]);
        assert_eq!(s.stopping, [section(1, 0..500 - 64), section(2, 0..150 - 37)]);
        assert_eq!(s.comparison, [section(1, 500..1000), section(2, 150..300)]);
        let s = sections(&FitSplit::ValidationStops, ModelKind::Lstm, &[500], &[1000]);
        assert_eq!((s.stopping, s.comparison), (vec![section(1, 0..1000)], vec![]));
        let s = sections(&FitSplit::ValidationStops, ModelKind::Frf, &[500], &[1000]);
        assert_eq!((s.stopping, s.comparison), (vec![], vec![section(1, 0..1000)]));
    }
}
