//! Watches a drive over short times: the spectrum of each input, and the linear response to all of them.

use std::ops::Range;

use super::band::{self, Bands, OutOfBand, WINDOW_LEN, window_len};
use super::joint::{self, Apart, Distance, JointRange};
use super::response::{self, Driven, LinearLevels};
use super::short_time::ShortTime;
use crate::Signal;
use crate::model::RigModel;

/// What is watched of a model's drives.
#[derive(Clone)]
pub(in crate::model) struct SpectrumWatch {
    bands: Vec<[f64; 2]>,
    fft: ShortTime,
    /// Of models that know their response in the training.
    levels: Option<LinearLevels>,
    /// Of models that know the means of all inputs together.
    distance: Option<Distance>,
}

/// Where a drive is outside.
#[derive(Debug, Default)]
pub(super) struct SeenOutside {
    pub out_of_band: Vec<OutOfBand>,
    pub driven: Vec<Driven>,
    /// Stretches of means far from those of the training.
    pub apart: Vec<(Range<usize>, Apart)>,
}

impl std::fmt::Debug for SpectrumWatch {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("SpectrumWatch").field("bands", &self.bands).field("window", &self.fft.len()).finish()
    }
}

impl SpectrumWatch {
    /// None when nothing can be told to be outside.
    pub fn new(model: &RigModel) -> Option<Self> {
        let bands = band::of_model(model);
        let fft = ShortTime::new(window_len(&bands, model.sample_rate_hz));
        // Ranges of other windows, from a file, say nothing about these.
        let known = model.window_range.first().is_some_and(|range| range.window == fft.len());
        let levels = known.then(|| LinearLevels::new(model, fft.len()));
        let joint = model.joint_range.as_ref().filter(|joint| joint.window == fft.len());
        let distance = joint.and_then(JointRange::distance);
        let over_windows = levels.is_some() || distance.is_some();
        let tells = over_windows || Bands::new(&bands, &fft, model.sample_rate_hz).tell();
        tells.then_some(Self { bands, fft, levels, distance })
    }

    /// Where the inputs of the model are outside.
    pub(super) fn find(&self, model: &RigModel, x: &Signal) -> SeenOutside {
        let n = x.n_samples();
        if n < WINDOW_LEN.start {
            return SeenOutside::default();
        }
        // The spectrum of a drive shorter than the window is looked at through a shorter one; the rest is not judged.
        let fft = self.fft.no_longer_than(n);
        let whole = fft.len() == self.fft.len();
        let (levels, distance) =
            (self.levels.as_ref().filter(|_| whole), self.distance.as_ref().filter(|_| whole));
        let bands = Bands::new(&self.bands, &fft, x.sample_rate_hz());
        let inputs: Vec<&[f64]> = x.channels().iter().map(Vec::as_slice).collect();
        let (mut powers, mut of_levels, mut distances) = (Vec::new(), Vec::new(), Vec::new());
        for (samples, (power, level, distance)) in fft.each(&inputs, |window| {
            let level = levels.map(|levels| levels.of(window));
            (bands.of(window), level, distance.map(|distance| distance.of(window.means)))
        }) {
            of_levels.extend(level.map(|level| (samples.clone(), level)));
            distances.extend(distance.map(|distance| (samples.clone(), distance)));
            powers.push((samples, power));
        }
        let limit = model.joint_range.as_ref().map_or(f64::INFINITY, JointRange::limit);
        SeenOutside {
            out_of_band: bands.find(&model.range, &powers),
            driven: response::find(&model.window_range, &of_levels),
            apart: joint::find(limit, &distances),
        }
    }
}
