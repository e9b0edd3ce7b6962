//! Faults of the runs of a fit, a sentence for each channel and fault, for the model's report.

use super::sentences::{delay, hum, percent};
use super::{ChannelQuality, Quality};
use crate::domain::Run;

/// Runs that a sentence names; more are counted.
const NAMED: usize = 3;

/// A fault of a channel in one run: what the channel does, and what that means for a fit.
struct Fault {
    /// Verb and object, after the name of the channel.
    what: String,
    /// The rest of the sentence.
    means: &'static str,
    /// Share of the samples, where there is one.
    share: Option<f64>,
}

/// Faults of these channels in the runs of a fit, a sentence each, by channel in the order of `channels`.
pub fn faults_of_runs<'a>(runs: &[&Run], channels: impl IntoIterator<Item = &'a String>) -> Vec<String> {
    channels.into_iter().flat_map(|channel| of_channel(runs, channel)).collect()
}

fn of_channel(runs: &[&Run], channel: &str) -> Vec<String> {
    // In the order in which the runs show them.
    let mut found: Vec<(Fault, Vec<&Run>)> = Vec::new();
    for run in runs {
        let Some(figures) = run.quality.channels.iter().find(|c| c.channel == channel) else { continue };
        for fault in faults(figures, run) {
            match found.iter_mut().find(|(known, _)| known.what == fault.what) {
                Some((known, of)) => {
                    known.share = known.share.zip(fault.share).map(|(known, new)| known.max(new));
                    of.push(run);
                }
                None => found.push((fault, vec![run])),
            }
        }
    }
    let sentence = |(fault, of): &(Fault, Vec<&Run>)| {
        let share = fault.share.map(|share| format!(", up to {} of its samples", percent(share)));
        let (what, runs, means) = (&fault.what, named(of, runs.len()), fault.means);
        format!("{channel} {what} in {runs}{}: {means}.", share.unwrap_or_default())
    };
    found.iter().map(sentence).collect()
}

fn faults(channel: &ChannelQuality, run: &Run) -> Vec<Fault> {
    let fault = |what: &str, means, share| Fault { what: what.to_owned(), means, share };
    if channel.dead {
        return vec![fault("is constant", "the run says nothing about it", None)];
    }
    let mut found = Vec::new();
    if channel.clipped_share > 0.0 {
        let means = "the model learns the limit of the measurement as one of the rig";
        found.push(fault("is clipped", means, Some(channel.clipped_share)));
    }
    if let Some(other) = repeated(&run.quality, &channel.channel) {
        let means = "one of both was not measured, and the model learns that they are equal";
        found.push(Fault { what: format!("repeats {other}"), means, share: None });
    }
    if channel.spikes.is_some_and(|spikes| spikes.count > 0) {
        found.push(fault("has spikes", "a linear fit cannot explain them", None));
    }
    if channel.dropouts.is_some_and(|dropouts| dropouts.count > 0) {
        found.push(fault("has drop-outs", "the model learns that the rig stands still there", None));
    }
    if hum(channel).is_some() {
        found.push(fault("has mains hum", "no model can predict it", None));
    }
    if delay(channel, run.sample_rate_hz).is_some() {
        let means = "the quality of the run says by how much, and what a fit loses";
        found.push(fault("is out of step with its drive", means, None));
    }
    found
}

/// The channel that this one repeats in the run.
fn repeated<'a>(quality: &'a Quality, channel: &str) -> Option<&'a str> {
    let others = quality.channels.iter().map(|other| other.channel.as_str());
    others
        .filter(|other| *other != channel)
        .find(|other| quality.warnings.contains(&super::repeats_sentence(channel, other)))
}

/// The runs by name, or by id where they have none.
fn named(runs: &[&Run], of: usize) -> String {
    let name = |run: &&Run| if run.name.is_empty() { run.id.to_string() } else { run.name.clone() };
    let mut names = runs.iter().take(NAMED).map(name).collect::<Vec<_>>().join(", ");
    if runs.len() > NAMED {
        names.push_str(", ...");
    }
    format!("{} of {of} runs ({names})", runs.len())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{Role, RunKind, Split};
    use crate::engine::Signal;

    fn run(name: &str, u: Vec<f64>, y: Vec<f64>) -> Run {
        let names = ["u", "y"].map(str::to_owned);
        let mut signal = Signal::new(100.0, vec![u, y]).unwrap();
        let quality = Quality::assess(&names, &[Role::Drive, Role::Response], &mut signal).unwrap();
        Run {
            id: uuid::Uuid::from_u128(7),
            rig: "bench".parse().unwrap(),
            name: name.to_owned(),
            kind: RunKind::Noise,
            split: Split::Training,
            tags: Vec::new(),
            started_at: None,
            created_at: jiff::Timestamp::UNIX_EPOCH,
            channels: names.to_vec(),
            units: ["kN", "mm"].map(str::to_owned).to_vec(),
            samples: 500,
            duration_s: 5.0,
            sample_rate_hz: 100.0,
            sha256: String::new(),
            quality,
            duplicate_of: None,
            object: String::new(),
        }
    }

    fn wave(step: f64) -> Vec<f64> {
        (0..500).map(|i| (step * f64::from(i)).sin() + 0.3 * (1.7 * step * f64::from(i)).cos()).collect()
    }

    fn told(runs: &[Run]) -> Vec<String> {
        let channels = ["u", "y"].map(str::to_owned);
        faults_of_runs(&runs.iter().collect::<Vec<_>>(), &channels)
    }

    #[test]
    fn a_fault_is_told_once_with_the_runs_that_have_it() {
        let clipped = |limit: f64| -> Vec<f64> { wave(0.2).iter().map(|y| y.clamp(-limit, limit)).collect() };
        let runs = [
            run("n1", wave(0.5), clipped(0.9)),
            run("n2", wave(0.6), clipped(0.5)),
            run("n3", wave(0.4), wave(0.8)),
        ];
        let mut found = told(&runs);
        found.retain(|sentence| sentence.contains("clipped"));
        assert_eq!(found.len(), 1, "{found:?}");
        assert!(found[0].starts_with("y is clipped in 2 of 3 runs (n1, n2), up to "), "{found:?}");
        assert!(
            found[0].ends_with("the model learns the limit of the measurement as one of the rig."),
            "{found:?}"
        );
    }

    #[test]
    fn constant_and_repeated_channels_are_told_by_name() {
        let runs = [run("a", wave(0.5), wave(0.5)), run("", vec![2.0; 500], wave(0.9))];
        let found = told(&runs);
        assert_eq!(
            found[0],
            format!("u is constant in 1 of 2 runs ({}): the run says nothing about it.", runs[1].id)
        );
        assert!(found[1].starts_with("y repeats u in 1 of 2 runs (a): "), "{found:?}");
    }

    #[test]
    fn clean_runs_are_told_nothing_of() {
        assert_eq!(told(&[run("a", wave(0.5), wave(0.9))]), [""; 0]);
        assert_eq!(named(&[&run("a", wave(0.5), wave(0.9)); 5], 9), "5 of 9 runs (a, a, a, ...)");
    }
}
