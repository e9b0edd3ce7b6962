//! The only door from async code to work for the processor: permits, blocking threads, spans.
//!
//! Each class of work has its own permits and its own pool of threads, so that a fit that keeps
//! every core busy never holds a thread that a prediction needs, and a prediction of an hour none
//! that one of seconds waits for: it is the system that shares the cores between them. Threads of
//! long work and of fits have lower priorities: they get what the others leave.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::{ThreadPool, ThreadPoolBuilder};
use tokio::sync::Semaphore;

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
    /// Predictions at once.
    pub predict_permits: usize,
    /// Predictions that may wait; more are told that the service is busy.
    pub predict_queue: usize,
    /// Threads that share the work of predictions.
    pub predict_threads: usize,
    /// Pieces of long work at once; each holds an hour of signal or more in memory.
    pub long_permits: usize,
    /// Pieces of long work that may wait.
    pub long_queue: usize,
    /// Threads that share long work.
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
    /// One prediction, one piece of long work and one thread of each class a core, thirty-two
    /// waiting of each a core, one fit.
    fn default() -> Self {
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        Self {
            predict_permits: cores,
            predict_queue: 32 * cores,
            predict_threads: cores,
            long_permits: cores,
            long_queue: 32 * cores,
            long_threads: cores,
            fit_permits: 1,
            fit_threads: cores,
        }
    }
}

/// Why work was not done.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ComputeError {
    /// Too many wait already: try again later.
    #[error("busy: {waiting} tasks wait already")]
    Busy {
        /// How many.
        waiting: usize,
    },
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

/// Permits and threads of one class.
#[derive(Debug)]
struct Lane {
    permits: Arc<Semaphore>,
    /// Tasks that wait for a permit, and how many may.
    waiting: AtomicUsize,
    queue: usize,
    threads: ThreadPool,
}

impl Compute {
    /// Makes the thread pools.
    ///
    /// # Errors
    /// [`ComputeError::Threads`] when the system gives no threads.
    pub fn new(settings: &ComputeSettings) -> Result<Self, ComputeError> {
        let lane = |permits: usize, queue, threads: usize, name: &'static str, niceness: i32| {
            let threads = ThreadPoolBuilder::new()
                .num_threads(threads.max(1))
                .thread_name(move |i| format!("{name}-{i}"))
                .start_handler(move |_| lower_priority(niceness))
                .build()
                .map_err(|error| ComputeError::Threads(error.to_string()))?;
            let permits = Arc::new(Semaphore::new(permits.max(1)));
            Ok(Arc::new(Lane { permits, waiting: AtomicUsize::new(0), queue, threads }))
        };
        let s = settings;
        Ok(Self {
            predict: lane(s.predict_permits, s.predict_queue, s.predict_threads, "predict", 0)?,
            long: lane(s.long_permits, s.long_queue, s.long_threads, "long", LONG_NICENESS)?,
            fit: lane(s.fit_permits, usize::MAX, s.fit_threads, "fit", FIT_NICENESS)?,
        })
    }

    /// Does `work` on the threads of its class, inside the current tracing span, and waits. Work
    /// that has begun goes on, and keeps its permit, when the caller goes away.
    ///
    /// # Errors
    /// [`ComputeError::Busy`] at once when too many wait; [`ComputeError::Panicked`].
    pub async fn run<T, F>(&self, class: Class, work: F) -> Result<T, ComputeError>
    where
        T: Send + 'static,
        F: FnOnce() -> T + Send + 'static,
    {
        let lane = match class {
            Class::Predict => &self.predict,
            Class::Long => &self.long,
            Class::Fit => &self.fit,
        };
        let permit = lane.permit().await?;
        let span = tracing::Span::current();
        let lane = Arc::clone(lane);
        let task = tokio::task::spawn_blocking(move || {
            let _permit = permit;
            let inside = || span.in_scope(|| catch_unwind(AssertUnwindSafe(work)));
            lane.threads.install(inside)
        });
        match task.await {
            Ok(Ok(done)) => Ok(done),
            Ok(Err(panic)) => Err(ComputeError::Panicked(message(panic.as_ref()))),
            Err(error) => Err(ComputeError::Threads(error.to_string())),
        }
    }
}

/// Counts a task as waiting for as long as it does, cancelled ones included.
struct Waiting<'a>(&'a AtomicUsize);

impl Drop for Waiting<'_> {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

impl Lane {
    async fn permit(&self) -> Result<tokio::sync::OwnedSemaphorePermit, ComputeError> {
        let closed = |error: &dyn std::error::Error| ComputeError::Threads(error.to_string());
        if let Ok(permit) = Arc::clone(&self.permits).try_acquire_owned() {
            return Ok(permit);
        }
        let waiting = self.waiting.fetch_add(1, Ordering::Relaxed);
        let _counted = Waiting(&self.waiting);
        if waiting >= self.queue {
            return Err(ComputeError::Busy { waiting });
        }
        Arc::clone(&self.permits).acquire_owned().await.map_err(|error| closed(&error))
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
        Compute::new(&ComputeSettings {
            predict_permits: permits,
            predict_queue: queue,
            predict_threads: 2,
            long_permits: permits,
            long_queue: queue,
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
            tokio::spawn(async move { compute.run(Class::Predict, work).await })
        };
        let first = run(Box::new(move || gate.recv().unwrap()));
        while compute.predict.permits.available_permits() > 0 {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
        let second = run(Box::new(|| ()));
        while compute.predict.waiting.load(Ordering::Relaxed) == 0 {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
        let third = compute.run(Class::Predict, || ()).await;
        assert_eq!(third, Err(ComputeError::Busy { waiting: 1 }));
        // Fits have permits of their own.
        assert_eq!(compute.run(Class::Fit, || 7).await, Ok(7));
        // One that gives up waiting makes room.
        second.abort();
        assert!(second.await.unwrap_err().is_cancelled());
        assert_eq!(compute.predict.waiting.load(Ordering::Relaxed), 0);
        release.send(()).unwrap();
        first.await.unwrap().unwrap();
        assert_eq!(compute.run(Class::Predict, || 7).await, Ok(7));
    }

    #[tokio::test]
    async fn a_panic_is_an_error_and_its_permit_comes_back() {
        let compute = compute(1, 0);
        let panicked = compute.run(Class::Predict, || -> () { panic!("a defect") }).await;
        assert_eq!(panicked, Err(ComputeError::Panicked("a defect".into())));
        assert_eq!(compute.run(Class::Predict, || 1).await, Ok(1));
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
                (release, tokio::spawn(async move { compute.run(Class::Long, work).await }))
            })
            .collect();
        tokio::task::spawn_blocking(move || (0..2).for_each(|_| at_work.recv().unwrap())).await.unwrap();
        // The third waits for a permit; nobody short does.
        let third = tokio::spawn({
            let compute = compute.clone();
            async move { compute.run(Class::Long, || 3).await }
        });
        let join = || rayon::join(|| 1, || 2);
        for _ in 0..3 {
            assert_eq!(compute.run(Class::Predict, join).await, Ok((1, 2)));
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
                .run(class, || {
                    (0..64)
                        .into_par_iter()
                        .map(|_| std::thread::current().name().unwrap().to_owned())
                        .collect()
                })
                .await
                .unwrap();
            assert!(names.iter().all(|found| found.starts_with(name)), "{names:?}");
            assert_eq!(compute.run(class, rayon::current_num_threads).await, Ok(threads));
        }
    }

    #[cfg(target_os = "linux")]
    #[tokio::test]
    async fn long_work_and_fits_run_at_lower_priorities() {
        let compute = compute(1, 1);
        let niceness = || rustix::process::getpriority_process(None).unwrap();
        let own = niceness();
        assert_eq!(compute.run(Class::Predict, niceness).await, Ok(own));
        assert_eq!(compute.run(Class::Long, niceness).await, Ok(own.max(LONG_NICENESS)));
        assert_eq!(compute.run(Class::Fit, niceness).await, Ok(own.max(FIT_NICENESS)));
    }
}
