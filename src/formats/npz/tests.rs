use std::io::{Cursor, Write};

use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

use super::*;

/// An NPY file.
fn npy(descr: &str, fortran: bool, shape: &str, data: &[u8]) -> Vec<u8> {
    let order = if fortran { "True" } else { "False" };
    let text = format!("{{'descr': '{descr}', 'fortran_order': {order}, 'shape': {shape}, }}\n");
    let mut file = b"\x93NUMPY\x01\0".to_vec();
    file.extend((text.len() as u16).to_le_bytes());
    file.extend(text.bytes());
    file.extend(data);
    file
}

fn doubles(values: &[f64]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

/// Text as NumPy stores it, three characters each.
fn texts(values: &[&str]) -> Vec<u8> {
    let points = values.iter().flat_map(|text| text.chars().map(u32::from).chain([0; 3]).take(3));
    points.flat_map(u32::to_le_bytes).collect()
}

fn archive_of(entries: &[(&str, Vec<u8>)], method: CompressionMethod) -> Vec<u8> {
    let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
    for (name, data) in entries {
        let options = SimpleFileOptions::default().compression_method(method).large_file(true);
        archive.start_file(*name, options).unwrap();
        archive.write_all(data).unwrap();
    }
    archive.finish().unwrap().into_inner()
}

fn stored(entries: &[(&str, Vec<u8>)]) -> Vec<u8> {
    archive_of(entries, CompressionMethod::Stored)
}

fn error(name: &str, data: Vec<u8>) -> (&'static str, String) {
    let error = read(&stored(&[("u.npy", npy("<f8", false, "(2,)", &doubles(&[1.0, 2.0]))), (name, data)]));
    let error = error.unwrap_err();
    (error.code(), error.to_string())
}

#[test]
fn arrays_are_channels_of_their_names_stored_or_compressed() {
    let entries = [
        ("force_x.npy", npy("<f8", false, "(3,)", &doubles(&[1.0, -2.5, 3.0]))),
        ("y.npy", npy(">i2", false, "(3, 1)", &[0, 1, 0xFF, 0xFF, 0x80, 0])),
        ("t.npy", npy("<f8", false, "(3,)", &doubles(&[0.5, 0.75, 1.0]))),
        ("comment.npy", npy("<U3", false, "()", &texts(&["abc"]))),
    ];
    for method in [CompressionMethod::Stored, CompressionMethod::Deflated] {
        let run = read(&archive_of(&entries, method)).unwrap();
        assert_eq!(run.channels, [[1.0, -2.5, 3.0], [1.0, -1.0, -32768.0]]);
        assert_eq!((run.names.unwrap(), run.sample_rate_hz), (vec!["force_x".into(), "y".into()], Some(4.0)));
    }
}

#[test]
fn a_matrix_of_either_order_holds_a_channel_a_column() {
    for (fortran, values) in [(false, [1.0, 4.0, 2.0, 5.0, 3.0, 6.0]), (true, [1.0, 2.0, 3.0, 4.0, 5.0, 6.0])]
    {
        let entries = [
            ("data.npy", npy("<f8", fortran, "(3, 2)", &doubles(&values))),
            ("names.npy", npy("<U3", false, "(2,)", &texts(&["u", "y_1"]))),
            ("units.npy", npy("<U3", false, "(2,)", &texts(&["kN", "mm"]))),
            ("fs.npy", npy("<i8", false, "()", &1000_i64.to_le_bytes())),
        ];
        let run = read(&stored(&entries)).unwrap();
        assert_eq!(run.channels, [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]);
        assert_eq!(run.names.unwrap(), ["u", "y_1"]);
        assert_eq!((run.units.unwrap(), run.sample_rate_hz), (vec!["kN".into(), "mm".into()], Some(1000.0)));
    }
}

#[test]
fn numbered_arrays_name_no_channels() {
    let vector = npy("<f8", false, "(2,)", &doubles(&[1.0, 2.0]));
    let run = read(&stored(&[("arr_0.npy", vector.clone()), ("arr_1.npy", vector)])).unwrap();
    assert_eq!((run.names, run.channels.len()), (None, 2));
}

#[test]
fn long_channels_come_whole() {
    let ramp: Vec<f64> = (0..60_000).map(f64::from).collect();
    let entries = [("data.npy", npy("<f8", false, "(20000, 3)", &doubles(&ramp)))];
    let run = read(&archive_of(&entries, CompressionMethod::Deflated)).unwrap();
    for (first, channel) in run.channels.iter().enumerate() {
        assert!(channel.iter().copied().eq((first..60_000).step_by(3).map(|n| n as f64)));
    }
}

#[test]
fn arrays_that_are_no_channels_are_refused_by_name() {
    for (data, code, reason) in [
        (npy("<c16", false, "(2,)", &[0; 32]), "variables.unsupported", "the dtype <c16"),
        (npy("|O", false, "(2,)", &[0; 32]), "variables.unsupported", "the dtype |O"),
        (npy("|S3", false, "(2,)", &[0; 6]), "variables.unsupported", "str"),
        (npy("<f2", false, "(2,)", &[0; 4]), "variables.unsupported", "the dtype <f2"),
        (npy("<f8", false, "(2, 2, 2)", &[0; 64]), "variables.unsupported", "[samples, channels]"),
        (npy("<f8", false, "(2, 5000)", &[0; 64]), "run.too_many_channels", "5001"),
        (npy("<f8", false, "(3,)", &[0; 24]), "run.unequal_lengths", "\"z\""),
        (npy("<f8", false, "(2,)", &doubles(&[f64::INFINITY, 0.0])), "run.non_finite", "\"z\""),
        (npy("<f8", false, "(3,)", &[0; 16]), "npz.invalid", "ends"),
        (npy("<f8", false, "(2,)", &[0; 24]), "npz.invalid", "more bytes"),
        (npy("<f8", false, "(18446744073709551615, 2)", &[0; 24]), "npz.invalid", "ends"),
        (b"no array at all".to_vec(), "npy.header", "magic"),
        (b"\x93NUMPY\x01\0\xff\xff{".to_vec(), "npz.invalid", "ends"),
        (Vec::new(), "npz.invalid", "ends"),
    ] {
        let (found, text) = error("z.npy", data);
        assert!(found == code && text.contains(reason), "{found}: {text}");
    }
    assert_eq!(error("readme.txt", Vec::new()).0, "npz.invalid");
    assert_eq!(error("names.npy", npy("<U300000000", false, "(9,)", &[])).0, "variables.unsupported");
}

#[test]
fn damaged_archives_are_refused() {
    let vector = npy("<f8", false, "(2,)", &doubles(&[1.0, 2.0]));
    for method in [CompressionMethod::Stored, CompressionMethod::Deflated] {
        let whole = archive_of(&[("u.npy", vector.clone())], method);
        // The directory at the end is not read.
        let end = memchr::memmem::find(&whole, b"PK\x01\x02").unwrap();
        for len in 0..end {
            assert!(read(&whole[..len]).is_err(), "{len} bytes");
        }
        // Methods that are not read: any but stored and deflated.
        for unknown in [1, 6, 12, 93, 99] {
            let mut other = whole.clone();
            other[8] = unknown;
            assert_eq!(read(&other).unwrap_err().code(), "npz.invalid", "method {unknown}");
        }
        // The checksum tells a changed number.
        let mut changed = whole.clone();
        changed[end - 3] ^= 1;
        assert_eq!(read(&changed).unwrap_err().code(), "npz.invalid");
    }
}

#[test]
fn a_file_does_not_become_more_than_its_limit() {
    let zeros = npy("<f8", false, "(40000000,)", &vec![0; 320_000_000]);
    let file = archive_of(&[("u.npy", zeros)], CompressionMethod::Deflated);
    assert!(file.len() < 1 << 20);
    assert_eq!(read(&file).unwrap_err().code(), "file.unpacked_size");
}
