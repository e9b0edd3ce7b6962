//! CSV: whatever comes is a run of equally long, finite channels, or refused by a documented code.
#![no_main]

use libfuzzer_sys::fuzz_target;
use rigcast::formats::csv;
use rigcast_fuzz::{check_parsed, plant};

fuzz_target!(init: plant("csv"), |file: &[u8]| check_parsed(csv::read(file), file.len()));
