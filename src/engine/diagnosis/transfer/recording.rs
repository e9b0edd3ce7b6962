//! The runs of a request as the screen reads them, and the noise that their repeats tell.

use crate::diagnosis::data::overview::Overview;
use crate::diagnosis::input::{self, Input, Mode, Run, level};
use crate::diagnosis::numerics::linear::{mean, rms, squares_about_mean};
use crate::diagnosis::screen::{Channel, Grouping, Record, Recording, group};

/// Samples of the baseline that are screened beside fewer of the runs to explain.
const BASELINE: usize = 100_000;

/// Ratio of two runs' levels from which on they are different.
const APART: f64 = 1.1;

/// What the runs tell before any law is tried.
pub(super) struct Runs {
    /// Names of the records.
    pub names: Vec<String>,
    pub recording: Recording,
    pub grouping: Grouping,
    /// RMS of each response's noise, where repeats tell it.
    pub noise: Option<Vec<f64>>,
    /// Share of each response that laws are sought in.
    pub shares: Vec<f64>,
}

impl Runs {
    /// The runs to explain; in situ also the baseline, which the rig drove with the effect in it. With adopted effects
    /// only what these add to a baseline run makes it of use.
    ///
    /// The baseline is there for its drives and levels: it counts as much as the runs to explain at most, by the beginning
    /// of each of its runs, since hours of it tell no law better and take hours.
    pub fn of(input: &Input) -> Self {
        let again = |run: &Run| input.runs.iter().any(|other| other.name == run.name);
        let known = |run: &Run| !input.has_adopted() || run.added.is_some();
        let baseline: Vec<&Run> = input
            .baseline
            .iter()
            .filter(|run| input.mode == Mode::InSitu && known(run) && !again(run))
            .collect();
        let samples = |run: &Run| run.drive.n_samples();
        let whole: usize = baseline.iter().map(|run| samples(run)).sum();
        let most = input.runs.iter().map(samples).sum::<usize>().max(BASELINE);
        let kept = |run: &Run| (samples(run) as f64 * (most as f64 / whole as f64).min(1.0)).ceil() as usize;
        let all = |run| (run, samples(run));
        Self::of_runs(
            input,
            input.runs.iter().map(all).chain(baseline.into_iter().map(|run| (run, kept(run)))),
        )
    }

    /// The runs to explain alone.
    pub fn without_baseline(input: &Input) -> Self {
        Self::of_runs(input, input.runs.iter().map(|run| (run, run.drive.n_samples())))
    }

    /// Whether runs of the baseline are among them.
    pub fn has_baseline(&self, input: &Input) -> bool {
        self.recording.records.len() > input.runs.len()
    }

    /// Whether the level of the drives follows the clock: of any two runs at different levels the later is the louder one,
    /// or of any two the earlier.
    pub fn level_follows_time(&self) -> bool {
        let records = &self.recording.records;
        let runs: Vec<[f64; 2]> = records.iter().map(|r| [r.started_s, level(r.drive.channels())]).collect();
        let mut grow = (0..runs.len()).flat_map(|i| (0..i).map(move |j| (i, j))).filter_map(|(i, j)| {
            let ([t, a], [s, b]) = (runs[i], runs[j]);
            let apart = a.max(b) > APART * a.min(b) && t != s;
            apart.then_some((a > b) == (t > s))
        });
        grow.next().is_some_and(|first| grow.all(|other| other == first))
    }

    /// RMS of errors of a response's groups, as the screen gives them, relative to the whole response.
    pub fn left(&self, r: usize, errors: &[f64]) -> f64 {
        self.shares[r] * rms(errors)
    }

    /// RMS of each response's noise relative to the response, where repeats tell it.
    pub fn relative_noise(&self, overview: &Overview) -> Option<Vec<f64>> {
        let noise = self.noise.as_ref()?;
        Some(noise.iter().zip(&overview.power).map(|(noise, power)| noise / power.level()).collect())
    }

    /// Bounds the noise of repeats by what a law leaves of each response's groups.
    pub fn noise_is_no_more_than(&mut self, errors: &[Vec<f64>], overview: &Overview) {
        let left = |r: usize| overview.power[r].level() * self.left(r, &errors[r]);
        let left: Vec<f64> = (0..errors.len()).map(left).collect();
        self.noise.iter_mut().flatten().zip(left).for_each(|(noise, left)| *noise = noise.min(left));
    }

    /// Runs, of each its first samples.
    fn of_runs<'a>(input: &Input, runs: impl Iterator<Item = (&'a Run, usize)> + Clone) -> Self {
        let names = runs.clone().map(|(run, _)| run.name.clone()).collect();
        let recording = recording(input, runs);
        let grouping = group(&recording, &input.repeats);
        let (noise, shares) = (noise(&recording, &grouping), shares(&recording));
        Self { names, recording, grouping, noise, shares }
    }
}

fn recording<'a>(input: &Input, runs: impl Iterator<Item = (&'a Run, usize)>) -> Recording {
    let channel = |c: &input::Channel| Channel { name: c.name.clone(), quantity: c.quantity, size: c.size };
    let record = |(run, samples): (&Run, usize)| Record {
        drive: run.drive.slice(0..samples),
        response: run.response.slice(0..samples),
        added: run.added.as_ref().map(|added| added.slice(0..samples)),
        started_s: run.started_s,
    };
    Recording {
        drives: input.drives.iter().map(channel).collect(),
        responses: input.responses.iter().map(channel).collect(),
        records: runs.map(record).collect(),
    }
}

/// Of each response the RMS of what adopted effects leave of it, which laws are sought in, relative to its own; 1
/// without any.
fn shares(recording: &Recording) -> Vec<f64> {
    let of = |r: usize| {
        let (mut rest, mut all) = (0.0, 0.0);
        for record in &recording.records {
            all += squares_about_mean(record.response.channel(r));
            rest += squares_about_mean(&record.beside_added(r, 0..record.response.n_samples()));
        }
        if all > 0.0 { f64::sqrt(rest / all) } else { 1.0 }
    };
    (0..recording.responses.len()).map(of).collect()
}

/// RMS of the noise of each response as its repeats tell it: half of the mean square by which they differ, what a
/// difference of their drives does included. `None` without repeats.
fn noise(recording: &Recording, grouping: &Grouping) -> Option<Vec<f64>> {
    let responses = recording.responses.len();
    let mut sums = vec![(0.0, 0.0); responses];
    let mut add = |a: &[f64], b: &[f64], r: usize| {
        let difference: Vec<f64> = a.iter().zip(b).map(|(a, b)| a - b).collect();
        let centre = mean(&difference);
        sums[r].0 += 0.5 * difference.iter().map(|d| (d - centre) * (d - centre)).sum::<f64>();
        sums[r].1 += difference.len() as f64;
    };
    for (record, period) in grouping.periods.iter().enumerate() {
        let Some(period) = *period else { continue };
        for r in 0..responses {
            let y = recording.records[record].response.channel(r);
            // The rig settles in the first periods.
            let settled = (y.len() / 8).div_ceil(period).max(1) * period;
            if settled + 2 * period <= y.len() {
                add(&y[settled..y.len() - period], &y[settled + period..], r);
            }
        }
    }
    for same in &grouping.repeats {
        for pair in same.windows(2) {
            for r in 0..responses {
                let [a, b] = [pair[0], pair[1]].map(|run| recording.records[run].response.channel(r));
                let n = a.len().min(b.len());
                add(&a[n / 6..n], &b[n / 6..n], r);
            }
        }
    }
    sums.iter().all(|s| s.1 > 0.0).then(|| sums.iter().map(|(sum, n)| (sum / n).sqrt()).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diagnosis::tests::rig::{noise_drive, none, request, run};

    /// Samples of each record that is not a run to explain.
    fn of_baseline(baseline: Vec<Run>) -> Vec<usize> {
        let input = Input { baseline, mode: Mode::InSitu, ..request(none, 0.01) };
        let records = Runs::of(&input).recording.records;
        records[input.runs.len()..].iter().map(|record| record.response.n_samples()).collect()
    }

    #[test]
    fn a_level_follows_the_clock_where_no_two_runs_say_otherwise() {
        let follows = |levels: &[f64]| {
            let runs = levels.iter().enumerate().map(|(i, level)| {
                let drive = noise_drive(5.0, *level, i as u64);
                Run { started_s: 60.0 * i as f64, ..run(&i.to_string(), drive, none, 0.01, i as u64) }
            });
            Runs::without_baseline(&Input { runs: runs.collect(), ..request(none, 0.01) })
                .level_follows_time()
        };
        assert!(follows(&[0.2, 0.5, 1.0]) && follows(&[1.0, 0.5, 0.5, 0.2]));
        assert!(!follows(&[0.5, 0.2, 1.0]) && !follows(&[0.2, 1.0, 0.2]));
        assert!(!follows(&[1.0, 1.0, 1.0]), "one level");
    }

    #[test]
    fn a_long_baseline_counts_by_the_beginnings_of_its_runs_and_a_short_one_whole() {
        let baseline = |seconds| {
            vec![
                run("one", noise_drive(seconds, 1.0, 1), none, 0.01, 1),
                run("other", noise_drive(0.5 * seconds, 1.0, 2), none, 0.01, 2),
            ]
        };
        let short = baseline(40.0);
        let whole: Vec<usize> = short.iter().map(|run| run.drive.n_samples()).collect();
        assert_eq!(of_baseline(short), whole);
        let kept = of_baseline(baseline(800.0));
        assert!(kept.iter().sum::<usize>() <= BASELINE + kept.len(), "{kept:?}");
        assert!(kept[0].abs_diff(2 * kept[1]) <= 2, "alike of each: {kept:?}");
    }
}
