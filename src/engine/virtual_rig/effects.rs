//! The effects of the bench and their strengths.

use serde::{Deserialize, Serialize};

use crate::EngineError;

/// Largest strength of an effect: three times the drawn bench, still a machine that stands.
pub const MAX_STRENGTH: f64 = 3.0;

/// Strength of each effect: 0 is off, 1 is the drawn bench, at most [`MAX_STRENGTH`].
///
/// The first five are the non-linear ones: with all of them at 0 the bench is linear and time
/// invariant. The last two are not: noise is added after the dynamics, preload shifts the means.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Effects {
    /// Rise of the mount's stiffness towards both ends of its travel (scales the stops' stiffness).
    pub progressive_stiffness: f64,
    /// Friction hysteresis of the filled rubber (scales the friction force).
    pub friction: f64,
    /// Quadratic pressure loss of the oil in the inertia track; the linear part of the oil path stays.
    pub oil_damping: f64,
    /// Tilting struts that couple the axes (scales 1 / strut length).
    pub pendulum: f64,
    /// Square-root orifice law and limits of the servo-valve (scales load pressure / supply pressure
    /// in the law, and divides the opening limit).
    pub valve: f64,
    /// White noise of each sensor (scales its standard deviation).
    pub sensor_noise: f64,
    /// Static load on the mount at zero drive.
    pub preload: f64,
}

impl Default for Effects {
    /// The drawn bench: all effects at strength 1.
    fn default() -> Self {
        Self {
            progressive_stiffness: 1.0,
            friction: 1.0,
            oil_damping: 1.0,
            pendulum: 1.0,
            valve: 1.0,
            sensor_noise: 1.0,
            preload: 1.0,
        }
    }
}

impl Effects {
    /// Non-linear effects off; sensor noise and preload as drawn.
    pub fn linear() -> Self {
        Self { sensor_noise: 1.0, preload: 1.0, ..Self::none() }
    }

    /// Everything off: the linear bench without noise and preload.
    pub fn none() -> Self {
        Self {
            progressive_stiffness: 0.0,
            friction: 0.0,
            oil_damping: 0.0,
            pendulum: 0.0,
            valve: 0.0,
            sensor_noise: 0.0,
            preload: 0.0,
        }
    }

    /// Whether every non-linear effect is off.
    pub fn is_linear(&self) -> bool {
        [self.progressive_stiffness, self.friction, self.oil_damping, self.pendulum, self.valve]
            .iter()
            .all(|&strength| strength == 0.0)
    }

    /// The same effects, if each strength is within 0..=[`MAX_STRENGTH`].
    ///
    /// # Errors
    /// [`EngineError::Setting`] that names the strength.
    pub fn checked(self) -> Result<Self, EngineError> {
        let strengths = [
            ("effects.progressive_stiffness", self.progressive_stiffness),
            ("effects.friction", self.friction),
            ("effects.oil_damping", self.oil_damping),
            ("effects.pendulum", self.pendulum),
            ("effects.valve", self.valve),
            ("effects.sensor_noise", self.sensor_noise),
            ("effects.preload", self.preload),
        ];
        match strengths.into_iter().find(|(_, strength)| !(0.0..=MAX_STRENGTH).contains(strength)) {
            None => Ok(self),
            Some((setting, strength)) => Err(EngineError::Setting {
                setting,
                found: strength.to_string(),
                limit: format!("a strength from 0 to {MAX_STRENGTH}"),
            }),
        }
    }
}
