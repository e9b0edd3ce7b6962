use super::*;
use crate::formats::tests::Pieces;
use crate::measured::shared_data;

/// A data set 58 as a program may write it.
#[derive(Clone)]
struct Set {
    /// Line after the first -1.
    kind: String,
    id: &'static str,
    record_6: String,
    record_7: String,
    abscissa: String,
    ordinate: String,
    /// All that comes before the last -1.
    numbers: Vec<u8>,
}

impl Set {
    /// Three numbers in single precision at 100 Hz.
    fn of_text() -> Self {
        let numbers = "  1.00000E+00-2.50000E-001  3.00000E+00\n".into();
        Self {
            kind: "    58".into(),
            id: "force",
            record_6: "    1         0    0         0 NONE              12   3 NONE               0   0"
                .into(),
            record_7: "         2         3         1  0.00000E+00  1.00000E-02  0.00000E+00".into(),
            abscissa: "        17    0    0    0 Time                 s".into(),
            ordinate: "        13    0    0    0 Force                kN".into(),
            numbers,
        }
    }

    /// The same numbers as binary ones; the ordinate data type of single precision is 2, of double precision 4.
    fn of_floats(double: bool, big_endian: bool) -> Self {
        let mut numbers = Vec::new();
        for value in [1.0_f32, -0.25, 3.0] {
            let mut bytes =
                if double { f64::from(value).to_le_bytes().to_vec() } else { value.to_le_bytes().to_vec() };
            if big_endian {
                bytes.reverse();
            }
            numbers.extend(bytes);
        }
        let (order, kind) = (1 + u8::from(big_endian), 2 + 2 * u8::from(double));
        Self {
            kind: format!(
                "    58b{order:6}{:6}{:12}{:12}     0     0           0           0",
                2,
                11,
                numbers.len()
            ),
            record_7: format!("{kind:10}         3         1  0.00000E+00  1.00000E-02  0.00000E+00"),
            numbers,
            ..Self::of_text()
        }
    }

    /// The second of two channels.
    fn other(self) -> Self {
        Self { id: "stroke", ordinate: "         8    0    0    0 NONE                 mm".into(), ..self }
    }

    fn file(&self) -> Vec<u8> {
        let Self { kind, id, record_6, record_7, abscissa, ordinate, numbers } = self;
        let none = "         0    0    0    0 NONE                 NONE";
        let head = [
            "    -1",
            kind,
            id,
            "NONE",
            "01-Jan-26 12:00:00",
            "NONE",
            "NONE",
            record_6,
            record_7,
            abscissa,
            ordinate,
            none,
            none,
            "",
        ];
        [head.join("\n").as_bytes(), numbers, b"    -1\n"].concat()
    }

    fn read(&self) -> Result<ParsedRun, FormatError> {
        read(&self.file())
    }
}

/// A header and units as other programs put them before the functions.
const OTHERS: &str = "    -1\n   151\nmodel\n    -1x\n    -1\n\n    -1\n   164\n         1SI\n    -1\n \n";

#[test]
fn a_data_set_is_a_channel_with_its_name_unit_and_rate() {
    let file =
        [OTHERS.as_bytes(), &Set::of_text().file(), b"\n", &Set::of_floats(true, false).other().file()];
    let run = read(&file.concat()).unwrap();
    assert_eq!(run.sample_rate_hz, Some(100.0));
    assert_eq!(run.names.unwrap(), ["force", "stroke"]);
    assert_eq!(run.units.unwrap(), ["kN", "mm"]);
    assert_eq!(run.channels, [[1.0, -0.25, 3.0]; 2]);
}

#[test]
fn every_form_of_the_numbers_and_lines_holds_the_same_in_one_piece_and_in_many() {
    let double = Set {
        record_7: "         4         3         1  0.00000E+00  1.00000D-02".into(),
        numbers: b"  1.000000000000E+00 -2.500000000000D-01\n\n  0.300000000000E+01".to_vec(),
        ..Set::of_text()
    };
    let double = Set { numbers: [&double.numbers[..], b"   \n"].concat(), ..double };
    let mut filled = Set::of_text();
    filled.numbers = b"  1.00000e+00 -0.25000D+00    3.0        0.00000E+00*************NaN\n  \n".to_vec();
    let crlf = |file: Vec<u8>| String::from_utf8(file).unwrap().replace('\n', "\r\n").into_bytes();
    let mut files = vec![
        double.file(),
        filled.file(),
        crlf(double.file()),
        crlf(filled.file()),
        crlf(Set::of_text().file()),
    ];
    for (wide, big) in [(false, false), (false, true), (true, false), (true, true)] {
        let set = Set::of_floats(wide, big);
        files.push(set.file());
        for padding in [&b"\n"[..], b"\r\n", b"\0\0\0\0 \n\n"] {
            files.push(Set { numbers: [&set.numbers[..], padding].concat(), ..set.clone() }.file());
        }
    }
    let expected = Set::of_text().read().unwrap();
    for file in files {
        let text = String::from_utf8_lossy(&file);
        // The last line may end with the file.
        let end = file.trim_ascii_end();
        assert_eq!(read(end).as_ref(), Ok(&expected), "{text}");
        assert_eq!(read(&file).as_ref(), Ok(&expected), "{text}");
        let in_pieces = read_from(Pieces(&file), Spool::in_memory()).unwrap();
        assert_eq!(in_pieces.into_memory(), expected, "{text}");
    }
}

#[test]
fn a_long_run_goes_through_a_file() {
    let directory = tempfile::tempdir().unwrap();
    let samples: Vec<f64> = (0..30_000).map(|i| (0.1 * f64::from(i)).sin()).collect();
    let mut set = Set::of_floats(true, true);
    set.numbers = samples.iter().flat_map(|v| v.to_be_bytes()).collect();
    set.kind = set.kind.replace("          24", "      240000");
    set.record_7 = set.record_7.replace("         3", "     30000");
    let mut text = Set::of_text();
    text.record_7 = text.record_7.replace("         3", "     30000");
    text.numbers = samples
        .chunks(6)
        .flat_map(|line| line.iter().map(|v| format!("{v:13.5e}")).chain(["\n".to_owned()]))
        .collect::<String>()
        .into();
    let file = [set.file(), text.other().file()].concat();
    let run = read_from(&file[..], Spool::in_file(directory.path())).unwrap();
    assert_eq!((run.channels.n_columns(), run.channels.len(0), run.channels.len(1)), (2, 30_000, 30_000));
    let mut found = Vec::new();
    run.channels.read(0, 0..30_000, &mut found).unwrap();
    assert_eq!(found, samples);
    found.clear();
    run.channels.read(1, 0..30_000, &mut found).unwrap();
    assert!(found.iter().zip(&samples).all(|(a, b)| (a - b).abs() <= 5e-6 * b.abs().max(1e-3)));
}

#[test]
fn channels_are_named_by_id_line_or_else_by_node_and_direction() {
    let node = |name: &str, node: i64, direction: i64| {
        format!("    1         0    0         0 {name:10}{node:10}{direction:4} NONE               0   0")
    };
    let names = |sets: &[(&'static str, String)]| {
        let file = |(id, record_6): &(&'static str, String)| Set {
            id,
            record_6: record_6.clone(),
            ..Set::of_text()
        };
        read(&sets.iter().flat_map(|set| file(set).file()).collect::<Vec<_>>()).unwrap().names
    };
    let two = |a: &[&str]| Some(a.iter().map(|&name| name.to_owned()).collect::<Vec<_>>());
    let (z, rx) = (node("NONE", 12, 3), node("hub", 7, -4));
    assert_eq!(names(&[("a", z.clone()), ("b", z.clone())]), two(&["a", "b"]));
    assert_eq!(names(&[("a", z.clone()), ("a", rx.clone())]), two(&["12:+Z", "hub:7:-RX"]));
    assert_eq!(names(&[("a", z.clone()), ("NONE", z.clone())]), two(&["12:+Z", "12:+Z (2)"]));
    assert_eq!(names(&[("", node(" mic 1", 0, 0)), ("", node("none", 5, 0))]), two(&["mic 1", "5"]));
    assert_eq!(names(&[("", z), ("", node("NONE", 0, 0))]), None, "a channel without a name");

    // A name beyond ASCII comes as UTF-8 or as Windows-1252.
    let mut utf8 = Set::of_text();
    utf8.id = "Größe";
    utf8.ordinate = "         1    0    0    0 1x                   m/s²".into();
    let file = utf8.file();
    let latin: Vec<u8> = encoding_rs::WINDOWS_1252.encode(std::str::from_utf8(&file).unwrap()).0.into();
    assert_ne!(file, latin);
    for file in [file, latin] {
        let run = read(&file).unwrap();
        assert_eq!((run.names.unwrap(), run.units.unwrap()), (vec!["Größe".into()], vec!["m/s²".into()]));
    }
}

#[test]
fn the_rate_is_as_simple_as_the_digits_of_the_increment_allow() {
    for (increment, rate) in [
        ("  1.00000E-02", 100.0),
        ("  1.52588E-05", 65536.0),
        (" 0.48828E-03 ", 2048.0),
        ("  1.30208D-03", 768.0),
        ("  1.22070E-03", 819.2),
        (" 5.00000E-005", 20_000.0),
        ("        7E-03", 1.0 / 7e-3),
        ("  2.00000E+00", 0.5),
    ] {
        let mut set = Set::of_text();
        set.record_7 = set.record_7.replace("  1.00000E-02", increment);
        assert_eq!(set.read().unwrap().sample_rate_hz, Some(rate), "{increment}");
    }
}

/// Changes the first text of the header that holds `from`.
fn with(set: &Set, from: &str, to: &str) -> Set {
    let mut changed = set.clone();
    let texts = [&mut changed.kind, &mut changed.record_6, &mut changed.record_7, &mut changed.abscissa];
    let text = texts.into_iter().find(|text| text.contains(from)).unwrap();
    *text = text.replacen(from, to, 1);
    changed
}

#[test]
fn a_data_set_of_another_kind_is_refused_by_name() {
    let (text, floats) = (Set::of_text(), Set::of_floats(false, false));
    let one = "data set 58 number 1, ";
    for (set, from, to, message) in [
        (
            &text,
            "    1         0",
            "    4         0",
            "line 8: it is a frequency response function (function type 4); a time response (function type 1) is read",
        ),
        (&text, "    1 ", "    9 ", "line 8: it is a power spectral density (function type 9); "),
        (&text, "    1 ", "   99 ", "line 8: it is an unknown function (function type 99); "),
        (&text, "    1 ", "      ", "line 8: it is a general or unknown function (function type 0); "),
        (
            &text,
            "         2 ",
            "         5 ",
            "line 9: the numbers are complex (ordinate data type 5); real (2 or 4) is",
        ),
        (&text, "         2 ", "         6 ", "line 9: the numbers are complex (ordinate data type 6); "),
        (&text, "3         1", "3         0", "line 9: the abscissa is uneven (spacing 0); "),
        (&text, "        17", "        18", "line 10: the abscissa has data type 18; time (17) is read"),
        (&text, "      s", "      ms", "line 10: the abscissa is in ms; an abscissa in s is read"),
        (
            &floats,
            "     2          11",
            "     1          11",
            "line 2: the numbers are DEC VMS floats (format 1); IEEE",
        ),
        (
            &floats,
            "     2          11",
            "     3          11",
            "line 2: the numbers are IBM floats (format 3); ",
        ),
        (&floats, "     2          11", "     9          11", "line 2: the numbers are floats of format 9; "),
        (&text, "58", "58c", "line 2: the data set is \"58c\"; data set 58 or 58b is read"),
    ] {
        let error = with(set, from, to).read().unwrap_err();
        let place = if message.starts_with("line 2:") { "" } else { one };
        assert_eq!(error.code(), "uff58.unsupported", "{error}");
        assert!(error.to_string().starts_with(&format!("UFF {place}{message}")), "{error}");
        assert!(error.row().is_some() && error.limit().is_some());
    }
    let none = read(OTHERS.as_bytes()).unwrap_err();
    assert_eq!(none.code(), "uff58.unsupported");
    assert!(none.to_string().contains("the file ends without a data set 58"), "{none}");
    // The second of two is named by its number.
    let second = with(&text, "    1 ", "   12 ").file();
    let error = read(&[OTHERS.as_bytes(), &text.file(), &second].concat()).unwrap_err();
    assert!(error.to_string().starts_with("UFF data set 58 number 2, line 34: it is a spectrum"), "{error}");
    let error = read(&[floats.file(), second].concat()).unwrap_err();
    assert!(error.to_string().starts_with("UFF data set 58 number 2, after "), "{error}");
    assert_eq!(error.row(), None, "binary numbers have no lines");
}

#[test]
fn records_that_cannot_be_read_are_refused_with_their_line() {
    let (text, floats) = (Set::of_text(), Set::of_floats(true, false));
    for (set, from, to, message) in [
        (&text, "58", "x8", "UFF line 2: the line is \"x8\", and not the number of a data set"),
        (&text, "58", "1234567", "UFF line 2: the line is "),
        (
            &text,
            "    1 ",
            "    x ",
            "UFF data set 58 number 1, line 8: the function type (columns 1 to 5) is \"x\", no whole",
        ),
        (
            &text,
            "12   3",
            "12   7",
            "UFF data set 58 number 1, line 8: the response direction is 7, and not -6 to 6",
        ),
        (
            &text,
            "        12",
            "      1 2 ",
            "UFF data set 58 number 1, line 8: the response node (columns 42 to 51) is \"1 2\"",
        ),
        (
            &text,
            "         2 ",
            "         3 ",
            "UFF data set 58 number 1, line 9: the ordinate data type is 3",
        ),
        (&text, "         3 ", "        -3 ", "UFF data set 58 number 1, line 9: the number of values is -3"),
        (
            &text,
            "         3 ",
            "       3.0 ",
            "UFF data set 58 number 1, line 9: the number of values (columns 11 to 20)",
        ),
        (&text, "3         1", "3         2", "UFF data set 58 number 1, line 9: the abscissa spacing is 2"),
        (
            &text,
            "1.00000E-02",
            "        NaN",
            "UFF data set 58 number 1, line 9: the abscissa increment (columns 44 to 56) is",
        ),
        (
            &text,
            "0.00000E+00",
            "   Infinity",
            "UFF data set 58 number 1, line 9: the first abscissa (columns 31 to 43) is",
        ),
        (
            &floats,
            "     1     2",
            "     3     2",
            "UFF line 2: the byte order is 3, and not 1 (little) or 2 (big",
        ),
        (&floats, "     1     2", "           2", "UFF line 2: the byte order is 0"),
        (&floats, "  11", "  12", "UFF line 2: the numbers begin after 12 records, and not 11"),
        (&floats, "  24", "  -1", "UFF line 2: the number of bytes is -1"),
    ] {
        let error = with(set, from, to).read().unwrap_err();
        assert_eq!(error.code(), "uff58.header", "{error}");
        assert!(error.to_string().starts_with(message), "{error}");
        assert!(error.row().is_some());
    }
    for (from, to) in
        [("  1.00000E-02", "  0.00000E+00"), ("  1.00000E-02", " -1.00000E-02"), ("  1.00000E-02", "")]
    {
        let error = with(&text, from, to).read().unwrap_err();
        assert_eq!(error.code(), "run.sample_rate", "{to}");
    }
    assert_eq!(with(&text, "         3 ", "         0 ").read().unwrap_err().code(), "run.empty");
    for file in [&b"PK\x03\x04"[..], b"time,force\n0,1\n", b"-1 -1\n    58\n", b"       -1\n"] {
        let error = read(file).unwrap_err();
        assert_eq!((error.code(), error.row()), ("uff58.header", Some(1)), "{error}");
    }
    let early = read(b"    -1\n    58\na\nb\nc\nd\ne\n    -1\n").unwrap_err();
    assert_eq!(early.to_string(), "UFF data set 58 number 1, line 8: the data set ends inside its header");
}

#[test]
fn numbers_that_are_more_or_fewer_than_declared_are_refused() {
    let (text, floats) = (Set::of_text(), Set::of_floats(false, false));
    let one = |message: &str| format!("UFF data set 58 number 1, {message}");
    for (set, from, to, message) in [
        (
            &text,
            "         3 ",
            "         4 ",
            one("line 15: the header declares 4 numbers, the data set ends after 3"),
        ),
        (
            &text,
            "         3 ",
            "9999999999 ",
            one("line 15: the header declares 9999999999 numbers, the data set ends"),
        ),
        (
            &floats,
            "         3 ",
            "         4 ",
            one(
                "line 14: the header declares 12 bytes of numbers, which is not what 4 numbers of 4 bytes take",
            ),
        ),
        (
            &floats,
            "         2 ",
            "         4 ",
            one("line 14: the header declares 12 bytes of numbers, which is not"),
        ),
        (
            &floats,
            "          12 ",
            "          13 ",
            one("line 14: the header declares 13 bytes of numbers, which is"),
        ),
        (
            &floats,
            "          12 ",
            "999999999999 ",
            one("line 14: the header declares 999999999999 bytes of numbers, "),
        ),
    ] {
        let error = with(set, from, to).read().unwrap_err();
        assert_eq!(error.code(), "uff58.size", "{error}");
        assert!(error.to_string().starts_with(&message), "{error}");
        assert!(error.limit().is_some());
    }
    let huge = with(&with(&floats, "         3 ", "9999999999 "), "          12 ", " 39999999996 ").read();
    let huge = huge.unwrap_err().to_string();
    assert!(huge.starts_with("UFF data set 58 number 1, after "), "{huge}");
    assert!(
        huge.ends_with("the header declares 39999999996 bytes of numbers, the file ends after 19"),
        "{huge}"
    );

    let more = |set: &Set, numbers: &[u8]| Set { numbers: [&set.numbers, numbers].concat(), ..set.clone() };
    for set in [more(&text, b"  1.00000E+00\n"), more(&floats, b"\0\0\x80\x3f"), more(&floats, b"\n    58\n")]
    {
        let error = set.read().unwrap_err();
        assert_eq!(error.code(), "uff58.size", "{error}");
        assert!(error.to_string().ends_with("the data set goes on after them"), "{error}");
    }
    for (numbers, column, found) in [
        ("  1.00000E+00     2.000,00\n", 14, "2.000,00"),
        ("  1.00000E+00               3.00000E+00\n", 14, ""),
        ("1.0 -0.25 3.0\n", 1, "1.0 -0.25 3.0"),
        ("*************\n", 1, "*************"),
    ] {
        let error = Set { numbers: numbers.into(), ..text.clone() }.read().unwrap_err();
        assert_eq!(
            (error.code(), error.row(), error.column()),
            ("uff58.not_a_number", Some(14), Some(column))
        );
        assert!(
            error.to_string().ends_with(&format!("column {column}: {found:?} is not a number")),
            "{error}"
        );
    }
    let wide = Set { numbers: [&[b' '; 80][..], b"1.0\n"].concat(), ..text.clone() }.read().unwrap_err();
    assert_eq!(wide.code(), "uff58.header", "{wide}");
}

#[test]
fn nan_and_infinity_are_refused_in_every_form() {
    for (numbers, sample) in
        [("  1.00000E+00  2.00000E+00          NaN\n", 2), ("  1.0000E+400          1.0     Infinity\n", 0)]
    {
        let error = Set { numbers: numbers.into(), ..Set::of_text() }.read().unwrap_err();
        let found = (error.code(), error.channel(), error.sample());
        assert_eq!(found, ("run.non_finite", Some("force"), Some(sample)));
    }
    for (double, bad) in
        [(false, f32::NAN.to_le_bytes().to_vec()), (true, f64::INFINITY.to_le_bytes().to_vec())]
    {
        let mut set = Set::of_floats(double, false);
        let at = bad.len();
        set.numbers[at..2 * at].copy_from_slice(&bad);
        let error = set.read().unwrap_err();
        assert_eq!((error.code(), error.sample()), ("run.non_finite", Some(1)));
    }
}

#[test]
fn channels_of_unlike_times_are_refused_by_name_with_both_values() {
    let first = Set::of_text();
    let refused = |from: &str, to: &str| {
        let file = [first.file(), with(&first.clone().other(), from, to).file()].concat();
        read(&file).unwrap_err()
    };
    let interval = refused("  1.00000E-02", "  1.00001E-02");
    let start = refused("1  0.00000E+00", "1  5.00000E-01");
    for (error, what, found, limit) in
        [(&interval, "sample interval", "0.0100001", "0.01 s"), (&start, "start", "0.5", "0 s")]
    {
        assert_eq!((error.code(), error.channel_index()), ("uff58.unsupported", Some(1)));
        assert_eq!((error.channel(), error.limit().as_deref()), (Some("stroke"), Some(limit)));
        let message =
            format!("channel \"stroke\" has a {what} of {found} s, the first channel one of {limit}; ");
        assert!(error.to_string().starts_with(&message), "{error}");
    }
    let length = refused("         3 ", "         4 ");
    assert_eq!((length.code(), length.channel()), ("run.unequal_lengths", Some("stroke")));
    assert_eq!(length.to_string(), "channel \"stroke\" has 4 samples, the first channel has 3");
    let many = first.file().repeat(crate::formats::MAX_CHANNELS + 1);
    assert_eq!(read(&many).unwrap_err().code(), "run.too_many_channels");
}

#[test]
fn a_file_that_is_cut_anywhere_inside_a_data_set_is_refused() {
    for (set, other) in [
        (Set::of_text(), Set::of_text().other()),
        (Set::of_floats(false, true), Set::of_floats(true, false).other()),
    ] {
        let (first, whole) = (set.file(), [set.file(), other.file()].concat());
        for len in 0..whole.len() {
            let cut = read(&whole[..len]);
            // The last line end may be missing, and blanks are no data set.
            let (end, next) = (first.len() - 1, first.len() + 4);
            let whole_sets = (end..=next).contains(&len) || len == whole.len() - 1;
            match cut {
                Ok(run) => assert!(whole_sets && run.channels[0].len() == 3, "{len} bytes"),
                Err(error) => {
                    assert!(!whole_sets, "{len} bytes: {error}");
                    let codes = ["uff58.header", "uff58.size", "uff58.unsupported", "uff58.not_a_number"];
                    assert!(codes.contains(&error.code()), "{len} bytes: {error}");
                }
            }
        }
    }
    let whole = Set::of_text().file();
    let cut = read(&whole[..whole.len() - 8]).unwrap_err().to_string();
    assert_eq!(
        cut,
        "UFF data set 58 number 1, line 15: the header declares 3 numbers, the file ends without a -1 after them"
    );
}

#[test]
fn lines_of_any_length_take_no_memory() {
    let long = "x".repeat(5 << 20);
    let file = [format!("    -1\n   151\n{long}\n    -1\n").as_bytes(), &Set::of_text().file()].concat();
    let run = read(&file).unwrap();
    assert_eq!(run.names.unwrap(), ["force"]);
    let error = read(long.as_bytes()).unwrap_err();
    assert!(error.to_string().len() < 200, "{error}");
}

/// Files of other programs, with values as the package pyuff reads them.
#[test]
fn measured_files_hold_the_numbers_that_another_reader_finds() {
    let Some(path) = shared_data("formats/uff58/expected.json") else { return };
    let expected: serde_json::Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    let file = |name: &str| std::fs::read(path.with_file_name(name)).unwrap();
    for (name, rate, channel, unit) in [
        ("Sample_UFF58b_bin.uff", 65536.0, "Mic 01.0Scalar", "Pa"),
        ("binary8byte.uff", 100.0, "sine 5 Hz:1", "g"),
        ("time-history-not-all-columns-filled.uff", 20_000.0, "1x : m/s²", "m/s²"),
    ] {
        let set = &expected["files"][name]["sets58"][0];
        let run = read(&file(name)).unwrap();
        assert_eq!(run.sample_rate_hz, Some(rate), "{name}");
        assert_eq!((run.names.unwrap(), run.units.unwrap()), (vec![channel.into()], vec![unit.into()]));
        let samples = &run.channels[0];
        assert_eq!(set["num_pts"], samples.len(), "{name}");
        for (found, expected) in samples.iter().zip(set["first"].as_array().unwrap()) {
            assert_eq!(*found, expected.as_str().unwrap().parse::<f64>().unwrap(), "{name}");
        }
        let rms = (samples.iter().map(|v| v * v).sum::<f64>() / samples.len() as f64).sqrt();
        let expected = set["rms"].as_f64().unwrap();
        assert!((rms / expected - 1.0).abs() < 1e-12, "{name}: {rms}, {expected}");
    }
    let error = read(&file("sample_dataset58_psd.uff")).unwrap_err();
    assert_eq!(error.code(), "uff58.unsupported");
    assert!(error.to_string().contains("it is a power spectral density (function type 9)"), "{error}");
}
