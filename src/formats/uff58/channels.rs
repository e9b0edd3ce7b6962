//! The channels of a file, one a data set: all of one time axis.

use std::collections::HashSet;

use crate::formats::{ChannelAt, FormatError, ParsedRun, Spool, check_channel_count, labels, step};

use super::header::Header;

/// Largest share by which the digits of a sample interval may move its rate: five digits, as Fortran writes them,
/// leave half of it.
const MOST_ROUNDING: f64 = 1e-4;

/// The headers' names, units and time axis so far.
#[derive(Debug, Default)]
pub(super) struct Channels {
    /// The time axis of the first channel.
    axis: Option<Axis>,
    ids: Vec<String>,
    nodes: Vec<String>,
    units: Vec<String>,
}

#[derive(Debug, Clone, Copy)]
struct Axis {
    numbers: u64,
    start_s: f64,
    step_s: f64,
    sample_rate_hz: f64,
}

impl Channels {
    /// Adds the channel of a data set.
    ///
    /// # Errors
    /// `run.too_many_channels`, `run.sample_rate`; `run.unequal_lengths`, `uff58.unsupported` for a channel whose time
    /// is not that of the first.
    pub(super) fn add(&mut self, header: &Header) -> Result<(), FormatError> {
        check_channel_count(self.ids.len() as u64 + 1)?;
        match self.axis {
            None => self.axis = Some(Axis::of(header)?),
            Some(first) => {
                let channel = ChannelAt { index: self.ids.len(), name: header.label().map(str::to_owned) };
                first.check(header, channel)?;
            }
        }
        self.ids.push(header.id.clone());
        self.nodes.push(header.node.clone());
        self.units.push(header.unit.clone());
        Ok(())
    }

    /// The run of these channels.
    pub(super) fn run(self, channels: Spool) -> ParsedRun<Spool> {
        let units = self.units.iter().any(|unit| !unit.is_empty()).then_some(self.units);
        ParsedRun {
            sample_rate_hz: self.axis.map(|axis| axis.sample_rate_hz),
            names: names(self.ids, self.nodes),
            units,
            ..ParsedRun::of(channels)
        }
    }
}

impl Axis {
    fn of(header: &Header) -> Result<Self, FormatError> {
        let rounding = (header.step_half_unit_s / header.step_s).min(MOST_ROUNDING);
        let sample_rate_hz = step::rate(header.step_s, rounding)?;
        let Header { numbers, start_s, step_s, .. } = *header;
        Ok(Self { numbers, start_s, step_s, sample_rate_hz })
    }

    /// Compares the values as the file has them: one program writes equal ones with equal digits.
    fn check(self, header: &Header, channel: ChannelAt) -> Result<(), FormatError> {
        for (what, expected_s, found_s) in
            [("sample interval", self.step_s, header.step_s), ("start", self.start_s, header.start_s)]
        {
            if expected_s != found_s {
                return Err(FormatError::Uff58Unlike { channel, what, expected_s, found_s });
            }
        }
        if self.numbers != header.numbers {
            // A count of the first channel has been read, and one of this channel is only declared.
            let [expected, found] =
                [self.numbers, header.numbers].map(|n| usize::try_from(n).unwrap_or(usize::MAX));
            return Err(FormatError::UnequalLengths { channel, expected, found });
        }
        Ok(())
    }
}

/// ID lines where every channel has one of its own, else nodes; none where a channel has no node either.
fn names(ids: Vec<String>, nodes: Vec<String>) -> Option<Vec<String>> {
    let all = |labels: &[String]| labels.iter().all(|label| !label.is_empty());
    if all(&ids) && ids.iter().collect::<HashSet<_>>().len() == ids.len() {
        return Some(ids);
    }
    all(&nodes).then(|| labels::distinct(nodes))
}
