//! The plan of an evaluation, resolved without loading a sample: models, runs, classes, and which model is compared
//! with which run on which channels.

use std::collections::HashSet;

use crate::domain::evaluation::{Classes, Omission, OmittedRun, Seen};
use crate::domain::fits::{RunFilter, RunSelection};
use crate::domain::{EvaluationRequest, FieldError, Model, ModelRef, Rig, Run, RunKind, Split};
use crate::engine::Signal;
use crate::engine::evaluation::ChannelGroup;
use crate::storage::Store;

use super::super::predicted::{needed, seen};
use super::super::problem::of_setting;
use super::super::selection;
use super::problem::EvaluationProblem;

/// Most models of an evaluation, the baseline among them.
const MAX_MODELS: usize = 32;

/// Most runs.
const MAX_RUNS: usize = 2000;

/// Most classes.
const MAX_CLASSES: usize = 64;

/// Most averages of channels: models times classes times channels. Each has two spectra in the report.
const MAX_AVERAGES: usize = 8192;

/// Most results of channels: models times runs times channels.
const MAX_RESULTS: usize = 200_000;

/// Most samples in memory at once, all channels together: those of a run that models need, and the inputs, outputs
/// and measurements of one prediction. They take 4 GiB.
const MAX_VALUES: u64 = 1 << 29;

/// Spans that may be searched for the worst, s.
const SPANS_S: std::ops::RangeInclusive<f64> = 0.01..=3600.0;

/// Runs of one class, by their places in rising order.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::jobs) struct Class {
    pub name: String,
    pub runs: Vec<usize>,
}

impl Class {
    /// Whether a run is in it.
    pub fn holds(&self, run: usize) -> bool {
        self.runs.binary_search(&run).is_ok()
    }
}

/// One comparison to make.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::jobs) struct Pairing {
    /// Place of the model.
    pub model: usize,
    /// Place of the run.
    pub run: usize,
    /// The model's outputs that the run holds, by their places among the outputs.
    pub outputs: Vec<usize>,
    /// What the run had been to the model.
    pub seen: Option<Seen>,
}

/// An evaluation with everything resolved.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::jobs) struct EvaluationPlan {
    /// The request with models and runs filled in, as the evaluation stores it.
    pub request: EvaluationRequest,
    /// Models, each once.
    pub models: Vec<Model>,
    /// Place of the baseline among them.
    pub baseline: Option<usize>,
    /// Runs, by id.
    pub runs: Vec<Run>,
    /// Classes with at least one run.
    pub classes: Vec<Class>,
    /// Comparisons, run by run.
    pub pairings: Vec<Pairing>,
    /// What is not compared.
    pub omitted: Vec<OmittedRun>,
    /// Compared channels and their units, in the rig's order.
    pub channels: Vec<(String, String)>,
    /// The groups of these channels.
    pub groups: Vec<ChannelGroup>,
    /// Groups of three channels with a Multi-Rain, by the channels' names.
    pub vectors: Vec<(String, [String; 3])>,
}

/// Resolves a request against the rig, its models and runs, without loading a sample.
///
/// # Errors
/// See [`EvaluationProblem`].
pub(in crate::jobs) async fn check(
    store: &Store,
    rig: &Rig,
    request: &EvaluationRequest,
) -> Result<EvaluationPlan, EvaluationProblem> {
    settings(request)?;
    let (models, baseline) = models(store, rig, request).await?;
    let runs = runs(&store.all_runs(&rig.id).await?, &request.runs)?;
    plan(rig, request, models, baseline, runs)
}

fn invalid<T>(errors: Vec<FieldError>, of: T) -> Result<T, EvaluationProblem> {
    if errors.is_empty() { Ok(of) } else { Err(EvaluationProblem::Invalid(errors)) }
}

/// Refuses numbers that make no sense on any rig.
fn settings(request: &EvaluationRequest) -> Result<(), EvaluationProblem> {
    let mut errors = Vec::new();
    if !SPANS_S.contains(&request.span_s) {
        let limit = format!("from {} to {} s", SPANS_S.start(), SPANS_S.end());
        errors.push(FieldError::new("/span_s", limit));
    }
    if let Err(error) = request.damage.check() {
        errors.push(of_setting(&error));
    }
    if request.models.is_empty() || request.models.len() > MAX_MODELS {
        errors.push(FieldError::new("/models", format!("1 to {MAX_MODELS} models")));
    }
    if let Classes::Named(names) = &request.classes {
        if names.is_empty() || names.len() > MAX_CLASSES {
            errors.push(FieldError::new("/classes", format!("1 to {MAX_CLASSES} classes")));
        }
        let mut seen = HashSet::new();
        for (i, name) in names.iter().enumerate().take(MAX_CLASSES).filter(|(_, name)| !seen.insert(*name)) {
            errors.push(FieldError::new(format!("/classes/{i}"), format!("each class once, {name:?} too")));
        }
    }
    invalid(errors, ())
}

/// The models, each once and with its place in the request, and the place of the baseline among them.
async fn models(
    store: &Store,
    rig: &Rig,
    request: &EvaluationRequest,
) -> Result<(Vec<(Model, String)>, Option<usize>), EvaluationProblem> {
    let mut models: Vec<(Model, String)> = Vec::new();
    let places = (0..request.models.len()).map(|i| format!("/models/{i}"));
    let asked = request.models.iter().copied().zip(places);
    let asked = asked.chain(request.baseline.map(|name| (name, "/baseline".to_owned())));
    let mut last = 0;
    for (name, pointer) in asked {
        let version = match name {
            ModelRef::Version(version) => version,
            ModelRef::Active => {
                let active = store.active_model(&rig.id).await?.ok_or(EvaluationProblem::RigGone)?;
                active.version.ok_or_else(|| EvaluationProblem::NoneActive(pointer.clone()))?
            }
        };
        last = match models.iter().position(|(model, _)| model.version == version) {
            Some(place) => place,
            None => {
                let Some(model) = store.model(&rig.id, version).await? else {
                    return Err(EvaluationProblem::NoModel { version, pointer });
                };
                models.push((model, pointer));
                models.len() - 1
            }
        };
    }
    Ok((models, request.baseline.map(|_| last)))
}

/// The runs, each measurement once.
fn runs(all: &[Run], asked: &RunSelection) -> Result<Vec<Run>, EvaluationProblem> {
    let runs = match asked {
        RunSelection::Ids(ids) => {
            if ids.is_empty() || ids.len() > MAX_RUNS {
                invalid(vec![FieldError::new("/runs", format!("1 to {MAX_RUNS} runs"))], ())?;
            }
            let runs = selection::by_id(all, ids, "/runs").map_err(EvaluationProblem::Invalid)?;
            let pointers = (0..runs.len()).map(|i| format!("/runs/{i}"));
            invalid(selection::repeated(&runs, pointers), ())?;
            runs
        }
        RunSelection::Match(filter) => {
            invalid(selection::unknown_words(filter, "/runs"), ())?;
            matching(all, filter)
        }
    };
    if runs.is_empty() {
        return Err(EvaluationProblem::NoRuns);
    }
    if runs.len() > MAX_RUNS {
        let limit = format!("a selection of at most {MAX_RUNS} runs; it has {}", runs.len());
        invalid(vec![FieldError::new("/runs", limit)], ())?;
    }
    Ok(runs)
}

fn matching(all: &[Run], filter: &RunFilter) -> Vec<Run> {
    selection::matching(all, filter, None, Split::Test)
}

/// Classes with their runs.
///
/// # Errors
/// A named class that no run is in.
fn classes(asked: &Classes, runs: &[Run]) -> Result<Vec<Class>, EvaluationProblem> {
    let of = |name: &str, holds: &dyn Fn(&Run) -> bool| Class {
        name: name.to_owned(),
        runs: (0..runs.len()).filter(|&run| holds(&runs[run])).collect(),
    };
    let names = match asked {
        Classes::Kind => {
            let kinds = RunKind::ALL.into_iter();
            let classes = kinds.map(|kind| of(kind.as_str(), &|run| run.kind == kind));
            return Ok(classes.filter(|class| !class.runs.is_empty()).collect());
        }
        Classes::Named(names) => names,
    };
    let classes: Vec<Class> = names
        .iter()
        .map(|name| of(name, &|run| run.kind.as_str() == name || run.tags.contains(name)))
        .collect();
    let empty = classes.iter().enumerate().filter(|(_, class)| class.runs.is_empty());
    let errors: Vec<FieldError> = empty
        .map(|(i, class)| {
            let limit = format!("a kind or tag of the runs; none of them has {:?}", class.name);
            FieldError::new(format!("/classes/{i}"), limit)
        })
        .collect();
    if errors.is_empty() { Ok(classes) } else { Err(EvaluationProblem::EmptyClass(errors)) }
}

fn plan(
    rig: &Rig,
    request: &EvaluationRequest,
    models: Vec<(Model, String)>,
    baseline: Option<usize>,
    mut runs: Vec<Run>,
) -> Result<EvaluationPlan, EvaluationProblem> {
    runs.sort_by_key(|run| run.id);
    let (models, pointers): (Vec<Model>, Vec<String>) = models.into_iter().unzip();
    let classes = classes(&request.classes, &runs)?;
    let (mut pairings, mut omitted) = (Vec::new(), Vec::new());
    for (r, run) in runs.iter().enumerate() {
        // Runs of no class have no place in the table.
        if !classes.iter().any(|class| class.holds(r)) {
            continue;
        }
        for (m, model) in models.iter().enumerate() {
            match pairing(model, run) {
                Ok((outputs, seen)) => pairings.push(Pairing { model: m, run: r, outputs, seen }),
                Err((reason, channels)) => {
                    omitted.push(OmittedRun { model: model.version, run: run.id, reason, channels });
                }
            }
        }
    }
    in_common(&models, &pointers, &pairings, &omitted)?;
    let compared: HashSet<&String> =
        pairings.iter().flat_map(|p| p.outputs.iter().map(|&o| &models[p.model].outputs[o])).collect();
    let channels: Vec<(String, String)> = rig
        .channels
        .iter()
        .filter(|channel| compared.contains(&channel.name))
        .map(|channel| (channel.name.clone(), channel.unit.clone()))
        .collect();
    let groups = groups(rig, &channels);
    let vectors = rig.groups().into_iter().filter_map(|(name, members)| {
        let members: Vec<String> = members.into_iter().map(str::to_owned).collect();
        Some((name.to_owned(), <[String; 3]>::try_from(members).ok()?))
    });
    let vectors = vectors.collect();
    let version = |model: &Model| ModelRef::Version(model.version);
    let request = EvaluationRequest {
        models: models.iter().map(version).collect(),
        runs: RunSelection::Ids(runs.iter().map(|run| run.id).collect()),
        baseline: baseline.map(|place| version(&models[place])),
        ..request.clone()
    };
    let plan = EvaluationPlan {
        request,
        models,
        baseline,
        runs,
        classes,
        pairings,
        omitted,
        channels,
        groups,
        vectors,
    };
    plan.bounded()?;
    Ok(plan)
}

/// Why there is no comparison, and the channels that are missing.
pub(in crate::jobs) type Missing = (Omission, Vec<String>);

/// The outputs on which a model is compared with a run, and what the run had been to it.
fn pairing(model: &Model, run: &Run) -> Result<(Vec<usize>, Option<Seen>), Missing> {
    Ok((comparable(model, run)?, seen(model, run)))
}

/// The outputs, by their places, on which a model can be compared with a run.
pub(in crate::jobs) fn comparable(model: &Model, run: &Run) -> Result<Vec<usize>, Missing> {
    if !Signal::same_rate(run.sample_rate_hz, model.sample_rate_hz) {
        return Err((Omission::SampleRate, Vec::new()));
    }
    let held = |name: &String| run.channels.contains(name);
    let missing: Vec<String> = model.inputs.iter().filter(|name| !held(name)).cloned().collect();
    let outputs: Vec<usize> = (0..model.outputs.len()).filter(|&o| held(&model.outputs[o])).collect();
    if !missing.is_empty() || outputs.is_empty() {
        let outputs = if outputs.is_empty() { &model.outputs[..] } else { &[] };
        return Err((
            Omission::MissingChannels,
            missing.into_iter().chain(outputs.iter().cloned()).collect(),
        ));
    }
    Ok(outputs)
}

/// Refuses models that no run can be compared with.
fn in_common(
    models: &[Model],
    pointers: &[String],
    pairings: &[Pairing],
    omitted: &[OmittedRun],
) -> Result<(), EvaluationProblem> {
    let mut errors = Vec::new();
    for (m, model) in models.iter().enumerate() {
        if pairings.iter().any(|pairing| pairing.model == m) {
            continue;
        }
        let of_model: Vec<&OmittedRun> = omitted.iter().filter(|o| o.model == model.version).collect();
        let limit = match of_model.first() {
            Some(first) if of_model.iter().all(|o| o.reason == Omission::MissingChannels) => format!(
                "a run that holds the inputs of model {} and one of its outputs at least; run {} lacks {}",
                model.version,
                first.run,
                first.channels.join(", ")
            ),
            _ => format!("runs of the sample rate of model {}", model.version),
        };
        errors.push(FieldError::new(&pointers[m], limit));
    }
    if errors.is_empty() { Ok(()) } else { Err(EvaluationProblem::NoCommonChannels(errors)) }
}

/// Compared channels by the rig's groups; those without one by their quantity.
fn groups(rig: &Rig, compared: &[(String, String)]) -> Vec<ChannelGroup> {
    let mut groups: Vec<ChannelGroup> = Vec::new();
    for (name, _) in compared {
        let Some(channel) = rig.channel(name) else { continue };
        let quantity = channel.quantity.as_str();
        let group = match &channel.group {
            Some(group) => group.clone(),
            None if rig.groups().iter().any(|(name, _)| *name == quantity) => format!("{quantity}, no group"),
            None => quantity.to_owned(),
        };
        match groups.iter_mut().find(|known| known.name == group) {
            Some(known) => known.channels.push(name.clone()),
            None => groups.push(ChannelGroup { name: group, channels: vec![name.clone()] }),
        }
    }
    groups
}

impl EvaluationPlan {
    /// The comparisons with a run.
    pub fn of_run(&self, run: usize) -> Vec<Pairing> {
        self.pairings.iter().filter(|pairing| pairing.run == run).cloned().collect()
    }

    /// The channels of a run that its comparisons need, each once.
    pub fn needed(&self, run: usize) -> Vec<String> {
        let mut all: Vec<String> = Vec::new();
        for pairing in self.of_run(run) {
            let of_pairing = needed(&self.models[pairing.model], &pairing.outputs);
            let new: Vec<String> = of_pairing.into_iter().filter(|name| !all.contains(name)).collect();
            all.extend(new);
        }
        all
    }

    /// Refuses an evaluation whose report, or one of whose runs, is too large.
    fn bounded(&self) -> Result<(), EvaluationProblem> {
        let mut errors = Vec::new();
        let per_model = self.models.len() * self.channels.len();
        for (count, most, pointer, what) in [
            (per_model * self.classes.len(), MAX_AVERAGES, "/classes", "classes"),
            (per_model * self.runs.len(), MAX_RESULTS, "/runs", "runs"),
        ] {
            if count > most {
                let limit = format!("at most {most} models times {what} times channels; these are {count}");
                errors.push(FieldError::new(pointer, limit));
            }
        }
        for (r, run) in self.runs.iter().enumerate() {
            let of_run = self.pairings.iter().filter(|pairing| pairing.run == r);
            let in_use = of_run.map(|pairing| {
                let model = &self.models[pairing.model];
                2 * model.inputs.len() + model.outputs.len() + 2 * pairing.outputs.len()
            });
            let channels = in_use.max().unwrap_or(0) + self.needed(r).len();
            if run.samples.saturating_mul(channels as u64) > MAX_VALUES {
                let limit = format!(
                    "runs of at most {} samples for {} channels; run {} has {}",
                    MAX_VALUES / channels as u64,
                    self.needed(r).len(),
                    run.id,
                    run.samples
                );
                errors.push(FieldError::new("/runs", limit));
            }
        }
        invalid(errors, ())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::jobs::fit_plan::testing::run;

    #[test]
    fn a_class_holds_the_runs_of_its_kind_or_tag_and_an_empty_one_is_pointed_at() {
        let mut runs = [
            run(1, RunKind::Noise, Split::Test, 100),
            run(2, RunKind::Service, Split::Test, 100),
            run(3, RunKind::Service, Split::Test, 100),
        ];
        runs[1].tags = vec!["sl".into(), "sl-minus".into()];
        let of = |classes: Classes| {
            let found = super::classes(&classes, &runs);
            found.map(|found| found.into_iter().map(|class| (class.name, class.runs)).collect::<Vec<_>>())
        };
        let class = |name: &str, runs: &[usize]| (name.to_owned(), runs.to_vec());
        assert_eq!(of(Classes::Kind).unwrap(), [class("noise", &[0]), class("service", &[1, 2])]);
        let named = |names: &[&str]| Classes::Named(names.iter().map(|name| (*name).to_owned()).collect());
        assert_eq!(of(named(&["sl", "service"])).unwrap(), [class("sl", &[1]), class("service", &[1, 2])]);
        let Err(EvaluationProblem::EmptyClass(errors)) = of(named(&["sl", "n2"])) else { panic!("refused") };
        assert_eq!(errors[0].pointer, "/classes/1");
    }
}
