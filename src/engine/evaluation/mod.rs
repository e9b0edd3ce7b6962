//! How good a model's predictions are: figures of one run, their averages over the runs of a class, and the
//! differences between two models (Heindel et al., section 3.2).
//!
//! [`compare`] takes one prediction and what was measured. [`average`] takes the figures of all runs of a class:
//! errors are averaged over runs and then over the channels of a group, ratios geometrically. A figure that cannot
//! be given is absent and has a reason.

mod average;
mod compare;
mod spectrum;
#[cfg(test)]
mod tests;
mod worst_span;

pub use average::{
    ChannelAverage, ChannelDifference, ChannelGroup, ClassAverage, ClassDifference, GroupAverage,
    GroupDifference, NoAverage, average, difference,
};
pub use compare::{ChannelFigures, CompareSettings, Compared, DamageFigures, RunFigures, compare};
pub use spectrum::{ChannelSpectrum, MeanSpectra, Spectra};
pub use worst_span::WorstSpan;
