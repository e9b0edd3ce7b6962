//! UFF, data sets 58 as text and as binary numbers.
#![no_main]

use libfuzzer_sys::fuzz_target;
use rigcast::formats::uff58;
use rigcast_fuzz::{check_parsed, plant};

fuzz_target!(init: plant("uff58"), |file: &[u8]| check_parsed(uff58::read(file), file.len()));
