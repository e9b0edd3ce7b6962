//! Prepares a run for the store: all work for the processor, done before the transaction.

use std::collections::HashMap;
use std::path::Path;

use crate::domain::{FieldError, Quality, Rig, Role, RunMeta};
use crate::engine::{Samples, Signal};

use super::files::failed;
use super::object_file::ObjectFile;
use super::{Digest, StoreError, npy};

/// A checked run with its quality figures and its object, ready to be stored.
#[derive(Debug)]
pub struct PreparedRun {
    pub(super) row: NewRun,
    pub(super) object: ObjectFile,
}

/// The columns of a new run, but for those that the store gives it.
#[derive(Debug)]
pub(super) struct NewRun {
    pub(super) meta: RunMeta,
    pub(super) channels: Vec<String>,
    pub(super) units: Vec<String>,
    pub(super) samples: u64,
    pub(super) duration_s: f64,
    pub(super) sample_rate_hz: f64,
    pub(super) sha256: String,
    pub(super) quality: Quality,
    pub(super) object: Digest,
}

/// The reason why a run was not prepared.
#[derive(Debug)]
pub enum PrepareError {
    /// It does not suit its rig.
    Unsuitable(Vec<FieldError>),
    /// Its samples could not be read, or its object not be written.
    Store(StoreError),
}

impl From<Vec<FieldError>> for PrepareError {
    fn from(found: Vec<FieldError>) -> Self {
        Self::Unsuitable(found)
    }
}

impl From<StoreError> for PrepareError {
    fn from(error: StoreError) -> Self {
        Self::Store(error)
    }
}

impl PreparedRun {
    /// Checks the samples of a file against its rig, and writes them to a file in `scratch`, some at a time.
    /// Takes processor time: call it off the async threads.
    ///
    /// `channels` name the channels in order; `changes` say how the samples differ from those of the file, a sentence
    /// each, and become the first warnings of the run; `sha256` is that of the uploaded file, hex.
    ///
    /// # Errors
    /// Channels that are unknown or come twice, another sample rate, no samples,
    /// and what [`RunMeta::check`] finds; the file system's errors.
    pub fn new(
        scratch: &Path,
        rig: &Rig,
        meta: RunMeta,
        channels: Vec<String>,
        changes: Vec<String>,
        mut samples: impl Samples,
        sha256: String,
    ) -> Result<Self, PrepareError> {
        let meta = meta.check()?;
        let (units, roles) = check_channels(rig, &channels, &samples)?;
        if !Signal::same_rate(rig.sample_rate_hz, samples.sample_rate_hz()) {
            let found = samples.sample_rate_hz();
            let limit = format!("{} Hz, the rig's sample rate; found {found} Hz", rig.sample_rate_hz);
            return Err(vec![FieldError::new("/sample_rate_hz", limit)].into());
        }
        if samples.n_samples() == 0 {
            return Err(vec![FieldError::new("", "at least one sample")].into());
        }
        let mut quality = Quality::assess(&channels, &roles, &mut samples).map_err(failed(scratch))?;
        quality.warnings.splice(0..0, changes);
        let object = ObjectFile::make(scratch, |file| npy::encode(&mut samples, file))?;
        let samples = samples.n_samples();
        let row = NewRun {
            meta,
            channels,
            units,
            samples: samples as u64,
            // Uses the rig's rate, because files round theirs.
            duration_s: samples as f64 / rig.sample_rate_hz,
            sample_rate_hz: rig.sample_rate_hz,
            sha256,
            quality,
            object: object.digest().clone(),
        };
        Ok(Self { row, object })
    }

    /// Samples of each channel.
    pub fn samples(&self) -> u64 {
        self.row.samples
    }

    /// Length, s.
    pub fn duration_s(&self) -> f64 {
        self.row.duration_s
    }

    /// Quality figures.
    pub fn quality(&self) -> &Quality {
        &self.row.quality
    }
}

/// Units and roles of the channels, which must be channels of the rig and as many as there are samples of.
fn check_channels(
    rig: &Rig,
    channels: &[String],
    samples: &impl Samples,
) -> Result<(Vec<String>, Vec<Role>), Vec<FieldError>> {
    if channels.len() != samples.n_channels() {
        let limit =
            format!("one name a channel: {} names, {} channels", channels.len(), samples.n_channels());
        return Err(vec![FieldError::new("/channels", limit)]);
    }
    let mut errors = Vec::new();
    let mut seen = HashMap::new();
    let mut found = (Vec::with_capacity(channels.len()), Vec::with_capacity(channels.len()));
    for (i, name) in channels.iter().enumerate() {
        let at = format!("/channels/{i}");
        let Some(channel) = rig.channel(name) else {
            errors.push(FieldError::new(at, "a channel of the rig").on_channel(name));
            continue;
        };
        if seen.insert(name, i).is_some() {
            errors.push(FieldError::new(at, "each channel once").on_channel(name));
        }
        found.0.push(channel.unit.clone());
        found.1.push(channel.role);
    }
    if errors.is_empty() { Ok(found) } else { Err(errors) }
}

#[cfg(test)]
mod tests {
    use super::super::testing::{draft, meta, rig};
    use super::*;

    fn prepare(channels: &[&str], signal: &Signal) -> Result<PreparedRun, Vec<FieldError>> {
        let own = |texts: &[&str]| texts.iter().map(|t| (*t).to_owned()).collect::<Vec<_>>();
        let scratch = tempfile::tempdir().unwrap();
        let rig = rig(&draft("bench"));
        let names = own(channels);
        PreparedRun::new(scratch.path(), &rig, meta(), names, Vec::new(), signal.clone(), "00".into())
            .map_err(|error| match error {
                PrepareError::Unsuitable(found) => found,
                PrepareError::Store(error) => panic!("{error}"),
            })
    }

    fn signal(rate: f64, channels: &[&[f64]]) -> Signal {
        Signal::new(rate, channels.iter().map(|c| c.to_vec()).collect()).unwrap()
    }

    #[test]
    fn a_subset_of_the_channels_in_any_order_is_a_run() {
        let run = prepare(&["y", "u"], &signal(100.0, &[&[1.0, 2.0], &[3.0, 4.0]])).unwrap().row;
        assert_eq!((run.units, run.samples, run.duration_s), (vec!["mm".into(), "kN".into()], 2, 0.02));
    }

    #[test]
    fn unknown_and_repeated_channels_are_named() {
        let s = signal(100.0, &[&[1.0], &[2.0], &[3.0]]);
        let errors = prepare(&["u", "q", "u"], &s).unwrap_err();
        let named: Vec<_> =
            errors.iter().map(|e| (e.pointer.as_str(), e.channel.as_deref().unwrap())).collect();
        assert_eq!(named, [("/channels/1", "q"), ("/channels/2", "u")]);
    }

    #[test]
    fn another_sample_rate_and_an_empty_file_are_refused() {
        let errors = prepare(&["u"], &signal(101.0, &[&[1.0]])).unwrap_err();
        assert_eq!(errors[0].pointer, "/sample_rate_hz");
        assert!(prepare(&["u"], &signal(100.00005, &[&[1.0]])).is_ok(), "1e-6 relative is one rate");
        assert!(prepare(&["u"], &signal(100.0, &[&[]])).is_err());
        assert!(prepare(&["u", "y"], &signal(100.0, &[&[1.0]])).is_err());
    }
}
