//! Means over a window about each sample.

/// Mean of up to `window` values about each one; fewer at the ends.
pub(super) fn moving_mean(values: impl Iterator<Item = f64>, window: usize) -> Vec<f64> {
    let mut sums = vec![0.0];
    sums.extend(values.scan(0.0, |sum, v| {
        *sum += v;
        Some(*sum)
    }));
    let n = sums.len() - 1;
    let (before, after) = (window / 2, window - window / 2);
    let at = |t: usize| {
        let (from, to) = (t.saturating_sub(before), n.min(t + after));
        (sums[to] - sums[from]) / (to - from) as f64
    };
    // Whole windows lie about these.
    let start = before.min(n);
    let end = (n + 1).saturating_sub(after).max(start);
    let mut means = Vec::with_capacity(n);
    means.extend((0..start).map(at));
    let (share, pairs) = (1.0 / window as f64, sums.iter().zip(sums.get(window..).unwrap_or_default()));
    means.extend(pairs.take(end - start).map(|(from, to)| (to - from) * share));
    means.extend((end..n).map(at));
    means
}

/// [`moving_mean`] of the squares.
pub(super) fn moving_mean_square(values: impl Iterator<Item = f64>, window: usize) -> Vec<f64> {
    // The rounding of the sums may go below zero.
    moving_mean(values.map(|v| v * v), window).into_iter().map(|square| square.max(0.0)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_window_lies_about_its_sample_and_is_shorter_at_the_ends() {
        assert_eq!(moving_mean([1.0, 0.0, -2.0, 0.0].into_iter(), 2), [1.0, 0.5, -1.0, -1.0]);
        let found = moving_mean_square([1.0, 0.0, 2.0, 0.0].into_iter(), 2);
        assert_eq!(found, [1.0, 0.5, 2.0, 2.0]);
        assert_eq!(moving_mean_square([3.0].into_iter(), 256), [9.0]);
        assert!(moving_mean_square(std::iter::empty(), 256).is_empty());
    }

    #[test]
    fn every_mean_is_that_of_the_values_in_its_window() {
        for n in [0_usize, 1, 2, 3, 7, 8, 9, 20] {
            let values: Vec<f64> = (0..n).map(|t| (t * t % 13) as f64 - 5.0).collect();
            for window in [1_usize, 2, 3, 7, 8, 9, 30] {
                let found = moving_mean(values.iter().copied(), window);
                let about = |t: usize| {
                    let of = &values[t.saturating_sub(window / 2)..n.min(t + window - window / 2)];
                    of.iter().sum::<f64>() / of.len() as f64
                };
                assert_eq!(found.len(), n);
                let worst = (0..n).map(|t| (found[t] - about(t)).abs()).fold(0.0, f64::max);
                assert!(worst < 1e-12, "{n} {window}: {found:?}");
            }
        }
    }
}
