//! The figures of one prediction.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::worst_span::{WorstSpan, worst_span};
use crate::fatigue::{DamageChannel, DamageGroup, DamageRatio, DamageSettings, TargetDamage, damage_report};
use crate::metrics::{ChannelErrors, errors_with_spectra};
use crate::spectral::Psd;
use crate::{EngineError, Signal};

/// Settings of the figures.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CompareSettings {
    /// Of damage and Multi-Rain.
    pub damage: DamageSettings,
    /// Length of the spans that are searched for the worst, s.
    pub span_s: f64,
}

/// Damage of prediction and target, and their ratio.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DamageFigures {
    /// Of the prediction.
    pub predicted: f64,
    /// Of the measurement.
    pub target: f64,
    /// Predicted over target.
    #[serde(flatten)]
    pub ratio: DamageRatio,
}

/// Figures of one channel.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ChannelFigures {
    /// Errors.
    #[serde(flatten)]
    pub errors: ChannelErrors,
    /// Palmgren-Miner damage.
    pub damage: DamageFigures,
}

/// Figures of one model on one run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunFigures {
    /// By channel name.
    pub channels: BTreeMap<String, ChannelFigures>,
    /// Multi-Rain damage by the name of a group whose three channels are compared.
    pub groups: BTreeMap<String, DamageFigures>,
    /// Where the prediction is farthest off; `None` where everything measured is zero.
    pub worst_span: Option<WorstSpan>,
}

/// The figures of a prediction and the spectra behind them.
#[derive(Debug, Clone, PartialEq)]
pub struct Compared {
    /// Figures.
    pub figures: RunFigures,
    /// Samples of a segment of the spectra.
    pub segment_len: usize,
    /// Of the measured channels, in their order.
    pub measured: Psd,
    /// Of the predicted channels, in the same order.
    pub predicted: Psd,
}

/// Compares a prediction with what was measured. Both have the channels `names`; `groups` holds the places of x, y
/// and z.
///
/// # Errors
/// Signals that differ in channels, length or sample rate, no samples, settings outside their limits, figures beyond
/// `f64`.
///
/// # Panics
/// If there are other than one name a channel, or a group with a place that is none.
pub fn compare(
    names: &[String],
    groups: &[DamageGroup<'_>],
    measured: &Signal,
    predicted: &Signal,
    settings: &CompareSettings,
) -> Result<Compared, EngineError> {
    assert_eq!(names.len(), measured.n_channels(), "one name a channel");
    let (errors, [measured_psd, predicted_psd]) = errors_with_spectra(measured, predicted)?;
    let channel = |(c, name): (usize, &'_ String)| (name.clone(), errors.channels[c]);
    let found: Vec<(String, ChannelErrors)> = names.iter().enumerate().map(channel).collect();
    let channels: Vec<DamageChannel<'_>> = names
        .iter()
        .enumerate()
        .map(|(c, name)| DamageChannel {
            name,
            predicted: predicted.channel(c),
            target: Some(measured.channel(c)),
        })
        .collect();
    let damage = damage_report(&channels, groups, &settings.damage)?;
    let no_target = || unreachable!("every channel has a target");
    let channels = found.into_iter().zip(damage.channels).map(|((name, errors), (_, damage))| {
        let TargetDamage { target, ratio } = damage.target.unwrap_or_else(no_target);
        let damage = DamageFigures { predicted: damage.predicted, target, ratio };
        (name, ChannelFigures { errors, damage })
    });
    let groups = damage.groups.into_iter().filter_map(|(name, damage)| {
        let target = damage.target?;
        let figures =
            DamageFigures { predicted: damage.predicted, target: target.target, ratio: target.ratio };
        Some((name, figures))
    });
    Ok(Compared {
        figures: RunFigures {
            channels: channels.collect(),
            groups: groups.collect(),
            worst_span: worst_span(names, measured, predicted, settings.span_s),
        },
        segment_len: errors.settings.psd.segment_len,
        measured: measured_psd,
        predicted: predicted_psd,
    })
}
