//! The learning curve: errors against minutes of data.

use maud::{Markup, html};

use crate::domain::study::{ErrorAt, LearningCurveReport, OutputCurve};
use crate::ui::figures::Drawing;
use crate::ui::plot::{Axis, Figure, Key, Mark, Scale, Style};
use crate::ui::text::percent;
use crate::ui::words::{clamped, duration};

/// The error of each output with all data and with more.
pub(super) fn table(report: &LearningCurveReport) -> Markup {
    let at = |of: &ErrorAt| format!("{} ({} to {})", percent(of.error), percent(of.low), percent(of.high));
    html! {
        @if !report.outputs.is_empty() {
            div.wide { table {
                thead { tr { th { "Output" } th.number { "With all data" } th.number { "With more" } th.number { "More data" } } }
                tbody { @for output in &report.outputs { tr {
                    td { (clamped(&output.channel)) }
                    td.number { (at(&output.now)) }
                    td.number { (at(&output.then)) }
                    td.number { (duration(60.0 * (output.then.minutes - output.now.minutes))) }
                } } }
            } }
            p.soft { "In brackets the 90 % interval." }
        }
    }
}

/// Fits as dots and curves with their intervals; `outputs` are those of the fits.
pub(super) fn figure(report: &LearningCurveReport, outputs: &[String], size: (f64, f64)) -> Drawing {
    let mut marks: Vec<Mark> = Vec::new();
    for (place, curve) in report.outputs.iter().enumerate() {
        let style = Style::Series(place);
        let points: Vec<ErrorAt> = curve.curve.iter().copied().chain([curve.then]).collect();
        let x: Vec<f64> = points.iter().map(|at| at.minutes).collect();
        let of = |value: fn(&ErrorAt) -> f64| points.iter().map(|at| 100.0 * value(at)).collect::<Vec<f64>>();
        let name = curve.channel.clone();
        marks.push(Mark::Band {
            x: x.clone(),
            low: of(|at| at.low),
            high: of(|at| at.high),
            style,
            name: String::new(),
        });
        marks.push(Mark::Line { x, y: of(|at| at.error), style, name });
    }
    let names = if report.outputs.is_empty() { outputs.to_vec() } else { named(&report.outputs) };
    for (place, name) in names.iter().enumerate() {
        let Some(output) = outputs.iter().position(|known| known == name) else { continue };
        let known = || {
            report
                .fits
                .iter()
                .filter_map(move |fit| Some((fit.minutes, fit.rms.get(output).copied().flatten()?)))
        };
        marks.push(Mark::Dots {
            x: known().map(|(minutes, _)| minutes).collect(),
            y: known().map(|(_, error)| 100.0 * error).collect(),
            style: Style::Series(place),
            radius: 3.5,
            name: if report.outputs.is_empty() { name.clone() } else { format!("{name}, fits") },
        });
    }
    let of_fits =
        report.fits.iter().flat_map(|fit| fit.rms.iter().flatten().map(|error| (fit.minutes, *error)));
    let of_curves = report
        .outputs
        .iter()
        .flat_map(|curve| curve.curve.iter().chain([&curve.then]))
        .flat_map(|at| [(at.minutes, at.low), (at.minutes, at.high)]);
    let all: Vec<(f64, f64)> = of_fits.chain(of_curves).collect();
    if all.is_empty() {
        return Drawing::Nothing("No fit has an error yet.".into());
    }
    Figure {
        id: "errors".into(),
        title: "Error against minutes of data".into(),
        description: "RMS error of each output: fits, and the curve through them with its interval".into(),
        size,
        x: (Axis::around(Scale::Linear, all.iter().map(|(minutes, _)| *minutes)), "Minutes of data".into()),
        y: (Axis::around(Scale::Linear, all.iter().map(|(_, error)| 100.0 * error)), "RMS error in %".into()),
        key: Key::Above,
        marks,
    }
    .into()
}

fn named(curves: &[OutputCurve]) -> Vec<String> {
    curves.iter().map(|curve| curve.channel.clone()).collect()
}
