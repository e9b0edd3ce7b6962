//! The virtual bench of the demo: three drives, six responses.

use rigcast::engine::virtual_rig::VirtualRig;
use rigcast::engine::virtual_rig::drives::{
    MixedNoise, NoiseRegion, ServiceLoad, ServiceShape, linear_noise, mixed_noise, service_load,
};
use rigcast::engine::{EngineError, Signal};
use serde_json::{Value, json};

use super::{Drive, Rig};

/// The bench with the parameters of a seed.
pub struct Demo(VirtualRig);

impl Demo {
    pub fn new(seed: u64) -> Self {
        Self(VirtualRig::draw(seed))
    }
}

impl Rig for Demo {
    fn id(&self) -> &'static str {
        "demo"
    }

    fn channels(&self) -> Value {
        json!(self.0.channels())
    }

    fn drives(&self) -> usize {
        3
    }

    fn targets(&self) -> Vec<String> {
        self.0.channels().iter().map(|channel| channel.name.to_owned()).skip(6).collect()
    }

    fn drive(&self, kind: Drive, seconds: f64, seed: u64) -> Result<Signal, EngineError> {
        match kind {
            Drive::LinearNoise => linear_noise(seconds, seed),
            Drive::Noise => {
                let settings =
                    MixedNoise { duration_s: seconds, stretch_s: 15.0, region: NoiseRegion::Interior };
                mixed_noise(&settings, seed)
            }
            Drive::Service => {
                let shape = ServiceShape::HandlingCourse;
                service_load(&ServiceLoad { shape, duration_s: seconds, scale: 0.7, offset_kn: 0.0 }, seed)
            }
        }
    }

    fn play(&self) -> f64 {
        0.16
    }

    fn respond(&self, arriving: &Signal, seed: u64) -> Result<Signal, EngineError> {
        self.0.simulate(arriving, seed)
    }
}
