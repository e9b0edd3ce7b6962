//! The linear study: errors against the number of files, one line a network.

use maud::{Markup, html};

use crate::domain::study::{LinearFit, LinearStudyReport};
use crate::ui::plot::{Axis, Figure, Key, Mark, Scale, Style, picture};
use crate::ui::text::percent;
use crate::ui::words::duration;

/// The errors of a linear study against its files, one line a network, as an SVG file.
pub fn linear_study_svg(fits: &[LinearFit]) -> String {
    picture(figure(fits).svg())
}

/// Every fit.
pub(super) fn table(report: &LinearStudyReport) -> Markup {
    html! {
        div.wide { table {
            thead { tr { th { "Cells" } th.number { "Weights" } th.number { "Files" } th.number { "Data" } th.number { "Error" } th { "" } } }
            tbody { @for fit in &report.fits { tr {
                td { (net(&fit.net)) }
                td.number { (fit.parameters) }
                td.number { (fit.files) }
                td.number { (duration(60.0 * fit.minutes)) }
                td.number { (fit.error.map_or_else(|| "–".into(), percent)) }
                td.soft { (fit.reason.as_deref().unwrap_or_default()) }
            } } }
        } }
    }
}

fn net(cells: &[usize]) -> String {
    format!("{{{}}}", cells.iter().map(usize::to_string).collect::<Vec<_>>().join(","))
}

pub(super) fn figure(fits: &[LinearFit]) -> Figure {
    let mut nets: Vec<&Vec<usize>> = Vec::new();
    for one in fits {
        if !nets.contains(&&one.net) {
            nets.push(&one.net);
        }
    }
    let known = || fits.iter().filter(|one| one.error.is_some_and(|error| error > 0.0));
    let percent = |one: &LinearFit| 100.0 * one.error.unwrap_or_default();
    let line = |(number, cells): (usize, &&Vec<usize>)| {
        let of_net: Vec<&LinearFit> = known().filter(|one| one.net == **cells).collect();
        Mark::Line {
            x: of_net.iter().map(|one| one.files as f64).collect(),
            y: of_net.iter().map(|one| percent(one)).collect(),
            style: Style::Series(number),
            name: net(cells),
        }
    };
    Figure {
        id: "linear-study".into(),
        title: "Linear study".into(),
        description: "RMS error of each network against the number of training files".into(),
        size: (640.0, 360.0),
        x: (Axis::around(Scale::Log, known().map(|one| one.files as f64)), "training files".into()),
        y: (Axis::around(Scale::Log, known().map(percent)), "RMS error in %".into()),
        key: Key::Ends,
        marks: nets.iter().enumerate().map(line).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_network_has_a_line_of_its_own() {
        let fit = |net: &[usize], files: usize, error: Option<f64>| LinearFit {
            net: net.to_vec(),
            parameters: 1,
            files,
            minutes: 3.0,
            error,
            rms: Vec::new(),
            reason: None,
        };
        let fits = [
            fit(&[10], 3, Some(0.1)),
            fit(&[23, 23], 3, Some(0.12)),
            fit(&[10], 6, Some(0.08)),
            fit(&[23, 23], 6, Some(0.06)),
            fit(&[39], 6, None),
        ];
        let svg = linear_study_svg(&fits);
        assert!(svg.contains("{10}") && svg.contains("{23,23}"), "{svg}");
        assert_eq!(svg.matches("<path class=\"line").count(), 3);
        assert!(!svg.contains("NaN") && !svg.contains("inf"));
    }
}
