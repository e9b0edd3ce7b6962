//! Predictions: a drive in, the response out, with damage, errors and trust.
//!
//! [`receive`] takes a request in each of its forms and [`request`] says what is asked for, [`memory`] waits for the
//! memory that it needs, [`inputs`] makes signals for the model, which [`conversion`] brings to its sample rate,
//! [`answer`] computes and writes the answer in the [`form`] that the client prefers.

mod answer;
mod compare;
mod conversion;
mod fallback;
mod form;
mod inputs;
pub(super) mod memory;
mod receive;
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
use super::negotiate::NPY;
use super::params::Params;
use super::paths::{OfRig, no_model, no_rig};
use super::problem::{Answer, Problem};
use super::{Shared, body, codes, json};
use crate::compute::Class;
use crate::domain::{ModelRef, Rig, RigId};
use crate::models::LoadedModel;
use crate::telemetry::names;
use answer::Computed;
use receive::Incoming;

pub(super) use answer::class;
pub use compare::{Comparison, Comparisons, compare};
pub(super) use conversion::check_rate;
pub use memory::PredictionMemory;
pub(super) use stages::Stages;

/// `POST /v1/rigs/{rig}/predict`
pub async fn predict(
    State(http): State<Shared>,
    OfRig(rig): OfRig,
    params: Params,
    headers: HeaderMap,
    body: Body,
) -> Answer {
    let media_type = body::media_type(&headers);
    let incoming = Incoming { rig, params, headers, body };
    let mut stages = Stages::begin();
    let task = match media_type.as_deref() {
        Some(json::MEDIA_TYPE) => incoming.json(&http, &mut stages).await?,
        Some(NPY) => incoming.npy(&http, &mut stages).await?,
        other => incoming.measurement(&http, other, &mut stages).await?,
    };
    let (model, class) = (task.model.clone(), task.class());
    let work = |deadline: &Deadline, stages: &mut Stages| {
        let computed = task.run(deadline, stages)?;
        let samples = computed.samples;
        Ok((computed, samples))
    };
    let computed = compute(&http, &model, class, stages, work).await?;
    respond(&http, &model, computed)
}

/// Bytes of the signals of a prediction: inputs before and behind the model's filter, outputs, the whole response of a
/// core, and a target.
pub(super) fn needed(model: &LoadedModel, samples: usize, target: bool) -> usize {
    let model = model.model();
    let of_outputs = if target { 3 } else { 1 } + usize::from(!model.core.is_empty());
    let channels = 2 * model.inputs.len() + of_outputs * model.outputs.len();
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
    let Computed { written, size, content_type, inside, fallback_share, .. } = computed;
    let mut response = written.into_body(&http.compute).into_response();
    let headers = response.headers_mut();
    headers.insert(CONTENT_TYPE, HeaderValue::try_from(content_type).map_err(Problem::internal)?);
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
    put("rigcast-sample-rate-hz", model.model().sample_rate_hz.to_string())?;
    put("rigcast-channels", header_names(&model.model().outputs))?;
    if let Some(inside) = inside {
        put("rigcast-trust-inside", inside.to_string())?;
    }
    if let Some(share) = fallback_share {
        put("rigcast-fallback-share", share.to_string())?;
    }
    Ok(response)
}
