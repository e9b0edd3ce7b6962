//! Prepares a run for the store: all work for the processor, done before the transaction.

use std::collections::HashMap;

use crate::domain::{FieldError, Quality, Rig, RunMeta};
use crate::engine::Signal;

use super::{Digest, npy};

/// A checked run with its quality figures and its bytes, ready to be stored.
#[derive(Debug, Clone)]
pub struct PreparedRun {
    pub(super) meta: RunMeta,
    pub(super) channels: Vec<String>,
    pub(super) units: Vec<String>,
    pub(super) samples: u64,
    pub(super) duration_s: f64,
    pub(super) sample_rate_hz: f64,
    pub(super) sha256: String,
    pub(super) quality: Quality,
    pub(super) object: Digest,
    pub(super) bytes: bytes::Bytes,
}

impl PreparedRun {
    /// Checks a parsed file against its rig. Takes processor time: call it off the async threads.
    ///
    /// `channels` name the signal's channels in order; `units`, where the file had some, must be the
    /// rig's (an empty unit is ignored); `sha256` is that of the uploaded file, hex.
    ///
    /// # Errors
    /// Channels that are unknown or come twice, another unit, another sample rate, no samples,
    /// and what [`RunMeta::check`] finds.
    pub fn new(
        rig: &Rig,
        meta: RunMeta,
        channels: Vec<String>,
        units: Option<Vec<String>>,
        signal: Signal,
        sha256: String,
    ) -> Result<Self, Vec<FieldError>> {
        let meta = meta.check()?;
        let units = check_channels(rig, &channels, units.as_deref(), &signal)?;
        if !Signal::same_rate(rig.sample_rate_hz, signal.sample_rate_hz()) {
            let found = signal.sample_rate_hz();
            let limit = format!("{} Hz, the rig's sample rate; found {found} Hz", rig.sample_rate_hz);
            return Err(vec![FieldError::new("/sample_rate_hz", limit)]);
        }
        if signal.n_samples() == 0 {
            return Err(vec![FieldError::new("", "at least one sample")]);
        }
        let quality = Quality::assess(&channels, &signal);
        let samples = signal.n_samples();
        let bytes = npy::encode(signal.into_channels());
        Ok(Self {
            meta,
            channels,
            units,
            samples: samples as u64,
            // Uses the rig's rate, because files round theirs.
            duration_s: samples as f64 / rig.sample_rate_hz,
            sample_rate_hz: rig.sample_rate_hz,
            sha256,
            quality,
            object: Digest::of(&bytes),
            bytes: bytes.into(),
        })
    }
}

/// Units of the channels, which must be channels of the rig and as many as the signal has.
fn check_channels(
    rig: &Rig,
    channels: &[String],
    units: Option<&[String]>,
    signal: &Signal,
) -> Result<Vec<String>, Vec<FieldError>> {
    if channels.len() != signal.n_channels() {
        let limit = format!("one name a channel: {} names, {} channels", channels.len(), signal.n_channels());
        return Err(vec![FieldError::new("/channels", limit)]);
    }
    let mut errors = Vec::new();
    let mut seen = HashMap::new();
    let mut found = Vec::with_capacity(channels.len());
    for (i, name) in channels.iter().enumerate() {
        let at = format!("/channels/{i}");
        let Some(channel) = rig.channel(name) else {
            errors.push(FieldError::new(at, "a channel of the rig").on_channel(name));
            continue;
        };
        if seen.insert(name, i).is_some() {
            errors.push(FieldError::new(at, "each channel once").on_channel(name));
        }
        let unit = units.and_then(|units| units.get(i)).map_or("", |unit| unit.trim());
        if !unit.is_empty() && unit != channel.unit {
            let limit = format!("{:?}, the rig's unit; found {unit:?}", channel.unit);
            errors.push(FieldError::new(format!("/units/{i}"), limit).on_channel(name));
        }
        found.push(channel.unit.clone());
    }
    if errors.is_empty() { Ok(found) } else { Err(errors) }
}

#[cfg(test)]
mod tests {
    use super::super::testing::{draft, meta, rig};
    use super::*;

    fn prepare(
        channels: &[&str],
        units: Option<&[&str]>,
        signal: &Signal,
    ) -> Result<PreparedRun, Vec<FieldError>> {
        let own = |texts: &[&str]| texts.iter().map(|t| (*t).to_owned()).collect::<Vec<_>>();
        PreparedRun::new(
            &rig(&draft("bench")),
            meta(),
            own(channels),
            units.map(own),
            signal.clone(),
            "00".into(),
        )
    }

    fn signal(rate: f64, channels: &[&[f64]]) -> Signal {
        Signal::new(rate, channels.iter().map(|c| c.to_vec()).collect()).unwrap()
    }

    #[test]
    fn a_subset_of_the_channels_in_any_order_is_a_run() {
        let run = prepare(&["y", "u"], None, &signal(100.0, &[&[1.0, 2.0], &[3.0, 4.0]])).unwrap();
        assert_eq!((run.units, run.samples, run.duration_s), (vec!["mm".into(), "kN".into()], 2, 0.02));
    }

    #[test]
    fn unknown_and_repeated_channels_and_other_units_are_named() {
        let s = signal(100.0, &[&[1.0], &[2.0], &[3.0]]);
        let errors = prepare(&["u", "q", "u"], Some(&["N", "", "kN"]), &s).unwrap_err();
        let named: Vec<_> =
            errors.iter().map(|e| (e.pointer.as_str(), e.channel.as_deref().unwrap())).collect();
        assert_eq!(named, [("/units/0", "u"), ("/channels/1", "q"), ("/channels/2", "u")]);
    }

    #[test]
    fn another_sample_rate_and_an_empty_file_are_refused() {
        let errors = prepare(&["u"], None, &signal(101.0, &[&[1.0]])).unwrap_err();
        assert_eq!(errors[0].pointer, "/sample_rate_hz");
        assert!(prepare(&["u"], None, &signal(100.00005, &[&[1.0]])).is_ok(), "1e-6 relative is one rate");
        assert!(prepare(&["u"], None, &signal(100.0, &[&[]])).is_err());
        assert!(prepare(&["u", "y"], None, &signal(100.0, &[&[1.0]])).is_err());
    }
}
