//! The networks of a fit, one a seed, trained by every worker that has nothing else to do.
//!
//! Where processes share a registry, the worker of a fit offers networks while it has more than one to train and much to do.
//! A worker without a job reads the same data and says that it is there. The fit's worker stops a training, stores its
//! state and gives it away; the helper goes on from there, stores its states in the same place, and gives back what has
//! ended or has to stop. What they tell each other are checkpoints of the job, each with one writer. Nothing depends on
//! who trains what: a state that is read late or not at all costs time, and the network comes out alike. A helper that is
//! not heard of has gone.

use std::collections::BTreeMap;
use std::convert::Infallible;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};
use tokio::time::MissedTickBehavior;
use uuid::Uuid;

use crate::domain::JobId;
use crate::engine::checkpoint::CheckpointStore;
use crate::storage::{Checkpoint, Store, StoreError};

use super::checkpoints::JobCheckpoints;
use super::control::{Control, Stop};
use super::helping::{FRESH, OFFER, OPENED};
use super::problem::JobError;

/// How often each side looks what the other has said.
const LOOK_EVERY: Duration = Duration::from_secs(1);

/// What is left of the trainings must take this long for help to pay: a network that changes hands stands still for a
/// second or two.
const WORTH: Duration = Duration::from_secs(5);

/// Time after which the speed of the trainings is known.
const KNOWN: Duration = Duration::from_secs(1);

/// What the processes tell each other.
#[derive(Debug, Serialize, Deserialize)]
enum Said {
    /// Networks can be had of the fit's worker.
    Offer,
    /// A helper is there, and has done this share of its network.
    Helper { who: Uuid, done: f64 },
    /// The fit's worker leaves a part to a helper.
    Given { part: String, to: Uuid },
    /// A helper has ended a part, or leaves it and the fit.
    Back { part: String, from: Uuid, leaves: bool },
}

impl Said {
    /// The name of the checkpoint that says it.
    fn place(&self) -> String {
        match self {
            Self::Offer => OFFER.into(),
            Self::Helper { who, .. } => format!("share helper {who}"),
            Self::Given { part, .. } => format!("share given {part}"),
            Self::Back { part, from, .. } => format!("share back {part} {from}"),
        }
    }
}

/// Who trains a network.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Place {
    /// This process, if it has begun.
    Here { begun: bool },
    /// Another one since then, and the share that it has done.
    With { who: Uuid, since: Instant, done: f64 },
}

/// One network.
#[derive(Debug, Clone)]
struct Part {
    place: Place,
    /// Share that is done.
    done: f64,
    /// Share that was done when this process began.
    done_before: Option<f64>,
    /// What has come back, or has been given.
    kept: Option<Vec<u8>>,
}

impl Part {
    fn new() -> Self {
        Self { place: Place::Here { begun: false }, done: 0.0, done_before: None, kept: None }
    }

    fn is_open_here(&self) -> bool {
        matches!(self.place, Place::Here { .. }) && self.done < 1.0
    }
}

/// The parts of a fit, and when they began.
#[derive(Debug, Default)]
struct Parts {
    of: BTreeMap<String, Part>,
    began: Option<Instant>,
}

impl Parts {
    /// The network that is to be given away, if it pays: the one with the least done while another stays.
    fn giveable(&self, worth: Duration) -> Option<String> {
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
        if took.mul_f64((left / done).min(1e6)) < worth {
            return None;
        }
        let least = open.into_iter().rev().min_by(|one, other| one.1.done.total_cmp(&other.1.done));
        least.map(|(name, _)| name.clone())
    }

    /// Those that helpers train.
    fn away(&self) -> impl Iterator<Item = (&String, Uuid, Instant)> {
        self.of.iter().filter_map(|(name, part)| match part.place {
            Place::With { who, since, .. } => Some((name, who, since)),
            Place::Here { .. } => None,
        })
    }
}

/// What this process is to the fit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Role {
    /// The fit's worker, and no other can help.
    Alone,
    /// The fit's worker.
    Worker,
    /// Another one.
    Helper(Uuid),
}

/// The checkpoints of a fit, and who trains which of its networks.
pub(super) struct SeedShares {
    own: JobCheckpoints,
    store: Store,
    control: Arc<Control>,
    job: JobId,
    /// Digest of everything that the fit depends on, this machine's instruction set included.
    fits: String,
    role: Role,
    parts: Mutex<Parts>,
}

impl SeedShares {
    /// Opens the checkpoints of a fit, for its own worker or for one that helps.
    ///
    /// # Errors
    /// The store's failures.
    pub(super) async fn open(
        store: &Store,
        (job, fits): (JobId, String),
        every: Duration,
        control: &Arc<Control>,
        helps: bool,
    ) -> Result<Self, StoreError> {
        let (role, own) = if helps {
            (Role::Helper(Uuid::new_v4()), JobCheckpoints::none(fits.clone(), every, control))
        } else {
            let role = if store.is_shared() { Role::Worker } else { Role::Alone };
            (role, JobCheckpoints::open(store, job, fits.clone(), every, control).await?)
        };
        let (store, control) = (store.clone(), Arc::clone(control));
        Ok(Self { own, store, control, job, fits, role, parts: Mutex::default() })
    }

    /// Waits, as a helper, until the fit's worker offers what this process would compute.
    ///
    /// # Errors
    /// [`JobError::Stopped`]: it does not, as with another instruction set. The store's failures.
    pub(super) async fn wait_for_offer(&self) -> Result<(), JobError> {
        let began = Instant::now();
        while began.elapsed() < OPENED && self.control.stopped().is_none() {
            let said = self.said().await?;
            if said.iter().any(|(said, age)| matches!(said, Said::Offer) && *age < FRESH) {
                return Ok(());
            }
            tokio::time::sleep(LOOK_EVERY).await;
        }
        Err(JobError::Stopped)
    }

    /// Gives networks away and takes them back, as long as it is polled.
    pub(super) async fn tend(&self) -> Infallible {
        if self.role == Role::Alone {
            return std::future::pending().await;
        }
        let mut ticks = tokio::time::interval(LOOK_EVERY);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let (mut offers, mut idle_since) = (false, Instant::now());
        loop {
            ticks.tick().await;
            let looked = match self.said().await {
                Ok(said) => match self.role {
                    Role::Helper(own) => self.look_for_gifts(own, &said, &mut idle_since).await,
                    _ => self.look_for_helpers(&said, &mut offers).await,
                },
                Err(error) => Err(error),
            };
            if let Err(error) = looked {
                error.count();
                tracing::warn!(%error, "helpers of a fit are not heard for now");
            }
        }
    }

    async fn look_for_helpers(&self, said: &[(Said, Duration)], offers: &mut bool) -> Result<(), StoreError> {
        let mut helpers = BTreeMap::new();
        for (said, age) in said {
            if let Said::Helper { who, done } = said
                && *age < FRESH
            {
                helpers.insert(*who, *done);
            }
        }
        let is_back = |part: &str, who: Uuid| {
            let is_it =
                |said: &Said| matches!(said, Said::Back { part: p, from, .. } if p == part && *from == who);
            said.iter().any(|(said, _)| is_it(said))
        };
        let back: Vec<String> = {
            let parts = self.parts();
            let gone = |who, since: Instant| !helpers.contains_key(&who) && since.elapsed() > FRESH;
            let back = parts.away().filter(|&(part, who, since)| is_back(part, who) || gone(who, since));
            back.map(|(part, ..)| part.clone()).collect()
        };
        if !back.is_empty() {
            self.take(&back).await?;
        }
        let mut parts = self.parts();
        for part in parts.of.values_mut() {
            if let Place::With { who, done, .. } = &mut part.place {
                *done = helpers.get(who).copied().unwrap_or(*done);
            }
        }
        let mut to_give = parts.giveable(WORTH);
        let free = helpers.into_keys().find(|who| {
            let has_left =
                |(said, _): &(Said, _)| matches!(said, Said::Back { from, leaves: true, .. } if from == who);
            !parts.away().any(|(_, with, _)| with == *who) && !said.iter().any(has_left)
        });
        if let (Some(name), Some(who)) = (&to_give, free) {
            let part = parts.of.get_mut(name).expect("it was found there");
            let begun = part.place == Place::Here { begun: true };
            part.place = Place::With { who, since: Instant::now(), done: part.done };
            tracing::info!(part = name, helper = %who, "gives a network to another worker");
            if !begun {
                self.say(&Said::Given { part: name.clone(), to: who });
            }
            to_give = parts.giveable(WORTH);
        }
        if to_give.is_some() != *offers {
            *offers = to_give.is_some();
            self.control.renew(offers.then(|| self.checkpoint(&Said::Offer)));
        }
        Ok(())
    }

    async fn look_for_gifts(
        &self,
        own: Uuid,
        said: &[(Said, Duration)],
        idle_since: &mut Instant,
    ) -> Result<(), StoreError> {
        let given: Vec<String> = {
            let parts = self.parts();
            let given = said.iter().filter_map(|(said, _)| match said {
                Said::Given { part, to } if *to == own && !parts.of.contains_key(part) => Some(part.clone()),
                _ => None,
            });
            given.collect()
        };
        if !given.is_empty() {
            tracing::info!(parts = ?given, "was given a network to train");
            self.take(&given).await?;
        }
        let done = self.parts().of.values().find(|part| part.is_open_here()).map(|part| part.done);
        let offered = said.iter().any(|(said, age)| matches!(said, Said::Offer) && *age < FRESH);
        if done.is_some() {
            *idle_since = Instant::now();
        } else if !offered || idle_since.elapsed() > OPENED {
            self.control.stop(Stop::Yield);
        }
        let sign = Said::Helper { who: own, done: done.unwrap_or(0.0) };
        self.control.renew(Some(self.checkpoint(&sign)));
        Ok(())
    }

    /// Goes on with parts that another process has left, from their last states.
    async fn take(&self, names: &[String]) -> Result<(), StoreError> {
        let mut found: BTreeMap<String, Vec<u8>> = BTreeMap::new();
        for one in self.store.checkpoints(self.job, &self.fits).await? {
            if names.contains(&one.part) {
                found.insert(one.part, one.state.into());
            }
        }
        let mut parts = self.parts();
        for name in names {
            let before = parts.of.get(name);
            let (done, kept) = match before {
                Some(Part { place: Place::With { done, .. }, kept, .. }) => (*done, kept.clone()),
                _ => (0.0, None),
            };
            let kept = found.remove(name).or(kept);
            // A part that has ended there is looked at once more here.
            parts.of.insert(name.clone(), Part { done: done.min(0.999), kept, ..Part::new() });
        }
        Ok(())
    }

    async fn said(&self) -> Result<Vec<(Said, Duration)>, StoreError> {
        let rows = self.store.shares(self.job, &self.fits).await?;
        let read = |(_, state, age): (String, Vec<u8>, Duration)| {
            Some((serde_json::from_slice::<Said>(&state).ok()?, age))
        };
        Ok(rows.into_iter().filter_map(read).collect())
    }

    fn say(&self, said: &Said) {
        self.control.keep(self.checkpoint(said));
    }

    fn checkpoint(&self, said: &Said) -> Checkpoint {
        let state = serde_json::to_vec(said).expect("names and numbers always serialise");
        Checkpoint { part: said.place(), fits: self.fits.clone(), state: state.into() }
    }

    fn parts(&self) -> MutexGuard<'_, Parts> {
        self.parts.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl CheckpointStore for SeedShares {
    fn load(&self, part: &str) -> Option<Vec<u8>> {
        let kept = self.parts().of.get(part).and_then(|part| part.kept.clone());
        kept.or_else(|| self.own.load(part))
    }

    fn is_due(&self, part: &str, done: bool) -> bool {
        // What a helper has done is of use only where it is stored.
        (done && matches!(self.role, Role::Helper(_))) || self.own.is_due(part, done)
    }

    fn save(&self, part: &str, state: Vec<u8>) {
        if let Some(part) = self.parts().of.get_mut(part)
            && self.role != Role::Alone
        {
            part.kept = Some(state.clone());
        }
        self.own.save(part, state);
    }

    fn announce(&self, names: &[String]) {
        if self.role == Role::Worker {
            let of = names.iter().map(|name| (name.clone(), Part::new())).collect();
            *self.parts() = Parts { of, began: Some(Instant::now()) };
        }
    }

    fn elsewhere(&self, name: &str, share: f64) -> Option<f64> {
        let mut parts = self.parts();
        let Some(part) = parts.of.get_mut(name) else {
            // A helper trains what it was given.
            return matches!(self.role, Role::Helper(_)).then_some(0.0);
        };
        if let Place::With { done, .. } = part.place {
            return Some(done);
        }
        part.place = Place::Here { begun: true };
        part.done = share.max(part.done);
        if share > 0.0 {
            part.done_before.get_or_insert(share);
        }
        if share >= 1.0
            && let Role::Helper(from) = self.role
        {
            self.say(&Said::Back { part: name.to_owned(), from, leaves: false });
        }
        None
    }

    fn hand_over(&self, name: &str) {
        let parts = self.parts();
        let part = name.to_owned();
        match (self.role, parts.of.get(name).map(|part| part.place)) {
            (Role::Worker, Some(Place::With { who, .. })) => self.say(&Said::Given { part, to: who }),
            (Role::Helper(from), Some(_)) => self.say(&Said::Back { part, from, leaves: true }),
            _ => {}
        }
    }
}
