//! How far a drive is outside what a model was fitted on over short times, in numbers, and what would bring it back.

use std::ops::Range;

use super::beyond::Way;
use super::local::each_window;
use super::watch::SpectrumWatch;
use super::{InputRange, band};
use crate::Signal;
use crate::model::RigModel;

/// One input over the samples that a window speaks for, outside in one way.
#[derive(Debug, Clone, PartialEq)]
pub struct Excursion {
    /// Samples.
    pub samples: Range<usize>,
    /// The input.
    pub input: usize,
    /// How far it is outside: of means relative to half the input's range; of levels, of the linear response and of all
    /// means together, the share of them that is beyond the limit; of a spectrum, the share of its amplitude outside the
    /// band that is beyond the share allowed. 0 at the limit.
    pub excess: f64,
    /// What would bring it back to the limit.
    pub remedy: Remedy,
}

/// What brings an input back to a limit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Remedy {
    /// This is added, channel unit.
    Shift(f64),
    /// What it has about its mean is multiplied by this, 0..1.
    Scale(f64),
    /// What lies outside this band is removed, Hz.
    Filter([f64; 2]),
}

/// The excursions of inputs behind the model's filter; `watch` is the model's.
pub(in crate::model) fn excursions(
    model: &RigModel,
    watch: Option<&SpectrumWatch>,
    x: &Signal,
) -> Vec<Excursion> {
    let mut found = Vec::new();
    for (input, range) in model.range.iter().enumerate() {
        dwelling(range, input, x.channel(input), &mut found);
    }
    let Some(seen) = watch.and_then(|watch| watch.look(x)) else { return found };
    for (samples, powers) in &seen.powers {
        for (input, range) in model.range.iter().enumerate() {
            let [out, all] = powers[input];
            if band::is_outside(powers[input], range) {
                found.push(Excursion {
                    samples: samples.clone(),
                    input,
                    excess: (out / all).sqrt() - band::SHARE.sqrt(),
                    remedy: Remedy::Filter(seen.bands.of_input(input)),
                });
            }
        }
    }
    for (samples, levels) in &seen.levels {
        for (place, (range, levels)) in model.window_range.iter().zip(levels).enumerate() {
            for (way, limit) in range.limits() {
                if way.beyond(levels, limit) {
                    driven(model, x, samples, (place, way, way.level(levels), limit), &mut found);
                }
            }
        }
    }
    let Some(joint) = &model.joint_range else { return found };
    let limit = joint.limit();
    for (samples, apart) in seen.distances.iter().filter(|(_, apart)| apart.distance > limit) {
        let excess = 1.0 - limit / apart.distance;
        found.extend(joint.middle.iter().enumerate().map(|(input, middle)| {
            let remedy = Remedy::Shift(excess * (middle - mean(x, input, samples)));
            Excursion { samples: samples.clone(), input, excess, remedy }
        }));
    }
    found
}

/// Windows in which one input has a mean or a level that the training did not have.
fn dwelling(range: &InputRange, input: usize, samples: &[f64], found: &mut Vec<Excursion>) {
    let Some(local) = &range.local else { return };
    let half = (range.max - range.min) / 2.0;
    each_window(samples, local.window, |part, mean, rms| {
        for (way, limit) in local.limits([range.min, range.max]) {
            let levels = [mean, rms];
            if !way.beyond(&levels, limit) {
                continue;
            }
            let level = way.level(&levels);
            let (excess, remedy) = match way {
                Way::High | Way::Low => (relative(level - limit, half), Remedy::Shift(limit - level)),
                Way::Strong | Way::Fast | Way::Tonal => scale(level, limit),
            };
            found.push(Excursion { samples: part.clone(), input, excess, remedy });
        }
    });
}

/// A window in which the linear response at an output is beyond a limit, to which all inputs add; without an FRF, an input.
fn driven(
    model: &RigModel,
    x: &Signal,
    samples: &Range<usize>,
    (place, way, level, limit): (usize, Way, f64, f64),
    found: &mut Vec<Excursion>,
) {
    let mut add = |input: usize, excess: f64, remedy: Remedy| {
        found.push(Excursion { samples: samples.clone(), input, excess, remedy });
    };
    let is_mean = matches!(way, Way::High | Way::Low);
    match &model.frf {
        Some(frf) if is_mean => {
            // The mean of the response leaves its working point in proportion to those of the inputs.
            let working_point = frf.y_mean[place];
            let kept = ((limit - working_point) / (level - working_point)).clamp(0.0, 1.0);
            for (input, middle) in frf.x_mean.iter().enumerate() {
                let shift = (1.0 - kept) * (middle - mean(x, input, samples));
                add(input, 1.0 - kept, Remedy::Shift(shift));
            }
        }
        Some(frf) => {
            let (excess, remedy) = scale(level, limit);
            (0..frf.n_inputs).for_each(|input| add(input, excess, remedy));
        }
        None if is_mean => {
            let range = &model.range[place];
            let excess = relative(level - limit, (range.max - range.min) / 2.0);
            add(place, excess, Remedy::Shift(limit - level));
        }
        None => {
            let (excess, remedy) = scale(level, limit);
            add(place, excess, remedy);
        }
    }
}

/// A level brought down to its limit.
fn scale(level: f64, limit: f64) -> (f64, Remedy) {
    let kept = (limit / level).clamp(0.0, 1.0);
    (1.0 - kept, Remedy::Scale(kept))
}

/// An input that never moved has no range: whatever moves it is far outside.
fn relative(excess: f64, half: f64) -> f64 {
    if half > 0.0 { excess.abs() / half } else { 1.0 }
}

fn mean(x: &Signal, input: usize, samples: &Range<usize>) -> f64 {
    x.channel(input)[samples.clone()].iter().sum::<f64>() / samples.len() as f64
}

#[cfg(test)]
mod tests {
    use realfft::num_complex::Complex64;

    use super::*;
    use crate::frf::Frf;
    use crate::model::tests::made_up;
    use crate::model::{JointRange, LocalRange, ModelKind, WindowRange};

    const RATE: f64 = 1000.0;
    const N: usize = 8192;

    /// Two inputs that add up, known from 0 to 100 Hz.
    fn model() -> RigModel {
        let frf = Frf {
            sample_rate_hz: RATE,
            segment_len: 1000,
            n_inputs: 2,
            n_outputs: 1,
            h: vec![Complex64::from(1.0); 2 * 501],
            usable_hz: [0.0, 100.0],
            x_mean: vec![0.0; 2],
            y_mean: vec![0.0],
        };
        let range =
            InputRange { min: -4.0, max: 4.0, max_rate: 1e9, band_hz: Some([0.0, 100.0]), local: None };
        RigModel { frf: Some(frf), sample_rate_hz: RATE, range: vec![range; 2], ..made_up(ModelKind::Frf) }
    }

    fn tone(hz: f64, amplitude: f64, mean: f64) -> Vec<f64> {
        let at = |t: usize| mean + amplitude * (std::f64::consts::TAU * hz * t as f64 / RATE).sin();
        (0..N).map(at).collect()
    }

    fn found(model: &RigModel, u: Vec<f64>, v: Vec<f64>) -> Vec<Excursion> {
        let x = Signal::new(RATE, vec![u, v]).unwrap();
        excursions(model, SpectrumWatch::new(model).as_ref(), &x)
    }

    /// The inputs that are outside, all in one way and all the time.
    fn of_all(found: &[Excursion], inputs: &[usize], like: impl Fn(f64, Remedy) -> bool) {
        for &input in inputs {
            let of: Vec<&Excursion> = found.iter().filter(|e| e.input == input).collect();
            let covered: usize = of.iter().map(|e| e.samples.len()).sum();
            assert_eq!(covered, N, "{found:?}");
            assert!(of.iter().all(|e| like(e.excess, e.remedy)), "{of:?}");
        }
        assert!(found.iter().all(|e| inputs.contains(&e.input)), "{found:?}");
    }

    fn near(found: f64, wanted: f64) -> bool {
        (found - wanted).abs() < 0.02
    }

    #[test]
    fn a_drive_inside_has_none() {
        let mut model = model();
        model.range[0].local = Some(LocalRange { window: 512, mean: [-1.0, 1.0], max_rms: 2.0 });
        assert_eq!(found(&model, tone(20.0, 2.0, 0.5), tone(30.0, 2.0, 0.0)), []);
    }

    #[test]
    fn means_and_levels_of_one_input_are_brought_to_their_limits() {
        let mut model = model();
        model.range[0].local = Some(LocalRange { window: 500, mean: [-1.0, 1.0], max_rms: 1.0 });
        // The slack is 0.2, a twentieth of half the range.
        let high = found(&model, tone(20.0, 0.5, 2.0), tone(30.0, 9.0, 0.0));
        of_all(&high, &[0], |excess, remedy| {
            near(excess, 0.2) && matches!(remedy, Remedy::Shift(by) if near(by, -0.8))
        });
        let low = found(&model, tone(20.0, 0.5, -2.0), tone(30.0, 9.0, 0.0));
        of_all(&low, &[0], |excess, remedy| {
            near(excess, 0.2) && matches!(remedy, Remedy::Shift(by) if near(by, 0.8))
        });
        // 1.1 and the slack are allowed of an RMS of 2.6.
        let strong = found(&model, tone(20.0, 2.6 * 2.0_f64.sqrt(), 0.0), tone(30.0, 9.0, 0.0));
        of_all(&strong, &[0], |excess, remedy| {
            near(excess, 0.5) && matches!(remedy, Remedy::Scale(kept) if near(kept, 0.5))
        });
    }

    #[test]
    fn a_spectrum_outside_its_band_is_filtered() {
        let both: Vec<f64> =
            tone(20.0, 0.8, 0.0).iter().zip(&tone(300.0, 0.6, 0.0)).map(|(a, b)| a + b).collect();
        let found = found(&model(), tone(20.0, 1.0, 0.0), both);
        of_all(&found, &[1], |excess, remedy| near(excess, 0.5) && remedy == Remedy::Filter([0.0, 100.0]));
    }

    #[test]
    fn the_response_and_the_means_of_all_inputs_together_concern_all_inputs() {
        let mut model = model();
        let (fft_len, wide) = (512, [-9.0, 9.0]);
        model.window_range = vec![WindowRange {
            window: fft_len,
            mean: wide,
            max_rms: 1.0,
            max_rate: 1e9,
            max_tone_rate: Some(1e9),
        }];
        // Each is an RMS of 2, together of 4; of the limit 1.1 and a slack of 0.5.
        let (u, v) = (tone(20.0, 8.0_f64.sqrt(), 0.0), tone(20.0, 8.0_f64.sqrt(), 0.0));
        let strong = found(&model, u, v);
        of_all(&strong, &[0, 1], |excess, remedy| {
            near(excess, 0.6) && matches!(remedy, Remedy::Scale(kept) if near(kept, 0.4))
        });
        // A mean of 4; of the limit 1 and a slack of 1.
        model.window_range[0] = WindowRange { mean: [-1.0, 1.0], max_rms: 19.0, ..model.window_range[0] };
        let high = found(&model, tone(20.0, 0.1, 4.0), tone(20.0, 0.1, 0.0));
        of_all(&high, &[0, 1], |excess, _| near(excess, 0.5));
        let shift = |input: usize| {
            high.iter().find_map(|e| match e.remedy {
                Remedy::Shift(by) if e.input == input => Some(by),
                _ => None,
            })
        };
        assert!(near(shift(0).unwrap(), -2.0) && near(shift(1).unwrap(), 0.0), "{high:?}");

        model.window_range.clear();
        model.joint_range = Some(JointRange {
            window: fft_len,
            middle: vec![1.0, 0.0],
            covariance: vec![vec![1.0, 0.0], vec![0.0, 1.0]],
            max_distance: 2.5,
        });
        // The limit is 3; the distance is 6.
        let apart = found(&model, tone(20.0, 0.1, 1.0), tone(20.0, 0.1, 6.0));
        of_all(&apart, &[0, 1], |excess, _| near(excess, 0.5));
        let moved = apart.iter().all(|e| {
            let wanted = if e.input == 0 { 0.0 } else { -3.0 };
            matches!(e.remedy, Remedy::Shift(by) if near(by, wanted))
        });
        assert!(moved, "{apart:?}");
    }
}
