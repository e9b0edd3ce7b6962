//! The period of drives that repeat themselves inside a record.

use rigcast_numerics::fft::RealFftPlanner;

/// Correlation of two periods from which on they are alike.
const ALIKE: f64 = 0.99;
/// Correlation that a drive falls below before it repeats itself.
const APART: f64 = 0.5;

/// The smallest number of samples after which all drives, `[drive][sample]`, repeat themselves, at least twice.
pub(super) fn period(drives: &[Vec<f64>]) -> Option<usize> {
    let n = drives.first()?.len();
    let moving: Vec<Vec<f64>> = drives
        .iter()
        .map(|x| {
            let mean = x.iter().sum::<f64>() / n as f64;
            x.iter().map(|x| x - mean).collect::<Vec<f64>>()
        })
        .filter(|x| x.iter().any(|x| *x != 0.0))
        .collect();
    let loudest = moving.iter().max_by(|a, b| energy(a).total_cmp(&energy(b)))?;
    let products = autocorrelation(loudest);
    let sums: Vec<f64> = std::iter::once(0.0)
        .chain(loudest.iter().scan(0.0, |sum, x| {
            *sum += x * x;
            Some(*sum)
        }))
        .collect();
    let correlation = |lag: usize| {
        let (head, tail) = (sums[n - lag], sums[n] - sums[lag]);
        products[lag] / (head * tail).sqrt().max(f64::MIN_POSITIVE)
    };
    let apart = (1..n / 2).find(|&lag| correlation(lag) < APART)?;
    (apart..n / 2).find(|&lag| {
        let here = correlation(lag);
        here > ALIKE
            && here >= correlation(lag - 1)
            && here >= correlation(lag + 1)
            && moving.iter().all(|x| repeats(x, lag))
    })
}

fn energy(x: &[f64]) -> f64 {
    x.iter().map(|x| x * x).sum()
}

fn repeats(x: &[f64], lag: usize) -> bool {
    let (head, tail) = (&x[..x.len() - lag], &x[lag..]);
    let product: f64 = head.iter().zip(tail).map(|(a, b)| a * b).sum();
    product > ALIKE * (energy(head) * energy(tail)).sqrt()
}

/// Sums of `x[t] x[t + lag]` for every lag.
fn autocorrelation(x: &[f64]) -> Vec<f64> {
    let size = (2 * x.len()).next_power_of_two();
    let mut planner = RealFftPlanner::new();
    let forward = planner.plan_fft_forward(size);
    let mut padded = x.to_vec();
    padded.resize(size, 0.0);
    let mut lines = forward.make_output_vec();
    forward.process(&mut padded, &mut lines).expect("buffers are the plan's own");
    for line in &mut lines {
        *line = line.norm_sqr().into();
    }
    planner.plan_fft_inverse(size).process(&mut lines, &mut padded).expect("buffers are the plan's own");
    padded.truncate(x.len());
    padded.iter_mut().for_each(|x| *x /= size as f64);
    padded
}

#[cfg(test)]
mod tests {
    use super::*;

    fn noise(n: usize, mut state: u64) -> Vec<f64> {
        let mut next = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as f64 / f64::from(1_u32 << 31) - 0.5
        };
        let mut x = 0.0;
        (0..n)
            .map(|_| {
                x = 0.8 * x + next();
                x
            })
            .collect()
    }

    #[test]
    fn a_repeated_drive_has_its_period_in_spite_of_noise_and_random_noise_has_none() {
        let one = noise(500, 1);
        let own = noise(2200, 2);
        let several: Vec<f64> = (0..2200).map(|k| one[k % 500] + 0.02 * own[k]).collect();
        assert_eq!(period(&[several]), Some(500));
        assert_eq!(period(&[own]), None);
    }

    #[test]
    fn drives_of_different_periods_repeat_with_both() {
        let (a, b) = (noise(60, 3), noise(90, 4));
        let of = |x: &[f64]| -> Vec<f64> { (0..900).map(|k| x[k % x.len()]).collect() };
        assert_eq!(period(&[of(&a), of(&b)]), Some(180));
        assert_eq!(period(&[vec![1.0; 50]]), None);
    }
}
