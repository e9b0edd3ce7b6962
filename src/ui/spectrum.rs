//! Plots of power spectral densities.

use super::plot::{Axis, Figure, Key, Mark, Scale, Style};
use super::text::density_unit;

/// Decades below the largest density that a plot shows.
const DECADES: f64 = 6.0;

/// A spectrum: its lines in Hz, its densities, and how it is drawn.
pub(super) struct Density<'a> {
    pub freq_hz: &'a [f64],
    pub values: &'a [f64],
    pub style: Style,
    pub name: String,
}

/// Densities of one channel over frequency; the first gives the range of frequencies.
pub(super) fn densities(
    id: String,
    title: String,
    description: &str,
    unit: &str,
    drawn: Vec<Density<'_>>,
) -> Figure {
    let all = || drawn.iter().flat_map(|density| density.values).copied();
    let largest = all().fold(0.0, f64::max);
    let lowest = all().filter(|y| *y > 0.0).fold(f64::INFINITY, f64::min);
    let lowest = lowest.max(largest * 10.0_f64.powf(-DECADES));
    let freq_hz = drawn.first().map_or(&[][..], |first| first.freq_hz);
    let ends = [freq_hz.first(), freq_hz.last()].map(|f| f.copied().unwrap_or(1.0));
    let line = |density: Density<'_>| Mark::Line {
        x: density.freq_hz.to_vec(),
        y: density.values.to_vec(),
        style: density.style,
        name: density.name,
    };
    Figure {
        id,
        title,
        description: description.into(),
        size: (720.0, 280.0),
        x: (Axis::exact(Scale::Log, ends[0], ends[1]), "Frequency in Hz".into()),
        y: (
            Axis::around(Scale::Log, [lowest, largest]),
            format!("Power spectral density in {}", density_unit(unit)),
        ),
        key: Key::Ends,
        marks: drawn.into_iter().map(line).collect(),
    }
}
