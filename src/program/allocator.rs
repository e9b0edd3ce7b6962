//! When memory that the service has freed goes back to the system.
//!
//! glibc raises its two thresholds by itself: a freed block of its own, up to 32 MiB, lets later blocks of that size
//! come from the heap, and up to twice as much may then stay free at the heap's end. After a few large predictions
//! the service so keeps hundreds of MiB that nothing uses. With fixed thresholds it keeps at most [`TRIM_BYTES`].

use std::env;
use std::io;
use std::os::unix::process::CommandExt;
use std::process::Command;

/// Blocks from this size on are of their own, and go back as they are freed. Most requests have none: it is five
/// minutes of three channels at 1 kHz.
const MMAP_BYTES: usize = 8 << 20;

/// Free memory at the heap's end that is kept.
const TRIM_BYTES: usize = 16 << 20;

/// Variables that glibc reads once, before `main`. Other systems ignore them.
const VARIABLES: [(&str, usize); 2] =
    [("MALLOC_MMAP_THRESHOLD_", MMAP_BYTES), ("MALLOC_TRIM_THRESHOLD_", TRIM_BYTES)];

/// A variable by which the one who starts the program sets these and more.
const TUNABLES: &str = "GLIBC_TUNABLES";

/// Starts this program once more in the same process, with both thresholds fixed, unless they are set already.
///
/// glibc can be told so only before `main`, or by a call that is not safe Rust. Nothing is open yet: process id,
/// arguments and standard streams stay as they are.
///
/// # Errors
/// The program cannot be started again; it can go on as it is.
pub fn fix_thresholds() -> io::Result<()> {
    let set = |name: &str| env::var_os(name).is_some();
    if !cfg!(all(target_os = "linux", target_env = "gnu"))
        || set(TUNABLES)
        || VARIABLES.iter().any(|(name, _)| set(name))
    {
        return Ok(());
    }
    let mut arguments = env::args_os();
    let mut again = Command::new(env::current_exe()?);
    if let Some(name) = arguments.next() {
        again.arg0(name);
    }
    again.args(arguments).envs(VARIABLES.map(|(name, bytes)| (name, bytes.to_string())));
    // It returns only where it fails.
    Err(again.exec())
}
