//! Predictions: a drive in, the response out, with damage, errors and trust.
//!
//! [`request`] reads the request, [`memory`] waits for the memory that it needs, [`inputs`] makes signals for
//! the model, [`answer`] computes and writes the answer.

mod answer;
mod compare;
mod inputs;
pub(super) mod memory;
mod request;
mod stages;

use std::sync::Arc;
use std::time::Instant;

use axum::body::Body;
use axum::extract::State;
use axum::http::header::{CONTENT_LENGTH, CONTENT_TYPE};
use axum::http::{HeaderMap, HeaderName, HeaderValue};
use axum::response::{IntoResponse, Response};

use super::body::signals::header_names;
use super::deadline::Deadline;
use super::negotiate::{self, CSV, MAT, NPY, RPC3};
use super::params::Params;
use super::paths::{OfRig, no_model, no_rig};
use super::problem::{Answer, Problem};
use super::{Shared, admission, body, codes, json, measurement, upload};
use crate::compute::Class;
use crate::domain::{ModelRef, Rig, RigId};
use crate::engine::Samples;
use crate::formats::Format;
use crate::models::LoadedModel;
use crate::telemetry::names;
use answer::{Computed, PredictionTask};
use inputs::Drive;
use request::{MeasurementQuery, NpyQuery, PredictRequest};

pub(super) use answer::{check_rate, class};
pub use compare::{Comparison, Comparisons, compare};
pub use memory::PredictionMemory;
pub(super) use stages::Stages;

/// `POST /v1/rigs/{rig}/predict`
pub async fn predict(
    State(http): State<Shared>,
    OfRig(id): OfRig,
    params: Params,
    headers: HeaderMap,
    request: Body,
) -> Answer {
    let found = body::media_type(&headers);
    let mut stages = Stages::begin();
    match found.as_deref() {
        Some(json::MEDIA_TYPE) => {
            params.finish()?;
            let media_type = negotiate::choose(&headers, &forms(json::MEDIA_TYPE))?;
            let request: PredictRequest = json::take_signals(&headers, request, &http).await?;
            stages.end("receive");
            let (rig, model) = find(&http, &id, request.model).await?;
            let include = request.includes()?;
            let drive = inputs::find(&http, &id, request.drive, "/drive").await?;
            let target = match request.target {
                Some(source) => Some(inputs::find(&http, &id, source, "/target").await?),
                None => None,
            };
            let bytes = needed(&model, drive.n_samples(), target.is_some());
            let memory = http.predictions.take(admission::client_id(), bytes).await?;
            let drive = inputs::drive(&http, drive, &model).await?;
            let target = match target {
                Some(found) => Some(inputs::target(&http, found, &model).await?),
                None => None,
            };
            stages.end("load");
            let task = PredictionTask {
                rig,
                model,
                drive,
                target,
                include,
                damage: request.damage.unwrap_or_default(),
                media_type,
                memory,
            };
            predicted(&http, task, stages).await
        }
        Some(NPY) => {
            let query = NpyQuery::take(params)?;
            let media_type = negotiate::choose(&headers, &forms(NPY))?;
            let bytes = body::Limited::new(&headers, request, http.limits.drive_bytes, http.limits.pace)?
                .collect()
                .await?;
            let (rig, model) = find(&http, &id, query.model).await?;
            let drive = Drive::Npy { bytes, sample_rate_hz: query.sample_rate_hz };
            let samples = drive.n_samples(model.model().inputs.len());
            let memory =
                http.predictions.take(admission::client_id(), needed(&model, samples, false)).await?;
            predicted(&http, PredictionTask::of_file(rig, model, drive, media_type, memory), stages).await
        }
        other => {
            // General types are not looked into here: they would hide an NPY file without its rate.
            let Some(format) = measurement::format(other)? else {
                return Err(body::unsupported(other, &measurement::OFFERED));
            };
            let query = MeasurementQuery::take(params)?;
            let own = match format {
                Format::Rpc3 => RPC3,
                Format::Mat => MAT,
                _ => CSV,
            };
            let media_type = negotiate::choose(&headers, &forms(own))?;
            let (rig, model) = find(&http, &id, query.model).await?;
            let upload = upload::receive_at_most(&http, http.limits.drive_bytes, &headers, request).await?;
            stages.end("receive");
            let (class, scratch) = (Class::of_bytes(upload.size()), http.store.scratch_dir());
            let of_rig = rig.clone();
            let read = move || query.file.read(&of_rig, Some(format), upload, &scratch);
            let measurement = http.off_thread(class, read).await??;
            let bytes = needed(&model, measurement.samples.n_samples(), false);
            let memory = http.predictions.take(admission::client_id(), bytes).await?;
            let of_model = model.clone();
            let drive = http.off_thread(class, move || inputs::measured(measurement, &of_model)).await??;
            stages.end("load");
            predicted(&http, PredictionTask::of_file(rig, model, drive, media_type, memory), stages).await
        }
    }
}

/// Media types of an answer: that of the request first, which is chosen without `Accept`.
fn forms(own: &'static str) -> [&'static str; 5] {
    let mut forms = [json::MEDIA_TYPE, NPY, CSV, RPC3, MAT];
    let place = forms.iter().position(|&form| form == own).expect("an answer has the forms of requests");
    forms[..=place].rotate_right(1);
    forms
}

/// Bytes of the signals of a prediction: inputs before and behind the model's filter, outputs, and a target.
pub(super) fn needed(model: &LoadedModel, samples: usize, target: bool) -> usize {
    let model = model.model();
    let channels = 2 * model.inputs.len() + if target { 3 } else { 1 } * model.outputs.len();
    samples.saturating_mul(channels).saturating_mul(size_of::<f64>())
}

/// The rig and the model that predicts for it, held until the answer is written.
///
/// # Errors
/// `rig.not_found`, `model.not_found`, `model.none_active`; a model that cannot be loaded.
pub(super) async fn find(http: &Shared, id: &RigId, name: ModelRef) -> Answer<(Rig, Arc<LoadedModel>)> {
    let rig = http.store.rig(id).await?.ok_or_else(|| no_rig(id.as_str()))?;
    let model = match name {
        ModelRef::Active => http.models.active(id).await?.ok_or_else(|| {
            let detail =
                format!("The rig {:?} has no active model; fit one, or name a version.", id.as_str());
            Problem::new(codes::MODEL_NONE_ACTIVE, detail)
        })?,
        ModelRef::Version(version) => {
            http.models.version(id, version).await?.ok_or_else(|| no_model(&version.to_string()))?
        }
    };
    Ok((rig, model))
}

async fn predicted(http: &Shared, task: PredictionTask, stages: Stages) -> Answer {
    let (model, class) = (task.model.clone(), task.class());
    let work = |deadline: &Deadline, stages: &mut Stages| {
        let computed = task.run(deadline, stages)?;
        let samples = computed.samples;
        Ok((computed, samples))
    };
    let computed = compute(http, &model, class, stages, work).await?;
    respond(http, &model, computed)
}

/// Predicts before the deadline, and counts the prediction. The work gives its result and the number of
/// samples predicted, all outputs together.
///
/// # Errors
/// Those of the work; `predict.deadline`, `busy`, `token.busy`.
pub(super) async fn compute<T, F>(
    http: &Shared,
    model: &LoadedModel,
    class: Class,
    mut stages: Stages,
    work: F,
) -> Answer<T>
where
    T: Send + 'static,
    F: FnOnce(&Deadline, &mut Stages) -> Answer<(T, u64)> + Send + 'static,
{
    let kind = model.model().version_kind().as_str();
    let started = Instant::now();
    let work = move |deadline: &Deadline| {
        stages.end("wait");
        work(deadline, &mut stages)
    };
    let (computed, samples) = http.in_time(class, work).await?;
    metrics::counter!(names::PREDICTIONS, "kind" => kind).increment(1);
    metrics::counter!(names::PREDICTED_SAMPLES).increment(samples);
    metrics::histogram!(names::PREDICTION_SECONDS, "kind" => kind).record(started.elapsed().as_secs_f64());
    Ok(computed)
}

fn respond(http: &Shared, model: &LoadedModel, computed: Computed) -> Answer<Response> {
    let Computed { written, size, media_type, inside, .. } = computed;
    let mut response = written.into_body(&http.compute).into_response();
    let headers = response.headers_mut();
    headers.insert(CONTENT_TYPE, HeaderValue::from_static(media_type));
    if let Some(size) = size {
        headers.insert(CONTENT_LENGTH, HeaderValue::from(size));
    }
    let mut put = |name: &'static str, value: String| -> Answer<()> {
        let value = HeaderValue::try_from(value).map_err(Problem::internal)?;
        headers.insert(HeaderName::from_static(name), value);
        Ok(())
    };
    put("rigcast-model-version", model.version.to_string())?;
    put("rigcast-model-digest", model.sha256.clone())?;
    put("rigcast-channels", header_names(&model.model().outputs))?;
    if let Some(inside) = inside {
        put("rigcast-trust-inside", inside.to_string())?;
    }
    Ok(response)
}
