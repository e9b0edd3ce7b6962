//! CSV: any input is a run of equally long, finite channels, or refused with a documented code.
#![no_main]

use libfuzzer_sys::fuzz_target;
use rigcast::formats::csv;
use rigcast_fuzz::{check_parsed, plant};

fuzz_target!(init: plant("csv"), |file: &[u8]| check_parsed(csv::read(file), file.len()));
