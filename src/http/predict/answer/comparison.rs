//! What a prediction and its target have in common: errors and damage.

use std::collections::BTreeMap;

use serde::Serialize;

use crate::domain::Rig;
use crate::engine::Signal;
use crate::engine::fatigue::{
    DamageChannel, DamageGroup, DamageReport, DamageSettings, Omission, OmittedGroup, damage_report,
};
use crate::engine::metrics::{self, ChannelErrors, ErrorSettings};
use crate::engine::model::Preprocess;
use crate::http::errors;
use crate::http::predict::inputs::Target;
use crate::http::problem::Answer;

/// Errors by channel name.
#[derive(Debug, Serialize)]
pub(in crate::http::predict) struct ErrorReport {
    settings: ComparisonSettings,
    pub(in crate::http::predict) channels: BTreeMap<String, ChannelErrors>,
}

/// How a prediction was compared with its target.
#[derive(Debug, Serialize)]
struct ComparisonSettings {
    #[serde(flatten)]
    errors: ErrorSettings,
    /// The model's filter, which the target has passed before the comparison.
    preprocess: Preprocess,
}

/// Damage, and the filter that the target has passed, if there are both.
#[derive(Debug, Serialize)]
pub(super) struct DamageAnswer {
    #[serde(flatten)]
    pub(super) report: DamageReport,
    #[serde(skip_serializing_if = "Preprocess::is_none")]
    pub(super) preprocess: Preprocess,
}

/// Damage of every output, and Multi-Rain of every group of the rig whose channels are outputs.
pub(in crate::http::predict) fn damages(
    rig: &Rig,
    outputs: &[String],
    response: &Signal,
    target: Option<&Target>,
    settings: &DamageSettings,
) -> Answer<DamageReport> {
    let wanted = |name: &String| {
        let target = target?;
        let place = target.names.iter().position(|n| n == name)?;
        Some(target.signal.channel(place))
    };
    let channels: Vec<DamageChannel<'_>> = outputs
        .iter()
        .zip(response.channels())
        .map(|(name, predicted)| DamageChannel { name, predicted, target: wanted(name) })
        .collect();
    let (groups, omitted) = groups(rig, outputs);
    let mut report =
        damage_report(&channels, &groups, settings).map_err(|error| errors::engine(&error, outputs, ""))?;
    report.omitted.extend(omitted);
    Ok(report)
}

/// Groups with the places of their channels among the outputs, in the rig's order; and those of which
/// only a part is among them.
pub(in crate::http::predict) fn groups<'a>(
    rig: &'a Rig,
    outputs: &[String],
) -> (Vec<DamageGroup<'a>>, Vec<OmittedGroup>) {
    let (mut whole, mut partial) = (Vec::new(), Vec::new());
    for (name, members) in rig.groups() {
        let place = |member: &&str| outputs.iter().position(|output| output == member);
        let places: Vec<usize> = members.iter().filter_map(place).collect();
        if let Ok(channels) = <[usize; 3]>::try_from(&places[..]) {
            whole.push(DamageGroup { name, channels });
        } else if !places.is_empty() {
            let missing = members.iter().filter(|member| place(member).is_none());
            let channels = missing.map(|member| (*member).to_owned()).collect();
            partial.push(OmittedGroup { group: name.to_owned(), channels, reason: Omission::NotPredicted });
        }
    }
    (whole, partial)
}

/// Errors of the outputs that have a target.
pub(in crate::http::predict) fn distances(
    outputs: &[String],
    response: &Signal,
    target: &Target,
    preprocess: Preprocess,
) -> Answer<ErrorReport> {
    let places: Vec<usize> =
        target.names.iter().filter_map(|name| outputs.iter().position(|output| output == name)).collect();
    let found = metrics::errors(&target.signal, &response.select(&places))
        .map_err(|error| errors::engine(&error, &target.names, "/target/channels"))?;
    let channels = target.names.iter().cloned().zip(found.channels).collect();
    Ok(ErrorReport { settings: ComparisonSettings { errors: found.settings, preprocess }, channels })
}
