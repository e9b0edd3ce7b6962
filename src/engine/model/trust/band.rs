//! Power of a drive outside the band that a model knows, over short times.

use std::ops::Range;
use std::sync::Arc;

use rayon::prelude::*;
use realfft::num_complex::Complex64;
use rigcast_numerics::fft::{RealFftPlanner, RealToComplex};

use super::InputRange;
use crate::Signal;
use crate::model::RigModel;
use crate::spectral::hann;

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
const WINDOW_LEN: Range<usize> = 64..4096;

/// Watches the spectra of a model's inputs.
#[derive(Clone)]
pub(in crate::model) struct BandWatch {
    sample_rate_hz: f64,
    /// Of each input, first and last frequency.
    bands: Vec<[f64; 2]>,
    fft: ShortTime,
}

/// A stretch of one input with power outside its band.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct OutOfBand {
    /// Samples.
    pub samples: Range<usize>,
    /// Share of the power outside.
    pub share: f64,
    /// The band.
    pub band_hz: [f64; 2],
    /// Length of the windows.
    pub window_s: f64,
}

impl std::fmt::Debug for BandWatch {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let window = self.fft.window.len();
        f.debug_struct("BandWatch").field("bands", &self.bands).field("window", &window).finish()
    }
}

impl BandWatch {
    /// None when no frequency can be told to be outside.
    pub fn new(model: &RigModel) -> Option<Self> {
        let rate = model.sample_rate_hz;
        let all = [0.0, rate / 2.0];
        let [from, to] = model.frf.as_ref().map_or(all, |frf| frf.usable_hz);
        // The FRF may come from other runs than the network: both must know a frequency.
        let both = |range: &InputRange| {
            let [first, last] = range.band_hz.unwrap_or(all);
            let upper = to.min(last);
            [from.max(first).min(upper), upper]
        };
        let bands: Vec<[f64; 2]> = model.range.iter().map(both).collect();
        let fft = ShortTime::new(window_len(&bands, rate));
        let watch = Self { sample_rate_hz: rate, bands, fft };
        let tells = (0..watch.bands.len()).any(|input| watch.fft.outside(watch.bands[input], rate).any());
        tells.then_some(watch)
    }

    /// Where each input's power leaves its band, in their order.
    pub(super) fn find(&self, range: &[InputRange], x: &Signal) -> Vec<Vec<OutOfBand>> {
        let n = x.n_samples();
        if n < WINDOW_LEN.start {
            return vec![Vec::new(); self.bands.len()];
        }
        // A drive shorter than the window is looked at through a shorter one.
        let shorter = (n < self.fft.window.len()).then(|| ShortTime::new(1 << n.ilog2()));
        let fft = shorter.as_ref().unwrap_or(&self.fft);
        self.bands
            .par_iter()
            .enumerate()
            .map(|(input, &band_hz)| {
                let outside = fft.outside(band_hz, self.sample_rate_hz);
                if !outside.any() {
                    return Vec::new();
                }
                let InputRange { min, max, .. } = range[input];
                let least = (LEVEL * (max - min) / 2.0).powi(2);
                let window_s = fft.window.len() as f64 / self.sample_rate_hz;
                let found = fft.find(x.channel(input), &outside, least).into_iter();
                found.map(|(samples, share)| OutOfBand { samples, share, band_hz, window_s }).collect()
            })
            .collect()
    }
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

/// Spectra of half-overlapping windows of one length.
#[derive(Clone)]
struct ShortTime {
    window: Vec<f64>,
    fft: Arc<dyn RealToComplex<f64>>,
}

/// Lines outside a band; the mean, line 0, is judged by its value.
#[derive(Debug, PartialEq)]
struct Outside {
    below: Range<usize>,
    above: Range<usize>,
}

impl Outside {
    fn any(&self) -> bool {
        !(self.below.is_empty() && self.above.is_empty())
    }
}

impl ShortTime {
    fn new(len: usize) -> Self {
        Self { window: hann(len), fft: RealFftPlanner::new().plan_fft_forward(len) }
    }

    fn outside(&self, [low_hz, high_hz]: [f64; 2], rate: f64) -> Outside {
        let (df, lines) = (rate / self.window.len() as f64, self.window.len() / 2 + 1);
        let below = ((low_hz / df).ceil() as usize).saturating_sub(GUARD);
        let above = (high_hz / df).floor() as usize + GUARD + 1;
        Outside { below: 1..below.max(1), above: above.min(lines)..lines }
    }

    /// Stretches of windows with more than [`SHARE`] of their power outside, and more than `least` (a
    /// mean square); with the share over the stretch. A window speaks for its middle half.
    fn find(&self, samples: &[f64], outside: &Outside, least: f64) -> Vec<(Range<usize>, f64)> {
        let (n, len) = (samples.len(), self.window.len());
        let starts: Vec<usize> = (0..n - len).step_by(len / 2).chain([n - len]).collect();
        let (mut time, mut lines) = (self.fft.make_input_vec(), self.fft.make_output_vec());
        let mut scratch = self.fft.make_scratch_vec();
        let scale = 2.0 / (len as f64 * self.window.iter().map(|w| w * w).sum::<f64>());
        let mut found: Vec<(Range<usize>, f64, f64)> = Vec::new();
        for (k, &start) in starts.iter().enumerate() {
            let segment = &samples[start..start + len];
            let mean = segment.iter().sum::<f64>() / len as f64;
            for ((t, v), w) in time.iter_mut().zip(segment).zip(&self.window) {
                *t = (v - mean) * w;
            }
            self.fft
                .process_with_scratch(&mut time, &mut lines, &mut scratch)
                .expect("buffers are the plan's own");
            let power = |lines: &[Complex64]| scale * lines.iter().map(Complex64::norm_sqr).sum::<f64>();
            let out = power(&lines[outside.below.clone()]) + power(&lines[outside.above.clone()]);
            // Not a comparison of shares: a drive at rest has no power.
            let all = power(&lines[1..]);
            if !(out > least && out > SHARE * all) {
                continue;
            }
            let from = if k == 0 { 0 } else { start + len / 4 };
            let to = starts.get(k + 1).map_or(n, |next| next + len / 4);
            match found.last_mut() {
                Some((last, last_out, last_all)) if last.end >= from => {
                    last.end = to;
                    *last_out += out;
                    *last_all += all;
                }
                _ => found.push((from..to, out, all)),
            }
        }
        found.into_iter().map(|(samples, out, all)| (samples, out / all)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RATE: f64 = 1000.0;

    fn tone(n: usize, hz: f64, amplitude: f64) -> Vec<f64> {
        (0..n).map(|t| amplitude * (std::f64::consts::TAU * hz * t as f64 / RATE).sin()).collect()
    }

    fn watch(bands: &[[f64; 2]]) -> (BandWatch, Vec<InputRange>) {
        let range = |band: &[f64; 2]| InputRange {
            min: -2.0,
            max: 2.0,
            max_rate: 1e9,
            band_hz: Some(*band),
            local: None,
        };
        let fft = ShortTime::new(window_len(bands, RATE));
        let watch = BandWatch { sample_rate_hz: RATE, bands: bands.to_vec(), fft };
        (watch, bands.iter().map(range).collect())
    }

    fn find(bands: &[[f64; 2]], channels: Vec<Vec<f64>>) -> Vec<Vec<OutOfBand>> {
        let (watch, range) = watch(bands);
        watch.find(&range, &Signal::new(RATE, channels).unwrap())
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
