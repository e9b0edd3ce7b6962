//! The rig's test programme: simulated, then uploaded run by run.

use rayon::prelude::*;

use super::scores::TestRun;
use super::{DemoError, bars};
use crate::client::{Client, ClientError};
use crate::engine::virtual_rig::{ProgrammeRun, ProgrammeSettings, VirtualRig, programme};
use crate::engine::{EngineError, Signal, Split};
use crate::formats::npy::{self, Dtype, Order};

/// One recorded run of the virtual rig.
pub struct DemoRun {
    run: ProgrammeRun,
    /// Drives, then responses: all channels in the rig's order.
    recorded: Signal,
}

impl DemoRun {
    /// Simulates a run; `arriving` holds the drives that reach the rig if they differ from those sent.
    ///
    /// # Errors
    /// Those of [`VirtualRig::simulate`].
    pub fn simulated(
        rig: &VirtualRig,
        run: ProgrammeRun,
        arriving: Option<&Signal>,
        sensor_seed: u64,
    ) -> Result<Self, EngineError> {
        let responses = rig.simulate(arriving.unwrap_or(&run.drive), sensor_seed)?;
        let channels = [run.drive.channels(), responses.channels()].concat();
        let recorded = Signal::new(run.drive.sample_rate_hz(), channels)?;
        Ok(Self { run, recorded })
    }

    /// Length of training data in it.
    pub fn training_s(&self) -> f64 {
        if self.run.split == Split::Training { self.recorded.duration_s() } else { 0.0 }
    }

    /// Column of the table that it belongs to.
    fn column(&self) -> Option<&'static str> {
        let test = self.run.split == Split::Test;
        self.run.tags.iter().filter(|_| test).find_map(|tag| match *tag {
            "n1" => Some("N1"),
            "n2" => Some("N2"),
            "sl" => Some("SL"),
            "sl-minus" => Some("SL-"),
            "sl-plus" => Some("SL+"),
            _ => None,
        })
    }
}

/// The service's answers to the uploads.
pub struct Uploaded {
    /// Jobs that the fit policy queued.
    pub jobs: Vec<String>,
    /// Runs to predict.
    pub tests: Vec<TestRun>,
}

/// Simulates a whole test programme, one run per core.
///
/// # Errors
/// Lengths that the programme refuses.
pub fn record(
    rig: &VirtualRig,
    seed: u64,
    minutes: f64,
    bar: &bars::Bar,
) -> Result<Vec<DemoRun>, EngineError> {
    let runs = programme(&ProgrammeSettings::of_minutes(minutes), seed)?;
    bar.set_length(runs.len() as u64);
    runs.into_par_iter()
        .enumerate()
        .map(|(i, run)| {
            let run = DemoRun::simulated(rig, run, None, seed.wrapping_mul(1_000).wrapping_add(i as u64))?;
            bar.inc(1);
            Ok(run)
        })
        .collect()
}

/// Uploads all runs as NPY files, training noise last: the policy then finds everything there.
///
/// # Errors
/// [`ClientError`] when a run is refused.
pub async fn all(client: &Client, rig: &str, runs: &[DemoRun]) -> Result<Uploaded, DemoError> {
    let bar = bars::steps("uploading the runs");
    bar.set_length(runs.len() as u64);
    let mut uploaded = Uploaded { jobs: Vec::new(), tests: Vec::new() };
    let (training, withheld): (Vec<_>, Vec<_>) = runs.iter().partition(|r| r.training_s() > 0.0);
    for recording in withheld.into_iter().chain(training) {
        let run = &recording.run;
        let mut query =
            vec![("name", run.name.as_str()), ("kind", run.kind.as_str()), ("split", run.split.as_str())];
        query.extend(run.tags.iter().map(|tag| ("tag", *tag)));
        let file =
            npy::write(recording.recorded.channels(), Dtype::F8, Order::C).map_err(std::io::Error::other)?;
        let answer = client.upload(rig, &query, "application/x-npy", file).await?;
        let jobs = answer["jobs"].as_array().ok_or(ClientError::Missing("jobs"))?;
        uploaded.jobs.extend(jobs.iter().filter_map(|j| j.as_str()).map(String::from));
        if let Some(column) = recording.column() {
            let id = answer["id"].as_str().ok_or(ClientError::Missing("id"))?.to_owned();
            uploaded.tests.push(TestRun { id, column });
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    uploaded.jobs.dedup();
    Ok(uploaded)
}
