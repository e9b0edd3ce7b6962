//! An FRF as JSON, piece by piece.

use std::io;
use std::vec::IntoIter;

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

/// The document in order.
#[derive(Debug)]
enum Piece {
    Text(Vec<u8>),
    /// All lines of the real numbers, the real or the imaginary parts of an array.
    Lines(Part, Component),
}

#[derive(Debug, Clone, Copy)]
enum Component {
    Real,
    Re,
    Im,
}

/// The pieces of the document.
#[derive(Debug)]
pub struct FrfDocument {
    arrays: Arrays,
    pieces: IntoIter<Piece>,
    /// The array that is being written, and its next line.
    begun: Option<(Part, Component, usize)>,
}

impl FrfDocument {
    /// The document of all parts.
    ///
    /// # Errors
    /// None that a query can cause.
    pub fn new(arrays: Arrays, units: &Units) -> Answer<Self> {
        let (model, frf, loaded) = (arrays.model(), arrays.frf()?, &arrays.loaded);
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
        let mut pieces = Vec::new();
        for part in &arrays.parts {
            let inverse = if *part == Part::H { arrays.inverse()? } else { None };
            let mut object = Object::new();
            let name = match (part, inverse) {
                (Part::Confidence, _) => {
                    object.add("level", &CONFIDENCE)?;
                    "confidence"
                }
                (_, Some(inverse)) => {
                    object.add("ridge", &inverse.ridge)?;
                    object.add("zero_outside_hz", &inverse.zero_outside_hz)?;
                    "inverse"
                }
                (part, None) => part.as_str(),
            };
            let text = document.field(name);
            let components: &[(&'static str, Component)] = match part {
                Part::H => &[("re", Component::Re), ("im", Component::Im)],
                Part::Confidence => &[("radius", Component::Real)],
                part => {
                    pieces.extend([Piece::Text(std::mem::take(text)), Piece::Lines(*part, Component::Real)]);
                    continue;
                }
            };
            for (name, component) in components {
                text.append(object.field(name));
                pieces.extend([Piece::Text(std::mem::take(text)), Piece::Lines(*part, *component)]);
            }
            text.append(&mut object.finish());
        }
        for part in &arrays.missing {
            document.add(part.as_str(), &None::<f64>)?;
        }
        pieces.push(Piece::Text(document.finish()));
        Ok(Self { arrays, pieces: pieces.into_iter(), begun: None })
    }

    /// The next lines of an array as JSON text.
    fn lines(&mut self, part: Part, component: Component, at: usize) -> io::Result<Vec<u8>> {
        let axes = self.arrays.axes(part);
        let (all, lines) = (&self.arrays.lines, self.arrays.piece(at, self.arrays.width(part)));
        let numbers = self.arrays.numbers(part, lines.clone())?;
        let numbers = match (&numbers, component) {
            (Numbers::Complex(values), Component::Im) => Of::Im(values),
            (Numbers::Complex(values), _) => Of::Re(values),
            (Numbers::Real(values), _) => Of::Real(values),
        };
        let mut text = serde_json::to_vec(&Nested { numbers, axes: &axes })?;
        // Its brackets are those of the whole array at the ends, and a comma between pieces.
        if at > all.start {
            text[0] = b',';
        }
        self.begun = (lines.end < all.end).then_some((part, component, lines.end));
        if self.begun.is_some() {
            text.pop();
        }
        Ok(text)
    }
}

impl Iterator for FrfDocument {
    type Item = io::Result<Vec<u8>>;

    fn next(&mut self) -> Option<io::Result<Vec<u8>>> {
        let (part, component, at) = match self.begun {
            Some(begun) => begun,
            None => match self.pieces.next()? {
                Piece::Text(text) => return Some(Ok(text)),
                Piece::Lines(part, component) => (part, component, self.arrays.lines.start),
            },
        };
        Some(self.lines(part, component, at))
    }
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
