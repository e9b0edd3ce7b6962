//! An FRF as JSON.

use realfft::num_complex::Complex64;
use serde::ser::SerializeSeq;
use serde::{Serialize, Serializer};

use super::Units;
use super::arrays::{Arrays, CONFIDENCE, Numbers};
use super::query::Part;
use crate::domain::model::NO_COHERENCE;
use crate::engine::frf::{FrfQuality, FrfSettings};
use crate::engine::model::VersionKind;
use crate::http::body::json::Object;
use crate::http::problem::Answer;
use crate::models::LoadedModel;

/// Which model answers.
#[derive(Serialize)]
struct Source<'a> {
    version: u32,
    kind: VersionKind,
    sha256: &'a str,
}

/// A value of each input and each output, in order.
#[derive(Serialize)]
struct Both<'a, T> {
    inputs: &'a [T],
    outputs: &'a [T],
}

/// How the FRF was estimated.
#[derive(Serialize)]
struct Estimate<'a> {
    #[serde(flatten)]
    settings: &'a FrfSettings,
    window: &'static str,
    averages: usize,
    effective_averages: f64,
    /// Stretches that all inputs excite, first and last line of each.
    excited_hz: Vec<[f64; 2]>,
    /// Of each input, in order.
    input_hz: &'a [[f64; 2]],
}

impl<'a> Estimate<'a> {
    fn of(quality: &'a FrfQuality, df_hz: f64) -> Self {
        Self {
            settings: &quality.settings,
            window: "hann",
            averages: quality.averages,
            effective_averages: quality.effective_averages,
            excited_hz: quality.excited.iter().map(|span| span.map(|line| line as f64 * df_hz)).collect(),
            input_hz: &quality.input_hz,
        }
    }
}

/// `H`: real and imaginary parts.
#[derive(Serialize)]
struct Parts<'a> {
    re: Nested<'a>,
    im: Nested<'a>,
}

#[derive(Serialize)]
struct InverseParts<'a> {
    ridge: f64,
    zero_outside_hz: [f64; 2],
    #[serde(flatten)]
    parts: Parts<'a>,
}

#[derive(Serialize)]
struct Confidence<'a> {
    level: f64,
    radius: Nested<'a>,
}

/// Writes the document.
///
/// # Errors
/// None that a query can cause.
pub fn write(arrays: &Arrays<'_>, units: &Units, loaded: &LoadedModel) -> Answer<Vec<u8>> {
    let (model, frf) = (arrays.model, arrays.frf);
    let quality = model.frf_quality.as_ref();
    let mut document = Object::new();
    let source = Source { version: loaded.version, kind: model.version_kind(), sha256: &loaded.sha256 };
    document.add("model", &source)?;
    document.add("inputs", &model.inputs)?;
    document.add("outputs", &model.outputs)?;
    document.add("units", &Both { inputs: &units.inputs, outputs: &units.outputs })?;
    document.add("sample_rate_hz", &frf.sample_rate_hz)?;
    document.add("segment_len", &frf.segment_len)?;
    document.add("usable_hz", &frf.usable_hz)?;
    document.add("working_point", &Both { inputs: &frf.x_mean, outputs: &frf.y_mean })?;
    document.add("estimate", &quality.map(|quality| Estimate::of(quality, frf.df_hz())))?;
    document.add("reason", &quality.is_none().then_some(NO_COHERENCE))?;
    for (part, numbers) in &arrays.parts {
        let axes = arrays.axes(*part);
        match numbers {
            Numbers::Real(values) => {
                let nested = Nested { numbers: Of::Real(values), axes: &axes };
                match part {
                    Part::Confidence => {
                        document.add("confidence", &Confidence { level: CONFIDENCE, radius: nested })?;
                    }
                    part => document.add(part.as_str(), &nested)?,
                }
            }
            Numbers::Complex(values) => {
                let nested = |numbers| Nested { numbers, axes: &axes };
                let parts = Parts { re: nested(Of::Re(values)), im: nested(Of::Im(values)) };
                match arrays.inverse {
                    None => document.add("h", &parts)?,
                    Some(inverse) => {
                        let (ridge, zero_outside_hz) = (inverse.ridge, inverse.zero_outside_hz);
                        document.add("inverse", &InverseParts { ridge, zero_outside_hz, parts })?;
                    }
                }
            }
        }
    }
    for part in &arrays.missing {
        document.add(part.as_str(), &None::<f64>)?;
    }
    Ok(document.finish())
}

#[derive(Clone, Copy)]
enum Of<'a> {
    Real(&'a [f64]),
    Re(&'a [Complex64]),
    Im(&'a [Complex64]),
}

impl<'a> Of<'a> {
    fn len(self) -> usize {
        match self {
            Self::Real(values) => values.len(),
            Self::Re(values) | Self::Im(values) => values.len(),
        }
    }

    fn slice(self, from: usize, len: usize) -> Self {
        match self {
            Self::Real(values) => Self::Real(&values[from..from + len]),
            Self::Re(values) => Self::Re(&values[from..from + len]),
            Self::Im(values) => Self::Im(&values[from..from + len]),
        }
    }

    fn at(self, i: usize) -> f64 {
        match self {
            Self::Real(values) => values[i],
            Self::Re(values) => values[i].re,
            Self::Im(values) => values[i].im,
        }
    }
}

/// Numbers as arrays in arrays: lines, and each of the further axes.
struct Nested<'a> {
    numbers: Of<'a>,
    /// Lengths of the axes after the lines.
    axes: &'a [usize],
}

impl Serialize for Nested<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let inside: usize = self.axes.iter().product();
        let mut seq = serializer.serialize_seq(Some(self.numbers.len() / inside))?;
        for first in (0..self.numbers.len()).step_by(inside) {
            match self.axes.split_first() {
                None => seq.serialize_element(&self.numbers.at(first))?,
                Some((_, axes)) => {
                    seq.serialize_element(&Nested { numbers: self.numbers.slice(first, inside), axes })?;
                }
            }
        }
        seq.end()
    }
}
