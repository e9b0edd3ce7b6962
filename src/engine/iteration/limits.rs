//! What a drive may not do: leave its limits, or what the model was fitted on.

use super::{DriveLimit, Outside};
use crate::model::InputRange;

/// Share of what lies beyond the training range that one iteration takes back.
const TAKEN_BACK: f64 = 0.5;

/// Brings one drive towards the training range and within its limits; returns the share of its samples that the
/// limits changed. The order is range, rate, RMS, peak, so that the peak holds whatever the others did.
pub(super) fn hold(
    samples: &mut [f64],
    sample_rate_hz: f64,
    limit: &DriveLimit,
    range: Option<&InputRange>,
    outside: Outside,
) -> f64 {
    if let Some(range) = range.filter(|_| outside == Outside::Penalised) {
        for v in samples.iter_mut() {
            *v -= TAKEN_BACK * beyond(*v, range);
        }
    }
    let free = samples.to_vec();
    if let Some(rate) = limit.rate {
        let step = rate / sample_rate_hz;
        for i in 1..samples.len() {
            samples[i] = samples[i].clamp(samples[i - 1] - step, samples[i - 1] + step);
        }
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

/// How far a value lies beyond the training range, with its sign.
fn beyond(v: f64, range: &InputRange) -> f64 {
    v - v.clamp(range.min, range.max)
}

/// Mean square of what lies beyond the training range, relative to the square of half the range; 0 where the
/// range is unknown or no range at all.
pub(super) fn excess(samples: &[f64], range: Option<&InputRange>) -> f64 {
    let Some(range) = range else { return 0.0 };
    let half = (range.max - range.min) / 2.0;
    if half <= 0.0 {
        return 0.0;
    }
    samples.iter().map(|v| (beyond(*v, range) / half).powi(2)).sum::<f64>() / samples.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn range() -> InputRange {
        InputRange { min: -1.0, max: 3.0, max_rate: 1e3, band_hz: None, local: None }
    }

    #[test]
    fn each_limit_holds_and_the_share_of_changed_samples_is_told() {
        let free = [0.0, 4.0, -4.0, 0.5];
        let held = |limit: DriveLimit| {
            let mut samples = free;
            let share = hold(&mut samples, 10.0, &limit, None, Outside::Allowed);
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

    #[test]
    fn half_of_what_lies_beyond_the_training_range_is_taken_back() {
        let mut samples = [0.0, 5.0, -2.0];
        let share = hold(&mut samples, 10.0, &DriveLimit::default(), Some(&range()), Outside::Penalised);
        assert_eq!((samples, share), ([0.0, 4.0, -1.5], 0.0));
        assert_eq!(excess(&samples, Some(&range())), (0.25 + 0.0625) / 3.0);
        assert_eq!(excess(&samples, None), 0.0);
        hold(&mut samples, 10.0, &DriveLimit::default(), Some(&range()), Outside::Allowed);
        assert_eq!(samples, [0.0, 4.0, -1.5]);
    }
}
