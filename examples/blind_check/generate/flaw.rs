//! Flaws of a rig or of its recording, and those of them that act on whole signals.

/// A flaw; its numbers are relative to the linear rig's own levels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Flaw {
    Nothing,
    Gain,
    Delay,
    ExtraPole,
    LinearChange { stiffness: f64, damping: f64 },
    CubicStiffness { bend: f64 },
    QuadraticStiffness,
    BumpStop { gap: f64 },
    OneSidedStop { gap: f64, side: f64 },
    Clearance { gap: f64 },
    Coulomb { smooth: f64 },
    Stribeck { smooth: f64, peak: f64, decay: f64 },
    BoucWen { yielding: f64, sharpness: f64 },
    QuadraticDamping,
    DriveSaturation { skew: f64 },
    DrivePolynomial { even: f64, odd: f64 },
    RateLimit,
    ValveFlow,
    DeadZone,
    Backlash,
    CrossLinear,
    CrossKinematic { mixed: f64 },
    StiffnessDrift,
    OffsetDrift,
    Offset,
    SensorGain,
    SensorSaturation { skew: f64 },
    SensorNonlinearity { even: f64, odd: f64 },
    Sandwich { odd: bool },
    // The same physics in another equation.
    Quintic,
    LuGre { smooth: f64 },
    TwoStageStop { gap: f64 },
    SoftSaturation,
    LeakingFlow { leak: f64 },
    // Outside the catalogue.
    Cogging { pitch: f64 },
    DropOuts,
    UnmeasuredForce,
    Parametric { hz: f64 },
    NegativeDamping { width: f64 },
    // Flaws of the recording, not of the rig.
    RaisedNoise,
    Hum { hz: f64 },
    Quantisation,
}

/// A flaw of one strength at its place.
#[derive(Debug, Clone, Copy)]
pub struct Placed {
    pub flaw: Flaw,
    pub strength: f64,
    /// Axis that it acts on.
    pub axis: usize,
    /// Response that it spoils, where it is of a sensor.
    pub sensor: usize,
}

impl Flaw {
    /// Whether only the recording differs and the rig is unchanged.
    pub fn of_recording(self) -> bool {
        matches!(self, Self::Nothing | Self::RaisedNoise | Self::Hum { .. } | Self::Quantisation)
    }

    /// Whether it acts differently in the same run at another time.
    pub fn of_the_hour(self) -> bool {
        matches!(self, Self::StiffnessDrift | Self::OffsetDrift | Self::DropOuts | Self::UnmeasuredForce)
    }

    /// A drive after what is static or has a memory of samples.
    pub fn on_drive(self, drive: Vec<f64>, s: f64) -> Vec<f64> {
        let map = |f: &dyn Fn(f64) -> f64| drive.iter().map(|&u| f(u)).collect();
        match self {
            Self::Gain => map(&|u| u * (1.0 + s)),
            Self::Delay => {
                let at = |k: usize| (k as f64 - 40.0 * s).max(0.0);
                (0..drive.len()).map(|k| windowed_sinc(&drive, at(k))).collect()
            }
            Self::DriveSaturation { skew } => {
                let limit = 3.5 / (1.0 + 4.0 * s);
                map(&|u| u.min(limit).max(-limit * skew))
            }
            Self::SoftSaturation => map(&|u| (s * u).tanh() / s.max(1e-9)),
            Self::DrivePolynomial { even, odd } => map(&|u| u + s * (even * u * u + odd * u * u * u)),
            Self::RateLimit => {
                let limit = 0.9 / (1.0 + 6.0 * s);
                with_memory(&drive, |w, u| w + (u - w).clamp(-limit, limit))
            }
            Self::DeadZone => map(&|u| u.signum() * (u.abs() - s).max(0.0)),
            Self::Backlash => with_memory(&drive, |w, u| w.clamp(u - s, u + s)),
            _ => drive,
        }
    }

    /// What the sensor makes of a response in units of its own level; `time` is the programme's at the
    /// first sample and per sample.
    pub fn on_sensor(self, y: &mut [f64], s: f64, time: [f64; 2]) {
        match self {
            Self::Offset => y.iter_mut().for_each(|y| *y += s),
            Self::OffsetDrift => {
                y.iter_mut().enumerate().for_each(|(k, y)| *y += s * (time[0] + time[1] * k as f64));
            }
            Self::SensorGain => y.iter_mut().for_each(|y| *y *= 1.0 + s),
            Self::SensorSaturation { skew } => {
                let limit = 3.5 / (1.0 + 4.0 * s);
                y.iter_mut().for_each(|y| *y = y.min(limit).max(-limit * skew));
            }
            Self::SensorNonlinearity { even, odd } => {
                y.iter_mut().for_each(|y| *y += s * (even * *y * *y + odd * *y * *y * *y));
            }
            Self::DropOuts => {
                let mut held = 0.0;
                for (k, y) in y.iter_mut().enumerate() {
                    let phase = (k as f64 * 0.618_03 / 60.0 + time[0] * 977.0).fract();
                    if phase < 0.3 * s.min(3.0) {
                        *y = held;
                    }
                    held = *y;
                }
            }
            _ => {}
        }
    }
}

fn with_memory(drive: &[f64], next: impl Fn(f64, f64) -> f64) -> Vec<f64> {
    let step = |w: &mut f64, &u: &f64| {
        *w = next(*w, u);
        Some(*w)
    };
    drive.iter().scan(0.0, step).collect()
}

/// Band-limited value between samples.
fn windowed_sinc(x: &[f64], at: f64) -> f64 {
    let centre = at.floor() as isize;
    let mut sum = 0.0;
    for k in -15..=16 {
        let i = centre + k;
        let d = at - i as f64;
        let sinc =
            if d.abs() < 1e-12 { 1.0 } else { (std::f64::consts::PI * d).sin() / (std::f64::consts::PI * d) };
        let window = (0.5 * std::f64::consts::PI * d / 17.0).cos().powi(2);
        sum += sinc * window * x[i.clamp(0, x.len() as isize - 1) as usize];
    }
    sum
}
