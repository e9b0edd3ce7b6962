//! Predictions of the protocol: tensors of a drive in, tensors of the response out.

use axum::body::Body;
use axum::extract::State;
use axum::http::header::{CONTENT_LENGTH, CONTENT_TYPE};
use axum::http::{HeaderMap, HeaderValue};
use axum::response::IntoResponse;

use super::answer::{Answering, Tensors};
use super::body::{self, BINARY, JSON_LENGTH, Received};
use super::drive::{Drive, unknown};
use super::layout::Layout;
use super::named::NamedModel;
use super::request::InferRequest;
use crate::engine::{EngineError, Progress};
use crate::http::deadline::{self, Deadline};
use crate::http::predict::memory::Share;
use crate::http::predict::{self, Stages};
use crate::http::problem::{Answer, FieldError, Problem};
use crate::http::{Shared, admission, codes, errors, json};
use crate::models::LoadedModel;

/// `POST /v2/models/{rig}/infer`, `POST /v2/models/{rig}/versions/{version}/infer`
pub async fn infer(
    State(http): State<Shared>,
    NamedModel(id, name): NamedModel,
    headers: HeaderMap,
    request: Body,
) -> Answer {
    let mut stages = Stages::begin();
    let Received { mut request, binary } = body::receive(&headers, request, &http).await?;
    stages.end("receive");
    let (rig, model) = predict::find(&http, &id, name).await?;
    let layout = Layout::of(&rig, model.model());
    // From here on only the drive holds the body: its memory is given back once it has become a signal.
    let drive = Drive::check(&mut request, binary, &layout)?;
    if let Some(found_hz) = request.sample_rate_hz() {
        predict::check_rate(model.model().sample_rate_hz, found_hz, "/parameters/sample_rate_hz")?;
    }
    let wanted = wanted(&request, &layout)?;
    let bytes = predict::needed(&model, drive.samples, false);
    let memory = http.predictions.take(admission::client_id(), bytes).await?;
    stages.end("load");
    let class = predict::class(&model.predictor, drive.samples, 1);
    let answering = Answering { rig: id, id: request.id, layout, wanted };
    let loaded = model.clone();
    let work = move |deadline: &Deadline, stages: &mut Stages| {
        run(&loaded, drive, answering, memory, deadline, stages)
    };
    let tensors = predict::compute(&http, &model, class, stages, work).await?;

    let Tensors { written, json_length, size } = tensors;
    let mut response = written.into_body(&http.compute).into_response();
    let headers = response.headers_mut();
    let media_type = if json_length.is_some() { BINARY } else { json::MEDIA_TYPE };
    headers.insert(CONTENT_TYPE, HeaderValue::from_static(media_type));
    if let (Some(length), Some(size)) = (json_length, size) {
        headers.insert(JSON_LENGTH.clone(), HeaderValue::from(length));
        headers.insert(CONTENT_LENGTH, HeaderValue::from(size));
    }
    Ok(response)
}

/// Places of the wanted tensors among the outputs, and whether each is binary.
fn wanted(request: &InferRequest, layout: &Layout) -> Answer<Vec<(usize, bool)>> {
    let Some(names) = request.wanted() else {
        return Ok((0..layout.outputs.len()).map(|place| (place, request.binary())).collect());
    };
    let mut wanted: Vec<(usize, bool)> = Vec::new();
    for (at, (name, binary)) in names.enumerate() {
        let pointer = || format!("/outputs/{at}/name");
        let place = layout.outputs.iter().position(|tensor| tensor.name == name);
        let place = place.ok_or_else(|| unknown(name, &layout.outputs, pointer()))?;
        if wanted.iter().any(|(other, _)| *other == place) {
            let detail = format!("The tensor {name:?} is asked for twice.");
            return Err(Problem::new(codes::INFERENCE_DUPLICATE_TENSOR, detail)
                .with(FieldError::new(pointer(), "each tensor once")));
        }
        wanted.push((place, binary));
    }
    Ok(wanted)
}

/// Predicts; gives the answer and the number of samples predicted, all outputs together. Each piece of the
/// response is written and dropped, so that samples are in memory once, with four bytes each.
fn run(
    loaded: &LoadedModel,
    drive: Drive,
    answering: Answering,
    mut memory: Share,
    deadline: &Deadline,
    stages: &mut Stages,
) -> Answer<(Tensors, u64)> {
    let (model, predictor) = (loaded.model(), &loaded.predictor);
    let signal = drive.into_signal(model)?;
    stages.end("parse");
    let mut prediction =
        predictor.begin(signal).map_err(|error| errors::engine(&error, &model.inputs, "/inputs"))?;
    let trust = predictor.trust(&prediction);
    let samples = prediction.n_samples();
    let mut rows = answering.rows(samples);
    let watch = |progress: Progress<'_>| deadline.watch(progress);
    let refusal = |error: EngineError| match error {
        EngineError::Cancelled => deadline::over(),
        error => errors::engine(&error, &model.outputs, "/inputs"),
    };
    while let Some(piece) = predictor.next(&mut prediction, &watch).map_err(refusal)? {
        rows.write(piece, &model.outputs)?;
    }
    drop(prediction);
    stages.end("simulate");
    memory.keep(rows.size());
    let tensors = answering.finish(loaded, trust, rows, memory)?;
    stages.end("report");
    Ok((tensors, (samples * model.outputs.len()) as u64))
}
