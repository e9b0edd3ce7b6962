//! The one error type of the engine; fields carry what was expected and what was found.

use super::rounded;

/// The reason why a computation was refused.
///
/// Channels are indices into the signal that was passed; callers that know names map them.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum EngineError {
    /// Channels of one signal, or two signals that belong together, differ in length.
    #[error("{what}: channel {channel} has {found} samples, expected {expected}")]
    UnequalLength {
        /// Which argument.
        what: &'static str,
        /// Channel index.
        channel: usize,
        /// Samples expected.
        expected: usize,
        /// Samples found.
        found: usize,
    },
    /// Another number of channels than the model or settings need.
    #[error("{what}: expected {expected} channels, found {found}")]
    ChannelCount {
        /// Which argument.
        what: &'static str,
        /// Channels expected.
        expected: usize,
        /// Channels found.
        found: usize,
    },
    /// NaN or infinity.
    #[error("{what}: channel {channel} is not finite at sample {sample}")]
    NonFinite {
        /// Which argument.
        what: &'static str,
        /// Channel index.
        channel: usize,
        /// Sample index.
        sample: usize,
    },
    /// Sample rates that should agree do not (1e-6 relative).
    #[error("{what}: sample rate {} Hz, expected {} Hz", rounded(*found_hz, 10), rounded(*expected_hz, 10))]
    SampleRate {
        /// Which argument.
        what: &'static str,
        /// Rate expected.
        expected_hz: f64,
        /// Rate found.
        found_hz: f64,
    },
    /// Too few samples for the settings.
    #[error("{what}: {found} samples, at least {needed} are needed")]
    TooShort {
        /// Which argument, and the reason why it must be longer.
        what: &'static str,
        /// Samples needed.
        needed: usize,
        /// Samples found.
        found: usize,
    },
    /// A channel without power where a fit needs power.
    #[error("{what}: channel {channel} is constant, a fit needs a channel that moves")]
    DeadChannel {
        /// Which argument.
        what: &'static str,
        /// Channel index.
        channel: usize,
    },
    /// A setting outside its limits.
    #[error("{setting} = {found}: {limit}")]
    Setting {
        /// The setting's name as in the contract (`frf.segment_len`).
        setting: &'static str,
        /// The value, as the client wrote it.
        found: String,
        /// The limit, in words.
        limit: String,
    },
    /// As many averages as drives make every coherence 1 by construction.
    #[error(
        "{averages} averages for {drives} drives: more averages than drives are needed; shorten frf.segment_len or add runs"
    )]
    TooFewAverages {
        /// Averages that the runs give.
        averages: usize,
        /// Drives.
        drives: usize,
    },
    /// A weight tensor of the wrong shape.
    #[error("tensor {tensor}: shape {found:?}, expected {expected:?}")]
    TensorShape {
        /// Its name in the file.
        tensor: String,
        /// Shape expected.
        expected: Vec<usize>,
        /// Shape found.
        found: Vec<usize>,
    },
    /// A weight file that cannot be read, or lacks something.
    #[error("weights: {0}")]
    Weights(String),
    /// The training diverged: the loss is no longer finite.
    #[error("training diverged in epoch {epoch}: lower lstm.learning_rate")]
    Diverged {
        /// Epoch, from 1.
        epoch: usize,
    },
    /// A computation produced NaN or infinity from finite input.
    #[error("{what} is not finite at sample {sample} of channel {channel}")]
    NonFiniteResult {
        /// What was computed.
        what: &'static str,
        /// Channel index.
        channel: usize,
        /// Sample index.
        sample: usize,
    },
    /// A damage, or a ratio of two, beyond the largest number.
    #[error(
        "{what}: the damage of channel {channel} is too large for a number; lower damage.slope or raise damage.constant"
    )]
    DamageOverflow {
        /// Which argument.
        what: &'static str,
        /// Channel index; of a group its first channel's.
        channel: usize,
    },
    /// An input that is a linear combination of the others.
    #[error(
        "input channel {channel} is a linear combination of the other inputs: leave it out or set frf.ridge above 0"
    )]
    DependentInputs {
        /// Channel index among the inputs.
        channel: usize,
    },
    /// A value outside the range of a channel.
    #[error("{what}: channel {channel} is {found} at sample {sample}, the limit is {limit}")]
    OutOfRange {
        /// Which argument.
        what: &'static str,
        /// Channel index.
        channel: usize,
        /// Sample index.
        sample: usize,
        /// Value found.
        found: f64,
        /// Largest magnitude allowed.
        limit: f64,
    },
    /// The caller cancelled.
    #[error("cancelled")]
    Cancelled,
}

impl EngineError {
    /// An error about a computed value that is not finite, as opposed to a given one.
    pub(super) fn of_result(self) -> Self {
        match self {
            Self::NonFinite { channel, sample, .. } => {
                Self::NonFiniteResult { what: "predicted response", channel, sample }
            }
            other => other,
        }
    }
}
