//! Watches a drive over short times: the spectrum of each input, and the linear response to all of them.

use std::borrow::Cow;
use std::ops::Range;

use super::band::{self, Bands, OutOfBand, Power, WINDOW_LEN, window_len};
use super::beyond::Beyond;
use super::joint::{self, Apart, Distance, JointRange};
use super::levels::{Level, LinearLevels};
use super::response::{self, WindowRange};
use super::short_time::{ShortTime, WindowOfInputs};
use crate::Signal;
use crate::model::RigModel;

/// What is watched of a model's drives.
#[derive(Clone)]
pub(in crate::model) struct SpectrumWatch {
    fft: ShortTime,
    bands: Bands,
    /// Of models that know their response in the training.
    levels: Option<LinearLevels>,
    /// Of models that know the means of all inputs together.
    distance: Option<Distance>,
}

/// Where a drive is outside.
#[derive(Debug, Default)]
pub(super) struct SeenOutside {
    pub out_of_band: Vec<OutOfBand>,
    /// Stretches of the linear response, with the place of the output; without an FRF of the inputs.
    pub driven: Vec<(usize, Beyond)>,
    /// Stretches of means far from those of the training.
    pub apart: Vec<(Range<usize>, Apart)>,
}

/// What is seen of a drive in each window, with the samples that the window speaks for.
pub(super) struct Seen<'a> {
    /// The bands on the lines of the windows.
    pub bands: Cow<'a, Bands>,
    /// Power of each input outside its band, and all of it.
    pub powers: Vec<(Range<usize>, Vec<Power>)>,
    /// Levels of the linear response, by output; without an FRF of each input.
    pub levels: Vec<(Range<usize>, Vec<Level>)>,
    /// How far the means of all inputs together are from the middle of the training.
    pub distances: Vec<(Range<usize>, Apart)>,
}

impl std::fmt::Debug for SpectrumWatch {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("SpectrumWatch").field("bands", &self.bands).field("window", &self.fft.len()).finish()
    }
}

impl SpectrumWatch {
    /// None when nothing can be told to be outside.
    pub fn new(model: &RigModel) -> Option<Self> {
        let (fft, bands) = windows(model);
        // Ranges of other windows, from a file, say nothing about these.
        let known = model.window_range.first().is_some_and(|range| range.window == fft.len());
        let levels = known.then(|| LinearLevels::new(model, fft.len()));
        let joint = model.joint_range.as_ref().filter(|joint| joint.window == fft.len());
        let distance = joint.and_then(JointRange::distance);
        let tells = levels.is_some() || distance.is_some() || bands.tell();
        tells.then_some(Self { fft, bands, levels, distance })
    }

    /// Where the inputs of the model are outside.
    pub(super) fn find(&self, model: &RigModel, x: &Signal) -> SeenOutside {
        let Some(Seen { bands, powers, levels, distances }) = self.look(x) else {
            return SeenOutside::default();
        };
        let limit = model.joint_range.as_ref().map_or(f64::INFINITY, JointRange::limit);
        SeenOutside {
            out_of_band: bands.find(&model.range, &powers),
            driven: response::find(&model.window_range, &levels),
            apart: joint::find(limit, &distances),
        }
    }

    /// What is seen of some inputs; none where they are shorter than the shortest window.
    pub(super) fn look(&self, x: &Signal) -> Option<Seen<'_>> {
        let n = x.n_samples();
        if n < WINDOW_LEN.start {
            return None;
        }
        // The spectrum of a drive shorter than the window is looked at through a shorter one; the rest is not judged.
        let shorter = self.fft.shortened(n).map(|fft| (self.bands.on(&fft, x.sample_rate_hz()), fft));
        let (fft, bands, levels, distance) = match shorter {
            Some((bands, fft)) => (Cow::Owned(fft), Cow::Owned(bands), None, None),
            None => {
                let of_whole = (self.levels.as_ref(), self.distance.as_ref());
                (Cow::Borrowed(&self.fft), Cow::Borrowed(&self.bands), of_whole.0, of_whole.1)
            }
        };
        let inputs: Vec<&[f64]> = x.channels().iter().map(Vec::as_slice).collect();
        let (mut powers, mut of_levels, mut distances) = (Vec::new(), Vec::new(), Vec::new());
        for (samples, (power, level, distance)) in fft.each_batch(&inputs, |windows| {
            let mut levels = levels.map(|levels| levels.of(windows).into_iter());
            let of_window = |window: &WindowOfInputs<'_>| {
                let level = levels.as_mut().and_then(Iterator::next);
                (bands.of(window), level, distance.map(|distance| distance.of(window.means)))
            };
            windows.iter().map(of_window).collect()
        }) {
            of_levels.extend(level.map(|level| (samples.clone(), level)));
            distances.extend(distance.map(|distance| (samples.clone(), distance)));
            powers.push((samples, power));
        }
        Some(Seen { bands, powers, levels: of_levels, distances })
    }
}

/// The windows over which a model's drives are watched, and its bands on their lines.
fn windows(model: &RigModel) -> (ShortTime, Bands) {
    let bands = band::of_model(model);
    let fft = ShortTime::new(window_len(&bands, model.sample_rate_hz));
    let bands = Bands::new(bands, &fft, model.sample_rate_hz);
    (fft, bands)
}

/// The ranges of a model over windows of the parts of runs that it was trained on, `[part][input]`.
pub(in crate::model) fn of_training(
    model: &RigModel,
    parts: &[Vec<&[f64]>],
) -> (Vec<WindowRange>, Option<JointRange>) {
    let (fft, _) = windows(model);
    let linear = LinearLevels::new(model, fft.len());
    let of_part = |part: &Vec<&[f64]>| {
        fft.each_batch(part, |windows| {
            let means = windows.iter().map(|window| window.means.to_vec());
            linear.of(windows).into_iter().zip(means).collect()
        })
    };
    let (levels, means): (Vec<_>, Vec<_>) = parts.iter().flat_map(of_part).map(|(_, found)| found).unzip();
    (WindowRange::of_windows(fft.len(), &levels), JointRange::of_windows(fft.len(), &model.range, &means))
}
