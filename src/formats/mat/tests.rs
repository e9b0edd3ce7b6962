use std::io::Write;

use flate2::Compression;
use flate2::write::ZlibEncoder;

use super::*;

/// Writes files of one byte order.
#[derive(Clone, Copy)]
struct File {
    big_endian: bool,
}

const LITTLE: File = File { big_endian: false };

/// A class, its flags, and the type of its numbers.
const DOUBLE: (u32, u32, u32) = (6, 0, 9);

impl File {
    fn word(self, n: u32) -> [u8; 4] {
        if self.big_endian { n.to_be_bytes() } else { n.to_le_bytes() }
    }

    fn element(self, kind: u32, data: &[u8]) -> Vec<u8> {
        let mut bytes = [self.word(kind), self.word(data.len() as u32)].concat();
        bytes.extend(data);
        bytes.resize(bytes.len().next_multiple_of(8), 0);
        bytes
    }

    /// A tag with its data, at most four bytes.
    fn small(self, kind: u32, data: &[u8]) -> Vec<u8> {
        let mut bytes = self.word((data.len() as u32) << 16 | kind).to_vec();
        bytes.extend(data);
        bytes.resize(8, 0);
        bytes
    }

    fn array(self, class: u32, flags: u32, shape: &[u32], name: &str, content: &[u8]) -> Vec<u8> {
        let shape: Vec<u8> = shape.iter().flat_map(|&n| self.word(n)).collect();
        let name = match name.len() {
            1..=4 => self.small(1, name.as_bytes()),
            _ => self.element(1, name.as_bytes()),
        };
        let flags = [self.word(class | flags), self.word(0)].concat();
        self.element(14, &[self.element(6, &flags), self.element(5, &shape), name, content.to_vec()].concat())
    }

    fn doubles(self, values: &[f64]) -> Vec<u8> {
        let bytes = |v: &f64| if self.big_endian { v.to_be_bytes() } else { v.to_le_bytes() };
        self.element(9, &values.iter().flat_map(bytes).collect::<Vec<u8>>())
    }

    fn variable(self, name: &str, shape: [u32; 2], values: &[f64]) -> Vec<u8> {
        self.array(DOUBLE.0, DOUBLE.1, &shape, name, &self.doubles(values))
    }

    /// Text in 16 bits a character.
    fn text(self, name: &str, rows: &[&str]) -> Vec<u8> {
        let columns = rows[0].len();
        let units = (0..columns).flat_map(|c| rows.iter().map(move |row| u16::from(row.as_bytes()[c])));
        let bytes = units.flat_map(|u| if self.big_endian { u.to_be_bytes() } else { u.to_le_bytes() });
        let data = self.element(4, &bytes.collect::<Vec<u8>>());
        self.array(4, 0, &[rows.len() as u32, columns as u32], name, &data)
    }

    fn of(self, variables: &[Vec<u8>]) -> Vec<u8> {
        let mut file = format!("{:116}\0\0\0\0\0\0\0\0", "MATLAB 5.0 MAT-file").into_bytes();
        file.extend(if self.big_endian { *b"\x01\0MI" } else { *b"\0\x01IM" });
        file.extend(variables.concat());
        file
    }

    fn compressed(self, variable: &[u8]) -> Vec<u8> {
        let mut packer = ZlibEncoder::new(Vec::new(), Compression::default());
        packer.write_all(variable).unwrap();
        let data = packer.finish().unwrap();
        // Not padded.
        [&self.word(15)[..], &self.word(data.len() as u32), &data].concat()
    }
}

/// A struct of these fields.
fn structure(file: File, name: &str, shape: [u32; 2], fields: &[(&str, Vec<u8>)]) -> Vec<u8> {
    let names: Vec<u8> = fields.iter().flat_map(|(name, _)| format!("{name:\0<8}").into_bytes()).collect();
    let fields: Vec<u8> = fields.iter().flat_map(|(_, field)| field.clone()).collect();
    let content = [file.small(5, &file.word(8)), file.element(1, &names), fields].concat();
    file.array(2, 0, &shape, name, &content)
}

fn error(variable: Vec<u8>) -> (&'static str, String) {
    let error = read(&LITTLE.of(&[LITTLE.variable("u", [2, 1], &[1.0, 2.0]), variable])).unwrap_err();
    (error.code(), error.to_string())
}

#[test]
fn vectors_are_channels_of_their_names_in_either_byte_order() {
    for big_endian in [false, true] {
        let file = File { big_endian };
        let variables = [
            file.variable("u", [3, 1], &[1.0, -2.5, 3.0]),
            file.variable("force_x", [1, 3], &[0.25, 0.0, 1e9]),
            file.variable("fs", [1, 1], &[512.0]),
            file.text("comment", &["of the rig"]),
        ];
        for compress in [false, true] {
            let pack = |v: &Vec<u8>| if compress { file.compressed(v) } else { v.clone() };
            let run = read(&file.of(&variables.iter().map(pack).collect::<Vec<_>>())).unwrap();
            assert_eq!(run.channels, [[1.0, -2.5, 3.0], [0.25, 0.0, 1e9]]);
            assert_eq!(run.names.unwrap(), ["u", "force_x"]);
            assert_eq!((run.sample_rate_hz, run.units), (Some(512.0), None));
        }
    }
}

#[test]
fn a_matrix_holds_a_channel_a_column_and_text_labels_them() {
    let matrix = LITTLE.variable("data", [3, 2], &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
    let run = read(&LITTLE.of(std::slice::from_ref(&matrix))).unwrap();
    assert_eq!((run.names, run.channels), (None, vec![vec![1.0, 2.0, 3.0], vec![4.0, 5.0, 6.0]]));

    let cells = [LITTLE.text("", &["drive_x"]), LITTLE.text("", &["y"])].concat();
    let names = LITTLE.array(1, 0, &[1, 2], "names", &cells);
    let units = LITTLE.text("units", &["kN", "mm"]);
    let times = LITTLE.variable("t", [3, 1], &[0.0, 0.01, 0.02]);
    let run = read(&LITTLE.of(&[names.clone(), matrix.clone(), units, times])).unwrap();
    assert_eq!(
        (run.names.unwrap(), run.units.unwrap()),
        (vec!["drive_x".into(), "y".into()], vec!["kN".into(), "mm".into()])
    );
    assert_eq!(run.sample_rate_hz, Some(100.0));

    let error = read(&LITTLE.of(&[names, LITTLE.variable("u", [2, 1], &[1.0, 2.0])])).unwrap_err();
    assert_eq!(error.to_string(), "variable \"names\" holds 2 labels for 1 channels");
    let two = read(&LITTLE.of(&[matrix, LITTLE.variable("u", [3, 1], &[0.0; 3])])).unwrap();
    assert_eq!(two.names.unwrap(), ["data_1", "data_2", "u"]);
}

#[test]
fn numbers_are_of_the_type_that_they_are_stored_in() {
    // MATLAB stores doubles that are small whole numbers in a byte.
    let bytes = LITTLE.array(6, 0, &[1, 3], "u", &LITTLE.small(2, &[0, 7, 255]));
    let shorts = LITTLE.array(10, 0, &[3, 1], "i", &LITTLE.element(3, &[0, 0x80, 1, 0, 0xFF, 0x7F]));
    let run = read(&LITTLE.of(&[bytes, shorts])).unwrap();
    assert_eq!(run.channels, [[0.0, 7.0, 255.0], [-32768.0, 1.0, 32767.0]]);
}

#[test]
fn long_channels_come_whole() {
    let ramp: Vec<f64> = (0..50_000).map(f64::from).collect();
    let variable = LITTLE.variable("data", [25_000, 2], &ramp);
    for variable in [LITTLE.compressed(&variable), variable] {
        let run = read(&LITTLE.of(&[variable])).unwrap();
        assert_eq!(run.channels.concat(), ramp);
    }
}

#[test]
fn fields_of_a_struct_are_variables() {
    let field = |values: &[f64]| LITTLE.variable("", [values.len() as u32, 1], values);
    let inner = structure(LITTLE, "", [1, 1], &[("y", field(&[3.0, 4.0]))]);
    let run =
        structure(LITTLE, "run", [1, 1], &[("u", field(&[1.0, 2.0])), ("out", inner), ("fs", field(&[8.0]))]);
    let read_run = read(&LITTLE.of(std::slice::from_ref(&run))).unwrap();
    assert_eq!(read_run.names.unwrap(), ["u", "y"]);
    assert_eq!(
        (read_run.channels, read_run.sample_rate_hz),
        (vec![vec![1.0, 2.0], vec![3.0, 4.0]], Some(8.0))
    );
    // Names that are not distinct are given with their struct's.
    let twice = read(&LITTLE.of(&[run, LITTLE.variable("u", [2, 1], &[1.0, 2.0])])).unwrap();
    assert_eq!(twice.names.unwrap(), ["run.u", "run.out.y", "u"]);

    let (code, text) = error(structure(LITTLE, "runs", [1, 2], &[]));
    assert_eq!(
        (code, text.as_str()),
        (
            "variables.unsupported",
            "variable \"runs\" is an array of structs, [1, 2] of them: one struct is read"
        )
    );
    let deep = (0..9).fold(field(&[1.0]), |inner, _| structure(LITTLE, "", [1, 1], &[("a", inner)]));
    let (code, text) = error(structure(LITTLE, "s", [1, 1], &[("a", deep)]));
    assert_eq!(code, "variables.unsupported", "{text}");
}

#[test]
fn variables_that_are_no_channels_are_refused_by_name() {
    let numbers = LITTLE.doubles(&[1.0, 2.0]);
    let complex = LITTLE.array(6, 0x0800, &[2, 1], "z", &[numbers.clone(), numbers.clone()].concat());
    let opaque = {
        let flags = [LITTLE.word(17), LITTLE.word(0)].concat();
        let parts = [
            LITTLE.element(6, &flags),
            LITTLE.small(1, b"z"),
            LITTLE.small(1, b"MCOS"),
            LITTLE.element(1, b"string"),
        ];
        LITTLE.element(14, &parts.concat())
    };
    for (variable, reason) in [
        (complex, "complex"),
        (opaque, "string"),
        (LITTLE.array(1, 0, &[1, 1], "z", &LITTLE.variable("", [1, 1], &[1.0])), "cell"),
        (LITTLE.array(16, 0, &[1, 1], "z", &[]), "function handle"),
        (LITTLE.array(5, 0, &[2, 1], "z", &numbers), "sparse"),
        (LITTLE.array(3, 0, &[1, 1], "z", &[]), "object"),
        (LITTLE.array(6, 0, &[2, 2, 2], "z", &LITTLE.doubles(&[0.0; 8])), "[samples, channels]"),
    ] {
        let (code, text) = error(variable);
        assert_eq!(code, "variables.unsupported");
        assert!(text.starts_with("variable \"z\"") && text.contains(reason), "{text}");
    }
    // Dimensions of one are no dimensions.
    let flat = LITTLE.array(6, 0, &[1, 2, 1, 2], "z", &LITTLE.doubles(&[1.0, 2.0, 3.0, 4.0]));
    assert_eq!(read(&LITTLE.of(&[flat])).unwrap().channels, [[1.0, 2.0], [3.0, 4.0]]);
    let (code, text) = error(LITTLE.variable("y", [3, 1], &[0.0; 3]));
    assert_eq!(
        (code, text.as_str()),
        ("run.unequal_lengths", "channel \"y\" has 3 samples, the first channel has 2")
    );
    let (code, _) = error(LITTLE.variable("y", [2, 1], &[0.0, f64::NAN]));
    assert_eq!(code, "run.non_finite");
    let (code, text) = error(LITTLE.variable("t", [2, 1], &[0.0, 0.0]));
    assert_eq!(code, "variables.uneven_time", "{text}");
}

#[test]
fn sample_rates_that_disagree_are_refused() {
    let given = |name: &str, value: f64| LITTLE.variable(name, [1, 1], &[value]);
    let u = LITTLE.variable("u", [3, 1], &[0.0; 3]);
    let rate = |more: &[Vec<u8>]| {
        read(&LITTLE.of(&[std::slice::from_ref(&u), more].concat())).map(|run| run.sample_rate_hz)
    };
    assert_eq!(rate(&[given("dt", 4.882_812_5e-4)]), Ok(Some(2048.0)));
    assert_eq!(rate(&[given("Fs", 100.0), given("dt", 0.01)]), Ok(Some(100.0)));
    assert_eq!(rate(&[given("fs", 100.0), given("dt", 0.02)]).unwrap_err().code(), "variables.unsupported");
    assert_eq!(rate(&[given("fs", -1.0)]).unwrap_err().code(), "run.sample_rate");
    let times = LITTLE.variable("time_ms", [3, 1], &[0.0, 10.0, 20.0]);
    assert_eq!(rate(std::slice::from_ref(&times)), Ok(Some(100.0)));
    let error = rate(&[times, given("fs", 10.0)]).unwrap_err();
    assert_eq!(error.to_string(), "variable \"time_ms\" gives 100 Hz, and \"fs\" gives 10 Hz");
}

#[test]
fn empty_arrays_and_lone_numbers_are_left_out_and_told() {
    let file = [
        LITTLE.variable("u", [2, 1], &[1.0, 2.0]),
        LITTLE.variable("empty", [0, 0], &[]),
        LITTLE.variable("gain", [1, 1], &[2.0]),
    ];
    let run = read(&LITTLE.of(&file)).unwrap();
    assert_eq!(run.names.unwrap(), ["u"]);
    assert_eq!(
        run.notes,
        ["\"empty\" is empty and was left out.", "\"gain\" is a single number and was left out."]
    );
    assert_eq!(read(&LITTLE.of(&file[1..])).unwrap_err().code(), "run.no_channels");
    assert_eq!(read(&LITTLE.of(&[])).unwrap_err().code(), "run.no_channels");
}

#[test]
fn damaged_files_are_refused() {
    let whole =
        LITTLE.of(&[LITTLE.variable("u", [2, 1], &[1.0, 2.0]), LITTLE.variable("y", [2, 1], &[3.0, 4.0])]);
    assert_eq!(read(&whole).unwrap().channels.len(), 2);
    for len in (0..whole.len()).filter(|len| ![128, 200].contains(len)) {
        let error = read(&whole[..len]).unwrap_err();
        assert_eq!(error.code(), "mat.invalid", "{len}: {error}");
    }
    let packed = LITTLE.of(&[LITTLE.compressed(&LITTLE.variable("u", [9, 1], &[0.5; 9]))]);
    assert_eq!(read(&packed).unwrap().channels, [[0.5; 9]]);
    for at in 136..packed.len() {
        let mut damaged = packed.clone();
        damaged[at] ^= 0x55;
        // Zlib's checksum tells any damage but to the level of compression, which says nothing.
        assert!(at == 137 || read(&damaged).is_err(), "byte {at}");
    }
    for (name, version) in [("7.3", *b"\0\x02IM"), ("of no version", *b"\0\0\0\0")] {
        let mut other = whole.clone();
        other[124..128].copy_from_slice(&version);
        assert_eq!(read(&other).unwrap_err().code(), "mat.invalid", "{name}");
    }
}

#[test]
fn sizes_that_are_declared_are_compared_with_the_bytes() {
    for (rows, columns) in [(u32::MAX, 1), (1 << 31, 1), (2, 3), (1 << 30, 1 << 30), (1, 1)] {
        let variable = LITTLE.array(6, 0, &[rows, columns], "y", &LITTLE.doubles(&[0.0; 2]));
        let (code, text) = error(variable);
        assert_eq!(code, "mat.invalid", "{text}");
    }
}

#[test]
fn a_file_does_not_become_more_than_its_limit() {
    let zeros = vec![0.0; 4 << 20];
    let variables: Vec<Vec<u8>> =
        (0..9).map(|i| LITTLE.compressed(&LITTLE.variable(&format!("u{i}"), [4 << 20, 1], &zeros))).collect();
    let file = LITTLE.of(&variables);
    assert!(file.len() < 1 << 20);
    let error = read(&file).unwrap_err();
    assert_eq!(error.code(), "file.unpacked_size", "{error}");
}
