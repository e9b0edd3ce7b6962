//! The networks of a fit, and which of them is given away or taken back.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use uuid::Uuid;

/// What is left of the trainings must take this long for help to pay: a network that changes hands stands still for a
/// second or two.
const WORTH: Duration = Duration::from_secs(5);

/// How long a helper may take before its speed counts.
const PATIENCE: Duration = Duration::from_secs(30);

/// Time after which the speed of the trainings is known.
const KNOWN: Duration = Duration::from_secs(1);

/// Who trains a network.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Place {
    /// This process, if it has begun.
    Here { begun: bool },
    /// Another one since then, and the share that is done there.
    With { who: Option<Uuid>, since: Instant, done: f64 },
}

/// One network.
#[derive(Debug, Clone)]
pub(super) struct Part {
    pub place: Place,
    /// Share that is done.
    pub done: f64,
    /// Share that was done when this process began.
    pub done_before: Option<f64>,
    /// What has come back, or has been given.
    pub kept: Option<Vec<u8>>,
    /// How often it was given away.
    pub gift: u32,
}

impl Part {
    pub(super) fn new() -> Self {
        Self { place: Place::Here { begun: false }, done: 0.0, done_before: None, kept: None, gift: 0 }
    }

    pub(super) fn is_open_here(&self) -> bool {
        matches!(self.place, Place::Here { .. }) && self.done < 1.0
    }
}

/// One that a helper trains.
#[derive(Debug)]
pub(super) struct Away<'a> {
    pub name: &'a String,
    pub part: &'a Part,
    pub who: Uuid,
    pub since: Instant,
}

/// One that changes hands, and whether it has ended where it was.
#[derive(Debug)]
pub(super) struct Taken {
    pub name: String,
    pub gift: u32,
    pub ended: bool,
}

/// The parts of a fit, and when they began.
#[derive(Debug, Default)]
pub(super) struct Parts {
    pub of: BTreeMap<String, Part>,
    /// When the trainings began; for a helper, since when it is ready.
    pub began: Option<Instant>,
}

impl Parts {
    /// The network that is to be given away, if it pays: the one with the least done while another stays.
    pub(super) fn giveable(&self) -> Option<String> {
        let open: Vec<(&String, &Part)> = self.of.iter().filter(|(_, part)| part.is_open_here()).collect();
        if open.len() < 2 {
            return None;
        }
        let took = self.began?.elapsed();
        let done: f64 = open.iter().map(|(_, part)| part.done - part.done_before.unwrap_or(part.done)).sum();
        if took < KNOWN || done <= 0.0 {
            return None;
        }
        let left: f64 = open.iter().map(|(_, part)| 1.0 - part.done).sum();
        if took.mul_f64((left / done).min(1e6)) < WORTH {
            return None;
        }
        let least = open.into_iter().rev().min_by(|one, other| one.1.done.total_cmp(&other.1.done));
        least.map(|(name, _)| name.clone())
    }

    /// Those that helpers train.
    pub(super) fn away(&self) -> impl Iterator<Item = Away<'_>> {
        self.of.iter().filter_map(|(name, part)| match part.place {
            Place::With { who: Some(who), since, .. } => Some(Away { name, part, who, since }),
            _ => None,
        })
    }

    /// Whether a helper has its network for so long, and does so little of it, that this process has it sooner: once it has
    /// nothing else to do.
    pub(super) fn is_slow(&self, part: &Part) -> bool {
        let (Place::With { since, done, .. }, Some(began)) = (part.place, self.began) else { return false };
        let (took, gained) = (since.elapsed(), done - part.done);
        let idle = !self.of.values().any(Part::is_open_here);
        idle && took > PATIENCE && took.as_secs_f64() * (1.0 - done) > gained * began.elapsed().as_secs_f64()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ago(seconds: u64) -> Instant {
        Instant::now().checked_sub(Duration::from_secs(seconds)).expect("the machine has run for longer")
    }

    /// Networks that have begun so many seconds ago, with the shares that are done.
    fn parts(seconds: u64, done: &[f64]) -> Parts {
        let part = |(k, &done): (usize, &f64)| {
            let place = Place::Here { begun: done > 0.0 };
            (format!("seed {k}"), Part { place, done, done_before: Some(0.0), ..Part::new() })
        };
        Parts { of: done.iter().enumerate().map(part).collect(), began: Some(ago(seconds)) }
    }

    #[test]
    fn the_network_with_the_least_done_is_given_while_another_stays_and_it_pays() {
        let given = Parts::giveable;
        assert_eq!(given(&parts(10, &[0.2, 0.1, 0.3])).as_deref(), Some("seed 1"));
        assert_eq!(
            given(&parts(10, &[0.2, 0.0, 0.0])).as_deref(),
            Some("seed 2"),
            "the last that has not begun"
        );
        assert_eq!(given(&parts(10, &[0.9, 0.95])), None, "the rest takes two seconds");
        assert_eq!(given(&parts(10, &[0.2, 1.0])), None, "only one is left");
        assert_eq!(given(&parts(0, &[0.2, 0.1])), None, "nobody knows how long it takes");
        assert_eq!(given(&parts(10, &[0.0, 0.0])), None, "nothing has been done yet");
        let mut away = parts(10, &[0.2, 0.1]);
        away.of.get_mut("seed 1").unwrap().place = with(5, 0.1);
        assert_eq!(given(&away), None, "the other one is away");
    }

    fn with(seconds: u64, done: f64) -> Place {
        Place::With { who: Some(Uuid::nil()), since: ago(seconds), done }
    }

    #[test]
    fn a_slow_helper_loses_its_network_once_nothing_else_is_to_be_done() {
        let slow = |done_here: f64, since: u64, done: f64| {
            let mut parts = parts(100, &[done_here, 0.2]);
            parts.of.get_mut("seed 1").unwrap().place = with(since, done);
            parts.is_slow(&parts.of["seed 1"])
        };
        assert!(slow(1.0, 60, 0.2), "it stands still");
        assert!(!slow(0.9, 60, 0.2), "there is something else to do");
        assert!(!slow(1.0, 20, 0.2), "it has only begun");
        // 0.2 in 60 s: 180 s more, where all the rest took 100 s.
        assert!(slow(1.0, 60, 0.4));
        assert!(!slow(1.0, 60, 0.6));
    }
}
