//! An FRF as a table, piece by piece: a row of names, a row of units, then one row per line.

use std::io;

use super::Units;
use super::arrays::{Arrays, Numbers};
use super::query::Part;
use crate::formats;
use crate::http::problem::{Answer, Problem};

/// The pieces of the table.
#[derive(Debug)]
pub struct FrfTable {
    arrays: Arrays,
    head: Vec<u8>,
    columns: usize,
    /// The next line.
    at: usize,
}

impl FrfTable {
    /// The table of all parts.
    ///
    /// # Errors
    /// None that a query can cause.
    pub fn new(arrays: Arrays, units: &Units) -> Answer<Self> {
        let (mut names, mut units_row) = (Vec::new(), Vec::new());
        for part in &arrays.parts {
            for at in 0..arrays.width(*part) {
                let (of, unit) = place(&arrays, units, *part, at);
                let columns: &[&str] = if *part == Part::H { &["re", "im"] } else { &[part.as_str()] };
                for column in columns {
                    names.push(format!("{column}{of}"));
                    units_row.push(unit.clone());
                }
            }
        }
        let columns = names.len();
        let head = formats::csv::head(&names, Some(&units_row), columns).map_err(Problem::internal)?;
        let at = arrays.lines.start;
        Ok(Self { arrays, head, columns, at })
    }

    fn piece(&mut self) -> io::Result<Vec<u8>> {
        let lines = self.arrays.piece(self.at, self.columns);
        let mut columns: Vec<Vec<f64>> = Vec::with_capacity(self.columns);
        for part in &self.arrays.parts {
            let width = self.arrays.width(*part);
            let numbers = self.arrays.numbers(*part, lines.clone())?;
            for at in 0..width {
                match &numbers {
                    Numbers::Real(values) => {
                        columns.push(values.iter().skip(at).step_by(width).copied().collect());
                    }
                    Numbers::Complex(values) => {
                        let column = || values.iter().skip(at).step_by(width);
                        columns.push(column().map(|z| z.re).collect());
                        columns.push(column().map(|z| z.im).collect());
                    }
                }
            }
        }
        self.at = lines.end;
        let mut text = std::mem::take(&mut self.head);
        formats::csv::rows(&mut text, &columns.iter().map(Vec::as_slice).collect::<Vec<_>>());
        Ok(text)
    }
}

impl Iterator for FrfTable {
    type Item = io::Result<Vec<u8>>;

    fn next(&mut self) -> Option<io::Result<Vec<u8>>> {
        (self.at < self.arrays.lines.end).then(|| self.piece())
    }
}

/// Which channels a column is of, in brackets, and its unit.
fn place(arrays: &Arrays, units: &Units, part: Part, at: usize) -> (String, String) {
    let (inputs, outputs) = (&arrays.model().inputs, &arrays.model().outputs);
    let of_path = |to: &str, from: &str| format!("({to}/{from})");
    match part {
        Part::FreqHz => (String::new(), "Hz".into()),
        Part::Condition => Default::default(),
        Part::MultipleCoherence => (format!("({})", outputs[at]), String::new()),
        Part::H if arrays.is_inverse() => {
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
