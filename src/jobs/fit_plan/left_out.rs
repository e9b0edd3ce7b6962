//! Which training runs a fit leaves out whole, to compare its model with others.

use crate::domain::{ChannelQuality, Run};
use crate::engine::model::FitSplit;

/// Runs that compare models hold at least this share of all samples, if runs like the rest allow it.
const COMPARISON_SHARE: f64 = 0.2;
/// Runs that stop a training, where there are enough, hold at least this share.
const STOPPING_SHARE: f64 = 0.1;
/// From so many training runs on a whole run stops the training; with fewer too little would be left.
const ENOUGH_TO_STOP: usize = 4;
/// A run of less than this share of all samples says too little about a model.
const SHORTEST_SHARE: f64 = 0.05;
/// Share of all samples that stays when the first run is left out, and when further ones are.
const LEFT_AT_FIRST: f64 = 0.3;
/// See [`LEFT_AT_FIRST`].
const LEFT: f64 = 0.5;
/// A run may leave the range of the others by this share of their span.
const BEYOND: f64 = 0.25;
/// A run that spans less than this share of what the others span is at another level.
const SPANNED: f64 = 0.5;

/// Chooses among `runs`, which are in the order of their upload. `fixed` runs are never left out;
/// `shortest` is the least number of samples that a run needs to compare.
///
/// The newest runs are left out, because an active model from before has not seen them either; of these,
/// runs inside the range that the others cover, at about their level.
///
/// # Errors
/// Why no run can be left out, in an engineer's words.
pub(super) fn choose(
    runs: &[Run],
    channels: &[&str],
    fixed: impl Fn(&Run) -> bool,
    shortest: u64,
) -> Result<FitSplit, String> {
    let total: u64 = runs.iter().map(|run| run.samples).sum();
    let least = shortest.max((SHORTEST_SHARE * total as f64).ceil() as u64);
    let field = Field { runs, channels, least, total };
    let free = |run: usize| !fixed(&runs[run]);
    let comparison = field.take(COMPARISON_SHARE, free, &[]);
    if comparison.is_empty() {
        let longest = (0..runs.len()).filter(|&run| free(run)).map(|run| runs[run].samples).max();
        return Err(match longest {
            None => "every training run is one of the FRF part".into(),
            Some(samples) if samples < least => format!(
                "no training run that can be left out is long enough to compare models: {samples} samples, \
                 {least} are needed"
            ),
            Some(_) => "without any one of the longer training runs too little would be left".into(),
        });
    }
    let stopping = if runs.len() < ENOUGH_TO_STOP {
        Vec::new()
    } else {
        field.take(STOPPING_SHARE, |run| free(run) && !comparison.contains(&run), &comparison)
    };
    Ok(FitSplit::LeftOut { comparison, stopping })
}

/// What is chosen from.
struct Field<'a> {
    runs: &'a [Run],
    channels: &'a [&'a str],
    least: u64,
    total: u64,
}

impl Field<'_> {
    /// Runs to leave out beside those that are `gone`, ascending: the best first until `share` of all
    /// samples is reached.
    fn take(&self, share: f64, allowed: impl Fn(usize) -> bool, gone: &[usize]) -> Vec<usize> {
        let mut taken: Vec<usize> = Vec::new();
        let samples = |runs: &[usize]| runs.iter().map(|&run| self.runs[run].samples).sum::<u64>();
        while (samples(&taken) as f64) < share * self.total as f64 {
            let out: Vec<usize> = gone.iter().chain(&taken).copied().collect();
            let left = |run: usize| self.total - samples(&out) - self.runs[run].samples;
            let candidate = (0..self.runs.len())
                .rev()
                .filter(|&run| allowed(run) && !out.contains(&run) && self.runs[run].samples >= self.least)
                .filter(|&run| {
                    left(run) as f64 >= if out.is_empty() { LEFT_AT_FIRST } else { LEFT } * self.total as f64
                })
                .filter(|&run| self.rest_moves(run, &out))
                // Of equals the newest.
                .min_by(|&a, &b| self.strangeness(a, &out).total_cmp(&self.strangeness(b, &out)));
            let Some(run) = candidate else { break };
            // A second run is not worth a comparison outside the range of the rest.
            if !taken.is_empty() && self.strangeness(run, &out) > 0.0 {
                break;
            }
            taken.push(run);
        }
        taken.sort_unstable();
        taken
    }

    fn rest<'a>(&'a self, run: usize, out: &'a [usize]) -> impl Iterator<Item = &'a Run> {
        let stays = move |other: &usize| *other != run && !out.contains(other);
        (0..self.runs.len()).filter(stays).map(|other| &self.runs[other])
    }

    /// Whether every channel still moves in some run.
    fn rest_moves(&self, run: usize, out: &[usize]) -> bool {
        self.channels.iter().all(|name| {
            self.rest(run, out).any(|other| !other.quality.dead_channels.iter().any(|dead| dead == name))
        })
    }

    /// How far a run leaves what the rest covers, by its worst channel: 0 for a run like the rest.
    fn strangeness(&self, run: usize, out: &[usize]) -> f64 {
        let of = |run: &Run, name: &str| -> Option<(f64, f64)> {
            let of_name = |q: &&ChannelQuality| q.channel == name;
            run.quality.channels.iter().find(of_name).map(|q| (q.min, q.max))
        };
        let channel = |name: &&str| -> Option<f64> {
            let (min, max) = of(&self.runs[run], name)?;
            let rest = self.rest(run, out).filter_map(|other| of(other, name));
            let (low, high) = rest.reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)))?;
            let span = high - low;
            if span <= 0.0 {
                return Some(0.0);
            }
            let beyond = ((low - min).max(max - high) / span - BEYOND).max(0.0);
            let below = (SPANNED - (max - min) / span).max(0.0);
            Some(beyond + below)
        };
        self.channels.iter().filter_map(channel).fold(0.0, f64::max)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{RunKind, Split};
    use crate::jobs::fit_plan::testing::run;

    /// A run of `samples` samples whose drive goes from `-peak` to `peak`.
    fn at_level(id: u128, samples: u64, peak: f64) -> Run {
        let mut run = run(id, RunKind::Noise, Split::Training, samples);
        run.quality.channels = vec![ChannelQuality {
            channel: "u".into(),
            min: -peak,
            max: peak,
            mean: 0.0,
            std: peak / 4.0,
            rms: peak / 4.0,
            peak_to_rms: Some(4.0),
            dead: false,
            longest_at_extreme: 1,
            clipped_share: 0.0,
            ..ChannelQuality::default()
        }];
        run
    }

    fn chosen(runs: &[Run]) -> Result<(Vec<usize>, Vec<usize>), String> {
        match choose(runs, &["u", "y"], |_| false, 512)? {
            FitSplit::LeftOut { comparison, stopping } => Ok((comparison, stopping)),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn the_newest_run_is_left_out_until_a_fifth_of_the_samples_is() {
        let runs = |n: u128| (0..n).map(|id| at_level(id, 10_000, 1.0)).collect::<Vec<_>>();
        assert_eq!(chosen(&runs(2)), Ok((vec![1], vec![])));
        assert_eq!(chosen(&runs(3)), Ok((vec![2], vec![])));
        assert_eq!(chosen(&runs(5)), Ok((vec![4], vec![3])));
        assert_eq!(chosen(&runs(10)), Ok((vec![8, 9], vec![7])));
    }

    #[test]
    fn a_run_beyond_the_range_or_far_below_the_level_of_the_others_stays() {
        let runs = [1.0, 1.0, 1.1, 3.0].map(|peak| at_level((peak * 10.0) as u128, 10_000, peak));
        assert_eq!(chosen(&runs).unwrap().0, [2], "the loudest run is trained on");
        let runs = [1.0, 1.0, 0.1].map(|peak| at_level(1, 10_000, peak));
        assert_eq!(chosen(&runs).unwrap().0, [1], "the quietest would say nothing of the others");
    }

    #[test]
    fn runs_that_are_too_short_to_compare_are_not_left_out() {
        let runs = [at_level(1, 10_000, 1.0), at_level(2, 300, 1.0)];
        let why = chosen(&runs).unwrap_err();
        assert!(why.contains("too little would be left"), "{why}");
        let runs = [at_level(1, 300, 1.0), at_level(2, 400, 1.0)];
        let why = chosen(&runs).unwrap_err();
        assert!(why.contains("400 samples, 512 are needed"), "{why}");
    }

    #[test]
    fn what_is_left_keeps_every_channel_moving() {
        let mut runs = [at_level(1, 10_000, 1.0), at_level(2, 10_000, 1.0), at_level(3, 10_000, 1.0)];
        for run in &mut runs[..2] {
            run.quality.dead_channels = vec!["y".into()];
        }
        assert_eq!(chosen(&runs).unwrap().0, [1]);
        let runs = [at_level(1, 10_000, 1.0), at_level(2, 50_000, 1.0), at_level(3, 10_000, 1.0)];
        assert_eq!(chosen(&runs).unwrap().0, [0, 2]);
        let fixed = choose(&runs, &["u"], |run| run.id == runs[2].id, 512).unwrap();
        assert_eq!(fixed, FitSplit::LeftOut { comparison: vec![0], stopping: vec![] });
    }
}
