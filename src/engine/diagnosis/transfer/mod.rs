//! A diagnosis without given repeats: what anything predicts on runs that it has not seen is not noise.
//!
//! The noise is found in repeats that the runs hold anyway, or bounded from above by what the best predictor leaves of
//! groups that it was not fitted to. The laws that the screen puts first run freely; the verdict follows from what they
//! leave elsewhere than where they were fitted, and is `undecided` where nothing is left to carry a law to, or where
//! nothing carries over.

mod alternatives;
mod decide;
mod evidence;
mod hypotheses;
mod next;
mod recording;
mod refit;
mod state;
mod words;

pub use alternatives::{Alternative, FEATURES, Weights, alternatives};
pub use decide::{NAMED, Ranked, ranked};
pub(super) use refit::FLOOR;
pub use refit::{Refits, refits};
pub(super) use words::{MODEL_ERRS, sentence};

use state::{Screened, screened};

use super::augmented::Augmented;
use super::input::Input;
use super::report::{Gap, Hypothesis, NextExperiment, NoiseSource, Verdict};
use crate::EngineError;
use crate::diagnosis::data::overview::Overview;
use crate::diagnosis::effects::effect::{Effect, Family, Tier};
use crate::progress::{Progress, Watch, report};

/// What follows from transfer between runs.
pub(super) struct Found {
    pub verdict: Verdict,
    pub gap: Gap,
    pub noise: NoiseSource,
    pub hypotheses: Vec<(Hypothesis, Augmented)>,
    pub next: Option<NextExperiment>,
    /// Share of the gap that a linear part fitted to these runs closes.
    pub linear_closure: f64,
    pub warnings: Vec<String>,
}

/// Fits a hypothesis once more, to all responses; `None` where that cannot be, or leaves no less.
pub(super) type FitAgain<'a> =
    &'a dyn Fn(&Hypothesis, Watch<'_>) -> Result<Option<(Hypothesis, Augmented)>, EngineError>;

/// Screens the runs, lets the foremost laws run freely, fits the one that they single out `again`, and decides.
///
/// # Errors
/// Too few samples to hold any of them out; [`EngineError::Cancelled`].
pub(super) fn by_transfer(
    input: &Input,
    overview: &Overview,
    again: FitAgain<'_>,
    watch: Watch<'_>,
) -> Result<Found, EngineError> {
    let of_screen = |p: Progress<'_>| watch(p.within(&(0.15..0.6)));
    let Screened { mut runs, screening, changed } = screened(input, &of_screen)?;
    let of_refits = |p: Progress<'_>| watch(p.within(&(0.6..0.75)));
    let refits = refits(&runs.recording, &runs.grouping, &screening, &input.catalogue, &of_refits)?;
    let ranked = decide::ranked(&screening, &refits, runs.relative_noise(overview).as_deref());
    let alone = decide::singled_out(&ranked);
    // What repeats differ by because the rig drifts is predicted, and no noise.
    if let Some(drift) = alone.filter(|best| best.standing.family == Family::TimeVariance) {
        runs.noise_is_no_more_than(&drift.free.errors, overview);
    }
    let mut listed = hypotheses::all(input, overview, &runs, &screening, &ranked);
    if let Some(law) = alone
        && let Some(best) = listed.iter_mut().find(|l| l.hypothesis.family == law.standing.family)
    {
        best.again = again(&best.hypothesis, &|p| watch(p.within(&(0.75..0.85))))?;
    }
    report(watch, "decision", 0.85)?;
    let evidence = evidence::Evidence::of(overview, &screening, &runs, &listed);
    let verdict = decide::verdict(input, &screening, &ranked, &evidence, &listed);
    report(watch, "next experiment", 0.9)?;
    let next = next::experiment(input, &runs.recording, &screening, &ranked, &listed, &verdict);
    let mut warnings = Vec::new();
    if changed {
        warnings.push("rig_changed".to_owned());
    }
    if screening.transfer == super::screen::Transfer::OneDrive {
        warnings.push("one_drive".to_owned());
    }
    Ok(Found {
        verdict,
        gap: evidence.gap(),
        noise: match (&runs.noise, input.repeats.is_empty()) {
            (None, _) => NoiseSource::Bounded,
            (Some(_), true) => NoiseSource::FoundRepeats,
            (Some(_), false) => NoiseSource::Repeats,
        },
        linear_closure: evidence.linear_closure(),
        next,
        hypotheses: listed.into_iter().map(|l| l.again.unwrap_or((l.hypothesis, l.augmented))).collect(),
        warnings,
    })
}

/// Whether an effect is one of the linear part.
fn linear(effect: Effect) -> bool {
    effect.tier() <= Tier::Linear
}
