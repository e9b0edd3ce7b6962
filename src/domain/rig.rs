//! Rigs: a sample rate, named channels, and the fits that arriving runs start.

use std::collections::{BTreeMap, HashSet};

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::fits::FitRequest;
use super::ids::RigId;
use super::problem::FieldError;
use super::strict::Strict;
use super::text::check_text;
use crate::engine::Quantity;
use crate::engine::RunKind;
use crate::engine::wording::plain;

/// Most channels of a rig.
pub const MAX_CHANNELS: usize = 128;

/// Most aliases of a channel.
const MAX_ALIASES: usize = 32;

/// Lowest sample rate. At much lower rates the length of a short run overflows.
pub const MIN_SAMPLE_RATE_HZ: f64 = 1e-6;

/// Highest sample rate.
pub const MAX_SAMPLE_RATE_HZ: f64 = 1e6;

/// Most fits of a fit policy.
pub const MAX_POLICY_FITS: usize = 16;

/// The role of a channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// Commanded signal.
    Drive,
    /// Measured signal.
    Response,
}

/// One channel of a rig.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Channel {
    /// Name, unique within the rig.
    pub name: String,
    /// Unit of its values, as people write it (`kN`).
    pub unit: String,
    /// Drive or response.
    pub role: Role,
    /// Physical quantity.
    #[serde(default)]
    pub quantity: Quantity,
    /// Axis, any label.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub axis: Option<String>,
    /// Three channels of one group are, in order, x, y and z for Multi-Rain.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub group: Option<String>,
    /// Names that measurement files have for it; none is a name or an alias of another channel.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub aliases: Vec<String>,
}

/// Whether two lists of channels are the same but for their aliases, which only the reading of files uses.
pub fn same_but_for_aliases(a: &[Channel], b: &[Channel]) -> bool {
    let bare = |channel: &Channel| Channel { aliases: Vec::new(), ..channel.clone() };
    a.len() == b.len() && a.iter().zip(b).all(|(a, b)| bare(a) == bare(b))
}

/// The fits that are queued when runs arrive.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FitPolicy {
    /// Kinds of training run that count.
    #[serde(default = "noise_only")]
    pub kinds: Vec<RunKind>,
    /// Seconds of such runs before anything is fitted.
    #[serde(default)]
    pub min_total_s: f64,
    /// The fits, in the order in which they are queued.
    pub fits: Vec<FitRequest>,
}

fn noise_only() -> Vec<RunKind> {
    vec![RunKind::Noise]
}

/// A rig as a client describes it: the body of `POST /v1/rigs`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RigDraft {
    /// Id.
    pub id: RigId,
    /// Name for people; left out: the id.
    #[serde(default, deserialize_with = "not_blank")]
    pub name: String,
    /// Samples per second of its runs.
    pub sample_rate_hz: f64,
    /// Channels, in order.
    pub channels: Vec<Channel>,
    /// The fits that arriving runs start.
    #[serde(default)]
    pub fit_policy: Option<FitPolicy>,
}

/// A name that is given is one. Left out, it is the id.
fn not_blank<'de, D: serde::Deserializer<'de>>(deserializer: D) -> Result<String, D::Error> {
    let name = String::deserialize(deserializer)?;
    if name.trim().is_empty() {
        return Err(serde::de::Error::custom("a name that is not blank, or none at all"));
    }
    Ok(name)
}

/// A rig as the contract shows it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Rig {
    /// Id.
    pub id: RigId,
    /// Name for people.
    pub name: String,
    /// Samples per second of its runs.
    pub sample_rate_hz: f64,
    /// Channels, in order.
    pub channels: Vec<Channel>,
    /// The fits that arriving runs start.
    pub fit_policy: Option<FitPolicy>,
    /// When it was created.
    pub created_at: Timestamp,
    /// When it was last changed.
    pub updated_at: Timestamp,
    /// Rises with every change.
    #[serde(skip)]
    pub revision: u64,
}

impl Rig {
    /// The `ETag` that a change must name.
    pub fn etag(&self) -> String {
        format!("\"r{}\"", self.revision)
    }

    /// Names of the drives, in order.
    pub fn drives(&self) -> impl Iterator<Item = &str> {
        names(&self.channels, Role::Drive)
    }

    /// Names of the responses, in order.
    pub fn responses(&self) -> impl Iterator<Item = &str> {
        names(&self.channels, Role::Response)
    }

    /// The channel of this name.
    pub fn channel(&self, name: &str) -> Option<&Channel> {
        self.channels.iter().find(|channel| channel.name == name)
    }

    /// Names of its groups of channels, with the names of their members, both in the rig's order.
    pub fn groups(&self) -> Vec<(&str, Vec<&str>)> {
        let mut groups: Vec<(&str, Vec<&str>)> = Vec::new();
        for channel in &self.channels {
            let Some(group) = channel.group.as_deref() else { continue };
            match groups.iter_mut().find(|(name, _)| *name == group) {
                Some((_, members)) => members.push(&channel.name),
                None => groups.push((group, vec![&channel.name])),
            }
        }
        groups
    }

    /// The draft from which the same rig would be created.
    pub fn draft(&self) -> RigDraft {
        RigDraft {
            id: self.id.clone(),
            name: self.name.clone(),
            sample_rate_hz: self.sample_rate_hz,
            channels: self.channels.clone(),
            fit_policy: self.fit_policy.clone(),
        }
    }

    /// The rig after a merge patch (RFC 7396), checked. The id cannot be patched.
    ///
    /// # Errors
    /// Fields that are unknown, of the wrong type, or outside their limits.
    pub fn patched(&self, patch: &Value) -> Result<RigDraft, Vec<FieldError>> {
        let mut whole = serde_json::to_value(self.draft())
            .map_err(|error| vec![FieldError::new("", error.to_string())])?;
        merge(&mut whole, patch);
        let mut track = serde_path_to_error::Track::new();
        let tracked = serde_path_to_error::Deserializer::new(whole, &mut track);
        let draft = RigDraft::deserialize(Strict(tracked)).map_err(|error| {
            let text = error.to_string();
            vec![FieldError::new(super::problem::pointer(&track.path(), &text), plain(&text))]
        })?;
        if draft.id != self.id {
            return Err(vec![FieldError::new("/id", "a rig keeps its id")]);
        }
        draft.check()?;
        Ok(draft)
    }
}

fn names(channels: &[Channel], role: Role) -> impl Iterator<Item = &str> {
    channels.iter().filter(move |channel| channel.role == role).map(|channel| channel.name.as_str())
}

impl RigDraft {
    /// Checks everything that does not depend on the registry.
    ///
    /// # Errors
    /// Every field that leaves its limit.
    pub fn check(&self) -> Result<(), Vec<FieldError>> {
        let mut errors = Vec::new();
        check_text(&mut errors, "/name", &self.name, 0);
        if !(MIN_SAMPLE_RATE_HZ..=MAX_SAMPLE_RATE_HZ).contains(&self.sample_rate_hz) {
            errors.push(FieldError::new(
                "/sample_rate_hz",
                format!("{MIN_SAMPLE_RATE_HZ} <= sample_rate_hz <= {MAX_SAMPLE_RATE_HZ}"),
            ));
        }
        self.check_channels(&mut errors);
        if let Some(policy) = &self.fit_policy {
            policy.check(self, &mut errors);
        }
        if errors.is_empty() { Ok(()) } else { Err(errors) }
    }

    fn check_channels(&self, errors: &mut Vec<FieldError>) {
        if self.channels.len() > MAX_CHANNELS {
            errors.push(FieldError::new("/channels", format!("at most {MAX_CHANNELS} channels")));
        }
        if !self.channels.iter().any(|channel| channel.role == Role::Drive) {
            errors.push(FieldError::new("/channels", "at least one channel with the role drive"));
        }
        let mut seen: BTreeMap<&str, usize> = BTreeMap::new();
        let mut groups: BTreeMap<&str, usize> = BTreeMap::new();
        let mut aliases = HashSet::new();
        for (i, channel) in self.channels.iter().enumerate() {
            let at = |field: &str| format!("/channels/{i}/{field}");
            check_text(errors, at("name"), &channel.name, 1);
            // Blanks around a name, commas and control characters would not survive a CSV header
            // or `?channels=a,b`.
            if channel.name.trim() != channel.name || channel.name.chars().any(|c| c == ',' || c.is_control())
            {
                let limit = "no comma, no control character, no blank at either end";
                errors.push(FieldError::new(at("name"), limit).on_channel(&channel.name));
            }
            check_text(errors, at("unit"), &channel.unit, 0);
            check_text(errors, at("axis"), channel.axis.as_deref().unwrap_or_default(), 0);
            if let Some(first) = seen.insert(&channel.name, i) {
                let limit = format!("a name of its own: /channels/{first} has this one");
                errors.push(FieldError::new(at("name"), limit).on_channel(&channel.name));
            }
            self.check_aliases(i, &mut aliases, errors);
            if let Some(group) = &channel.group {
                check_text(errors, at("group"), group, 1);
                *groups.entry(group).or_default() += 1;
            }
        }
        for (group, count) in groups.into_iter().filter(|(_, count)| *count != 3) {
            let limit = format!("a group has exactly three channels, {group:?} has {count}");
            errors.push(FieldError::new("/channels", limit));
        }
    }

    /// Checks the aliases of a channel; `seen` are those of the channels before it.
    fn check_aliases<'a>(
        &'a self,
        channel: usize,
        seen: &mut HashSet<&'a str>,
        errors: &mut Vec<FieldError>,
    ) {
        let Channel { name, aliases, .. } = &self.channels[channel];
        if aliases.len() > MAX_ALIASES {
            let at = format!("/channels/{channel}/aliases");
            errors.push(FieldError::new(at, format!("at most {MAX_ALIASES} aliases")).on_channel(name));
            return;
        }
        for (i, alias) in aliases.iter().enumerate() {
            let at = format!("/channels/{channel}/aliases/{i}");
            check_text(errors, at.as_str(), alias, 1);
            let limit = if alias.trim() != alias || alias.chars().any(char::is_control) {
                "no control character, no blank at either end"
            } else if self.channels.iter().any(|other| other.name == *alias) || !seen.insert(alias) {
                "no name and no other alias of a channel of the rig"
            } else {
                continue;
            };
            errors.push(FieldError::new(at, limit).on_channel(name));
        }
    }
}

impl FitPolicy {
    fn check(&self, rig: &RigDraft, errors: &mut Vec<FieldError>) {
        let at = "/fit_policy";
        if self.kinds.is_empty() {
            errors.push(FieldError::new(format!("{at}/kinds"), "at least one kind of run"));
        }
        if !(self.min_total_s.is_finite() && self.min_total_s >= 0.0) {
            errors.push(FieldError::new(format!("{at}/min_total_s"), "0 seconds or more, finite"));
        }
        if self.fits.is_empty() || self.fits.len() > MAX_POLICY_FITS {
            errors.push(FieldError::new(format!("{at}/fits"), format!("1 to {MAX_POLICY_FITS} fits")));
        }
        for (i, fit) in self.fits.iter().take(MAX_POLICY_FITS).enumerate() {
            if let Err(found) = fit.check(&rig.channels, rig.sample_rate_hz) {
                errors.extend(found.into_iter().map(|mut error| {
                    error.pointer = format!("{at}/fits/{i}{}", error.pointer);
                    error
                }));
            }
        }
    }
}

/// RFC 7396: objects merge, `null` removes, everything else replaces.
fn merge(target: &mut Value, patch: &Value) {
    let Value::Object(changes) = patch else {
        *target = patch.clone();
        return;
    };
    if !target.is_object() {
        *target = Value::Object(serde_json::Map::new());
    }
    let Value::Object(fields) = target else { return };
    for (name, change) in changes {
        if change.is_null() {
            fields.remove(name);
        } else {
            merge(fields.entry(name.clone()).or_insert(Value::Null), change);
        }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use serde_json::json;

    use super::*;
    use crate::domain::text::MAX_NAME_CHARS;

    pub(in super::super) fn draft(body: Value) -> RigDraft {
        serde_json::from_value(body).unwrap()
    }

    fn bench() -> Value {
        json!({
            "id": "bench", "name": "Bench", "sample_rate_hz": 1000.0,
            "channels": [
                {"name": "drive_x", "unit": "kN", "role": "drive", "quantity": "force", "axis": "x"},
                {"name": "force_x", "unit": "kN", "role": "response", "group": "force"},
                {"name": "force_y", "unit": "kN", "role": "response", "group": "force"},
                {"name": "force_z", "unit": "kN", "role": "response", "group": "force"}
            ],
            "fit_policy": {"kinds": ["noise"], "min_total_s": 60.0, "fits": [{"kind": "frf"}]}
        })
    }

    pub(in super::super) fn rig(draft: RigDraft) -> Rig {
        Rig {
            id: draft.id,
            name: draft.name,
            sample_rate_hz: draft.sample_rate_hz,
            channels: draft.channels,
            fit_policy: draft.fit_policy,
            created_at: Timestamp::UNIX_EPOCH,
            updated_at: Timestamp::UNIX_EPOCH,
            revision: 7,
        }
    }

    /// Pointers of what is wrong after a merge patch of the good rig.
    fn wrong_after(patch: Value) -> Vec<String> {
        let mut body = bench();
        merge(&mut body, &patch);
        draft(body).check().unwrap_err().into_iter().map(|error| error.pointer).collect()
    }

    #[test]
    fn the_rig_of_the_contract_passes_and_quantity_defaults_to_other() {
        let draft = draft(bench());
        draft.check().unwrap();
        assert_eq!(
            (draft.channels[0].quantity, draft.channels[1].quantity),
            (Quantity::Force, Quantity::Other)
        );
    }

    #[test]
    fn every_field_outside_its_limit_is_named() {
        for rate in [0.0, -1.0, 1e6 + 1.0] {
            assert_eq!(wrong_after(json!({"sample_rate_hz": rate})), ["/sample_rate_hz"]);
        }
        assert_eq!(wrong_after(json!({"name": "x".repeat(MAX_NAME_CHARS + 1)})), ["/name"]);
        let channel = |name: &str, role: &str| json!({"name": name, "unit": "", "role": role});
        let channels = |list: Vec<Value>| wrong_after(json!({"channels": list, "fit_policy": null}));
        assert_eq!(channels(vec![channel("u", "drive"), channel("u", "response")]), ["/channels/1/name"]);
        assert_eq!(channels(vec![channel("y", "response")]), ["/channels"]);
        assert_eq!(
            channels(vec![channel("", "drive"), channel("a,b", "response"), channel(" c", "response")]),
            ["/channels/0/name", "/channels/1/name", "/channels/2/name"]
        );
        let many = (0..129).map(|i| channel(&i.to_string(), if i == 0 { "drive" } else { "response" }));
        assert_eq!(channels(many.collect()), ["/channels"]);
        let mut pair = channel("p", "response");
        pair["group"] = json!("g");
        assert_eq!(channels(vec![channel("u", "drive"), pair]), ["/channels"]);
    }

    #[test]
    fn a_policy_is_checked_against_the_channels() {
        let fits = json!([{"kind": "frf", "inputs": ["nope"]}, {"kind": "lstm", "runs": {"split": "test"}}]);
        assert_eq!(
            wrong_after(json!({"fit_policy": {"kinds": [], "min_total_s": -1.0, "fits": fits}})),
            [
                "/fit_policy/kinds",
                "/fit_policy/min_total_s",
                "/fit_policy/fits/0/inputs/0",
                "/fit_policy/fits/1/runs/split"
            ]
        );
        assert_eq!(wrong_after(json!({"fit_policy": {"fits": []}})), ["/fit_policy/fits"]);
    }

    #[test]
    fn a_merge_patch_follows_rfc_7396() {
        // Cases of its appendix A.
        for (target, patch, result) in [
            (json!({"a": "b"}), json!({"a": "c"}), json!({"a": "c"})),
            (json!({"a": "b", "b": "c"}), json!({"a": null}), json!({"b": "c"})),
            (json!({"a": ["b"]}), json!({"a": "c"}), json!({"a": "c"})),
            (json!({"a": {"b": "c"}}), json!({"a": {"b": "d", "c": null}}), json!({"a": {"b": "d"}})),
            (json!(["a"]), json!({"a": 1}), json!({"a": 1})),
            (json!({}), json!({"a": {"bb": {"ccc": null}}}), json!({"a": {"bb": {}}})),
            (json!({"e": null}), json!({"a": 1}), json!({"e": null, "a": 1})),
        ] {
            let mut patched = target.clone();
            merge(&mut patched, &patch);
            assert_eq!(patched, result, "{target} + {patch}");
        }
    }

    #[test]
    fn a_patched_rig_keeps_its_id_and_names_what_is_unknown() {
        let rig = rig(draft(bench()));
        let patched = rig.patched(&json!({"fit_policy": null, "name": "New"})).unwrap();
        assert_eq!((patched.fit_policy, patched.name.as_str()), (None, "New"));
        assert_eq!(rig.patched(&json!({"id": "other"})).unwrap_err()[0].pointer, "/id");
        let unknown = rig.patched(&json!({"fit_policy": {"fitz": 1}})).unwrap_err();
        assert_eq!(unknown[0].pointer, "/fit_policy/fitz");
        let wrong =
            rig.patched(&json!({"channels": [{"name": "u", "unit": "", "role": "boss"}]})).unwrap_err();
        assert_eq!(wrong[0].pointer, "/channels/0/role");
        assert!(rig.patched(&json!([1])).is_err());
        assert_eq!(wrong[0].limit.as_deref(), Some("expected `drive` or `response`, found `boss`"));
        let one = rig.patched(&json!({"fit_policy": {"kinds": "noise", "fits": {"kind": "lstm"}}})).unwrap();
        let policy = one.fit_policy.unwrap();
        assert_eq!((policy.kinds.as_slice(), policy.fits.len()), (&[RunKind::Noise][..], 1));
    }
}
