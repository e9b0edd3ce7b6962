//! Effects that diagnoses found, on top of a model: `sim(u) + [augmented(u) - core(u)]`.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

use crate::engine::diagnosis::Augmented;
use crate::engine::{EngineError, Signal};

/// Most effects that a model may have.
pub(super) const MAX_EFFECTS: usize = 16;

/// One effect and what drives it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AddedEffect {
    /// Which of the model's inputs are the effect's drives, in its order.
    pub drives: Vec<usize>,
    /// The sim with the effect in it.
    pub augmented: Augmented,
}

impl AddedEffect {
    /// Checks that the effect can be simulated with a model of so many inputs and outputs at this
    /// rate.
    ///
    /// # Errors
    /// [`EngineError::Weights`]: drives that are no inputs or come twice, and [`Augmented::check`]'s.
    pub fn check(&self, inputs: usize, outputs: usize, sample_rate_hz: f64) -> Result<(), EngineError> {
        let known = self.drives.iter().enumerate().all(|(i, d)| *d < inputs && !self.drives[..i].contains(d));
        if self.drives.is_empty() || !known {
            let drives = &self.drives;
            return Err(EngineError::Weights(format!(
                "effect: drives {drives:?} must be inputs, each at most once"
            )));
        }
        self.augmented.check(self.drives.len(), outputs, sample_rate_hz)
    }

    /// The response with the effect; `x` are the model's inputs behind its filter.
    fn apply(&self, x: &Signal, response: &Signal) -> Result<Signal, EngineError> {
        let all = self.drives.iter().copied().eq(0..x.n_channels());
        let drive = if all { Cow::Borrowed(x) } else { Cow::Owned(x.select(&self.drives)) };
        self.augmented.apply(&drive, response)
    }
}

/// The response with all effects, each found on what came before it.
///
/// # Errors
/// A free run that runs away.
pub(super) fn apply_all(
    effects: &[AddedEffect],
    x: &Signal,
    response: Signal,
) -> Result<Signal, EngineError> {
    effects.iter().try_fold(response, |response, effect| effect.apply(x, &response))
}
