//! Model versions: lists, export and import of weights.

use axum::body::Body;
use axum::extract::State;
use axum::http::header::{CONTENT_DISPOSITION, CONTENT_TYPE, ETAG};
use axum::http::{HeaderMap, HeaderName, StatusCode};
use axum::response::IntoResponse;
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use bytes::Bytes;
use sha2::{Digest, Sha256};

use super::idempotency::{RequestKey, created};
use super::params::{NoParams, Params, page};
use super::paths::{OfModel, OfRig, no_model, no_rig};
use super::problem::{Answer, FieldError, Problem};
use super::upload;
use super::{Shared, body, codes, errors, json};
use crate::compute::Class;
use crate::domain::{Adoption, Created, Lineage, Model, Origin, Rig, UsedCore};
use crate::engine::model::{RigModel, from_safetensors};
use crate::engine::{Signal, rounded};
use crate::storage::{Activation, ModelDelete, NewModel};

/// Media type of weight files.
const SAFETENSORS: &str = "application/x-safetensors";
/// Media types of an import.
const IMPORT_TYPES: &[&str] = &["application/octet-stream", SAFETENSORS];

/// `GET /v1/rigs/{rig}/models`
pub async fn list(State(http): State<Shared>, OfRig(rig): OfRig, mut params: Params) -> Answer {
    let page = page(&mut params)?;
    params.finish()?;
    json::answer(&http.store.models(&rig, &page).await?.ok_or_else(|| no_rig(rig.as_str()))?)
}

/// `GET /v1/rigs/{rig}/models/{version}`
pub async fn show(State(http): State<Shared>, OfModel(rig, version): OfModel, _: NoParams) -> Answer {
    json::answer(&http.store.model(&rig, version).await?.ok_or_else(|| no_model(&version.to_string()))?)
}

/// `DELETE /v1/rigs/{rig}/models/{version}`
pub async fn remove(State(http): State<Shared>, OfModel(rig, version): OfModel, _: NoParams) -> Answer {
    match http.store.delete_model(&rig, version).await? {
        ModelDelete::Deleted => {
            http.models.forget(&rig, Some(version));
            Ok(StatusCode::NO_CONTENT.into_response())
        }
        ModelDelete::Missing => Err(no_model(&version.to_string())),
        ModelDelete::Active => {
            let detail =
                format!("Version {version} is the active model; activate another one (or none) first.");
            Err(Problem::new(codes::MODEL_ACTIVE, detail))
        }
    }
}

/// `GET /v1/rigs/{rig}/models/{version}/weights`
pub async fn weights(State(http): State<Shared>, OfModel(rig, version): OfModel, _: NoParams) -> Answer {
    let model = http.store.model(&rig, version).await?.ok_or_else(|| no_model(&version.to_string()))?;
    let bytes = http.store.weights(&model).await?;
    let hashed = bytes.clone();
    let digest = http
        .off_thread(Class::of_bytes(bytes.len()), move || STANDARD.encode(Sha256::digest(&hashed)))
        .await?;
    let head = [
        (CONTENT_TYPE, SAFETENSORS.to_owned()),
        (ETAG, format!("\"{}\"", model.sha256)),
        (HeaderName::from_static("content-digest"), format!("sha-256=:{digest}:")),
        (CONTENT_DISPOSITION, format!("attachment; filename=\"{rig}-{version}.safetensors\"")),
    ];
    Ok((head, bytes).into_response())
}

/// `POST /v1/rigs/{rig}/models`
pub async fn import(
    State(http): State<Shared>,
    OfRig(id): OfRig,
    _: NoParams,
    key: RequestKey,
    headers: HeaderMap,
    request: Body,
) -> Answer {
    let rig = http.store.rig(&id).await?.ok_or_else(|| no_rig(id.as_str()))?;
    let found = body::media_type(&headers);
    if !found.as_deref().is_some_and(|f| IMPORT_TYPES.contains(&f)) {
        return Err(body::unsupported(found.as_deref(), IMPORT_TYPES));
    }
    let upload = upload::receive(&http, &headers, request).await?;
    let class = Class::of_bytes(upload.size());
    let new =
        http.off_thread(class, move || read(&rig, &upload.read().map_err(Problem::internal)?)).await??;
    let key = key.stored().map(|key| (key, Created::model as fn(&Model) -> Created));
    let inserted = http.store.insert_model(&id, new, Activation::Leave, key, http.now()).await?;
    created(Created::model(&inserted.ok_or_else(|| no_rig(id.as_str()))?))
}

/// Reads a weight file and checks it against the rig. It is stored in the service's own form, so that
/// every stored file reads the same way.
fn read(rig: &Rig, bytes: &[u8]) -> Answer<NewModel> {
    let model = from_safetensors(bytes).map_err(|error| {
        let problem = errors::engine(&error, &[], "");
        errors::count_unreadable("safetensors", &problem);
        problem
    })?;
    suits(rig, &model)?;
    let weights = Bytes::from(crate::engine::model::to_safetensors(&model));
    Ok(NewModel {
        frf: model.frf_summary(),
        kind: model.kind,
        adoption: Adoption::of(&model, None, None),
        lineage: Lineage { core: UsedCore::of_import(&model), ..Lineage::default() },
        inputs: model.inputs,
        outputs: model.outputs,
        sample_rate_hz: model.sample_rate_hz,
        weights,
        origin: Origin::Import,
        job: None,
        request: None,
        report: None,
        record: None,
        // Weights made elsewhere do not say.
        instruction_set: "unknown".into(),
    })
}

fn suits(rig: &Rig, model: &RigModel) -> Answer<()> {
    for name in model.inputs.iter().chain(&model.outputs) {
        if rig.channel(name).is_none() {
            let detail = format!("The model has a channel {name:?}, which the rig does not have.");
            return Err(Problem::new(codes::MODEL_UNKNOWN_CHANNEL, detail)
                .with(FieldError::new("", "a channel of the rig").on_channel(name)));
        }
    }
    if !Signal::same_rate(model.sample_rate_hz, rig.sample_rate_hz) {
        let limit = format!("{} Hz", rounded(rig.sample_rate_hz, 10));
        let found = rounded(model.sample_rate_hz, 10);
        let detail = format!("The model has a sample rate of {found} Hz, the rig has {limit}.");
        return Err(Problem::new(codes::MODEL_SAMPLE_RATE, detail).with(FieldError::new("", limit)));
    }
    Ok(())
}
