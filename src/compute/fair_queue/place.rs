//! Promises of a permit, given before a request's body is read, so that a body is read only if its work will be
//! done.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use tokio::time::Instant;

use super::{ClientId, FairQueue, QueueSettings, Refused, State, Waiter};

/// How long a promise keeps its place for a body that is still coming. A slow sender then asks again once its
/// body is there.
const LASTS: Duration = Duration::from_millis(100);

/// A promised permit. Dropping it gives the place back.
#[derive(Debug)]
pub struct Place {
    queue: Arc<FairQueue>,
    client: ClientId,
    number: u64,
    /// Whether the request has had a permit.
    kept: AtomicBool,
}

impl Place {
    pub(super) fn new(queue: &Arc<FairQueue>, client: ClientId, number: u64) -> Self {
        Self { queue: Arc::clone(queue), client, number, kept: AtomicBool::new(false) }
    }

    pub(super) fn is_in(&self, queue: &Arc<FairQueue>) -> bool {
        Arc::ptr_eq(&self.queue, queue)
    }

    /// Gives up the promise for the permit that is asked for now. Tells whether the request may not be refused.
    pub(super) fn redeem(&self, state: &mut State) -> bool {
        state.lapse();
        state.take_promise(self.number) || self.kept.load(Ordering::Relaxed)
    }

    /// The request has had a permit.
    pub(super) fn keep(&self) {
        self.kept.store(true, Ordering::Relaxed);
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut state = self.queue.lock();
        if state.take_promise(self.number) {
            state.forget(self.client);
        }
    }
}

/// One that asks for a permit: a client, with the place that its request was promised.
#[derive(Debug, Clone, Default)]
pub struct Asker {
    /// The client.
    pub client: ClientId,
    /// The promise; one of another queue counts for nothing.
    pub place: Option<Arc<Place>>,
}

impl From<ClientId> for Asker {
    fn from(client: ClientId) -> Self {
        Self { client, place: None }
    }
}

/// The promises that stand, oldest first.
#[derive(Debug, Default)]
pub(super) struct Promises {
    standing: VecDeque<Promise>,
}

#[derive(Debug)]
struct Promise {
    number: u64,
    client: ClientId,
    until: Instant,
}

impl Promises {
    pub(super) fn len(&self) -> usize {
        self.standing.len()
    }
}

impl State {
    /// Promises a permit. Returns the number of the promise, and the task that was dropped to make room.
    pub(super) fn promise(
        &mut self,
        client: ClientId,
        settings: &QueueSettings,
    ) -> Result<(u64, Option<Waiter>), Refused> {
        if let Some(why) = self.refuses(client, settings) {
            self.forget(client);
            return Err(why);
        }
        let dropped = if self.is_full(settings) { self.drop_of_most() } else { None };
        self.last += 1;
        let until = Instant::now() + LASTS;
        self.promises.standing.push_back(Promise { number: self.last, client, until });
        self.shares.entry(client).or_default().promised += 1;
        Ok((self.last, dropped))
    }

    /// Ends the promise of this number, if it stands.
    fn take_promise(&mut self, number: u64) -> bool {
        let standing = &mut self.promises.standing;
        let found = standing.iter().position(|promise| promise.number == number);
        let Some(promise) = found.and_then(|found| standing.remove(found)) else { return false };
        self.release(promise.client);
        true
    }

    /// Ends the promises that have stood for long enough.
    pub(super) fn lapse(&mut self) {
        let now = Instant::now();
        while let Some(promise) = self.promises.standing.pop_front_if(|promise| promise.until <= now) {
            self.release(promise.client);
            self.forget(promise.client);
        }
    }

    fn release(&mut self, client: ClientId) {
        if let Some(share) = self.shares.get_mut(&client) {
            share.promised -= 1;
        }
    }
}
