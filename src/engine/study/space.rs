//! The settings that a search varies, their limits, and what a trial draws from them.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::EngineError;
use crate::lstm::{MAX_BATCH, MAX_BLOCKS, MAX_CELLS, MAX_WINDOW_LEN};
use crate::model::{LstmOptions, ModelKind};

/// Most values in a list.
pub const MAX_CHOICES: usize = 16;

/// Smallest and largest value, both included.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RangeOf<T> {
    /// Smallest.
    pub min: T,
    /// Largest.
    pub max: T,
}

/// Settings that vary from trial to trial; those that are left out are the fit's.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Space {
    /// Kinds of model.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub kinds: Option<Vec<ModelKind>>,
    /// Number of blocks, drawn evenly.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub blocks: Option<RangeOf<usize>>,
    /// Cells of each block, drawn evenly on a logarithmic scale.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cells: Option<RangeOf<usize>>,
    /// Learning rate, drawn evenly on a logarithmic scale.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub learning_rate: Option<RangeOf<f64>>,
    /// Window lengths, samples.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub window_len: Option<Vec<usize>>,
    /// Step between window starts, as a share of the window, drawn evenly; at most 0.5.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub hop: Option<RangeOf<f64>>,
    /// Mini-batches, windows.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub batch_size: Option<Vec<usize>>,
}

/// What a trial varies; the rest is the fit's.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TrialSettings {
    /// Kind of model.
    pub kind: ModelKind,
    /// LSTM settings.
    pub lstm: LstmOptions,
}

impl Space {
    /// Where a request names no space: size, learning rate, windows and mini-batches, about the default preset.
    pub fn usual() -> Self {
        Self {
            kinds: None,
            blocks: Some(RangeOf { min: 1, max: 2 }),
            cells: Some(RangeOf { min: 16, max: 48 }),
            learning_rate: Some(RangeOf { min: 1e-3, max: 1e-2 }),
            window_len: Some(vec![128, 256, 512]),
            hop: Some(RangeOf { min: 0.25, max: 0.5 }),
            batch_size: Some(vec![16, 32, 64]),
        }
    }

    /// Refuses empty ranges and lists, values outside the limits of a fit, and a space without a setting.
    ///
    /// # Errors
    /// [`EngineError::Setting`] with the name of the setting, `space.cells` say.
    pub fn check(&self) -> Result<(), EngineError> {
        if *self == Self::default() {
            return refuse("space", "{}", "at least one setting that varies");
        }
        let whole = |setting, range: Option<RangeOf<usize>>, most: usize| match range {
            Some(RangeOf { min, max }) if min > max || min < 1 || max > most => refuse(
                setting,
                format!("{min} to {max}"),
                format!("min and max from 1 to {most}, min <= max"),
            ),
            _ => Ok(()),
        };
        whole("space.blocks", self.blocks, MAX_BLOCKS)?;
        whole("space.cells", self.cells, MAX_CELLS)?;
        let real = |setting, range: Option<RangeOf<f64>>, most: f64| match range {
            // Written so that NaN would be refused.
            Some(RangeOf { min, max }) if !(min > 0.0 && min <= max && max <= most) => refuse(
                setting,
                format!("{min} to {max}"),
                format!("min and max above 0, at most {most}, min <= max"),
            ),
            _ => Ok(()),
        };
        real("space.learning_rate", self.learning_rate, 1.0)?;
        real("space.hop", self.hop, 0.5)?;
        let list = |setting, list: Option<&[usize]>, least: usize, most: usize| match list {
            Some(list) if list.is_empty() || list.len() > MAX_CHOICES => {
                refuse(setting, format!("{} values", list.len()), format!("1 to {MAX_CHOICES} values"))
            }
            Some(list) => match list.iter().find(|value| !(least..=most).contains(*value)) {
                Some(value) => refuse(setting, value.to_string(), format!("values from {least} to {most}")),
                None => Ok(()),
            },
            None => Ok(()),
        };
        list("space.window_len", self.window_len.as_deref(), 2, MAX_WINDOW_LEN)?;
        list("space.batch_size", self.batch_size.as_deref(), 1, MAX_BATCH)?;
        match &self.kinds {
            Some(kinds) if kinds.is_empty() || kinds.len() > MAX_CHOICES => {
                refuse("space.kinds", format!("{} kinds", kinds.len()), format!("1 to {MAX_CHOICES} kinds"))
            }
            _ => Ok(()),
        }
    }

    /// Kinds that trials may have.
    pub fn kinds_or(&self, kind: ModelKind) -> Vec<ModelKind> {
        self.kinds.clone().unwrap_or_else(|| vec![kind])
    }

    /// The settings of a trial. Every number is drawn whether it is used or not, so that a trial keeps the others
    /// when one setting of the space is left out.
    pub fn draw(&self, base: &TrialSettings, seed: u64, trial: usize) -> TrialSettings {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(trial as u64 + 1);
        let mut share = || rng.random::<f64>();
        let at = |share: f64, n: usize| ((share * n as f64) as usize).min(n.saturating_sub(1));
        let [kind, blocks, cells, rate, window, hop, batch] = std::array::from_fn(|_| share());
        let mut drawn = base.clone();
        if let Some(kinds) = &self.kinds {
            drawn.kind = kinds[at(kind, kinds.len())];
        }
        let lstm = &mut drawn.lstm;
        if self.blocks.is_some() || self.cells.is_some() {
            let given = lstm.blocks.clone().unwrap_or_default();
            let fixed = given.first().copied().unwrap_or(DEFAULT_CELLS);
            let n = self
                .blocks
                .map_or(given.len().max(1), |range| range.min + at(blocks, range.max - range.min + 1));
            let cells = self.cells.map_or(fixed, |range| {
                let drawn = logarithmic(range.min as f64, range.max as f64, cells).round() as usize;
                drawn.clamp(range.min, range.max)
            });
            lstm.blocks = Some(vec![cells; n]);
        }
        if let Some(range) = self.learning_rate {
            lstm.learning_rate = Some(logarithmic(range.min, range.max, rate));
        }
        if let Some(windows) = &self.window_len {
            lstm.window_len = Some(windows[at(window, windows.len())]);
        }
        if let Some(range) = self.hop {
            let len = lstm.window_len.unwrap_or(DEFAULT_WINDOW_LEN);
            let hop_share = range.min + (range.max - range.min) * hop;
            lstm.hop = Some(((hop_share * len as f64).round() as usize).clamp(1, (len / 2).max(1)));
        }
        if let Some(batches) = &self.batch_size {
            lstm.batch_size = Some(batches[at(batch, batches.len())]);
        }
        drawn
    }
}

/// Cells of the one block, and the window, of both presets' forward fits.
const DEFAULT_CELLS: usize = 39;
const DEFAULT_WINDOW_LEN: usize = 256;

fn logarithmic(min: f64, max: f64, share: f64) -> f64 {
    // Rounding must not leave the range.
    (min.ln() + (max.ln() - min.ln()) * share).exp().clamp(min, max)
}

fn refuse(
    setting: &'static str,
    found: impl Into<String>,
    limit: impl Into<String>,
) -> Result<(), EngineError> {
    Err(EngineError::Setting { setting, found: found.into(), limit: limit.into() })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn base() -> TrialSettings {
        TrialSettings { kind: ModelKind::Lstm, lstm: LstmOptions::default() }
    }

    #[test]
    fn a_trial_stays_within_its_space_and_is_the_same_each_time() {
        let space = Space { kinds: Some(vec![ModelKind::Lstm, ModelKind::Hybrid2]), ..Space::usual() };
        space.check().unwrap();
        let trials: Vec<TrialSettings> = (0..200).map(|trial| space.draw(&base(), 5, trial)).collect();
        for (trial, settings) in trials.iter().enumerate() {
            let lstm = &settings.lstm;
            let blocks = lstm.blocks.as_ref().unwrap();
            assert!((1..=2).contains(&blocks.len()) && blocks.iter().all(|c| (16..=48).contains(c)));
            let window = lstm.window_len.unwrap();
            assert!([128, 256, 512].contains(&window) && [16, 32, 64].contains(&lstm.batch_size.unwrap()));
            assert!((window / 4..=window / 2).contains(&lstm.hop.unwrap()));
            assert!((1e-3..=1e-2).contains(&lstm.learning_rate.unwrap()));
            assert_eq!(space.draw(&base(), 5, trial), *settings);
        }
        let of = |wanted: ModelKind| trials.iter().filter(|t| t.kind == wanted).count();
        assert!((60..140).contains(&of(ModelKind::Lstm)), "both kinds come: {}", of(ModelKind::Lstm));
        assert_ne!(space.draw(&base(), 6, 0), trials[0]);
        // The median of a logarithmic scale is the geometric mean.
        let below = trials.iter().filter(|t| t.lstm.learning_rate.unwrap() < 3.162e-3).count();
        assert!((70..130).contains(&below), "{below}");
    }

    #[test]
    fn a_setting_that_does_not_vary_is_the_fits_and_leaves_the_others_as_they_were() {
        let space = Space { cells: None, blocks: None, ..Space::usual() };
        let fixed = TrialSettings {
            lstm: LstmOptions { blocks: Some(vec![7, 9]), ..LstmOptions::default() },
            ..base()
        };
        let (some, all) = (space.draw(&fixed, 1, 3), Space::usual().draw(&base(), 1, 3));
        assert_eq!(some.lstm.blocks, Some(vec![7, 9]));
        assert_eq!(some.lstm.learning_rate, all.lstm.learning_rate);
        let cells = Space { cells: Some(RangeOf { min: 5, max: 5 }), ..Space::default() };
        assert_eq!(cells.draw(&fixed, 1, 3).lstm.blocks, Some(vec![5, 5]), "as many blocks as the fit has");
    }

    #[test]
    fn an_empty_range_is_refused_by_name() {
        let usual = Space::usual;
        let range = |min, max| Some(RangeOf { min, max });
        for (space, name) in [
            (Space::default(), "space"),
            (Space { cells: Some(RangeOf { min: 9, max: 8 }), ..usual() }, "space.cells"),
            (Space { blocks: Some(RangeOf { min: 0, max: 1 }), ..usual() }, "space.blocks"),
            (Space { cells: Some(RangeOf { min: 1, max: 513 }), ..usual() }, "space.cells"),
            (Space { learning_rate: range(1e-2, 1e-3), ..usual() }, "space.learning_rate"),
            (Space { learning_rate: range(0.0, 1e-3), ..usual() }, "space.learning_rate"),
            (Space { learning_rate: range(f64::NAN, 1e-3), ..usual() }, "space.learning_rate"),
            (Space { hop: range(0.1, 0.6), ..usual() }, "space.hop"),
            (Space { window_len: Some(vec![]), ..usual() }, "space.window_len"),
            (Space { window_len: Some(vec![1]), ..usual() }, "space.window_len"),
            (Space { batch_size: Some(vec![0]), ..usual() }, "space.batch_size"),
            (Space { batch_size: Some(vec![1; 17]), ..usual() }, "space.batch_size"),
            (Space { kinds: Some(vec![]), ..usual() }, "space.kinds"),
        ] {
            match space.check() {
                Err(EngineError::Setting { setting, .. }) => assert_eq!(setting, name),
                other => panic!("{name}: {other:?}"),
            }
        }
    }
}
