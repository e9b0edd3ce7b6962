//! A signal taken apart by frequency, two octaves at a time, with the mean square of each part over a window.

use super::moving::{moving_mean, moving_mean_square};

/// Lengths that part the frequencies, in windows, from high to low.
const LENGTHS: [f64; 5] = [1.0 / 64.0, 1.0 / 16.0, 0.25, 1.0, 4.0];

/// Frequency bands.
pub(super) const BANDS: usize = LENGTHS.len() + 1;

/// Moving means of a low pass.
const MEANS: usize = 3;

/// Calls `take` with the place of each frequency band, from high to low, and the mean square of the signal's part in it over
/// a window about each sample. The parts add up to the signal.
pub(super) fn mean_squares(
    signal: impl Iterator<Item = f64>,
    window: usize,
    mut take: impl FnMut(usize, Vec<f64>),
) {
    let mut rest: Vec<f64> = signal.collect();
    for (band, length) in LENGTHS.into_iter().enumerate() {
        // Odd, so that nothing is shifted.
        let length = (length * window as f64) as usize | 1;
        // What is left of low frequencies above is left once more than of one low pass H alone: 1 - (2 H - H^2) = (1 - H)^2.
        let once = low_pass(&rest, length);
        let twice = low_pass(&once, length);
        let below: Vec<f64> = once.iter().zip(&twice).map(|(once, twice)| 2.0 * once - twice).collect();
        take(band, moving_mean_square(rest.iter().zip(&below).map(|(all, below)| all - below), window));
        rest = below;
    }
    take(LENGTHS.len(), moving_mean_square(rest.into_iter(), window));
}

/// Moving means one after the other, since one alone lets much of the high frequencies through.
fn low_pass(values: &[f64], length: usize) -> Vec<f64> {
    let mean = |values: Vec<f64>, _| moving_mean(values.into_iter(), length);
    (1..MEANS).fold(moving_mean(values.iter().copied(), length), mean)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tone_is_in_the_band_of_its_period_and_an_offset_in_the_last() {
        let n = 20_000;
        let window = 256;
        // Periods in samples, and the band between whose lengths they lie.
        for (period, band) in [(4.0, 0), (20.0, 1), (80.0, 2), (320.0, 3), (1280.0, 4), (f64::INFINITY, 5)] {
            let tone = (0..n).map(|t| (std::f64::consts::TAU * t as f64 / period + 0.5).cos());
            let mut middle = [0.0; BANDS];
            mean_squares(tone, window, |place, squares| {
                assert_eq!(squares.len(), n);
                middle[place] = squares[4096..n - 4096].iter().sum::<f64>() / (n - 8192) as f64;
            });
            let all: f64 = middle.iter().sum();
            let largest = (0..BANDS).max_by(|a, b| middle[*a].total_cmp(&middle[*b])).unwrap();
            assert_eq!(largest, band, "{period}: {middle:?}");
            assert!(middle[band] > 0.6 * all, "{period}: {middle:?}");
        }
    }

    #[test]
    fn slow_signals_hardly_reach_the_highest_band() {
        let slow = (0..8192).map(|t| (std::f64::consts::TAU * t as f64 / 400.0).sin());
        mean_squares(slow, 256, |place, squares| {
            if place == 0 {
                assert!(squares[1024..7168].iter().all(|square| *square < 1e-6), "{}", squares[4096]);
            }
        });
    }

    #[test]
    fn a_window_shorter_than_the_lengths_and_a_short_signal_are_taken_apart() {
        for (n, window) in [(0, 256), (1, 256), (7, 1), (100, 8)] {
            let mut places = Vec::new();
            mean_squares((0..n).map(|t| f64::from(t % 3)), window, |place, squares| {
                assert!(squares.len() == n as usize && squares.iter().all(|square| square.is_finite()));
                places.push(place);
            });
            assert_eq!(places, (0..BANDS).collect::<Vec<_>>());
        }
    }
}
