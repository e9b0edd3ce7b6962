//! From what a path of the core gives out back to what went in, where noise allows.

use realfft::num_complex::Complex64;
use rigcast_numerics::fft::RealFftPlanner;

use crate::diagnosis::numerics::ar::Ar;

/// Share of a stretch at each end that the taper and the unknown past spoil.
pub(super) const SPOILT: f64 = 0.06;

/// Wiener's inverse of `answer` (an impulse response) on `gap`, with a flat spectrum of what is
/// looked for that is as strong as the gap says.
pub(super) fn divided(gap: &[f64], answer: &[f64], noise: &Ar, band_end: f64) -> Vec<f64> {
    let n = gap.len();
    let mut planner = RealFftPlanner::new();
    let (forward, inverse) = (planner.plan_fft_forward(n), planner.plan_fft_inverse(n));
    let edge = ((n as f64 * SPOILT) as usize).max(1);
    let taper = |i: usize| {
        let end = i.min(n - 1 - i);
        if end >= edge { 1.0 } else { 0.5 - 0.5 * (std::f64::consts::PI * end as f64 / edge as f64).cos() }
    };
    let lines = |x: &mut [f64]| -> Vec<Complex64> {
        let mut lines = forward.make_output_vec();
        forward.process(x, &mut lines).expect("buffers are the plan's own");
        lines
    };
    let mut gap_lines = lines(&mut gap.iter().enumerate().map(|(i, g)| g * taper(i)).collect::<Vec<f64>>());
    let path = lines(&mut answer.to_vec());
    let floor = |line: usize| noise.power(line as f64 / n as f64) * n as f64;
    let systematic: f64 =
        gap_lines.iter().enumerate().map(|(line, g)| (g.norm_sqr() - floor(line)).max(0.0)).sum();
    let passed: f64 = path.iter().map(Complex64::norm_sqr).sum();
    let sought = systematic / passed.max(f64::MIN_POSITIVE);
    for (line, (g, h)) in gap_lines.iter_mut().zip(&path).enumerate() {
        let f = line as f64 / n as f64;
        // Far above the band the core was never seen.
        let over = ((f - 2.0 * band_end) / band_end).clamp(0.0, 1.0);
        let fade = 0.5 * (1.0 + (std::f64::consts::PI * over).cos());
        let weight = h.norm_sqr() * sought + floor(line);
        *g *=
            if weight > 0.0 { h.conj() * (fade * sought / weight / n as f64) } else { Complex64::default() };
    }
    gap_lines[0].im = 0.0;
    gap_lines[n / 2].im = 0.0;
    let mut out = inverse.make_output_vec();
    inverse.process(&mut gap_lines, &mut out).expect("buffers are the plan's own");
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    #[test]
    fn what_went_in_is_found_again_and_noise_is_not_blown_up() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut normal = move || -> f64 { StandardNormal.sample(&mut rng) };
        let n = 4000;
        let slow: Vec<f64> = (0..n).map(|k| (0.11 * k as f64).sin() * (0.013 * k as f64).cos()).collect();
        let answer: Vec<f64> = (0..n).map(|k| 0.2 * 0.8_f64.powi(k)).collect();
        let mut state = 0.0;
        let clean: Vec<f64> = slow
            .iter()
            .map(|u| {
                state = 0.8 * state + 0.2 * u;
                state
            })
            .collect();
        let noise: Vec<f64> = (0..n).map(|_| normal()).collect();
        let error = |level: f64, believed: f64| {
            let gap: Vec<f64> = clean.iter().zip(&noise).map(|(y, e)| y + level * e).collect();
            let found = divided(&gap, &answer, &Ar::white(believed * believed), 0.1);
            let kept = 400..3600;
            let power: f64 = kept.clone().map(|k| (found[k] - slow[k]).powi(2)).sum();
            (power / kept.len() as f64).sqrt()
        };
        let quiet = error(1e-3, 1e-3);
        assert!(quiet < 0.02, "{quiet}");
        let (wary, plain) = (error(0.3, 0.3), error(0.3, 1e-6));
        assert!(wary < 0.7 * plain, "{wary} {plain}");
    }
}
