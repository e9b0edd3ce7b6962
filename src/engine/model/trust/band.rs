//! Power of a drive outside the band that a model knows, over short times.

use std::ops::Range;

use realfft::num_complex::Complex64;

use super::InputRange;
use super::beyond::join;
use super::short_time::{ShortTime, WindowOfInputs};
use crate::model::RigModel;

/// Share of the power over a window, the mean removed, that may lie outside the band: a tenth in
/// amplitude.
pub(super) const SHARE: f64 = 0.01;

/// Power outside counts only above this share of half the training range, in RMS: the hiss of a drive
/// at rest is all there is of it, and does no harm.
const LEVEL: f64 = 0.01;

/// A window holds at least so many periods of a band's upper edge, and so many of its lower one where
/// the longest window does.
const PERIODS_OF_UPPER: f64 = 32.0;
const PERIODS_OF_LOWER: f64 = 16.0;

/// Lines beyond an edge that the window's leakage reaches.
const GUARD: usize = 4;

/// Samples of the shortest and the longest window.
pub(super) const WINDOW_LEN: Range<usize> = 64..4096;

/// The bands of a model's inputs on the lines of windows.
#[derive(Debug, Clone)]
pub(super) struct Bands {
    /// Of each input, first and last frequency.
    bands: Vec<[f64; 2]>,
    outside: Vec<Outside>,
    window_s: f64,
}

/// A stretch of one input with power outside its band.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct OutOfBand {
    /// Samples.
    pub samples: Range<usize>,
    /// The input.
    pub input: usize,
    /// Share of the power outside.
    pub share: f64,
    /// The band.
    pub band_hz: [f64; 2],
    /// Length of the windows.
    pub window_s: f64,
}

/// Mean squares of an input over a window: of the lines outside its band, and of all.
pub(super) type Power = [f64; 2];

/// The band of each input that a model knows.
pub(super) fn of_model(model: &RigModel) -> Vec<[f64; 2]> {
    let all = [0.0, model.sample_rate_hz / 2.0];
    let [from, to] = model.frf.as_ref().map_or(all, |frf| frf.usable_hz);
    // The FRF may come from other runs than the network: both must know a frequency.
    let both = |range: &InputRange| {
        let [first, last] = range.band_hz.unwrap_or(all);
        let upper = to.min(last);
        [from.max(first).min(upper), upper]
    };
    model.range.iter().map(both).collect()
}

impl Bands {
    /// Those on the lines of some windows.
    pub fn new(bands: Vec<[f64; 2]>, fft: &ShortTime, sample_rate_hz: f64) -> Self {
        let outside = bands.iter().map(|band| Outside::new(*band, fft, sample_rate_hz)).collect();
        Self { bands, outside, window_s: fft.len() as f64 / sample_rate_hz }
    }

    /// First and last frequency of an input.
    pub fn of_input(&self, input: usize) -> [f64; 2] {
        self.bands[input]
    }

    /// Whether any line can be told to be outside.
    pub fn tell(&self) -> bool {
        self.outside.iter().any(Outside::any)
    }

    /// The same bands on the lines of other windows.
    pub fn on(&self, fft: &ShortTime, sample_rate_hz: f64) -> Self {
        Self::new(self.bands.clone(), fft, sample_rate_hz)
    }

    /// The power of each input; none where no line can be told to be outside.
    pub fn of(&self, window: &WindowOfInputs<'_>) -> Vec<Power> {
        let power = |(outside, lines): (&Outside, &Vec<Complex64>)| {
            if !outside.any() {
                return [0.0; 2];
            }
            let sum = |lines: &[Complex64]| lines.iter().map(Complex64::norm_sqr).sum::<f64>();
            let out = sum(&lines[outside.below.clone()]) + sum(&lines[outside.above.clone()]);
            [out, sum(&lines[1..])].map(|squares| window.mean_square(squares))
        };
        self.outside.iter().zip(window.lines).map(power).collect()
    }

    /// Stretches of windows with more than [`SHARE`] of their power outside, by input; with the share over the stretch.
    pub fn find(&self, range: &[InputRange], windows: &[(Range<usize>, Vec<Power>)]) -> Vec<OutOfBand> {
        let mut found = Vec::new();
        for (input, range) in range.iter().enumerate().filter(|(input, _)| self.outside[*input].any()) {
            let mut stretches = Vec::new();
            for (samples, powers) in windows {
                let [out, all] = powers[input];
                if is_outside(powers[input], range) {
                    join(
                        &mut stretches,
                        samples,
                        [out, all],
                        |[sum_out, sum_all]: &mut Power, [out, all]| {
                            *sum_out += out;
                            *sum_all += all;
                        },
                    );
                }
            }
            let (band_hz, window_s) = (self.bands[input], self.window_s);
            let of = |(samples, [out, all]): (Range<usize>, Power)| OutOfBand {
                samples,
                input,
                share: out / all,
                band_hz,
                window_s,
            };
            found.extend(stretches.into_iter().map(of));
        }
        found
    }
}

/// Whether too much of an input's power over a window lies outside its band.
pub(super) fn is_outside([out, all]: Power, range: &InputRange) -> bool {
    let least = (LEVEL * (range.max - range.min) / 2.0).powi(2);
    // Not a comparison of shares: a drive at rest has no power.
    out > least && out > SHARE * all
}

/// Window that suits all bands.
pub(super) fn window_len(bands: &[[f64; 2]], rate: f64) -> usize {
    let wanted = bands.iter().flat_map(|[low, high]| {
        let (upper, lower) = (PERIODS_OF_UPPER * rate / high, PERIODS_OF_LOWER * rate / low);
        [Some(upper), Some(lower).filter(|len| *len <= WINDOW_LEN.end as f64)]
    });
    let longest = wanted.flatten().fold(0.0_f64, f64::max).min(WINDOW_LEN.end as f64);
    (longest as usize).next_power_of_two().clamp(WINDOW_LEN.start, WINDOW_LEN.end)
}

/// Lines outside a band; the mean, line 0, is judged by its value.
#[derive(Debug, Clone, PartialEq)]
struct Outside {
    below: Range<usize>,
    above: Range<usize>,
}

impl Outside {
    fn new([low_hz, high_hz]: [f64; 2], fft: &ShortTime, sample_rate_hz: f64) -> Self {
        let (df, lines) = (sample_rate_hz / fft.len() as f64, fft.n_lines());
        let below = ((low_hz / df).ceil() as usize).saturating_sub(GUARD);
        let above = (high_hz / df).floor() as usize + GUARD + 1;
        Self { below: 1..below.max(1), above: above.min(lines)..lines }
    }

    fn any(&self) -> bool {
        !(self.below.is_empty() && self.above.is_empty())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RATE: f64 = 1000.0;

    fn tone(n: usize, hz: f64, amplitude: f64) -> Vec<f64> {
        (0..n).map(|t| amplitude * (std::f64::consts::TAU * hz * t as f64 / RATE).sin()).collect()
    }

    fn find(bands: &[[f64; 2]], channels: Vec<Vec<f64>>) -> Vec<Vec<OutOfBand>> {
        let range = |band: &[f64; 2]| InputRange {
            min: -2.0,
            max: 2.0,
            max_rate: 1e9,
            band_hz: Some(*band),
            local: None,
        };
        let range: Vec<InputRange> = bands.iter().map(range).collect();
        if channels[0].len() < WINDOW_LEN.start {
            return vec![Vec::new(); bands.len()];
        }
        let fft = ShortTime::new(window_len(bands, RATE));
        let fft = fft.shortened(channels[0].len()).unwrap_or(fft);
        let on_lines = Bands::new(bands.to_vec(), &fft, RATE);
        let inputs: Vec<&[f64]> = channels.iter().map(Vec::as_slice).collect();
        let found = on_lines.find(&range, &fft.each(&inputs, |window| on_lines.of(window)));
        (0..bands.len()).map(|i| found.iter().filter(|out| out.input == i).cloned().collect()).collect()
    }

    #[test]
    fn windows_suit_the_bands_edges() {
        assert_eq!(window_len(&[[0.0, 52.0]], RATE), 1024);
        assert_eq!(window_len(&[[0.0, 52.0], [20.0, 500.0]], RATE), 1024);
        assert_eq!(window_len(&[[0.1, 500.0]], RATE), 64, "0.1 Hz is too slow for any window");
        assert_eq!(window_len(&[[8.0, 500.0]], RATE), 2048);
        assert_eq!(window_len(&[[0.0, 0.01]], RATE), 4096);
        assert_eq!(window_len(&[[0.0, 0.0]], RATE), 4096);
    }

    #[test]
    fn a_tone_is_outside_beyond_either_edge_and_inside_between_them() {
        let band = [20.0, 52.0];
        for (hz, expected) in [(8.0, true), (21.0, false), (51.0, false), (80.0, true), (480.0, true)] {
            let found = find(&[band], vec![tone(10_000, hz, 1.0)]).remove(0);
            assert_eq!(found.len(), usize::from(expected), "{hz} Hz: {found:?}");
            if expected {
                assert_eq!(found[0].samples, 0..10_000, "{hz} Hz");
                assert!((found[0].share - 1.0).abs() < 0.01, "{hz} Hz: {found:?}");
                assert_eq!((found[0].band_hz, found[0].window_s), (band, 1.024));
            }
        }
    }

    #[test]
    fn each_input_has_its_band_and_a_preload_is_no_power() {
        let (slow, fast) = (tone(5000, 10.0, 1.0), tone(5000, 70.0, 1.0));
        let preloaded = slow.iter().map(|v| v + 50.0).collect();
        let found = find(&[[5.0, 30.0], [0.0, 30.0], [0.0, 90.0]], vec![preloaded, fast.clone(), fast]);
        assert_eq!(found.iter().map(Vec::len).collect::<Vec<_>>(), [0, 1, 0]);
    }

    #[test]
    fn a_short_burst_leaves_the_rest_of_the_drive_inside() {
        let mut drive = tone(60_000, 10.0, 1.0);
        for (v, burst) in drive[30_000..30_200].iter_mut().zip(tone(200, 80.0, 0.5)) {
            *v += burst;
        }
        let found = find(&[[0.0, 50.0]], vec![drive]).remove(0);
        assert_eq!(found.len(), 1, "{found:?}");
        let Range { start, end } = found[0].samples;
        assert!(start <= 30_000 && end >= 30_200 && end - start <= 1600, "{found:?}");
    }

    #[test]
    fn faint_power_is_inside_both_beside_a_large_drive_and_alone() {
        let mut beside = tone(10_000, 10.0, 1.0);
        beside.iter_mut().zip(tone(10_000, 80.0, 0.09)).for_each(|(v, hiss)| *v += hiss);
        assert_eq!(find(&[[0.0, 50.0]], vec![beside]), [vec![]], "0.8 % of the power");
        assert_eq!(find(&[[0.0, 50.0]], vec![tone(10_000, 80.0, 0.025)]), [vec![]], "0.9 % of the range");
        assert_eq!(find(&[[0.0, 50.0]], vec![vec![1.0; 10_000]]), [vec![]], "a drive at rest");
    }

    #[test]
    fn every_length_has_an_answer() {
        for n in [1, 63, 64, 65, 1000, 1023, 1024, 1025, 1536, 1537, 3000] {
            let found = find(&[[0.0, 50.0]], vec![tone(n, 200.0, 1.0)]).remove(0);
            let expected: Vec<Range<usize>> = (n >= 64).then_some(0..n).into_iter().collect();
            assert_eq!(found.into_iter().map(|f| f.samples).collect::<Vec<_>>(), expected, "{n} samples");
        }
    }
}
