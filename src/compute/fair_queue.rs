//! Permits for one class of work, and a bounded queue for them that is fair between tokens.
//!
//! The next permit goes to the token that has had the fewest of late. Each token has a tag that rises by
//! one with each of its permits and is never behind the tag of the permit given last (start-time fair
//! queueing, Goyal, Vin and Cheng 1996, with one price for all permits). A token with one request
//! therefore waits for no more than the work under way, however many requests of another token wait.
//!
//! A full queue drops the newest task of the token that has most tasks in it. `crowding` says how many
//! tasks may wait. A request is let in before its body is read: [`Place`] promises it a permit.

mod crowding;
mod place;

use std::collections::{HashMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::oneshot;
use tokio::time::Instant;

use crate::domain::TokenId;
use crate::telemetry::names;
use crowding::Crowding;
use place::Promises;

pub use place::{Asker, Place};

/// The client that a task belongs to: a token, or `None` for a caller without one.
pub type ClientId = Option<TokenId>;

/// How many permits there are, and how many tasks may wait for one.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct QueueSettings {
    /// Permits in use at once.
    pub permits: usize,
    /// Permits in use at once by one token.
    pub per_token: usize,
    /// Tasks that may wait.
    pub max_waiting: usize,
    /// Longest wait.
    pub max_wait: Duration,
    /// How long tasks should wait at most: for how much work at once there is room, and how long the queue may
    /// go without being empty before it is kept short.
    pub patience: Duration,
}

impl QueueSettings {
    /// Settings in which one token may have all permits and the queue always has its whole length.
    pub fn new(permits: usize, max_waiting: usize, max_wait: Duration) -> Self {
        Self {
            permits: permits.max(1),
            per_token: permits.max(1),
            max_waiting,
            max_wait,
            patience: Duration::MAX,
        }
    }
}

/// Why a task got no permit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Refused {
    /// Other tokens want permits too, and this one has or waits for more than its share.
    #[error("the token's own share of the permits and of the queue is used up")]
    Share,
    /// All permits and all places in the queue are taken.
    #[error("the queue is full")]
    Full,
    /// No permit came free within the longest wait.
    #[error("no permit came within the longest wait")]
    Late,
}

impl Refused {
    /// As a metric's label.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Share => "share",
            Self::Full => "full",
            Self::Late => "late",
        }
    }
}

/// The permits of one class of work and the queue for them.
#[derive(Debug)]
pub struct FairQueue {
    class: &'static str,
    settings: QueueSettings,
    state: Mutex<State>,
}

/// Leave to work. Dropping it gives the permit to the next task.
#[derive(Debug)]
pub struct Permit {
    queue: Arc<FairQueue>,
    client: ClientId,
    given: Instant,
}

#[derive(Debug)]
struct State {
    in_use: usize,
    waiting: usize,
    /// Tag of the permit that was given last.
    tag: u64,
    /// Number of the newest task.
    last: u64,
    crowding: Crowding,
    promises: Promises,
    shares: HashMap<ClientId, ClientShare>,
}

/// The permits, promises and waiting tasks of one token.
#[derive(Debug, Default)]
struct ClientShare {
    in_use: usize,
    promised: usize,
    waiting: VecDeque<Waiter>,
    /// Tag of its next permit.
    tag: u64,
}

#[derive(Debug)]
struct Waiter {
    number: u64,
    answer: oneshot::Sender<Result<Permit, Refused>>,
}

impl Waiter {
    /// Takes its place away for a client that has less.
    fn drop_for_others(self) {
        // A task that has gone away needs no answer.
        let _ = self.answer.send(Err(Refused::Share));
    }
}

/// The outcome of a task's arrival.
enum Arrival {
    Given,
    Refused(Refused),
    /// The task waits; another one may have been dropped to make room for it.
    Waits(u64, oneshot::Receiver<Result<Permit, Refused>>, Option<Waiter>),
}

impl FairQueue {
    /// A queue for a class of work; `class` is its label in the metrics.
    pub fn new(class: &'static str, settings: QueueSettings) -> Arc<Self> {
        let state = State {
            in_use: 0,
            waiting: 0,
            tag: 0,
            last: 0,
            crowding: Crowding::new(),
            promises: Promises::default(),
            shares: HashMap::new(),
        };
        Arc::new(Self { class, settings, state: Mutex::new(state) })
    }

    /// Waits for a permit. A task whose future is dropped leaves the queue. One that was promised a permit is
    /// not refused for a full queue.
    ///
    /// # Errors
    /// [`Refused`]: at once when the queue is full, later when the longest wait is over.
    pub async fn acquire(self: &Arc<Self>, asker: impl Into<Asker>) -> Result<Permit, Refused> {
        let Asker { client, place } = asker.into();
        let place = place.filter(|place| place.is_in(self));
        let arrival = {
            let mut state = self.lock();
            let promised = place.as_ref().is_some_and(|place| place.redeem(&mut state));
            state.arrive(client, promised, &self.settings)
        };
        let taken = match arrival {
            Arrival::Given => Ok(self.permit(client)),
            Arrival::Refused(why) => Err(why),
            Arrival::Waits(number, answer, dropped) => {
                dropped.into_iter().for_each(Waiter::drop_for_others);
                self.wait(client, number, answer).await
            }
        };
        match &taken {
            // A request may need more than one permit. Once it has one, work on it is not to be lost.
            Ok(_) => place.iter().for_each(|place| place.keep()),
            Err(why) => self.note(*why),
        }
        taken
    }

    /// Tells whether [`FairQueue::acquire`] would be refused now, so that the body of a request need not
    /// be read in vain.
    ///
    /// # Errors
    /// [`Refused`].
    pub fn check(&self, client: ClientId) -> Result<(), Refused> {
        let refused = self.lock().refuses(client, &self.settings);
        refused.map_or(Ok(()), |why| {
            self.note(why);
            Err(why)
        })
    }

    /// Promises a request a permit before its body is read, or refuses it at once.
    ///
    /// # Errors
    /// [`Refused`].
    pub fn promise(self: &Arc<Self>, client: ClientId) -> Result<Place, Refused> {
        let promised = self.lock().promise(client, &self.settings);
        match promised {
            Ok((number, dropped)) => {
                dropped.into_iter().for_each(Waiter::drop_for_others);
                Ok(Place::new(self, client, number))
            }
            Err(why) => {
                self.note(why);
                Err(why)
            }
        }
    }

    /// Name of the class, permits in use, tasks that wait.
    pub fn depth(&self) -> (&'static str, usize, usize) {
        let state = self.lock();
        (self.class, state.in_use, state.waiting)
    }

    async fn wait(
        self: &Arc<Self>,
        client: ClientId,
        number: u64,
        mut answer: oneshot::Receiver<Result<Permit, Refused>>,
    ) -> Result<Permit, Refused> {
        let started = Instant::now();
        let waiting = Waiting::new(self, client, number);
        let answered = tokio::time::timeout(self.settings.max_wait, &mut answer).await;
        drop(waiting);
        metrics::histogram!(names::QUEUE_SECONDS, "class" => self.class)
            .record(started.elapsed().as_secs_f64());
        // The permit may have come at the last moment.
        let answered = answered.unwrap_or_else(|_| answer.try_recv().map_or(Ok(Err(Refused::Late)), Ok));
        // The other end lives as long as the place in the queue.
        answered.unwrap_or(Err(Refused::Late))
    }

    fn note(&self, why: Refused) {
        metrics::counter!(names::SHED, "class" => self.class, "reason" => why.as_str()).increment(1);
    }

    fn permit(self: &Arc<Self>, client: ClientId) -> Permit {
        metrics::gauge!(names::TURNS, "class" => self.class).increment(1.0);
        Permit { queue: Arc::clone(self), client, given: Instant::now() }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        // Nothing in here panics half-way through a change.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for Permit {
    fn drop(&mut self) {
        let queue = &self.queue;
        metrics::gauge!(names::TURNS, "class" => queue.class).decrement(1.0);
        let next = {
            let mut state = queue.lock();
            state.crowding.worked(self.given.elapsed());
            state.leave(self.client);
            state.next(&queue.settings)
        };
        for (client, waiter) in next {
            // A task that has gone away gives the permit back by dropping it.
            let _ = waiter.answer.send(Ok(queue.permit(client)));
        }
    }
}

/// A place in the queue.
struct Waiting<'a> {
    queue: &'a FairQueue,
    client: ClientId,
    number: u64,
}

impl<'a> Waiting<'a> {
    fn new(queue: &'a FairQueue, client: ClientId, number: u64) -> Self {
        metrics::gauge!(names::QUEUE_DEPTH, "class" => queue.class).increment(1.0);
        Self { queue, client, number }
    }
}

impl Drop for Waiting<'_> {
    fn drop(&mut self) {
        metrics::gauge!(names::QUEUE_DEPTH, "class" => self.queue.class).decrement(1.0);
        self.queue.lock().give_up(self.client, self.number);
    }
}

impl State {
    fn arrive(&mut self, client: ClientId, promised: bool, settings: &QueueSettings) -> Arrival {
        let share = self.shares.entry(client).or_default();
        if share.waiting.is_empty() {
            share.tag = share.tag.max(self.tag);
        }
        // While a permit is free, a token whose tasks wait holds all that it may have.
        if self.in_use < settings.permits && share.in_use < settings.per_token {
            self.give(client);
            return Arrival::Given;
        }
        let mut dropped = None;
        if !promised {
            if let Some(why) = self.refuses(client, settings) {
                self.forget(client);
                return Arrival::Refused(why);
            }
            if self.is_full(settings) {
                dropped = self.drop_of_most();
            }
        }
        if self.waiting == 0 {
            self.crowding.emptied();
        }
        self.last += 1;
        let (answer, receiver) = oneshot::channel();
        self.shares.entry(client).or_default().waiting.push_back(Waiter { number: self.last, answer });
        self.waiting += 1;
        Arrival::Waits(self.last, receiver, dropped)
    }

    /// The reason why a task would get no place in the queue, if there is one.
    fn refuses(&mut self, client: ClientId, settings: &QueueSettings) -> Option<Refused> {
        self.lapse();
        let refused = self.reason(client, settings);
        self.crowding.asked(refused.is_some());
        refused
    }

    fn reason(&mut self, client: ClientId, settings: &QueueSettings) -> Option<Refused> {
        let own = self.shares.get(&client).map_or((0, 0), |share| (share.held(), share.waiting.len()));
        let free = self.in_use + self.promises.len() < settings.permits && own.0 < settings.per_token;
        if free || !self.is_full(settings) {
            return None;
        }
        let most = self.shares.values().map(|share| share.waiting.len()).max().unwrap_or_default();
        if own.1 + 1 < most {
            return None;
        }
        // More than the mean of the tokens that hold or want permits.
        let others =
            self.shares.iter().filter(|(other, share)| **other != client && share.is_active()).count();
        let all = self.in_use + self.promises.len() + self.waiting;
        let much = (own.0 + own.1) * (others + 1) > all;
        Some(if others > 0 && much { Refused::Share } else { Refused::Full })
    }

    fn is_full(&mut self, settings: &QueueSettings) -> bool {
        let free = settings.permits.saturating_sub(self.in_use);
        let queued = self.waiting + self.promises.len().saturating_sub(free);
        queued >= self.crowding.room(self.waiting, settings)
    }

    /// Drops the newest task of the token that has most tasks in the queue.
    fn drop_of_most(&mut self) -> Option<Waiter> {
        let longest = self.shares.values_mut().max_by_key(|share| share.waiting.len())?;
        let dropped = longest.waiting.pop_back()?;
        self.waiting -= 1;
        Some(dropped)
    }

    /// Tasks that get a permit now.
    fn next(&mut self, settings: &QueueSettings) -> Vec<(ClientId, Waiter)> {
        let mut next = Vec::new();
        while self.in_use < settings.permits {
            let first = self
                .shares
                .iter()
                .filter(|(_, share)| share.in_use < settings.per_token)
                .filter_map(|(client, share)| Some((share.tag, share.waiting.front()?.number, *client)))
                .min_by_key(|(tag, number, _)| (*tag, *number));
            let Some((_, _, client)) = first else { break };
            let waiter = self.shares.get_mut(&client).and_then(|share| share.waiting.pop_front());
            let Some(waiter) = waiter else { break };
            self.left_queue();
            self.give(client);
            next.push((client, waiter));
        }
        next
    }

    fn give(&mut self, client: ClientId) {
        let share = self.shares.entry(client).or_default();
        self.tag = self.tag.max(share.tag);
        share.tag += 1;
        share.in_use += 1;
        self.in_use += 1;
    }

    fn leave(&mut self, client: ClientId) {
        self.in_use -= 1;
        if let Some(share) = self.shares.get_mut(&client) {
            share.in_use -= 1;
        }
        self.forget(client);
    }

    fn give_up(&mut self, client: ClientId, number: u64) {
        let Some(share) = self.shares.get_mut(&client) else { return };
        let before = share.waiting.len();
        share.waiting.retain(|waiter| waiter.number != number);
        if share.waiting.len() < before {
            self.left_queue();
            self.forget(client);
        }
    }

    fn left_queue(&mut self) {
        self.waiting -= 1;
        if self.waiting == 0 {
            self.crowding.emptied();
        }
    }

    /// Forgets a token that holds and wants nothing and is not ahead of others.
    fn forget(&mut self, client: ClientId) {
        if self.in_use == 0 && self.waiting == 0 && self.promises.len() == 0 {
            self.shares.clear();
        } else if self.shares.get(&client).is_some_and(|share| !share.is_active() && share.tag <= self.tag) {
            self.shares.remove(&client);
        }
    }
}

impl ClientShare {
    /// Permits that it has or was promised.
    fn held(&self) -> usize {
        self.in_use + self.promised
    }

    fn is_active(&self) -> bool {
        self.held() > 0 || !self.waiting.is_empty()
    }
}

#[cfg(test)]
mod tests;
