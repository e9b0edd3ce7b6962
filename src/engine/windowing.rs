//! Windows over a signal, and the weights with which they are recombined (Heindel et al., section 2.2.2).
//!
//! Windows of `L` samples start at 0, hop, 2 hop, ..., on past the end until every sample has its
//! full set of weights; one more spans `-L/2..L/2`. Before the start and after the end inputs are
//! held. In time `t = 0..L-1` of a window its weight is `(1 - ((2t - L) / L)^2)^10`, divided by the
//! sum over all windows at that sample: a partition of unity. At `t = 0` the weight is zero.

use super::EngineError;

/// Windows of one length and hop over a signal of `samples` samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Windows {
    len: usize,
    hop: usize,
    samples: usize,
}

impl Windows {
    /// Checks `window_len >= 2` and `1 <= hop <= window_len / 2`.
    ///
    /// # Errors
    /// [`EngineError::Setting`] for `lstm.window_len` or `lstm.hop`; [`EngineError::TooShort`] for a
    /// signal without samples.
    pub fn new(window_len: usize, hop: usize, samples: usize) -> Result<Self, EngineError> {
        check_window(window_len, hop)?;
        if samples == 0 {
            return Err(EngineError::TooShort { what: "signal", needed: 1, found: 0 });
        }
        Ok(Self { len: window_len, hop, samples })
    }

    /// Samples of a window, `L`.
    #[expect(clippy::len_without_is_empty, reason = "a window always has samples")]
    pub fn len(&self) -> usize {
        self.len
    }

    /// How many windows there are, the one before the start included.
    pub fn count(&self) -> usize {
        // A window that starts at the last sample has weight zero there and is not needed.
        1 + (self.samples - 1).div_ceil(self.hop)
    }

    /// First sample of window `index`; `-L/2` for index 0.
    pub fn start(&self, index: usize) -> isize {
        if index == 0 { -((self.len / 2) as isize) } else { ((index - 1) * self.hop) as isize }
    }

    /// The partition of unity.
    pub fn weights(&self) -> Weights {
        let shape: Vec<f64> = (0..self.len).map(|t| welch10(t, self.len)).collect();
        // From sample L on the windows at a sample all start at or after 0, and the sums repeat
        // with every hop.
        let mut total = vec![0.0; self.len + self.hop];
        let starts = std::iter::once(-((self.len / 2) as isize))
            .chain((0..total.len()).step_by(self.hop).map(|s| s as isize));
        for start in starts {
            for (t, w) in shape.iter().enumerate() {
                if let Some(sum) = usize::try_from(start + t as isize).ok().and_then(|s| total.get_mut(s)) {
                    *sum += w;
                }
            }
        }
        let mut weights = Weights { shape, total, hop: self.hop, interior: Vec::new() };
        // Any start that is a multiple of the hop and not below L gives the same weights.
        let start = self.len.next_multiple_of(self.hop) as isize;
        weights.interior = weights.of_start(start);
        weights
    }
}

/// Limits of `lstm.window_len` and `lstm.hop`.
///
/// # Errors
/// [`EngineError::Setting`].
pub fn check_window(window_len: usize, hop: usize) -> Result<(), EngineError> {
    if window_len < 2 {
        return Err(EngineError::Setting {
            setting: "lstm.window_len",
            found: window_len.to_string(),
            limit: "at least 2 samples".into(),
        });
    }
    if hop == 0 || hop > window_len / 2 {
        return Err(EngineError::Setting {
            setting: "lstm.hop",
            found: hop.to_string(),
            limit: format!("1 to {}, half of lstm.window_len", window_len / 2),
        });
    }
    Ok(())
}

/// Weight of time `t` in a window of `len` samples, before normalisation: Welch's window to the
/// tenth power, `(1 - ((2t - L) / L)^2)^10`.
pub fn welch10(t: usize, len: usize) -> f64 {
    let u = (2.0 * t as f64 - len as f64) / len as f64;
    (1.0 - u * u).powi(10)
}

/// Normalised weights of all windows.
#[derive(Debug, Clone, PartialEq)]
pub struct Weights {
    /// [`welch10`] of each time in a window.
    shape: Vec<f64>,
    /// Sum over the windows at samples `0..L + hop`; later ones repeat the last `hop`.
    total: Vec<f64>,
    hop: usize,
    /// Normalised weights of a window that starts at or after sample `L`.
    interior: Vec<f32>,
}

impl Weights {
    /// Weights of the window that starts at sample `start`, which is one of the [`Windows`]; zero
    /// where the window lies before the signal.
    pub fn of(&self, start: isize) -> std::borrow::Cow<'_, [f32]> {
        if start >= self.shape.len() as isize {
            (&self.interior[..]).into()
        } else {
            self.of_start(start).into()
        }
    }

    fn of_start(&self, start: isize) -> Vec<f32> {
        let len = self.shape.len();
        let normalised = |(t, w): (usize, &f64)| {
            usize::try_from(start + t as isize).map_or(0.0, |sample| {
                let at = if sample < len { sample } else { len + (sample - len) % self.hop };
                (w / self.total[at]) as f32
            })
        };
        self.shape.iter().enumerate().map(normalised).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// All windows and weights at every sample, straight from the definition.
    fn naive(len: usize, hop: usize, samples: usize) -> Vec<Vec<(isize, f64)>> {
        // Twice as many windows as could matter on either side of the end.
        let mut starts = vec![-((len / 2) as isize)];
        starts.extend((0..samples + 2 * len).step_by(hop).map(|s| s as isize));
        (0..samples as isize)
            .map(|s| {
                let at: Vec<(isize, f64)> = starts
                    .iter()
                    .filter(|&&start| (start..start + len as isize).contains(&s))
                    .map(|&start| (start, welch10((s - start) as usize, len)))
                    .collect();
                let total: f64 = at.iter().map(|(_, w)| w).sum();
                at.into_iter().map(|(start, w)| (start, w / total)).collect()
            })
            .collect()
    }

    #[test]
    fn windows_and_weights_equal_the_definition_for_every_length_and_hop() {
        for (len, hops) in [(2, &[1][..]), (7, &[1, 2, 3]), (16, &[1, 3, 5, 8]), (32, &[7, 16])] {
            for &hop in hops {
                for samples in (1..3 * len + 3).chain([10 * len + 1]) {
                    let windows = Windows::new(len, hop, samples).unwrap();
                    let weights = windows.weights();
                    let mut found = vec![Vec::new(); samples];
                    for i in 0..windows.count() {
                        let start = windows.start(i);
                        for (t, &w) in weights.of(start).iter().enumerate() {
                            if let Ok(s) = usize::try_from(start + t as isize)
                                && s < samples
                            {
                                found[s].push((start, w));
                            }
                        }
                    }
                    for (s, expected) in naive(len, hop, samples).into_iter().enumerate() {
                        let sum: f64 = found[s].iter().map(|&(_, w)| f64::from(w)).sum();
                        assert!((sum - 1.0).abs() < 1e-6, "L {len} hop {hop} n {samples} sample {s}: {sum}");
                        for (start, w) in expected.into_iter().filter(|&(_, w)| w > 0.0) {
                            let other = found[s].iter().find(|f| f.0 == start).map(|f| f.1);
                            let other = other.unwrap_or_else(|| panic!("no window {start} at {s}"));
                            assert!((f64::from(other) - w).abs() < 1e-6);
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn the_first_window_reaches_half_a_length_before_the_start_and_the_next_begins_with_weight_zero() {
        let windows = Windows::new(256, 128, 1000).unwrap();
        assert_eq!((windows.start(0), windows.start(1), windows.start(2)), (-128, 0, 128));
        assert_eq!(welch10(0, 256), 0.0);
        assert_eq!(welch10(128, 256), 1.0);
        assert!((welch10(64, 256) - 0.75_f64.powi(10)).abs() < 1e-15);
        let weights = windows.weights();
        assert_eq!(weights.of(-128)[128], 1.0);
        assert_eq!(weights.of(0)[0], 0.0);
        assert!(weights.of(-128)[..128].iter().all(|&w| w == 0.0));
    }

    #[test]
    fn one_sample_needs_only_the_first_window() {
        let windows = Windows::new(8, 4, 1).unwrap();
        assert_eq!(windows.count(), 1);
        assert_eq!(windows.weights().of(-4)[4], 1.0);
    }

    #[test]
    fn senseless_windows_are_refused_by_name() {
        assert!(matches!(
            Windows::new(1, 1, 9),
            Err(EngineError::Setting { setting: "lstm.window_len", .. })
        ));
        for hop in [0, 5] {
            assert!(matches!(Windows::new(8, hop, 9), Err(EngineError::Setting { setting: "lstm.hop", .. })));
        }
        assert!(matches!(Windows::new(8, 4, 0), Err(EngineError::TooShort { .. })));
    }
}
