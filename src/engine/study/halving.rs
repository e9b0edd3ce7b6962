//! Successive halving (Jamieson and Talwalkar, 2016): all trials get a few epochs, the better ones more.

/// A round of trials with the same share of the epochs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rung {
    /// Trials in it.
    pub trials: usize,
    /// Share of the fit's epochs that each gets.
    pub share: f64,
}

/// The rungs of `trials` trials of which one in `reduction` goes on each time: the last has the full epochs and at
/// most `reduction` trials, so that a choice among full fits remains.
///
/// # Panics
/// If `reduction` is below 2.
pub fn rungs(trials: usize, reduction: usize) -> Vec<Rung> {
    assert!(reduction >= 2, "nothing would be left out");
    let mut counts = vec![trials];
    while counts[counts.len() - 1] > reduction {
        counts.push(counts[counts.len() - 1].div_ceil(reduction));
    }
    let last = counts.len() - 1;
    let share = |rung: usize| (reduction as f64).powi(-((last - rung) as i32));
    counts.iter().enumerate().map(|(rung, &trials)| Rung { trials, share: share(rung) }).collect()
}

/// The `keep` trials with the least error, in the order of their numbers. A trial without an error comes last, and of
/// equals the first stays.
pub fn survivors(errors: &[(usize, Option<f64>)], keep: usize) -> Vec<usize> {
    let mut order: Vec<(usize, f64)> =
        errors.iter().map(|&(trial, error)| (trial, error.unwrap_or(f64::INFINITY))).collect();
    order.sort_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
    let mut kept: Vec<usize> = order.into_iter().take(keep).map(|(trial, _)| trial).collect();
    kept.sort_unstable();
    kept
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_rung_has_a_share_of_the_trials_and_the_last_the_full_epochs() {
        let of = |trials, reduction| -> Vec<(usize, f64)> {
            rungs(trials, reduction).iter().map(|rung| (rung.trials, rung.share)).collect()
        };
        assert_eq!(of(27, 3), [(27, 1.0 / 9.0), (9, 1.0 / 3.0), (3, 1.0)]);
        assert_eq!(of(20, 3), [(20, 1.0 / 9.0), (7, 1.0 / 3.0), (3, 1.0)]);
        assert_eq!(of(3, 3), [(3, 1.0)]);
        assert_eq!(of(1, 2), [(1, 1.0)]);
        assert_eq!(of(5, 2), [(5, 0.25), (3, 0.5), (2, 1.0)]);
    }

    #[test]
    fn the_least_errors_go_on_and_a_failed_trial_comes_last() {
        let errors = [(0, Some(0.3)), (1, None), (2, Some(0.1)), (3, Some(0.3)), (4, Some(0.2))];
        assert_eq!(survivors(&errors, 2), [2, 4]);
        assert_eq!(survivors(&errors, 3), [0, 2, 4], "of equals the first");
        assert_eq!(survivors(&errors, 9).len(), 5);
    }
}
