//! Runs as JSON.
#![no_main]

use libfuzzer_sys::fuzz_target;
use rigcast::formats::json;
use rigcast_fuzz::{check_parsed, plant};

fuzz_target!(init: plant("run_json"), |file: &[u8]| check_parsed(json::read(file), file.len()));
