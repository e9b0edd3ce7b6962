//! Faults for tests of the whole program. Not in a release build.

use crate::jobs::spec::JobSpec;

/// Does what `RIGCAST_TEST_FAULT` names, as `fault@rig`, when a job of that rig begins: `abort`,
/// `overflow` (of the stack), `hoard` (memory without end), `deaf` (neither ends nor stops).
pub(super) fn inject(spec: &JobSpec) {
    let Ok(wanted) = std::env::var("RIGCAST_TEST_FAULT") else { return };
    let Some(fault) = wanted.strip_suffix(&format!("@{}", spec.rig)) else { return };
    match fault {
        "abort" => std::process::abort(),
        "overflow" => {
            std::hint::black_box(deeper(1));
        }
        "hoard" => {
            let mut hoard = Vec::new();
            loop {
                hoard.push(vec![1_u8; 1 << 20]);
                std::thread::sleep(std::time::Duration::from_millis(1));
            }
        }
        "deaf" => loop {
            std::thread::sleep(std::time::Duration::from_secs(1));
        },
        other => panic!("RIGCAST_TEST_FAULT: there is no fault {other:?}"),
    }
}

fn deeper(depth: u64) -> u64 {
    let room = std::hint::black_box([depth; 512]);
    if depth == 0 { 0 } else { deeper(depth + 1).wrapping_add(room[7]) }
}
