//! The only way from async code to work for the processor: permits, threads, spans.
//!
//! Each class of work has its own permits ([`fair_queue`]) and its own pool of threads. A fit that keeps
//! every core busy therefore never holds a thread that a prediction needs, and an hour-long prediction
//! none that a short one waits for; the operating system shares the cores between them. Threads of long
//! work and of fits have lower priorities and get the time that the others leave.

pub mod fair_queue;

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::time::Duration;

use rayon::{ThreadPool, ThreadPoolBuilder};
use tokio::sync::oneshot;

use fair_queue::{Asker, FairQueue, QueueSettings, Refused};

/// Niceness of threads that fit. Ten of nineteen: against a thread of normal priority they get
/// about a tenth of a core, and all of it when nobody else wants it.
const FIT_NICENESS: i32 = 10;

/// Niceness of threads that do long work for an answer: about a quarter of a core against a thread
/// of normal priority.
const LONG_NICENESS: i32 = 5;

/// Largest number of values of short work: a minute of a large rig, which takes some tens of
/// milliseconds to parse, predict or count.
const SHORT_VALUES: usize = 1 << 20;

/// A class of work; each has permits and threads of its own.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Class {
    /// Short work for an answer: predictions, damage, parsing.
    Predict,
    /// Long work for an answer, such as an hour of signal.
    Long,
    /// A fit: long, and at a lower priority.
    Fit,
}

/// Permits and threads of each class.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ComputeSettings {
    /// Predictions and other short work.
    pub predict: QueueSettings,
    /// Threads that share this work.
    pub predict_threads: usize,
    /// Long work; each piece holds an hour of signal or more in memory.
    pub long: QueueSettings,
    /// Threads that share this work.
    pub long_threads: usize,
    /// Fits at once; as many as there are job workers, which are their only queue.
    pub fit_permits: usize,
    /// Threads that share the work of fits.
    pub fit_threads: usize,
}

impl Class {
    /// Class of work for an answer with this number of values (samples of all channels).
    pub fn of_values(values: usize) -> Self {
        if values > SHORT_VALUES { Self::Long } else { Self::Predict }
    }

    /// Class of work on this number of bytes that hold values.
    pub fn of_bytes(bytes: usize) -> Self {
        Self::of_values(bytes / size_of::<f64>())
    }

    /// The longer of the two classes.
    #[must_use]
    pub fn or(self, other: Self) -> Self {
        if self == Self::Predict { other } else { self }
    }
}

impl Default for ComputeSettings {
    /// For each core one permit and one thread of each class, and a queue of thirty-two tasks; one fit.
    /// Once the queue of short work has not been empty for a tenth of a second (some ten predictions),
    /// it is kept short: a task then waits only for the work under way.
    fn default() -> Self {
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let predict = QueueSettings {
            patience: Duration::from_millis(100),
            ..QueueSettings::new(cores, 32 * cores, Duration::from_secs(5))
        };
        Self {
            predict,
            predict_threads: cores,
            long: QueueSettings::new(cores, 32 * cores, Duration::from_secs(30)),
            long_threads: cores,
            fit_permits: 1,
            fit_threads: cores,
        }
    }
}

/// Why work was not done.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ComputeError {
    /// The service is overloaded: try again later.
    #[error("busy: {0}")]
    Busy(#[from] Refused),
    /// A panic, which is a defect; the message is for the log, not for a client.
    #[error("panicked: {0}")]
    Panicked(String),
    /// Thread pools could not be made, or their threads are gone.
    #[error("threads: {0}")]
    Threads(String),
}

/// The classes of work with their permits and threads. Clones share them.
#[derive(Debug, Clone)]
pub struct Compute {
    predict: Arc<Lane>,
    long: Arc<Lane>,
    fit: Arc<Lane>,
    /// Write the pieces of answers that have begun to go out.
    answers: Arc<ThreadPool>,
}

/// Permits and threads of one class.
#[derive(Debug)]
struct Lane {
    queue: Arc<FairQueue>,
    threads: ThreadPool,
}

impl Compute {
    /// Makes the thread pools.
    ///
    /// # Errors
    /// [`ComputeError::Threads`] when the system gives no threads.
    pub fn new(settings: &ComputeSettings) -> Result<Self, ComputeError> {
        let lane = |name, queue, threads: usize, niceness| -> Result<Arc<Lane>, ComputeError> {
            let threads = pool(name, threads, niceness)?;
            Ok(Arc::new(Lane { queue: FairQueue::new(name, queue), threads }))
        };
        let s = settings;
        let fits = QueueSettings::new(s.fit_permits, usize::MAX, Duration::MAX);
        Ok(Self {
            predict: lane("predict", s.predict.clone(), s.predict_threads, 0)?,
            long: lane("long", s.long.clone(), s.long_threads, LONG_NICENESS)?,
            fit: lane("fit", fits, s.fit_threads, FIT_NICENESS)?,
            answers: Arc::new(pool("answer", s.long_threads, LONG_NICENESS)?),
        })
    }

    /// Does `work` of a client on the threads of its class, inside the current tracing span, and waits for its
    /// result. Work that has begun goes on, and keeps its permit, even if the caller goes away.
    ///
    /// # Errors
    /// [`ComputeError::Busy`], at once when too many wait; [`ComputeError::Panicked`].
    pub async fn run<T, F>(&self, class: Class, asker: impl Into<Asker>, work: F) -> Result<T, ComputeError>
    where
        T: Send + 'static,
        F: FnOnce() -> T + Send + 'static,
    {
        let lane = self.lane(class);
        let permit = lane.queue.acquire(asker).await?;
        on_threads(&lane.threads, move || {
            let done = catch_unwind(AssertUnwindSafe(work));
            drop(permit);
            done
        })
        .await
    }

    /// Writes a short piece of an answer that has begun to go out. Such work is never refused, and waits for
    /// no permit: pieces are written in the order in which they were asked for, one a thread.
    ///
    /// # Errors
    /// [`ComputeError::Panicked`].
    pub async fn piece<T, F>(&self, work: F) -> Result<T, ComputeError>
    where
        T: Send + 'static,
        F: FnOnce() -> T + Send + 'static,
    {
        on_threads(&self.answers, move || catch_unwind(AssertUnwindSafe(work))).await
    }

    /// The permits and the queue of a class.
    pub fn queue(&self, class: Class) -> &Arc<FairQueue> {
        &self.lane(class).queue
    }

    fn lane(&self, class: Class) -> &Arc<Lane> {
        match class {
            Class::Predict => &self.predict,
            Class::Long => &self.long,
            Class::Fit => &self.fit,
        }
    }
}

/// Does work on a pool's threads, inside the current tracing span, after all that was handed over before.
async fn on_threads<T, F>(threads: &ThreadPool, work: F) -> Result<T, ComputeError>
where
    T: Send + 'static,
    F: FnOnce() -> std::thread::Result<T> + Send + 'static,
{
    let (answer, done) = oneshot::channel();
    let span = tracing::Span::current();
    threads.spawn_fifo(move || {
        // Nobody waits for it if the client has left.
        let _ = answer.send(span.in_scope(work));
    });
    match done.await {
        Ok(Ok(done)) => Ok(done),
        Ok(Err(panic)) => Err(ComputeError::Panicked(message(panic.as_ref()))),
        Err(gone) => Err(ComputeError::Threads(gone.to_string())),
    }
}

fn pool(name: &'static str, threads: usize, niceness: i32) -> Result<ThreadPool, ComputeError> {
    ThreadPoolBuilder::new()
        .num_threads(threads.max(1))
        .thread_name(move |i| format!("{name}-{i}"))
        .start_handler(move |_| lower_priority(niceness))
        .build()
        .map_err(|error| ComputeError::Threads(error.to_string()))
}

/// Lowers the priority of the calling thread (on Linux niceness belongs to the thread). On other
/// systems, or where that is forbidden, all threads have the same priority.
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

/// The message of a panic.
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
        let queue = QueueSettings::new(permits, queue, Duration::from_secs(60));
        Compute::new(&ComputeSettings {
            predict: queue.clone(),
            predict_threads: 2,
            long: queue,
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
            let (_, in_use, waiting) = compute.queue(Class::Predict).depth();
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
        // Fits have permits of their own.
        assert_eq!(compute.run(Class::Fit, None, || 7).await, Ok(7));
        // A task that gives up waiting makes room.
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
        assert_eq!(compute.queue(Class::Predict).depth().1, 1);
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
        // Each piece of long work keeps both threads of its class until it is released.
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
        // The third waits for a permit; short work does not.
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

    #[tokio::test]
    async fn pieces_of_answers_wait_for_no_long_work() {
        let compute = compute(1, 1);
        let (release, gate) = mpsc::channel::<()>();
        let long = tokio::spawn({
            let compute = compute.clone();
            async move { compute.run(Class::Long, None, move || gate.recv().unwrap()).await }
        });
        while compute.queue(Class::Long).depth().1 == 0 {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
        let name = compute.piece(|| std::thread::current().name().unwrap().to_owned()).await.unwrap();
        assert!(name.starts_with("answer-"), "{name}");
        let panicked = compute.piece(|| -> () { panic!("a defect") }).await;
        assert_eq!(panicked, Err(ComputeError::Panicked("a defect".into())));
        assert_eq!(compute.piece(|| 7).await, Ok(7), "the thread goes on");
        release.send(()).unwrap();
        long.await.unwrap().unwrap();
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
