//! The runs of a request as the screen reads them, and the noise that their repeats tell.

use crate::diagnosis::input::{self, Input, Mode, Run};
use crate::diagnosis::numerics::linear::mean;
use crate::diagnosis::screen::{Channel, Grouping, Record, Recording, group};

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
    pub fn of(input: &Input) -> Self {
        let again = |run: &Run| input.runs.iter().any(|other| other.name == run.name);
        let known = |run: &Run| !input.has_adopted() || run.added.is_some();
        let baseline =
            input.baseline.iter().filter(|run| input.mode == Mode::InSitu && known(run) && !again(run));
        Self::of_runs(input, input.runs.iter().chain(baseline))
    }

    /// The runs to explain alone.
    pub fn without_baseline(input: &Input) -> Self {
        Self::of_runs(input, input.runs.iter())
    }

    /// Whether runs of the baseline are among them.
    pub fn has_baseline(&self, input: &Input) -> bool {
        self.recording.records.len() > input.runs.len()
    }

    fn of_runs<'a>(input: &Input, runs: impl Iterator<Item = &'a Run> + Clone) -> Self {
        let names = runs.clone().map(|run| run.name.clone()).collect();
        let recording = recording(input, runs);
        let grouping = group(&recording, &input.repeats);
        let (noise, shares) = (noise(&recording, &grouping), shares(&recording));
        Self { names, recording, grouping, noise, shares }
    }
}

fn recording<'a>(input: &Input, runs: impl Iterator<Item = &'a Run>) -> Recording {
    let channel = |c: &input::Channel| Channel { name: c.name.clone(), quantity: c.quantity };
    let record = |run: &Run| Record {
        drive: run.drive.clone(),
        response: run.response.clone(),
        added: run.added.clone(),
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
    let about_mean = |y: &[f64]| {
        let centre = mean(y);
        y.iter().map(|y| (y - centre) * (y - centre)).sum::<f64>()
    };
    let of = |r: usize| {
        let (mut rest, mut all) = (0.0, 0.0);
        for record in &recording.records {
            all += about_mean(record.response.channel(r));
            rest += about_mean(&record.beside_added(r, 0..record.response.n_samples()));
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
