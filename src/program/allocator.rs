//! When memory that the service has freed goes back to the system, and how much of it stays in pieces.
//!
//! glibc raises its two thresholds by itself: a freed block of its own, up to 32 MiB, lets later blocks of that size
//! come from the heap, and up to twice as much may then stay free at the heap's end. After a few large predictions
//! the service so keeps hundreds of MiB that nothing uses. With fixed thresholds it keeps at most [`TRIM_BYTES`].
//!
//! glibc also gives threads heaps of their own, up to eight a core. Each keeps its freed pieces, so that over hours all of
//! them grow to what the busiest moment of each of its threads took: 36 MiB in fifteen heaps after two hours of load. One
//! heap a core is enough for threads that compute.

use std::env;
use std::io;
use std::os::unix::process::CommandExt;
use std::process::Command;

/// Blocks from this size on are of their own, and go back as they are freed. Most requests have none: it is five
/// minutes of three channels at 1 kHz.
const MMAP_BYTES: usize = 8 << 20;

/// Free memory at the heap's end that is kept.
const TRIM_BYTES: usize = 16 << 20;

/// Fewest and most heaps.
const HEAPS: [usize; 2] = [2, 16];

/// Variables that glibc reads once, before `main`, and their values. Other systems ignore them.
fn variables() -> [(&'static str, usize); 3] {
    let cores = std::thread::available_parallelism().map_or(HEAPS[0], usize::from);
    [
        ("MALLOC_MMAP_THRESHOLD_", MMAP_BYTES),
        ("MALLOC_TRIM_THRESHOLD_", TRIM_BYTES),
        ("MALLOC_ARENA_MAX", cores.clamp(HEAPS[0], HEAPS[1])),
    ]
}

/// A variable by which the one who starts the program sets these and more.
const TUNABLES: &str = "GLIBC_TUNABLES";

/// Starts this program once more in the same process, with all of them fixed, unless one is set already.
///
/// glibc can be told so only before `main`, or by a call that is not safe Rust. Nothing is open yet: process id,
/// arguments and standard streams stay as they are.
///
/// # Errors
/// The program cannot be started again; it can go on as it is.
pub fn fix_settings() -> io::Result<()> {
    let set = |name: &str| env::var_os(name).is_some();
    if !cfg!(all(target_os = "linux", target_env = "gnu"))
        || set(TUNABLES)
        || variables().iter().any(|(name, _)| set(name))
    {
        return Ok(());
    }
    let mut arguments = env::args_os();
    let mut again = Command::new(env::current_exe()?);
    if let Some(name) = arguments.next() {
        again.arg0(name);
    }
    again.args(arguments).envs(variables().map(|(name, bytes)| (name, bytes.to_string())));
    // It returns only where it fails.
    Err(again.exec())
}
