use super::systems::{acceleration, noise, oscillator, recording};
use crate::Quantity;
use crate::diagnosis::numerics::linear::{mean, rms};
use crate::diagnosis::screen::arguments::arguments;
use crate::diagnosis::screen::band::Band;
use crate::diagnosis::screen::place::{Argument, Place, limits};

/// What an argument differs by from a displacement, relative to that, both about their means and beside their ends.
fn error(found: &Argument, truth: &[f64]) -> f64 {
    let rows = 300..truth.len() - 300;
    let about_mean = |x: &[f64]| -> Vec<f64> { x.iter().map(|v| v - mean(x)).collect() };
    let (d, truth) = (about_mean(&found.motion[0].d[rows.clone()]), about_mean(&truth[rows]));
    let difference: Vec<f64> = d.iter().zip(&truth).map(|(d, t)| d - t).collect();
    rms(&difference) / rms(&truth)
}

#[test]
fn two_accelerometers_that_move_together_are_told_apart_from_where_the_drives_do_it() {
    let u = noise(6000, 5);
    let first = oscillator(&u, |_, _| 0.0);
    // A mass on a stiff joint is behind by what its acceleration takes to press on that.
    let second: Vec<f64> = first.iter().zip(acceleration(&first)).map(|(y, a)| y + 2e-5 * a).collect();
    let of = |y: &[f64]| acceleration(y);
    let runs = vec![(vec![u], vec![of(&first), of(&second)])];
    let recording = recording(&[Quantity::Force], &[Quantity::Acceleration; 2], runs);
    let found = arguments(&recording, limits(&recording, Band::of(&recording)), &[6000]);
    let at = |place: Place| found.iter().find(|a| a.place == place).unwrap();
    let joint = at(Place::Between(1, 0));
    let own = at(Place::Response(0));
    assert!(joint.limits.low_hz > 1.5 * own.limits.low_hz, "{:?} {:?}", joint.limits, own.limits);
    assert!(error(own, &first) < 0.2, "{}", error(own, &first));
}
