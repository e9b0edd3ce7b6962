//! Forms: any bytes in any pieces are the same parts, or refused, and the reader keeps no more than a head.
#![no_main]

use libfuzzer_sys::fuzz_target;
use rigcast::formats::form_data::{Event, FormFault, FormReader, Part};
use rigcast_fuzz::plant;

fn read(body: &[u8], piece: usize) -> Result<Vec<(Part, Vec<u8>)>, FormFault> {
    let mut reader = FormReader::new("multipart/form-data; boundary=b")?;
    let mut parts: Vec<(Part, Vec<u8>)> = Vec::new();
    for piece in body.chunks(piece) {
        reader.push(piece);
        loop {
            match reader.next_event()? {
                Event::Part(part) => parts.push((part, Vec::new())),
                Event::Data(bytes) => parts.last_mut().expect("data follows a head").1.extend_from_slice(&bytes),
                Event::More | Event::End => break,
            }
        }
    }
    reader.finish().map(|()| parts)
}

fuzz_target!(init: plant("form_data"), |input: (u8, &[u8])| {
    let (piece, body) = input;
    let whole = read(body, body.len().max(1));
    let cut = read(body, usize::from(piece) + 1);
    assert_eq!(whole.is_ok(), cut.is_ok(), "{whole:?} {cut:?}");
    if let (Ok(whole), Ok(cut)) = (whole, cut) {
        assert_eq!(whole, cut);
    }
});
