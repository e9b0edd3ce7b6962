//! Samples of a run, or a stretch of some of its channels, read from its file as the client reads them.

use std::ops::Range;

use axum::extract::State;
use axum::http::header::{CONTENT_LENGTH, CONTENT_TYPE};
use axum::http::{HeaderMap, HeaderName};
use axum::response::IntoResponse;

use crate::domain::{Role, Run};
use crate::formats::csv::{CsvPieces, TimeOfRows};
use crate::formats::mat::MatPieces;
use crate::formats::npy::NpyPieces;
use crate::formats::rpc3::Rpc3Pieces;
use crate::http::body::pieces::{Pieces, Written};
use crate::http::body::signal_pieces::JsonPieces;
use crate::http::body::signals::header_names;
use crate::http::negotiate::{self, CSV, MAT, NPY, RPC3, RPC3_FLOATS};
use crate::http::params::{Params, invalid};
use crate::http::paths::{OfRun, no_run};
use crate::http::problem::{Answer, FieldError, Problem};
use crate::http::{Shared, codes, json};

/// `GET /v1/rigs/{rig}/runs/{run}/data`
pub async fn show(
    State(http): State<Shared>,
    OfRun(rig, id): OfRun,
    mut params: Params,
    headers: HeaderMap,
) -> Answer {
    let from_s = seconds(&mut params, "from_s")?;
    let to_s = seconds(&mut params, "to_s")?;
    let wanted = params.one("channels")?;
    params.finish()?;
    let media_type = negotiate::choose(&headers, &[json::MEDIA_TYPE, CSV, NPY, RPC3, MAT])?;
    let media_type = negotiate::with_numbers(&headers, RPC3, media_type)?;
    let run = http.store.run(&rig, id).await?.ok_or_else(|| no_run(&id.to_string()))?;
    let columns = columns(&run, wanted.as_deref())?;
    let range = stretch(&run, from_s, to_s)?;
    let names: Vec<String> = columns.iter().map(|&c| run.channels[c].clone()).collect();
    let mut head = HeaderMap::new();
    let mut put = |name: HeaderName, value: String| -> Answer<()> {
        head.insert(name, value.parse().map_err(Problem::internal)?);
        Ok(())
    };
    put(CONTENT_TYPE, media_type.to_owned())?;
    put(HeaderName::from_static("rigcast-channels"), header_names(&names))?;
    put(HeaderName::from_static("rigcast-sample-rate-hz"), run.sample_rate_hz.to_string())?;
    let open = http.store.open_samples(&run, columns.clone(), range.clone());
    let samples = http.read_in_time(open).await?;
    let units = || columns.iter().map(|&c| run.units[c].clone()).collect::<Vec<String>>();
    let pieces: Pieces = match media_type {
        NPY => {
            let pieces = NpyPieces::new(samples);
            put(CONTENT_LENGTH, pieces.size().to_string())?;
            Box::new(pieces)
        }
        CSV => {
            let time = TimeOfRows::beside(&names, range.start);
            Box::new(CsvPieces::new(names, units(), time, samples).map_err(Problem::internal)?)
        }
        MAT => {
            let pieces =
                MatPieces::new(&names, &units(), samples).ok_or_else(negotiate::too_large_for_mat)?;
            put(CONTENT_LENGTH, pieces.size().to_string())?;
            Box::new(pieces)
        }
        RPC3 | RPC3_FLOATS => {
            let rig = http.store.rig(&rig).await?.ok_or_else(|| no_run(&id.to_string()))?;
            let drives = names.iter().all(|n| rig.channel(n).is_some_and(|c| c.role == Role::Drive));
            let mut pieces = Rpc3Pieces::new(names, units(), drives, samples);
            if media_type == RPC3_FLOATS {
                pieces = pieces.as_floats();
            }
            put(CONTENT_LENGTH, pieces.size().to_string())?;
            Box::new(pieces)
        }
        _ => Box::new(JsonPieces::new(names, samples)),
    };
    let written = http.compute.piece(|| Written::begin(pieces)).await?.map_err(Problem::internal)?;
    Ok((head, written.into_body(&http.compute)).into_response())
}

fn seconds(params: &mut Params, name: &str) -> Answer<Option<f64>> {
    let limit = "a number of seconds, not negative";
    match params.number(name, limit)? {
        Some(s) if s < 0.0 => Err(invalid(name, format!("is {s}"), limit)),
        s => Ok(s),
    }
}

/// Indices of the requested channels.
fn columns(run: &Run, wanted: Option<&str>) -> Answer<Vec<usize>> {
    let Some(wanted) = wanted else { return Ok((0..run.channels.len()).collect()) };
    let place = |name: &str| {
        run.channels.iter().position(|c| c == name).ok_or_else(|| {
            let limit = format!("one of {}", run.channels.join(", "));
            Problem::new(codes::RUN_UNKNOWN_CHANNEL, format!("The run has no channel {name:?}."))
                .with(FieldError::new("?channels", limit).on_channel(name))
        })
    };
    wanted.split(',').map(|name| place(name.trim())).collect()
}

/// Samples whose time t (0 at the first) has `from_s <= t < to_s`.
fn stretch(run: &Run, from_s: Option<f64>, to_s: Option<f64>) -> Answer<Range<usize>> {
    // Half a millionth of a step allows for decimal times that are not exact in binary.
    let index = |s: f64| ((s * run.sample_rate_hz - 5e-7).ceil().max(0.0) as usize).min(run.samples as usize);
    let range = from_s.map_or(0, index)..to_s.map_or(run.samples as usize, index);
    if range.is_empty() {
        let limit = format!("before to_s, and within the run's {} s", run.duration_s);
        return Err(invalid("from_s", "and to_s leave no sample", &limit));
    }
    Ok(range)
}
