//! The missing effect as a force, or as a change of drive or sensor.

use maud::{Markup, html};

use super::{figure, heading, quiet};
use crate::engine::diagnosis::views::{Argument, ForceView, Path};
use crate::engine::diagnosis::{Report, Views};
use crate::ui::plot::{Axis, Figure, Key, Mark, Scale, Style};

/// Number of groups of points whose mean is drawn.
const GROUPS: usize = 24;
/// Fewest points of a group.
const ENOUGH: usize = 8;

/// The section; empty where there is no gap.
pub fn section(report: &Report, views: &Views) -> Markup {
    let Some((view, over)) = shown(report, views) else { return html! {} };
    html! {
        (heading("force", title(view.path)))
        p { (explained(view)) }
        div class=(if over.len() > 1 { "pair" } else { "" }) {
            @for argument in over { (figure(&plot(view, *argument, over.len() > 1).svg(), &caption(view, *argument))) }
        }
    }
}

/// The plots of the section.
pub fn figures(report: &Report, views: &Views) -> Vec<Figure> {
    let Some((view, over)) = shown(report, views) else { return Vec::new() };
    over.iter().map(|argument| plot(view, *argument, over.len() > 1)).collect()
}

/// The force and what it is drawn over.
fn shown<'a>(report: &Report, views: &'a Views) -> Option<(&'a ForceView, &'static [Argument])> {
    let view = views.force.as_ref().filter(|_| !quiet(report.verdict.kind))?;
    let over: &[Argument] = match view.path {
        Path::Force => &[Argument::Response, Argument::Velocity],
        Path::Drive => &[Argument::Drive],
        Path::Sensor => &[Argument::Response],
    };
    Some((view, over))
}

fn title(path: Path) -> &'static str {
    match path {
        Path::Force => "The missing force",
        Path::Drive => "The missing part of the drive",
        Path::Sensor => "The missing part of the sensor",
    }
}

fn explained(view: &ForceView) -> String {
    match view.path {
        Path::Force => format!(
            "The gap of {} on the unseen runs, worked back to the force that would cause it. Its size is given as the change of {} that would move the response as much. The dots come from the measurement alone.",
            view.channel, view.drive
        ),
        Path::Drive => format!(
            "The gap of {} on the unseen runs, worked back to the change of {} that would cause it. The dots come from the measurement alone.",
            view.channel, view.drive
        ),
        Path::Sensor => format!(
            "The change of the model's {} that would remove the gap on the unseen runs. The dots come from the measurement alone.",
            view.channel
        ),
    }
}

fn caption(view: &ForceView, over: Argument) -> Markup {
    let law = view.law.as_ref().is_some_and(|law| law.over == over);
    html! {
        b { "Over " (match over {
            Argument::Response => "the response",
            Argument::Velocity => "its velocity",
            Argument::Drive => "the drive",
        }) ". " }
        @if law { "The line is the fitted law." }
        @else if view.law.is_none() && view.fitted.is_some() { "The coloured dots are the fitted law, which depends on the past and is therefore not a single line." }
        @else { "Large dots are means of the cloud." }
    }
}

fn plot(view: &ForceView, over: Argument, half: bool) -> Figure {
    let (at, name) = match over {
        Argument::Response => (&view.response, format!("{} in {}", view.channel, view.channel_unit)),
        Argument::Velocity => {
            (&view.velocity, format!("Velocity of {} in {}/s", view.channel, view.channel_unit))
        }
        Argument::Drive => (&view.drive_at, format!("{} in {}", view.drive, view.drive_unit)),
    };
    let law = view.law.as_ref().filter(|law| law.over == over);
    let x = Axis::around(Scale::Linear, at.iter().copied());
    let dots = |y: &[f64], style, radius, name: &str| Mark::Dots {
        x: at.clone(),
        y: y.to_vec(),
        style,
        radius,
        name: name.into(),
    };
    let mut marks = vec![dots(&view.force, Style::Noise, 1.1, "measured")];
    if view.law.is_none() {
        marks.extend(view.fitted.iter().map(|y| dots(y, Style::After, 1.1, "fitted")));
    }
    marks.extend(law.map(|law| Mark::Line {
        x: law.at.clone(),
        y: law.value.clone(),
        style: Style::After,
        name: "fitted law".into(),
    }));
    let (mean_x, mean_y) = means(at, &view.force);
    marks.push(Mark::Dots { x: mean_x, y: mean_y, style: Style::Measured, radius: 2.6, name: "mean".into() });
    let values = view.force.iter().chain(law.iter().flat_map(|l| &l.value)).copied();
    let word = if view.path == Path::Force { "Force" } else { "Change" };
    Figure {
        id: format!(
            "force-{}",
            match over {
                Argument::Response => "response",
                Argument::Velocity => "velocity",
                Argument::Drive => "drive",
            }
        ),
        title: format!("{word} that is missing, over {name}"),
        description: "A cloud of missing values from the measurement, their means, and the fitted law."
            .into(),
        size: if half { (350.0, 290.0) } else { (720.0, 320.0) },
        x: (x, name),
        y: (Axis::around(Scale::Linear, values), format!("{word} in {}", view.unit)),
        key: Key::Above,
        marks,
    }
}

/// Means of groups of neighbouring points.
fn means(x: &[f64], y: &[f64]) -> (Vec<f64>, Vec<f64>) {
    let low = x.iter().copied().fold(f64::INFINITY, f64::min);
    let high = x.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let mut sums = vec![(0usize, 0.0, 0.0); GROUPS];
    for (x, y) in x.iter().zip(y) {
        let group = ((x - low) / (high - low).max(f64::MIN_POSITIVE) * GROUPS as f64) as usize;
        let sum = &mut sums[group.min(GROUPS - 1)];
        *sum = (sum.0 + 1, sum.1 + x, sum.2 + y);
    }
    sums.into_iter().filter(|s| s.0 >= ENOUGH).map(|(n, x, y)| (x / n as f64, y / n as f64)).unzip()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn means_of_a_line_lie_on_it_and_thin_groups_are_left_out() {
        let x: Vec<f64> = (0..600).map(|k| f64::from(k) / 100.0).chain([50.0]).collect();
        let y: Vec<f64> = x.iter().map(|x| 2.0 * x).collect();
        let (mean_x, mean_y) = means(&x, &y);
        assert!(mean_x.len() == 3 && mean_x.iter().zip(&mean_y).all(|(x, y)| (y - 2.0 * x).abs() < 1e-9));
        assert!(means(&[1.0; 20], &[3.0; 20]).1 == [3.0]);
    }
}
