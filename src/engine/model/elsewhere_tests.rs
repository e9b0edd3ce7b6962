//! Networks of a fit that another process trains: the model is the same, bit for bit.

use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

use super::tests::{data, settings};
use super::{FitData, FitSettings, Fitted, ModelKind, fit, fit_resumable};
use crate::EngineError;
use crate::checkpoint::CheckpointStore;
use crate::progress::unwatched;

/// Where both processes keep their states.
type States = Arc<Mutex<BTreeMap<String, Vec<u8>>>>;

/// What becomes of a network that is given away.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Fate {
    /// The other process ends it.
    Ends,
    /// The other process leaves it before its end.
    ComesBack,
    /// The other process never begins, and is missed after a while.
    IsForgotten,
}

/// The fit's own process: gives a network away at some share of it, to a helper that works at once.
struct Giver<'a> {
    states: States,
    part: &'a str,
    at: f64,
    fate: Fate,
    away: AtomicBool,
    gave: AtomicUsize,
    /// How often it was asked since.
    looks: AtomicUsize,
    work: (&'a FitData, &'a FitSettings),
}

impl CheckpointStore for Giver<'_> {
    fn load(&self, part: &str) -> Option<Vec<u8>> {
        self.states.lock().unwrap().get(part).cloned()
    }

    fn is_due(&self, _: &str, _: bool) -> bool {
        false
    }

    fn save(&self, part: &str, state: Vec<u8>) {
        self.states.lock().unwrap().insert(part.into(), state);
    }

    fn announce(&self, parts: &[String]) {
        assert_eq!(parts, ["seed 0", "seed 1", "seed 2"]);
        if self.at == 0.0 {
            // Before it has begun.
            self.away.store(true, Ordering::SeqCst);
            self.gave.fetch_add(1, Ordering::SeqCst);
            self.help();
        }
    }

    fn elsewhere(&self, part: &str, done: f64) -> Option<f64> {
        if part != self.part {
            return None;
        }
        if self.gave.load(Ordering::SeqCst) == 0 && done >= self.at && self.at > 0.0 {
            self.gave.fetch_add(1, Ordering::SeqCst);
            self.away.store(true, Ordering::SeqCst);
        }
        let away = self.away.load(Ordering::SeqCst);
        if away && self.fate == Fate::IsForgotten && self.looks.fetch_add(1, Ordering::SeqCst) == 2 {
            self.away.store(false, Ordering::SeqCst);
        }
        away.then_some(self.at)
    }

    fn hand_over(&self, part: &str) {
        assert_eq!(part, self.part);
        self.help();
    }
}

impl Giver<'_> {
    fn help(&self) {
        let leaves_at = match self.fate {
            Fate::Ends => 1.0,
            Fate::ComesBack => 0.7,
            Fate::IsForgotten => return,
        };
        let states = Arc::clone(&self.states);
        let helper = Helper { states, part: self.part, leaves_at, left: AtomicBool::new(false) };
        let watch = |_: crate::Progress<'_>| match helper.left.load(Ordering::SeqCst) {
            true => ControlFlow::Break(()),
            false => ControlFlow::Continue(()),
        };
        let (data, settings) = self.work;
        let helped = fit_resumable(data, settings, &helper, &watch);
        assert_eq!(helped, Err(EngineError::Cancelled), "a helper makes no model");
        self.away.store(false, Ordering::SeqCst);
    }
}

/// The other process: trains one network from where it was.
struct Helper<'a> {
    states: States,
    part: &'a str,
    leaves_at: f64,
    left: AtomicBool,
}

impl CheckpointStore for Helper<'_> {
    fn load(&self, part: &str) -> Option<Vec<u8>> {
        self.states.lock().unwrap().get(part).cloned()
    }

    fn is_due(&self, _: &str, done: bool) -> bool {
        done
    }

    fn save(&self, part: &str, state: Vec<u8>) {
        assert_eq!(part, self.part);
        self.states.lock().unwrap().insert(part.into(), state);
    }

    fn elsewhere(&self, part: &str, done: f64) -> Option<f64> {
        if part != self.part {
            return Some(0.0);
        }
        if done >= self.leaves_at {
            self.left.store(true, Ordering::SeqCst);
        }
        None
    }
}

/// A fit of three seeds; it is slow enough to be left in its middle.
fn three_seeds() -> FitSettings {
    let mut settings = settings(ModelKind::Hybrid2);
    settings.lstm.seeds = Some(vec![1, 2, 3]);
    settings
}

fn helped(part: &str, at: f64, fate: Fate) -> Fitted {
    let (data, settings) = (data(), three_seeds());
    let giver = Giver {
        states: States::default(),
        part,
        at,
        fate,
        away: AtomicBool::new(false),
        gave: AtomicUsize::new(0),
        looks: AtomicUsize::new(0),
        work: (&data, &settings),
    };
    let said = AtomicBool::new(false);
    let watch = |progress: crate::Progress<'_>| {
        said.fetch_or(progress.stage.ends_with("3 seeds, 1 of them at other workers"), Ordering::SeqCst);
        unwatched(progress)
    };
    let fitted = fit_resumable(&data, &settings, &giver, &watch).expect("a model");
    assert_eq!(giver.gave.into_inner(), 1, "it was given away");
    assert!(fate != Fate::IsForgotten || said.into_inner(), "the stage says so");
    fitted
}

#[test]
fn a_fit_is_the_same_wherever_its_networks_are_trained() {
    let whole = fit(&data(), &three_seeds(), &unwatched).expect("a model");
    let cases = [
        ("seed 0", 0.0, Fate::Ends),
        ("seed 1", 0.3, Fate::Ends),
        ("seed 2", 0.5, Fate::ComesBack),
        ("seed 1", 0.4, Fate::IsForgotten),
    ];
    for (part, at, fate) in cases {
        assert_eq!(helped(part, at, fate), whole, "{part} at {at}: {fate:?}");
    }
}
