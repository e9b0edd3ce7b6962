//! Autoregressive noise: a smooth spectrum from few numbers.

use realfft::num_complex::Complex64;

/// Share of a sum of white noise that a sample keeps of the one before.
const KEPT: f64 = 0.999;

/// `x_k + sum_i a_i x_(k-i) = e_k` with the variance of `e`.
#[derive(Debug, Clone, PartialEq)]
pub struct Ar {
    /// `a_1, a_2, ...`; none for white noise.
    pub coefficients: Vec<f64>,
    /// Variance of the innovation, unit^2.
    pub variance: f64,
}

impl Ar {
    /// White noise.
    pub fn white(variance: f64) -> Self {
        Self { coefficients: Vec::new(), variance }
    }

    /// White noise summed up so many times, without what is slower than a thousand samples.
    pub fn integrated(variance: f64, times: usize) -> Self {
        let mut coefficients = vec![0.0; times + 1];
        coefficients[0] = 1.0;
        for _ in 0..times {
            for i in (1..=times).rev() {
                coefficients[i] -= KEPT * coefficients[i - 1];
            }
        }
        Self { coefficients: coefficients.split_off(1), variance }
    }

    /// Power per sample at `frequency` (cycles a sample): its mean over all frequencies is the
    /// variance of the signal.
    pub fn power(&self, frequency: f64) -> f64 {
        let w = std::f64::consts::TAU * frequency;
        let mut sum = Complex64::new(1.0, 0.0);
        for (i, a) in self.coefficients.iter().enumerate() {
            sum += Complex64::from_polar(*a, -w * (i + 1) as f64);
        }
        self.variance / sum.norm_sqr()
    }

    /// Fits stretches of one process by Levinson and Durbin's recursion, the order up to
    /// `max_order` by Akaike's criterion (Ljung, System Identification, section 16.4).
    ///
    /// Samples that are all zero give the smallest white noise that is still positive.
    pub fn fit(stretches: &[&[f64]], max_order: usize) -> Self {
        let total: usize = stretches.iter().map(|s| s.len()).sum();
        let max_order = max_order.min(total / 10);
        let mut r = vec![0.0; max_order + 1];
        for stretch in stretches {
            for (lag, r) in r.iter_mut().enumerate() {
                *r += stretch.iter().zip(stretch.get(lag..).unwrap_or(&[])).map(|(a, b)| a * b).sum::<f64>();
            }
        }
        let n = total.max(1) as f64;
        r.iter_mut().for_each(|r| *r /= n);
        if r[0] <= 0.0 {
            return Self::white(f64::MIN_POSITIVE.sqrt());
        }
        // A trace of white noise bounds the depth of the spectrum's valleys.
        r[0] *= 1.0 + 1e-9;
        let mut best = Self::white(r[0]);
        let mut best_aic = n * r[0].ln();
        let (mut a, mut variance) = (Vec::<f64>::new(), r[0]);
        for order in 1..=max_order {
            let reflection =
                -(r[order] + a.iter().enumerate().map(|(i, a)| a * r[order - 1 - i]).sum::<f64>()) / variance;
            if reflection.is_nan() || reflection.abs() >= 1.0 {
                break;
            }
            let previous = a.clone();
            for (i, a) in a.iter_mut().enumerate() {
                *a += reflection * previous[order - 2 - i];
            }
            a.push(reflection);
            variance *= 1.0 - reflection * reflection;
            let aic = n * variance.ln() + 2.0 * order as f64;
            if aic < best_aic {
                best_aic = aic;
                best = Self { coefficients: a.clone(), variance };
            }
        }
        best
    }

    /// Fits stretches of one process as [`Ar::fit`] does, beside a colour that it has about: few numbers cannot tell a
    /// valley from a peak that is millions of times as high.
    pub fn fit_beside(about: &Self, stretches: &[&[f64]], max_order: usize) -> Self {
        let whitened: Vec<Vec<f64>> = stretches.iter().map(|s| about.whitened(s)).collect();
        let whitened: Vec<&[f64]> = whitened.iter().map(Vec::as_slice).collect();
        let beside = Self::fit(&whitened, max_order);
        let of =
            |ar: &Self| std::iter::once(1.0).chain(ar.coefficients.iter().copied()).collect::<Vec<f64>>();
        let (a, b) = (of(about), of(&beside));
        let mut product = vec![0.0; a.len() + b.len() - 1];
        for (i, a) in a.iter().enumerate() {
            for (j, b) in b.iter().enumerate() {
                product[i + j] += a * b;
            }
        }
        Self { coefficients: product.split_off(1), variance: beside.variance }
    }

    /// The innovations of a stretch, from where all that they follow from is known.
    fn whitened(&self, x: &[f64]) -> Vec<f64> {
        let order = self.coefficients.len();
        let innovation =
            |k: usize| x[k] + self.coefficients.iter().zip(1..).map(|(a, i)| a * x[k - i]).sum::<f64>();
        (order..x.len()).map(innovation).collect()
    }

    /// Mean power per sample over a band, cycles a sample.
    pub fn mean_power(&self, band: [f64; 2]) -> f64 {
        self.mean_power_over(&Self::white(1.0), band)
    }

    /// Mean over a band of the power relative to another's.
    pub fn mean_power_over(&self, other: &Self, band: [f64; 2]) -> f64 {
        const POINTS: usize = 200;
        let step = (band[1] - band[0]) / POINTS as f64;
        let at = |i: usize| band[0] + (i as f64 + 0.5) * step;
        (0..POINTS).map(|i| self.power(at(i)) / other.power(at(i))).sum::<f64>() / POINTS as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    #[test]
    fn a_second_order_process_is_found_again() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut x = vec![0.0; 60_000];
        for k in 2..x.len() {
            let e: f64 = StandardNormal.sample(&mut rng);
            x[k] = 1.5 * x[k - 1] - 0.8 * x[k - 2] + 0.5 * e;
        }
        let ar = Ar::fit(&[&x[1000..]], 12);
        let truth = Ar { coefficients: vec![-1.5, 0.8], variance: 0.25 };
        for f in [0.0, 0.05, 0.1, 0.2, 0.45] {
            assert!(
                (ar.power(f) / truth.power(f)).ln().abs() < 0.15,
                "{f}: {} {}",
                ar.power(f),
                truth.power(f)
            );
        }
    }

    #[test]
    fn summed_noise_falls_by_the_square_of_the_frequency_at_each_sum() {
        assert_eq!(Ar::integrated(2.0, 0), Ar::white(2.0));
        for times in 1..=2 {
            let ar = Ar::integrated(1.0, times);
            let ratio = ar.power(0.01) / ar.power(0.02);
            assert!((ratio / 4.0_f64.powi(times as i32) - 1.0).abs() < 0.01, "{times}: {ratio}");
        }
        let over = Ar::integrated(3.0, 2).mean_power_over(&Ar::integrated(1.0, 2), [0.01, 0.3]);
        assert!((over - 3.0).abs() < 1e-9, "{over}");
    }

    #[test]
    fn a_valley_far_below_a_peak_is_found_beside_the_colour_that_it_has() {
        // White noise summed up twice: between 0.4 and 0.002 cycles a sample its power grows by 4e8.
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let about = Ar::integrated(1.0, 2);
        let mut x = vec![0.0; 30_000];
        for k in 2..x.len() {
            let e: f64 = StandardNormal.sample(&mut rng);
            let before: f64 = about.coefficients.iter().zip(1..).map(|(a, i)| a * x[k - i]).sum();
            x[k] = 0.1 * e - before;
        }
        let found = Ar::fit_beside(&about, &[&x], 24);
        for f in [0.002, 0.05, 0.4] {
            assert!((found.power(f) / (0.01 * about.power(f))).ln().abs() < 0.15, "{f}: {}", found.power(f));
        }
        assert_eq!(Ar::fit_beside(&Ar::white(1.0), &[&x], 24), Ar::fit(&[&x], 24));
    }

    #[test]
    fn white_noise_keeps_its_variance_and_silence_stays_positive() {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let x: Vec<f64> = (0..20_000).map(|_| StandardNormal.sample(&mut rng)).collect();
        let mean: f64 = (0..100).map(|i| Ar::fit(&[&x], 8).power(f64::from(i) * 0.005)).sum::<f64>() / 100.0;
        assert!((mean - 1.0).abs() < 0.05, "{mean}");
        assert!(Ar::fit(&[&[0.0; 100]], 8).power(0.1) > 0.0);
    }
}
