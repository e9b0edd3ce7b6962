//! The tensors of a model: which channels stand together, and under which name.
//!
//! Channels of one group of the rig are one tensor, named by the group. Channels without a group are
//! together in `drive` or `response`, by their role. Where a name is taken, by a tensor before it or by an
//! input, `_2` is added, or the first higher number that is free.

use crate::domain::{Rig, Role};
use crate::engine::model::RigModel;

/// A tensor of shape `[samples, channels]`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Tensor {
    /// Name, unique among all tensors of the model.
    pub name: String,
    /// Places of its columns among the model's inputs or outputs, in their order.
    pub channels: Vec<usize>,
}

/// All tensors of a model, each in the order of its first channel.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Layout {
    /// They hold every input of the model once.
    pub inputs: Vec<Tensor>,
    /// They hold every output of the model once.
    pub outputs: Vec<Tensor>,
}

impl Layout {
    /// The tensors of a model of this rig.
    pub fn of(rig: &Rig, model: &RigModel) -> Self {
        let mut taken = Vec::new();
        let inputs = tensors(rig, &model.inputs, Role::Drive, &mut taken);
        let outputs = tensors(rig, &model.outputs, Role::Response, &mut taken);
        Self { inputs, outputs }
    }
}

/// The tensors of some channels. A channel that the rig does not have any more has the role `otherwise`.
fn tensors(rig: &Rig, names: &[String], otherwise: Role, taken: &mut Vec<String>) -> Vec<Tensor> {
    let mut found: Vec<(Key<'_>, Tensor)> = Vec::new();
    for (place, name) in names.iter().enumerate() {
        let channel = rig.channel(name);
        let key = match channel.and_then(|channel| channel.group.as_deref()) {
            Some(group) => Key::Group(group),
            None => Key::Role(channel.map_or(otherwise, |channel| channel.role)),
        };
        if let Some((_, tensor)) = found.iter_mut().find(|(of, _)| *of == key) {
            tensor.channels.push(place);
            continue;
        }
        let name = free(key.name(), taken);
        taken.push(name.clone());
        found.push((key, Tensor { name, channels: vec![place] }));
    }
    found.into_iter().map(|(_, tensor)| tensor).collect()
}

/// What channels of one tensor share.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Key<'a> {
    Group(&'a str),
    Role(Role),
}

impl<'a> Key<'a> {
    fn name(self) -> &'a str {
        match self {
            Self::Group(name) => name,
            Self::Role(Role::Drive) => "drive",
            Self::Role(Role::Response) => "response",
        }
    }
}

/// The name, or the name with the first number that makes it free.
fn free(name: &str, taken: &[String]) -> String {
    let numbered = (2..).map(|number| format!("{name}_{number}"));
    let is_free = |name: &String| !taken.contains(name);
    std::iter::once(name.to_owned()).chain(numbered).find(is_free).expect("numbers do not end")
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    /// A rig of channels of these names, roles and groups.
    fn rig(channels: &[(&str, Role, Option<&str>)]) -> Rig {
        let channels = channels
            .iter()
            .map(|(name, role, group)| json!({"name": name, "unit": "kN", "role": role, "group": group}));
        Rig {
            id: "bench".parse().expect("an id"),
            name: "Bench".into(),
            sample_rate_hz: 100.0,
            channels: serde_json::from_value(channels.collect()).expect("channels"),
            fit_policy: None,
            created_at: jiff::Timestamp::UNIX_EPOCH,
            updated_at: jiff::Timestamp::UNIX_EPOCH,
            revision: 1,
        }
    }

    /// Names and channels of the tensors of these channels.
    fn found(rig: &Rig, names: &[&str], taken: &mut Vec<String>) -> Vec<(String, Vec<usize>)> {
        let names: Vec<String> = names.iter().map(|name| (*name).to_owned()).collect();
        let tensors = tensors(rig, &names, Role::Drive, taken);
        tensors.into_iter().map(|tensor| (tensor.name, tensor.channels)).collect()
    }

    #[test]
    fn a_group_is_a_tensor_wherever_its_channels_stand_and_the_rest_is_one_by_its_role() {
        let rig = rig(&[
            ("a", Role::Drive, None),
            ("x", Role::Drive, Some("hub")),
            ("b", Role::Drive, None),
            ("y", Role::Drive, Some("hub")),
            ("z", Role::Response, None),
        ]);
        let expected = [("drive", vec![0, 2]), ("hub", vec![1, 3]), ("response", vec![4])];
        let expected = expected.map(|(name, channels)| (name.to_owned(), channels));
        assert_eq!(found(&rig, &["a", "x", "b", "y", "z"], &mut Vec::new()), expected);
    }

    #[test]
    fn every_name_comes_once_among_inputs_and_outputs() {
        let rig = rig(&[
            ("a", Role::Drive, Some("axis")),
            ("b", Role::Drive, Some("response")),
            ("c", Role::Drive, Some("axis_2")),
            ("d", Role::Response, Some("axis")),
            ("e", Role::Response, None),
        ]);
        let mut taken = Vec::new();
        let mut names = |channels: &[&str]| -> Vec<String> {
            found(&rig, channels, &mut taken).into_iter().map(|(name, _)| name).collect()
        };
        assert_eq!(names(&["a", "b", "c"]), ["axis", "response", "axis_2"]);
        assert_eq!(names(&["d", "e"]), ["axis_3", "response_2"]);
    }
}
