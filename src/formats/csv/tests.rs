//! Whole files, good and bad.

use proptest::prelude::*;

use super::*;

fn read_text(text: &str) -> Result<ParsedRun, FormatError> {
    read(text.as_bytes())
}

fn names(run: &ParsedRun) -> Vec<&str> {
    run.names.iter().flatten().map(String::as_str).collect()
}

#[test]
fn what_is_longer_than_any_name_and_wider_than_any_file_is_counted_and_not_kept() {
    let long = format!("u,{}\n1,2\n", "n".repeat(5000));
    let error = read_text(&long).unwrap_err();
    assert_eq!((error.code(), error.to_string().len() < 200), ("run.unknown_channel", true));
    let wide = vec!["1"; 5000].join(",");
    assert_eq!(
        read_text(&wide),
        Err(FormatError::TooManyChannels { found: 5000, limit: crate::formats::MAX_CHANNELS })
    );
    for n in [1024, 1025, 1026, 2050, 2051, 5000] {
        let text = format!("u,v\n{}\n", vec!["1"; n].join(","));
        assert_eq!(read_text(&text), Err(FormatError::CsvRagged { row: 2, expected: 2, found: n }), "{n}");
    }
    let full = format!("{0}\n{0}\n", vec!["1.5"; 1024].join(","));
    let run = read_text(&full).unwrap();
    assert!(run.channels.len() == 1024 && run.channels.iter().all(|c| c == &[1.5, 1.5]));
}

#[test]
fn header_units_and_time_are_taken_off_the_samples() {
    let run = read_text("time,drive_x,\"force, x\"\ns,kN,[mm]\n0,1,-2\n0.5,1e3,2.5\n1,0,0\n").unwrap();
    assert_eq!(run.sample_rate_hz, Some(2.0));
    assert_eq!(names(&run), ["drive_x", "force, x"]);
    assert_eq!(run.units.as_deref(), Some(&["kN".to_string(), "mm".into()][..]));
    assert_eq!(run.channels, [vec![1.0, 1000.0, 0.0], vec![-2.0, 2.5, 0.0]]);
}

#[test]
fn blanks_separate_where_nothing_else_does() {
    for text in [
        "t u y\ns kN mm\n0.0   1.5  -2\n0.5 3.0   4.25\n",
        "# t u y\r\n  0.0 1.5 -2\r\n  0.5 3.0 4.25\r\n",
        "Test 3 of today\n\nt \"u\" y\n0,0 1,5 -2,0\n0,5 3,0 4,25\n",
    ] {
        let run = read_text(text).unwrap_or_else(|e| panic!("{text:?}: {e}"));
        assert_eq!((names(&run), run.sample_rate_hz), (vec!["u", "y"], Some(2.0)), "{text:?}");
        assert_eq!(run.channels, [[1.5, 3.0], [-2.0, 4.25]], "{text:?}");
    }
    let savetxt = read_text("1.000000000000000000e+00 2.5e-01\n-3.0e+00 4.0e+00\n").unwrap();
    assert_eq!((savetxt.names, savetxt.channels), (None, vec![vec![1.0, -3.0], vec![0.25, 4.0]]));
    let ragged = read_text("u y\n1 2\n3 4\n5\n").unwrap_err();
    assert_eq!(ragged, FormatError::CsvRagged { row: 4, expected: 2, found: 1 });
    let thousands = read_text("u\n1 234,5\n12\n").unwrap();
    assert_eq!(thousands.channels, [[1234.5, 12.0]]);
}

#[test]
fn every_separator_line_end_and_mark_reads_the_same() {
    for separator in [",", ";", "\t"] {
        for end in ["\n", "\r\n", "\r"] {
            for mark in ["", "\u{feff}"] {
                for decimal in [".", ","] {
                    if (separator, decimal) == (",", ",") {
                        continue;
                    }
                    let rows = [["a", " b "], ["1d5", "-2"], [" 3", "4d25 "]]
                        .map(|cells| cells.join(separator).replace('d', decimal));
                    let text = format!("{mark}{}{end}", rows.join(end));
                    let run = read_text(&text).unwrap_or_else(|e| panic!("{text:?}: {e}"));
                    assert_eq!(names(&run), ["a", "b"], "{text:?}");
                    assert_eq!(run.channels, [[1.5, 3.0], [-2.0, 4.25]], "{text:?}");
                    assert_eq!((run.units, run.sample_rate_hz), (None, None), "{text:?}");
                }
            }
        }
    }
}

#[test]
fn a_file_of_numbers_has_no_names() {
    let run = read_text("1,2\n3,4\n").unwrap();
    assert_eq!(run.names, None);
    assert_eq!(run.channels, [[1.0, 3.0], [2.0, 4.0]]);
    assert_eq!(read_text("5").unwrap().channels, [[5.0]]);
}

#[test]
fn one_column_may_have_decimal_commas_and_quoted_cells() {
    assert_eq!(read_text("a\n1,5\n2,5\n").unwrap().channels, [[1.5, 2.5]]);
    assert_eq!(read_text("a,b\n\"1.5\",2\n").unwrap().channels, [[1.5], [2.0]]);
}

#[test]
fn a_cell_that_is_no_number_has_row_column_and_channel() {
    for (text, row, column, channel, found) in [
        ("a,b\n1,2\n3,x\n", 3, 2, Some("b"), "x"),
        ("a,b\r\nkN,mm\r\n1,2\r\n,4\r\n", 4, 1, Some("a"), ""),
        ("1,2\n3,4\n5,--\n", 3, 2, None, "--"),
        ("a;b\n10.00,5;2\n", 2, 1, Some("a"), "10.00,5"),
        ("a,b\n1,kN\n", 2, 2, Some("b"), "kN"),
        ("time,b\n0,1\nzero,2\n", 3, 1, Some("time"), "zero"),
    ] {
        let error = read_text(text).unwrap_err();
        assert_eq!(error.code(), "csv.not_a_number", "{text:?}");
        assert_eq!(
            (error.row(), error.column(), error.channel()),
            (Some(row), Some(column), channel),
            "{text:?}"
        );
        let FormatError::CsvNotANumber { found: cell, .. } = error else { unreachable!() };
        assert_eq!(cell, found);
    }
}

#[test]
fn nan_and_infinity_have_channel_sample_row_and_column() {
    for (text, channel, index, sample, row, column) in [
        ("a,b\n1,2\n3,NaN\n", Some("b"), 1, 1, 3, 2),
        ("a,b\n-inf,2\n", Some("a"), 0, 0, 2, 1),
        ("a,b\n1,2\n1,2\n1,1e999\n", Some("b"), 1, 2, 4, 2),
        ("t,a\n0,1\n1,nan\n", Some("a"), 0, 1, 3, 2),
        ("1,2\n3,inf\n", None, 1, 1, 2, 2),
    ] {
        let error = read_text(text).unwrap_err();
        assert_eq!(error.code(), "run.non_finite", "{text:?}");
        assert_eq!((error.channel(), error.channel_index()), (channel, Some(index)), "{text:?}");
        assert_eq!((error.sample(), error.row(), error.column()), (Some(sample), Some(row), Some(column)));
    }
}

#[test]
fn ragged_rows_and_empty_lines_are_refused_by_row() {
    for (text, row, expected, found) in [
        ("a,b\n1,2\n3\n", 3, 2, 1),
        ("a,b\n1,2,3\n", 2, 2, 3),
        ("a,b\r\n1,2\r\n\r\n3,4\r\n", 3, 2, 0),
        ("a,b\nkN\n1,2\n", 2, 2, 1),
        ("a\n1,5;2\n", 2, 1, 2),
    ] {
        let error = read_text(text).unwrap_err();
        assert_eq!(error, FormatError::CsvRagged { row, expected, found }, "{text:?}");
        assert_eq!((error.code(), error.row()), ("csv.ragged_row", Some(row)));
    }
}

#[test]
fn uneven_time_is_refused_by_row() {
    let error = read_text("t,a\ns,kN\n0,1\n0.1,1\n0.2,1\n0.35,1\n0.4,1\n").unwrap_err();
    assert_eq!((error.code(), error.row(), error.column()), ("csv.uneven_time", Some(6), Some(1)));
    assert!(error.limit().unwrap().contains("0.1 s") || error.limit().unwrap().contains("0.09999"));
}

#[test]
fn headers_that_cannot_be_are_refused_by_column() {
    let error = read_text("a,1,b\n1,2,3\n").unwrap_err();
    assert_eq!((error.code(), error.row(), error.column()), ("csv.header", Some(1), Some(2)));
    let error = read_text("a,,b\n1,2,3\n").unwrap_err();
    assert_eq!((error.code(), error.row(), error.column()), ("csv.header", Some(1), Some(2)));
    for text in ["u\n1\nu\n2\n3\n", "u\n1\nu\nkN\n2\n3\n"] {
        let error = read_text(text).unwrap_err();
        assert_eq!((error.code(), error.row()), ("csv.header", Some(2)), "{text:?}");
    }
    for text in ["u,y\n1,2\nu,y\n3,4\n5,6\n", "u,y\n1,2\n3,x\n5,6\n7,8\n"] {
        let error = read_text(text).unwrap_err();
        assert_eq!((error.code(), error.row()), ("csv.not_a_number", Some(3)), "{text:?}");
    }
    let error = read_text("a,b,a\n1,2,3\n").unwrap_err();
    assert_eq!((error.code(), error.channel()), ("run.duplicate_channel", Some("a")));
}

#[test]
fn files_without_samples_or_channels_are_refused() {
    for text in ["", "\n\n", "\u{feff}", "a,b\n", "a,b\nkN,mm\n", "t,a\n"] {
        assert_eq!(read_text(text).unwrap_err().code(), "run.empty", "{text:?}");
    }
    assert_eq!(read_text("time\n0\n1\n").unwrap_err().code(), "run.no_channels");
    let wide = vec!["1"; 1025].join(",");
    assert_eq!(read_text(&wide).unwrap_err().code(), "run.too_many_channels");
}

/// What files as laboratories write them hold.
fn lab(text: &str) -> (Option<f64>, Vec<String>, Vec<String>, Vec<Vec<f64>>) {
    let run = read_text(text).unwrap_or_else(|e| panic!("{text:?}: {e}"));
    (run.sample_rate_hz, run.names.unwrap_or_default(), run.units.unwrap_or_default(), run.channels)
}

#[test]
fn exports_of_spreadsheets_and_loggers_read_as_their_table() {
    let uy = || vec!["u".to_owned(), "y".to_owned()];
    let units = || vec!["kN".to_owned(), "mm".to_owned()];
    let samples = || vec![vec![1.5, 2.5], vec![-1234.5, 4.0]];
    for text in [
        "sep=;\r\nu;y\r\nkN;mm\r\n1,5;-1.234,5\r\n2,5;4\r\n",
        "u;y;;\nkN;mm;;\n1,5;-1234,5;;\n2,5;4;;\n",
        "u;y\nkN;mm\n1,5;-1234,5;\n2,5;4;\n",
        "Test of the bench;;\n;;\nu;y;\nkN;mm;\n1,5;-1234,5;\n2,5;4;\n",
        "Operator;Meier\nRig;3\n\nu;y\n[kN];[mm]\n1,5;-1234,5\n2,5;4\n",
        "Made by a logger, second channel broken, see notes\nu\ty\nkN\tmm\n1.5\t-1234.5\n2.5\t4\n",
        "u,y\nkN,mm\n1.5,\"-1,234.5\"\n2.5,4\n",
        "#HEADER\n#TITLES\nu,y\n#UNITS\nkN,mm\n#DATATYPES\nFloat,Float\n#DATA\n1.5,-1234.5\n2.5,4\n",
    ] {
        assert_eq!(lab(text), (None, uy(), units(), samples()), "{text:?}");
    }
    for text in ["# u,y\n1.5,-1234.5\n2.5,4\n", "Operator;Meier\nRig;3\nu;y\n1,5;-1234,5\n2,5;4\n"] {
        assert_eq!(lab(text), (None, uy(), vec![], samples()), "{text:?}");
    }
    let (_, names, ..) = lab("u [kN];Weg y (mm)\n1,5;2\n2,5;4\n");
    assert_eq!(names, ["u [kN]", "Weg y (mm)"], "whoever knows the rig takes the units off");
}

#[test]
fn date_times_give_the_sample_rate() {
    let table = |row: &dyn Fn(usize) -> String, head: &str| {
        let rows: Vec<String> = (0..200).map(row).collect();
        format!("{head}\n{}\n", rows.join("\n"))
    };
    let clock = |i: usize| {
        let ms = 86_399_900 + 2 * i;
        let (day, ms) = (29 + ms / 86_400_000, ms % 86_400_000);
        (day, format!("{:02}:{:02}:{:02}", ms / 3_600_000, ms / 60_000 % 60, ms / 1000 % 60), ms % 1000)
    };
    let iso = |i| {
        let (day, time, ms) = clock(i);
        format!("2026-04-{day} {time}.{ms:03},{i}")
    };
    let german = |i| {
        let (day, time, ms) = clock(i);
        format!("{day}.04.2026;{time},{ms:03};{i},5")
    };
    let bare = |i| {
        let (_, time, ms) = clock(i);
        format!("{time}.{ms:03},{i}")
    };
    for (row, head) in
        [(&iso as &dyn Fn(usize) -> String, "Timestamp,u"), (&german, "Datum;Uhrzeit;u"), (&bare, "time,u")]
    {
        let (rate, names, _, channels) = lab(&table(row, head));
        assert!((rate.unwrap() / 500.0 - 1.0).abs() < 1e-9, "{head}: {rate:?}");
        assert_eq!((names, channels[0].len()), (vec!["u".to_owned()], 200), "{head}");
    }
    let seconds = |i: usize| format!("2026-04-29 10:00:{:02},{i}", i / 10);
    let run = read_text(&table(&seconds, "Time,u")).unwrap();
    let (rate, error) = (run.sample_rate_hz.unwrap(), run.sample_rate_error);
    assert!(error < 0.06 && (rate / 10.0 - 1.0).abs() <= error, "{rate} {error}");
    let lost = table(&iso, "Timestamp,u").replacen("2026-04-29 23:59:59.920,10\n", "", 1);
    assert_eq!(read_text(&lost).unwrap_err().code(), "csv.uneven_time");
    let broken =
        table(&german, "Datum;Uhrzeit;u").replacen("29.04.2026;23:59:59,902", "29.13.2026;23:59:59,902", 1);
    assert_eq!(read_text(&broken).unwrap_err().code(), "csv.time_column");
    let error = read_text("Time,u\n10:00:00,1\n10:00:01,2\nnoon,3\n").unwrap_err();
    assert_eq!((error.code(), error.row(), error.column()), ("csv.time_column", Some(4), Some(1)));
}

#[test]
fn a_mark_that_may_be_either_is_refused_by_cell() {
    let error = read_text("a;b\n1.234;7\n1,5;8\n").unwrap_err();
    assert_eq!((error.code(), error.row(), error.column()), ("csv.ambiguous_number", Some(2), Some(1)));
    assert_eq!(error.channel(), Some("a"));
}

#[test]
fn what_makes_no_run_is_not_written() {
    let own = |list: &[&str]| list.iter().map(|s| s.to_string()).collect::<Vec<_>>();
    let code = |names: &[&str], units: Option<&[&str]>, channels: &[Vec<f64>]| {
        write(&own(names), units.map(own).as_deref(), channels).unwrap_err().code()
    };
    assert_eq!(code(&[], None, &[]), "run.no_channels");
    assert_eq!(code(&["a"], None, &[vec![1.0], vec![1.0]]), "run.unequal_lengths");
    assert_eq!(code(&["a", "b"], Some(&["kN"]), &[vec![1.0], vec![1.0]]), "run.unequal_lengths");
    assert_eq!(code(&["a", "b"], None, &[vec![1.0], vec![]]), "run.unequal_lengths");
    let error = write(&own(&["a", "b"]), None, &[vec![1.0, 2.0], vec![0.0, f64::NAN]]).unwrap_err();
    assert_eq!((error.code(), error.channel(), error.sample()), ("run.non_finite", Some("b"), Some(1)));
}

#[test]
fn the_written_file_is_as_short_as_it_reads_back() {
    let names = ["a".to_string(), "b, c".into()];
    let channels = [vec![1.0, 0.1], vec![-1e300, 5e-324]];
    let file = write(&names, Some(&["kN".into(), "\"".into()]), &channels).unwrap();
    assert_eq!(String::from_utf8(file).unwrap(), "a,\"b, c\"\nkN,\"\"\"\"\n1.0,-1e300\n0.1,5e-324\n");
}

#[test]
fn names_and_units_that_would_read_as_samples_are_kept_apart_from_them() {
    let names = ["a".to_string(), "b".into()];
    let units = ["1".to_string(), "[mm]".into()];
    let file = write(&names, Some(&units), &[vec![2.0], vec![3.0]]).unwrap();
    assert_eq!(String::from_utf8(file.clone()).unwrap(), "a,b\n[1],[[mm]]\n2.0,3.0\n");
    assert_eq!(read(&file).unwrap().units.unwrap(), units);
    let empty = write(&names, Some(&[String::new(), String::new()]), &[vec![2.0], vec![3.0]]).unwrap();
    assert_eq!(String::from_utf8(empty).unwrap(), "a,b\n2.0,3.0\n");
    let error = write(&["a".into(), "7".into()], None, &[vec![2.0], vec![3.0]]).unwrap_err();
    assert_eq!((error.code(), error.column()), ("csv.header", Some(2)));
}

/// Names that are neither numbers nor times, with everything that needs quotes.
fn name() -> impl Strategy<Value = String> {
    "[a-z\",;\u{e4} ]{0,6}".prop_map(|s| format!("n{s}x"))
}

proptest! {
    #[test]
    fn what_is_written_reads_back(
        (names, units, channels) in (1usize..5, 1usize..30).prop_flat_map(|(c, n)| (
            prop::collection::btree_set(name(), c),
            prop::option::of(prop::collection::vec(name(), c)),
            prop::collection::vec(prop::collection::vec(prop::num::f64::NORMAL | prop::num::f64::ZERO, n), c),
        ))
    ) {
        let names: Vec<String> = names.into_iter().collect();
        let file = write(&names, units.as_deref(), &channels).unwrap();
        let run = read(&file).unwrap();
        prop_assert_eq!(run.names, Some(names));
        prop_assert_eq!(run.units, units);
        prop_assert_eq!(run.channels, channels);
        prop_assert_eq!(run.sample_rate_hz, None);
    }

    #[test]
    fn any_bytes_are_read_or_refused(bytes in prop::collection::vec(
        prop_oneof![Just(b','), Just(b'\n'), Just(b'\r'), Just(b'"'), Just(b'1'), Just(b'a'), Just(b';'), any::<u8>()], 0..80
    )) {
        if let Ok(run) = read(&bytes) {
            let n = run.channels[0].len();
            prop_assert!(n > 0 && run.channels.iter().all(|c| c.len() == n && c.iter().all(|v| v.is_finite())));
        }
    }
}
