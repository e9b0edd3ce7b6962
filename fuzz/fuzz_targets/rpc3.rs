//! RPC III in all its readings.
#![no_main]

use libfuzzer_sys::fuzz_target;
use rigcast::formats::rpc3::{self, Padding, Reading, ScaleConvention};
use rigcast_fuzz::{check_parsed, plant};

fuzz_target!(init: plant("rpc3"), |file: &[u8]| {
    for (padding, scale) in
        [(Padding::Strip, ScaleConvention::Count), (Padding::Keep, ScaleConvention::FullScale)]
    {
        check_parsed(rpc3::read(file, Reading { padding, scale }), file.len());
    }
});
