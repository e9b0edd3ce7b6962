//! What no drive explains: lines, raised noise, quantised samples.

use rigcast_numerics::fft::RealFftPlanner;

use crate::diagnosis::numerics::ar::Ar;
use crate::diagnosis::numerics::rows::fast_len;

/// A line stands this many times above the spectrum around it.
const LINE: f64 = 25.0;
/// and holds this share of the residual's power.
const LINE_SHARE: f64 = 0.15;
/// Noise of this many times the baseline's power is raised.
const RAISED: f64 = 1.6;

/// A line in residuals.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Line {
    pub frequency_hz: f64,
    /// Share of the residual's power.
    pub share: f64,
}

/// The strongest line that stands out of the residuals over the full band, if any.
pub fn line(residuals: &[&[f64]], rate_hz: f64) -> Option<Line> {
    let shortest = residuals.iter().map(|r| r.len()).min()?;
    let n = fast_len(shortest);
    let mut power = vec![0.0; n / 2 + 1];
    let fft = RealFftPlanner::new().plan_fft_forward(n);
    let mut lines = fft.make_output_vec();
    for residual in residuals {
        let mean = residual[..n].iter().sum::<f64>() / n as f64;
        let mut input: Vec<f64> = residual[..n]
            .iter()
            .enumerate()
            .map(|(i, x)| {
                (x - mean) * (0.5 - 0.5 * (std::f64::consts::TAU * (i as f64 + 0.5) / n as f64).cos())
            })
            .collect();
        fft.process(&mut input, &mut lines).expect("buffers are the plan's own");
        power.iter_mut().zip(&lines).for_each(|(p, z)| *p += z.norm_sqr());
    }
    let total: f64 = power.iter().sum();
    let (peak, _) = power.iter().enumerate().skip(3).max_by(|a, b| a.1.total_cmp(b.1))?;
    let near: f64 = power[peak.saturating_sub(2)..(peak + 3).min(power.len())].iter().sum();
    let mut around: Vec<f64> = power[peak.saturating_sub(40)..(peak + 41).min(power.len())].to_vec();
    around.sort_by(f64::total_cmp);
    let floor = around[around.len() / 2].max(f64::MIN_POSITIVE);
    let share = near / total.max(f64::MIN_POSITIVE);
    // A resonance is many lines wide; a line is as wide as its window.
    let wide: f64 = power[peak.saturating_sub(12)..(peak + 13).min(power.len())].iter().sum();
    let narrow = near > 0.9 * wide;
    (narrow && power[peak] > LINE * floor && share > LINE_SHARE)
        .then(|| Line { frequency_hz: peak as f64 * rate_hz / n as f64, share })
}

/// Whether a line stands out of the differences of repeats too: what the drive causes is the same in
/// both, a narrow resonance included. True without repeats, `[first, second]` each.
pub fn undriven(found: Line, repeats: &[[&[f64]; 2]], rate_hz: f64) -> bool {
    repeats.is_empty()
        || repeats.iter().any(|[a, b]| {
            let difference: Vec<f64> = a.iter().zip(*b).map(|(a, b)| a - b).collect();
            line(&[&difference], rate_hz)
                .is_some_and(|line| (line.frequency_hz - found.frequency_hz).abs() < 1.0)
        })
}

/// Power of the noise over that before, if it is raised.
pub fn raised(now: &Ar, before: &Ar) -> Option<f64> {
    let ratio = now.mean_power([0.0, 0.5]) / before.mean_power([0.0, 0.5]);
    (ratio > RAISED).then_some(ratio)
}

/// Step of quantised samples: all distances of values are multiples of it and the samples are far
/// more than the values.
pub fn quantum(samples: &[f64]) -> Option<f64> {
    let mut values = samples.to_vec();
    values.sort_by(f64::total_cmp);
    values.dedup();
    if values.len() < 3 || values.len() * 4 > samples.len() {
        return None;
    }
    let mut steps: Vec<f64> = values.windows(2).map(|w| w[1] - w[0]).collect();
    steps.sort_by(f64::total_cmp);
    let step = steps[steps.len() / 4];
    let regular = steps.iter().filter(|s| {
        let multiple = *s / step;
        (multiple - multiple.round()).abs() < 0.02 && multiple > 0.5
    });
    (regular.count() * 100 >= steps.len() * 97).then_some(step)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diagnosis::core::modes::Modes;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    fn noise(n: usize, seed: u64) -> Vec<f64> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        (0..n).map(|_| StandardNormal.sample(&mut rng)).collect()
    }

    #[test]
    fn hum_is_found_at_its_frequency_and_noise_has_none() {
        let clean = noise(5000, 1);
        let hum: Vec<f64> = clean
            .iter()
            .enumerate()
            .map(|(k, x)| x + (std::f64::consts::TAU * 50.0 / 512.0 * k as f64).sin())
            .collect();
        assert!((line(&[&hum], 512.0).unwrap().frequency_hz - 50.0).abs() < 0.15);
        assert!(line(&[&clean], 512.0).is_none());
        let found = line(&[&hum], 512.0).unwrap();
        let driven: Vec<f64> = hum.iter().zip(noise(5000, 7)).map(|(h, e)| h + 0.1 * e).collect();
        assert!(undriven(found, &[[&hum, &clean]], 512.0));
        assert!(!undriven(found, &[[&hum, &driven]], 512.0));
        // A resonance is no line.
        let modes = Modes::of_values(&[
            realfft::num_complex::Complex64::from_polar(0.995, 0.2),
            realfft::num_complex::Complex64::from_polar(0.995, -0.2),
        ]);
        assert!(line(&[&modes.filter(&[1.0, 0.0], &clean)], 512.0).is_none());
    }

    #[test]
    fn a_lattice_gives_its_step_and_smooth_samples_none() {
        let samples: Vec<f64> = noise(4000, 2).iter().map(|x| (x / 0.21).round() * 0.21).collect();
        assert!((quantum(&samples).unwrap() - 0.21).abs() < 1e-9);
        assert!(quantum(&noise(4000, 3)).is_none());
    }

    #[test]
    fn noise_of_twice_the_power_is_raised() {
        assert!(raised(&Ar::white(2.0), &Ar::white(1.0)).is_some_and(|r| (r - 2.0).abs() < 1e-9));
        assert!(raised(&Ar::white(1.2), &Ar::white(1.0)).is_none());
    }
}
