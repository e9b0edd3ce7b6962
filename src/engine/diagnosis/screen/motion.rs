//! Displacement and velocity from whatever a channel measures, inside a band.

use std::f64::consts::TAU;

use realfft::num_complex::Complex64;
use rigcast_numerics::fft::RealFftPlanner;
use serde::{Deserialize, Serialize};

use crate::Quantity;

/// The motion at a place over one record.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Motion {
    /// Displacement, or whatever stands for it.
    pub d: Vec<f64>,
    /// Its rate a second.
    pub v: Vec<f64>,
}

/// Limits of what is integrated and differentiated, Hz.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(super) struct Limits {
    /// Nothing below it is integrated: there lies drift.
    pub low_hz: f64,
    /// Nothing above it is differentiated: there lies noise.
    pub high_hz: f64,
}

/// Motion from samples of a quantity. A velocity is integrated once and an acceleration twice; anything else
/// is taken for a displacement.
pub(super) fn motion(x: &[f64], quantity: Quantity, rate_hz: f64, limits: Limits) -> Motion {
    let order = quantity.integrals() as i32;
    Motion { d: displacement(x, quantity, rate_hz, limits), v: derived(x, rate_hz, limits, 1 - order) }
}

/// Its displacement alone.
pub(super) fn displacement(x: &[f64], quantity: Quantity, rate_hz: f64, limits: Limits) -> Vec<f64> {
    match quantity.integrals() as i32 {
        0 => x.to_vec(),
        order => derived(x, rate_hz, limits, -order),
    }
}

/// Times `(2 pi i f)^power`; only an integral has a lower limit.
fn derived(x: &[f64], rate_hz: f64, limits: Limits, power: i32) -> Vec<f64> {
    let low_hz = if power < 0 { limits.low_hz } else { 0.0 };
    filtered(x, rate_hz, Limits { low_hz, ..limits }, power)
}

/// What goes with a motion of a quantity: a signal inside the limits that the quantity is integrated in.
pub(super) fn beside(x: &[f64], quantity: Quantity, rate_hz: f64, limits: Limits) -> Vec<f64> {
    if quantity.integrals() > 0 { filtered(x, rate_hz, limits, 0) } else { x.to_vec() }
}

/// Multiplies the spectrum by `(2 pi i f)^power` inside the limits; the mean stays where nothing is integrated.
///
/// The signal goes on as its mirror image, so that its ends need not meet; one that is integrated as that turned over.
/// The mirror image of an acceleration would have its rate stand still at the ends: what it moves at there would be
/// missing, and its displacement wrong by far more than itself for periods of the limit.
fn filtered(x: &[f64], rate_hz: f64, limits: Limits, power: i32) -> Vec<f64> {
    let n = x.len();
    if n < 2 {
        return vec![0.0; n];
    }
    let size = 2 * n;
    let mean = x.iter().sum::<f64>() / n as f64;
    let (centre, turned) = if power < 0 { (mean, -1.0) } else { (0.0, 1.0) };
    let mut samples: Vec<f64> = x.iter().map(|x| x - centre).collect();
    samples.extend(x.iter().rev().map(|x| turned * (x - centre)));
    let mut planner = RealFftPlanner::new();
    let forward = planner.plan_fft_forward(size);
    let mut lines = forward.make_output_vec();
    forward.process(&mut samples, &mut lines).expect("buffers are the plan's own");
    for (k, line) in lines.iter_mut().enumerate() {
        let hz = k as f64 * rate_hz / size as f64;
        let inside = hz <= limits.high_hz && hz >= limits.low_hz && hz > 0.0;
        let gain = if inside || (power == 0 && k == 0) {
            Complex64::new(0.0, TAU * hz).powi(power)
        } else {
            Complex64::new(0.0, 0.0)
        };
        // The last line of an even size is real.
        *line = if k == size / 2 { Complex64::new(0.0, 0.0) } else { *line * gain };
    }
    lines[0].im = 0.0;
    let inverse = planner.plan_fft_inverse(size);
    inverse.process(&mut lines, &mut samples).expect("buffers are the plan's own");
    samples.truncate(n);
    samples.iter_mut().for_each(|x| *x /= size as f64);
    samples
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_quantity_of_one_motion_gives_the_same_displacement_and_velocity() {
        let (rate, hz, n) = (200.0, 5.0, 2000);
        let w = TAU * hz;
        let at = |k: usize| w * (k as f64 + 0.5) / rate;
        let d: Vec<f64> = (0..n).map(|k| at(k).cos()).collect();
        let v: Vec<f64> = (0..n).map(|k| -w * at(k).sin()).collect();
        let a: Vec<f64> = (0..n).map(|k| -w * w * at(k).cos()).collect();
        let limits = Limits { low_hz: 1.0, high_hz: 50.0 };
        for (x, quantity) in
            [(&d, Quantity::Displacement), (&v, Quantity::Velocity), (&a, Quantity::Acceleration)]
        {
            let found = motion(x, quantity, rate, limits);
            for k in 500..n - 500 {
                assert!((found.d[k] - d[k]).abs() < 0.05, "{quantity:?} {k}: {} for {}", found.d[k], d[k]);
                assert!((found.v[k] - v[k]).abs() < 0.05 * w, "{quantity:?} {k}");
            }
        }
    }

    #[test]
    fn an_acceleration_that_ends_in_motion_is_integrated_to_its_end() {
        let (rate, n) = (200.0, 2000);
        // Two lines that are no multiples of each other, both in full motion at the end.
        let lines = [(3.0, 1.0), (7.3, 0.4)];
        let at = |k: usize, hz: f64| TAU * hz * (k as f64 + 0.5 - n as f64) / rate;
        let sum = |of: &dyn Fn(f64, f64) -> f64| -> Vec<f64> {
            (0..n).map(|k| lines.iter().map(|(hz, size)| size * of(at(k, *hz), TAU * hz)).sum()).collect()
        };
        let (d, a) = (sum(&|x, _| x.sin()), sum(&|x, w| -w * w * x.sin()));
        let found = displacement(&a, Quantity::Acceleration, rate, Limits { low_hz: 0.5, high_hz: 100.0 });
        for k in n - 200..n {
            assert!((found[k] - d[k]).abs() < 0.1, "{k}: {} for {}", found[k], d[k]);
        }
    }

    #[test]
    fn what_goes_with_an_integral_has_its_limits_and_what_goes_with_a_displacement_none() {
        let (rate, n) = (200.0, 4000);
        let line =
            |hz: f64| -> Vec<f64> { (0..n).map(|k| (TAU * hz * (k as f64 + 0.5) / rate).cos()).collect() };
        let (slow, quick) = (line(0.4), line(5.0));
        let both: Vec<f64> = slow.iter().zip(&quick).map(|(a, b)| a + b).collect();
        let limits = Limits { low_hz: 1.0, high_hz: 50.0 };
        assert_eq!(beside(&both, Quantity::Displacement, rate, limits), both);
        let kept = beside(&both, Quantity::Acceleration, rate, limits);
        for k in 500..n - 500 {
            assert!((kept[k] - quick[k]).abs() < 0.02, "{k}: {} for {}", kept[k], quick[k]);
        }
    }
}
