//! The rigs whose work is timed: the virtual bench, and a large synthetic one.

mod demo;
mod large;

use rigcast::engine::{EngineError, Signal};
use serde_json::Value;

pub use demo::Demo;
pub use large::Large;

/// Samples per second of both rigs.
pub const RATE_HZ: f64 = 1000.0;

/// A drive that a lab sends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Drive {
    /// Small, centred noise, on which the rig is nearly linear.
    LinearNoise,
    /// Noise of many means and levels.
    Noise,
    /// A load as on a vehicle.
    Service,
}

/// The rig as it was when the models were fitted, or after a change.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum State {
    Fitted,
    /// The command of the last drive has play.
    Worn,
}

/// A rig that can be driven.
pub trait Rig {
    /// Its id, and its name in the figures.
    fn id(&self) -> &'static str;

    /// Its channels as `POST /v1/rigs` takes them, drives first.
    fn channels(&self) -> Value;

    /// Number of drives.
    fn drives(&self) -> usize;

    /// Responses that a target has: as many as drives, or fewer.
    fn targets(&self) -> Vec<String>;

    /// A drive of so many seconds.
    fn drive(&self, kind: Drive, seconds: f64, seed: u64) -> Result<Signal, EngineError>;

    /// Half of the play of a worn drive, in its unit.
    fn play(&self) -> f64;

    /// The responses to commands as they arrive.
    fn respond(&self, arriving: &Signal, seed: u64) -> Result<Signal, EngineError>;

    /// All channels of a run: the drives as they were sent, and the responses.
    fn record(&self, sent: &Signal, state: State, seed: u64) -> Result<Vec<Vec<f64>>, EngineError> {
        let mut channels = sent.channels().to_vec();
        let responses = match state {
            State::Fitted => self.respond(sent, seed)?,
            State::Worn => {
                let mut arriving = channels.clone();
                wear(&mut arriving[self.drives() - 1], self.play());
                self.respond(&Signal::new(RATE_HZ, arriving)?, seed)?
            }
        };
        channels.extend(responses.into_channels());
        Ok(channels)
    }
}

/// A command after play: it moves only where it is pushed from either side.
fn wear(command: &mut [f64], half: f64) {
    let mut arrived = 0.0;
    for u in command {
        arrived = f64::clamp(arrived, *u - half, *u + half);
        *u = arrived;
    }
}
