//! Files of other programs, broken files, and our own.

use proptest::prelude::*;

use super::*;

/// A version 1.0 file with this header text and data.
fn file(text: &str, data: &[u8]) -> Vec<u8> {
    let mut file = b"\x93NUMPY\x01\x00".to_vec();
    file.extend((text.len() as u16).to_le_bytes());
    file.extend(text.as_bytes());
    file.extend(data);
    file
}

fn plain(descr: &str, fortran: bool, shape: &str, data: &[u8]) -> Vec<u8> {
    let fortran = if fortran { "True" } else { "False" };
    file(&format!("{{'descr': '{descr}', 'fortran_order': {fortran}, 'shape': {shape}, }}     \n"), data)
}

#[test]
fn every_type_and_order_reads_as_channels() {
    let expected = [vec![1.0, 3.0, 5.0], vec![-2.0, 4.0, 6.0]];
    let (c, f) = ([1i16, -2, 3, 4, 5, 6], [1i16, 3, 5, -2, 4, 6]);
    for (fortran, numbers) in [(false, c), (true, f)] {
        let bytes = |of: &dyn Fn(i16) -> Vec<u8>| numbers.iter().flat_map(|&v| of(v)).collect::<Vec<u8>>();
        for (descr, data) in [
            ("<f4", bytes(&|v| f32::from(v).to_le_bytes().to_vec())),
            (">f4", bytes(&|v| f32::from(v).to_be_bytes().to_vec())),
            ("<f8", bytes(&|v| f64::from(v).to_le_bytes().to_vec())),
            (">f8", bytes(&|v| f64::from(v).to_be_bytes().to_vec())),
            ("<i2", bytes(&|v| v.to_le_bytes().to_vec())),
            (">i2", bytes(&|v| v.to_be_bytes().to_vec())),
            ("<i4", bytes(&|v| i32::from(v).to_le_bytes().to_vec())),
            (">i4", bytes(&|v| i32::from(v).to_be_bytes().to_vec())),
        ] {
            let run = read(&plain(descr, fortran, "(3, 2)", &data)).unwrap();
            assert_eq!(run.channels, expected, "{descr} fortran {fortran}");
            assert_eq!((run.names, run.units, run.sample_rate_hz), (None, None, None));
        }
    }
}

#[test]
fn one_dimension_is_one_channel_in_every_spelling() {
    let data: Vec<u8> = [1.5f64, 2.5].iter().flat_map(|v| v.to_le_bytes()).collect();
    for shape in ["(2,)", "( 2 , )", "(2L,)", "(2)", "(2, 1)"] {
        assert_eq!(read(&plain("<f8", false, shape, &data)).unwrap().channels, [[1.5, 2.5]], "{shape}");
    }
    let other = r#"{"shape":(2,),"fortran_order":False,"descr":"<f8"}"#;
    assert_eq!(read(&file(other, &data)).unwrap().channels, [[1.5, 2.5]]);
}

#[test]
fn versions_two_and_three_have_a_longer_length() {
    let text = "{'descr': '<f8', 'fortran_order': False, 'shape': (1,)}\n";
    for version in [2, 3] {
        let mut file = b"\x93NUMPY".to_vec();
        file.extend([version, 0]);
        file.extend((text.len() as u32).to_le_bytes());
        file.extend(text.as_bytes());
        file.extend(7.0f64.to_le_bytes());
        assert_eq!(read(&file).unwrap().channels, [[7.0]]);
    }
}

#[test]
fn types_that_are_not_read_are_refused_as_they_stand() {
    for descr in ["|O", "<f2", "<f16", "<c8", "<U5", "|S3", "|b1", "<i8", "<u4", "=f8", "f8", "", "é8"] {
        let error = read(&plain(descr, false, "(1,)", &[0; 8])).unwrap_err();
        assert_eq!(error, FormatError::NpyDtype { found: descr.into() });
        assert_eq!(error.code(), "npy.dtype");
    }
    let text = "{'descr': [('a', '<f4'), ('b', '<i4')], 'fortran_order': False, 'shape': (1,), }";
    let error = read(&file(text, &[0; 8])).unwrap_err();
    assert_eq!(error, FormatError::NpyDtype { found: "[('a', '<f4'), ('b', '<i4')]".into() });
}

#[test]
fn shapes_are_compared_with_the_bytes_before_anything_is_allocated() {
    let refused = |shape: &str, data: &[u8]| read(&plain("<f8", false, shape, data)).unwrap_err();
    assert_eq!(refused("(3, 2)", &[0; 47]), FormatError::NpyTruncated { expected: 48, found: 47 });
    assert_eq!(refused("(3, 2)", &[0; 49]), FormatError::NpyTrailing { expected: 48, found: 49 });
    assert_eq!(
        refused("(1000000000000000, 2)", &[0; 16]),
        FormatError::NpyTruncated { expected: 16_000_000_000_000_000, found: 16 }
    );
    let huge = refused("(18446744073709551615, 18446744073709551615)", &[0; 16]);
    assert_eq!(huge, FormatError::NpyShape { found: vec![u64::MAX, u64::MAX] });
    assert_eq!(refused("(1, 2, 3)", &[0; 48]), FormatError::NpyShape { found: vec![1, 2, 3] });
    assert_eq!(refused("()", &[0; 8]), FormatError::NpyShape { found: vec![] });
    assert_eq!(refused("(0, 2)", &[]).code(), "run.empty");
    assert_eq!(refused("(2, 0)", &[]).code(), "run.no_channels");
    assert_eq!(refused("(1, 2000)", &[0; 16_000]).code(), "run.too_many_channels");
    for shape in ["(-1, 2)", "(1.0,)", "(18446744073709551616,)", "[1]", "(1,,2)", "(1", "((1,))"] {
        assert_eq!(refused(shape, &[0; 8]).code(), "npy.header", "{shape}");
    }
}

#[test]
fn broken_headers_are_refused_at_every_length() {
    let good = plain("<f8", false, "(2,)", &[0; 16]);
    assert!(read(&good).is_ok());
    for len in 0..good.len() {
        let code = read(&good[..len]).unwrap_err().code();
        assert!(matches!(code, "npy.header" | "npy.truncated"), "{len}: {code}");
    }
    for text in [
        "",
        "{}",
        "[1]",
        "{'descr': '<f8', 'fortran_order': False}",
        "{'descr': '<f8', 'fortran_order': 0, 'shape': (1,)}",
        "{'descr': '<f8', 'descr': '<f8', 'fortran_order': False, 'shape': (1,)}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (1,), 'more': 1}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (1,)} 1",
        "{'descr': '<f8' 'fortran_order': False, 'shape': (1,)}",
        "{'descr",
    ] {
        assert_eq!(read(&file(text, &[0; 8])).unwrap_err().code(), "npy.header", "{text}");
    }
    let deep = format!("{{'descr': {}", "[".repeat(60_000));
    assert_eq!(read(&file(&deep, &[])).unwrap_err().code(), "npy.dtype");
    let mut long = b"\x93NUMPY\x02\x00".to_vec();
    long.extend(100_000_u32.to_le_bytes());
    long.resize(200_000, b' ');
    assert_eq!(read(&long).unwrap_err(), FormatError::NpyHeader("the header is longer than 64 KiB"));
    let mut old = good.clone();
    old[6] = 9;
    assert_eq!(read(&old).unwrap_err().code(), "npy.header");
}

#[test]
fn not_finite_numbers_are_named_by_channel_and_sample() {
    let data: Vec<u8> = [0.0, 1.0, 2.0, f64::NAN].iter().flat_map(|v| v.to_le_bytes()).collect();
    let error = read(&plain("<f8", false, "(2, 2)", &data)).unwrap_err();
    assert_eq!((error.code(), error.channel_index(), error.sample()), ("run.non_finite", Some(1), Some(1)));
    let error = read(&plain("<f8", true, "(4, 1)", &data)).unwrap_err();
    assert_eq!((error.channel_index(), error.sample()), (Some(0), Some(3)));
}

#[test]
fn nothing_that_is_not_finite_is_written() {
    let error = write(&[vec![0.0, 1e300]], Dtype::F4, Order::C).unwrap_err();
    assert_eq!((error.code(), error.channel_index(), error.sample()), ("run.non_finite", Some(0), Some(1)));
    assert!(write(&[vec![0.0], vec![f64::NAN]], Dtype::F8, Order::Fortran).is_err());
    assert_eq!(write(&[], Dtype::F8, Order::C).unwrap_err().code(), "run.no_channels");
    let error = write(&[vec![0.0], vec![]], Dtype::F8, Order::C).unwrap_err();
    assert_eq!((error.code(), error.channel_index()), ("run.unequal_lengths", Some(1)));
}

#[test]
fn numbers_begin_where_the_header_says_and_on_a_multiple_of_64() {
    let file = write(&[vec![1.0, 2.0], vec![3.0, 4.0]], Dtype::F8, Order::Fortran).unwrap();
    let header = header(&file).unwrap();
    assert_eq!((header.samples, header.channels, header.order), (2, 2, Order::Fortran));
    assert_eq!(header.data_offset % 64, 0);
    let at = header.data_offset + 8 * 2;
    assert_eq!(file[at..at + 8], 3.0f64.to_le_bytes());
}

fn channels() -> impl Strategy<Value = Vec<Vec<f64>>> {
    (1usize..5, 1usize..40)
        .prop_flat_map(|(c, n)| prop::collection::vec(prop::collection::vec(prop::num::f64::NORMAL, n), c))
}

proptest! {
    #[test]
    fn what_is_written_reads_back_and_npyz_agrees(channels in channels(), fortran: bool) {
        let order = if fortran { Order::Fortran } else { Order::C };
        let file = write(&channels, Dtype::F8, order).unwrap();
        prop_assert_eq!(&read(&file).unwrap().channels, &channels);
        let theirs = npyz::NpyFile::new(&file[..]).unwrap();
        prop_assert_eq!(theirs.shape(), [channels[0].len() as u64, channels.len() as u64]);
        let strides = theirs.strides().to_vec();
        let flat: Vec<f64> = theirs.into_vec().unwrap();
        for (c, samples) in channels.iter().enumerate() {
            for (i, v) in samples.iter().enumerate() {
                prop_assert_eq!(flat[i * strides[0] as usize + c * strides[1] as usize], *v);
            }
        }
    }

    #[test]
    fn single_precision_rounds_once(
        channels in prop::collection::vec(prop::collection::vec(-1e30..1e30f64, 7), 1..4)
    ) {
        let rounded: Vec<Vec<f64>> =
            channels.iter().map(|c| c.iter().map(|&v| f64::from(v as f32)).collect()).collect();
        let file = write(&channels, Dtype::F4, Order::C).unwrap();
        prop_assert_eq!(read(&file).unwrap().channels, rounded);
    }

    #[test]
    fn any_bytes_are_read_or_refused(bytes in prop::collection::vec(any::<u8>(), 0..200), prefix: bool) {
        let bytes = if prefix { plain("<f8", false, "(2, 3)", &bytes) } else { bytes };
        if let Ok(run) = read(&bytes) {
            prop_assert_eq!(run.channels.len(), 3);
        }
    }
}
