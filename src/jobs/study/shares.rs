//! The fits of a study, by every worker that has nothing else to do.
//!
//! Where processes share a registry, the worker of a study marks the fit that it is at, and stores what came of each, as
//! checkpoints of the job. Others that help do the same from the other end. Nothing depends on who does what: each fit comes
//! out alike at whichever worker, so that two that begin the same one at the same moment only waste time. A mark that is
//! not renewed belongs to a worker that is gone.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use uuid::Uuid;

use crate::domain::JobId;
use crate::jobs::control::Control;
use crate::jobs::helping::{FRESH, OPENED};
use crate::jobs::problem::JobError;
use crate::storage::{Checkpoint, Store};

/// What tells the fits of a study apart: trial and round, or size and repeat.
pub(super) type Place = (usize, usize);

/// How often a worker looks whether others have ended what is left.
const LOOK_EVERY: Duration = Duration::from_millis(200);

/// Part of the checkpoint that gives this sign.
const OPEN: &str = "shares";

/// Fits that can be shared.
pub(super) trait Fits {
    /// What comes of one.
    type Row: Serialize + DeserializeOwned;

    /// Whether one is done.
    fn has(&self, place: Place) -> bool;

    /// Takes what came of one.
    fn add(&mut self, row: Self::Row);

    /// Does one.
    async fn try_one(&mut self, place: Place) -> Result<Self::Row, JobError>;
}

/// What a worker tells the others of a fit.
#[derive(Debug, Serialize, Deserialize)]
enum Said<R> {
    /// It is at it.
    At(Uuid),
    /// It has ended.
    Done(R),
}

/// The shares of one worker in a study.
#[derive(Clone)]
pub(super) struct Shares<'a> {
    store: &'a Store,
    control: &'a Arc<Control>,
    job: JobId,
    /// Digest of everything that the fits depend on, this machine's instruction set included.
    fits: &'a str,
    own: Uuid,
    /// Whether the study is another worker's.
    helps: bool,
}

impl<'a> Shares<'a> {
    /// Opens the shares of a study; for a helper once they are open.
    ///
    /// # Errors
    /// [`JobError::Stopped`] for a helper that could not help: the study computes something else, as with another
    /// instruction set.
    pub(super) async fn open(
        store: &'a Store,
        control: &'a Arc<Control>,
        job: JobId,
        fits: &'a str,
        helps: bool,
    ) -> Result<Self, JobError> {
        let shares = Self { store, control, job, fits, own: Uuid::new_v4(), helps };
        if helps {
            shares.wait_until_open().await?;
        } else if store.is_shared() {
            shares.keep(OPEN.into(), Vec::new());
        }
        Ok(shares)
    }

    async fn wait_until_open(&self) -> Result<(), JobError> {
        let began = std::time::Instant::now();
        while began.elapsed() < OPENED && self.control.stopped().is_none() {
            if self.store.shares(self.job, self.fits).await?.iter().any(|(part, ..)| part == OPEN) {
                return Ok(());
            }
            tokio::time::sleep(LOOK_EVERY).await;
        }
        Err(JobError::Stopped)
    }

    /// Does all fits, together with others.
    ///
    /// # Errors
    /// The study was stopped, or the store failed.
    pub(super) async fn all<F: Fits>(&self, fits: &mut F, places: &[Place]) -> Result<(), JobError> {
        loop {
            let said = self.said::<F::Row>().await?;
            let mut taken = Vec::new();
            for (place, (said, age)) in said {
                match said {
                    Said::Done(row) if !fits.has(place) => fits.add(row),
                    Said::At(who) if who != self.own && age < FRESH => taken.push(place),
                    _ => {}
                }
            }
            if self.control.stopped().is_some() {
                return Err(JobError::Stopped);
            }
            let left = places.iter().filter(|place| !fits.has(**place));
            let mut free = left.clone().filter(|place| !taken.contains(place));
            // From both ends, so that two seldom meet.
            let next = if self.helps { free.next_back() } else { free.next() };
            if let Some(&place) = next {
                self.begin(place);
                let row = fits.try_one(place).await?;
                self.end(place, &row);
                fits.add(row);
            } else if left.count() == 0 {
                return Ok(());
            } else {
                tokio::time::sleep(LOOK_EVERY).await;
            }
        }
    }

    /// What the workers have said of fits, and how long ago.
    async fn said<R: DeserializeOwned>(&self) -> Result<BTreeMap<Place, (Said<R>, Duration)>, JobError> {
        let shares = self.store.shares(self.job, self.fits).await?;
        let read = shares.into_iter().filter_map(|(part, state, age)| {
            let (one, other) = part.strip_prefix("share ")?.split_once('-')?;
            let place = (one.parse().ok()?, other.parse().ok()?);
            Some((place, (serde_json::from_slice(&state).ok()?, age)))
        });
        Ok(read.collect())
    }

    fn begin(&self, place: Place) {
        if self.store.is_shared() {
            let state = json(&Said::<()>::At(self.own));
            self.control.renew(Some(self.checkpoint(part(place), state)));
        }
    }

    fn end<R: Serialize>(&self, place: Place, row: &R) {
        if self.store.is_shared() {
            self.control.renew(None);
            self.keep(part(place), json(&Said::Done(row)));
        }
    }

    fn keep(&self, part: String, state: Vec<u8>) {
        self.control.keep(self.checkpoint(part, state));
    }

    fn checkpoint(&self, part: String, state: Vec<u8>) -> Checkpoint {
        Checkpoint { part, fits: self.fits.to_owned(), state: state.into() }
    }
}

fn part((one, other): Place) -> String {
    format!("share {one}-{other}")
}

fn json(said: &impl Serialize) -> Vec<u8> {
    serde_json::to_vec(said).expect("a row always serialises")
}
