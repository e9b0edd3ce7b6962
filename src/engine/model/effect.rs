//! Effects that diagnoses found, on top of a model: `sim(u) + [augmented(u) - core(u)]`.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

use crate::diagnosis::{Augmented, sum};
use crate::progress::{Watch, report, unwatched};
use crate::{EngineError, Signal};

/// Most effects that a model may have.
pub(super) const MAX_EFFECTS: usize = 16;

/// One effect and its drives.
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
    /// [`EngineError::Weights`]: drives that are not inputs or come twice, and the errors of
    /// [`Augmented::check`].
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

    /// Its drives among the model's inputs behind its filter.
    fn drive<'a>(&self, x: &'a Signal) -> Cow<'a, Signal> {
        let all = self.drives.iter().copied().eq(0..x.n_channels());
        if all { Cow::Borrowed(x) } else { Cow::Owned(x.select(&self.drives)) }
    }
}

/// The response with all effects, each of which was found on the model with those before it. Asks `watch`
/// before each of them whether to go on.
///
/// # Errors
/// A free run that diverges; [`EngineError::Cancelled`].
pub(super) fn apply_all(
    effects: &[AddedEffect],
    x: &Signal,
    response: Signal,
    watch: Watch<'_>,
) -> Result<Signal, EngineError> {
    Ok(fold(effects, x, response, false, watch)?.0)
}

/// The response with all effects, and what they add to the linear cores that they were found on, both
/// `[output, sample]`. `x` are the model's inputs behind its filter, `response` the model's own without its
/// effects. No effects add nothing: `None`.
///
/// # Errors
/// A free run that diverges; signals that are not the effects'.
pub fn apply_effects(
    effects: &[AddedEffect],
    x: &Signal,
    response: Signal,
) -> Result<(Signal, Option<Signal>), EngineError> {
    fold(effects, x, response, true, &unwatched)
}

/// Applies one effect after the other, and sums what they add where a later one or the caller asks for it.
fn fold(
    effects: &[AddedEffect],
    x: &Signal,
    mut response: Signal,
    wanted: bool,
    watch: Watch<'_>,
) -> Result<(Signal, Option<Signal>), EngineError> {
    let mut added: Option<Signal> = None;
    for (i, effect) in effects.iter().enumerate() {
        report(watch, "effects", (1 + i) as f64 / (1 + effects.len()) as f64)?;
        let needed = wanted || effects[i + 1..].iter().any(|later| later.augmented.on_effects());
        let drive = effect.drive(x);
        let next = effect.augmented.apply(&drive, &response, added.as_ref())?;
        if needed {
            let own = effect.augmented.addition(&drive, &response, added.as_ref())?;
            added = Some(match added {
                Some(added) => sum(&added, &own)?,
                None => own,
            });
        }
        response = next;
    }
    Ok((response, added))
}

#[cfg(test)]
mod tests {
    use realfft::num_complex::Complex64;

    use super::*;
    use crate::diagnosis::tests::rig::{RATE, hardening, noise_drive, request};
    use crate::diagnosis::{Effect, Input, diagnose};
    use crate::frf::Frf;
    use crate::model::{
        InputRange, ModelKind, Predictor, Preprocess, RigModel, VersionKind, from_safetensors, to_safetensors,
    };

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
            frf_quality: None,
            core: Vec::new(),
            lstm: None,
            joint_range: None,
            window_range: Vec::new(),
            range: vec![InputRange { min: -9.0, max: 9.0, max_rate: 1e6, band_hz: None, local: None }; 2],
            band: None,
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
        let once = effect().augmented.apply(&filtered.select(&[1]), &bare, None).unwrap();
        assert_ne!(once, bare);
        assert_eq!(model(vec![effect()]).predict(&x).unwrap(), once);
        let twice = effect().augmented.apply(&filtered.select(&[1]), &once, None).unwrap();
        assert_eq!(model(vec![effect(), effect()]).predict(&x).unwrap(), twice);
    }

    #[test]
    fn a_long_drive_has_one_response_in_pieces_or_at_once() {
        let x = inputs(1100.0);
        let predictor = Predictor::new(model(vec![effect()])).unwrap();
        let whole = predictor.predict(x.clone()).unwrap();
        let mut prediction = predictor.begin(x).unwrap();
        let mut pieces = Vec::new();
        while let Some(piece) = predictor.next(&mut prediction, &unwatched).unwrap() {
            pieces.push(piece.into_channels().remove(0));
        }
        assert_eq!(pieces.len(), 2);
        assert_eq!(pieces.concat(), whole.channel(0));
        assert!(predictor.rest(&mut prediction, &unwatched).is_err(), "all has been given");
        assert_eq!(predictor.next(&mut prediction, &unwatched).unwrap(), None);
        let mut prediction = predictor.begin(inputs(1100.0)).unwrap();
        let first = predictor.next(&mut prediction, &unwatched).unwrap().unwrap();
        let rest = predictor.rest(&mut prediction, &unwatched).unwrap();
        assert_eq!([first.channel(0), rest.channel(0)].concat(), whole.channel(0));
    }

    /// The file with another metadata block.
    fn with_metadata(file: &[u8], edit: impl FnOnce(&mut serde_json::Value)) -> Vec<u8> {
        let (length, rest) = file.split_first_chunk::<8>().unwrap();
        let (header, tensors) = rest.split_at(u64::from_le_bytes(*length) as usize);
        let mut header: serde_json::Value = serde_json::from_slice(header).unwrap();
        let text = header["__metadata__"]["rigcast"].as_str().unwrap();
        let mut metadata: serde_json::Value = serde_json::from_str(text).unwrap();
        edit(&mut metadata);
        header["__metadata__"]["rigcast"] = metadata.to_string().into();
        let header = serde_json::to_vec(&header).unwrap();
        [&(header.len() as u64).to_le_bytes()[..], &header, tensors].concat()
    }

    #[test]
    fn a_file_with_effects_is_of_kind_adopted_and_one_from_before_that_kind_is_read() {
        let model = model(vec![effect()]);
        assert_eq!(model.version_kind(), VersionKind::Adopted);
        let file = to_safetensors(&model);
        let x = inputs(8.0);
        let same = |file: &[u8]| {
            let read = from_safetensors(file).unwrap();
            assert_eq!(read, model);
            assert_eq!(read.predict(&x).unwrap(), model.predict(&x).unwrap(), "bit by bit");
        };
        same(&file);
        let mut kind = serde_json::Value::Null;
        let before = with_metadata(&file, |metadata| {
            kind = metadata["kind"].take();
            metadata["kind"] = "frf".into();
            assert_eq!(metadata.as_object_mut().unwrap().remove("base").unwrap()["kind"], "frf");
        });
        assert_eq!(kind, "adopted");
        same(&before);

        let refused = |file: &[u8], edit: fn(&mut serde_json::Value)| {
            from_safetensors(&with_metadata(file, edit)).unwrap_err().to_string()
        };
        let error = refused(&file, |m| drop(m.as_object_mut().unwrap().remove("base")));
        assert!(error.contains("base is missing"), "{error}");
        let error = refused(&file, |m| m["base"]["kind"] = "adopted".into());
        assert!(error.contains("frf, lstm, hybrid1, hybrid2"), "{error}");
        let error = refused(&file, |m| drop(m.as_object_mut().unwrap().remove("effects")));
        assert!(error.contains("adopted has at least one"), "{error}");
        let error = refused(&file, |m| m["kind"] = "frf".into());
        assert!(error.contains("only kind adopted has one"), "{error}");
    }

    #[test]
    fn an_effect_found_on_effects_runs_with_what_they_add() {
        let x = inputs(8.0);
        let bare = model(Vec::new());
        let (filtered, response) = (bare.preprocess.apply(&x).unwrap(), bare.predict(&x).unwrap());
        let apply = |effects: &[AddedEffect]| apply_effects(effects, &filtered, response.clone()).unwrap();
        assert_eq!(apply(&[]), (response.clone(), None));
        let effect = effect();
        let (once, added) = apply(std::slice::from_ref(&effect));
        let added = added.unwrap();
        // The model is no linear core: it keeps what the effect is added to.
        for ((y, before), added) in once.channel(0).iter().zip(response.channel(0)).zip(added.channel(0)) {
            assert!((y - before - added).abs() < 1e-9 * (1.0 + y.abs()), "{y} {before} {added}");
        }
        let (twice, both) = apply(&[effect.clone(), effect.clone()]);
        let mut json = serde_json::to_value(&effect.augmented).unwrap();
        json["on_effects"] = true.into();
        let on_effects = AddedEffect { augmented: serde_json::from_value(json).unwrap(), ..effect.clone() };
        let (further, all) = apply(&[effect.clone(), on_effects.clone()]);
        assert_ne!(further, twice, "the second spring bends by the motion that the first one leaves");
        assert_ne!(all, both);
        assert_eq!(model(vec![effect, on_effects]).predict(&x).unwrap(), further);
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
