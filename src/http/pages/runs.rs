//! The page of a run, its figures, and its file as a download.

use axum::extract::{FromRequestParts, Request, State};
use axum::http::header::{ACCEPT, CONTENT_DISPOSITION};
use axum::http::{HeaderMap, HeaderValue};

use super::figure::FigureQuery;
use super::rigs::find;
use super::{Visitor, html};
use crate::compute::Class;
use crate::domain::Run;
use crate::engine::Signal;
use crate::engine::fatigue::{ClassSettings, DamageChannel, Residue, counts_report};
use crate::engine::metrics::ErrorSettings;
use crate::engine::spectral::psd;
use crate::http::negotiate::{CSV, MAT, NPY, RPC3};
use crate::http::params::{Params, invalid};
use crate::http::paths::{OfRun, no_run};
use crate::http::problem::{Answer, Problem};
use crate::http::{Shared, errors, json, runs};
use crate::ui;
use crate::ui::figures::Drawing;
use crate::ui::run::{RunView, TimeView};

/// Names of the figures.
const FIGURES: &str = "time, psd, from_to, range_pair or level_crossing";

/// `GET /rigs/{rig}/runs/{run}`, and its figures.
pub async fn show(
    State(http): State<Shared>,
    OfRun(rig_id, id): OfRun,
    visitor: Visitor,
    mut params: Params,
) -> Answer {
    let query = FigureQuery::take(&mut params)?;
    let channel = params.parse::<usize>("channel", "the place of a channel")?.unwrap_or_default();
    let overlay = params.flag("overlay")?;
    params.finish()?;
    let run = http.store.run(&rig_id, id).await?.ok_or_else(|| no_run(&id.to_string()))?;
    if channel >= run.channels.len() {
        return Err(invalid("channel", format!("is {channel}"), &format!("below {}", run.channels.len())));
    }
    let file = format!("{rig_id}-{}", &id.to_string()[24..]);
    match query.name.as_deref() {
        None => {}
        Some("time") => return query.answer(&time(&http, &run, &query, overlay).await?, &file),
        Some("psd") => return query.answer(&spectra(&http, run, query.width).await?, &file),
        Some(name @ ("from_to" | "range_pair" | "level_crossing")) => {
            return query.answer(&counted(&http, run, name.to_owned(), channel, query.width).await?, &file);
        }
        Some(_) => return Err(query.unknown(FIGURES)),
    }
    let rig = find(&http, &rig_id).await?;
    let can_predict = http.store.active_model(&rig_id).await?.is_some_and(|active| active.version.is_some());
    let time = time(&http, &run, &query, overlay).await?;
    html(ui::run::page(
        &visitor.shown,
        &RunView { rig: &rig, run: &run, channel, overlay, time, can_predict },
    ))
}

/// The signals over time.
async fn time(http: &Shared, run: &Run, query: &FigureQuery, overlay: bool) -> Answer<Drawing> {
    let watch = http.views.open(http, run).await?;
    let n = usize::try_from(run.samples).unwrap_or(usize::MAX);
    let index = |s: f64| ((s * run.sample_rate_hz).round().max(0.0) as usize).min(n);
    let from = query.range[0].map_or(0, index).min(n - 1);
    let to = query.range[1].map_or(n, index).max(from + 1);
    let width = query.width;
    // A pixel of the plot, whose frame leaves some 70 free.
    let columns = ((width - 70.0).max(100.0) as usize).min(to - from);
    let channels = run.channels.iter().cloned().zip(run.units.iter().cloned()).collect();
    let rate = run.sample_rate_hz;
    let draw = move || {
        let envelopes = watch.envelopes(&(from..to), columns)?;
        let range = [from as f64 / rate, to as f64 / rate];
        let single = columns == to - from;
        Ok::<_, std::io::Error>(TimeView { channels, envelopes, range, single, width, overlay }.drawing())
    };
    http.off_thread(Class::of_values(to - from), draw).await?.map_err(Problem::internal)
}

/// The samples of some channels of a run, in the memory that large predictions share.
async fn load(http: &Shared, run: &Run, channels: Vec<usize>) -> Answer<Signal> {
    http.store.load_channels(run, channels).await.map_err(Into::into)
}

async fn spectra(http: &Shared, run: Run, width: f64) -> Answer<Drawing> {
    let n = usize::try_from(run.samples).unwrap_or(usize::MAX);
    let names: Vec<(String, String)> = run.channels.iter().cloned().zip(run.units.iter().cloned()).collect();
    let welch = ErrorSettings::for_length(n).psd;
    let mut density = Vec::with_capacity(names.len());
    let mut found = None;
    // One channel in memory at a time.
    for channel in 0..names.len() {
        let bytes = n.saturating_mul(size_of::<f64>());
        let _share = http.predictions.take(crate::http::admission::client_id(), bytes).await?;
        let signal = load(http, &run, vec![channel]).await?;
        let of = http.off_thread(Class::of_values(n), move || psd(&[&signal], &welch)).await?;
        let mut of = of.map_err(|error| errors::engine(&error, &run.channels[channel..=channel], ""))?;
        density.append(&mut of.density);
        found = Some(of);
    }
    match found {
        Some(found) => {
            Ok(ui::run::spectra(&names, &crate::engine::spectral::Psd { density, ..found }, width))
        }
        None => Ok(Drawing::Nothing("The run has no channels.".into())),
    }
}

async fn counted(http: &Shared, run: Run, name: String, channel: usize, width: f64) -> Answer<Drawing> {
    let n = usize::try_from(run.samples).unwrap_or(usize::MAX);
    let _share = http
        .predictions
        .take(crate::http::admission::client_id(), n.saturating_mul(3 * size_of::<f64>()))
        .await?;
    let signal = load(http, &run, vec![channel]).await?;
    http.off_thread(Class::of_values(n), move || {
        let (channel_name, unit) = (&run.channels[channel], &run.units[channel]);
        if run.quality.channels.get(channel).is_some_and(|quality| quality.dead) {
            return Ok(Drawing::Nothing("The channel is constant: it has no cycles.".into()));
        }
        let of = [DamageChannel { name: channel_name, predicted: signal.channel(0), target: None }];
        let report = counts_report(&of, &ClassSettings::default(), Residue::default());
        let report = report.map_err(|error| errors::engine(&error, &run.channels[channel..=channel], ""))?;
        let tables = [("measured", &report.channels[0].1.predicted)];
        Ok(ui::run::counted(&name, channel_name, unit, &tables, width))
    })
    .await?
}

/// `GET /rigs/{rig}/runs/{run}/file`: the samples as the API gives them, in a format that the address names.
pub async fn file(State(http): State<Shared>, request: Request) -> Answer {
    let (mut parts, _) = request.into_parts();
    let OfRun(rig, run) = OfRun::from_request_parts(&mut parts, &http).await?;
    let mut params = Params::from_request_parts(&mut parts, &http).await?;
    let format = params.one("format")?.unwrap_or_default();
    params.finish()?;
    let media_type = match format.as_str() {
        "csv" => CSV,
        "npy" => NPY,
        "rpc3" => RPC3,
        "mat" => MAT,
        "json" => json::MEDIA_TYPE,
        other => return Err(invalid("format", format!("is {other:?}"), "csv, npy, rpc3, mat or json")),
    };
    let ending = if media_type == RPC3 { "rsp" } else { &format };
    let name = format!("attachment; filename=\"{rig}-{}.{ending}\"", &run.to_string()[24..]);
    let headers = HeaderMap::from_iter([(ACCEPT, HeaderValue::from_static(media_type))]);
    let mut response = runs::data::show(State(http), OfRun(rig, run), Params::none(), headers).await?;
    response
        .headers_mut()
        .insert(CONTENT_DISPOSITION, HeaderValue::try_from(name).map_err(Problem::internal)?);
    Ok(response)
}
