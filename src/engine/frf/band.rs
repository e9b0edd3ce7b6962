//! The lines that the inputs excite, and the treatment of the others.

use realfft::num_complex::Complex64;

/// A line is excited when its power is above this share of the in-band maximum.
const EXCITED: f64 = 1e-6;
/// Width of the Hann window's main lobe in lines: neighbours closer than this share data, so a
/// narrower gap (between the lines of a periodic drive) is bridged rather than silenced.
const MAIN_LOBE: usize = 4;

/// The excited lines of an estimate.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Band {
    /// Stretches of excited lines, first and last of each, ascending, narrow gaps bridged.
    pub spans: Vec<(usize, usize)>,
    /// Whether a line is excited.
    live: Vec<bool>,
}

impl Band {
    /// `power[line]` is the power of the weakest combination of inputs. Lines 0 and 1 take no part in
    /// the maximum: the offsets of the runs lie there, far above the noise.
    ///
    /// None when no line has power.
    pub fn new(power: &[f64]) -> Option<Self> {
        let from = 2.min(power.len() - 1);
        let largest = power[from..].iter().copied().fold(0.0, f64::max);
        if largest <= 0.0 {
            return None;
        }
        let live: Vec<bool> = power.iter().map(|&p| p >= EXCITED * largest).collect();
        let mut spans: Vec<(usize, usize)> = Vec::new();
        for line in (0..live.len()).filter(|&line| live[line]) {
            match spans.last_mut() {
                Some((_, last)) if line - *last <= MAIN_LOBE => *last = line,
                _ => spans.push((line, line)),
            }
        }
        Some(Self { spans, live })
    }

    /// First excited line.
    pub fn first(&self) -> usize {
        self.spans[0].0
    }

    /// Last excited line.
    pub fn last(&self) -> usize {
        self.spans[self.spans.len() - 1].1
    }

    /// Excited lines.
    pub fn lines(&self) -> impl Iterator<Item = usize> + '_ {
        (0..self.live.len()).filter(|&line| self.live[line])
    }

    /// Bridges narrow gaps linearly; beyond the ends of a span, `h` falls from its last value to
    /// zero by half a cosine (a brick wall would ring through the whole impulse response).
    pub fn shape(&self, h: &mut [Complex64], per_line: usize) {
        let n_lines = self.live.len();
        let measured = h.to_vec();
        let value = |line: usize, at: usize| measured[line * per_line + at];
        h.fill(Complex64::default());
        let tapers = tapers(&self.spans, n_lines);
        for (s, &(first, last)) in self.spans.iter().enumerate() {
            let mut before = first;
            for line in first..=last {
                if self.live[line] {
                    before = line;
                }
                let after = (line..=last).find(|&l| self.live[l]).unwrap_or(last);
                let share =
                    if after == before { 0.0 } else { (line - before) as f64 / (after - before) as f64 };
                for at in 0..per_line {
                    h[line * per_line + at] = value(before, at) * (1.0 - share) + value(after, at) * share;
                }
            }
            for (edge, width, down) in [(first, tapers[s][0], true), (last, tapers[s][1], false)] {
                for k in 1..=width {
                    let fade = fade(k, width);
                    let line = if down { edge - k } else { edge + k };
                    for at in 0..per_line {
                        h[line * per_line + at] = value(edge, at) * fade;
                    }
                }
            }
        }
    }
}

/// Lines of the taper below and above each span of excited lines.
pub(super) fn tapers(spans: &[(usize, usize)], n_lines: usize) -> Vec<[usize; 2]> {
    // DC and Nyquist stay zero: their lines are real, so that a phase cannot be continued there.
    let tapers = |(s, &(first, last)): (usize, &(usize, usize))| {
        let width = ((last - first + 1) / 16).max(MAIN_LOBE);
        let below = match s.checked_sub(1) {
            Some(below) => (first - spans[below].1 - 1) / 2,
            None => first.saturating_sub(1),
        };
        let above = match spans.get(s + 1) {
            Some(above) => (above.0 - last - 1) / 2,
            None => (n_lines - 1 - last).saturating_sub(1),
        };
        [width.min(below), width.min(above)]
    };
    spans.iter().enumerate().map(tapers).collect()
}

/// What is left of a span's edge `k` lines beyond it, in a taper of `width` lines.
pub(super) fn fade(k: usize, width: usize) -> f64 {
    0.5 + 0.5 * (std::f64::consts::PI * k as f64 / (width + 1) as f64).cos()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shaped(power: &[f64], h: &[f64]) -> Vec<f64> {
        let mut h: Vec<Complex64> = h.iter().map(|&v| v.into()).collect();
        Band::new(power).unwrap().shape(&mut h, 1);
        h.iter().map(|z| z.re).collect()
    }

    #[test]
    fn dead_lines_fall_to_zero_smoothly_and_live_ones_are_untouched() {
        let mut power = vec![0.0; 64];
        power[10..40].fill(1.0);
        let h: Vec<f64> =
            (0..64).map(|l| if (10..40).contains(&l) { 2.0 + l as f64 } else { 99.0 }).collect();
        let found = shaped(&power, &h);
        assert_eq!(found.len(), 64);
        assert_eq!(found[10..40], h[10..40]);
        for edge in [&found[39..=44], &found[5..=10].iter().rev().copied().collect::<Vec<_>>()[..]] {
            assert!(edge.windows(2).all(|w| w[1] < w[0]), "{edge:?}");
            assert_eq!(edge[5], 0.0);
        }
        assert!(found[..5].iter().chain(&found[45..]).all(|&v| v == 0.0));
    }

    #[test]
    fn narrow_gaps_are_bridged_and_wide_ones_silenced() {
        let mut power = vec![0.0; 64];
        for line in [0, 1, 2, 20, 24, 28, 29, 30] {
            power[line] = 1.0;
        }
        let h: Vec<f64> = (0..64).map(f64::from).collect();
        let found = shaped(&power, &h);
        assert!(found[20..=30].iter().zip(&h[20..=30]).all(|(f, h)| (f - h).abs() < 1e-12));
        assert_eq!(found[10], 0.0);
        let band = Band::new(&power).unwrap();
        assert_eq!(band.spans, [(0, 2), (20, 30)]);
        assert_eq!((band.first(), band.last(), band.lines().count()), (0, 30, 8));
    }

    #[test]
    fn offsets_at_dc_do_not_hide_the_noise_band() {
        let mut power = vec![1.0; 32];
        power[0] = 1e9;
        power[1] = 1e8;
        power[20..].fill(1e-7);
        assert_eq!(Band::new(&power).unwrap().spans, [(0, 19)]);
        assert_eq!(Band::new(&[0.0; 5]), None);
    }

    #[test]
    fn dc_and_nyquist_are_never_reached_by_a_taper() {
        let mut power = vec![1.0; 17];
        (power[0], power[1], power[16]) = (0.0, 0.0, 0.0);
        let found = shaped(&power, &[1.0; 17]);
        assert_eq!((found[0], found[1] > 0.0, found[16]), (0.0, true, 0.0));
    }
}
