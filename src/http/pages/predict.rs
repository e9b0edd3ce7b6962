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
use crate::ui::predict::{Choice, Overlay, RatioRow, Result};
use crate::ui::run::with_unit;

const FIGURES: &str = "overlay, error, damage_ratio, multi_rain, psd, range_pair or loop";

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
    let group = params.parse::<usize>("group", "the place of a group")?.unwrap_or_default();
    params.finish()?;
    let rig = find(&http, &id).await?;
    let compared = match drive {
        Some(drive) => Some(compare(&http, &id, model, drive, target).await?),
        None => None,
    };
    let view = match &compared {
        Some(compared) => Some(View::of(compared, output, axes, group)?),
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
    group: usize,
}

impl View {
    fn of(of: &Arc<Comparison>, output: usize, axes: [Option<usize>; 2], group: usize) -> Answer<Self> {
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
        let groups = of.damage.groups.len();
        if group > 0 && group >= groups {
            return Err(invalid("group", format!("is {group}"), &format!("below {groups}")));
        }
        Ok(Self { of: Arc::clone(of), output, axes, group })
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
            no_band: of.band.as_ref().err().copied(),
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
            Some("damage_ratio") => Ok(self.damage_ratios()),
            Some("multi_rain") => self.multi_rain(),
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
        let half_width =
            self.of.band.as_ref().ok().map(|band| &band.half_width.channel(self.output)[range.clone()]);
        let (centre, lines) = match (error, target) {
            (true, Some(target)) => {
                let error: Vec<f64> = predicted.iter().zip(target).map(|(p, t)| p - t).collect();
                (None, vec![("predicted minus measured", Envelope::of(&error, columns))])
            }
            (true, None) => {
                return Drawing::Nothing("The run it is compared with has no such channel.".into());
            }
            (false, Some(target)) => {
                let measured = ("measured", Envelope::of(target, columns));
                (Some(predicted), vec![measured, ("predicted", Envelope::of(predicted, columns))])
            }
            (false, None) => (Some(predicted), vec![("predicted", Envelope::of(predicted, columns))]),
        };
        let band = half_width.map(|half_width| band(centre, half_width, columns));
        let range = [range.start as f64 / rate, range.end as f64 / rate];
        let (id, spans) = (if error { "error" } else { "overlay" }, &self.of.trust.spans[..]);
        Overlay { id, channel, lines, band, spans, range, width: query.width }.drawing()
    }

    fn damage_ratios(&self) -> Drawing {
        let of = &*self.of;
        let row = |name: String, ratio: Option<f64>, interval| RatioRow {
            name,
            value: ratio,
            other: None,
            interval,
        };
        let channels = of.damage.channels.iter().enumerate().filter_map(|(output, (name, damage))| {
            let target = damage.target?;
            let within =
                of.band.as_ref().ok().map(|band| band.damage[output].map(|damage| damage / target.target));
            Some(row(name.clone(), target.ratio.ratio, within.filter(|_| target.ratio.ratio.is_some())))
        });
        let groups = of.damage.groups.iter().filter_map(|(name, damage)| {
            Some(row(format!("Multi-Rain of {name}"), damage.target?.ratio.ratio, None))
        });
        ui::predict::damage_ratios(channels.chain(groups).collect())
    }

    fn multi_rain(&self) -> Answer<Drawing> {
        let model = self.of.model.model();
        Ok(match self.of.directions()?.get(self.group) {
            Some(group) => {
                let axes = group.outputs.map(|output| model.outputs[output].clone());
                let damages = (group.predicted.clone(), group.target.clone());
                ui::predict::multi_rain((self.group, &group.name), axes, damages)
            }
            None => Drawing::Nothing("The model predicts no whole group of three channels.".into()),
        })
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

/// Extremes of a band in each column; without a centre that of the error, about zero.
fn band(centre: Option<&[f64]>, half_width: &[f64], columns: usize) -> Envelope {
    let centre = |t: usize| centre.map_or(0.0, |centre| centre[t]);
    let edge = |sign: f64| {
        let samples: Vec<f64> = half_width.iter().enumerate().map(|(t, h)| centre(t) + sign * h).collect();
        Envelope::of(&samples, columns)
    };
    Envelope { low: edge(-1.0).low, high: edge(1.0).high }
}

fn unit<'a>(rig: &'a Rig, channel: &str) -> &'a str {
    rig.channel(channel).map_or("", |channel| channel.unit.as_str())
}
