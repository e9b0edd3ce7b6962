//! A measured signal without what lies above a band.

use rigcast_numerics::fft::RealFftPlanner;

use super::rows::fast_len;

/// The signal without what lies far above the band: a measured argument for a regression, whose
/// velocity would otherwise be mostly noise.
pub fn smooth(signal: &[f64], band_end: f64) -> Vec<f64> {
    let n = signal.len();
    let padded = fast_len(2 * n + 64);
    // Mirrored at its end, so that the ends meet.
    let mut input: Vec<f64> = (0..padded)
        .map(|k| {
            let k = k % (2 * n).max(1);
            if k < n { signal[k] } else { signal[2 * n - 1 - k] }
        })
        .collect();
    let mut planner = RealFftPlanner::new();
    let (forward, inverse) = (planner.plan_fft_forward(padded), planner.plan_fft_inverse(padded));
    let mut lines = forward.make_output_vec();
    forward.process(&mut input, &mut lines).expect("buffers are the plan's own");
    for (line, z) in lines.iter_mut().enumerate() {
        let f = line as f64 / padded as f64;
        let over = ((f - 1.5 * band_end) / (0.5 * band_end)).clamp(0.0, 1.0);
        *z *= 0.5 * (1.0 + (std::f64::consts::PI * over).cos()) / padded as f64;
    }
    lines[0].im = 0.0;
    lines[padded / 2].im = 0.0;
    let mut out = inverse.make_output_vec();
    inverse.process(&mut lines, &mut out).expect("buffers are the plan's own");
    out.truncate(n);
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn smoothing_keeps_the_band_and_drops_what_lies_above() {
        let low: Vec<f64> = (0..1000).map(|k| (0.2 * f64::from(k)).cos()).collect();
        let both: Vec<f64> = low.iter().enumerate().map(|(k, y)| y + (2.5 * k as f64).sin()).collect();
        let smoothed = smooth(&both, 0.05);
        for k in 50..950 {
            assert!((smoothed[k] - low[k]).abs() < 0.02, "sample {k}");
        }
    }
}
