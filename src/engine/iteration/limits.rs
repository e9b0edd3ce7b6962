//! Limits of single drives.

use super::DriveLimit;

/// Brings one drive within its limits; returns the share of its samples that they changed. The order is rate, RMS,
/// peak, so that the peak holds whatever the others did.
pub(super) fn hold(samples: &mut [f64], sample_rate_hz: f64, limit: &DriveLimit) -> f64 {
    let free = samples.to_vec();
    if let Some(rate) = limit.rate {
        samples.copy_from_slice(&slowed(samples, rate / sample_rate_hz));
    }
    if let Some(most) = limit.rms {
        let mean = samples.iter().sum::<f64>() / samples.len() as f64;
        let rms = (samples.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / samples.len() as f64).sqrt();
        if rms > most {
            samples.iter_mut().for_each(|v| *v = mean + (*v - mean) * most / rms);
        }
    }
    if let Some(peak) = limit.peak {
        samples.iter_mut().for_each(|v| *v = v.clamp(-peak, peak));
    }
    let changed = samples.iter().zip(&free).filter(|(held, free)| held != free).count();
    changed as f64 / samples.len() as f64
}

/// A drive that changes by at most `step` from sample to sample, as it would follow another.
pub(super) fn slowed(samples: &[f64], step: f64) -> Vec<f64> {
    let mut at = samples.first().copied().unwrap_or_default();
    let follow = |v: &f64| {
        at = v.clamp(at - step, at + step);
        at
    };
    samples.iter().map(follow).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_limit_holds_and_the_share_of_changed_samples_is_told() {
        let free = [0.0, 4.0, -4.0, 0.5];
        let held = |limit: DriveLimit| {
            let mut samples = free;
            let share = hold(&mut samples, 10.0, &limit);
            (samples, share)
        };
        assert_eq!(held(DriveLimit::default()), (free, 0.0));
        let peak = held(DriveLimit { peak: Some(2.0), ..DriveLimit::default() });
        assert_eq!(peak, ([0.0, 2.0, -2.0, 0.5], 0.5));
        let (slow, _) = held(DriveLimit { rate: Some(10.0), ..DriveLimit::default() });
        assert_eq!(slow, [0.0, 1.0, 0.0, 0.5]);
        let (quiet, share) = held(DriveLimit { rms: Some(1.0), ..DriveLimit::default() });
        let mean = quiet.iter().sum::<f64>() / 4.0;
        let rms = (quiet.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / 4.0).sqrt();
        assert!((rms - 1.0).abs() < 1e-12 && (mean - 0.125).abs() < 1e-12 && share > 0.7, "{quiet:?}");
        // After the other limits, too.
        let all = DriveLimit { peak: Some(0.5), rms: Some(1.0), rate: Some(100.0) };
        assert!(held(all).0.iter().all(|v| v.abs() <= 0.5));
    }
}
