use hdf5_pure::FileBuilder;

use super::*;

fn built(build: impl FnOnce(&mut FileBuilder)) -> Vec<u8> {
    let mut file = FileBuilder::new();
    build(&mut file);
    file.finish().unwrap()
}

fn error(build: impl FnOnce(&mut FileBuilder)) -> (&'static str, String) {
    let error = read(&built(build)).unwrap_err();
    (error.code(), error.to_string())
}

#[test]
fn datasets_are_channels_with_their_units_and_rate() {
    let run = read(&built(|file| {
        file.set_attr("fs", AttrValue::F64(512.0));
        file.create_dataset("y").with_i16_data(&[1, -2, 300]).with_shape(&[3]);
        let mut group = file.create_group("drives");
        let drive = group.create_dataset("u").with_f64_data(&[0.5, 1.5, -2.5]).with_shape(&[3]);
        drive.set_attr("unit", AttrValue::String("kN".into()));
        file.add_group(group.finish());
    }))
    .unwrap();
    assert_eq!(
        (run.names.unwrap(), run.units.unwrap()),
        (vec!["y".into(), "u".into()], vec!["".into(), "kN".into()])
    );
    assert_eq!(run.channels, [[1.0, -2.0, 300.0], [0.5, 1.5, -2.5]]);
    assert_eq!(run.sample_rate_hz, Some(512.0));
}

#[test]
fn a_matrix_holds_a_channel_a_column_and_matlabs_a_channel_a_row() {
    let values = [1.0, 4.0, 2.0, 5.0, 3.0, 6.0];
    let run = read(&built(|file| {
        file.create_dataset("data").with_f64_data(&values).with_shape(&[3, 2]);
        file.create_dataset("t").with_f64_data(&[0.0, 0.5, 1.0]).with_shape(&[3]);
    }))
    .unwrap();
    assert_eq!((run.names, run.channels), (None, vec![vec![1.0, 2.0, 3.0], vec![4.0, 5.0, 6.0]]));
    assert_eq!(run.sample_rate_hz, Some(2.0));
    let run = read(&built(|file| {
        let data = file.create_dataset("data").with_f64_data(&values).with_shape(&[2, 3]);
        data.set_attr("MATLAB_class", AttrValue::AsciiString("double".into()));
    }))
    .unwrap();
    assert_eq!(run.channels, [[1.0, 4.0, 2.0], [5.0, 3.0, 6.0]]);
}

#[test]
fn long_channels_come_whole_from_chunks() {
    let ramp: Vec<f64> = (0..1_200_000).map(f64::from).collect();
    let run = read(&built(|file| {
        let data = file.create_dataset("data").with_f64_data(&ramp).with_shape(&[600_000, 2]);
        data.with_chunks(&[1000, 2]).with_deflate(1);
    }))
    .unwrap();
    for (first, channel) in run.channels.iter().enumerate() {
        assert!(channel.iter().copied().eq((first..1_200_000).step_by(2).map(|n| n as f64)));
    }
}

#[test]
fn channels_of_matlab_come_whole_from_chunks_that_hold_several() {
    // Of a size of which not all channels are read at once.
    let (samples, channels) = (1_500_000, 9);
    let ramp: Vec<f64> = (0..channels * samples).map(|n| n as f64).collect();
    let run = read(&built(|file| {
        let data =
            file.create_dataset("data").with_f64_data(&ramp).with_shape(&[channels as u64, samples as u64]);
        data.with_chunks(&[4, 100_000]).set_attr("MATLAB_class", AttrValue::AsciiString("double".into()));
    }))
    .unwrap();
    assert_eq!(run.channels.len(), channels);
    assert!(run.channels.concat() == ramp);
}

#[test]
fn chunks_are_bounded_in_number_and_size() {
    for (shape, chunk, reason) in
        [(1_100_000, 1, "1100000 chunks"), (11_000_000, 11_000_000, "chunks of 88000000 bytes")]
    {
        let (code, text) = error(|file| {
            let data = file.create_dataset("u").with_i8_data(&vec![0; shape]).with_shape(&[shape as u64]);
            data.with_chunks(&[chunk]);
        });
        assert!(code == "variables.unsupported" && text.contains(reason), "{code}: {text}");
    }
}

#[test]
fn datasets_that_are_no_channels_are_refused_by_name() {
    let u = |file: &mut FileBuilder| {
        file.create_dataset("u").with_f64_data(&[1.0, 2.0]).with_shape(&[2]);
    };
    for class in ["cell", "function_handle", "struct", "string"] {
        let (code, text) = error(|file| {
            u(file);
            let data = file.create_dataset("z").with_u64_data(&[1, 2]).with_shape(&[2]);
            data.set_attr("MATLAB_class", AttrValue::AsciiString(class.into()));
        });
        assert_eq!(code, "variables.unsupported");
        assert!(text.starts_with(&format!("variable \"z\" is of MATLAB's class {class}")), "{text}");
    }
    let (code, text) = error(|file| {
        u(file);
        file.create_dataset("z").with_complex64_data(&[(1.0, 2.0), (0.0, 1.0)]).with_shape(&[2]);
    });
    assert!(code == "variables.unsupported" && text.contains("complex"), "{text}");
    let (code, text) = error(|file| {
        u(file);
        file.create_dataset("y").with_f64_data(&[1.0, f64::NAN]).with_shape(&[2]);
    });
    assert_eq!(code, "run.non_finite", "{text}");
    let (code, text) = error(|file| {
        u(file);
        file.create_dataset("z").with_f64_data(&[0.0; 8]).with_shape(&[2, 2, 2]);
    });
    assert!(code == "variables.unsupported" && text.contains("[samples, channels]"), "{text}");
    assert_eq!(error(|_| ()).0, "run.no_channels");
}

#[test]
fn groups_are_read_to_a_depth() {
    let nested = |depth: usize| {
        built(|file| {
            let mut group = file.create_group("g");
            group.create_dataset("u").with_f64_data(&[1.0, 2.0]).with_shape(&[2]);
            let mut group = group.finish();
            for _ in 1..depth {
                let mut outer = file.create_group("g");
                outer.add_group(group);
                group = outer.finish();
            }
            file.add_group(group);
        })
    };
    assert_eq!(read(&nested(8)).unwrap().names.unwrap(), ["u"]);
    assert_eq!(read(&nested(9)).unwrap_err().code(), "variables.unsupported");
}

#[test]
fn damaged_files_are_refused() {
    let whole = built(|file| {
        file.create_dataset("u").with_f64_data(&[1.0, 2.0]).with_shape(&[2]);
    });
    for len in 0..whole.len() {
        let error = read(&whole[..len]).unwrap_err();
        assert!(["hdf5.invalid", "file.unpacked_size"].contains(&error.code()), "{len} bytes: {error}");
    }
    for at in 0..whole.len() {
        for bit in 0..8 {
            let mut damaged = whole.clone();
            damaged[at] ^= 1 << bit;
            // Any answer will do but a panic or a number that is not finite.
            if let Ok(run) = read(&damaged) {
                assert!(run.channels.iter().flatten().all(|v| v.is_finite()));
            }
        }
    }
}
