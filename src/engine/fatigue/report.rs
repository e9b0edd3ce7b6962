//! The whole fatigue answer for predicted channels, with or without targets: what predict,
//! `/v1/damage` and evaluations send.

use rayon::prelude::*;
use serde::ser::SerializeMap;
use serde::{Serialize, Serializer};

use super::classes::ClassSettings;
use super::counts::{Counts, counts};
use super::damage::{DamageRatio, DamageSettings, check_finite, damage_unchecked, finite};
use super::multi_rain::multi_rain_unchecked;
use super::rainflow::Residue;
use crate::EngineError;

/// One channel to report on.
#[derive(Debug, Clone, Copy)]
pub struct DamageChannel<'a> {
    /// Its name.
    pub name: &'a str,
    /// Predicted samples, in the channel's unit.
    pub predicted: &'a [f64],
    /// What was wanted or measured, as long as `predicted`.
    pub target: Option<&'a [f64]>,
}

/// Three channels that are one vector in space.
#[derive(Debug, Clone, Copy)]
pub struct DamageGroup<'a> {
    /// Its name.
    pub name: &'a str,
    /// Places of x, y and z among the channels.
    pub channels: [usize; 3],
}

/// Damage per channel and group, and the settings behind it. Entries keep the order of the
/// request.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DamageReport {
    /// Settings of every figure.
    pub settings: DamageSettings,
    /// By channel name.
    #[serde(serialize_with = "as_map")]
    pub channels: Vec<(String, ChannelDamage)>,
    /// By group name.
    #[serde(serialize_with = "as_map")]
    pub groups: Vec<(String, GroupDamage)>,
    /// Groups of which something cannot be said.
    pub omitted: Vec<OmittedGroup>,
}

/// A group without Multi-Rain, or without its ratio.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct OmittedGroup {
    /// Its name.
    pub group: String,
    /// The channels that are missing, in the group's order.
    pub channels: Vec<String>,
    /// What they lack.
    pub reason: Omission,
}

/// Why something about a group is left out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Omission {
    /// Only some of its channels are predicted: there is no Multi-Rain.
    NotPredicted,
    /// Only some of its channels have a target: there is no ratio.
    NoTarget,
}

/// Damage of one channel.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ChannelDamage {
    /// Palmgren-Miner sum of the predicted samples.
    pub predicted: f64,
    /// Only with a target.
    #[serde(flatten)]
    pub target: Option<TargetDamage>,
}

/// What a target adds to a channel.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct TargetDamage {
    /// Palmgren-Miner sum of the target.
    pub target: f64,
    /// Predicted over target.
    #[serde(flatten)]
    pub ratio: DamageRatio,
}

/// Multi-Rain damage of one group.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct GroupDamage {
    /// Largest damage of the predicted samples.
    pub predicted: f64,
    /// Unit vector `[x, y, z]` of that damage.
    pub direction_predicted: [f64; 3],
    /// Only when all three channels have a target.
    #[serde(flatten)]
    pub target: Option<GroupTarget>,
}

/// What targets add to a group.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct GroupTarget {
    /// Largest damage of the targets, in whatever direction that is.
    pub target: f64,
    /// Predicted over target (Heindel et al., section 3.2).
    #[serde(flatten)]
    pub ratio: DamageRatio,
    /// Unit vector `[x, y, z]` of the target's damage.
    pub direction_target: [f64; 3],
}

/// Damage of every channel and group. They are counted side by side on rayon's current pool; figures, and the error of several
/// that is returned, do not depend on the number of threads.
///
/// # Errors
/// Settings outside their limits; no samples; unequal lengths; a sample that is not finite; a
/// group with a channel that is not there; damage beyond `f64`. `channel` is the place in
/// `channels`, `what` is `predicted`, `target` or `damage ratio`.
pub fn damage_report(
    channels: &[DamageChannel<'_>],
    groups: &[DamageGroup<'_>],
    settings: &DamageSettings,
) -> Result<DamageReport, EngineError> {
    settings.check()?;
    check(channels)?;
    let channel_damage = |i: usize, c: &DamageChannel<'_>| {
        let predicted = damage_unchecked(c.predicted, settings, "predicted", i)?;
        let target = match c.target {
            Some(target) => {
                let target = damage_unchecked(target, settings, "target", i)?;
                Some(TargetDamage { target, ratio: ratio(predicted, target, i)? })
            }
            None => None,
        };
        Ok((c.name.to_owned(), ChannelDamage { predicted, target }))
    };
    let group_damage = |group: &DamageGroup<'_>| {
        if let Some(missing) = group.channels.iter().find(|&&c| c >= channels.len()) {
            return Err(EngineError::ChannelCount {
                what: "group",
                expected: missing + 1,
                found: channels.len(),
            });
        }
        let first = group.channels[0];
        let predicted = || {
            let predicted = group.channels.map(|c| channels[c].predicted);
            multi_rain_unchecked(predicted, settings, "predicted", first)
        };
        let target = || match group.channels.map(|c| channels[c].target) {
            [Some(x), Some(y), Some(z)] => {
                multi_rain_unchecked([x, y, z], settings, "target", first).map(Some)
            }
            _ => Ok(None),
        };
        let (predicted, target) = rayon::join(predicted, target);
        let predicted = predicted?;
        let target = match target? {
            Some(target) => {
                let ratio = ratio(predicted.damage, target.damage, first)?;
                Some(GroupTarget { target: target.damage, ratio, direction_target: target.direction })
            }
            None => None,
        };
        let damage =
            GroupDamage { predicted: predicted.damage, direction_predicted: predicted.direction, target };
        Ok((group.name.to_owned(), damage))
    };
    // Of a group whose channels have no target at all none was asked for.
    let without_ratio = |group: &DamageGroup<'_>| {
        let members = group.channels.iter().filter_map(|&c| channels.get(c));
        let missing: Vec<String> =
            members.filter(|c| c.target.is_none()).map(|c| c.name.to_owned()).collect();
        let reason = Omission::NoTarget;
        (1..group.channels.len()).contains(&missing.len()).then(|| OmittedGroup {
            group: group.name.to_owned(),
            channels: missing,
            reason,
        })
    };
    // The groups take longest: their directions begin while channels are counted.
    let (of_groups, of_channels): (Vec<_>, Vec<_>) = rayon::join(
        || groups.par_iter().map(group_damage).collect(),
        || channels.par_iter().enumerate().map(|(i, c)| channel_damage(i, c)).collect(),
    );
    Ok(DamageReport {
        settings: *settings,
        channels: of_channels.into_iter().collect::<Result<_, EngineError>>()?,
        groups: of_groups.into_iter().collect::<Result<_, EngineError>>()?,
        omitted: groups.iter().filter_map(without_ratio).collect(),
    })
}

/// Count tables per channel, and the settings behind them.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CountsReport {
    /// Classes as asked for; limits left out are each channel's own.
    pub classes: ClassSettings,
    /// What unclosed turning points count for.
    pub residue: Residue,
    /// By channel name.
    #[serde(serialize_with = "as_map")]
    pub channels: Vec<(String, ChannelCounts)>,
}

/// Count tables of one channel; prediction and target share their classes.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ChannelCounts {
    /// Of the predicted samples.
    pub predicted: Counts,
    /// Of the target, when there is one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub target: Option<Counts>,
}

/// Range-pair count, level crossings and from-to matrix of every channel.
///
/// # Errors
/// Class settings outside their limits, or that leave samples out; no samples; unequal lengths; a
/// sample that is not finite.
pub fn counts_report(
    channels: &[DamageChannel<'_>],
    classes: &ClassSettings,
    residue: Residue,
) -> Result<CountsReport, EngineError> {
    classes.check()?;
    check(channels)?;
    let tables = |c: &DamageChannel<'_>| {
        let shared = classes.over(&[c.predicted, c.target.unwrap_or_default()])?;
        let predicted = counts(c.predicted, &shared, residue);
        let target = c.target.map(|t| counts(t, &shared, residue));
        Ok((c.name.to_owned(), ChannelCounts { predicted, target }))
    };
    let channels = channels.iter().map(tables).collect::<Result<_, EngineError>>()?;
    Ok(CountsReport { classes: *classes, residue, channels })
}

/// Every signal has samples, as many as the first, all finite.
fn check(channels: &[DamageChannel<'_>]) -> Result<(), EngineError> {
    let Some(first) = channels.first() else {
        return Err(EngineError::ChannelCount { what: "predicted", expected: 1, found: 0 });
    };
    let expected = first.predicted.len();
    if expected == 0 {
        return Err(EngineError::TooShort { what: "predicted", needed: 1, found: 0 });
    }
    for (channel, c) in channels.iter().enumerate() {
        for (what, samples) in [("predicted", Some(c.predicted)), ("target", c.target)] {
            let Some(samples) = samples else { continue };
            if samples.len() != expected {
                return Err(EngineError::UnequalLength { what, channel, expected, found: samples.len() });
            }
            check_finite(what, channel, samples)?;
        }
    }
    Ok(())
}

fn ratio(predicted: f64, target: f64, channel: usize) -> Result<DamageRatio, EngineError> {
    let ratio = DamageRatio::of(predicted, target);
    finite(ratio.ratio.unwrap_or(0.0), "damage ratio", channel)?;
    Ok(ratio)
}

/// Pairs as a JSON object in their own order.
fn as_map<T: Serialize, S: Serializer>(entries: &[(String, T)], serializer: S) -> Result<S::Ok, S::Error> {
    let mut map = serializer.serialize_map(Some(entries.len()))?;
    for (name, value) in entries {
        map.serialize_entry(name, value)?;
    }
    map.end()
}

#[cfg(test)]
mod tests {
    use super::super::{damage, multi_rain};
    use super::*;

    fn channel<'a>(name: &'a str, predicted: &'a [f64], target: Option<&'a [f64]>) -> DamageChannel<'a> {
        DamageChannel { name, predicted, target }
    }

    fn wave(level: f64, step: f64) -> Vec<f64> {
        (0..200).map(|i| level * (step * f64::from(i)).sin()).collect()
    }

    #[test]
    fn the_report_has_the_figures_of_its_parts_in_the_order_asked() {
        let (x, y, z, t) = (wave(3.0, 0.1), wave(1.0, 0.7), wave(2.0, 0.3), wave(2.5, 0.1));
        let channels = [
            channel("z", &z, Some(&z)),
            channel("x", &x, Some(&t)),
            channel("y", &y, Some(&y)),
            channel("extra", &x, None),
        ];
        let groups = [
            DamageGroup { name: "force", channels: [1, 2, 0] },
            DamageGroup { name: "half", channels: [1, 2, 3] },
        ];
        let settings = DamageSettings { directions: 100, ..Default::default() };
        let report = damage_report(&channels, &groups, &settings).unwrap();

        let names: Vec<_> = report.channels.iter().map(|(n, _)| n.as_str()).collect();
        assert_eq!(names, ["z", "x", "y", "extra"]);
        let (predicted, target) = (damage(&x, &settings).unwrap(), damage(&t, &settings).unwrap());
        let found = report.channels[1].1;
        assert_eq!(found.predicted, predicted);
        assert_eq!(found.target, Some(TargetDamage { target, ratio: DamageRatio::of(predicted, target) }));
        assert_eq!(report.channels[0].1.target.unwrap().ratio.ratio, Some(1.0));
        assert_eq!(report.channels[3].1.target, None);

        let group = report.groups[0].1;
        let predicted = multi_rain([&x, &y, &z], &settings).unwrap();
        let target = multi_rain([&t, &y, &z], &settings).unwrap();
        assert_eq!((group.predicted, group.direction_predicted), (predicted.damage, predicted.direction));
        let found = group.target.unwrap();
        assert_eq!((found.target, found.direction_target), (target.damage, target.direction));
        assert_eq!(found.ratio.ratio, Some(predicted.damage / target.damage));
        assert_eq!(report.groups[1].1.target, None, "one of its channels has no target");
        let omitted =
            OmittedGroup { group: "half".into(), channels: vec!["extra".into()], reason: Omission::NoTarget };
        assert_eq!(report.omitted, [omitted]);
    }

    #[test]
    fn the_json_is_that_of_the_contract() {
        let (x, still) = ([0.0, 20.0, 0.0], [0.0; 3]);
        let settings = DamageSettings { directions: 1, ..Default::default() };
        let json = |target: Option<&[f64]>| {
            let channels = [channel("b", &x, target), channel("a", &still, None), channel("c", &still, None)];
            let groups = [DamageGroup { name: "g", channels: [0, 1, 2] }];
            let report =
                damage_report(&channels[..], if target.is_none() { &groups } else { &[] }, &settings);
            serde_json::to_string(&report.unwrap()).unwrap()
        };
        let head = r#"{"settings":{"slope":5.0,"constant":10000000.0,"residue":"repeated","directions":1},"#;
        let rest = r#""a":{"predicted":0.0},"c":{"predicted":0.0}}"#;
        assert_eq!(
            json(Some(&x)),
            format!(
                r#"{head}"channels":{{"b":{{"predicted":0.01,"target":0.01,"ratio":1.0}},{rest},"groups":{{}},"omitted":[]}}"#
            )
        );
        assert_eq!(
            json(Some(&still)),
            format!(
                concat!(
                    r#"{}"channels":{{"b":{{"predicted":0.01,"target":0.0,"ratio":null,"#,
                    r#""reason":"target_damage_zero"}},{},"groups":{{}},"omitted":[]}}"#
                ),
                head, rest
            )
        );
        let alone: serde_json::Value = serde_json::from_str(&json(None)).unwrap();
        let group = alone["groups"]["g"].as_object().unwrap();
        let mut keys: Vec<_> = group.keys().map(String::as_str).collect();
        keys.sort_unstable();
        assert_eq!(keys, ["direction_predicted", "predicted"]);
    }

    #[test]
    fn a_group_with_targets_has_the_fields_of_the_contract() {
        let x = [0.0, 20.0, 0.0];
        let channels = [channel("x", &x, Some(&x)), channel("y", &x, Some(&x)), channel("z", &x, Some(&x))];
        let groups = [DamageGroup { name: "g", channels: [0, 1, 2] }];
        let report = damage_report(&channels, &groups, &DamageSettings::default()).unwrap();
        let json = serde_json::to_value(&report).unwrap();
        let group = json["groups"]["g"].as_object().unwrap();
        let mut keys: Vec<_> = group.keys().map(String::as_str).collect();
        keys.sort_unstable();
        assert_eq!(keys, ["direction_predicted", "direction_target", "predicted", "ratio", "target"]);
        assert_eq!(group["ratio"], 1.0);
    }

    #[test]
    fn bad_signals_are_refused_by_what_channel_and_sample() {
        let (good, short, nan) = ([0.0, 1.0], [0.0], [0.0, f64::NAN]);
        let refused = |channels: &[DamageChannel<'_>]| {
            let error = damage_report(channels, &[], &DamageSettings::default()).unwrap_err();
            assert_eq!(counts_report(channels, &ClassSettings::default(), Residue::Half).unwrap_err(), error);
            error
        };
        assert_eq!(
            refused(&[channel("a", &good, None), channel("b", &good, Some(&nan))]),
            EngineError::NonFinite { what: "target", channel: 1, sample: 1 }
        );
        assert_eq!(
            refused(&[channel("a", &good, Some(&short))]),
            EngineError::UnequalLength { what: "target", channel: 0, expected: 2, found: 1 }
        );
        assert_eq!(
            refused(&[channel("a", &good, None), channel("b", &short, None)]),
            EngineError::UnequalLength { what: "predicted", channel: 1, expected: 2, found: 1 }
        );
        assert_eq!(
            refused(&[channel("a", &[], None)]),
            EngineError::TooShort { what: "predicted", needed: 1, found: 0 }
        );
        assert_eq!(refused(&[]), EngineError::ChannelCount { what: "predicted", expected: 1, found: 0 });
    }

    #[test]
    fn overflow_and_missing_channels_are_errors() {
        let (x, huge, tiny) = ([0.0, 1.0], [0.0, 1e100], [0.0, 1e-60]);
        let s = DamageSettings::default();
        assert_eq!(
            damage_report(&[channel("a", &x, None), channel("b", &x, Some(&huge))], &[], &s),
            Err(EngineError::DamageOverflow { what: "target", channel: 1 })
        );
        let large = [0.0, 1e60];
        assert_eq!(
            damage_report(&[channel("a", &large, Some(&tiny))], &[], &s),
            Err(EngineError::DamageOverflow { what: "damage ratio", channel: 0 })
        );
        assert_eq!(
            damage_report(&[channel("a", &x, None)], &[DamageGroup { name: "g", channels: [0, 0, 4] }], &s),
            Err(EngineError::ChannelCount { what: "group", expected: 5, found: 1 })
        );
    }

    #[test]
    fn counts_of_prediction_and_target_share_their_classes() {
        let (x, t) = ([0.0, 1.0, 0.0], [0.0, 4.0, -4.0]);
        let classes = ClassSettings { count: 8, ..Default::default() };
        let report =
            counts_report(&[channel("a", &x, Some(&t)), channel("b", &x, None)], &classes, Residue::Half)
                .unwrap();
        let (name, a) = &report.channels[0];
        assert_eq!(name, "a");
        let target = a.target.as_ref().unwrap();
        assert_eq!(a.predicted.from_to.edges, target.from_to.edges);
        assert_eq!(target.from_to.edges[0], -4.0);
        assert_eq!(target.from_to.edges[8], 4.0);
        assert_eq!(a.predicted.range_pair.cumulative[0], 1.0);
        let b = &report.channels[1].1;
        assert_eq!((b.predicted.from_to.edges[8], b.target.is_none()), (1.0, true));
        let json = serde_json::to_value(&report).unwrap();
        assert_eq!(json["classes"], serde_json::json!({"count": 8, "lower": null, "upper": null}));
        assert_eq!(json["residue"], "half");
        assert!(json["channels"]["b"].get("target").is_none());
    }
}
