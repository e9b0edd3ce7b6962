//! What an estimate says about itself is what the known system and noise make of it.

use super::modal::Modal;
use super::*;

/// Share of all `H[line, output, input]` between DC and Nyquist within their 95 % radius.
fn share_within(estimate: &FrfEstimate, truth: impl Fn(f64, usize, usize) -> Complex64) -> f64 {
    let (frf, quality) = (&estimate.frf, &estimate.quality);
    let factor = quality.confidence_factor(0.95).unwrap();
    let mut inside = Vec::new();
    for line in 1..frf.n_lines() - 1 {
        for o in 0..frf.n_outputs {
            for i in 0..frf.n_inputs {
                let radius = factor * quality.std_error[(line * frf.n_outputs + o) * frf.n_inputs + i];
                inside.push((frf.at(line, o, i) - truth(line as f64 * frf.df_hz(), o, i)).norm() <= radius);
            }
        }
    }
    inside.iter().filter(|inside| **inside).count() as f64 / inside.len() as f64
}

#[test]
fn the_other_drives_are_noise_to_the_ratio_form_and_its_confidence_says_so() {
    // Gains without frequency dependence, so that no segment is too short for them.
    let gains = [[1.0, 0.7, -0.4], [0.2, -1.0, 0.6]];
    let n = 60_000;
    let x = channels(21, 3, n);
    let y = gains.iter().enumerate().map(|(o, gains)| {
        let e = noise(900 + o as u64, n);
        (0..n).map(|t| gains.iter().zip(&x).map(|(g, x)| g * x[t]).sum::<f64>() + 0.3 * e[t]).collect()
    });
    let (y, x) = (signal(100.0, y.collect()), signal(100.0, x));
    for estimator in [Estimator::H1, Estimator::Ratio] {
        let settings = FrfSettings { estimator, overlap: 0.5, ..fixed(512, 0.0) };
        let found = estimate(&[(&x, &y)], &settings, &unwatched).unwrap();
        let share = share_within(&found, |_, o, i| gains[o][i].into());
        println!("{estimator:?}: {share:.3} within 95 %");
        assert!((0.92..=0.98).contains(&share), "{estimator:?}: {share}");
    }
}

#[test]
fn the_random_error_is_that_of_averages_and_coherence() {
    // y = 3 x + noise as strong as 3 x: coherence 0.5.
    let n = 100_000;
    let (x, e) = (noise(31, n), noise(32, n));
    let y = x.iter().zip(&e).map(|(x, e)| 3.0 * (x + e)).collect();
    let (x, y) = (signal(100.0, vec![x]), signal(100.0, vec![y]));
    let settings = FrfSettings { overlap: 0.0, ..fixed(500_usize.next_power_of_two(), 0.0) };
    let found = estimate(&[(&x, &y)], &settings, &unwatched).unwrap();
    let averages = found.quality.averages as f64;
    assert_eq!(found.quality.effective_averages, averages, "segments do not overlap");
    let expected = (1.0 - 0.5_f64).sqrt() / (0.5_f64.sqrt() * (2.0 * averages).sqrt());
    let error = found.quality.random_error(&found.frf)[0].unwrap();
    assert!((error / expected - 1.0).abs() < 0.05, "{error}, expected {expected}");
}

#[test]
fn each_input_has_its_own_band_and_together_they_have_what_they_share() {
    // The first drive stops at 30 Hz of 100 Hz, the second does not.
    let n = 65_536;
    let mut x = channels(41, 2, n);
    x[0] = band_limited(&x[0], 0.0, 0.3);
    let y = (0..n).map(|t| x[0][t] + x[1][t]).collect();
    let (x, y) = (signal(200.0, x), signal(200.0, vec![y]));
    let found = estimate(&[(&x, &y)], &fixed(512, 0.0), &unwatched).unwrap();
    let [first, second] = [found.quality.input_hz[0], found.quality.input_hz[1]];
    assert!(first[0] == 0.0 && (30.0..33.0).contains(&first[1]), "{first:?}");
    assert_eq!(second, [0.0, 100.0]);
    assert!((found.frf.usable_hz[1] - first[1]).abs() < 1.0, "{:?}", found.frf.usable_hz);
    let [span] = found.quality.excited[..] else { panic!("{:?}", found.quality.excited) };
    assert_eq!(span.map(|line| line as f64 * found.frf.df_hz()), found.frf.usable_hz);
}

#[test]
fn a_summary_holds_the_figures_of_the_lines() {
    let rig = Modal::bench();
    let x = channels(51, 3, 40_000);
    let mut y = rig.simulate(&x);
    // Half of the second output's power is noise.
    let deviation = (y[1].iter().map(|v| v * v).sum::<f64>() / 40_000.0).sqrt();
    y[1].iter_mut().zip(noise(52, 40_000)).for_each(|(y, e)| *y += deviation * e);
    let (x, y) = (signal(rig.fs, x), signal(rig.fs, y));
    let found = estimate(&[(&x, &y)], &fixed(512, 0.0), &unwatched).unwrap();
    let names = |of: &str, n: usize| (0..n).map(|i| format!("{of}{i}")).collect::<Vec<_>>();
    let summary = FrfSummary::of(&found.frf, Some(&found.quality), &names("x", 3), &names("y", 2));
    assert_eq!((summary.lines, summary.usable_hz), (257, [0.0, 100.0]));
    let measured = summary.measured.clone().unwrap();
    assert_eq!(measured.inputs.len(), 3);
    let [clean, noisy] = &measured.outputs[..] else { panic!("two outputs") };
    assert!(clean.coherence_median > 0.95 && noisy.coherence_median < 0.5, "{measured:?}");
    assert!(clean.random_error < noisy.random_error);
    let at = (noisy.coherence_min_hz / summary.df_hz).round() as usize;
    assert_eq!(found.quality.multiple_coherence[at * 2 + 1], noisy.coherence_min);
    let stored: FrfSummary = serde_json::from_str(&serde_json::to_string(&summary).unwrap()).unwrap();
    assert_eq!(stored, summary);
    let bare = FrfSummary { measured: None, ..summary };
    let stored: FrfSummary = serde_json::from_str(&serde_json::to_string(&bare).unwrap()).unwrap();
    assert_eq!(stored, bare);
}
