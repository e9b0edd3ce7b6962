//! MAT of version 5, compressed or not.
#![no_main]

use libfuzzer_sys::fuzz_target;
use rigcast::formats::mat;
use rigcast_fuzz::{check_parsed, plant};

// Compressed samples may be more than the bytes.
fuzz_target!(init: plant("mat"), |file: &[u8]| check_parsed(mat::read(file), usize::MAX));
