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

#[cfg(test)]
mod tests {
    use realfft::num_complex::Complex64;

    use super::*;
    use crate::engine::diagnosis::tests::rig::{RATE, hardening, noise_drive, request};
    use crate::engine::diagnosis::{Effect, Input, diagnose};
    use crate::engine::frf::Frf;
    use crate::engine::model::{
        InputRange, ModelKind, Predictor, Preprocess, RigModel, from_safetensors, to_safetensors,
    };
    use crate::engine::progress::unwatched;

    fn augmented() -> Augmented {
        let input = Input { catalogue: vec![Effect::CubicStiffness], ..request(hardening, 0.01) };
        diagnose(&input, &unwatched).unwrap().augmented.swap_remove(0)
    }

    /// Two inputs, of which the second drives the effect; the model itself only scales.
    fn model(effects: Vec<AddedEffect>) -> RigModel {
        let frf = Frf {
            sample_rate_hz: RATE,
            segment_len: 8,
            n_inputs: 2,
            n_outputs: 1,
            h: [0.5, 0.9].into_iter().cycle().take(10).map(|g| Complex64::new(g, 0.0)).collect(),
            usable_hz: [0.0, RATE / 2.0],
            x_mean: vec![0.0; 2],
            y_mean: vec![0.0],
        };
        RigModel {
            kind: ModelKind::Frf,
            inputs: vec!["a".into(), "b".into()],
            outputs: vec!["y".into()],
            sample_rate_hz: RATE,
            preprocess: Preprocess { low_pass_hz: Some(60.0), band_pass_hz: None },
            frf: Some(frf),
            lstm: None,
            range: vec![InputRange { min: -9.0, max: 9.0, max_rate: 1e6 }; 2],
            effects,
        }
    }

    fn effect() -> AddedEffect {
        AddedEffect { drives: vec![1], augmented: augmented() }
    }

    fn inputs(seconds: f64) -> Signal {
        Signal::new(RATE, vec![noise_drive(seconds, 1.0, 5), noise_drive(seconds, 0.8, 6)]).unwrap()
    }

    #[test]
    fn effects_come_behind_the_filter_one_on_the_other_and_none_changes_nothing() {
        let x = inputs(8.0);
        let filtered = model(Vec::new()).preprocess.apply(&x).unwrap();
        let bare = model(Vec::new()).predict(&x).unwrap();
        let once = effect().augmented.apply(&filtered.select(&[1]), &bare).unwrap();
        assert_ne!(once, bare);
        assert_eq!(model(vec![effect()]).predict(&x).unwrap(), once);
        let twice = effect().augmented.apply(&filtered.select(&[1]), &once).unwrap();
        assert_eq!(model(vec![effect(), effect()]).predict(&x).unwrap(), twice);
    }

    #[test]
    fn a_long_drive_has_one_response_in_pieces_or_at_once() {
        let x = inputs(1100.0);
        let predictor = Predictor::new(model(vec![effect()])).unwrap();
        let whole = predictor.predict(x.clone()).unwrap();
        let mut prediction = predictor.begin(x).unwrap();
        let mut pieces = Vec::new();
        while let Some(piece) = predictor.next(&mut prediction).unwrap() {
            pieces.push(piece.into_channels().remove(0));
        }
        assert_eq!(pieces.len(), 2);
        assert_eq!(pieces.concat(), whole.channel(0));
        assert!(predictor.rest(&mut prediction, &unwatched).is_err(), "all has been given");
        assert_eq!(predictor.next(&mut prediction).unwrap(), None);
        let mut prediction = predictor.begin(inputs(1100.0)).unwrap();
        let first = predictor.next(&mut prediction).unwrap().unwrap();
        let rest = predictor.rest(&mut prediction, &unwatched).unwrap();
        assert_eq!([first.channel(0), rest.channel(0)].concat(), whole.channel(0));
    }

    #[test]
    fn weights_carry_effects_and_refuse_those_that_do_not_belong() {
        let file = to_safetensors(&model(vec![effect(), effect()]));
        assert_eq!(from_safetensors(&file).unwrap(), model(vec![effect(), effect()]));
        let refused = |effects: Vec<AddedEffect>| {
            from_safetensors(&to_safetensors(&model(effects))).unwrap_err().to_string()
        };
        for drives in [vec![], vec![2], vec![0, 0], vec![0, 1]] {
            let error = refused(vec![AddedEffect { drives, ..effect() }]);
            assert!(error.contains("effect: "), "{error}");
        }
        let error = refused(vec![effect(); MAX_EFFECTS + 1]);
        assert!(error.contains("at most 16"), "{error}");
        let mut other_rate = model(vec![effect()]);
        other_rate.sample_rate_hz = 2.0 * RATE;
        other_rate.frf.as_mut().unwrap().sample_rate_hz = 2.0 * RATE;
        assert!(from_safetensors(&to_safetensors(&other_rate)).is_err());
    }
}
