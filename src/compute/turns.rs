//! Turns: permits that are waited for in a bounded queue, fairly between tokens.
//!
//! The next turn is the token's that has had fewest of late: each token has a tag that rises by one
//! with its turns and is never behind the tag of the turn given last (start-time fair queueing, Goyal,
//! Vin and Cheng 1996, all turns at one price). So a token with one request waits for no more than the
//! turns under way, however many requests of another token wait.
//!
//! A full queue drops the newest task of the token that has most in it. A burst may fill the whole
//! queue; one that has not been empty for a while tells of more work than can be done, and waiting in
//! it helps nobody: then it is kept short (after Nichols and Jacobson's controlled delay, 2012).

use std::collections::{HashMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::oneshot;
use tokio::time::Instant;

use crate::domain::TokenId;
use crate::telemetry::names;

/// Whose work it is: a token's, or that of whoever needs none.
pub type Who = Option<TokenId>;

/// Tasks that a queue may hold which does not empty, for each permit.
const SHORT_QUEUE: usize = 2;

/// How many have turns at once, and who may wait for one.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TurnSettings {
    /// Turns at once.
    pub permits: usize,
    /// Turns at once of one token.
    pub per_token: usize,
    /// Tasks that may wait.
    pub queue: usize,
    /// Longest wait.
    pub wait: Duration,
    /// How long the queue may go without being empty until it is kept short.
    pub patience: Duration,
}

impl TurnSettings {
    /// One token may have all turns, and the queue always has its whole length.
    pub fn new(permits: usize, queue: usize, wait: Duration) -> Self {
        Self { permits: permits.max(1), per_token: permits.max(1), queue, wait, patience: Duration::MAX }
    }
}

/// Why there is no turn.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Refused {
    /// Others want turns too, and the token has or waits for more than its share.
    #[error("the token's own share of the turns and of the queue is used up")]
    Share,
    /// All turns and all places in the queue are taken.
    #[error("the queue is full")]
    Full,
    /// No turn came within the longest wait.
    #[error("no turn came within the longest wait")]
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

/// The turns of one class of work.
#[derive(Debug)]
pub struct Turns {
    class: &'static str,
    settings: TurnSettings,
    state: Mutex<State>,
}

/// A turn; it ends with this value.
#[derive(Debug)]
pub struct Turn {
    turns: Arc<Turns>,
    who: Who,
}

#[derive(Debug)]
struct State {
    in_use: usize,
    waiting: usize,
    /// Tag of the turn that was given last.
    tag: u64,
    /// Number of the task that came last.
    last: u64,
    /// When nobody was waiting last.
    emptied: Instant,
    shares: HashMap<Who, Share>,
}

/// What one token has of it.
#[derive(Debug, Default)]
struct Share {
    in_use: usize,
    waiting: VecDeque<Waiter>,
    /// Tag of its next turn.
    tag: u64,
}

#[derive(Debug)]
struct Waiter {
    number: u64,
    answer: oneshot::Sender<Result<Turn, Refused>>,
}

/// What becomes of a task that comes.
enum Came {
    Given,
    Refused(Refused),
    /// It waits; in its place another task may have been dropped.
    Waits(u64, oneshot::Receiver<Result<Turn, Refused>>, Option<Waiter>),
}

impl Turns {
    /// Turns of a class of work, named as in the metrics.
    pub fn new(class: &'static str, settings: TurnSettings) -> Arc<Self> {
        let state =
            State { in_use: 0, waiting: 0, tag: 0, last: 0, emptied: Instant::now(), shares: HashMap::new() };
        Arc::new(Self { class, settings, state: Mutex::new(state) })
    }

    /// Waits for a turn. Who stops waiting leaves the queue.
    ///
    /// # Errors
    /// [`Refused`]: at once when the queue is full, later when the longest wait is over.
    pub async fn take(self: &Arc<Self>, who: Who) -> Result<Turn, Refused> {
        let came = self.lock().come(who, &self.settings);
        let taken = match came {
            Came::Given => Ok(self.turn(who)),
            Came::Refused(why) => Err(why),
            Came::Waits(number, answer, dropped) => {
                if let Some(dropped) = dropped {
                    // Who has gone meanwhile needs no answer.
                    let _ = dropped.answer.send(Err(Refused::Share));
                }
                self.wait(who, number, answer).await
            }
        };
        if let Err(why) = taken {
            self.note(why);
        }
        taken
    }

    /// Whether [`Turns::take`] would wait in vain already now: spares the reading of what a request
    /// sends.
    ///
    /// # Errors
    /// [`Refused`].
    pub fn check(&self, who: Who) -> Result<(), Refused> {
        let refused = self.lock().refuses(who, &self.settings);
        if let Some(why) = refused {
            self.note(why);
            return Err(why);
        }
        Ok(())
    }

    /// Name of the class, turns under way, tasks that wait.
    pub fn depth(&self) -> (&'static str, usize, usize) {
        let state = self.lock();
        (self.class, state.in_use, state.waiting)
    }

    async fn wait(
        self: &Arc<Self>,
        who: Who,
        number: u64,
        mut answer: oneshot::Receiver<Result<Turn, Refused>>,
    ) -> Result<Turn, Refused> {
        let started = Instant::now();
        let waiting = Waiting::new(self, who, number);
        let answered = tokio::time::timeout(self.settings.wait, &mut answer).await;
        drop(waiting);
        metrics::histogram!(names::QUEUE_SECONDS, "class" => self.class)
            .record(started.elapsed().as_secs_f64());
        // The turn may have come at the last moment.
        let answered = answered.unwrap_or_else(|_| answer.try_recv().map_or(Ok(Err(Refused::Late)), Ok));
        // The other end lives as long as the place in the queue.
        answered.unwrap_or(Err(Refused::Late))
    }

    fn note(&self, why: Refused) {
        metrics::counter!(names::SHED, "class" => self.class, "reason" => why.as_str()).increment(1);
    }

    fn turn(self: &Arc<Self>, who: Who) -> Turn {
        metrics::gauge!(names::TURNS, "class" => self.class).increment(1.0);
        Turn { turns: Arc::clone(self), who }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        // Nothing in here panics half-way through a change.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for Turn {
    fn drop(&mut self) {
        let turns = &self.turns;
        metrics::gauge!(names::TURNS, "class" => turns.class).decrement(1.0);
        let next = {
            let mut state = turns.lock();
            state.leave(self.who);
            state.next(&turns.settings)
        };
        for (who, waiter) in next {
            // Who has gone meanwhile gives it back by not taking it.
            let _ = waiter.answer.send(Ok(turns.turn(who)));
        }
    }
}

/// A place in the queue.
struct Waiting<'a> {
    turns: &'a Turns,
    who: Who,
    number: u64,
}

impl<'a> Waiting<'a> {
    fn new(turns: &'a Turns, who: Who, number: u64) -> Self {
        metrics::gauge!(names::QUEUE_DEPTH, "class" => turns.class).increment(1.0);
        Self { turns, who, number }
    }
}

impl Drop for Waiting<'_> {
    fn drop(&mut self) {
        metrics::gauge!(names::QUEUE_DEPTH, "class" => self.turns.class).decrement(1.0);
        self.turns.lock().give_up(self.who, self.number);
    }
}

impl State {
    fn come(&mut self, who: Who, settings: &TurnSettings) -> Came {
        let share = self.shares.entry(who).or_default();
        if share.waiting.is_empty() {
            share.tag = share.tag.max(self.tag);
        }
        // Whoever waits while there is a turn left has all that are the token's.
        if self.in_use < settings.permits && share.in_use < settings.per_token {
            self.give(who);
            return Came::Given;
        }
        if let Some(why) = self.refuses(who, settings) {
            self.forget(who);
            return Came::Refused(why);
        }
        let dropped = if self.is_full(settings) { self.drop_of_most() } else { None };
        if self.waiting == 0 {
            self.emptied = Instant::now();
        }
        self.last += 1;
        let (answer, receiver) = oneshot::channel();
        self.shares.entry(who).or_default().waiting.push_back(Waiter { number: self.last, answer });
        self.waiting += 1;
        Came::Waits(self.last, receiver, dropped)
    }

    /// Why a task would get no place in the queue.
    fn refuses(&self, who: Who, settings: &TurnSettings) -> Option<Refused> {
        let own = self.shares.get(&who).map_or((0, 0), |share| (share.in_use, share.waiting.len()));
        let free = self.in_use < settings.permits && own.0 < settings.per_token;
        if free || !self.is_full(settings) {
            return None;
        }
        let most = self.shares.values().map(|share| share.waiting.len()).max().unwrap_or_default();
        if own.1 + 1 < most {
            return None;
        }
        // More than the mean of those who have or want turns.
        let others = self.shares.iter().filter(|(other, share)| **other != who && share.is_active()).count();
        let all = self.in_use + self.waiting;
        let much = (own.0 + own.1) * (others + 1) > all;
        Some(if others > 0 && much { Refused::Share } else { Refused::Full })
    }

    fn is_full(&self, settings: &TurnSettings) -> bool {
        let stands = self.waiting > 0 && self.emptied.elapsed() > settings.patience;
        let short = settings.queue.min(SHORT_QUEUE * settings.permits);
        self.waiting >= if stands { short } else { settings.queue }
    }

    /// Takes the newest task out of the longest part of the queue.
    fn drop_of_most(&mut self) -> Option<Waiter> {
        let longest = self.shares.values_mut().max_by_key(|share| share.waiting.len())?;
        let dropped = longest.waiting.pop_back()?;
        self.waiting -= 1;
        Some(dropped)
    }

    /// Tasks whose turn it is.
    fn next(&mut self, settings: &TurnSettings) -> Vec<(Who, Waiter)> {
        let mut next = Vec::new();
        while self.in_use < settings.permits {
            let first = self
                .shares
                .iter()
                .filter(|(_, share)| share.in_use < settings.per_token)
                .filter_map(|(who, share)| Some((share.tag, share.waiting.front()?.number, *who)))
                .min_by_key(|(tag, number, _)| (*tag, *number));
            let Some((_, _, who)) = first else { break };
            let waiter = self.shares.get_mut(&who).and_then(|share| share.waiting.pop_front());
            let Some(waiter) = waiter else { break };
            self.left_queue();
            self.give(who);
            next.push((who, waiter));
        }
        next
    }

    fn give(&mut self, who: Who) {
        let share = self.shares.entry(who).or_default();
        self.tag = self.tag.max(share.tag);
        share.tag += 1;
        share.in_use += 1;
        self.in_use += 1;
    }

    fn leave(&mut self, who: Who) {
        self.in_use -= 1;
        if let Some(share) = self.shares.get_mut(&who) {
            share.in_use -= 1;
        }
        self.forget(who);
    }

    fn give_up(&mut self, who: Who, number: u64) {
        let Some(share) = self.shares.get_mut(&who) else { return };
        let before = share.waiting.len();
        share.waiting.retain(|waiter| waiter.number != number);
        if share.waiting.len() < before {
            self.left_queue();
            self.forget(who);
        }
    }

    fn left_queue(&mut self) {
        self.waiting -= 1;
        if self.waiting == 0 {
            self.emptied = Instant::now();
        }
    }

    /// Keeps no token in memory that has and wants nothing and is not ahead of others.
    fn forget(&mut self, who: Who) {
        if self.in_use == 0 && self.waiting == 0 {
            self.shares.clear();
        } else if self.shares.get(&who).is_some_and(|share| !share.is_active() && share.tag <= self.tag) {
            self.shares.remove(&who);
        }
    }
}

impl Share {
    fn is_active(&self) -> bool {
        self.in_use > 0 || !self.waiting.is_empty()
    }
}

#[cfg(test)]
mod tests;
