//! Averages over the runs of a class, and what one model has over another.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::compare::{ChannelFigures, DamageFigures, RunFigures};
use crate::metrics::geometric_mean;

/// Channels that are averaged together.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ChannelGroup {
    /// Its name.
    pub name: String,
    /// Names of its channels.
    pub channels: Vec<String>,
}

/// Why an average is absent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NoAverage {
    /// There is no run to average over.
    NoRun,
    /// What was measured is zero in every run, or does not move where the figure leaves the mean out.
    MeasuredStill,
    /// The target does no damage in any run.
    TargetDamageZero,
    /// The prediction does no damage in some run, so that the geometric mean is none.
    PredictedDamageZero,
    /// The group has no Multi-Rain: it is not three channels of a vector, or the model does not predict them all.
    NotAVector,
}

/// Averages of one channel.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ChannelAverage {
    /// Mean over runs of the RMS error.
    pub rms: Option<f64>,
    /// Mean over runs of the RMS error about the means.
    pub rms_ac: Option<f64>,
    /// Mean over runs of the error of the spectrum.
    pub psd_rms: Option<f64>,
    /// Geometric mean over runs of predicted over target damage.
    pub damage_ratio: Option<f64>,
    /// Why figures are absent, by their names.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub reasons: BTreeMap<String, NoAverage>,
}

/// Averages of one group: over its channels.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct GroupAverage {
    /// Mean of the channels' `rms`.
    pub rms: Option<f64>,
    /// Mean of the channels' `rms_ac`.
    pub rms_ac: Option<f64>,
    /// Mean of the channels' `psd_rms`.
    pub psd_rms: Option<f64>,
    /// Geometric mean of the channels' `damage_ratio`.
    pub damage_ratio: Option<f64>,
    /// Geometric mean over runs of the Multi-Rain damage ratio.
    pub multi_rain: Option<f64>,
    /// Why figures are absent, by their names.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub reasons: BTreeMap<String, NoAverage>,
}

/// Averages of a class.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct ClassAverage {
    /// By channel name.
    pub channels: BTreeMap<String, ChannelAverage>,
    /// By group name.
    pub groups: BTreeMap<String, GroupAverage>,
}

/// Averages over `runs` of the channels of all `groups`. A run without a channel is left out of that channel's
/// averages.
pub fn average(runs: &[&RunFigures], groups: &[ChannelGroup]) -> ClassAverage {
    let names = groups.iter().flat_map(|group| &group.channels);
    let channels: BTreeMap<String, ChannelAverage> =
        names.map(|name| (name.clone(), channel_average(runs, name))).collect();
    let groups =
        groups.iter().map(|group| (group.name.clone(), group_average(runs, group, &channels))).collect();
    ClassAverage { channels, groups }
}

fn channel_average(runs: &[&RunFigures], name: &str) -> ChannelAverage {
    let found: Vec<&ChannelFigures> = runs.iter().filter_map(|run| run.channels.get(name)).collect();
    let mut reasons = BTreeMap::new();
    let mut error = |what: &str, figure: fn(&ChannelFigures) -> Option<f64>| {
        noted(&mut reasons, what, mean(found.iter().map(|figures| figure(figures))))
    };
    ChannelAverage {
        rms: error("rms", |figures| figures.errors.rms),
        rms_ac: error("rms_ac", |figures| figures.errors.rms_ac),
        psd_rms: error("psd_rms", |figures| figures.errors.psd_rms),
        damage_ratio: noted(&mut reasons, "damage_ratio", mean_ratio(found.iter().map(|f| &f.damage))),
        reasons,
    }
}

fn group_average(
    runs: &[&RunFigures],
    group: &ChannelGroup,
    channels: &BTreeMap<String, ChannelAverage>,
) -> GroupAverage {
    let members: Vec<&ChannelAverage> = group.channels.iter().filter_map(|name| channels.get(name)).collect();
    let mut reasons = BTreeMap::new();
    let mut error = |what: &str, figure: fn(&ChannelAverage) -> Option<f64>| {
        noted(&mut reasons, what, mean(members.iter().map(|member| figure(member))))
    };
    let (rms, rms_ac) = (error("rms", |member| member.rms), error("rms_ac", |member| member.rms_ac));
    let psd_rms = error("psd_rms", |member| member.psd_rms);
    let ratios: Vec<f64> = members.iter().filter_map(|member| member.damage_ratio).collect();
    let first = members.iter().find_map(|member| member.reasons.get("damage_ratio"));
    let damage_ratio = geometric_mean(&ratios).ok_or(first.copied().unwrap_or(NoAverage::NoRun));
    let multi_rain: Vec<&DamageFigures> = runs.iter().filter_map(|run| run.groups.get(&group.name)).collect();
    let multi_rain = if multi_rain.is_empty() && !runs.is_empty() {
        Err(NoAverage::NotAVector)
    } else {
        mean_ratio(multi_rain.into_iter())
    };
    GroupAverage {
        rms,
        rms_ac,
        psd_rms,
        damage_ratio: noted(&mut reasons, "damage_ratio", damage_ratio),
        multi_rain: noted(&mut reasons, "multi_rain", multi_rain),
        reasons,
    }
}

fn noted(
    reasons: &mut BTreeMap<String, NoAverage>,
    what: &str,
    figure: Result<f64, NoAverage>,
) -> Option<f64> {
    figure.map_err(|reason| reasons.insert(what.to_owned(), reason)).ok()
}

/// Mean of the figures that are there.
fn mean(figures: impl ExactSizeIterator<Item = Option<f64>>) -> Result<f64, NoAverage> {
    let none = if figures.len() == 0 { NoAverage::NoRun } else { NoAverage::MeasuredStill };
    let found: Vec<f64> = figures.flatten().collect();
    if found.is_empty() { Err(none) } else { Ok(found.iter().sum::<f64>() / found.len() as f64) }
}

/// Geometric mean of the ratios that are there.
fn mean_ratio<'a>(damages: impl ExactSizeIterator<Item = &'a DamageFigures>) -> Result<f64, NoAverage> {
    let none = if damages.len() == 0 { NoAverage::NoRun } else { NoAverage::TargetDamageZero };
    let ratios: Vec<f64> = damages.filter_map(|damage| damage.ratio.ratio).collect();
    if ratios.is_empty() { Err(none) } else { geometric_mean(&ratios).ok_or(NoAverage::PredictedDamageZero) }
}

/// What one model has over another on a channel; absent where one of them lacks the figure.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ChannelDifference {
    /// `rms` minus that of the baseline: below 0 is better.
    pub rms: Option<f64>,
    /// `psd_rms` minus that of the baseline.
    pub psd_rms: Option<f64>,
    /// `damage_ratio` over that of the baseline.
    pub damage_ratio: Option<f64>,
}

/// The same on a group.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct GroupDifference {
    /// As of channels.
    #[serde(flatten)]
    pub errors: ChannelDifference,
    /// `multi_rain` over that of the baseline.
    pub multi_rain: Option<f64>,
}

/// Differences over a class.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct ClassDifference {
    /// By channel name.
    pub channels: BTreeMap<String, ChannelDifference>,
    /// By group name.
    pub groups: BTreeMap<String, GroupDifference>,
}

/// Differences of the channels and groups that both have. Both must be averages over the same runs.
pub fn difference(of: &ClassAverage, baseline: &ClassAverage) -> ClassDifference {
    let minus = |a: Option<f64>, b: Option<f64>| Some(a? - b?);
    let over = |a: Option<f64>, b: Option<f64>| Some(a? / b?).filter(|ratio| ratio.is_finite());
    let channels = of.channels.iter().filter_map(|(name, a)| {
        let b = baseline.channels.get(name)?;
        let difference = ChannelDifference {
            rms: minus(a.rms, b.rms),
            psd_rms: minus(a.psd_rms, b.psd_rms),
            damage_ratio: over(a.damage_ratio, b.damage_ratio),
        };
        Some((name.clone(), difference))
    });
    let groups = of.groups.iter().filter_map(|(name, a)| {
        let b = baseline.groups.get(name)?;
        let errors = ChannelDifference {
            rms: minus(a.rms, b.rms),
            psd_rms: minus(a.psd_rms, b.psd_rms),
            damage_ratio: over(a.damage_ratio, b.damage_ratio),
        };
        Some((name.clone(), GroupDifference { errors, multi_rain: over(a.multi_rain, b.multi_rain) }))
    });
    ClassDifference { channels: channels.collect(), groups: groups.collect() }
}
