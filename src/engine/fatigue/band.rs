//! Damage of the signals within a band around a signal.

use super::damage::{DamageSettings, damage};
use super::turning::turning_points;
use crate::EngineError;

/// Damage of the least and of the largest swings that fit into `signal` plus and minus `half_width`, `[low, high]`; both as
/// long as each other.
///
/// The least swings are those of a backlash as wide as the band: they go on in one direction only as far as the band makes
/// them. The largest ones leave each maximum upwards and each minimum downwards by the half width.
///
/// # Errors
/// Settings outside their limits; a number that is not finite; damage beyond `f64`.
pub fn damage_band(
    signal: &[f64],
    half_width: &[f64],
    settings: &DamageSettings,
) -> Result<[f64; 2], EngineError> {
    if half_width.len() != signal.len() {
        let (expected, found) = (signal.len(), half_width.len());
        return Err(EngineError::UnequalLength { what: "half width", channel: 0, expected, found });
    }
    let mut at = signal.first().copied().unwrap_or_default();
    let least = signal.iter().zip(half_width).map(|(y, h)| {
        at = at.max(y - h).min(y + h);
        at
    });
    let low = damage(&least.collect::<Vec<f64>>(), settings)?;
    let high = damage(&outwards(signal, half_width), settings)?;
    // The first swing of a backlash may begin anywhere in the band.
    Ok([low.min(high), high])
}

/// The turning points of a signal, each moved away from its neighbours.
fn outwards(signal: &[f64], half_width: &[f64]) -> Vec<f64> {
    let points = turning_points(signal);
    let moved = |(i, point): (usize, &super::TurningPoint)| {
        let neighbour = if i == 0 { points.get(1) } else { points.get(i - 1) };
        let h = half_width[point.index];
        match neighbour {
            Some(other) if other.value > point.value => point.value - h,
            Some(_) => point.value + h,
            None => point.value,
        }
    };
    points.iter().enumerate().map(moved).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const SETTINGS: DamageSettings =
        DamageSettings { slope: 5.0, constant: 1e7, residue: super::super::Residue::Repeated, directions: 1 };

    fn sine(n: usize, amplitude: f64) -> Vec<f64> {
        (0..n).map(|t| amplitude * (t as f64 * std::f64::consts::TAU / 40.0).sin()).collect()
    }

    #[test]
    fn a_sine_has_the_damage_of_the_sines_at_the_edges_of_its_band() {
        let (y, h) = (sine(4000, 2.0), vec![0.2; 4000]);
        let [low, high] = damage_band(&y, &h, &SETTINGS).unwrap();
        let of = |amplitude: f64| damage(&sine(4000, amplitude), &SETTINGS).unwrap();
        assert!((low / of(1.8) - 1.0).abs() < 0.05, "{low} {}", of(1.8));
        assert!((high / of(2.2) - 1.0).abs() < 0.05, "{high} {}", of(2.2));
    }

    #[test]
    fn a_band_without_width_has_one_damage_and_one_wider_than_the_signal_reaches_down_to_none() {
        let y = sine(1000, 2.0);
        let d = damage(&y, &SETTINGS).unwrap();
        let [low, high] = damage_band(&y, &vec![0.0; 1000], &SETTINGS).unwrap();
        assert!((low / d - 1.0).abs() < 1e-12 && (high / d - 1.0).abs() < 1e-12);
        let [low, high] = damage_band(&y, &vec![3.0; 1000], &SETTINGS).unwrap();
        assert!(low == 0.0 && high > 50.0 * d, "{low} {high}");
        assert_eq!(damage_band(&[], &[], &SETTINGS).unwrap(), [0.0, 0.0]);
        assert!(damage_band(&y, &[1.0], &SETTINGS).is_err());
    }
}
