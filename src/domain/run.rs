//! Runs: recorded measurements of a rig.

use jiff::Timestamp;
use serde::{Deserialize, Deserializer, Serialize};

use super::ids::{JobId, RigId, RunId};
use super::problem::FieldError;
use super::quality::Quality;
use super::rig::MAX_NAME_CHARS;

/// Most tags of a run.
pub const MAX_TAGS: usize = 32;

/// What was driven.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RunKind {
    /// Random excitation that identifies the rig.
    Noise,
    /// Service loads.
    Service,
    /// Sine at fixed frequency.
    Sine,
    /// Sine of sweeping frequency.
    Sweep,
    /// Anything else.
    Other,
}

impl RunKind {
    /// All kinds.
    pub const ALL: [Self; 5] = [Self::Noise, Self::Service, Self::Sine, Self::Sweep, Self::Other];

    /// The word of the contract.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Noise => "noise",
            Self::Service => "service",
            Self::Sine => "sine",
            Self::Sweep => "sweep",
            Self::Other => "other",
        }
    }
}

/// What a run may be used for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Split {
    /// Sets weights.
    #[default]
    Training,
    /// Chooses among models and settings.
    Validation,
    /// Never enters a fit.
    Test,
}

impl Split {
    /// All splits.
    pub const ALL: [Self; 3] = [Self::Training, Self::Validation, Self::Test];

    /// The word of the contract.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Training => "training",
            Self::Validation => "validation",
            Self::Test => "test",
        }
    }
}

/// What a client says about a run beside its samples.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RunMeta {
    /// Name for people, may be empty.
    pub name: String,
    /// What was driven.
    pub kind: RunKind,
    /// What it may be used for.
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
        if self.name.chars().count() > MAX_NAME_CHARS {
            errors.push(FieldError::new("/name", format!("at most {MAX_NAME_CHARS} characters")));
        }
        if self.tags.len() > MAX_TAGS {
            errors.push(FieldError::new("/tags", format!("at most {MAX_TAGS} tags")));
        }
        for (i, tag) in self.tags.iter().enumerate() {
            let chars = tag.chars().count();
            if chars == 0 || chars > MAX_NAME_CHARS {
                let limit = format!("1 to {MAX_NAME_CHARS} characters");
                errors.push(FieldError::new(format!("/tags/{i}"), limit));
            }
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
    /// What was driven.
    pub kind: RunKind,
    /// What it may be used for.
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
    /// What the samples look like.
    pub quality: Quality,
    /// The run of this rig that came earlier with the same bytes.
    pub duplicate_of: Option<RunId>,
    /// SHA-256 of the object that holds the samples, hex.
    #[serde(skip)]
    pub object: String,
}

/// Answer to an accepted upload: the run, and the jobs that it set off.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct InsertedRun {
    /// The run.
    #[serde(flatten)]
    pub run: Run,
    /// Jobs of the fit policy that it queued or joined.
    pub jobs: Vec<JobId>,
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

/// Tells what is there from what is absent: `null` is an inner `None`, or refused where there is none.
fn present<'de, T, D>(deserializer: D) -> Result<Option<T>, D::Error>
where
    T: Deserialize<'de>,
    D: Deserializer<'de>,
{
    T::deserialize(deserializer).map(Some)
}

impl RunPatch {
    /// What the run says after the patch, checked.
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
