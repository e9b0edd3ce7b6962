//! Memory that a fit takes, known before a sample is read.

use super::{ModelKind, Preprocess};
use crate::frf::{self, FrfSettings};

/// What the memory of a fit depends on.
#[derive(Debug, Clone)]
pub struct FitSize<'a> {
    /// Kind of model.
    pub kind: ModelKind,
    /// Inputs of the model.
    pub inputs: usize,
    /// Outputs of the model.
    pub outputs: usize,
    /// Samples of each run that trains, compares or stops.
    pub runs: &'a [usize],
    /// Samples of each further run, which only the FRF is estimated from.
    pub frf_only: &'a [usize],
    /// Largest number of values, all channels, of a run as it is stored.
    pub largest_run: usize,
    /// Filter.
    pub preprocess: Preprocess,
    /// FRF part.
    pub frf: &'a FrfSettings,
    /// Whether the FRF is given, and not estimated.
    pub core: bool,
}

/// Program, threads, and what small parts take.
const FIXED: usize = 128 << 20;

/// Share of the data, one in so many, that compare models, as a rule.
const COMPARED: usize = 5;

impl FitSize<'_> {
    /// Largest memory of the fit, bytes: the samples, twice behind a filter; of a network its standardised inputs and targets,
    /// and of a hybrid the response of its FRF; the matrices of an FRF; the predictions of the data that compare. An estimate:
    /// of two hours of nine channels it says a tenth more than a fit was seen to take.
    pub fn bytes(&self) -> u64 {
        const WIDE: usize = size_of::<f64>();
        const NARROW: usize = size_of::<f32>();
        let samples: usize = self.runs.iter().sum();
        let read = samples.saturating_add(self.frf_only.iter().sum());
        let data = read.saturating_mul(self.inputs + self.outputs).saturating_mul(WIDE);
        let filtered = if self.preprocess.is_none() { 0 } else { data };
        let of_outputs = samples.saturating_mul(self.outputs).saturating_mul(WIDE);
        let hybrid = matches!(self.kind, ModelKind::Hybrid1 | ModelKind::Hybrid2);
        let network = if self.kind == ModelKind::Frf {
            0
        } else {
            let linear = if self.kind == ModelKind::Hybrid2 { self.outputs } else { 0 };
            let values = self.inputs + linear + self.outputs;
            samples.saturating_mul(values).saturating_mul(NARROW)
        };
        let linear = match self.kind {
            ModelKind::Hybrid1 => of_outputs.saturating_mul(2),
            _ if hybrid => of_outputs,
            _ => 0,
        };
        let frf = if self.kind == ModelKind::Lstm || self.core {
            0
        } else {
            let all: Vec<usize> = self.runs.iter().chain(self.frf_only).copied().collect();
            frf::estimate_bytes(self.frf, [self.inputs, self.outputs], &all)
        };
        let compared = of_outputs / COMPARED * 2;
        // The network's data are made when the estimate is over, and gone when predictions are compared.
        let at_work = frf.max(network.saturating_add(linear)).max(compared);
        let fit = data.saturating_add(filtered).saturating_add(at_work);
        // A run is read whole, and then cut to its channels.
        let reading = data.saturating_add(self.largest_run.saturating_mul(WIDE));
        (fit.max(reading).saturating_add(FIXED)) as u64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HOUR: usize = 3_600_000;
    const GIB: u64 = 1 << 30;

    fn bytes(kind: ModelKind, channels: usize, runs: &[usize]) -> u64 {
        let (inputs, outputs) = (channels / 2, channels - channels / 2);
        let frf = &FrfSettings::default();
        let largest_run = runs.iter().max().unwrap().saturating_mul(channels);
        let preprocess = Preprocess::default();
        FitSize { kind, inputs, outputs, runs, frf_only: &[], largest_run, preprocess, frf, core: false }
            .bytes()
    }

    #[test]
    fn a_large_rig_with_an_hour_does_not_fit_into_eight_gibibytes_and_a_small_one_does() {
        let hour = [HOUR / 6; 6];
        for kind in [ModelKind::Hybrid1, ModelKind::Hybrid2] {
            assert!(bytes(kind, 128, &hour) > 6 * GIB, "{kind:?}");
            assert!(bytes(kind, 9, &hour) < 2 * GIB, "{kind:?}");
        }
        let hybrid2 = bytes(ModelKind::Hybrid2, 128, &hour) as f64 / GIB as f64;
        assert!((hybrid2 - 7.8).abs() < 0.1, "docs/operations.md says 7.8 GiB: {hybrid2}");
        // The samples alone.
        assert!(bytes(ModelKind::Frf, 128, &hour) > (HOUR * 128 * 8) as u64);
    }

    #[test]
    fn every_part_of_a_fit_counts() {
        let one = bytes(ModelKind::Lstm, 9, &[HOUR]);
        assert!(bytes(ModelKind::Hybrid2, 9, &[HOUR]) > one);
        assert!(bytes(ModelKind::Hybrid1, 9, &[HOUR]) > one);
        assert!(bytes(ModelKind::Lstm, 9, &[HOUR, HOUR]) > one);
        let frf = &FrfSettings::default();
        let size = FitSize {
            kind: ModelKind::Hybrid2,
            inputs: 3,
            outputs: 6,
            runs: &[HOUR],
            frf_only: &[],
            largest_run: 9 * HOUR,
            preprocess: Preprocess::default(),
            frf,
            core: false,
        };
        let plain = size.bytes();
        let filter = Preprocess { low_pass_hz: Some(80.0), band_pass_hz: None };
        assert!(FitSize { preprocess: filter, ..size.clone() }.bytes() > plain);
        assert!(FitSize { frf_only: &[HOUR], ..size.clone() }.bytes() > plain);
        assert!(FitSize { largest_run: 100 * HOUR, ..size.clone() }.bytes() > plain, "a run is read whole");
        let fine = &FrfSettings { segment_len: Some(1 << 22), ..FrfSettings::default() };
        assert!(FitSize { frf: fine, ..size }.bytes() > plain);
    }

    #[test]
    fn numbers_beyond_the_range_are_the_largest_and_not_small_ones() {
        assert!(bytes(ModelKind::Hybrid2, 128, &[usize::MAX / 2, usize::MAX / 4]) > 1 << 60);
    }
}
