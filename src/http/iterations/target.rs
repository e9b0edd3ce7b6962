//! The target of an iteration: a run and the channels that are wanted of it, or signals.

use std::fmt;

use serde::de::value::{MapAccessDeserializer, SeqAccessDeserializer};
use serde::de::{Error, MapAccess, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer};

use crate::domain::iteration::IterationTarget;
use crate::domain::{IterationRequest, RunId};
use crate::engine::Signal;
use crate::http::body::HoldsSignals;
use crate::http::body::signals::Channels;
use crate::http::body::source::{Given, Source, signal};
use crate::http::problem::Answer;

/// A target as it is sent.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SentTarget {
    #[serde(default)]
    run: Option<RunId>,
    #[serde(default)]
    sample_rate_hz: Option<f64>,
    #[serde(default)]
    channels: Option<NamesOrSignals>,
}

/// The channels of a run by name, or signals.
#[derive(Debug)]
enum NamesOrSignals {
    Names(Vec<String>),
    Signals(Channels),
}

/// A target that is a run or signals.
#[derive(Debug)]
pub enum Target {
    Run(IterationTarget),
    Signals(Vec<String>, Signal),
}

impl HoldsSignals for IterationRequest<SentTarget> {
    fn signals(&mut self) -> Vec<&mut Channels> {
        match &mut self.target.channels {
            Some(NamesOrSignals::Signals(channels)) => vec![channels],
            _ => Vec::new(),
        }
    }
}

impl SentTarget {
    /// The target.
    ///
    /// # Errors
    /// A target that is neither or both; signals of another rate than a number above zero, of unequal lengths, of none.
    pub fn target(self) -> Answer<Target> {
        let (names, channels) = match self.channels {
            Some(NamesOrSignals::Names(names)) => (Some(names), None),
            Some(NamesOrSignals::Signals(channels)) => (None, Some(channels)),
            None => (None, None),
        };
        let source = Source { run: self.run, sample_rate_hz: self.sample_rate_hz, channels };
        match source.given("/target")? {
            Given::Run(run) => Ok(Target::Run(IterationTarget { run, channels: names })),
            Given::Signals(rate, channels) => {
                let (names, samples): (Vec<String>, Vec<Vec<f64>>) = channels.0.into_iter().unzip();
                let signal = signal(rate, samples, &names, "/target")?;
                Ok(Target::Signals(names, signal))
            }
        }
    }
}

impl<'de> Deserialize<'de> for NamesOrSignals {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(ChannelsVisitor)
    }
}

struct ChannelsVisitor;

impl<'de> Visitor<'de> for ChannelsVisitor {
    type Value = NamesOrSignals;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a list of names, or an object of arrays of numbers")
    }

    /// A list of one, as some programs write it.
    fn visit_str<E: Error>(self, name: &str) -> Result<NamesOrSignals, E> {
        Ok(NamesOrSignals::Names(vec![name.to_owned()]))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, list: A) -> Result<NamesOrSignals, A::Error> {
        Vec::deserialize(SeqAccessDeserializer::new(list)).map(NamesOrSignals::Names)
    }

    fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<NamesOrSignals, A::Error> {
        Channels::deserialize(MapAccessDeserializer::new(map)).map(NamesOrSignals::Signals)
    }
}
