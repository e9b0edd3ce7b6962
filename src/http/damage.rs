//! Damage and counts of the signals in a request, without rig or model.

use axum::extract::State;
use serde::{Deserialize, Serialize};

use super::body::HoldsSignals;
use super::body::signals::{Channels, Signals};
use super::json::{self, SignalsJson};
use super::params::NoParams;
use super::problem::{Answer, FieldError, Problem};
use super::{Shared, codes, errors};
use crate::compute::Class;
use crate::engine::fatigue::{
    ClassSettings, CountsReport, DamageChannel, DamageGroup, DamageReport, DamageSettings, counts_report,
    damage_report,
};
use crate::engine::{EngineError, Signal, rounded};

/// The body.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DamageRequest {
    predicted: Signals,
    #[serde(default)]
    target: Option<Signals>,
    #[serde(default)]
    groups: Groups,
    #[serde(default)]
    damage: DamageSettings,
    #[serde(default)]
    classes: ClassSettings,
}

impl HoldsSignals for DamageRequest {
    fn signals(&mut self) -> Vec<&mut Channels> {
        let signals = std::iter::once(&mut self.predicted).chain(&mut self.target);
        signals.map(|signals| &mut signals.channels).collect()
    }
}

/// Channels of each group, in the order of the groups' names.
type Groups = std::collections::BTreeMap<String, [String; 3]>;

#[derive(Debug, Serialize)]
struct DamageAnswer {
    damage: DamageReport,
    counts: CountsReport,
}

/// `POST /v1/damage`
pub async fn damage(
    State(http): State<Shared>,
    _: NoParams,
    SignalsJson(request): SignalsJson<DamageRequest>,
) -> Answer {
    let signals = [Some(&request.predicted), request.target.as_ref()];
    let values = signals.iter().flatten().map(|s| s.channels.values()).sum();
    http.in_time(Class::of_values(values), move |_| report(request)).await.map(json::respond)
}

fn report(request: DamageRequest) -> Answer<Vec<u8>> {
    let DamageRequest { predicted, target, groups, damage, classes } = request;
    let names = predicted.channels.names();
    let rate = predicted.sample_rate_hz;
    let predicted = signal(predicted, &names, "/predicted")?;
    let mut targets = match target {
        Some(target) => targets(target, &names, rate)?,
        None => Channels::default(),
    };
    let targets: Vec<Option<Vec<f64>>> = names.iter().map(|name| targets.take(name)).collect();
    let channels: Vec<DamageChannel<'_>> = names
        .iter()
        .zip(predicted.channels())
        .zip(&targets)
        .map(|((name, predicted), target)| DamageChannel { name, predicted, target: target.as_deref() })
        .collect();
    let groups = places(&groups, &names)?;
    let groups: Vec<DamageGroup<'_>> =
        groups.iter().map(|(name, channels)| DamageGroup { name, channels: *channels }).collect();
    // Both reports name predicted and target as the fields do.
    let refuse = |error: EngineError| errors::engine(&error, &names, "");
    let answer = DamageAnswer {
        damage: damage_report(&channels, &groups, &damage).map_err(refuse)?,
        counts: counts_report(&channels, &classes, damage.residue).map_err(refuse)?,
    };
    serde_json::to_vec(&answer).map_err(Problem::internal)
}

fn signal(signals: Signals, names: &[String], at: &str) -> Answer<Signal> {
    let samples = signals.channels.0.into_iter().map(|(_, samples)| samples).collect();
    Signal::new(signals.sample_rate_hz, samples).map_err(|error| match error {
        EngineError::Setting { limit, .. } => {
            Problem::new(codes::BODY_INVALID_VALUE, format!("{at}/sample_rate_hz must be {limit}."))
                .with(FieldError::new(format!("{at}/sample_rate_hz"), limit))
        }
        error => errors::engine(&error, names, &format!("{at}/channels")),
    })
}

/// The target's channels, each of which must have been predicted, at the same rate.
fn targets(target: Signals, predicted: &[String], rate_hz: f64) -> Answer<Channels> {
    let names = target.channels.names();
    if let Some(name) = names.iter().find(|name| !predicted.contains(name)) {
        return Err(unknown(name, "/target/channels"));
    }
    if !Signal::same_rate(target.sample_rate_hz, rate_hz) {
        let limit = format!("{} Hz", rounded(rate_hz, 10));
        let detail =
            format!("The target has {} Hz, the prediction {limit}.", rounded(target.sample_rate_hz, 10));
        return Err(Problem::new(codes::DAMAGE_SAMPLE_RATE, detail)
            .with(FieldError::new("/target/sample_rate_hz", limit)));
    }
    let samples = signal(target, &names, "/target")?.into_channels();
    Ok(Channels(names.into_iter().zip(samples).collect()))
}

/// Groups by the indices of their channels.
fn places(groups: &Groups, names: &[String]) -> Answer<Vec<(String, [usize; 3])>> {
    let mut places = Vec::with_capacity(groups.len());
    for (group, channels) in groups {
        let mut found = [0; 3];
        for (axis, name) in channels.iter().enumerate() {
            let at = format!("/groups/{}/{axis}", group.replace('~', "~0").replace('/', "~1"));
            found[axis] = names.iter().position(|n| n == name).ok_or_else(|| unknown(name, &at))?;
        }
        places.push((group.clone(), found));
    }
    Ok(places)
}

fn unknown(name: &str, at: &str) -> Problem {
    let limit = "a channel of the predicted signals";
    Problem::new(codes::DAMAGE_UNKNOWN_CHANNEL, format!("{at}: {name:?} is not {limit}."))
        .with(FieldError::new(at, limit).on_channel(name))
}
