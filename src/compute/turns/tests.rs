//! Order, refusals and waits.

use std::future::Future;
use std::pin::pin;
use std::task::{Context, Poll, Waker};

use proptest::prelude::*;

use super::*;

fn token(n: u128) -> Who {
    Some(TokenId::from_u128(n))
}

fn turns(permits: usize, queue: usize) -> Arc<Turns> {
    Turns::new("test", TurnSettings::new(permits, queue, Duration::from_secs(60)))
}

/// A task that has asked for a turn, and what it was told so far.
struct Task(std::pin::Pin<Box<dyn Future<Output = Result<Turn, Refused>> + Send>>);

impl Task {
    fn ask(turns: &Arc<Turns>, who: Who) -> Self {
        let turns = Arc::clone(turns);
        let mut task = Self(Box::pin(async move { turns.take(who).await }));
        assert!(task.told().is_none(), "it waits");
        task
    }

    fn told(&mut self) -> Option<Result<Turn, Refused>> {
        match self.0.as_mut().poll(&mut Context::from_waker(Waker::noop())) {
            Poll::Ready(told) => Some(told),
            Poll::Pending => None,
        }
    }
}

/// The turn or refusal that comes at once.
fn at_once(turns: &Arc<Turns>, who: Who) -> Result<Turn, Refused> {
    match pin!(turns.take(who)).poll(&mut Context::from_waker(Waker::noop())) {
        Poll::Ready(told) => told,
        Poll::Pending => panic!("it waits"),
    }
}

#[tokio::test]
async fn a_token_with_one_request_goes_before_the_queue_of_another() {
    let turns = turns(1, 8);
    let first = at_once(&turns, token(1)).unwrap();
    let mut many: Vec<Task> = (0..4).map(|_| Task::ask(&turns, token(1))).collect();
    let mut other = Task::ask(&turns, token(2));
    let mut nobodys = Task::ask(&turns, None);
    assert_eq!(turns.depth(), ("test", 1, 6));
    drop(first);
    let turn = other.told().expect("the other token is next").unwrap();
    assert!(nobodys.told().is_none() && many[0].told().is_none());
    drop(turn);
    let turn = nobodys.told().expect("then who needs no token").unwrap();
    drop(turn);
    // From here on it goes round in turns.
    let mut again = Task::ask(&turns, token(2));
    let turn = many[0].told().expect("the first token is next").unwrap();
    drop(turn);
    let turn = again.told().expect("one turn each").unwrap();
    assert!(many[1].told().is_none());
    drop(turn);
    for task in &mut many[1..] {
        drop(task.told().expect("and then the rest, in order").unwrap());
    }
    assert_eq!(turns.depth(), ("test", 0, 0));
    assert!(turns.lock().shares.is_empty(), "nobody is remembered");
}

#[tokio::test]
async fn a_full_queue_refuses_and_makes_room_for_who_has_less_in_it() {
    let turns = turns(1, 2);
    let first = at_once(&turns, token(1)).unwrap();
    let mut many = [Task::ask(&turns, token(1)), Task::ask(&turns, token(1))];
    assert_eq!(at_once(&turns, token(1)).unwrap_err(), Refused::Full, "nobody else is there");
    assert_eq!(turns.check(token(1)), Err(Refused::Full));
    assert_eq!(turns.check(token(2)), Ok(()));
    let mut other = Task::ask(&turns, token(2));
    assert_eq!(many[1].told().expect("dropped").unwrap_err(), Refused::Share);
    assert_eq!(at_once(&turns, token(1)).unwrap_err(), Refused::Share);
    // Nobody has more than one in it any more: there is no room to be made.
    assert_eq!(at_once(&turns, token(2)).unwrap_err(), Refused::Full);
    drop(first);
    drop(other.told().expect("a turn").unwrap());
    drop(many[0].told().expect("a turn").unwrap());
}

#[tokio::test]
async fn the_longest_wait_ends_and_leaves_no_place_taken() {
    let wait = Duration::from_millis(50);
    let turns = Turns::new("test", TurnSettings::new(1, 4, wait));
    let turn = at_once(&turns, token(1)).unwrap();
    let started = Instant::now();
    assert_eq!(turns.take(token(1)).await.unwrap_err(), Refused::Late);
    assert!(started.elapsed() >= wait);
    let gone = Task::ask(&turns, token(1));
    assert_eq!(turns.depth().2, 1);
    drop(gone);
    assert_eq!(turns.depth().2, 0);
    // A turn that comes to somebody who has just gone goes on to the next.
    let given = Task::ask(&turns, token(1));
    let mut next = Task::ask(&turns, token(1));
    drop(turn);
    assert!(next.told().is_none());
    drop(given);
    assert!(next.told().expect("the next one's").is_ok());
}

#[tokio::test]
async fn a_queue_that_does_not_empty_is_kept_short() {
    let settings = TurnSettings {
        patience: Duration::from_millis(200),
        ..TurnSettings::new(1, 16, Duration::from_secs(60))
    };
    let turns = Turns::new("test", settings);
    let turn = at_once(&turns, token(1)).unwrap();
    let mut burst: Vec<Task> = (0..10).map(|_| Task::ask(&turns, token(1))).collect();
    tokio::time::sleep(Duration::from_millis(250)).await;
    assert_eq!(at_once(&turns, token(1)).unwrap_err(), Refused::Full, "ten wait, two may");
    drop(turn);
    for task in &mut burst {
        drop(task.told().expect("who is in the queue keeps the place").unwrap());
    }
    let turn = at_once(&turns, token(1)).unwrap();
    let burst: Vec<Task> = (0..10).map(|_| Task::ask(&turns, token(1))).collect();
    assert_eq!(burst.len(), 10, "it was empty: the next burst finds all of it");
    drop(turn);
}

#[tokio::test]
async fn one_token_has_at_most_its_number_of_turns() {
    let settings = TurnSettings { per_token: 2, ..TurnSettings::new(3, 4, Duration::from_secs(60)) };
    let turns = Turns::new("test", settings);
    let own = [at_once(&turns, token(1)).unwrap(), at_once(&turns, token(1)).unwrap()];
    let mut third = Task::ask(&turns, token(1));
    let other = at_once(&turns, token(2)).expect("a turn is left for others");
    drop(other);
    assert!(third.told().is_none(), "and stays so");
    drop(own);
    assert!(third.told().expect("its own are back").is_ok());
}

proptest! {
    /// Whoever comes, goes or gives up in whatever order: no turn is lost, none is given twice.
    #[test]
    fn turns_are_neither_lost_nor_made(
        permits in 1_usize..4, per_token in 1_usize..4, queue in 0_usize..6,
        moves in prop::collection::vec((0_u8..3, 0_u128..4, any::<prop::sample::Index>()), 1..200),
    ) {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
        let _inside = runtime.enter();
        let settings =
            TurnSettings { per_token, ..TurnSettings::new(permits, queue, Duration::from_secs(600)) };
        let turns = Turns::new("test", settings);
        let mut tasks: Vec<(u128, Task)> = Vec::new();
        let mut held: Vec<(u128, Turn)> = Vec::new();
        for (what, who, which) in moves {
            match what {
                0 => {
                    let turns = Arc::clone(&turns);
                    let task = Task(Box::pin(async move { turns.take(token(who)).await }));
                    tasks.push((who, task));
                }
                1 if !held.is_empty() => drop(held.swap_remove(which.index(held.len()))),
                2 if !tasks.is_empty() => drop(tasks.swap_remove(which.index(tasks.len()))),
                _ => {}
            }
            // One that comes may have dropped one that was looked at before it.
            for _ in 0..2 {
                let mut i = 0;
                while i < tasks.len() {
                    match tasks[i].1.told() {
                        None => i += 1,
                        Some(told) => {
                            let (who, _) = tasks.remove(i);
                            held.extend(told.ok().map(|turn| (who, turn)));
                        }
                    }
                }
            }
            let (_, in_use, waiting) = turns.depth();
            prop_assert_eq!(in_use, held.len());
            prop_assert_eq!(waiting, tasks.len());
            prop_assert!(in_use <= permits && waiting <= queue);
            let own = |who: u128| held.iter().filter(|(other, _)| *other == who).count();
            prop_assert!((0..4).all(|who| own(who) <= per_token));
            // Nobody waits who could have a turn.
            prop_assert!(in_use == permits || tasks.iter().all(|(who, _)| own(*who) == per_token));
        }
        drop(tasks);
        drop(held);
        prop_assert_eq!(turns.depth(), ("test", 0, 0));
        prop_assert!(turns.lock().shares.is_empty());
    }
}
