//! Operators with memory: a spring and dry friction in series, a rate limit, a smooth hysteresis.

/// The force of a spring of stiffness 1 in series with dry friction that slips at `limit` (Jenkins' element,
/// the stop operator): it follows the displacement `d` until it slips.
pub(super) fn slider(d: &[f64], limit: f64) -> Vec<f64> {
    let mut last = d.first().copied().unwrap_or(0.0);
    let step = |z: &mut f64, &x: &f64| {
        *z = (*z + x - last).clamp(-limit, limit);
        last = x;
        Some(*z)
    };
    d.iter().scan(0.0, step).collect()
}

/// Follows `d` by no more than `limit` a sample.
pub(super) fn slew(d: &[f64], limit: f64) -> Vec<f64> {
    let step = |z: &mut f64, &x: &f64| {
        *z += (x - *z).clamp(-limit, limit);
        Some(*z)
    };
    d.iter().scan(d.first().copied().unwrap_or(0.0), step).collect()
}

/// The hysteretic displacement of Bouc and Wen with exponent 1, `dz = dy (1 - |z| / limit)` while `dy` and `z`
/// have one sign, else `dz = dy`; exact for any step of `d`.
pub(super) fn bouc_wen(d: &[f64], limit: f64) -> Vec<f64> {
    let mut last = d.first().copied().unwrap_or(0.0);
    let step = |z: &mut f64, &x: &f64| {
        let side = (x - last).signum();
        let mut way = (x - last).abs();
        last = x;
        let mut along = *z * side;
        if along < 0.0 {
            let straight = way.min(-along);
            along += straight;
            way -= straight;
        }
        along = limit - (limit - along) * (-way / limit).exp();
        *z = along * side;
        Some(*z)
    };
    d.iter().scan(0.0, step).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slider_follows_to_its_limit_and_returns_at_once() {
        let d = [0.0, 0.5, 2.0, 1.5, 0.5, -0.5, -1.0];
        assert_eq!(slider(&d, 1.0), [0.0, 0.5, 1.0, 0.5, -0.5, -1.0, -1.0]);
    }

    #[test]
    fn a_rate_limit_follows_slowly_and_arrives() {
        assert_eq!(slew(&[0.0, 1.0, 1.0, 0.9], 0.5), [0.0, 0.5, 1.0, 0.9]);
    }

    #[test]
    fn a_smooth_hysteresis_does_not_depend_on_the_steps_and_stays_inside_its_limit() {
        let coarse: Vec<f64> = [0.0, 3.0, -2.0, 1.0].to_vec();
        let fine: Vec<f64> = coarse
            .windows(2)
            .flat_map(|w| (0..100).map(move |k| w[0] + (w[1] - w[0]) * f64::from(k) / 100.0))
            .chain([1.0])
            .collect();
        let (a, b) = (bouc_wen(&coarse, 0.7), bouc_wen(&fine, 0.7));
        assert!((a[3] - b[300]).abs() < 1e-12 && (a[2] - b[200]).abs() < 1e-12, "{a:?}");
        assert!(b.iter().all(|z| z.abs() < 0.7));
    }
}
