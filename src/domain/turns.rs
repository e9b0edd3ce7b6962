//! Turns: which of the waiting jobs a free worker does next.
//!
//! Workers' time goes round between tokens, and within a token between rigs. A token with one job therefore
//! waits for the jobs at work and for no other, however many jobs of another token wait, unless its own
//! jobs have used more time of late.

use std::collections::HashMap;

use jiff::Timestamp;

use super::job::JobKind;
use super::{JobId, RigId};

/// Time after which only half of a worker's time still counts. A few of the longer jobs: a shorter memory
/// would forget a long job before many short ones of another token have made up for it.
const HALF_LIFE_S: f64 = 3600.0;

/// After this time work in the background counts as work that somebody asked for, so that requests without
/// end do not hold it up for ever.
const PATIENCE_S: f64 = 1800.0;

/// How soon a job is needed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Urgency {
    /// An engineer waits for it, and it takes minutes.
    Awaited = 0,
    /// A client asked for it.
    Requested = 1,
    /// Nobody waits for it.
    Background = 2,
}

impl Urgency {
    /// All urgencies, the most urgent first.
    pub const ALL: [Self; 3] = [Self::Awaited, Self::Requested, Self::Background];

    /// Of a job that a client asked for.
    pub fn of_request(kind: JobKind) -> Self {
        match kind {
            JobKind::Diagnosis | JobKind::Evaluation => Self::Awaited,
            JobKind::Fit | JobKind::Iteration => Self::Requested,
            JobKind::Study => Self::Background,
        }
    }
}

/// The waiting jobs of one token, rig and urgency.
#[derive(Debug, Clone, PartialEq)]
pub struct WaitingJobs {
    /// The token that asked for them; empty without tokens.
    pub owner: String,
    /// Their rig.
    pub rig: RigId,
    /// How soon they are needed.
    pub urgency: Urgency,
    /// Whether they were interrupted with the service, and resume.
    pub go_on: bool,
    /// The oldest of them.
    pub oldest: JobId,
    /// When it was queued.
    pub since: Timestamp,
}

/// The time of workers that a token's jobs for a rig have used of late.
#[derive(Debug, Clone, PartialEq)]
pub struct WorkerTime {
    /// The token; empty without tokens.
    pub owner: String,
    /// The rig.
    pub rig: RigId,
    /// Seconds at the time `at`; they count for less since.
    pub used_s: f64,
    /// Time of the last change.
    pub at: Timestamp,
}

impl WorkerTime {
    /// Seconds that still count.
    pub fn left_at(&self, now: Timestamp) -> f64 {
        self.used_s * 0.5_f64.powf(seconds_between(self.at, now) / HALF_LIFE_S)
    }
}

/// Seconds from `earlier` to `later`; none if the clock went back in between.
pub fn seconds_between(earlier: Timestamp, later: Timestamp) -> f64 {
    later.duration_since(earlier).as_secs_f64().max(0.0)
}

/// The jobs of which the oldest is done next.
///
/// Jobs that the end of the service interrupted go on first, because their turn is not over. Then comes
/// work that somebody asked for, then work in the background. Of these the token has its turn whose jobs
/// have used the least time, and of its rigs the one whose jobs have. There the more urgent job is done
/// first, then the older one.
pub fn next<'a>(waiting: &'a [WaitingJobs], times: &[WorkerTime], now: Timestamp) -> Option<&'a WaitingJobs> {
    let mut of_token: HashMap<&str, f64> = HashMap::new();
    let mut of_rig: HashMap<(&str, &RigId), f64> = HashMap::new();
    for time in times {
        let used_s = time.left_at(now);
        *of_token.entry(&time.owner).or_default() += used_s;
        *of_rig.entry((&time.owner, &time.rig)).or_default() += used_s;
    }
    // Whole seconds: a token that has used next to nothing is equal to one that has used nothing, and age
    // decides.
    let whole = |used_s: Option<&f64>| used_s.map_or(0, |used_s| used_s.round() as u64);
    waiting.iter().min_by_key(|jobs| {
        let may_wait = jobs.urgency == Urgency::Background && seconds_between(jobs.since, now) < PATIENCE_S;
        let urgency = if may_wait { jobs.urgency } else { jobs.urgency.min(Urgency::Requested) };
        let of_token = whole(of_token.get(&*jobs.owner));
        let of_rig = whole(of_rig.get(&(&*jobs.owner, &jobs.rig)));
        (!jobs.go_on, may_wait, of_token, of_rig, urgency, jobs.oldest)
    })
}

#[cfg(test)]
mod tests {
    use jiff::ToSpan;

    use super::*;

    fn now() -> Timestamp {
        "2026-03-01T12:00:00Z".parse().unwrap()
    }

    /// Job number `n` waits for a minute.
    fn waiting(n: u128, owner: &str, rig: &str, urgency: Urgency) -> WaitingJobs {
        WaitingJobs {
            owner: owner.into(),
            rig: rig.parse().unwrap(),
            urgency,
            go_on: false,
            oldest: JobId::from_u128(n),
            since: now() - 1.minute(),
        }
    }

    fn used(owner: &str, rig: &str, used_s: f64) -> WorkerTime {
        WorkerTime { owner: owner.into(), rig: rig.parse().unwrap(), used_s, at: now() }
    }

    #[track_caller]
    fn check(waiting: &[WaitingJobs], times: &[WorkerTime], expected: u128) {
        let found = next(waiting, times, now()).map(|jobs| jobs.oldest);
        assert_eq!(found, Some(JobId::from_u128(expected)));
    }

    #[test]
    fn the_token_that_has_used_least_goes_next_then_its_rig_then_the_oldest() {
        use Urgency::Requested;
        let all = [
            waiting(1, "a", "x", Requested),
            waiting(2, "b", "x", Requested),
            waiting(3, "b", "y", Requested),
        ];
        check(&all, &[], 1);
        check(&all, &[used("a", "x", 5.0)], 2);
        check(&all, &[used("a", "x", 5.0), used("b", "x", 2.0)], 3);
        // A token's rigs count together.
        check(&all, &[used("a", "x", 5.0), used("b", "x", 3.0), used("b", "z", 3.0)], 1);
        check(&all, &[used("a", "x", 0.3)], 1);
        assert_eq!(next(&[], &[], now()), None);
    }

    #[test]
    fn worker_time_counts_for_less_and_less_and_a_clock_that_goes_back_changes_nothing() {
        let time = used("a", "x", 100.0);
        assert_eq!(time.left_at(now()), 100.0);
        assert!((time.left_at(now() + 1.hour()) - 50.0).abs() < 1e-9);
        assert!((time.left_at(now() + 3.hours()) - 12.5).abs() < 1e-9);
        assert_eq!(time.left_at(now() - 1.hour()), 100.0);
        let all = [waiting(1, "a", "x", Urgency::Requested), waiting(2, "b", "x", Urgency::Requested)];
        let older = WorkerTime { at: now() - 4.hours(), ..used("a", "x", 100.0) };
        check(&all, &[older, used("b", "x", 10.0)], 1);
    }

    #[test]
    fn background_work_waits_for_requests_of_any_token_but_not_for_ever() {
        use Urgency::{Awaited, Background, Requested};
        let times = [used("b", "x", 100.0)];
        let mut all = [waiting(1, "a", "x", Background), waiting(2, "b", "x", Requested)];
        check(&all, &times, 2);
        all[1].urgency = Awaited;
        check(&all, &times, 2);
        all[0].since = now() - 31.minutes();
        check(&all, &times, 1);
        // Within a token and rig a diagnosis comes before fits and before work that has waited for long.
        let all = [waiting(2, "a", "x", Requested), all[0].clone(), waiting(3, "a", "x", Awaited)];
        check(&all, &times, 3);
        check(&all[..2], &times, 1);
    }

    #[test]
    fn no_number_of_diagnoses_keeps_another_token_or_rig_waiting() {
        use Urgency::{Awaited, Requested};
        let times = [used("a", "x", 60.0)];
        check(&[waiting(1, "a", "x", Awaited), waiting(2, "b", "x", Requested)], &times, 2);
        check(&[waiting(1, "a", "x", Awaited), waiting(2, "a", "y", Requested)], &times, 2);
    }

    #[test]
    fn a_job_that_was_interrupted_goes_on_before_all_others() {
        use Urgency::{Awaited, Background};
        let interrupted = WaitingJobs { go_on: true, ..waiting(9, "a", "x", Background) };
        check(&[waiting(1, "b", "y", Awaited), interrupted], &[used("a", "x", 1e6)], 9);
    }

    #[test]
    fn the_urgency_follows_from_the_kind() {
        let of = |kind| Urgency::of_request(kind);
        assert_eq!(of(JobKind::Diagnosis), Urgency::Awaited);
        assert_eq!(of(JobKind::Evaluation), Urgency::Awaited);
        assert_eq!(of(JobKind::Fit), Urgency::Requested);
        assert_eq!(of(JobKind::Study), Urgency::Background);
    }
}
