//! The networks of a fit, one a seed, trained by every worker that has nothing else to do.
//!
//! Where processes share a registry, the worker of a fit offers networks while it has more than one to train and much to do.
//! A worker without a job reads the same data and says that it is there. The fit's worker stops a training, stores its
//! state and gives it away; the helper goes on from there, stores its states in the same place, and gives back what has
//! ended or has to stop. Nothing depends on who trains what: a state that is read late or not at all costs time, and the
//! network comes out alike. A helper that is not heard of, stands still or is too slow loses its network.

mod parts;
mod said;

use std::collections::BTreeMap;
use std::convert::Infallible;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tokio::time::MissedTickBehavior;
use uuid::Uuid;

use crate::domain::JobId;
use crate::engine::checkpoint::CheckpointStore;
use crate::storage::{Checkpoint, Store, StoreError};

use super::checkpoints::JobCheckpoints;
use super::control::{Control, Stop};
use super::helping::{FRESH, OPENED};
use super::problem::JobError;
use parts::{Part, Parts, Place, Taken};
use said::Said;

/// How often each side looks what the other has said.
const LOOK_EVERY: Duration = Duration::from_secs(1);

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
    opened: Instant,
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
        Ok(Self { own, store, control, job, fits, role, parts: Mutex::default(), opened: Instant::now() })
    }

    /// Waits, as a helper, until the fit's worker offers what this process would compute.
    ///
    /// # Errors
    /// [`JobError::Stopped`]: it does not, as with another instruction set. The store's failures.
    pub(super) async fn wait_for_offer(&self, patience: Duration) -> Result<(), JobError> {
        let began = Instant::now();
        while began.elapsed() < patience && self.control.stopped().is_none() {
            if is_offered(&self.said().await?) {
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
        // Those of an attempt before this one cannot write any more.
        let fresh = FRESH.min(self.opened.elapsed());
        let there = said.iter().filter(|(_, age)| *age < fresh).filter_map(|(said, _)| match said {
            Said::Helper { who, done, leaves: false } => Some((*who, *done)),
            _ => None,
        });
        let helpers: BTreeMap<Uuid, f64> = there.collect();
        let back = self.come_back(said, &helpers);
        if !back.is_empty() {
            self.take(&back).await?;
        }
        let mut parts = self.parts();
        self.give(&mut parts, &helpers);
        let to_give = parts.giveable().is_some();
        if to_give != *offers {
            *offers = to_give;
            self.control.renew(offers.then(|| self.checkpoint(&Said::Offer)));
        }
        Ok(())
    }

    /// The networks that helpers have given back, or lose.
    fn come_back(&self, said: &[(Said, Duration)], helpers: &BTreeMap<Uuid, f64>) -> Vec<Taken> {
        let mut parts = self.parts();
        for part in parts.of.values_mut() {
            if let Place::With { who: Some(who), done, .. } = &mut part.place {
                *done = helpers.get(who).map_or(*done, |there| done.max(*there));
            }
        }
        let said_back = |name: &str, gift: u32| {
            said.iter().find_map(|(said, _)| match said {
                Said::Back { part, gift: g, ended } if part == name && *g == gift => Some(*ended),
                _ => None,
            })
        };
        let mut back = Vec::new();
        for away in parts.away() {
            let (name, gift) = (away.name.clone(), away.part.gift);
            let is_gone = !helpers.contains_key(&away.who) && away.since.elapsed() > FRESH;
            match said_back(&name, gift) {
                Some(ended) => back.push(Taken { name, gift, ended }),
                None if is_gone || parts.is_slow(away.part) => {
                    tracing::info!(part = name, helper = %away.who, "takes a network back from another worker");
                    self.say(&Said::Given { part: name.clone(), to: None, gift });
                    back.push(Taken { name, gift, ended: false });
                }
                None => {}
            }
        }
        back
    }

    /// Gives a network to a helper that has none, if that pays.
    fn give(&self, parts: &mut Parts, helpers: &BTreeMap<Uuid, f64>) {
        let free = helpers.keys().find(|who| !parts.away().any(|away| away.who == **who));
        let (Some(&who), Some(name)) = (free, parts.giveable()) else { return };
        let part = parts.of.get_mut(&name).expect("it was found there");
        let begun = part.place == Place::Here { begun: true };
        part.place = Place::With { who: Some(who), since: Instant::now(), done: part.done };
        part.gift += 1;
        tracing::info!(part = name, helper = %who, "gives a network to another worker");
        // One that has begun is given when it has stopped.
        if !begun {
            self.say(&Said::Given { part: name, to: Some(who), gift: part.gift });
        }
    }

    async fn look_for_gifts(
        &self,
        own: Uuid,
        said: &[(Said, Duration)],
        idle_since: &mut Instant,
    ) -> Result<(), StoreError> {
        let mut given = Vec::new();
        {
            let mut parts = self.parts();
            for (said, _) in said {
                let Said::Given { part: name, to, gift } = said else { continue };
                let known = parts.of.get_mut(name);
                if *to == Some(own) {
                    if known.is_none_or(|part| part.gift < *gift) {
                        given.push(Taken { name: name.clone(), gift: *gift, ended: false });
                    }
                } else if let Some(part) = known
                    && part.is_open_here()
                {
                    // The fit's worker has given up waiting.
                    part.place = Place::With { who: None, since: Instant::now(), done: part.done };
                }
            }
        }
        if !given.is_empty() {
            tracing::info!(parts = ?given, "was given a network to train");
            self.take(&given).await?;
        }
        let done = self.parts().of.values().find(|part| part.is_open_here()).map(|part| part.done);
        if done.is_some() {
            *idle_since = Instant::now();
        } else if !is_offered(said) || idle_since.elapsed() > OPENED {
            self.leave();
            self.control.stop(Stop::Lost);
            return Ok(());
        }
        if self.parts().began.is_some() {
            let sign = Said::Helper { who: own, done: done.unwrap_or(0.0), leaves: false };
            self.control.renew(Some(self.checkpoint(&sign)));
        } else {
            // It reads the data, and estimates the FRF.
            *idle_since = Instant::now();
        }
        Ok(())
    }

    /// Says, at the end of the work, that nothing is offered any more, or that a helper leaves.
    pub(super) fn leave(&self) {
        self.control.renew(None);
        if let Role::Helper(who) = self.role {
            self.say(&Said::Helper { who, done: 0.0, leaves: true });
        }
    }

    /// Goes on with parts that another process has left, from their last states.
    async fn take(&self, taken: &[Taken]) -> Result<(), StoreError> {
        let mut found: BTreeMap<String, Vec<u8>> = BTreeMap::new();
        for one in self.store.checkpoints(self.job, &self.fits).await? {
            if taken.iter().any(|taken| taken.name == one.part) {
                found.insert(one.part, one.state.into());
            }
        }
        let mut parts = self.parts();
        for Taken { name, gift, ended } in taken {
            let before = parts.of.remove(name).unwrap_or_else(Part::new);
            let there = if let Place::With { done, .. } = before.place { done } else { 0.0 };
            // What has not said that it ended is open, whatever share it has told.
            let done = if *ended { 1.0 } else { there.min(0.999) };
            let kept = found.remove(name).or(before.kept);
            parts.of.insert(name.clone(), Part { done, kept, gift: *gift, ..Part::new() });
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

/// Whether the fit's worker offers networks.
fn is_offered(said: &[(Said, Duration)]) -> bool {
    said.iter().any(|(said, age)| matches!(said, Said::Offer) && *age < FRESH)
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
        if let Some(part) = self.parts().of.get_mut(part) {
            part.kept = Some(state.clone());
        }
        self.own.save(part, state);
    }

    fn announce(&self, names: &[String]) {
        if let Role::Helper(_) = self.role {
            self.parts().began = Some(Instant::now());
        } else if self.role == Role::Worker {
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
        if share >= 1.0 {
            // It was at its last step when it was given away: there is nothing left to do elsewhere.
            (part.place, part.done) = (Place::Here { begun: true }, 1.0);
            let gift = part.gift;
            if matches!(self.role, Role::Helper(_)) {
                self.say(&Said::Back { part: name.to_owned(), gift, ended: true });
            }
            return None;
        }
        if let Place::With { done, .. } = part.place {
            return Some(done);
        }
        part.place = Place::Here { begun: true };
        part.done = share.max(part.done);
        if share > 0.0 {
            part.done_before.get_or_insert(share);
        }
        None
    }

    fn hand_over(&self, name: &str) {
        let parts = self.parts();
        let Some(Part { place, gift, .. }) = parts.of.get(name) else { return };
        let (part, gift) = (name.to_owned(), *gift);
        match (self.role, place) {
            // After its state, which sorts before this: what is stored at once is stored by name.
            (Role::Worker, Place::With { who, .. }) => self.say(&Said::Given { part, to: *who, gift }),
            (Role::Helper(_), Place::Here { .. }) => self.say(&Said::Back { part, gift, ended: false }),
            _ => {}
        }
    }
}
