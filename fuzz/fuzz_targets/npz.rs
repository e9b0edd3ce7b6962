//! NPZ: an archive of NPY files.
#![no_main]

use libfuzzer_sys::fuzz_target;
use rigcast::formats::npz;
use rigcast_fuzz::{check_parsed, plant};

// Compressed samples may be more than the bytes.
fuzz_target!(init: plant("npz"), |file: &[u8]| check_parsed(npz::read(file), usize::MAX));
