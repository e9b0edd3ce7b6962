//! How a model came about; stored and shown with it.

use serde::{Deserialize, Serialize};

use super::score::SectionScore;
use super::split::SplitRule;
use super::{Preprocess, Task};
use crate::frf::FrfSettings;
use crate::lstm::{LstmSettings, Recombine, Trained};

/// The outcome of a fit.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FitReport {
    /// What the model is for; reports that are older than this field lack it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub task: Option<Task>,
    /// Filter used.
    pub preprocess: Preprocess,
    /// FRF settings used, none left open.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub frf: Option<FrfSettings>,
    /// LSTM settings used.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lstm: Option<LstmSettings>,
    /// RMS error per output, in the order of the outputs, on the data that compare models (where there are
    /// none, on those that stopped the training); `None` where the output is all zero.
    pub validation_rms: Vec<Option<f64>>,
    /// How data were divided, and what the model leaves of those that compare.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub comparison: Option<Comparison>,
    /// Recombination used.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub recombine: Option<Recombine>,
    /// Each seed's network.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub seeds: Vec<SeedReport>,
    /// Seed whose network was kept.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub best_seed: Option<u64>,
    /// Averages of the FRF estimate.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub frf_averages: Option<usize>,
    /// Seconds of training data.
    pub training_s: f64,
    /// Seconds of the data that compare models.
    pub validation_s: f64,
    /// Limits of the model that an engineer should know: correlated drives, few averages, dead band, low coherence.
    pub warnings: Vec<String>,
}

/// The division of a fit's data, and the scores of its model on the data that compare models.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Comparison {
    /// Where the data come from.
    pub rule: SplitRule,
    /// The reason, if another rule is usual.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// Whether the model was fitted again on all training runs. The scores are then those of the model
    /// before that, which had not seen the data.
    pub refitted: bool,
    /// One for each stretch of data that compares, in the order of the lineage's `validation`.
    pub scores: Vec<SectionScore>,
}

/// One seed's training.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SeedReport {
    /// Seed.
    pub seed: u64,
    /// Epoch whose weights were kept, from 1; 0 is the start itself, the copy of the FRF.
    pub best_epoch: usize,
    /// Its mean squared error on the windows that stop the training, standardised.
    pub validation_mse: f64,
    /// Learning curve: `[epoch, training MSE, validation MSE]`, at most a few hundred points.
    pub curve: Vec<(usize, f64, f64)>,
}

/// At most this many points of a learning curve are kept.
const CURVE_POINTS: usize = 300;

impl SeedReport {
    pub(super) fn of(seed: u64, trained: &Trained) -> Self {
        let step = trained.history.len().div_ceil(CURVE_POINTS).max(1);
        Self {
            seed,
            best_epoch: trained.best_epoch,
            validation_mse: trained.validation_mse,
            curve: trained
                .history
                .iter()
                .filter(|e| e.epoch % step == 0 || e.epoch == trained.best_epoch)
                .map(|e| (e.epoch, e.training_mse, e.validation_mse))
                .collect(),
        }
    }

    /// Lowest validation error; of equals the first.
    pub(super) fn best(seeds: &[Self]) -> Option<&Self> {
        seeds.iter().reduce(|a, b| if b.validation_mse < a.validation_mse { b } else { a })
    }
}
