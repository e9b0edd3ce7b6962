//! What clients ask about a model before they use it.

use axum::extract::State;
use serde::Serialize;
use serde_json::{Value, json};

use super::layout::{Layout, Tensor};
use super::named::NamedModel;
use crate::domain::page::MAX_LIMIT;
use crate::domain::{Cursor, ModelRef, PageRequest, Rig, RigId};
use crate::http::paths::no_rig;
use crate::http::problem::{Answer, Problem};
use crate::http::{Shared, codes, json, predict};

/// Seconds after which a client may ask again whether a model is ready: a fit takes no less.
const RETRY_S: u32 = 5;

/// A tensor as the metadata describe it.
#[derive(Debug, Serialize)]
struct TensorMetadata<'a> {
    name: &'a str,
    datatype: &'static str,
    /// Any number of samples, so many channels.
    shape: [i64; 2],
    parameters: Columns<'a>,
}

/// The channels of a tensor, in the order of its columns.
#[derive(Debug, Serialize)]
struct Columns<'a> {
    channels: Vec<&'a str>,
    units: Vec<&'a str>,
}

/// `GET /v2/models/{rig}`, `GET /v2/models/{rig}/versions/{version}`
pub async fn metadata(State(http): State<Shared>, NamedModel(id, name): NamedModel) -> Answer {
    let (rig, loaded) = predict::find(&http, &id, name).await?;
    let model = loaded.model();
    let layout = Layout::of(&rig, model);
    let versions = match name {
        ModelRef::Active => versions(&http, &id).await?,
        ModelRef::Version(version) => vec![version.to_string()],
    };
    let kind = model.version_kind().as_str();
    json::answer(&json!({
        "name": id,
        "versions": versions,
        "platform": platform(kind),
        "inputs": described(&layout.inputs, &model.inputs, &rig),
        "outputs": described(&layout.outputs, &model.outputs, &rig),
        "parameters": {
            "version": loaded.version.to_string(), "kind": kind, "sha256": loaded.sha256,
            "sample_rate_hz": model.sample_rate_hz,
        },
    }))
}

/// `GET /v2/models/{rig}/config`, `GET /v2/models/{rig}/versions/{version}/config`: Triton's form of the metadata.
/// A `max_batch_size` of 0 says that the first dimension is no batch.
pub async fn config(State(http): State<Shared>, NamedModel(id, name): NamedModel) -> Answer {
    let (rig, loaded) = predict::find(&http, &id, name).await?;
    let model = loaded.model();
    let layout = Layout::of(&rig, model);
    let tensors = |tensors: &[Tensor]| -> Vec<Value> {
        let one = |tensor: &Tensor| json!({"name": tensor.name, "data_type": "TYPE_FP32", "dims": [-1, tensor.channels.len()]});
        tensors.iter().map(one).collect()
    };
    let version = loaded.version;
    json::answer(&json!({
        "name": id,
        "platform": platform(model.version_kind().as_str()),
        "backend": "rigcast",
        "version_policy": {"specific": {"versions": [version]}},
        "max_batch_size": 0,
        "input": tensors(&layout.inputs),
        "output": tensors(&layout.outputs),
    }))
}

/// `GET /v2/models/{rig}/ready`, `GET /v2/models/{rig}/versions/{version}/ready`: 200 only where a prediction
/// would find its model.
pub async fn ready(State(http): State<Shared>, NamedModel(id, name): NamedModel) -> Answer {
    match predict::find(&http, &id, name).await {
        Ok(_) => json::answer(&json!({"name": id, "ready": true})),
        Err(problem) if problem.code() == codes::MODEL_NONE_ACTIVE.name => {
            let detail = format!("The rig {:?} has no active model.", id.as_str());
            Err(Problem::new(codes::MODEL_NOT_READY, detail).retry_after(RETRY_S))
        }
        Err(problem) => Err(problem),
    }
}

/// Name of a kind of model, as the protocol names frameworks.
fn platform(kind: &str) -> String {
    format!("rigcast_{kind}")
}

fn described<'a>(tensors: &'a [Tensor], names: &'a [String], rig: &'a Rig) -> Vec<TensorMetadata<'a>> {
    let one = |tensor: &'a Tensor| {
        let channels: Vec<&str> = tensor.channels.iter().map(|&place| names[place].as_str()).collect();
        let unit = |name: &&str| rig.channel(name).map_or("", |channel| channel.unit.as_str());
        let units = channels.iter().map(unit).collect();
        TensorMetadata {
            name: &tensor.name,
            datatype: "FP32",
            shape: [-1, channels.len() as i64],
            parameters: Columns { channels, units },
        }
    };
    tensors.iter().map(one).collect()
}

/// All versions of a rig's models.
async fn versions(http: &Shared, rig: &RigId) -> Answer<Vec<String>> {
    let mut found = Vec::new();
    let mut page = PageRequest { limit: MAX_LIMIT, cursor: None };
    loop {
        let models = http.store.models(rig, &page).await?.ok_or_else(|| no_rig(rig.as_str()))?;
        found.extend(models.items.iter().map(|model| model.version.to_string()));
        match models.next.and_then(|next| Cursor::parse(&next).ok()) {
            None => return Ok(found),
            cursor => page.cursor = cursor,
        }
    }
}
