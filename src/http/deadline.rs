//! The time at which work for an answer stops: at the deadline, or when the caller goes away.

use std::ops::ControlFlow;
use std::sync::{Arc, Weak};
use std::time::Instant;

use super::problem::{Answer, Problem};
use super::{Http, codes};
use crate::compute::Class;
use crate::engine::Progress;
use crate::storage::StoreError;
use crate::telemetry::names;

/// Checked by long work between its steps.
#[derive(Debug)]
pub struct Deadline {
    at: Instant,
    /// Alive as long as the caller waits for the answer.
    caller: Weak<()>,
}

impl Deadline {
    /// Ends work past its deadline, or whose caller has gone away.
    ///
    /// # Errors
    /// `predict.deadline`.
    pub fn check(&self) -> Answer<()> {
        if Instant::now() > self.at || self.caller.strong_count() == 0 { Err(over()) } else { Ok(()) }
    }

    /// [`Deadline::check`] as the engine asks it.
    pub fn watch(&self, _: Progress<'_>) -> ControlFlow<()> {
        if self.check().is_ok() { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
    }
}

/// The refusal of a request whose answer was not ready in time.
pub fn over() -> Problem {
    let detail = "The answer was not ready before the deadline of the service; send a shorter signal, or try again later.";
    Problem::new(codes::PREDICT_DEADLINE, detail)
}

impl Http {
    /// Does work for an answer that must be ready before the deadline, the wait in the queue included.
    /// Work that has begun goes on, and keeps its permit, until it next checks the deadline. Work that waits
    /// leaves the queue at once when its caller goes away.
    pub(super) async fn in_time<T, F>(&self, class: Class, work: F) -> Answer<T>
    where
        T: Send + 'static,
        F: FnOnce(&Deadline) -> Answer<T> + Send + 'static,
    {
        let mut caller = Caller::default();
        let deadline =
            Deadline { at: Instant::now() + self.limits.deadline, caller: Arc::downgrade(&caller.waits) };
        let work = self.off_thread(class, move || {
            deadline.check()?;
            work(&deadline)
        });
        let done = match tokio::time::timeout(self.limits.deadline, work).await {
            Ok(done) => done.flatten(),
            Err(_) => Err(over()),
        };
        caller.answered = true;
        counted(done)
    }

    /// Reads for an answer that must begin before the deadline.
    pub(super) async fn read_in_time<T>(
        &self,
        read: impl Future<Output = Result<T, StoreError>>,
    ) -> Answer<T> {
        match tokio::time::timeout(self.limits.deadline, read).await {
            Ok(read) => Ok(read?),
            Err(_) => counted(Err(over())),
        }
    }
}

/// Counts an answer that was not ready in time.
fn counted<T>(done: Answer<T>) -> Answer<T> {
    if done.as_ref().is_err_and(|problem| problem.code() == codes::PREDICT_DEADLINE.name) {
        metrics::counter!(names::DEADLINES).increment(1);
    }
    done
}

/// The caller of some work. It is dropped before it is answered when its connection ends.
#[derive(Debug, Default)]
struct Caller {
    waits: Arc<()>,
    answered: bool,
}

impl Drop for Caller {
    fn drop(&mut self) {
        if !self.answered {
            metrics::counter!(names::ABANDONED).increment(1);
            tracing::info!("given up: the client has gone");
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn work_is_worth_doing_until_the_deadline_and_while_somebody_waits() {
        let caller = Arc::new(());
        let until = |at| Deadline { at, caller: Arc::downgrade(&caller) };
        let later = until(Instant::now() + Duration::from_secs(600));
        assert!(later.check().is_ok());
        let before = Instant::now();
        std::thread::sleep(Duration::from_millis(1));
        assert!(until(before).check().is_err_and(|problem| problem.code() == "predict.deadline"));
        drop(caller);
        assert!(later.check().is_err());
    }
}
