//! Drives outside what the model was fitted on: how far they are, and the way back.
//!
//! The model's trust says where: values and rates sample by sample, means, levels and spectra of each drive over short
//! times, and those of the linear response and of all means together. Unless all of it is asked for, only values count.

use super::limits::slowed;
use crate::model::{Excursion, InputRange, Preprocess, Remedy};
use crate::{EngineError, Signal};

/// Share of the way back to the limits that one iteration goes.
const TAKEN_BACK: f64 = 0.5;

/// A filter's gain falls over this share of its limit, inside: limits are set apart by it, so that the band itself passes.
const SLOPE: f64 = 0.05;

/// Takes the drives half of the way back to what the model was fitted on, `excursions` being those of the drives.
///
/// # Errors
/// A result that is not finite.
pub(super) fn taken_back(
    drive: Signal,
    ranges: &[InputRange],
    excursions: &[Excursion],
) -> Result<Signal, EngineError> {
    let rate = drive.sample_rate_hz();
    let mut channels = drive.into_channels();
    for (input, samples) in channels.iter_mut().enumerate() {
        let of: Vec<&Excursion> = excursions.iter().filter(|excursion| excursion.input == input).collect();
        if !of.is_empty() {
            towards(samples, rate, &of)?;
        }
        let Some(range) = ranges.get(input) else { continue };
        let followed = slowed(samples, range.max_rate / rate);
        for (v, followed) in samples.iter_mut().zip(followed) {
            *v += TAKEN_BACK * (followed - *v);
        }
        for v in samples.iter_mut() {
            *v -= TAKEN_BACK * beyond(*v, range);
        }
    }
    Signal::new(rate, channels)
}

/// What the excursions of one drive ask of each of its samples.
struct Wanted {
    shift: Vec<f64>,
    /// Share of what it has about its mean that is too much.
    excess: Vec<f64>,
    /// 1 where what lies outside the band is to go.
    filtered: Vec<f64>,
    band_hz: Option<[f64; 2]>,
}

fn towards(samples: &mut [f64], rate: f64, excursions: &[&Excursion]) -> Result<(), EngineError> {
    let n = samples.len();
    let mut wanted =
        Wanted { shift: vec![0.0; n], excess: vec![0.0; n], filtered: vec![0.0; n], band_hz: None };
    for excursion in excursions {
        let range = excursion.samples.clone();
        match excursion.remedy {
            // Of several the farthest: what brings it back brings back the others.
            Remedy::Shift(by) => {
                wanted.shift[range].iter_mut().filter(|found| found.abs() < by.abs()).for_each(|v| *v = by);
            }
            Remedy::Scale(kept) => {
                wanted.excess[range].iter_mut().for_each(|v| *v = v.max(1.0 - kept));
            }
            Remedy::Filter(band_hz) => {
                wanted.filtered[range].fill(1.0);
                wanted.band_hz = Some(band_hz);
            }
        }
    }
    // Steps between windows would be what the model does not know: the way back fades over half of the shortest.
    let fade = excursions.iter().map(|excursion| excursion.samples.len()).min().unwrap_or(1) / 2;
    let smooth = |wanted: &[f64]| averaged(&averaged(wanted, fade / 2), fade / 2);
    let (shift, excess) = (smooth(&wanted.shift), smooth(&wanted.excess));
    let mean = averaged(samples, 2 * fade);
    let outside = match wanted.band_hz {
        Some(band_hz) => out_of_band(samples, rate, band_hz)?,
        None => vec![0.0; n],
    };
    let filtered = smooth(&wanted.filtered);
    for (t, v) in samples.iter_mut().enumerate() {
        *v += TAKEN_BACK * (shift[t] - excess[t] * (*v - mean[t]) - filtered[t] * outside[t]);
    }
    Ok(())
}

/// Mean over so many samples to either side, fewer at the ends.
fn averaged(samples: &[f64], reach: usize) -> Vec<f64> {
    let mut sums = Vec::with_capacity(samples.len() + 1);
    sums.push(0.0);
    let mut sum = 0.0;
    sums.extend(samples.iter().map(|v| {
        sum += v;
        sum
    }));
    let at = |t: usize| {
        let (from, to) = (t.saturating_sub(reach), (t + reach + 1).min(samples.len()));
        (sums[to] - sums[from]) / (to - from) as f64
    };
    (0..samples.len()).map(at).collect()
}

/// What a drive has outside a band, its mean apart.
fn out_of_band(samples: &[f64], rate: f64, [from, to]: [f64; 2]) -> Result<Vec<f64>, EngineError> {
    let mean = samples.iter().sum::<f64>() / samples.len() as f64;
    let about: Vec<f64> = samples.iter().map(|v| v - mean).collect();
    let upper = Some(to / (1.0 - SLOPE)).filter(|hz| *hz > 0.0 && *hz < 0.5 * rate);
    let lower = Some(from / (1.0 + SLOPE)).filter(|hz| *hz > 0.0);
    // A band that ends at half the sample rate has no upper limit.
    let highest = 0.5 * rate * (1.0 - 1e-9);
    let filter = match (lower, upper) {
        (Some(lower), upper) if lower < upper.unwrap_or(highest) => {
            Preprocess { low_pass_hz: None, band_pass_hz: Some([lower, upper.unwrap_or(highest)]) }
        }
        (_, upper) => Preprocess { low_pass_hz: upper, band_pass_hz: None },
    };
    let inside = filter.apply_to(Signal::new(rate, vec![about.clone()])?)?;
    Ok(about.iter().zip(inside.channel(0)).map(|(v, inside)| v - inside).collect())
}

/// How far a value lies beyond the training range, with its sign.
fn beyond(v: f64, range: &InputRange) -> f64 {
    v - v.clamp(range.min, range.max)
}

/// How far drives are outside, as a part of the error: the mean over drives and samples of the square of what values are
/// beyond the range, relative to half of it, and the mean over samples of the square of the largest excess in any other
/// way. 0 where nothing is known.
pub(super) fn excess(drive: &Signal, ranges: &[InputRange], excursions: &[Excursion]) -> f64 {
    let (n, rate) = (drive.n_samples() as f64, drive.sample_rate_hz());
    let mut values = 0.0;
    let mut largest = vec![0.0_f64; drive.n_samples()];
    for (samples, range) in drive.channels().iter().zip(ranges) {
        let half = (range.max - range.min) / 2.0;
        if half > 0.0 {
            values += samples.iter().map(|v| (beyond(*v, range) / half).powi(2)).sum::<f64>();
        }
        for (pair, largest) in samples.windows(2).zip(&mut largest[1..]) {
            let found = (pair[1] - pair[0]).abs() * rate;
            if found > range.max_rate {
                *largest = largest.max(1.0 - range.max_rate / found);
            }
        }
    }
    for excursion in excursions {
        largest[excursion.samples.clone()].iter_mut().for_each(|v| *v = v.max(excursion.excess));
    }
    let others: f64 = largest.iter().map(|v| v * v).sum();
    values / (n * drive.n_channels() as f64) + others / n
}

#[cfg(test)]
mod tests {
    use super::*;

    const RATE: f64 = 1000.0;

    fn range() -> InputRange {
        InputRange { min: -1.0, max: 3.0, max_rate: 1e9, band_hz: None, local: None }
    }

    fn one(samples: Vec<f64>) -> Signal {
        Signal::new(RATE, vec![samples]).unwrap()
    }

    fn outside(n: usize, excess: f64, remedy: Remedy) -> Vec<Excursion> {
        vec![Excursion { samples: 0..n, input: 0, excess, remedy }]
    }

    fn tone(n: usize, hz: f64, amplitude: f64) -> Vec<f64> {
        (0..n).map(|t| amplitude * (std::f64::consts::TAU * hz * t as f64 / RATE).sin()).collect()
    }

    fn rms(samples: &[f64]) -> f64 {
        (samples.iter().map(|v| v * v).sum::<f64>() / samples.len() as f64).sqrt()
    }

    #[test]
    fn half_of_what_lies_beyond_the_training_range_is_taken_back() {
        let held = taken_back(one(vec![0.0, 5.0, -2.0]), &[range()], &[]).unwrap();
        assert_eq!(held.channel(0), [0.0, 4.0, -1.5]);
        assert_eq!(excess(&held, &[range()], &[]), (0.25 + 0.0625) / 3.0);
        assert_eq!(excess(&held, &[], &[]), 0.0);
        assert_eq!(taken_back(held.clone(), &[], &[]).unwrap(), held);
    }

    #[test]
    fn half_of_what_is_too_fast_is_taken_back() {
        let slow = InputRange { max_rate: 100.0, ..range() };
        // A tenth of a unit a sample is allowed; the step is a whole one.
        let step = one(vec![0.0, 1.0, 1.0]);
        let held = taken_back(step.clone(), &[slow], &[]).unwrap();
        assert_eq!(held.channel(0), [0.0, 0.55, 0.6]);
        let before = excess(&step, &[slow], &[]);
        assert!((before - 0.81 / 3.0).abs() < 1e-12 && excess(&held, &[slow], &[]) < before, "{before}");
        assert_eq!(excess(&one(vec![0.0, 0.1, 0.2]), &[slow], &[]), 0.0);
    }

    #[test]
    fn means_levels_and_spectra_go_half_of_the_way_back_where_they_are_outside() {
        let n = 4000;
        let shifted = |remedy: Remedy, samples: Vec<f64>| {
            let found = taken_back(one(samples), &[], &outside(n, 0.5, remedy)).unwrap();
            found.into_channels().remove(0)
        };
        let mean = shifted(Remedy::Shift(-0.8), vec![2.0; n]);
        assert!(mean.iter().all(|v| (v - 1.6).abs() < 1e-9));
        // Of one half too much a half is taken back, about the mean that stays.
        let about = |mean: f64, samples: Vec<f64>| samples.iter().map(|v| mean + v).collect::<Vec<_>>();
        let weaker = shifted(Remedy::Scale(0.5), about(1.0, tone(n, 20.0, 1.0)));
        let share = rms(&about(-1.0, weaker)) / rms(&tone(n, 20.0, 1.0));
        assert!((share - 0.75).abs() < 0.01, "{share}");
        let both: Vec<f64> =
            tone(n, 20.0, 1.0).iter().zip(tone(n, 200.0, 1.0)).map(|(a, b)| 3.0 + a + b).collect();
        for (band, kept, halved) in [([0.0, 100.0], 20.0, 200.0), ([100.0, 500.0], 200.0, 20.0)] {
            let filtered = shifted(Remedy::Filter(band), both.clone());
            let wanted = tone(n, kept, 1.0).into_iter().zip(tone(n, halved, 0.5)).map(|(a, b)| 3.0 + a + b);
            let off: Vec<f64> = filtered.iter().zip(wanted).map(|(found, wanted)| found - wanted).collect();
            assert!(rms(&off[500..n - 500]) < 0.01, "{band:?}: {}", rms(&off[500..n - 500]));
        }
    }

    #[test]
    fn the_way_back_fades_between_windows_and_what_is_inside_stays() {
        let n = 4000;
        let part = vec![Excursion { samples: 1000..1400, input: 0, excess: 0.5, remedy: Remedy::Shift(2.0) }];
        let held = taken_back(one(vec![0.0; n]), &[], &part).unwrap();
        let u = held.channel(0);
        assert_eq!((u[700], u[1700]), (0.0, 0.0));
        assert!((u[1200] - 1.0).abs() < 1e-3, "{}", u[1200]);
        assert!(u.windows(2).all(|pair| (pair[1] - pair[0]).abs() < 0.012));
        assert!((excess(&held, &[], &part) - 0.25 * 0.1).abs() < 1e-12);
    }
}
