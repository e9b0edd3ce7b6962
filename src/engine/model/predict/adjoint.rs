//! The vector-Jacobian product of a model: from weights on its outputs to those on its inputs.

use super::Predictor;
use crate::lstm;
use crate::model::{LstmPart, ModelKind, network_inputs};
use crate::progress::{Watch, report};
use crate::{EngineError, Signal};

impl Predictor {
    /// Whether [`Predictor::adjoint`] knows the model's derivative. An effect is a free run, through which nothing goes back.
    pub fn has_adjoint(&self) -> bool {
        self.model.core.is_empty() && self.model.effects.is_empty()
    }

    /// `J^T w`, `[input, sample]`, where `J` is the derivative of the response by the drive at the drive `x`,
    /// `[input, sample]`, and `w` weights of the outputs, `[output, sample]`. It goes back through all that a prediction
    /// does: the network's windows or its stream, the FRF, the model's filter. The unit is that of `w` times output unit /
    /// input unit.
    ///
    /// # Errors
    /// [`EngineError::Setting`] for a model without ([`Predictor::has_adjoint`]); another channel count, length or sample
    /// rate; a result that is not finite; [`EngineError::Cancelled`].
    pub fn adjoint(&self, x: &Signal, w: &Signal, watch: Watch<'_>) -> Result<Signal, EngineError> {
        let model = &self.model;
        if !self.has_adjoint() {
            return Err(EngineError::Setting {
                setting: "model",
                found: "a model with effects".into(),
                limit: "a model without effects, whose derivative is known".into(),
            });
        }
        let (expected, found) = (model.outputs.len(), w.n_channels());
        if expected != found {
            return Err(EngineError::ChannelCount { what: "weights of the outputs", expected, found });
        }
        let (expected, found) = (x.n_samples(), w.n_samples());
        if expected != found {
            let what = "weights of the outputs";
            return Err(EngineError::UnequalLength { what, channel: 0, expected, found });
        }
        report(watch, "gradient", 0.0)?;
        let x = super::begin(model, x.clone())?.x;
        let gradient = match (&model.lstm, &self.filter) {
            (None, Some(filter)) => filter.adjoint(w)?,
            (None, None) => return Err(EngineError::Weights("a model has an FRF or an LSTM".into())),
            (Some(part), filter) => {
                let linear = match (model.kind, filter) {
                    (ModelKind::Hybrid2, Some(filter)) => {
                        Some(filter.apply(&x).map_err(EngineError::of_result)?.into_channels())
                    }
                    _ => None,
                };
                let z = network_inputs(&part.x, model.kind, &x, 0..x.n_samples(), linear.as_deref());
                let mut by_inputs = of_network(part, &z, w, watch)?;
                let by_linear = by_inputs.split_off(x.n_channels());
                // The network's inputs behind the model's are FRF(x); its outputs are on top of FRF(x).
                let back = match (model.kind, filter) {
                    (ModelKind::Hybrid2, Some(filter)) => {
                        Some(filter.adjoint(&Signal::new(x.sample_rate_hz(), by_linear)?)?)
                    }
                    (ModelKind::Hybrid1, Some(filter)) => Some(filter.adjoint(w)?),
                    _ => None,
                };
                for (sum, more) in by_inputs.iter_mut().zip(back.iter().flat_map(Signal::channels)) {
                    sum.iter_mut().zip(more).for_each(|(sum, more)| *sum += more);
                }
                Signal::new(x.sample_rate_hz(), by_inputs)?
            }
        };
        model.preprocess.adjoint(gradient)
    }
}

/// The same of the network alone, by its inputs before they are standardised.
fn of_network(
    part: &LstmPart,
    z: &[Vec<f32>],
    w: &Signal,
    watch: Watch<'_>,
) -> Result<Vec<Vec<f64>>, EngineError> {
    let scaled = |(w, std): (&Vec<f64>, &f64)| w.iter().map(|w| w * std).collect::<Vec<f64>>();
    let scaled: Vec<Vec<f64>> = w.channels().iter().zip(&part.y.std).map(scaled).collect();
    // The pass is linear in the weights and computes in f32, whose range their unit might leave.
    let largest = scaled.iter().flatten().fold(0.0_f64, |largest, w| largest.max(w.abs()));
    if largest == 0.0 {
        return Ok(vec![vec![0.0; w.n_samples()]; z.len()]);
    }
    let single = |w: &Vec<f64>| w.iter().map(|w| (w / largest) as f32).collect();
    let single: Vec<Vec<f32>> = scaled.iter().map(single).collect();
    let mut gradient =
        lstm::adjoint(&part.net, z, &single, (part.window_len, part.hop, part.recombine), watch)?;
    for (gradient, std) in gradient.iter_mut().zip(&part.x.std) {
        gradient.iter_mut().for_each(|v| *v *= largest / std);
    }
    Ok(gradient)
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::lstm::Recombine;
    use crate::model::tests::made_up;
    use crate::model::{Preprocess, RigModel};
    use crate::progress::unwatched;

    fn numbers(channels: usize, n: usize, seed: u64) -> Signal {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let channels = (0..channels).map(|_| (0..n).map(|_| rng.random_range(-1.0..1.0)).collect());
        Signal::new(100.0, channels.collect()).unwrap()
    }

    fn product(a: &Signal, b: &Signal) -> f64 {
        a.channels().iter().flatten().zip(b.channels().iter().flatten()).map(|(a, b)| a * b).sum()
    }

    fn moved(x: &Signal, by: f64, along: &Signal) -> Signal {
        let of = |(x, d): (&Vec<f64>, &Vec<f64>)| x.iter().zip(d).map(|(x, d)| x + by * d).collect();
        Signal::new(100.0, x.channels().iter().zip(along.channels()).map(of).collect()).unwrap()
    }

    /// Along a direction, `(J d) . w` by central differences of predictions is `d . (J^T w)`.
    #[test]
    fn the_product_equals_differences_of_predictions_for_every_kind_of_model() {
        let filters = [
            Preprocess::default(),
            Preprocess { low_pass_hz: Some(30.0), band_pass_hz: None },
            Preprocess { low_pass_hz: None, band_pass_hz: Some([2.0, 40.0]) },
        ];
        for kind in [ModelKind::Frf, ModelKind::Lstm, ModelKind::Hybrid1, ModelKind::Hybrid2] {
            for (recombine, preprocess) in
                [Recombine::Stream, Recombine::Welch].into_iter().flat_map(|way| filters.map(|f| (way, f)))
            {
                let mut model = RigModel { preprocess, ..made_up(kind) };
                if let Some(part) = &mut model.lstm {
                    part.recombine = recombine;
                    // A stream's gradient looks two windows ahead, which the made-up weights do not forget in 40 samples.
                    part.window_len = 80;
                }
                let predictor = Predictor::new(model).unwrap();
                let (x, w) = (numbers(2, 700, 1), numbers(3, 700, 2));
                let gradient = predictor.adjoint(&x, &w, &unwatched).unwrap();
                for seed in 3..6 {
                    let along = numbers(2, 700, seed);
                    let at = |by: f64| product(&predictor.predict(moved(&x, by, &along)).unwrap(), &w);
                    // Large enough for the roundings of f32, small enough for the terms of third order.
                    let h = 1e-3;
                    let slope = (8.0 * (at(h) - at(-h)) - (at(2.0 * h) - at(-2.0 * h))) / (12.0 * h);
                    let found = product(&gradient, &along);
                    let size = product(&gradient, &gradient).sqrt() * product(&along, &along).sqrt();
                    let apart = (slope - found).abs() / size;
                    // What a stream's state carries farther than its gradient looks is missing.
                    let cut = recombine == Recombine::Stream && kind != ModelKind::Frf;
                    let allowed = if cut { 1e-2 } else { 5e-4 };
                    assert!(
                        apart < allowed,
                        "{kind:?} {recombine:?} {preprocess:?}: {slope} {found} {apart:e}"
                    );
                }
            }
        }
    }

    #[test]
    fn weights_that_are_not_the_models_are_refused_and_none_give_none() {
        let predictor = Predictor::new(made_up(ModelKind::Hybrid2)).unwrap();
        let x = numbers(2, 100, 1);
        let of = |w: &Signal| predictor.adjoint(&x, w, &unwatched);
        assert!(matches!(
            of(&numbers(2, 100, 2)),
            Err(EngineError::ChannelCount { expected: 3, found: 2, .. })
        ));
        assert!(matches!(of(&numbers(3, 99, 2)), Err(EngineError::UnequalLength { found: 99, .. })));
        let nothing = of(&Signal::new(100.0, vec![vec![0.0; 100]; 3]).unwrap()).unwrap();
        assert!(nothing.channels().iter().flatten().all(|v| *v == 0.0));
    }
}
