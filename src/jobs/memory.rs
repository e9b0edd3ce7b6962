//! Whether there is the memory that a fit takes, asked before a sample is read.

use super::fit_plan::{FitPlan, FitProblem};
use super::process::available_memory_bytes;
use crate::domain::Run;
use crate::engine::model::FitSize;

/// The memory that a fit is estimated to take.
fn needed(plan: &FitPlan) -> u64 {
    let samples = |runs: &mut dyn Iterator<Item = &Run>| -> Vec<usize> {
        runs.map(|run| usize::try_from(run.samples).unwrap_or(usize::MAX)).collect()
    };
    let all = || plan.training.iter().chain(plan.frf_only()).chain(&plan.validation);
    let values = |run: &Run| (run.samples as usize).saturating_mul(run.channels.len());
    FitSize {
        kind: plan.request.kind,
        inputs: plan.inputs.len(),
        outputs: plan.outputs.len(),
        runs: &samples(&mut plan.training.iter().chain(&plan.validation)),
        frf_only: &samples(&mut plan.frf_only()),
        largest_run: all().map(values).max().unwrap_or(0),
        preprocess: plan.request.preprocess,
        frf: &plan.request.frf.settings(plan.request.preset),
        core: plan.core.is_some(),
    }
    .bytes()
}

/// Refuses a fit that a job may never do, because it takes more than `limit` bytes.
///
/// # Errors
/// [`FitProblem::Memory`].
pub(super) fn check_limit(plan: &FitPlan, limit: u64) -> Result<(), FitProblem> {
    enough(needed(plan), limit, None)
}

/// Refuses a fit that takes more than a job may hold or than the machine, or its control group, has left now.
///
/// # Errors
/// [`FitProblem::Memory`].
pub(super) fn check_now(plan: &FitPlan, limit: u64) -> Result<(), FitProblem> {
    enough(needed(plan), limit, available_memory_bytes())
}

fn enough(needed: u64, limit: u64, available: Option<u64>) -> Result<(), FitProblem> {
    if needed <= limit && available.is_none_or(|available| needed <= available) {
        return Ok(());
    }
    Err(FitProblem::Memory { needed, limit, available })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::jobs::problem::{JobError, codes};

    const GIB: u64 = 1 << 30;

    #[test]
    fn a_fit_that_needs_too_much_is_refused_with_what_it_needs_and_what_there_is() {
        assert!(enough(GIB, GIB, None).is_ok() && enough(GIB, 2 * GIB, Some(GIB)).is_ok());
        let problem = |found: Result<(), FitProblem>| found.unwrap_err().problem();
        let never = problem(enough(7 * GIB, 6 * GIB, None));
        assert_eq!((never.code.as_str(), never.status), (codes::FIT_MEMORY, 422));
        let detail = never.detail.clone();
        assert!(detail.contains("7168 MiB") && detail.contains("6144 MiB"), "{detail}");
        let now = problem(enough(7 * GIB, 8 * GIB, Some(5 * GIB)));
        assert!(
            now.detail.contains("7168 MiB") && now.detail.contains("5120 MiB are free"),
            "{}",
            now.detail
        );
    }

    #[test]
    fn what_is_short_now_may_be_there_later_and_what_no_job_may_take_never_is() {
        let end = |found: Result<(), FitProblem>| JobError::from(found.unwrap_err());
        assert!(matches!(end(enough(7 * GIB, 6 * GIB, None)), JobError::Failed(_)));
        assert!(matches!(end(enough(7 * GIB, 6 * GIB, Some(9 * GIB))), JobError::Failed(_)));
        assert!(matches!(end(enough(7 * GIB, 8 * GIB, Some(5 * GIB))), JobError::Retry(_)));
    }
}
