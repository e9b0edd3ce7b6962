use std::f64::consts::TAU;

use super::*;
use crate::engine::Signal;
use crate::formats::tests::Pieces;
use crate::measured::shared_data;

/// A file from key words and numbers, as another program may write it.
fn file(records: &[(&str, &str)], data: &[u8]) -> Vec<u8> {
    let mut file = Vec::new();
    let blocks = (records.len() + 3).div_ceil(4);
    let (count, all) = (blocks.to_string(), (records.len() + 3).to_string());
    let format = ("FORMAT", "BINARY_IEEE_LITTLE_END");
    let given = records.iter().find(|(key, _)| *key == "FORMAT").copied();
    let fixed = [given.unwrap_or(format), ("NUM_HEADER_BLOCKS", &*count), ("NUM_PARAMS", &*all)];
    for (key, value) in fixed.iter().chain(records.iter().filter(|(key, _)| *key != "FORMAT")) {
        let mut record = [0; 128];
        record[..key.len()].copy_from_slice(key.as_bytes());
        record[32..32 + value.len()].copy_from_slice(value.as_bytes());
        file.extend(record);
    }
    file.resize(blocks * 512, 0);
    file.extend(data);
    file
}

/// Key words of two channels in frames of four samples.
const TWO: [(&str, &str); 9] = [
    ("CHANNELS", "2"),
    ("DELTA_T", "4.882813E-04"),
    ("FRAMES", "3"),
    ("PTS_PER_FRAME", "4"),
    ("PTS_PER_GROUP", "8"),
    ("DESC.CHAN_1", "drive"),
    ("DESC.CHAN_2", "force"),
    ("SCALE.CHAN_1", "0.5"),
    ("SCALE.CHAN_2", "2.0E-01"),
];

fn two_with(more: &[(&'static str, &'static str)]) -> Vec<(&'static str, &'static str)> {
    let kept = TWO.iter().filter(|(key, _)| more.iter().all(|(other, _)| other != key));
    kept.chain(more).copied().collect()
}

/// Two groups of two channels: channel 1 counts from 1, channel 2 from 101, as the group order asks.
fn counts() -> Vec<i16> {
    [1..9, 101..109, 9..17, 109..117].into_iter().flatten().collect()
}

fn little(counts: &[i16]) -> Vec<u8> {
    counts.iter().flat_map(|v| v.to_le_bytes()).collect()
}

#[test]
fn groups_of_channels_are_read_with_their_scales_rate_names_and_units() {
    let records = two_with(&[("UNITS.CHAN_2", "kN")]);
    let run = read(&file(&records, &little(&counts())), Reading::default()).unwrap();
    assert_eq!(run.sample_rate_hz, Some(2048.0), "seven digits of the step");
    assert_eq!(run.names.unwrap(), ["drive", "force"]);
    assert_eq!(run.units.unwrap(), ["", "kN"]);
    // Three frames of four samples; the fourth frame of the last group is no data.
    let expected: Vec<f64> = (1..13).map(|v| 0.5 * f64::from(v)).collect();
    assert_eq!(run.channels[0], expected);
    assert_eq!(run.channels[1][11], 0.2 * 112.0);
}

#[test]
fn both_byte_orders_floats_and_a_file_that_comes_in_pieces_hold_the_same() {
    let expected = read(&file(&TWO, &little(&counts())), Reading::default()).unwrap();
    let big: Vec<u8> = counts().iter().flat_map(|v| v.to_be_bytes()).collect();
    let big = file(&two_with(&[("FORMAT", "BINARY_IEEE_BIG_END")]), &big);
    assert_eq!(read(&big, Reading::default()).unwrap(), expected);
    let pieces = read_from(Pieces(&big), big.len() as u64, Spool::in_memory(), Reading::default()).unwrap();
    assert_eq!(pieces.into_memory(), expected);
    // Floats are engineering units; without DATA_TYPE the size tells them.
    let scaled: Vec<f32> = counts()
        .iter()
        .enumerate()
        .map(|(i, &v)| f32::from(v) * if i / 8 % 2 == 0 { 0.5 } else { 0.25 })
        .collect();
    let data: Vec<u8> = scaled.iter().flat_map(|v| v.to_le_bytes()).collect();
    for records in [TWO.to_vec(), two_with(&[("DATA_TYPE", "FLOATING_POINT")])] {
        let floats = read(&file(&records, &data), Reading::default()).unwrap();
        assert_eq!((&floats.channels[0], floats.channels[1][0]), (&expected.channels[0], 25.25));
    }
}

#[test]
fn a_scale_may_be_that_of_the_full_scale() {
    let reading = Reading { scale: ScaleConvention::FullScale, ..Reading::default() };
    let run = read(&file(&two_with(&[("INT_FULL_SCALE", "32000")]), &little(&counts())), reading).unwrap();
    assert_eq!(run.channels[0][1], 2.0 * (0.5 / 32000.0));
}

#[test]
fn a_scale_of_one_for_every_channel_is_told_unless_the_reader_was_told_its_meaning() {
    let notes = |records: &[(&'static str, &'static str)], scale| {
        let file = file(&two_with(records), &little(&counts()));
        read(&file, Reading { scale, ..Reading::default() }).unwrap().notes
    };
    let (ones, one) = (&[("SCALE.CHAN_1", "1"), ("SCALE.CHAN_2", "1.0")][..], &[("SCALE.CHAN_1", "1")][..]);
    assert!(notes(ones, ScaleConvention::Count)[0].starts_with("SCALE is 1 for every channel"));
    assert!(notes(one, ScaleConvention::Count).is_empty());
    assert!(notes(ones, ScaleConvention::FullScale).is_empty());
}

#[test]
fn half_frames_at_both_ends_hold_no_data() {
    let records = two_with(&[("HALF_FRAMES", "YES")]);
    let run = read(&file(&records, &little(&counts())), Reading::default()).unwrap();
    // Four frames are stored: two samples at the start and two at the end are none.
    assert_eq!(run.channels[0], (3..15).map(|v| 0.5 * f64::from(v)).collect::<Vec<_>>());
}

/// 40 samples of two channels in one group of 64, of which the last 24 repeat `fill`.
fn padded(fill: [i16; 2]) -> Vec<u8> {
    let wave = |c: i16| (0..64).map(move |i: i16| (i, c));
    let counts: Vec<i16> = [0, 1]
        .into_iter()
        .flat_map(wave)
        .map(|(i, c)| if i < 40 { (10 + c) * (i % 7 - 3) + i } else { fill[usize::from(c == 1)] })
        .collect();
    let records = two_with(&[("FRAMES", "1"), ("PTS_PER_FRAME", "64"), ("PTS_PER_GROUP", "64")]);
    file(&records, &little(&counts))
}

#[test]
fn padding_is_left_out_unless_it_is_asked_for_or_the_true_length_is_given() {
    let len = |file: &[u8], padding| {
        read(file, Reading { padding, ..Reading::default() }).unwrap().channels[0].len()
    };
    // The last true sample: 39 % 7 - 3 = 1.
    for fill in [[0, 0], [10 + 39, 11 + 39]] {
        let file = padded(fill);
        assert_eq!((len(&file, Padding::Strip), len(&file, Padding::Keep)), (40, 64), "{fill:?}");
    }
    let notes = |padding| read(&padded([0, 0]), Reading { padding, ..Reading::default() }).unwrap().notes;
    let left_out = "The last 24 samples of the file were left out as padding of its last frame.";
    assert_eq!((notes(Padding::Strip), notes(Padding::Keep)), (vec![left_out.to_owned()], vec![]));
    // A channel that goes on ends nothing.
    let file_of = |samples: &'static str| {
        let records = two_with(&[
            ("FRAMES", "1"),
            ("PTS_PER_FRAME", "64"),
            ("PTS_PER_GROUP", "64"),
            ("SAMPLES", samples),
        ]);
        file(&records, &little(&[0; 128]))
    };
    assert_eq!(len(&file_of("50"), Padding::Strip), 50);
    assert_eq!(read(&file_of("65"), Reading::default()).unwrap_err().code(), "rpc3.header");
    let rest = file(&two_with(&[("FRAMES", "4")]), &little(&[7; 32]));
    assert_eq!(len(&rest, Padding::Strip), 16, "a run at rest is a run");
}

#[test]
fn names_are_cut_at_their_first_zero_byte_and_made_distinct() {
    let mut latin = file(&two_with(&[("DESC.CHAN_2", "drive")]), &little(&counts()));
    let at = latin.windows(11).position(|w| w == b"DESC.CHAN_1").unwrap() + 32;
    latin[at..at + 10].copy_from_slice(b"dr\xe4ve\0junk");
    let run = read(&latin, Reading::default()).unwrap();
    assert_eq!(run.names.unwrap(), ["dräve", "drive"]);
    let twice = file(&two_with(&[("DESC.CHAN_2", "drive")]), &little(&counts()));
    assert_eq!(read(&twice, Reading::default()).unwrap().names.unwrap(), ["drive", "drive (2)"]);
    // A channel without a description is known by its place alone.
    let none = file(&two_with(&[("DESC.CHAN_2", "")]), &little(&counts()));
    assert_eq!(read(&none, Reading::default()).unwrap().names, None);
}

#[test]
fn a_file_that_says_something_else_than_it_holds_is_refused_with_its_reason() {
    let refused = |more: &[(&'static str, &'static str)]| {
        read(&file(&two_with(more), &little(&counts())), Reading::default()).unwrap_err()
    };
    for (more, code) in [
        (("FORMAT", "ASCII"), "rpc3.unsupported"),
        (("FILE_TYPE", "MATRIX"), "rpc3.unsupported"),
        (("TIME_TYPE", "MULT_RESP"), "rpc3.unsupported"),
        (("TIME_TYPE", "3"), "rpc3.unsupported"),
        (("DATA_TYPE", "LONG"), "rpc3.unsupported"),
        (("HALF_FRAMES", "2"), "rpc3.unsupported"),
        (("CHANNELS", "0"), "run.no_channels"),
        (("CHANNELS", "1025"), "run.too_many_channels"),
        (("CHANNELS", "3"), "rpc3.size"),
        (("CHANNELS", "two"), "rpc3.header"),
        (("FRAMES", "18446744073709551615"), "rpc3.size"),
        (("FRAMES", "0"), "rpc3.size"),
        (("FRAMES", "-1"), "rpc3.header"),
        (("PTS_PER_FRAME", "0"), "rpc3.header"),
        (("PTS_PER_FRAME", "3"), "rpc3.header"),
        (("PTS_PER_GROUP", "9223372036854775808"), "rpc3.size"),
        (("DELTA_T", "0"), "run.sample_rate"),
        (("DELTA_T", "-1e-3"), "run.sample_rate"),
        (("DELTA_T", "nan"), "rpc3.header"),
        (("DELTA_T", ""), "rpc3.header"),
        (("SCALE.CHAN_2", ""), "rpc3.header"),
        (("SCALE.CHAN_2", "inf"), "rpc3.header"),
        (("INT_FULL_SCALE", "0"), "rpc3.header"),
    ] {
        assert_eq!(refused(&[more]).code(), code, "{more:?}");
    }
    let size = refused(&[("FRAMES", "5")]);
    assert_eq!(size.to_string(), "the RPC III header declares 96 bytes of data, the file has 64");
    assert_eq!(size.limit().unwrap(), "96 bytes of data");
    let whole = file(&TWO, &little(&counts()));
    for len in 0..whole.len() {
        let cut = read(&whole[..len], Reading::default()).unwrap_err();
        let code = if len < whole.len() - 64 { "rpc3.header" } else { "rpc3.size" };
        assert_eq!(cut.code(), code, "{len} bytes");
    }
    let mut blocks = whole.clone();
    for count in ["0", "5000", "18446744073709551615"] {
        blocks[160..256].fill(0);
        blocks[160..160 + count.len()].copy_from_slice(count.as_bytes());
        assert_eq!(read(&blocks, Reading::default()).unwrap_err().code(), "rpc3.header", "{count}");
    }
    let floats: Vec<u8> = [f32::NAN; 32].iter().flat_map(|v| v.to_le_bytes()).collect();
    let nan = read(&file(&TWO, &floats), Reading::default()).unwrap_err();
    assert_eq!((nan.code(), nan.channel(), nan.sample()), ("run.non_finite", Some("drive"), Some(0)));
}

#[test]
fn a_written_file_reads_back_within_half_a_count() {
    for n in [1, 1024, 2047, 2048, 5000] {
        let wave =
            |k: f64, by: f64| (0..n).map(move |i| by * (TAU * k * f64::from(i) / 100.0).sin() + 0.1 * by);
        let channels: Vec<Vec<f64>> =
            vec![wave(1.3, 4.7).collect(), wave(0.7, 1e-6).collect(), vec![0.0; n as usize]];
        let names = ["a", "Größe", "力"].map(str::to_owned).to_vec();
        let units = ["kN", "mm", ""].map(str::to_owned).to_vec();
        let signal = Signal::new(1024.5, channels.clone()).unwrap();
        let pieces = Rpc3Pieces::new(names, units, true, signal);
        let size = pieces.size();
        let file: Vec<u8> = pieces.collect::<std::io::Result<Vec<_>>>().unwrap().concat();
        assert_eq!(file.len(), size);
        let run = read(&file, Reading::default()).unwrap();
        assert!((run.sample_rate_hz.unwrap() - 1024.5).abs() < 1e-6 * 1024.5);
        assert_eq!(run.names.unwrap(), ["a", "Größe", "?"]);
        assert_eq!(run.units.unwrap(), ["kN", "mm", ""]);
        for (found, channel) in run.channels.iter().zip(&channels) {
            assert_eq!(found.len(), channel.len(), "the true length");
            let largest = channel.iter().fold(0.0_f64, |most, v| most.max(v.abs()));
            let off = found.iter().zip(channel).fold(0.0_f64, |most, (a, b)| most.max((a - b).abs()));
            assert!(off <= 0.501 * largest / FULL_SCALE, "{off} of {largest}");
        }
    }
}

#[test]
fn a_file_of_floats_reads_back_to_single_precision() {
    let channels = vec![(0..3000).map(|i| (0.1 * f64::from(i)).sin() * 1e-9).collect(), vec![1e300; 3000]];
    let names = ["a", "b"].map(str::to_owned).to_vec();
    let signal = Signal::new(1024.0, channels).unwrap();
    let pieces = Rpc3Pieces::new(names.clone(), names, false, signal.clone()).as_floats();
    let size = pieces.size();
    let file: Vec<u8> = pieces.collect::<std::io::Result<Vec<_>>>().unwrap().concat();
    assert_eq!(file.len(), size);
    let run = read(&file, Reading::default()).unwrap();
    let expected: Vec<f64> = signal.channel(0).iter().map(|v| f64::from(*v as f32)).collect();
    assert_eq!(run.channels, [expected, vec![f64::from(f32::MAX); 3000]]);
}

#[test]
fn columns_in_a_file_are_shortened_like_those_in_memory() {
    let directory = tempfile::tempdir().unwrap();
    for n in [0, 1, 4095, 4096, 4097, 9000, 10_000, 12_000] {
        let [memory, file] = [Spool::in_memory(), Spool::in_file(directory.path())].map(|mut spool| {
            spool.add_columns(1);
            let values = (0..10_000).map(|i| if i == 9_500 { f64::NAN } else { f64::from(i) });
            spool.extend(0, values).unwrap();
            spool.truncate(n).unwrap();
            let mut found = Vec::new();
            spool.read(0, 0..spool.len(0), &mut found).unwrap();
            (spool.first_not_finite(0), found.iter().map(|v| v.to_bits()).collect::<Vec<_>>())
        });
        assert_eq!(memory.1.len(), n.min(10_000));
        assert_eq!(memory, file, "{n}");
    }
}

/// A file that nCode wrote, whose header holds the statistics of its channels.
#[test]
fn a_measured_file_has_the_statistics_that_its_header_states() {
    let Some(path) = shared_data("formats/rpc3/test1.rsp") else { return };
    let file = std::fs::read(path).unwrap();
    let run = read(&file, Reading { padding: Padding::Keep, ..Reading::default() }).unwrap();
    assert_eq!(run.sample_rate_hz, Some(250.0));
    let header = file.as_chunks::<128>().0;
    for (c, samples) in run.channels.iter().enumerate() {
        let key = format!("NCODE_STAT1_CHAN_{}\0", c + 1);
        let record = header.iter().find(|record| record.starts_with(key.as_bytes())).unwrap();
        let text = String::from_utf8_lossy(&record[32..]);
        let stated: Vec<f64> = text
            .trim_matches('\0')
            .split(',')
            .map(|v| v.trim_matches(['\0', ' ']).parse().unwrap())
            .collect();
        let n = samples.len() as f64;
        let mean = samples.iter().sum::<f64>() / n;
        let rms = (samples.iter().map(|v| v * v).sum::<f64>() / n).sqrt();
        for (found, stated) in [(mean, stated[2]), (rms, stated[4])] {
            assert!((found - stated).abs() <= 1e-5 * rms, "channel {c}: {found}, stated {stated}");
        }
    }
}
