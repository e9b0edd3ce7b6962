//! Doubtful estimates are told by channel and band, sound ones are not.

use super::*;

const N: usize = 131_072;

/// An estimate at 200 Hz of outputs that are the one drive plus white noise in these bands, as strong
/// there as the drive: multiple coherence is 0.5 in the bands and 1 elsewhere.
fn noisy_in(bands: &[&[[f64; 2]]]) -> FrfEstimate {
    let x = noise(61, N);
    let y = bands.iter().enumerate().map(|(o, bands)| {
        let e = noise(700 + o as u64, N);
        let mut y = x.clone();
        for band in *bands {
            let part = band_limited(&e, band[0] / 100.0, band[1] / 100.0);
            y.iter_mut().zip(part).for_each(|(y, e)| *y += e);
        }
        y
    });
    let (y, x) = (signal(200.0, y.collect()), signal(200.0, vec![x.clone()]));
    estimate(&[(&x, &y)], &fixed(1024, 0.0), &unwatched).unwrap()
}

fn told(found: &FrfEstimate) -> Vec<String> {
    let names: Vec<String> = ["force_x", "force_y", "force_z"].map(String::from).to_vec();
    low_coherence(&found.frf, &found.quality, &names[..found.frf.n_outputs])
}

/// The numbers in a text.
fn numbers(text: &str) -> Vec<f64> {
    text.split([' ', '(', ',']).filter_map(|word| word.parse().ok()).collect()
}

#[test]
fn low_coherence_is_told_by_channel_and_band() {
    let found = noisy_in(&[&[], &[[38.0, 52.0]], &[[10.0, 20.0], [70.0, 75.0]]]);
    let [one, two] = &told(&found)[..] else { panic!("{:?}", told(&found)) };
    assert!(one.starts_with("force_y: multiple coherence below 0.8 from "), "{one}");
    let [threshold, from, to, share] = numbers(one)[..] else { panic!("{one}") };
    assert_eq!(threshold, 0.8);
    assert!((from - 38.0).abs() < 1.0 && (to - 52.0).abs() < 1.0 && (share - 14.0).abs() < 2.0, "{one}");
    let [_, a, b, c, d, share] = numbers(two)[..] else { panic!("{two}") };
    assert!(two.starts_with("force_z: "), "{two}");
    let bounds = [(a, 10.0), (b, 20.0), (c, 70.0), (d, 75.0)];
    assert!(bounds.iter().all(|(found, truth)| (found - truth).abs() < 1.0), "{two}");
    assert!((share - 15.0).abs() < 2.0, "{two}");
}

#[test]
fn a_narrow_dip_is_not_told_and_of_many_bands_the_widest() {
    let dip: &[[f64; 2]] = &[[40.0, 41.5]];
    let many: &[[f64; 2]] = &[[5.0, 10.0], [20.0, 26.0], [40.0, 47.0], [60.0, 68.0], [80.0, 89.0]];
    let found = told(&noisy_in(&[dip, many]));
    let [only] = &found[..] else { panic!("{found:?}") };
    assert!(only.starts_with("force_y: ") && only.contains(" and elsewhere ("), "{only}");
    assert_eq!(only.matches("from").count(), 3, "{only}");
    let [_, first, ..] = numbers(only)[..] else { panic!("{only}") };
    assert!((first - 40.0).abs() < 1.0, "the widest, in their order: {only}");
}

#[test]
fn chance_at_few_averages_does_not_scatter_the_warning() {
    // Coherence 0.85 at every line; single lines of 30 averages fall below 0.8, their mean does not.
    let (x, e) = (noise(71, N / 4), noise(72, N / 4));
    let y = x.iter().zip(&e).map(|(x, e)| x + (0.15 / 0.85_f64).sqrt() * e).collect();
    let (x, y) = (signal(200.0, vec![x]), signal(200.0, vec![y]));
    let found = estimate(&[(&x, &y)], &FrfSettings { overlap: 0.0, ..fixed(1024, 0.0) }, &unwatched).unwrap();
    let low = found.quality.multiple_coherence.iter().filter(|c| **c < 0.8).count();
    assert!(low > 20, "{low} single lines are low");
    assert_eq!(told(&found), [""; 0]);
}

#[test]
fn few_averages_are_told_with_what_they_make_of_the_error() {
    let x = channels(81, 3, 2 * 512 + 512 / 4);
    let n = x[0].len();
    let e = noise(82, n);
    let y: Vec<f64> = (0..n).map(|t| x[0][t] + 0.1 * x[1][t] + 0.3 * e[t]).collect();
    let (x, y) = (signal(100.0, x), signal(100.0, vec![y]));
    let found = estimate(&[(&x, &y)], &fixed(512, 0.0), &unwatched).unwrap();
    let told = found.warnings.join("\n");
    assert!(told.contains("6 averages (") && told.contains("for 3 inputs"), "{told}");
    assert!(
        told.contains("the FRF's random error is about") && told.contains("too high by construction"),
        "{told}"
    );
    // Many averages of an output that is nearly all noise: uncertain too, but not by construction.
    let x = noise(83, 20_000);
    let y = x.iter().zip(noise(84, 20_000)).map(|(x, e)| 0.05 * x + e).collect();
    let (x, y) = (signal(100.0, vec![x]), signal(100.0, vec![y]));
    let found = estimate(&[(&x, &y)], &fixed(1024, 0.0), &unwatched).unwrap();
    let [told] = &found.warnings[..] else { panic!("{:?}", found.warnings) };
    assert!(told.contains("random error") && !told.contains("by construction"), "{told}");
}
