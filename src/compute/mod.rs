//! The only door from async code to work for the processor: turns, blocking threads, spans.
//!
//! Each class of work has its own turns ([`turns`]) and its own pool of threads, so that a fit that keeps
//! every core busy never holds a thread that a prediction needs, and a prediction of an hour none
//! that one of seconds waits for: it is the system that shares the cores between them. Threads of
//! long work and of fits have lower priorities: they get what the others leave.

pub mod turns;

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::time::Duration;

use rayon::{ThreadPool, ThreadPoolBuilder};

use turns::{Refused, TurnSettings, Turns, Who};

/// Niceness of threads that fit. Ten of nineteen: against a thread of normal priority they get
/// about a tenth of a core, and all of it when nobody else wants it.
const FIT_NICENESS: i32 = 10;

/// Niceness of threads that do long work for an answer: about a quarter of a core against a thread
/// of normal priority.
const LONG_NICENESS: i32 = 5;

/// Most values that work may go over and still count as short: a minute of a large rig, whose
/// parsing, prediction or damage takes some tens of milliseconds.
const SHORT_VALUES: usize = 1 << 20;

/// What kind of work it is; each has permits and threads of its own.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Class {
    /// An answer that somebody waits for: predictions, damage, parsing.
    Predict,
    /// The same when it takes long: whoever asks for an hour of signal can wait a little more.
    Long,
    /// A fit: long, and at a lower priority.
    Fit,
}

/// How much may happen at once.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ComputeSettings {
    /// Predictions and other short work.
    pub predict: TurnSettings,
    /// Threads that share it.
    pub predict_threads: usize,
    /// Long work; each piece holds an hour of signal or more in memory.
    pub long: TurnSettings,
    /// Threads that share it.
    pub long_threads: usize,
    /// Fits at once; as many as there are job workers, which are their only queue.
    pub fit_permits: usize,
    /// Threads that share the work of fits.
    pub fit_threads: usize,
}

impl Class {
    /// Class of work for an answer that goes over so many values (samples of all channels).
    pub fn of_values(values: usize) -> Self {
        if values > SHORT_VALUES { Self::Long } else { Self::Predict }
    }

    /// Class of work on so many bytes that hold values.
    pub fn of_bytes(bytes: usize) -> Self {
        Self::of_values(bytes / size_of::<f64>())
    }

    /// The longer of two.
    #[must_use]
    pub fn or(self, other: Self) -> Self {
        if self == Self::Predict { other } else { self }
    }
}

impl Default for ComputeSettings {
    /// One turn and one thread of each class a core, thirty-two tasks that wait a core, one fit. The
    /// queue of short work is kept short once it has stood for a tenth of a second: some ten
    /// predictions, which then wait for those under way and no more.
    fn default() -> Self {
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let predict = TurnSettings {
            patience: Duration::from_millis(100),
            ..TurnSettings::new(cores, 32 * cores, Duration::from_secs(5))
        };
        Self {
            predict,
            predict_threads: cores,
            long: TurnSettings::new(cores, 32 * cores, Duration::from_secs(30)),
            long_threads: cores,
            fit_permits: 1,
            fit_threads: cores,
        }
    }
}

/// Why work was not done.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ComputeError {
    /// Too much to do: try again later.
    #[error("busy: {0}")]
    Busy(#[from] Refused),
    /// A defect of ours; the message is for the log, not for a client.
    #[error("panicked: {0}")]
    Panicked(String),
    /// Thread pools could not be made, or their threads are gone.
    #[error("threads: {0}")]
    Threads(String),
}

/// The door. Clones share it.
#[derive(Debug, Clone)]
pub struct Compute {
    predict: Arc<Lane>,
    long: Arc<Lane>,
    fit: Arc<Lane>,
}

/// Turns and threads of one class.
#[derive(Debug)]
struct Lane {
    turns: Arc<Turns>,
    threads: ThreadPool,
}

impl Compute {
    /// Makes the thread pools.
    ///
    /// # Errors
    /// [`ComputeError::Threads`] when the system gives no threads.
    pub fn new(settings: &ComputeSettings) -> Result<Self, ComputeError> {
        let lane = |name, turns, threads: usize, niceness| -> Result<Arc<Lane>, ComputeError> {
            let threads = ThreadPoolBuilder::new()
                .num_threads(threads.max(1))
                .thread_name(move |i| format!("{name}-{i}"))
                .start_handler(move |_| lower_priority(niceness))
                .build()
                .map_err(|error| ComputeError::Threads(error.to_string()))?;
            Ok(Arc::new(Lane { turns: Turns::new(name, turns), threads }))
        };
        let s = settings;
        let fits = TurnSettings::new(s.fit_permits, usize::MAX, Duration::MAX);
        Ok(Self {
            predict: lane("predict", s.predict.clone(), s.predict_threads, 0)?,
            long: lane("long", s.long.clone(), s.long_threads, LONG_NICENESS)?,
            fit: lane("fit", fits, s.fit_threads, FIT_NICENESS)?,
        })
    }

    /// Does `work` of `who` on the threads of its class, inside the current tracing span, and waits.
    /// Work that has begun goes on, and keeps its turn, when the caller goes away.
    ///
    /// # Errors
    /// [`ComputeError::Busy`], at once when too many wait; [`ComputeError::Panicked`].
    pub async fn run<T, F>(&self, class: Class, who: Who, work: F) -> Result<T, ComputeError>
    where
        T: Send + 'static,
        F: FnOnce() -> T + Send + 'static,
    {
        let lane = Arc::clone(self.lane(class));
        let turn = lane.turns.take(who).await?;
        let span = tracing::Span::current();
        let task = tokio::task::spawn_blocking(move || {
            let _turn = turn;
            let inside = || span.in_scope(|| catch_unwind(AssertUnwindSafe(work)));
            lane.threads.install(inside)
        });
        match task.await {
            Ok(Ok(done)) => Ok(done),
            Ok(Err(panic)) => Err(ComputeError::Panicked(message(panic.as_ref()))),
            Err(error) => Err(ComputeError::Threads(error.to_string())),
        }
    }

    /// Turns of a class.
    pub fn turns(&self, class: Class) -> &Turns {
        &self.lane(class).turns
    }

    fn lane(&self, class: Class) -> &Arc<Lane> {
        match class {
            Class::Predict => &self.predict,
            Class::Long => &self.long,
            Class::Fit => &self.fit,
        }
    }
}

/// Lowers the priority of the calling thread (on Linux niceness belongs to the thread). Elsewhere,
/// or where it is forbidden, all compete as equals.
fn lower_priority(niceness: i32) {
    #[cfg(target_os = "linux")]
    if niceness > 0
        && let Err(error) = rustix::process::getpriority_process(None)
            .and_then(|own| rustix::process::setpriority_process(None, own.max(niceness)))
    {
        tracing::warn!(%error, "threads of fits and of long work keep their normal priority");
    }
    #[cfg(not(target_os = "linux"))]
    let _ = niceness;
}

/// What a panic said.
fn message(panic: &(dyn Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
    text.or_else(|| panic.downcast_ref::<String>().cloned()).unwrap_or_else(|| "no message".into())
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc;
    use std::time::Duration;

    use super::*;

    fn compute(permits: usize, queue: usize) -> Compute {
        let turns = TurnSettings::new(permits, queue, Duration::from_secs(60));
        Compute::new(&ComputeSettings {
            predict: turns.clone(),
            predict_threads: 2,
            long: turns,
            long_threads: 2,
            fit_permits: 1,
            fit_threads: 1,
        })
        .unwrap()
    }

    #[tokio::test]
    async fn work_beyond_the_queue_is_told_busy_at_once() {
        let compute = compute(1, 1);
        let (release, gate) = mpsc::channel::<()>();
        let run = |work: Box<dyn FnOnce() + Send>| {
            let compute = compute.clone();
            tokio::spawn(async move { compute.run(Class::Predict, None, work).await })
        };
        let depth = || {
            let (_, in_use, waiting) = compute.turns(Class::Predict).depth();
            (in_use, waiting)
        };
        let first = run(Box::new(move || gate.recv().unwrap()));
        while depth() != (1, 0) {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
        let second = run(Box::new(|| ()));
        while depth() != (1, 1) {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
        let third = compute.run(Class::Predict, None, || ()).await;
        assert_eq!(third, Err(ComputeError::Busy(Refused::Full)));
        // Fits have turns of their own.
        assert_eq!(compute.run(Class::Fit, None, || 7).await, Ok(7));
        // One that gives up waiting makes room.
        second.abort();
        assert!(second.await.unwrap_err().is_cancelled());
        assert_eq!(depth(), (1, 0));
        release.send(()).unwrap();
        first.await.unwrap().unwrap();
        assert_eq!(compute.run(Class::Predict, None, || 7).await, Ok(7));
    }

    #[tokio::test]
    async fn work_whose_caller_has_gone_keeps_its_turn_until_it_ends() {
        let compute = compute(1, 1);
        let (release, gate) = mpsc::channel::<()>();
        let (started, at_work) = mpsc::channel::<()>();
        let work = move || {
            started.send(()).unwrap();
            gate.recv().unwrap();
        };
        let task = tokio::spawn({
            let compute = compute.clone();
            async move { compute.run(Class::Predict, None, work).await }
        });
        tokio::task::spawn_blocking(move || at_work.recv().unwrap()).await.unwrap();
        task.abort();
        assert!(task.await.unwrap_err().is_cancelled());
        assert_eq!(compute.turns(Class::Predict).depth().1, 1);
        release.send(()).unwrap();
        assert_eq!(compute.run(Class::Predict, None, || 7).await, Ok(7));
    }

    #[tokio::test]
    async fn a_panic_is_an_error_and_its_permit_comes_back() {
        let compute = compute(1, 0);
        let panicked = compute.run(Class::Predict, None, || -> () { panic!("a defect") }).await;
        assert_eq!(panicked, Err(ComputeError::Panicked("a defect".into())));
        assert_eq!(compute.run(Class::Predict, None, || 1).await, Ok(1));
    }

    #[tokio::test]
    async fn short_work_is_done_while_long_work_holds_all_its_permits_and_threads() {
        let compute = compute(2, 8);
        // Each piece of long work keeps both threads of its class until it is let go.
        let (started, at_work) = mpsc::channel::<()>();
        let gates: Vec<_> = (0..2)
            .map(|_| {
                let (started, compute) = (started.clone(), compute.clone());
                let (release, gate) = mpsc::channel::<()>();
                let work = move || {
                    started.send(()).unwrap();
                    gate.recv().unwrap();
                };
                (release, tokio::spawn(async move { compute.run(Class::Long, None, work).await }))
            })
            .collect();
        tokio::task::spawn_blocking(move || (0..2).for_each(|_| at_work.recv().unwrap())).await.unwrap();
        // The third waits for a permit; nobody short does.
        let third = tokio::spawn({
            let compute = compute.clone();
            async move { compute.run(Class::Long, None, || 3).await }
        });
        let join = || rayon::join(|| 1, || 2);
        for _ in 0..3 {
            assert_eq!(compute.run(Class::Predict, None, join).await, Ok((1, 2)));
        }
        assert!(!third.is_finished(), "long work waits for its own kind");
        for (release, task) in gates {
            release.send(()).unwrap();
            task.await.unwrap().unwrap();
        }
        assert_eq!(third.await.unwrap(), Ok(3));
    }

    #[test]
    fn a_minute_is_short_and_an_hour_long() {
        let values = |seconds: usize| seconds * 1000 * (3 + 6);
        assert_eq!(Class::of_values(values(60)), Class::Predict);
        assert_eq!(Class::of_values(values(3600)), Class::Long);
        assert_eq!(Class::of_bytes(8 << 20), Class::Predict);
        assert_eq!(Class::of_bytes((8 << 20) + 8), Class::Long);
        assert_eq!(Class::Long.or(Class::Predict), Class::Long);
        assert_eq!(Class::Predict.or(Class::Long), Class::Long);
        assert_eq!(Class::Predict.or(Class::Predict), Class::Predict);
    }

    #[tokio::test]
    async fn parallel_work_stays_on_the_threads_of_its_class() {
        use rayon::iter::{IntoParallelIterator, ParallelIterator};
        let compute = compute(1, 1);
        let classes = [(Class::Predict, "predict-", 2), (Class::Long, "long-", 2), (Class::Fit, "fit-", 1)];
        for (class, name, threads) in classes {
            let names: Vec<String> = compute
                .run(class, None, || {
                    (0..64)
                        .into_par_iter()
                        .map(|_| std::thread::current().name().unwrap().to_owned())
                        .collect()
                })
                .await
                .unwrap();
            assert!(names.iter().all(|found| found.starts_with(name)), "{names:?}");
            assert_eq!(compute.run(class, None, rayon::current_num_threads).await, Ok(threads));
        }
    }

    #[cfg(target_os = "linux")]
    #[tokio::test]
    async fn long_work_and_fits_run_at_lower_priorities() {
        let compute = compute(1, 1);
        let niceness = || rustix::process::getpriority_process(None).unwrap();
        let own = niceness();
        assert_eq!(compute.run(Class::Predict, None, niceness).await, Ok(own));
        assert_eq!(compute.run(Class::Long, None, niceness).await, Ok(own.max(LONG_NICENESS)));
        assert_eq!(compute.run(Class::Fit, None, niceness).await, Ok(own.max(FIT_NICENESS)));
    }
}
