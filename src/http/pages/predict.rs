//! The page that predicts a run and compares it, and its figures.

use std::ops::Range;
use std::sync::Arc;

use axum::extract::State;

use super::figure::FigureQuery;
use super::rigs::{find, items, whole};
use super::{Visitor, html};
use crate::compute::Class;
use crate::domain::{ModelRef, Rig, RunId};
use crate::engine::envelope::Envelope;
use crate::engine::fatigue::{ClassSettings, DamageChannel, Residue, counts_report};
use crate::engine::metrics::ErrorSettings;
use crate::engine::spectral::psd;
use crate::engine::{EngineError, Signal};
use crate::http::params::{Params, invalid};
use crate::http::paths::OfRig;
use crate::http::predict::{Comparison, compare};
use crate::http::problem::Answer;
use crate::http::{Shared, errors};
use crate::storage::RunQuery;
use crate::ui;
use crate::ui::figures::Drawing;
use crate::ui::predict::{Choice, Overlay, Result};
use crate::ui::run::with_unit;

const FIGURES: &str = "overlay, error, psd, range_pair or loop";

/// `GET /rigs/{rig}/predict`, and its figures.
pub async fn show(
    State(http): State<Shared>,
    OfRig(id): OfRig,
    visitor: Visitor,
    mut params: Params,
) -> Answer {
    let query = FigureQuery::take(&mut params)?;
    let name = params.one("model")?.unwrap_or_else(|| "active".into());
    let model = ModelRef::parse(&name)
        .ok_or_else(|| invalid("model", format!("is {name:?}"), "active or a version"))?;
    let drive = run_id(&mut params, "drive")?;
    let target = run_id(&mut params, "target")?;
    let place = "the place of a channel";
    let output = params.parse::<usize>("output", place)?.unwrap_or_default();
    let axes = [params.parse::<usize>("x", place)?, params.parse::<usize>("y", place)?];
    params.finish()?;
    let rig = find(&http, &id).await?;
    let compared = match drive {
        Some(drive) => Some(compare(&http, &id, model, drive, target).await?),
        None => None,
    };
    let view = match &compared {
        Some(compared) => Some(View::of(compared, output, axes)?),
        None => None,
    };
    if query.name.is_some() {
        let view = view.ok_or_else(|| query.unknown("given with the run of the drives"))?;
        let file = format!("{id}-prediction");
        return query.answer(&view.draw(&http, query.clone()).await?, &file);
    }
    let runs = items(http.store.runs(&id, &RunQuery::default(), &whole()).await?);
    let models = items(http.store.models(&id, &whole()).await?);
    let text = |run: Option<RunId>| run.map(|run| run.to_string());
    let (drive, target) = (text(drive), text(target));
    let mut at = format!("/rigs/{id}/predict?model={name}");
    for (key, value) in [("drive", &drive), ("target", &target)] {
        if let Some(value) = value {
            at.push_str(&format!("&{key}={value}"));
        }
    }
    let choice = Choice { rig: &rig, models: &models, runs: &runs, model: name, drive, target, at };
    let result = view.as_ref().map(View::result);
    html(ui::predict::page(&visitor.shown, &choice, result.as_ref()))
}

fn run_id(params: &mut Params, name: &str) -> Answer<Option<RunId>> {
    match params.one(name)?.as_deref() {
        None | Some("") => Ok(None),
        Some(text) => {
            text.parse().map(Some).map_err(|_| invalid(name, format!("is {text:?}"), "the id of a run"))
        }
    }
}

/// A comparison with the channels that are shown.
struct View {
    of: Arc<Comparison>,
    output: usize,
    axes: [usize; 2],
}

impl View {
    fn of(of: &Arc<Comparison>, output: usize, axes: [Option<usize>; 2]) -> Answer<Self> {
        let model = of.model.model();
        let all = model.outputs.len() + model.inputs.len();
        let axes = [axes[0].unwrap_or(model.outputs.len()), axes[1].unwrap_or(output)];
        for (name, place, below) in
            [("output", output, model.outputs.len()), ("x", axes[0], all), ("y", axes[1], all)]
        {
            if place >= below {
                return Err(invalid(name, format!("is {place}"), &format!("below {below}")));
            }
        }
        Ok(Self { of: Arc::clone(of), output, axes })
    }

    fn result(&self) -> Result<'_> {
        let of = &*self.of;
        let model = of.model.model();
        let rate = of.response.sample_rate_hz();
        Result {
            model: format!("Version {} ({})", of.model.version, model.version_kind().as_str()),
            channels: [&model.outputs, &model.inputs],
            output: self.output,
            axes: self.axes,
            errors: &of.errors,
            damage: &of.damage,
            inside: (!model.range.is_empty()).then_some(of.trust.inside),
            spans: &of.trust.spans,
            length: [of.response.n_samples() as f64 / rate, rate],
            has_target: of.target.is_some(),
        }
    }

    async fn draw(self, http: &Shared, query: FigureQuery) -> Answer<Drawing> {
        let class = Class::of_values(self.of.response.n_samples());
        http.off_thread(class, move || self.drawing(&query)).await?
    }

    fn drawing(&self, query: &FigureQuery) -> Answer<Drawing> {
        let output = &self.of.model.model().outputs[self.output];
        let channel = (output.as_str(), unit(&self.of.rig, output));
        let refuse = |error: EngineError| errors::engine(&error, std::slice::from_ref(output), "");
        match query.name.as_deref() {
            Some("overlay") => Ok(self.overlay(channel, query, false)),
            Some("error") => Ok(self.overlay(channel, query, true)),
            Some("psd") => self.spectra(channel, query.width).map_err(refuse),
            Some("range_pair") => self.counts(channel, query.width).map_err(refuse),
            Some("loop") => Ok(self.loops(query)),
            _ => Err(query.unknown(FIGURES)),
        }
    }

    /// Samples of the range of time that is shown.
    fn range(&self, query: &FigureQuery) -> Range<usize> {
        let (n, rate) = (self.of.response.n_samples(), self.of.response.sample_rate_hz());
        let index = |s: f64| ((s * rate).round().max(0.0) as usize).min(n);
        let from = query.range[0].map_or(0, index).min(n - 1);
        from..query.range[1].map_or(n, index).max(from + 1)
    }

    fn overlay(&self, channel: (&str, &str), query: &FigureQuery, error: bool) -> Drawing {
        let range = self.range(query);
        let columns = (query.width - 70.0).max(100.0) as usize;
        let rate = self.of.response.sample_rate_hz();
        let predicted = &self.of.response.channel(self.output)[range.clone()];
        let target = self.of.target_of(self.output).map(|target| &target[range.clone()]);
        let lines = match (error, target) {
            (true, Some(target)) => {
                let error: Vec<f64> = predicted.iter().zip(target).map(|(p, t)| p - t).collect();
                vec![("predicted minus measured", Envelope::of(&error, columns))]
            }
            (true, None) => {
                return Drawing::Nothing("The run it is compared with has no such channel.".into());
            }
            (false, Some(target)) => {
                vec![
                    ("measured", Envelope::of(target, columns)),
                    ("predicted", Envelope::of(predicted, columns)),
                ]
            }
            (false, None) => vec![("predicted", Envelope::of(predicted, columns))],
        };
        let range = [range.start as f64 / rate, range.end as f64 / rate];
        Overlay { channel, lines, spans: &self.of.trust.spans, range, width: query.width }.drawing()
    }

    fn spectra(&self, channel: (&str, &str), width: f64) -> std::result::Result<Drawing, EngineError> {
        let rate = self.of.response.sample_rate_hz();
        let welch = ErrorSettings::for_length(self.of.response.n_samples()).psd;
        let of = |samples: &[f64]| psd(&[&Signal::new(rate, vec![samples.to_vec()])?], &welch);
        let predicted = of(self.of.response.channel(self.output))?;
        let target = self.of.target_of(self.output).map(of).transpose()?;
        let mut lines = vec![("predicted", &predicted)];
        if let Some(target) = &target {
            lines.insert(0, ("measured", target));
        }
        Ok(ui::predict::spectra(channel, &lines, width))
    }

    fn counts(&self, channel: (&str, &str), width: f64) -> std::result::Result<Drawing, EngineError> {
        let predicted = self.of.response.channel(self.output);
        let target = self.of.target_of(self.output);
        let of = [DamageChannel { name: channel.0, predicted, target }];
        let report = counts_report(&of, &ClassSettings::default(), Residue::default())?;
        let counts = &report.channels[0].1;
        let mut tables = vec![("predicted", &counts.predicted)];
        if let Some(target) = &counts.target {
            tables.insert(0, ("measured", target));
        }
        Ok(ui::run::counted("range_pair", channel.0, channel.1, &tables, width))
    }

    fn loops(&self, query: &FigureQuery) -> Drawing {
        let (model, range) = (self.of.model.model(), self.range(query));
        let outputs = model.outputs.len();
        let names = self.axes.map(|place| {
            let name = if place < outputs { &model.outputs[place] } else { &model.inputs[place - outputs] };
            with_unit(name, unit(&self.of.rig, name))
        });
        let predicted = self.axes.map(|place| {
            let samples = match place.checked_sub(outputs) {
                None => self.of.response.channel(place),
                Some(input) => self.of.drive.channel(input),
            };
            samples[range.clone()].to_vec()
        });
        let measured = self.axes.map(|place| match place.checked_sub(outputs) {
            None => self.of.target_of(place).map(|target| target[range.clone()].to_vec()),
            Some(input) => Some(self.of.drive.channel(input)[range.clone()].to_vec()),
        });
        let [x, y] = predicted;
        let mut lines = vec![("predicted", x, y)];
        if let ([Some(x), Some(y)], true) = (measured, self.axes.iter().any(|place| *place < outputs)) {
            lines.insert(0, ("measured", x, y));
        }
        ui::predict::loops(names, lines, query.width)
    }
}

fn unit<'a>(rig: &'a Rig, channel: &str) -> &'a str {
    rig.channel(channel).map_or("", |channel| channel.unit.as_str())
}
