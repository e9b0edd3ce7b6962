//! A report as one long table: a row for each figure, so that a spreadsheet filters the part that it draws.

use std::io;

use crate::domain::ModelReport;

/// Columns. `at` is the epoch, the frequency in Hz, the lag in s or the number of the class that the figure belongs to.
const HEAD: [&str; 5] = ["part", "name", "quantity", "at", "value"];

/// The table as it is written.
struct Table(csv::Writer<Vec<u8>>);

impl Table {
    fn add(&mut self, part: &str, name: &str, quantity: &str, at: Option<f64>, value: f64) -> io::Result<()> {
        let at = at.map_or_else(String::new, |at| at.to_string());
        Ok(self.0.write_record([part, name, quantity, &at, &value.to_string()])?)
    }
}

/// Writes the table. A part that is absent, and a figure that is not known, has no row.
///
/// # Errors
/// None: memory takes what is written.
pub fn write(report: &ModelReport<'_>) -> io::Result<Vec<u8>> {
    let mut table = Table(csv::Writer::from_writer(Vec::new()));
    table.0.write_record(HEAD)?;
    for error in report.errors.iter().flatten() {
        if let Some(rms) = error.rms {
            table.add("errors", error.channel, "rms", None, rms)?;
        }
    }
    for seed in report.training.iter().flat_map(|training| &training.seeds) {
        let name = format!("seed {}", seed.seed);
        for (quantity, values) in [("training_mse", &seed.training), ("stopping_mse", &seed.stopping)] {
            for (epoch, value) in seed.epochs.iter().zip(values) {
                table.add("training", &name, quantity, Some(*epoch as f64), *value)?;
            }
        }
    }
    residual(&mut table, report)?;
    for input in report.coverage.iter().flatten() {
        let of = input.coverage;
        let [slowest, fastest] = of.rate;
        let mut figures = vec![("min", of.min), ("max", of.max), ("mean", of.mean), ("rms", of.rms)];
        figures.extend([("rate_min_per_s", slowest), ("rate_max_per_s", fastest)]);
        figures.extend(
            of.band_hz.into_iter().flat_map(|[from, to]| [("band_from_hz", from), ("band_to_hz", to)]),
        );
        for (quantity, value) in figures {
            table.add("coverage", input.channel, quantity, None, value)?;
        }
        for (class, share) in of.shares.iter().enumerate() {
            table.add("coverage", input.channel, "share", Some((class + 1) as f64), *share)?;
        }
    }
    table.0.into_inner().map_err(|error| io::Error::other(error.to_string()))
}

fn residual(table: &mut Table, report: &ModelReport<'_>) -> io::Result<()> {
    let Some(residual) = report.residual else { return Ok(()) };
    if let Some(spectra) = &residual.spectra {
        for (channel, spectrum) in &spectra.channels {
            for (quantity, values) in [("measured", &spectrum.measured), ("residual", &spectrum.residual)] {
                for (hz, value) in spectra.freq_hz.iter().zip(values) {
                    table.add("spectra", channel, quantity, Some(*hz), *value)?;
                }
            }
        }
    }
    let lags = &residual.autocorrelation;
    for (channel, values) in &lags.channels {
        for (lag, value) in values.iter().flatten().enumerate() {
            let at = (lag + 1) as f64 * lags.lag_s;
            table.add("autocorrelation", channel, "residual", Some(at), *value)?;
        }
    }
    Ok(())
}
