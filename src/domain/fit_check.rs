//! Checks of a fit request that need only the rig.

use std::collections::HashSet;

use crate::engine::EngineError;
use crate::engine::frf::FrfSettings;
use crate::engine::model::{ModelKind, Preset, Task};

use super::fits::{FitRequest, FrfOptions, RunFilter, RunSelection};
use super::problem::FieldError;
use super::rig::{Channel, Role};
use crate::engine::{RunKind, Split};

/// Most runs that a selection may list by id.
const MAX_IDS: usize = 10_000;

/// Channels of a fit, none left open.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FitChannels {
    /// Input channels, in order.
    pub inputs: Vec<String>,
    /// Output channels, in order.
    pub outputs: Vec<String>,
}

/// What a model from `inputs` to `outputs` is for: forward prediction where all inputs are drives and
/// all outputs responses of a rig with these channels, else virtual sensing.
pub fn task(channels: &[Channel], inputs: &[String], outputs: &[String]) -> Task {
    let all = |names: &[String], role| {
        names.iter().all(|name| channels.iter().any(|channel| channel.name == *name && channel.role == role))
    };
    match all(inputs, Role::Drive) && all(outputs, Role::Response) {
        true => Task::Forward,
        false => Task::VirtualSensing,
    }
}

impl FrfOptions {
    /// Settings of the engine. Those that are left open come from the preset, or the engine chooses them.
    pub fn settings(&self, preset: Preset) -> FrfSettings {
        let default = preset.frf();
        FrfSettings {
            segment_len: self.segment_len,
            overlap: self.overlap.unwrap_or(default.overlap),
            estimator: self.estimator.unwrap_or(default.estimator),
            ridge: self.ridge,
        }
    }
}

impl FitRequest {
    /// Resolves the channels of the fit, and checks its settings and its selections of runs.
    ///
    /// # Errors
    /// Channels that the rig does not have, that come twice, or that are input and output at
    /// once; settings outside their limits; kinds and splits that do not exist; the test split,
    /// which never enters a fit.
    pub fn check(&self, channels: &[Channel], sample_rate_hz: f64) -> Result<FitChannels, Vec<FieldError>> {
        let mut errors = Vec::new();
        setting(&mut errors, self.preprocess.check(sample_rate_hz));
        setting(&mut errors, self.frf.settings(self.preset).check());
        let inputs = resolve(&mut errors, channels, "/inputs", self.inputs.as_deref(), Role::Drive);
        let outputs = resolve(&mut errors, channels, "/outputs", self.outputs.as_deref(), Role::Response);
        for (i, output) in outputs.iter().enumerate().filter(|(_, output)| inputs.contains(output)) {
            let error = FieldError::new(format!("/outputs/{i}"), "a channel that is no input of the fit");
            errors.push(error.on_channel(output));
        }
        let task = task(channels, &inputs, &outputs);
        setting(&mut errors, self.lstm.check(self.preset, self.kind, task));
        if self.start.is_some() && self.kind == ModelKind::Frf {
            errors
                .push(FieldError::new("/start", "a kind with a network: an FRF has no weights to start at"));
        }
        self.check_core(&mut errors);
        check_runs(&mut errors, "/runs", self.runs.as_ref());
        check_runs(&mut errors, "/validation_runs", self.validation_runs.as_ref());
        check_runs(&mut errors, "/frf/runs", self.frf.runs.as_ref());
        if errors.is_empty() { Ok(FitChannels { inputs, outputs }) } else { Err(errors) }
    }

    /// A core belongs to a hybrid, which then estimates no FRF.
    fn check_core(&self, errors: &mut Vec<FieldError>) {
        if self.core.is_none() {
            return;
        }
        if !matches!(self.kind, ModelKind::Hybrid1 | ModelKind::Hybrid2) {
            let limit = "left out, or kind hybrid1 or hybrid2: a core takes the place of a hybrid's FRF";
            errors.push(FieldError::new("/core", limit));
        }
        if self.frf != FrfOptions::default() {
            errors.push(FieldError::new("/frf", "left out: with a core no FRF is estimated"));
        }
    }
}

fn setting(errors: &mut Vec<FieldError>, checked: Result<(), EngineError>) {
    match checked {
        Ok(()) => {}
        Err(EngineError::Setting { setting, limit, .. }) => {
            errors.push(FieldError::new(format!("/{}", setting.replace('.', "/")), limit));
        }
        Err(other) => errors.push(FieldError::new("", other.to_string())),
    }
}

fn resolve(
    errors: &mut Vec<FieldError>,
    channels: &[Channel],
    pointer: &str,
    asked: Option<&[String]>,
    role: Role,
) -> Vec<String> {
    let Some(asked) = asked else {
        let all: Vec<String> = channels.iter().filter(|c| c.role == role).map(|c| c.name.clone()).collect();
        if all.is_empty() {
            errors.push(FieldError::new(pointer, "name the channels: the rig has none of this role"));
        }
        return all;
    };
    if asked.is_empty() {
        errors.push(FieldError::new(pointer, "at least one channel"));
    }
    let mut seen = HashSet::new();
    for (i, name) in asked.iter().enumerate() {
        let at = format!("{pointer}/{i}");
        if !channels.iter().any(|channel| channel.name == *name) {
            errors.push(FieldError::new(at, "a channel of the rig").on_channel(name));
        } else if !seen.insert(name) {
            errors.push(FieldError::new(at, "each channel once").on_channel(name));
        }
    }
    asked.to_vec()
}

fn check_runs(errors: &mut Vec<FieldError>, pointer: &str, selection: Option<&RunSelection>) {
    match selection {
        Some(RunSelection::Ids(ids)) if ids.is_empty() || ids.len() > MAX_IDS => {
            errors.push(FieldError::new(pointer, format!("1 to {MAX_IDS} runs")));
        }
        Some(RunSelection::Ids(_)) | None => {}
        Some(RunSelection::Match(RunFilter { kinds, tags: _, split })) => {
            for (i, kind) in kinds.iter().flatten().enumerate() {
                if !RunKind::ALL.iter().any(|known| known.as_str() == kind) {
                    let limit = "noise, service, sine, sweep or other";
                    errors.push(FieldError::new(format!("{pointer}/kinds/{i}"), limit));
                }
            }
            if let Some(split) = split
                && split != Split::Training.as_str()
                && split != Split::Validation.as_str()
            {
                let limit = "training or validation: the test split never enters a fit";
                errors.push(FieldError::new(format!("{pointer}/split"), limit));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::frf::Estimator;

    fn channels() -> Vec<Channel> {
        let channel = |name: &str, role| Channel {
            name: name.into(),
            unit: String::new(),
            role,
            quantity: Default::default(),
            axis: None,
            group: None,
            aliases: Vec::new(),
        };
        vec![channel("u", Role::Drive), channel("y", Role::Response), channel("z", Role::Response)]
    }

    fn request(json: &str) -> FitRequest {
        serde_json::from_str(json).unwrap()
    }

    #[test]
    fn channels_left_open_are_all_drives_and_all_responses() {
        let found = request(r#"{"kind": "frf"}"#).check(&channels(), 100.0).unwrap();
        assert_eq!(found, FitChannels { inputs: vec!["u".into()], outputs: vec!["y".into(), "z".into()] });
    }

    #[test]
    fn a_model_from_drives_to_responses_is_for_forward_prediction_and_any_other_for_virtual_sensing() {
        let names = |names: &[&str]| names.iter().map(|&name| name.to_owned()).collect::<Vec<_>>();
        let of = |inputs: &[&str], outputs: &[&str]| task(&channels(), &names(inputs), &names(outputs));
        assert_eq!(of(&["u"], &["y", "z"]), Task::Forward);
        assert_eq!(of(&["u"], &["z"]), Task::Forward);
        assert_eq!(of(&["y"], &["z"]), Task::VirtualSensing);
        assert_eq!(of(&["u", "y"], &["z"]), Task::VirtualSensing);
        assert_eq!(of(&["y"], &["u"]), Task::VirtualSensing);
    }

    #[test]
    fn the_frf_settings_that_a_request_leaves_open_are_those_of_its_preset() {
        let of = |json: &str| {
            let request = request(json);
            request.frf.settings(request.preset)
        };
        assert_eq!(of(r#"{"kind": "frf"}"#).estimator, Estimator::H1);
        assert_eq!(of(r#"{"kind": "frf", "preset": "paper"}"#).estimator, Estimator::Auto);
        let asked = r#"{"kind": "frf", "preset": "paper", "frf": {"estimator": "ratio", "overlap": 0.5}}"#;
        assert_eq!((of(asked).estimator, of(asked).overlap), (Estimator::Ratio, 0.5));
    }

    #[test]
    fn unknown_repeated_and_shared_channels_are_named() {
        let errors = request(r#"{"kind": "frf", "inputs": ["u", "q", "u", "y"], "outputs": ["y"]}"#)
            .check(&channels(), 100.0)
            .unwrap_err();
        let named: Vec<_> =
            errors.iter().map(|e| (e.pointer.as_str(), e.channel.as_deref().unwrap())).collect();
        assert_eq!(named, [("/inputs/1", "q"), ("/inputs/2", "u"), ("/outputs/0", "y")]);
    }

    #[test]
    fn the_test_split_and_unknown_kinds_are_refused_wherever_runs_are_named() {
        let errors = request(
            r#"{"kind": "frf", "runs": {"split": "test"}, "validation_runs": {"kinds": ["nose"]},
                "frf": {"runs": []}}"#,
        )
        .check(&channels(), 100.0)
        .unwrap_err();
        let pointers: Vec<_> = errors.iter().map(|e| e.pointer.as_str()).collect();
        assert_eq!(pointers, ["/runs/split", "/validation_runs/kinds/0", "/frf/runs"]);
    }

    #[test]
    fn settings_outside_their_limits_are_named_by_their_place_in_the_request() {
        let errors = request(
            r#"{"kind": "lstm", "preprocess": {"low_pass_hz": 50.0}, "frf": {"overlap": 1.0},
                "lstm": {"window_len": 256, "hop": 200}}"#,
        )
        .check(&channels(), 100.0)
        .unwrap_err();
        let pointers: Vec<_> = errors.iter().map(|e| e.pointer.as_str()).collect();
        assert_eq!(pointers, ["/preprocess/low_pass_hz", "/frf/overlap", "/lstm/hop"]);
    }
}
