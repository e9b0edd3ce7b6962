//! Ids: the rig's slug, which the client chooses, and UUIDs, which the service makes.

use std::fmt;
use std::str::FromStr;
use std::sync::Mutex;

use serde::{Deserialize, Serialize};
use uuid::timestamp::context::ContextV7;

/// Id of a run (UUID v7).
pub type RunId = uuid::Uuid;

/// Id of a job (UUID v7).
pub type JobId = uuid::Uuid;

/// Id of a diagnosis (UUID v7).
pub type DiagnosisId = uuid::Uuid;

/// Id of an evaluation (UUID v7).
pub type EvaluationId = uuid::Uuid;

/// Id of a study: that of its job.
pub type StudyId = JobId;

/// Id of a drive-file iteration (UUID v7).
pub type IterationId = uuid::Uuid;

/// A rig's id: `^[a-z0-9][a-z0-9_-]{0,62}$`. The only id that a client chooses.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct RigId(String);

/// The form of a rig id.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("a rig id is 1 to 63 of a-z, 0-9, _ and -, and starts with a letter or digit")]
pub struct RigIdError;

impl RigId {
    /// The id as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl FromStr for RigId {
    type Err = RigIdError;

    fn from_str(text: &str) -> Result<Self, RigIdError> {
        let alphanumeric = |b: u8| b.is_ascii_lowercase() || b.is_ascii_digit();
        let fits = text.len() <= 63
            && text.bytes().next().is_some_and(alphanumeric)
            && text.bytes().all(|b| alphanumeric(b) || b == b'_' || b == b'-');
        if fits { Ok(Self(text.to_owned())) } else { Err(RigIdError) }
    }
}

impl TryFrom<String> for RigId {
    type Error = RigIdError;

    fn try_from(text: String) -> Result<Self, RigIdError> {
        text.parse()
    }
}

impl From<RigId> for String {
    fn from(id: RigId) -> Self {
        id.0
    }
}

impl fmt::Display for RigId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// Keeps the ids of one process in order within a millisecond and when the clock steps back, since lists
/// and queues are read in the order of their ids.
static ORDER: Mutex<ContextV7> = Mutex::new(ContextV7::new());

/// A new UUID v7 at `now`; later calls give greater ids.
pub fn new_id(now: jiff::Timestamp) -> uuid::Uuid {
    // UUIDs count from 1970 without a sign, so that an earlier clock is set to 1970.
    let seconds = u64::try_from(now.as_second()).unwrap_or(0);
    let nanoseconds = u32::try_from(now.subsec_nanosecond()).unwrap_or(0);
    uuid::Uuid::new_v7(uuid::Timestamp::from_unix(&ORDER, seconds, nanoseconds))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rig_id_is_a_slug() {
        for good in ["a", "0", "hydromount-3x", "a_b", &"x".repeat(63)] {
            assert_eq!(good.parse::<RigId>().unwrap().as_str(), good);
        }
        for bad in ["", "-a", "_a", "A", "a b", "a/b", "ä", "a.", "../x", &"x".repeat(64)] {
            assert_eq!(bad.parse::<RigId>(), Err(RigIdError), "{bad}");
        }
    }

    #[test]
    fn ids_rise_even_when_the_clock_steps_back() {
        let now: jiff::Timestamp = "2026-03-01T12:00:00Z".parse().unwrap();
        let earlier: jiff::Timestamp = "2026-03-01T11:00:00Z".parse().unwrap();
        let ids: Vec<_> = (0..1000).map(|i| new_id(if i % 2 == 0 { now } else { earlier })).collect();
        assert!(ids.windows(2).all(|pair| pair[0] < pair[1]));
        assert_eq!(ids[0].get_version_num(), 7);
    }
}
