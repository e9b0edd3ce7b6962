//! HDF5, and MAT of version 7.3.
#![no_main]

use libfuzzer_sys::fuzz_target;
use rigcast::formats::hdf5;
use rigcast_fuzz::{check_parsed, plant};

// Compressed samples may be more than the bytes.
fuzz_target!(init: plant("hdf5"), |file: &[u8]| check_parsed(hdf5::read(file), usize::MAX));
