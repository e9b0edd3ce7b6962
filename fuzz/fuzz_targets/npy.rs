//! NPY: the header alone, and the whole file.
#![no_main]

use libfuzzer_sys::fuzz_target;
use rigcast::formats::npy;
use rigcast_fuzz::{check_parsed, plant};

fuzz_target!(init: plant("npy"), |file: &[u8]| {
    if let Ok(header) = npy::header(file) {
        let data = header.samples * header.channels * header.dtype.size();
        assert_eq!(header.data_offset + data, file.len(), "its sizes are those of the file");
    }
    check_parsed(npy::read(file), file.len());
});
