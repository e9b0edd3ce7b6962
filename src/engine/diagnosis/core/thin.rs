//! Long runs made short enough to search them.

use super::fit::Stretch;
use crate::diagnosis::numerics::smooth::smooth;

/// Samples in all on which the order and its poles are searched: more cost time and tell no more.
const SEARCHED: usize = 60_000;
/// Drives beyond which work is spared. The columns of a fit grow with the drives, and its time with their square.
pub(in crate::diagnosis) const FEW_DRIVES: usize = 8;

/// Samples for so many drives, of `most` for [few](FEW_DRIVES): the more beyond these, the fewer, in proportion.
pub(in crate::diagnosis) fn samples_for(drives: usize, most: usize) -> usize {
    most * FEW_DRIVES / drives.max(FEW_DRIVES)
}

/// A stretch at a lower rate.
pub(super) struct Thinned {
    pub drives: Vec<Vec<f64>>,
    pub response: Vec<f64>,
}

/// Stretches with fewer samples, on which an order and its poles can be searched quickly, and how many
/// samples one of theirs stands for; `None` where there are few as it is. What lies above the band is
/// taken out first; its edge stays well below half the lower rate.
pub(super) fn thin(stretches: &[Stretch<'_>], band: [f64; 2]) -> Option<(Vec<Thinned>, usize)> {
    let total: usize = stretches.iter().map(|s| s.response.len()).sum();
    let searched = samples_for(stretches.first().map_or(0, |s| s.drives.len()), SEARCHED);
    if total <= searched {
        return None;
    }
    let step = total.div_ceil(searched).min((0.2 / band[1]) as usize).max(1);
    // What is too much even then is left out at each stretch's end.
    let share = (searched * step) as f64 / total as f64;
    let thinned = stretches
        .iter()
        .map(|s| {
            let kept = ((s.response.len() as f64 * share) as usize).min(s.response.len());
            let slower = |x: &[f64]| -> Vec<f64> {
                let below = if step > 1 { smooth(&x[..kept], band[1]) } else { x[..kept].to_vec() };
                below.into_iter().step_by(step).collect()
            };
            Thinned { drives: s.drives.iter().map(|d| slower(d)).collect(), response: slower(s.response) }
        })
        .collect();
    Some((thinned, step))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn few_samples_stay_and_many_keep_their_band() {
        let wave = |n: usize| -> Vec<f64> { (0..n).map(|k| (0.01 * k as f64).sin()).collect() };
        let band = [0.0, 0.02];
        let short = wave(1000);
        assert!(thin(&[Stretch { drives: vec![&short], response: &short }], band).is_none());
        let long = wave(3 * SEARCHED);
        let (thinned, step) = thin(&[Stretch { drives: vec![&long], response: &long }], band).unwrap();
        assert_eq!(step, 3);
        let found = &thinned[0].response;
        assert!(found.len() <= SEARCHED && found.len() > SEARCHED - 5, "{}", found.len());
        for k in 100..1000 {
            assert!((found[k] - long[3 * k]).abs() < 1e-3, "sample {k}");
        }
    }

    #[test]
    fn of_many_drives_fewer_samples_are_searched() {
        assert_eq!([1, 8, 32].map(|drives| samples_for(drives, SEARCHED)), [60_000, 60_000, 15_000]);
        let long: Vec<f64> = (0..SEARCHED).map(|k| (0.01 * k as f64).sin()).collect();
        let of = |drives: usize| {
            thin(&[Stretch { drives: vec![&long; drives], response: &long }], [0.0, 0.02])
                .map(|(thinned, step)| (thinned[0].response.len(), step))
        };
        assert_eq!([of(8), of(16), of(32)], [None, Some((30_000, 2)), Some((15_000, 4))]);
    }
}
