//! Runs: recorded measurements of a rig.

use jiff::Timestamp;
use serde::{Deserialize, Deserializer, Serialize};

use super::fits::FitRequest;
use super::ids::{JobId, RigId, RunId};
use super::problem::FieldError;
use super::quality::Quality;
use super::text::check_text;
use crate::engine::{RunKind, Split};

/// Most tags of a run.
pub const MAX_TAGS: usize = 32;

/// A client's description of a run, without its samples.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RunMeta {
    /// Name for people, may be empty.
    pub name: String,
    /// Kind of excitation.
    pub kind: RunKind,
    /// Its use.
    pub split: Split,
    /// Tags, without repeats.
    pub tags: Vec<String>,
    /// When the measurement began.
    pub started_at: Option<Timestamp>,
}

impl RunMeta {
    /// Checks lengths and drops repeated tags.
    ///
    /// # Errors
    /// Every field that leaves its limit, by its name in the query (`/name`, `/tag/0`).
    pub fn check(mut self) -> Result<Self, Vec<FieldError>> {
        let mut errors = Vec::new();
        check_text(&mut errors, "/name", &self.name, 0);
        if self.tags.len() > MAX_TAGS {
            errors.push(FieldError::new("/tags", format!("at most {MAX_TAGS} tags")));
        }
        for (i, tag) in self.tags.iter().enumerate() {
            check_text(&mut errors, format!("/tags/{i}"), tag, 1);
        }
        if !errors.is_empty() {
            return Err(errors);
        }
        let mut seen = std::collections::HashSet::new();
        self.tags.retain(|tag| seen.insert(tag.clone()));
        Ok(self)
    }
}

/// A run as the contract shows it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Run {
    /// Id.
    pub id: RunId,
    /// Its rig.
    pub rig: RigId,
    /// Name for people, may be empty.
    pub name: String,
    /// Kind of excitation.
    pub kind: RunKind,
    /// Its use.
    pub split: Split,
    /// Tags.
    pub tags: Vec<String>,
    /// When the measurement began.
    pub started_at: Option<Timestamp>,
    /// When it was accepted.
    pub created_at: Timestamp,
    /// Channels that it holds, in the order of its samples.
    pub channels: Vec<String>,
    /// Unit of each channel.
    pub units: Vec<String>,
    /// Samples per channel.
    pub samples: u64,
    /// Length.
    pub duration_s: f64,
    /// Sample rate.
    pub sample_rate_hz: f64,
    /// SHA-256 of the file that was uploaded, hex.
    pub sha256: String,
    /// Quality figures of the samples.
    pub quality: Quality,
    /// An earlier run of this rig with the same bytes.
    pub duplicate_of: Option<RunId>,
    /// SHA-256 of the object that holds the samples, hex.
    #[serde(skip)]
    pub object: String,
}

/// Answer to an accepted upload: the run, and the jobs that it started.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct InsertedRun {
    /// The run.
    #[serde(flatten)]
    pub run: Run,
    /// Jobs of the fit policy that it queued or joined.
    pub jobs: Vec<JobId>,
    /// Outcome of the rig's fit policy in words: the reason for no jobs, or the number of fits.
    pub policy: String,
}

/// What an upload of a file would do, beside storing its run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RunOutlook {
    /// The earliest run of the rig with the same bytes.
    pub duplicate_of: Option<RunId>,
    /// Fits that the rig's policy would queue.
    pub fits: Vec<FitRequest>,
    /// Queued jobs of the fit policy that the run would join.
    pub jobs: Vec<JobId>,
    /// Outcome of the rig's fit policy in words: the reason for no fits, or their number.
    pub policy: String,
}

/// A merge patch of a run: what is absent stays, `null` clears.
#[derive(Debug, Clone, PartialEq, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RunPatch {
    /// Name.
    #[serde(deserialize_with = "present")]
    pub name: Option<Option<String>>,
    /// Kind; cannot be cleared.
    #[serde(deserialize_with = "present")]
    pub kind: Option<RunKind>,
    /// Split; cannot be cleared.
    #[serde(deserialize_with = "present")]
    pub split: Option<Split>,
    /// All tags.
    #[serde(deserialize_with = "present")]
    pub tags: Option<Option<Vec<String>>>,
    /// When the measurement began.
    #[serde(deserialize_with = "present")]
    pub started_at: Option<Option<Timestamp>>,
}

/// Distinguishes `null` from an absent field: `null` is an inner `None`, or refused where there is none.
fn present<'de, T, D>(deserializer: D) -> Result<Option<T>, D::Error>
where
    T: Deserialize<'de>,
    D: Deserializer<'de>,
{
    T::deserialize(deserializer).map(Some)
}

impl RunPatch {
    /// The description of the run after the patch, checked.
    ///
    /// # Errors
    /// As [`RunMeta::check`].
    pub fn apply(self, run: &Run) -> Result<RunMeta, Vec<FieldError>> {
        RunMeta {
            name: self.name.map_or_else(|| run.name.clone(), Option::unwrap_or_default),
            kind: self.kind.unwrap_or(run.kind),
            split: self.split.unwrap_or(run.split),
            tags: self.tags.map_or_else(|| run.tags.clone(), Option::unwrap_or_default),
            started_at: self.started_at.unwrap_or(run.started_at),
        }
        .check()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_patch_tells_null_from_absent() {
        let patch: RunPatch = serde_json::from_str(r#"{"name": null, "tags": ["a"]}"#).unwrap();
        assert_eq!(patch.name, Some(None));
        assert_eq!(patch.tags, Some(Some(vec!["a".to_owned()])));
        assert_eq!(patch.started_at, None);
        assert!(serde_json::from_str::<RunPatch>(r#"{"samples": 3}"#).is_err());
    }

    #[test]
    fn tags_are_checked_and_repeats_dropped() {
        let meta = |tags: Vec<String>| RunMeta {
            name: String::new(),
            kind: RunKind::Noise,
            split: Split::Training,
            tags,
            started_at: None,
        };
        let kept = meta(vec!["a".into(), "b".into(), "a".into()]).check().unwrap();
        assert_eq!(kept.tags, ["a", "b"]);
        assert_eq!(meta(vec!["a".into(), String::new()]).check().unwrap_err()[0].pointer, "/tags/1");
        assert!(meta((0..33).map(|i| i.to_string()).collect()).check().is_err());
    }
}
