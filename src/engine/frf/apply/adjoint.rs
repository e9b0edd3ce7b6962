//! The adjoint of an FRF as a filter: from weights on the outputs to those on the inputs.

use std::ops::Range;

use rayon::prelude::*;
use realfft::num_complex::Complex64;

use super::FrfFilter;
use crate::{EngineError, Signal, first_not_finite};

impl FrfFilter {
    /// `J^T w`, `[input, sample]`, as long as `w` (at least one sample), where `J` is the derivative of the response by the
    /// inputs: exactly that of [`FrfFilter::apply`], the values held beyond either end included. The unit is that of the
    /// weights `w`, `[output, sample]`, times output unit / input unit.
    ///
    /// # Errors
    /// Another channel count or sample rate, no samples, a result that is not finite.
    pub fn adjoint(&self, w: &Signal) -> Result<Signal, EngineError> {
        self.check("weights of the FRF's outputs", w, self.y_mean.len())?;
        let (nx, n) = (self.x_mean.len(), w.n_samples());
        // Outputs depend on held inputs up to half the taps beyond either end. Those are computed as samples of their own
        // and then added to the value that is held there.
        let (reach, step) = (self.taps / 2, self.block - self.taps + 1);
        let total = n + self.taps;
        let starts: Vec<usize> = (0..total).step_by(step).collect();
        let parts: Vec<Vec<Vec<f64>>> =
            starts.par_iter().map(|&start| self.back_through(w, start..total.min(start + step))).collect();
        let mut x = vec![vec![0.0; n]; nx];
        for (start, part) in starts.iter().zip(&parts) {
            for (x, part) in x.iter_mut().zip(part) {
                for (place, v) in (*start..).zip(part) {
                    x[place.saturating_sub(reach).min(n - 1)] += v;
                }
            }
        }
        for (channel, x) in x.iter().enumerate() {
            if let Some(sample) = first_not_finite(x) {
                return Err(EngineError::NonFiniteResult { what: "adjoint of the FRF", channel, sample });
            }
        }
        Ok(Signal::of_checked(w.sample_rate_hz(), x))
    }

    /// The weights on some samples of each input, counted from half the taps before the start, as if no sample were held.
    fn back_through(&self, w: &Signal, places: Range<usize>) -> Vec<Vec<f64>> {
        let bins = self.block / 2 + 1;
        let (nx, ny) = (self.x_mean.len(), self.y_mean.len());
        let (mut real, mut lines) = (self.forward.make_input_vec(), vec![Complex64::default(); ny * bins]);
        // The impulse response begins half the taps before time 0, so that place `p` needs the outputs from
        // sample `p - taps` on.
        let first = places.start as isize - self.taps as isize;
        for (output, lines) in lines.chunks_exact_mut(bins).enumerate() {
            let samples = w.channel(output);
            for (t, v) in (first..).zip(&mut real) {
                *v = usize::try_from(t).ok().and_then(|t| samples.get(t)).copied().unwrap_or(0.0);
            }
            self.forward.process(&mut real, lines).expect("buffers are the plan's own");
        }
        let mut sum = self.forward.make_output_vec();
        let of_input = |input: usize| {
            sum.fill(Complex64::default());
            for (output, lines) in lines.chunks_exact(bins).enumerate() {
                let h = &self.spectra[(output * nx + input) * bins..][..bins];
                for ((sum, h), line) in sum.iter_mut().zip(h).zip(lines) {
                    *sum += h.conj() * line;
                }
            }
            // Rounding leaves a trace in what is real by symmetry; the inverse refuses it.
            sum[0].im = 0.0;
            sum[bins - 1].im = 0.0;
            self.inverse.process(&mut sum, &mut real).expect("buffers are the plan's own");
            real[..places.len()].to_vec()
        };
        (0..nx).map(of_input).collect()
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::frf::Frf;

    #[test]
    fn weights_and_responses_have_the_same_product_on_either_side() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let mut draw = |n: usize| (0..n).map(|_| rng.random_range(-1.0..1.0)).collect::<Vec<f64>>();
        let (n_inputs, n_outputs, segment_len) = (2, 3, 32);
        let lines = segment_len / 2 + 1;
        let (re, im) = (draw(lines * n_inputs * n_outputs), draw(lines * n_inputs * n_outputs));
        let frf = Frf {
            sample_rate_hz: 100.0,
            segment_len,
            n_inputs,
            n_outputs,
            h: re.into_iter().zip(im).map(|(re, im)| Complex64::new(re, im)).collect(),
            usable_hz: [0.0, 50.0],
            x_mean: vec![0.0; n_inputs],
            y_mean: vec![0.0; n_outputs],
        };
        let filter = frf.filter().unwrap();
        // Shorter than the taps, one block, and several.
        for n in [1, 7, 31, 97, 500] {
            let mut signal =
                |channels: usize| Signal::new(100.0, (0..channels).map(|_| draw(n)).collect()).unwrap();
            let (x, w) = (signal(n_inputs), signal(n_outputs));
            let product = |a: &Signal, b: &Signal| -> f64 {
                a.channels().iter().flatten().zip(b.channels().iter().flatten()).map(|(a, b)| a * b).sum()
            };
            let (ahead, back) =
                (product(&filter.apply(&x).unwrap(), &w), product(&filter.adjoint(&w).unwrap(), &x));
            assert!((ahead - back).abs() < 1e-9 * (1.0 + ahead.abs()), "{n}: {ahead} {back}");
        }
        let none = filter.adjoint(&Signal::new(100.0, vec![vec![]; 3]).unwrap());
        assert!(matches!(none, Err(EngineError::TooShort { .. })));
        let two = filter.adjoint(&Signal::new(100.0, vec![vec![0.0]; 2]).unwrap());
        assert!(matches!(two, Err(EngineError::ChannelCount { expected: 3, found: 2, .. })));
    }
}
