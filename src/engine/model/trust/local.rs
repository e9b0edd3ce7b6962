//! Means and levels of an input over short times: a drive may dwell where the training only passed, with every sample
//! inside the training's range.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use super::band::window_len;
use super::beyond::{Beyond, Way, join};

/// Means may leave those of the training by this share of half the range of its values.
const MEAN_SLACK: f64 = 0.05;

/// The RMS over a window may exceed the largest of the training by this factor: that of few windows is uncertain.
const RMS_SLACK: f64 = 1.1;

/// Windows per length of a window.
const HOPS: usize = 4;

/// Means of one input over the windows of its training data, and RMS values about them.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LocalRange {
    /// Samples of a window.
    pub window: usize,
    /// Smallest and largest mean, channel unit.
    pub mean: [f64; 2],
    /// Largest RMS about the mean, channel unit.
    pub max_rms: f64,
}

impl LocalRange {
    /// That of stretches of one input that excited `band_hz`; `None` where no stretch is as long as a window.
    pub(super) fn of<'a>(
        stretches: impl Iterator<Item = &'a [f64]>,
        band_hz: [f64; 2],
        sample_rate_hz: f64,
    ) -> Option<Self> {
        let window = window_len(&[band_hz], sample_rate_hz);
        let mut found = Self { window, mean: [f64::INFINITY, f64::NEG_INFINITY], max_rms: 0.0 };
        for stretch in stretches {
            each_window(stretch, window, |_, mean, rms| {
                found.mean = [found.mean[0].min(mean), found.mean[1].max(mean)];
                found.max_rms = found.max_rms.max(rms);
            });
        }
        (found.mean[0] <= found.mean[1]).then_some(found)
    }

    /// Stretches of an input outside; `values` are the smallest and the largest value of the training. An input
    /// shorter than a window is not judged.
    pub(super) fn find(&self, values: [f64; 2], samples: &[f64]) -> Vec<Beyond> {
        let mut found = self.limits(values).map(|limit| (limit, Vec::new()));
        each_window(samples, self.window, |part, mean, rms| {
            for ((way, limit), stretches) in &mut found {
                if way.beyond(&[mean, rms], *limit) {
                    join(stretches, &part, (), |(), ()| ());
                }
            }
        });
        let beyond = found.into_iter().flat_map(|((way, limit), stretches)| {
            stretches.into_iter().map(move |(samples, ())| Beyond { samples, way, limit })
        });
        beyond.collect()
    }

    /// The limits and the ways to pass them.
    pub(super) fn limits(&self, values: [f64; 2]) -> [(Way, f64); 3] {
        let slack = MEAN_SLACK * (values[1] - values[0]) / 2.0;
        [
            (Way::High, self.mean[1] + slack),
            (Way::Low, self.mean[0] - slack),
            (Way::Strong, RMS_SLACK * self.max_rms + slack),
        ]
    }
}

/// Calls `then` with the samples that each window speaks for, which are those nearest to its middle, its mean and its
/// RMS about the mean. Windows share the moments of the blocks between their starts.
pub(super) fn each_window(samples: &[f64], window: usize, mut then: impl FnMut(Range<usize>, f64, f64)) {
    let n = samples.len();
    if n < window {
        return;
    }
    let hop = (window / HOPS).max(1);
    let blocks: Vec<Moments> = samples.chunks_exact(hop).map(Moments::of).collect();
    let mut starts = (0..n - window).step_by(hop).chain([n - window]).peekable();
    let mut from = 0;
    while let Some(start) = starts.next() {
        let to = starts.peek().map_or(n, |next| usize::midpoint(start, *next) + window / 2);
        let whole = start.is_multiple_of(hop) && window.is_multiple_of(hop);
        let moments = if whole {
            blocks[start / hop..(start + window) / hop].iter().copied().reduce(Moments::and)
        } else {
            Some(Moments::of(&samples[start..start + window]))
        };
        let Some(Moments { count, mean, squares }) = moments else { return };
        then(from..to, mean, (squares / count).sqrt());
        from = to;
    }
}

/// Count, mean, and sum of squares about the mean.
#[derive(Debug, Clone, Copy)]
struct Moments {
    count: f64,
    mean: f64,
    squares: f64,
}

impl Moments {
    fn of(samples: &[f64]) -> Self {
        let count = samples.len() as f64;
        let mean = sum(samples, |v| v) / count;
        Self { count, mean, squares: sum(samples, |v| (v - mean) * (v - mean)) }
    }

    /// Those of both (Chan, Golub, LeVeque 1979).
    fn and(self, other: Self) -> Self {
        let count = self.count + other.count;
        let apart = other.mean - self.mean;
        Self {
            count,
            mean: self.mean + apart * other.count / count,
            squares: self.squares + other.squares + apart * apart * self.count * other.count / count,
        }
    }
}

/// Sum of a function of all samples. Eight sums run side by side: one alone would wait for each addition.
fn sum(samples: &[f64], of: impl Fn(f64) -> f64) -> f64 {
    let (eights, rest) = samples.as_chunks::<8>();
    let mut sums = [0.0; 8];
    for eight in eights {
        for (sum, v) in sums.iter_mut().zip(eight) {
            *sum += of(*v);
        }
    }
    sums.iter().sum::<f64>() + rest.iter().map(|v| of(*v)).sum::<f64>()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Noise of 1 RMS about a mean, from a linear congruential generator.
    fn noise(n: usize, mean: f64, rms: f64) -> Vec<f64> {
        let mut state = 7_u64;
        let mut next = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1_u64 << 53) as f64 - 0.5
        };
        (0..n).map(|_| mean + rms * 12.0_f64.sqrt() * next()).collect()
    }

    fn trained() -> LocalRange {
        let parts = [noise(4000, -1.0, 0.5), noise(4000, 1.0, 1.0)];
        LocalRange::of(parts.iter().map(Vec::as_slice), [0.0, 100.0], 1000.0).unwrap()
    }

    #[test]
    fn each_sample_belongs_to_the_window_about_it() {
        let mut parts = Vec::new();
        each_window(&noise(1000, 0.0, 1.0), 128, |part, _, _| parts.push(part));
        assert_eq!((parts[0].start, parts.last().unwrap().end), (0, 1000));
        assert!(parts.windows(2).all(|pair| pair[0].end == pair[1].start), "{parts:?}");
        // Ramps: the mean tells which window it was.
        for (n, window) in [(1000, 128), (1024, 128), (300, 6), (128, 128)] {
            let ramp: Vec<f64> = (0..n).map(f64::from).collect();
            let rms = (((window * window - 1) as f64) / 12.0).sqrt();
            each_window(&ramp, window, |part, mean, found| {
                assert!((found - rms).abs() < 1e-9 * rms, "{n} {window}: {found} and not {rms}");
                let middle = mean + 0.5;
                assert!(part.start as f64 <= middle && middle <= part.end as f64, "{part:?} {mean}");
            });
        }
        each_window(&[0.0; 127], 128, |_, _, _| panic!("it is shorter than a window"));
    }

    #[test]
    fn a_range_holds_the_means_and_the_largest_level_of_all_stretches() {
        let found = trained();
        assert_eq!(found.window, 512);
        assert!((found.mean[0] + 1.0).abs() < 0.1 && (found.mean[1] - 1.0).abs() < 0.2, "{found:?}");
        assert!((found.max_rms - 1.0).abs() < 0.1, "{found:?}");
        assert_eq!(LocalRange::of([&[1.0; 100][..]].into_iter(), [0.0, 100.0], 1000.0), None);
    }

    #[test]
    fn training_and_its_like_are_inside_and_what_dwells_or_is_stronger_is_not() {
        let (range, values) = (trained(), [-3.0, 3.0]);
        for (mean, rms) in [(-1.0, 0.5), (1.0, 1.0), (0.0, 0.9)] {
            assert_eq!(range.find(values, &noise(8000, mean, rms)), [], "{mean} {rms}");
        }
        let mut drive = noise(8000, 0.0, 0.5);
        drive[3000..5000].iter_mut().for_each(|v| *v += 2.0);
        drive[6000..7000].iter_mut().for_each(|v| *v *= 3.0);
        let found = range.find(values, &drive);
        let ways: Vec<Way> = found.iter().map(|dwelling| dwelling.way).collect();
        assert_eq!(ways, [Way::High, Way::Strong], "{found:?}");
        let [high, strong] = [&found[0].samples, &found[1].samples];
        assert!((2800..3500).contains(&high.start) && (4500..5300).contains(&high.end), "{found:?}");
        assert!((5700..6500).contains(&strong.start) && (6500..7400).contains(&strong.end), "{found:?}");
        assert_eq!(range.find(values, &[9.0; 511]), [], "shorter than a window");
    }
}
