//! Order, refusals and waits.

use std::future::Future;
use std::pin::pin;
use std::task::{Context, Poll, Waker};

use proptest::prelude::*;

use super::*;

fn token(n: u128) -> ClientId {
    Some(TokenId::from_u128(n))
}

fn queue(permits: usize, queue: usize) -> Arc<FairQueue> {
    FairQueue::new("test", QueueSettings::new(permits, queue, Duration::from_secs(60)))
}

/// A task that has asked for a permit.
struct Task(std::pin::Pin<Box<dyn Future<Output = Result<Permit, Refused>> + Send>>);

impl Task {
    fn ask(queue: &Arc<FairQueue>, client: ClientId) -> Self {
        let queue = Arc::clone(queue);
        let mut task = Self(Box::pin(async move { queue.acquire(client).await }));
        assert!(task.told().is_none(), "it waits");
        task
    }

    fn told(&mut self) -> Option<Result<Permit, Refused>> {
        match self.0.as_mut().poll(&mut Context::from_waker(Waker::noop())) {
            Poll::Ready(told) => Some(told),
            Poll::Pending => None,
        }
    }
}

/// The permit or refusal that comes at once.
fn at_once(queue: &Arc<FairQueue>, client: ClientId) -> Result<Permit, Refused> {
    match pin!(queue.acquire(client)).poll(&mut Context::from_waker(Waker::noop())) {
        Poll::Ready(told) => told,
        Poll::Pending => panic!("it waits"),
    }
}

#[tokio::test]
async fn a_token_with_one_request_goes_before_the_queue_of_another() {
    let queue = queue(1, 8);
    let first = at_once(&queue, token(1)).unwrap();
    let mut many: Vec<Task> = (0..4).map(|_| Task::ask(&queue, token(1))).collect();
    let mut other = Task::ask(&queue, token(2));
    let mut nobodys = Task::ask(&queue, None);
    assert_eq!(queue.depth(), ("test", 1, 6));
    drop(first);
    let permit = other.told().expect("the other token is next").unwrap();
    assert!(nobodys.told().is_none() && many[0].told().is_none());
    drop(permit);
    let permit = nobodys.told().expect("then who needs no token").unwrap();
    drop(permit);
    // From here on the tokens take turns.
    let mut again = Task::ask(&queue, token(2));
    let permit = many[0].told().expect("the first token is next").unwrap();
    drop(permit);
    let permit = again.told().expect("one permit each").unwrap();
    assert!(many[1].told().is_none());
    drop(permit);
    for task in &mut many[1..] {
        drop(task.told().expect("and then the rest, in order").unwrap());
    }
    assert_eq!(queue.depth(), ("test", 0, 0));
    assert!(queue.lock().shares.is_empty(), "nobody is remembered");
}

#[tokio::test]
async fn a_full_queue_refuses_and_makes_room_for_who_has_less_in_it() {
    let queue = queue(1, 2);
    let first = at_once(&queue, token(1)).unwrap();
    let mut many = [Task::ask(&queue, token(1)), Task::ask(&queue, token(1))];
    assert_eq!(at_once(&queue, token(1)).unwrap_err(), Refused::Full, "nobody else is there");
    assert_eq!(queue.check(token(1)), Err(Refused::Full));
    assert_eq!(queue.check(token(2)), Ok(()));
    let mut other = Task::ask(&queue, token(2));
    assert_eq!(many[1].told().expect("dropped").unwrap_err(), Refused::Share);
    assert_eq!(at_once(&queue, token(1)).unwrap_err(), Refused::Share);
    // No token has more than one task in the queue any more: nothing can be dropped.
    assert_eq!(at_once(&queue, token(2)).unwrap_err(), Refused::Full);
    drop(first);
    drop(other.told().expect("a permit").unwrap());
    drop(many[0].told().expect("a permit").unwrap());
}

#[tokio::test]
async fn the_longest_wait_ends_and_leaves_no_place_taken() {
    let wait = Duration::from_millis(50);
    let queue = FairQueue::new("test", QueueSettings::new(1, 4, wait));
    let permit = at_once(&queue, token(1)).unwrap();
    let started = Instant::now();
    assert_eq!(queue.acquire(token(1)).await.unwrap_err(), Refused::Late);
    assert!(started.elapsed() >= wait);
    let gone = Task::ask(&queue, token(1));
    assert_eq!(queue.depth().2, 1);
    drop(gone);
    assert_eq!(queue.depth().2, 0);
    // A permit for a task that has just gone away passes to the next.
    let given = Task::ask(&queue, token(1));
    let mut next = Task::ask(&queue, token(1));
    drop(permit);
    assert!(next.told().is_none());
    drop(given);
    assert!(next.told().expect("the next one's").is_ok());
}

#[tokio::test]
async fn a_queue_that_does_not_empty_is_kept_short() {
    let settings = QueueSettings {
        patience: Duration::from_millis(200),
        ..QueueSettings::new(1, 16, Duration::from_secs(60))
    };
    let queue = FairQueue::new("test", settings);
    let permit = at_once(&queue, token(1)).unwrap();
    let mut burst: Vec<Task> = (0..10).map(|_| Task::ask(&queue, token(1))).collect();
    tokio::time::sleep(Duration::from_millis(250)).await;
    assert_eq!(at_once(&queue, token(1)).unwrap_err(), Refused::Full, "ten wait, two may");
    drop(permit);
    for task in &mut burst {
        drop(task.told().expect("who is in the queue keeps the place").unwrap());
    }
    // That it was empty for a moment is no sign: nine of ten that came since were refused.
    let permit = at_once(&queue, token(1)).unwrap();
    let mut two: Vec<Task> = (0..2).map(|_| Task::ask(&queue, token(1))).collect();
    assert_eq!(at_once(&queue, token(1)).unwrap_err(), Refused::Full);
    drop(permit);
    for task in &mut two {
        drop(task.told().expect("in order").unwrap());
    }
}

#[tokio::test]
async fn a_queue_is_long_again_once_hardly_a_task_is_refused() {
    let settings = QueueSettings {
        patience: Duration::from_millis(200),
        ..QueueSettings::new(1, 16, Duration::from_secs(60))
    };
    let queue = FairQueue::new("test", settings);
    let permit = at_once(&queue, token(1)).unwrap();
    let short: Vec<Task> = (0..2).map(|_| Task::ask(&queue, token(1))).collect();
    tokio::time::sleep(Duration::from_millis(250)).await;
    for _ in 0..10 {
        assert_eq!(at_once(&queue, token(1)).unwrap_err(), Refused::Full);
    }
    drop((permit, short));
    // In the next second one task in ten is refused.
    tokio::time::sleep(Duration::from_millis(1100)).await;
    let permit = at_once(&queue, token(1)).unwrap();
    for _ in 0..10 {
        let mut short: Vec<Task> = (0..2).map(|_| Task::ask(&queue, token(1))).collect();
        assert!(short.iter_mut().all(|task| task.told().is_none()));
    }
    let short: Vec<Task> = (0..2).map(|_| Task::ask(&queue, token(1))).collect();
    assert_eq!(at_once(&queue, token(1)).unwrap_err(), Refused::Full);
    drop((permit, short));
    tokio::time::sleep(Duration::from_millis(1100)).await;
    let permit = at_once(&queue, token(1)).unwrap();
    let burst: Vec<Task> = (0..10).map(|_| Task::ask(&queue, token(1))).collect();
    assert_eq!(burst.len(), 10);
    drop(permit);
}

#[tokio::test]
async fn a_queue_takes_as_many_tasks_as_its_patience_has_time_for_or_a_burst_has() {
    for (work_ms, room) in [(4, 25), (50, 16), (1, 64)] {
        let settings = QueueSettings {
            patience: Duration::from_millis(100),
            ..QueueSettings::new(1, 64, Duration::from_secs(60))
        };
        let queue = FairQueue::new("test", settings);
        queue.lock().crowding.worked(Duration::from_millis(work_ms));
        let permit = at_once(&queue, None).unwrap();
        let waiting: Vec<Task> = (0..room).map(|_| Task::ask(&queue, None)).collect();
        assert_eq!(at_once(&queue, None).unwrap_err(), Refused::Full, "{room} tasks of {work_ms} ms wait");
        drop((permit, waiting));
    }
}

#[tokio::test]
async fn a_promised_permit_is_not_refused_for_tasks_that_came_later() {
    let queue = queue(1, 1);
    let place = Arc::new(queue.promise(token(1)).expect("one is free"));
    let next = Arc::new(queue.promise(token(1)).expect("one may wait"));
    assert_eq!(queue.promise(token(1)).unwrap_err(), Refused::Full);
    assert_eq!(queue.check(token(1)), Err(Refused::Full));
    let asker = |place: &Arc<Place>| Asker { client: token(1), place: Some(Arc::clone(place)) };
    let ask = |place: &Arc<Place>| {
        let (queue, asker) = (Arc::clone(&queue), asker(place));
        let mut task = Task(Box::pin(async move { queue.acquire(asker).await }));
        (task.told(), task)
    };
    let permit = ask(&place).0.expect("at once").unwrap();
    let (told, mut waiting) = ask(&next);
    assert!(told.is_none());
    assert_eq!(at_once(&queue, token(1)).unwrap_err(), Refused::Full);
    drop(permit);
    let permit = waiting.told().expect("its permit").unwrap();
    let ordinary = Task::ask(&queue, token(1));
    // The first request needs a second permit. The queue is full, but work on it was begun.
    let (told, mut again) = ask(&place);
    assert!(told.is_none());
    drop((ordinary, permit));
    drop(again.told().expect("its second permit").unwrap());
    drop((place, next));
    assert!(queue.lock().shares.is_empty(), "nobody is remembered");
}

#[tokio::test]
async fn a_promise_ends_with_its_request_and_lapses_for_a_slow_sender() {
    let queue = queue(1, 0);
    let gone = queue.promise(token(1)).unwrap();
    assert_eq!(queue.promise(token(2)).unwrap_err(), Refused::Full);
    drop(gone);
    let slow = Arc::new(queue.promise(token(2)).unwrap());
    assert_eq!(queue.promise(token(1)).unwrap_err(), Refused::Full);
    tokio::time::sleep(Duration::from_millis(150)).await;
    let permit = at_once(&queue, token(1)).expect("the slow sender keeps nobody waiting");
    let asker = Asker { client: token(2), place: Some(slow) };
    assert_eq!(queue.acquire(asker).await.unwrap_err(), Refused::Full, "and asks again like all others");
    drop(permit);
    assert!(queue.lock().shares.is_empty(), "nobody is remembered");
}

#[tokio::test]
async fn a_promise_makes_room_as_a_task_does() {
    let queue = queue(1, 2);
    let _permit = at_once(&queue, token(1)).unwrap();
    let mut many = [Task::ask(&queue, token(1)), Task::ask(&queue, token(1))];
    let place = queue.promise(token(2)).expect("it has less in the queue");
    assert_eq!(many[1].told().expect("dropped").unwrap_err(), Refused::Share);
    assert!(many[0].told().is_none());
    drop(place);
}

#[tokio::test]
async fn one_token_has_at_most_its_number_of_turns() {
    let settings = QueueSettings { per_token: 2, ..QueueSettings::new(3, 4, Duration::from_secs(60)) };
    let queue = FairQueue::new("test", settings);
    let own = [at_once(&queue, token(1)).unwrap(), at_once(&queue, token(1)).unwrap()];
    let mut third = Task::ask(&queue, token(1));
    let other = at_once(&queue, token(2)).expect("a permit is left for others");
    drop(other);
    assert!(third.told().is_none(), "and stays so");
    drop(own);
    assert!(third.told().expect("its own are back").is_ok());
}

proptest! {
    /// Whatever the order in which tasks come, are promised permits, end or give up, no permit is lost and none is
    /// given twice.
    #[test]
    fn turns_are_neither_lost_nor_made(
        permits in 1_usize..4, per_token in 1_usize..4, room in 0_usize..6,
        moves in prop::collection::vec((0_u8..6, 0_u128..4, any::<prop::sample::Index>()), 1..200),
    ) {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
        let _inside = runtime.enter();
        let settings =
            QueueSettings { per_token, ..QueueSettings::new(permits, room, Duration::from_secs(600)) };
        let queue = FairQueue::new("test", settings);
        let mut tasks: Vec<(u128, Task)> = Vec::new();
        let mut held: Vec<(u128, Permit)> = Vec::new();
        let mut places: Vec<(u128, Arc<Place>)> = Vec::new();
        let mut promised = 0;
        for (what, client, which) in moves {
            match what {
                0 => {
                    let queue = Arc::clone(&queue);
                    let task = Task(Box::pin(async move { queue.acquire(token(client)).await }));
                    tasks.push((client, task));
                }
                1 if !held.is_empty() => drop(held.swap_remove(which.index(held.len()))),
                2 if !tasks.is_empty() => drop(tasks.swap_remove(which.index(tasks.len()))),
                3 => places.extend(queue.promise(token(client)).ok().map(|place| (client, Arc::new(place)))),
                4 if !places.is_empty() => {
                    promised += 1;
                    let (client, place) = places[which.index(places.len())].clone();
                    let (queue, asker) = (Arc::clone(&queue), Asker { client: token(client), place: Some(place) });
                    tasks.push((client, Task(Box::pin(async move { queue.acquire(asker).await }))));
                }
                5 if !places.is_empty() => drop(places.swap_remove(which.index(places.len()))),
                _ => {}
            }
            // A new task may have dropped one that was polled before it.
            for _ in 0..2 {
                let mut i = 0;
                while i < tasks.len() {
                    match tasks[i].1.told() {
                        None => i += 1,
                        Some(told) => {
                            let (client, _) = tasks.remove(i);
                            held.extend(told.ok().map(|permit| (client, permit)));
                        }
                    }
                }
            }
            let (_, in_use, waiting) = queue.depth();
            prop_assert_eq!(in_use, held.len());
            prop_assert_eq!(waiting, tasks.len());
            prop_assert!(in_use <= permits && waiting <= room + promised);
            let own = |client: u128| held.iter().filter(|(other, _)| *other == client).count();
            prop_assert!((0..4).all(|client| own(client) <= per_token));
            // No task waits that could have a permit.
            prop_assert!(in_use == permits || tasks.iter().all(|(client, _)| own(*client) == per_token));
        }
        drop(tasks);
        drop(held);
        drop(places);
        prop_assert_eq!(queue.depth(), ("test", 0, 0));
        prop_assert!(queue.lock().shares.is_empty());
    }
}
