//! Models as safetensors files.
//!
//! Tensors: `frf.freq_hz [line]`, `frf.re`, `frf.im [line, output, input]`, optionally
//! `frf.x_mean`, `frf.y_mean`; with the metadata block `frf` the quality of its estimate,
//! `frf.coherence [line, output, input]`, `frf.multiple_coherence [line, output]`,
//! `frf.condition [line]`, `frf.std_error [line, output, input]`; per block i `lstm.{i}.weight_ih [4 cells, inputs]`,
//! `lstm.{i}.weight_hh [4 cells, cells]`, `lstm.{i}.bias [4 cells]` in gate order i, f, g, o;
//! `fc.weight [outputs, cells]`, `fc.bias`; `x.mean`, `x.std`, `y.mean`, `y.std`; per effect i that was found by transfer
//! `effects.{i}.taps [taps]`, or `core.{i}.taps` of a core: its impulse responses, one after the other.
//! PyTorch's own names (`lstm.weight_ih_l0`, two biases) are read too. The metadata key `rigcast`
//! holds the JSON of [`Metadata`]. F32 and F64 tensors are read; spectra are written as F64.

use std::collections::HashMap;

use realfft::num_complex::Complex64;
use safetensors::tensor::{Dtype, SafeTensorError, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};

use super::effect::MAX_EFFECTS;
use super::{
    AddedEffect, Band, InputRange, JointRange, LocalRange, LstmPart, ModelKind, Preprocess, RigModel, Scaler,
    VersionKind, WindowRange,
};
use crate::EngineError;
use crate::frf::{Frf, FrfQuality, FrfSettings};
use crate::lstm::{LstmBlock, LstmNet, Recombine};
use crate::wording::plain;

/// Version of names and meanings in the file.
const SCHEMA: u32 = 1;

/// Longest header that is read, far above the names and shapes of any model. A parsed header takes up to
/// fifty times its size in memory.
const MAX_HEADER_BYTES: u64 = 1 << 20;

/// Bound on sizes read from a file, far above any sensible network.
const MAX_CHANNELS: usize = 128;

/// Samples of the longest window over which trust looks at means and levels.
const MAX_WINDOW: usize = 4096;

/// The metadata block, JSON under the key `rigcast`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Metadata {
    schema: u32,
    kind: VersionKind,
    /// Kind `adopted`: the model beneath the effects, whose tensors the file holds. Files of before that
    /// kind name the base's in its place.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    base: Option<Base>,
    inputs: Vec<String>,
    outputs: Vec<String>,
    sample_rate_hz: f64,
    /// Needed where there is an LSTM.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    window_len: Option<usize>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    hop: Option<usize>,
    /// Left out: `welch`, the paper's way.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    recombine: Option<Recombine>,
    #[serde(default)]
    preprocess: Preprocess,
    /// Band that the FRF's data excited; left out: all lines.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    usable_hz: Option<[f64; 2]>,
    /// How the FRF was estimated; left out: unknown.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    frf: Option<FrfMetadata>,
    /// Range of the inputs in the training data, for trust; left out: unknown.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    range: Vec<InputRange>,
    /// Range of the FRF's response at each output over windows of the training data, without an FRF of each input; left out:
    /// unknown.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    window_range: Vec<WindowRange>,
    /// Range of the means of all inputs together; left out: unknown.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    joint_range: Option<JointRange>,
    /// The band about predictions; left out: unknown.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    band: Option<Band>,
    /// Hybrids: effects on the FRF, which together take its place.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    core: Option<Core>,
    /// Effects that diagnoses found.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    effects: Vec<AddedEffect>,
}

/// The core in place of a hybrid's FRF, whose tensors the file holds.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Core {
    effects: Vec<AddedEffect>,
}

/// The model beneath adopted effects.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Base {
    kind: ModelKind,
}

impl Metadata {
    /// Kind of the model whose tensors the file holds.
    fn model_kind(&self) -> Result<ModelKind, EngineError> {
        match (ModelKind::try_from(self.kind), &self.base) {
            (Ok(kind), None) => Ok(kind),
            (Ok(kind), Some(_)) => {
                Err(wrong(format!("base: only kind adopted has one, this is {}", kind.as_str())))
            }
            (Err(_), None) => Err(wrong("base is missing: kind adopted names that of the model beneath")),
            (Err(_), Some(_)) if self.effects.is_empty() => {
                Err(wrong("effects: kind adopted has at least one"))
            }
            (Err(_), Some(base)) => Ok(base.kind),
        }
    }
}

/// How an FRF was estimated: the part of [`FrfQuality`] that is no tensor.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct FrfMetadata {
    settings: FrfSettings,
    averages: usize,
    effective_averages: f64,
    /// Lines, first and last of each stretch.
    excited: Vec<[usize; 2]>,
    input_hz: Vec<[f64; 2]>,
}

/// Serialises a model; the same model always gives the same bytes.
pub fn to_safetensors(model: &RigModel) -> Vec<u8> {
    let mut tensors: Vec<(String, Dtype, Vec<usize>, Vec<u8>)> = Vec::new();
    let mut f64s = |name: &str, shape: Vec<usize>, values: &mut dyn Iterator<Item = f64>| {
        tensors.push((name.into(), Dtype::F64, shape, values.flat_map(f64::to_le_bytes).collect()));
    };
    let (mut effects, mut core) = (model.effects.clone(), model.core.clone());
    for (what, effects) in [("effects", &mut effects), ("core", &mut core)] {
        for (i, effect) in effects.iter_mut().enumerate() {
            let taps = effect.augmented.detach_taps();
            if !taps.is_empty() {
                f64s(&taps_of(what, i), vec![taps.len()], &mut taps.iter().copied());
            }
        }
    }
    if let Some(frf) = &model.frf {
        let lines = frf.segment_len / 2 + 1;
        let shape = vec![lines, frf.n_outputs, frf.n_inputs];
        let df_hz = frf.sample_rate_hz / frf.segment_len as f64;
        f64s("frf.freq_hz", vec![lines], &mut (0..lines).map(|l| l as f64 * df_hz));
        f64s("frf.re", shape.clone(), &mut frf.h.iter().map(|h| h.re));
        f64s("frf.im", shape, &mut frf.h.iter().map(|h| h.im));
        f64s("frf.x_mean", vec![frf.n_inputs], &mut frf.x_mean.iter().copied());
        f64s("frf.y_mean", vec![frf.n_outputs], &mut frf.y_mean.iter().copied());
        if let Some(quality) = &model.frf_quality {
            let (lines, outputs) = (frf.n_lines(), frf.n_outputs);
            let full = vec![lines, outputs, frf.n_inputs];
            let mut all = |name: &str, shape: Vec<usize>, values: &[f64]| {
                f64s(name, shape, &mut values.iter().copied());
            };
            all("frf.coherence", full.clone(), &quality.coherence);
            all("frf.multiple_coherence", vec![lines, outputs], &quality.multiple_coherence);
            all("frf.condition", vec![lines], &quality.condition);
            all("frf.std_error", full, &quality.std_error);
        }
    }
    if let Some(lstm) = &model.lstm {
        for (axis, scaler) in [("x", &lstm.x), ("y", &lstm.y)] {
            let n = scaler.mean.len();
            f64s(&format!("{axis}.mean"), vec![n], &mut scaler.mean.iter().copied());
            f64s(&format!("{axis}.std"), vec![n], &mut scaler.std.iter().copied());
        }
        let mut f32s = |name: String, shape: Vec<usize>, values: &[f32]| {
            tensors.push((
                name,
                Dtype::F32,
                shape,
                values.iter().copied().flat_map(f32::to_le_bytes).collect(),
            ));
        };
        for (i, block) in lstm.net.blocks.iter().enumerate() {
            let gates = 4 * block.cells;
            f32s(format!("lstm.{i}.weight_ih"), vec![gates, block.inputs], &block.weight_ih);
            f32s(format!("lstm.{i}.weight_hh"), vec![gates, block.cells], &block.weight_hh);
            f32s(format!("lstm.{i}.bias"), vec![gates], &block.bias);
        }
        let cells = lstm.net.blocks.last().map_or(0, |b| b.cells);
        f32s("fc.weight".into(), vec![lstm.net.outputs, cells], &lstm.net.fc_weight);
        f32s("fc.bias".into(), vec![lstm.net.outputs], &lstm.net.fc_bias);
    }
    let metadata = Metadata {
        schema: SCHEMA,
        kind: model.version_kind(),
        base: (!model.effects.is_empty()).then_some(Base { kind: model.kind }),
        inputs: model.inputs.clone(),
        outputs: model.outputs.clone(),
        sample_rate_hz: model.sample_rate_hz,
        window_len: model.lstm.as_ref().map(|l| l.window_len),
        hop: model.lstm.as_ref().map(|l| l.hop),
        recombine: model.lstm.as_ref().map(|l| l.recombine),
        preprocess: model.preprocess,
        usable_hz: model.frf.as_ref().map(|f| f.usable_hz),
        frf: model.frf_quality.as_ref().filter(|_| model.frf.is_some()).map(|quality| FrfMetadata {
            settings: quality.settings.clone(),
            averages: quality.averages,
            effective_averages: quality.effective_averages,
            excited: quality.excited.clone(),
            input_hz: quality.input_hz.clone(),
        }),
        range: model.range.clone(),
        window_range: model.window_range.clone(),
        joint_range: model.joint_range.clone(),
        band: model.band.clone(),
        core: (!core.is_empty()).then_some(Core { effects: core }),
        effects,
    };
    let metadata = serde_json::to_string(&metadata).expect("names and finite numbers are always JSON");
    let views = tensors.iter().map(|(name, dtype, shape, bytes)| {
        let view = TensorView::new(*dtype, shape.clone(), bytes).expect("shape and bytes were made together");
        (name, view)
    });
    safetensors::serialize(views, Some(HashMap::from([("rigcast".to_string(), metadata)])))
        .expect("views are consistent and the header is small")
}

/// Reads a model from a file of this service or of another program.
///
/// # Errors
/// [`EngineError::Weights`] for files, metadata or values that are not a model's, and
/// [`EngineError::TensorShape`] naming the tensor whose shape does not fit.
pub fn from_safetensors(bytes: &[u8]) -> Result<RigModel, EngineError> {
    check_header_len(bytes)?;
    let (_, header) = SafeTensors::read_metadata(bytes).map_err(unreadable)?;
    let text = header
        .metadata()
        .as_ref()
        .and_then(|m| m.get("rigcast"))
        .ok_or_else(|| wrong("the metadata key `rigcast` is missing"))?;
    let mut meta: Metadata = serde_json::from_str(text)
        .map_err(|e| wrong(format!("metadata key `rigcast`: {}", unreadable_json(&e))))?;
    drop(header);
    let mut file =
        File { tensors: SafeTensors::deserialize(bytes).map_err(unreadable)?, read: Default::default() };
    file.taps("effects", &mut meta.effects)?;
    file.taps("core", meta.core.as_mut().map_or(&mut [], |core| &mut core.effects))?;
    let kind = meta.model_kind()?;
    check(&meta, kind)?;
    check_core(&meta, kind)?;
    let frf = if kind == ModelKind::Lstm { None } else { Some(file.frf(&meta)?) };
    // A model without an FRF is told first of the tensors that it does not have.
    let frf_quality = match &frf {
        Some(frf) => file.quality(meta.frf.clone(), Some(frf))?,
        None => None,
    };
    let lstm = if kind == ModelKind::Frf { None } else { Some(file.lstm(&meta, kind)?) };
    file.all_read()?;
    if frf.is_none() && meta.frf.is_some() {
        return Err(wrong("metadata key `rigcast`: frf: the model has no FRF"));
    }
    Ok(RigModel {
        kind,
        inputs: meta.inputs,
        outputs: meta.outputs,
        sample_rate_hz: meta.sample_rate_hz,
        preprocess: meta.preprocess,
        frf,
        frf_quality,
        core: meta.core.map(|core| core.effects).unwrap_or_default(),
        lstm,
        range: meta.range,
        window_range: meta.window_range,
        joint_range: meta.joint_range,
        band: meta.band,
        effects: meta.effects,
    })
}

fn wrong(message: impl Into<String>) -> EngineError {
    EngineError::Weights(message.into())
}

/// The place of a parser's error within the metadata says little; what was expected says it.
fn unreadable_json(error: &serde_json::Error) -> String {
    let text = error.to_string();
    plain(text.split(" at line ").next().unwrap_or(&text))
}

fn unreadable(error: SafeTensorError) -> EngineError {
    wrong(format!("not a readable safetensors file: {error}"))
}

/// Checks the length of the header before it is parsed.
fn check_header_len(bytes: &[u8]) -> Result<(), EngineError> {
    match bytes.first_chunk() {
        Some(length) if u64::from_le_bytes(*length) > MAX_HEADER_BYTES => {
            Err(wrong(format!("the header is longer than {MAX_HEADER_BYTES} bytes")))
        }
        _ => Ok(()),
    }
}

fn check(meta: &Metadata, kind: ModelKind) -> Result<(), EngineError> {
    if meta.schema != SCHEMA {
        return Err(wrong(format!("schema {} is unknown, this version reads {SCHEMA}", meta.schema)));
    }
    if !(meta.sample_rate_hz > 0.0 && meta.sample_rate_hz.is_finite()) {
        return Err(wrong("sample_rate_hz must be positive"));
    }
    for (what, names) in [("inputs", &meta.inputs), ("outputs", &meta.outputs)] {
        if names.is_empty() || names.len() > MAX_CHANNELS {
            return Err(wrong(format!("{what}: 1 to {MAX_CHANNELS} channel names are needed")));
        }
        if let Some(i) = (1..names.len()).find(|&i| names[..i].contains(&names[i])) {
            return Err(wrong(format!("{what}: channel {:?} comes twice", names[i])));
        }
    }
    if !meta.range.is_empty() && meta.range.len() != meta.inputs.len() {
        return Err(wrong(format!("range: {} entries for {} inputs", meta.range.len(), meta.inputs.len())));
    }
    if let Some(name) = meta.outputs.iter().find(|name| meta.inputs.contains(name)) {
        return Err(wrong(format!("outputs: channel {name:?} is an input too")));
    }
    for (i, range) in meta.range.iter().enumerate() {
        if !(range.min <= range.max && range.max_rate >= 0.0) {
            return Err(wrong(format!(
                "range[{i}]: min {} to max {}, max_rate {}: min must not be above max, and max_rate not negative",
                range.min, range.max, range.max_rate
            )));
        }
    }
    check_bands(meta)?;
    check_local(meta)?;
    check_window_range(meta, kind)?;
    meta.joint_range.as_ref().map_or(Ok(()), |joint| joint.check(meta.inputs.len()))?;
    meta.band.as_ref().map_or(Ok(()), |band| band.check(meta.outputs.len()))?;
    check_effects(meta, "effects", &meta.effects)?;
    meta.preprocess.check(meta.sample_rate_hz)
}

/// At most so many effects as are read, each of which can be simulated on the model's channels.
fn check_effects(meta: &Metadata, what: &str, effects: &[AddedEffect]) -> Result<(), EngineError> {
    if effects.len() > MAX_EFFECTS {
        return Err(wrong(format!("{what}: {}, at most {MAX_EFFECTS} are read", effects.len())));
    }
    let check =
        |effect: &AddedEffect| effect.check(meta.inputs.len(), meta.outputs.len(), meta.sample_rate_hz);
    effects.iter().try_for_each(check)
}

/// Only a hybrid has a core, which has effects.
fn check_core(meta: &Metadata, kind: ModelKind) -> Result<(), EngineError> {
    let Some(core) = &meta.core else { return Ok(()) };
    if !matches!(kind, ModelKind::Hybrid1 | ModelKind::Hybrid2) {
        return Err(wrong(format!("core: only hybrids have one, this is {}", kind.as_str())));
    }
    if core.effects.is_empty() {
        return Err(wrong("core.effects: a core has at least one"));
    }
    check_effects(meta, "core.effects", &core.effects)
}

/// Bands are two frequencies that do not fall, from zero to half the sample rate.
fn check_bands(meta: &Metadata) -> Result<(), EngineError> {
    let nyquist = meta.sample_rate_hz / 2.0;
    let whole = meta.usable_hz.into_iter().map(|band| ("usable_hz".to_owned(), band));
    let inputs = meta.range.iter().enumerate();
    let inputs = inputs.filter_map(|(i, range)| Some((format!("range[{i}].band_hz"), range.band_hz?)));
    for (what, [from, to]) in whole.chain(inputs) {
        // The last line of an FRF may lie beyond by rounding.
        if !(0.0 <= from && from <= to && to <= nyquist * (1.0 + 1e-6)) {
            return Err(wrong(format!(
                "{what} is [{from}, {to}]: two frequencies from 0 to {nyquist} Hz, the first not above the second, are needed"
            )));
        }
    }
    Ok(())
}

/// Windows have samples, means do not fall, a level is not negative.
fn check_local(meta: &Metadata) -> Result<(), EngineError> {
    for (i, range) in meta.range.iter().enumerate() {
        let Some(LocalRange { window, mean, max_rms }) = range.local else { continue };
        if !((1..=MAX_WINDOW).contains(&window) && mean[0] <= mean[1] && max_rms >= 0.0) {
            return Err(wrong(format!(
                "range[{i}].local: a window of 1 to {MAX_WINDOW} samples, a mean that does not fall and a max_rms that is not \
                 negative are needed"
            )));
        }
    }
    Ok(())
}

/// One of each output, without an FRF of each input, in windows of one length that have samples; means do not fall, levels
/// are not negative.
fn check_window_range(meta: &Metadata, kind: ModelKind) -> Result<(), EngineError> {
    let channels = if kind == ModelKind::Lstm { &meta.inputs } else { &meta.outputs };
    let (found, needed) = (meta.window_range.len(), channels.len());
    if found != 0 && found != needed {
        return Err(wrong(format!("window_range: {found} entries for {needed} channels")));
    }
    for (i, range) in meta.window_range.iter().enumerate() {
        let WindowRange { window, mean, max_rms, max_rate, max_tone_rate } = *range;
        let one = window == meta.window_range[0].window && (1..=MAX_WINDOW).contains(&window);
        if !(one
            && mean[0] <= mean[1]
            && [max_rms, max_rate, max_tone_rate.unwrap_or_default()].iter().all(|level| *level >= 0.0))
        {
            return Err(wrong(format!(
                "window_range[{i}]: the same window of 1 to {MAX_WINDOW} samples for all, a mean that does not fall, and \
                 levels that are not negative are needed"
            )));
        }
    }
    Ok(())
}

/// A file's tensors, and which of them a model has taken.
struct File<'a> {
    tensors: SafeTensors<'a>,
    read: std::collections::BTreeSet<String>,
}

/// Tensor of the impulse responses of one effect.
fn taps_of(what: &str, effect: usize) -> String {
    format!("{what}.{effect}.taps")
}

impl File<'_> {
    /// Gives effects whose taps stand in tensors their taps; files of before have them in the metadata.
    fn taps(&mut self, what: &str, effects: &mut [AddedEffect]) -> Result<(), EngineError> {
        for (i, effect) in effects.iter_mut().enumerate().filter(|(_, effect)| effect.augmented.lacks_taps())
        {
            let (_, taps) = self.values(&taps_of(what, i), &[None])?;
            effect.augmented.attach_taps(&taps)?;
        }
        Ok(())
    }

    fn has(&self, name: &str) -> bool {
        self.tensors.tensor(name).is_ok()
    }

    /// Finite values of a tensor; dimensions that are `None` are free.
    fn values(&mut self, name: &str, shape: &[Option<usize>]) -> Result<(Vec<usize>, Vec<f64>), EngineError> {
        let view = self.tensors.tensor(name).map_err(|_| wrong(format!("tensor {name} is missing")))?;
        let found = view.shape().to_vec();
        let fits =
            found.len() == shape.len() && found.iter().zip(shape).all(|(f, s)| s.is_none_or(|s| s == *f));
        if !fits {
            let expected = shape
                .iter()
                .enumerate()
                .map(|(i, s)| s.unwrap_or(found.get(i).copied().unwrap_or(1)))
                .collect();
            return Err(EngineError::TensorShape { tensor: name.into(), expected, found });
        }
        let data = view.data();
        let values: Vec<f64> = match view.dtype() {
            Dtype::F32 => data
                .chunks_exact(4)
                .map(|b| f64::from(f32::from_le_bytes(b.try_into().expect("chunks of four"))))
                .collect(),
            Dtype::F64 => data
                .chunks_exact(8)
                .map(|b| f64::from_le_bytes(b.try_into().expect("chunks of eight")))
                .collect(),
            other => return Err(wrong(format!("tensor {name}: type {other:?}, F32 or F64 is needed"))),
        };
        if let Some(i) = values.iter().position(|v| !v.is_finite()) {
            return Err(wrong(format!("tensor {name}: value {i} is not finite")));
        }
        self.read.insert(name.into());
        Ok((found, values))
    }

    fn vector(&mut self, name: &str, len: usize) -> Result<Vec<f64>, EngineError> {
        Ok(self.values(name, &[Some(len)])?.1)
    }

    fn vector_or_zeros(&mut self, name: &str, len: usize) -> Result<Vec<f64>, EngineError> {
        if self.has(name) { self.vector(name, len) } else { Ok(vec![0.0; len]) }
    }

    fn frf(&mut self, meta: &Metadata) -> Result<Frf, EngineError> {
        let (n_inputs, n_outputs) = (meta.inputs.len(), meta.outputs.len());
        let (shape, freq_hz) = self.values("frf.freq_hz", &[None])?;
        let lines = shape[0];
        if lines < 2 {
            return Err(wrong("tensor frf.freq_hz: at least two lines are needed"));
        }
        let segment_len = 2 * (lines - 1);
        let df_hz = meta.sample_rate_hz / segment_len as f64;
        if let Some(l) =
            (0..lines).find(|&l| (freq_hz[l] - l as f64 * df_hz).abs() > 1e-6 * df_hz * lines as f64)
        {
            return Err(wrong(format!(
                "tensor frf.freq_hz: line {l} is {} Hz; lines must run evenly from 0 to sample_rate_hz / 2, here {} Hz apart",
                freq_hz[l], df_hz
            )));
        }
        let full = [Some(lines), Some(n_outputs), Some(n_inputs)];
        let (_, re) = self.values("frf.re", &full)?;
        let mut h: Vec<Complex64> = re.into_iter().map(|re| Complex64::new(re, 0.0)).collect();
        let (_, im) = self.values("frf.im", &full)?;
        h.iter_mut().zip(im).for_each(|(h, im)| h.im = im);
        Ok(Frf {
            sample_rate_hz: meta.sample_rate_hz,
            segment_len,
            n_inputs,
            n_outputs,
            h,
            usable_hz: meta.usable_hz.unwrap_or([0.0, meta.sample_rate_hz / 2.0]),
            x_mean: self.vector_or_zeros("frf.x_mean", n_inputs)?,
            y_mean: self.vector_or_zeros("frf.y_mean", n_outputs)?,
        })
    }

    /// Quality of the file's FRF: complete or absent.
    fn quality(
        &mut self,
        meta: Option<FrfMetadata>,
        frf: Option<&Frf>,
    ) -> Result<Option<FrfQuality>, EngineError> {
        let tensor = ["coherence", "multiple_coherence", "condition", "std_error"]
            .into_iter()
            .map(|part| format!("frf.{part}"))
            .find(|name| self.has(name));
        let (meta, frf) = match (meta, frf, tensor) {
            (Some(meta), Some(frf), _) => (meta, frf),
            (Some(_), None, _) => return Err(wrong("metadata key `rigcast`: frf: the model has no FRF")),
            (None, Some(_), Some(name)) => {
                return Err(wrong(format!(
                    "tensor {name} needs the block `frf` in the metadata key `rigcast`"
                )));
            }
            (None, ..) => return Ok(None),
        };
        let (lines, outputs, inputs) = (Some(frf.n_lines()), Some(frf.n_outputs), Some(frf.n_inputs));
        let quality = FrfQuality {
            settings: meta.settings,
            averages: meta.averages,
            effective_averages: meta.effective_averages,
            excited: meta.excited,
            input_hz: meta.input_hz,
            coherence: self.values("frf.coherence", &[lines, outputs, inputs])?.1,
            multiple_coherence: self.values("frf.multiple_coherence", &[lines, outputs])?.1,
            condition: self.values("frf.condition", &[lines])?.1,
            std_error: self.values("frf.std_error", &[lines, outputs, inputs])?.1,
        };
        quality.check(frf)?;
        Ok(Some(quality))
    }

    fn lstm(&mut self, meta: &Metadata, kind: ModelKind) -> Result<LstmPart, EngineError> {
        let window_len = meta.window_len.ok_or_else(|| wrong("window_len is missing"))?;
        let hop = meta.hop.unwrap_or(window_len / 2);
        if !(2..=65_536).contains(&window_len) || hop == 0 || hop > window_len / 2 {
            return Err(wrong(format!(
                "window_len {window_len} and hop {hop}: 2 <= window_len <= 65536 and 1 <= hop <= window_len / 2 are needed"
            )));
        }
        let n_outputs = meta.outputs.len();
        let n_inputs = meta.inputs.len() + if kind == ModelKind::Hybrid2 { n_outputs } else { 0 };
        let mut blocks: Vec<LstmBlock> = Vec::new();
        loop {
            let i = blocks.len();
            let (ours, theirs) = (format!("lstm.{i}.weight_ih"), format!("lstm.weight_ih_l{i}"));
            if i > 0 && !self.has(&ours) && !self.has(&theirs) {
                break;
            }
            let inputs = blocks.last().map_or(n_inputs, |b| b.cells);
            blocks.push(self.block(i, inputs)?);
        }
        let cells = blocks[blocks.len() - 1].cells;
        let net = LstmNet {
            blocks,
            outputs: n_outputs,
            fc_weight: to_f32(self.values("fc.weight", &[Some(n_outputs), Some(cells)])?.1),
            fc_bias: to_f32(self.vector("fc.bias", n_outputs)?),
        };
        net.check()?;
        Ok(LstmPart {
            net,
            x: self.scaler("x", n_inputs)?,
            y: self.scaler("y", n_outputs)?,
            window_len,
            hop,
            recombine: meta.recombine.unwrap_or(Recombine::Welch),
        })
    }

    fn block(&mut self, i: usize, inputs: usize) -> Result<LstmBlock, EngineError> {
        let pytorch = self.has(&format!("lstm.weight_ih_l{i}"));
        let name = |part: &str| {
            if pytorch { format!("lstm.{part}_l{i}") } else { format!("lstm.{i}.{part}") }
        };
        let (shape, weight_ih) = self.values(&name("weight_ih"), &[None, Some(inputs)])?;
        let gates = shape[0];
        if gates == 0 || gates % 4 != 0 {
            return Err(EngineError::TensorShape {
                tensor: name("weight_ih"),
                expected: vec![gates.div_ceil(4).max(1) * 4, inputs],
                found: shape,
            });
        }
        let cells = gates / 4;
        let weight_hh = self.values(&name("weight_hh"), &[Some(gates), Some(cells)])?.1;
        let bias = if pytorch {
            // The two biases are redundant: only their sum enters the gates.
            let (ih, hh) = (self.vector(&name("bias_ih"), gates)?, self.vector(&name("bias_hh"), gates)?);
            ih.iter().zip(&hh).map(|(a, b)| a + b).collect()
        } else {
            self.vector(&name("bias"), gates)?
        };
        Ok(LstmBlock {
            inputs,
            cells,
            weight_ih: to_f32(weight_ih),
            weight_hh: to_f32(weight_hh),
            bias: to_f32(bias),
        })
    }

    fn scaler(&mut self, axis: &str, len: usize) -> Result<Scaler, EngineError> {
        let mean = self.vector(&format!("{axis}.mean"), len)?;
        let std = self.vector(&format!("{axis}.std"), len)?;
        match std.iter().position(|&s| s <= 0.0) {
            Some(i) => Err(wrong(format!("tensor {axis}.std: value {i} must be positive"))),
            None => Ok(Scaler { mean, std }),
        }
    }

    /// Refuses tensors that the model does not use: a misspelt name, or another kind of model.
    fn all_read(&self) -> Result<(), EngineError> {
        match self.tensors.names().into_iter().filter(|n| !self.read.contains(*n)).min() {
            Some(name) => Err(wrong(format!("tensor {name} is not part of a model of this kind"))),
            None => Ok(()),
        }
    }
}

fn to_f32(values: Vec<f64>) -> Vec<f32> {
    values.into_iter().map(|v| v as f32).collect()
}
