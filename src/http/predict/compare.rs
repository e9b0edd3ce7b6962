//! A prediction of a stored run and its comparison with another, for pages: the same steps as for a request.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use super::answer::{
    check_length, class, damages, damages_within, distances, filtered, groups, no_band, refusal,
};
use super::conversion::check_rate;
use super::inputs::{self, Drive, Found, Target};
use super::stages::Stages;
use super::{compute, find, needed};
use crate::domain::{ModelRef, Rig, RigId, RunId};
use crate::engine::fatigue::{DamageReport, DamageSettings, damage_by_direction};
use crate::engine::metrics::ChannelErrors;
use crate::engine::model::{Predictor, Trust};
use crate::engine::{Progress, Signal};
use crate::http::deadline::Deadline;
use crate::http::paths::no_run;
use crate::http::problem::{Answer, Problem};
use crate::http::{Shared, admission, errors};
use crate::models::LoadedModel;

/// Memory of the comparisons that are kept for the figures of a page, bytes.
const KEPT_BYTES: usize = 64 << 20;

/// A run that was predicted, with what it is compared with.
#[derive(Debug)]
pub struct Comparison {
    /// The rig.
    pub rig: Rig,
    /// The model.
    pub model: Arc<LoadedModel>,
    /// The model's inputs.
    pub drive: Signal,
    /// Its outputs.
    pub response: Signal,
    /// What they are compared with, behind the model's filter.
    pub target: Option<Target>,
    /// Damage, with ratios where there is a target.
    pub damage: DamageReport,
    /// Errors by channel.
    pub errors: BTreeMap<String, ChannelErrors>,
    /// Where the drive leaves what the model was fitted on.
    pub trust: Trust,
    /// The band about the response, or why there is none.
    pub band: Result<ResponseBand, &'static str>,
    /// Damage of each group by direction, once somebody has looked at it.
    by_direction: OnceLock<Vec<GroupDirections>>,
}

/// The band about a response.
#[derive(Debug)]
pub struct ResponseBand {
    /// Half width, `[output, sample]`.
    pub half_width: Signal,
    /// Damage of the least and of the largest swings within it, by output.
    pub damage: Vec<[f64; 2]>,
}

/// Damage of a group by direction.
#[derive(Debug, Clone)]
pub struct GroupDirections {
    /// Name of the group.
    pub name: String,
    /// Its outputs x, y and z.
    pub outputs: [usize; 3],
    /// Damage of the prediction in each direction.
    pub predicted: Vec<f64>,
    /// The same of the target, if it has all three channels.
    pub target: Option<Vec<f64>>,
}

/// Weights, drive and target.
type Key = (String, String, Option<String>);

/// The comparisons that were looked at last.
#[derive(Debug, Default)]
pub struct Comparisons(Mutex<Vec<(Key, Arc<Comparison>)>>);

impl Comparisons {
    fn get(&self, key: &Key) -> Option<Arc<Comparison>> {
        let kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        kept.iter().find(|(found, _)| found == key).map(|(_, found)| Arc::clone(found))
    }

    fn put(&self, key: Key, comparison: &Arc<Comparison>) {
        let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        kept.retain(|(found, _)| *found != key);
        kept.push((key, Arc::clone(comparison)));
        while kept.iter().map(|(_, found)| found.bytes()).sum::<usize>() > KEPT_BYTES {
            kept.remove(0);
        }
    }
}

impl Comparison {
    fn bytes(&self) -> usize {
        let target = self.target.as_ref().map_or(0, |target| target.signal.n_channels());
        let band = self.band.as_ref().map_or(0, |band| band.half_width.n_channels());
        let channels = self.drive.n_channels() + self.response.n_channels() + target + band;
        channels * self.response.n_samples() * size_of::<f64>()
    }
}

/// Predicts a run's drives with a model and compares the result with the responses of a run.
///
/// # Errors
/// As `POST /v1/rigs/{rig}/predict`.
pub async fn compare(
    http: &Shared,
    id: &RigId,
    model: ModelRef,
    drive: RunId,
    target: Option<RunId>,
) -> Answer<Arc<Comparison>> {
    let (rig, model) = find(http, id, model).await?;
    let run = async |id_of_run: RunId| {
        http.store.run(id, id_of_run).await?.ok_or_else(|| no_run(&id_of_run.to_string()))
    };
    let drive = run(drive).await?;
    let target = match target {
        Some(target) => Some(run(target).await?),
        None => None,
    };
    let key = (model.sha256.clone(), drive.object.clone(), target.as_ref().map(|run| run.object.clone()));
    if let Some(kept) = http.comparisons.get(&key).filter(|kept| kept.rig == rig) {
        return Ok(kept);
    }
    let samples = usize::try_from(drive.samples).unwrap_or(usize::MAX);
    // The drive once more, which stays for the figures, and the half width of the band beside a linear response.
    let more = model.model().inputs.len() + 2 * model.model().outputs.len();
    let bytes = needed(&model, samples, target.is_some())
        .saturating_add(more.saturating_mul(samples).saturating_mul(size_of::<f64>()));
    let _memory = http.predictions.take(admission::client_id(), bytes).await?;
    let Drive::Signal(drive) = inputs::drive(http, Found::Run(Box::new(drive)), &model).await? else {
        return Err(Problem::internal("a run is no NPY body"));
    };
    let target = match target {
        Some(run) => Some(inputs::target(http, Found::Run(Box::new(run)), &model).await?),
        None => None,
    };
    let class = class(&model.predictor, drive.n_samples(), 1);
    let of = Arc::clone(&model);
    let work = move |deadline: &Deadline, stages: &mut Stages| {
        let made = predict(rig, of, drive, target, deadline)?;
        stages.end("simulate");
        let samples = (made.response.n_samples() * made.response.n_channels()) as u64;
        Ok((Arc::new(made), samples))
    };
    let made = compute(http, &model, class, Stages::begin(), work).await?;
    http.comparisons.put(key, &made);
    Ok(made)
}

fn predict(
    rig: Rig,
    loaded: Arc<LoadedModel>,
    drive: Signal,
    target: Option<Target>,
    deadline: &Deadline,
) -> Answer<Comparison> {
    let (model, predictor): (_, &Predictor) = (loaded.model(), &loaded.predictor);
    check_rate(model.sample_rate_hz, drive.sample_rate_hz(), "drive")?;
    if let Some(target) = &target {
        check_rate(model.sample_rate_hz, target.signal.sample_rate_hz(), "target")?;
        check_length(drive.n_samples(), target.signal.n_samples())?;
    }
    let target = target.map(|target| filtered(target, &model.preprocess)).transpose()?;
    let begun = predictor.begin(drive.clone());
    let mut prediction = begun.map_err(|error| errors::engine(&error, &model.inputs, "drive"))?;
    let trust = predictor.trust(&prediction);
    let watch = |progress: Progress<'_>| deadline.watch(progress);
    let response = predictor
        .rest(&mut prediction, &watch)
        .map_err(|error| refusal(&error, &model.outputs, "/drive/channels"))?;
    let half_width = predictor
        .half_width(&prediction, &response)
        .map_err(|error| refusal(&error, &model.outputs, "/drive/channels"))?;
    let settings = DamageSettings::default();
    let band = match half_width {
        Some(half_width) => {
            let damage = damages_within(predictor, &response, &half_width, &settings)?;
            Ok(ResponseBand { half_width, damage })
        }
        None => Err(no_band(model)),
    };
    deadline.check()?;
    let damage = damages(&rig, &model.outputs, &response, target.as_ref(), &settings)?;
    deadline.check()?;
    let errors = match &target {
        Some(target) => distances(&model.outputs, &response, target, model.preprocess)?.channels,
        None => BTreeMap::new(),
    };
    let by_direction = OnceLock::new();
    Ok(Comparison { rig, model: loaded, drive, response, target, damage, errors, trust, band, by_direction })
}

impl Comparison {
    /// The target's samples of an output, if it has some.
    pub fn target_of(&self, output: usize) -> Option<&[f64]> {
        let name = &self.model.model().outputs[output];
        let target = self.target.as_ref()?;
        let place = target.names.iter().position(|found| found == name)?;
        Some(target.signal.channel(place))
    }

    /// Damage of each group by direction, in the order of the groups of the damage report; counted at the first call.
    ///
    /// # Errors
    /// Damage beyond its range.
    pub fn directions(&self) -> Answer<&[GroupDirections]> {
        if let Some(found) = self.by_direction.get() {
            return Ok(found);
        }
        let outputs = &self.model.model().outputs;
        let of = |group: [&[f64]; 3]| {
            damage_by_direction(group, &self.damage.settings)
                .map_err(|error| errors::engine(&error, outputs, ""))
        };
        let mut all = Vec::new();
        for group in groups(&self.rig, outputs).0 {
            let target = match group.channels.map(|output| self.target_of(output)) {
                [Some(x), Some(y), Some(z)] => Some(of([x, y, z])?),
                _ => None,
            };
            let predicted = of(group.channels.map(|output| self.response.channel(output)))?;
            all.push(GroupDirections { name: group.name.into(), outputs: group.channels, predicted, target });
        }
        Ok(self.by_direction.get_or_init(|| all))
    }
}
