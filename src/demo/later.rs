//! The rig months later: the pilot stage of z's servo-valve is worn, and the command has play. The models
//! do not have this effect; a diagnosis finds it.

use rayon::prelude::*;

use super::upload::DemoRun;
use crate::engine::virtual_rig::drives::{Noise, ServiceLoad, ServiceShape, noise, service_load};
use crate::engine::virtual_rig::{ProgrammeRun, VirtualRig};
use crate::engine::{EngineError, RunKind, Signal, Split};

/// Tag of these runs.
pub const TAG: &str = "later";
/// Index of the drive whose valve is worn.
const WORN: usize = 2;
/// Half width of the play, kN: 1.6 % of the largest command, within the 3 % that data sheets of two-stage valves
/// allow for hysteresis.
const PLAY_KN: f64 = 0.16;
/// Largest mean amplitude of the training noise (three standard deviations), kN, and the length of a noise run.
const NOISE_KN: f64 = 2.0;
const NOISE_S: f64 = 20.0;
/// The service load: the test shape at half its scale.
const LOAD: ServiceLoad =
    ServiceLoad { shape: ServiceShape::HandlingCourse, duration_s: 60.0, scale: 0.5, offset_kn: 0.0 };

/// Two noise drives, each run twice so that the repeats give the noise floor, and a service load for the
/// test.
///
/// # Errors
/// Those of [`VirtualRig::simulate`].
pub fn record(rig: &VirtualRig, seed: u64) -> Result<Vec<DemoRun>, EngineError> {
    let of = |number: u64| seed.wrapping_mul(1_000).wrapping_add(number);
    let first = drive(of(900))?;
    let second = drive(of(901))?;
    let load = service_load(&LOAD, of(902))?;
    let run = |name: &str, kind, drive: &Signal| ProgrammeRun {
        name: format!("{TAG}-{name}"),
        kind,
        split: Split::Test,
        tags: vec![TAG],
        drive: drive.clone(),
    };
    let runs = vec![
        run("noise-1", RunKind::Noise, &first),
        run("noise-1-again", RunKind::Noise, &first),
        run("noise-2", RunKind::Noise, &second),
        run("noise-2-again", RunKind::Noise, &second),
        run("service", RunKind::Service, &load),
    ];
    runs.into_par_iter()
        .enumerate()
        .map(|(i, run)| {
            let mut arriving = run.drive.channels().to_vec();
            play(&mut arriving[WORN]);
            let arriving = Signal::new(run.drive.sample_rate_hz(), arriving)?;
            DemoRun::simulated(rig, run, Some(&arriving), of(950 + i as u64))
        })
        .collect()
}

fn drive(seed: u64) -> Result<Signal, EngineError> {
    noise(&Noise { duration_s: NOISE_S, mean_kn: [0.0; 3], amplitude_kn: [NOISE_KN; 3] }, seed)
}

/// The command after the play: it moves only where the command pushes it from either side.
fn play(command: &mut [f64]) {
    let mut arrived = 0.0;
    for u in command {
        arrived = f64::clamp(arrived, *u - PLAY_KN, *u + PLAY_KN);
        *u = arrived;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_command_with_play_rests_where_it_turns() {
        let mut command = [0.0, 0.1, 0.16, 0.5, 0.4, 0.2, 0.18, 0.0];
        play(&mut command);
        let expected = [0.0, 0.0, 0.0, 0.34, 0.34, 0.34, 0.34, 0.16];
        assert!(
            command.iter().zip(expected).all(|(found, x): (&f64, f64)| (found - x).abs() < 1e-12),
            "{command:?}"
        );
    }
}
