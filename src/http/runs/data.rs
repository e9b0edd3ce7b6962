//! Samples of a run, or a stretch of some of its channels.

use std::ops::Range;

use axum::extract::State;
use axum::http::header::CONTENT_TYPE;
use axum::http::{HeaderMap, HeaderName};
use axum::response::IntoResponse;

use crate::compute::Class;
use crate::domain::Run;
use crate::engine::Signal;
use crate::formats::npy::{Dtype, Order};
use crate::formats::{self, FormatError};
use crate::http::body::signals::{header_names, write_json};
use crate::http::params::{Params, invalid};
use crate::http::paths::{OfRun, no_run};
use crate::http::predict::NPY;
use crate::http::problem::{Answer, FieldError, Problem};
use crate::http::{Shared, codes, json, negotiate};

/// Media type of tables.
const CSV: &str = "text/csv";
/// Name of the first column of a table.
const TIME: &str = "time_s";

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
    let media_type = negotiate::choose(&headers, &[json::MEDIA_TYPE, CSV, NPY])?;
    let run = http.store.run(&rig, id).await?.ok_or_else(|| no_run(&id.to_string()))?;
    let columns = columns(&run, wanted.as_deref())?;
    let range = stretch(&run, from_s, to_s)?;
    let whole = http.store.load_signal(&run).await?;
    let names: Vec<String> = columns.iter().map(|&c| run.channels[c].clone()).collect();
    let head = [
        (CONTENT_TYPE, media_type.to_owned()),
        (HeaderName::from_static("rigcast-channels"), header_names(&names)),
        (HeaderName::from_static("rigcast-sample-rate-hz"), run.sample_rate_hz.to_string()),
    ];
    let class = Class::of_values(run.samples as usize * run.channels.len());
    let bytes = http
        .in_time(class, move |_| {
            let signal = whole.select(&columns).slice(range.clone());
            match media_type {
                NPY => formats::npy::write(signal.channels(), Dtype::F8, Order::C).map_err(Problem::internal),
                CSV => {
                    let units = columns.iter().map(|&c| run.units[c].clone()).collect();
                    table(names, units, signal, range.start).map_err(Problem::internal)
                }
                _ => {
                    let mut json = Vec::new();
                    write_json(&mut json, &names, &signal);
                    Ok(json)
                }
            }
        })
        .await?;
    Ok((head, bytes).into_response())
}

/// A table whose first column is the time since the start of the run.
fn table(
    mut names: Vec<String>,
    mut units: Vec<String>,
    signal: Signal,
    start: usize,
) -> Result<Vec<u8>, FormatError> {
    let rate = signal.sample_rate_hz();
    let time = (start..start + signal.n_samples()).map(|i| i as f64 / rate).collect();
    let mut channels = signal.into_channels();
    // A rig with a channel of that name gets no second one.
    if !names.iter().any(|name| name == TIME) {
        names.insert(0, TIME.into());
        units.insert(0, "s".into());
        channels.insert(0, time);
    }
    formats::csv::write(&names, Some(&units), &channels)
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
