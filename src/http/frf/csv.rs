//! An FRF as a table: a row of names, a row of units, then one row per line.

use super::Units;
use super::arrays::{Arrays, Numbers};
use super::query::Part;
use crate::formats;
use crate::http::problem::{Answer, Problem};

/// Columns by name, unit and values.
#[derive(Default)]
struct Table {
    names: Vec<String>,
    units: Vec<String>,
    columns: Vec<Vec<f64>>,
}

impl Table {
    fn push(&mut self, name: String, unit: String, column: Vec<f64>) {
        self.names.push(name);
        self.units.push(unit);
        self.columns.push(column);
    }
}

/// Writes the table.
///
/// # Errors
/// None that a query can cause.
pub fn write(arrays: &Arrays<'_>, units: &Units) -> Answer<Vec<u8>> {
    let mut table = Table::default();
    for (part, numbers) in &arrays.parts {
        let width = arrays.axes(*part).iter().product::<usize>();
        for at in 0..width {
            let (of, unit) = place(arrays, units, *part, at);
            match numbers {
                Numbers::Real(values) => {
                    let column = values.iter().skip(at).step_by(width).copied().collect();
                    table.push(format!("{}{of}", part.as_str()), unit, column);
                }
                Numbers::Complex(values) => {
                    let column = || values.iter().skip(at).step_by(width);
                    table.push(format!("re{of}"), unit.clone(), column().map(|z| z.re).collect());
                    table.push(format!("im{of}"), unit, column().map(|z| z.im).collect());
                }
            }
        }
    }
    formats::csv::write(&table.names, Some(&table.units), &table.columns).map_err(Problem::internal)
}

/// Which channels a column is of, in brackets, and its unit.
fn place(arrays: &Arrays<'_>, units: &Units, part: Part, at: usize) -> (String, String) {
    let (inputs, outputs) = (&arrays.model.inputs, &arrays.model.outputs);
    let of_path = |to: &str, from: &str| format!("({to}/{from})");
    match part {
        Part::FreqHz => (String::new(), "Hz".into()),
        Part::Condition => Default::default(),
        Part::MultipleCoherence => (format!("({})", outputs[at]), String::new()),
        Part::H if arrays.inverse.is_some() => {
            let (i, o) = (at / outputs.len(), at % outputs.len());
            (of_path(&inputs[i], &outputs[o]), Units::ratio(&units.inputs[i], &units.outputs[o]))
        }
        Part::H | Part::Coherence | Part::Confidence => {
            let (o, i) = (at / inputs.len(), at % inputs.len());
            let unit = Units::ratio(&units.outputs[o], &units.inputs[i]);
            (of_path(&outputs[o], &inputs[i]), if part == Part::Coherence { String::new() } else { unit })
        }
    }
}
