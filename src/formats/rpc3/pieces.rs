//! Writing RPC III piece by piece, so that a file of any length takes the memory of one group.

use std::io;

use super::header::{BLOCK, KEY, RECORD};
use super::{FRAME, FULL_SCALE, GROUP};
use crate::engine::{Samples, samples};

/// The pieces of a file of 16-bit integers, or of single floats: the header, then a piece a group. The last group is
/// filled with the last value of each channel, and `SAMPLES` says how many are true.
#[derive(Debug)]
pub struct Rpc3Pieces<S> {
    samples: S,
    names: Vec<String>,
    units: Vec<String>,
    drives: bool,
    floats: bool,
    /// Unit of one count of each channel, once the header is written.
    scales: Vec<f64>,
    /// The next group.
    group: usize,
}

impl<S: Samples> Rpc3Pieces<S> {
    /// The file of these samples with a name and a unit for each channel; `drives` makes it a drive file (`.drv`)
    /// and no response file (`.rsp`).
    ///
    /// # Panics
    /// If names or units are not one a channel, which is a defect of the caller.
    pub fn new(names: Vec<String>, units: Vec<String>, drives: bool, samples: S) -> Self {
        let channels = samples.n_channels();
        assert_eq!((names.len(), units.len()), (channels, channels), "one name and one unit a channel");
        Self { samples, names, units, drives, floats: false, scales: Vec::new(), group: 0 }
    }

    /// The same file with single floats in place of integers. A value beyond their range becomes its end.
    pub fn as_floats(self) -> Self {
        Self { floats: true, ..self }
    }

    /// Bytes of the whole file.
    pub fn size(&self) -> usize {
        // Its length does not depend on the scales.
        let scales = vec![1.0; self.names.len()];
        self.header(&scales).len() + self.groups() * GROUP * self.names.len() * self.number_bytes()
    }

    fn number_bytes(&self) -> usize {
        if self.floats { size_of::<f32>() } else { size_of::<i16>() }
    }

    fn groups(&self) -> usize {
        self.samples.n_samples().div_ceil(GROUP)
    }

    /// The largest magnitude of each channel is the full scale, as far as seven digits say it. Floats are engineering
    /// units.
    fn find_scales(&mut self) -> io::Result<Vec<f64>> {
        if self.floats {
            return Ok(vec![1.0; self.samples.n_channels()]);
        }
        let mut scales = Vec::new();
        for channel in 0..self.samples.n_channels() {
            let mut largest = 0.0_f64;
            samples::each_block(&mut self.samples, channel, |block| {
                largest = block.iter().fold(largest, |most, v| most.max(v.abs()));
                Ok(())
            })?;
            let scale = if largest > 0.0 { largest / FULL_SCALE } else { 1.0 };
            let printed: f64 = number(scale).parse().expect("a printed number reads back");
            // Of the smallest numbers nothing is left in seven digits.
            scales.push(if printed > 0.0 { printed } else { 1.0 });
        }
        Ok(scales)
    }

    fn header(&self, scales: &[f64]) -> Vec<u8> {
        let channels = scales.len();
        // Whole groups: some readers take a group of fewer frames for one that is stored shorter.
        let frames = self.groups() * (GROUP / FRAME);
        let mut records: Vec<(String, String)> = Vec::new();
        let mut put = |key: &str, value: String| records.push((key.to_owned(), value));
        put("FILE_TYPE", "TIME_HISTORY".into());
        put("TIME_TYPE", if self.drives { "DRIVE" } else { "RESPONSE" }.into());
        put("DATA_TYPE", if self.floats { "FLOATING_POINT" } else { "SHORT_INTEGER" }.into());
        put("DELTA_T", number(self.samples.sample_rate_hz().recip()));
        put("CHANNELS", channels.to_string());
        put("FRAMES", frames.to_string());
        put("PTS_PER_FRAME", FRAME.to_string());
        put("PTS_PER_GROUP", GROUP.to_string());
        put("SAMPLES", self.samples.n_samples().to_string());
        put("INT_FULL_SCALE", FULL_SCALE.to_string());
        put("REPEATS", "1".into());
        put("HALF_FRAMES", "0".into());
        put("BYPASS_FILTER", "0".into());
        put("PARTITIONS", "1".into());
        put("PART.CHAN_1", "1".into());
        put("PART.NCHAN_1", channels.to_string());
        put("OPERATION", "Rigcast".into());
        put("PARENT_1", String::new());
        for (c, scale) in scales.iter().enumerate() {
            let n = c + 1;
            put(&format!("DESC.CHAN_{n}"), self.names[c].clone());
            put(&format!("UNITS.CHAN_{n}"), self.units[c].clone());
            put(&format!("SCALE.CHAN_{n}"), number(*scale));
            put(&format!("UPPER_LIMIT.CHAN_{n}"), "1.0".into());
            put(&format!("LOWER_LIMIT.CHAN_{n}"), "-1.0".into());
            put(&format!("MAP.CHAN_{n}"), n.to_string());
        }
        let all = records.len() + 3;
        let blocks = all.div_ceil(BLOCK / RECORD);
        let mut file = Vec::with_capacity(blocks * BLOCK);
        record(&mut file, "FORMAT", "BINARY_IEEE_LITTLE_END");
        record(&mut file, "NUM_HEADER_BLOCKS", &blocks.to_string());
        record(&mut file, "NUM_PARAMS", &all.to_string());
        records.iter().for_each(|(key, value)| record(&mut file, key, value));
        file.resize(blocks * BLOCK, 0);
        file
    }

    fn piece(&mut self) -> io::Result<Vec<u8>> {
        let n = self.samples.n_samples();
        let range = self.group * GROUP..n.min((self.group + 1) * GROUP);
        let mut piece = Vec::with_capacity(GROUP * self.scales.len() * self.number_bytes());
        let mut values = Vec::with_capacity(GROUP);
        for (channel, scale) in self.scales.iter().enumerate() {
            values.clear();
            self.samples.read(channel, range.clone(), &mut values)?;
            let last = *values.last().expect("a group has a sample");
            values.resize(GROUP, last);
            if self.floats {
                let floats = values.iter().map(|v| (*v as f32).clamp(f32::MIN, f32::MAX));
                piece.extend(floats.flat_map(f32::to_le_bytes));
                continue;
            }
            let counts =
                values.iter().map(|v| (v / scale).round().clamp(f64::from(i16::MIN), f64::from(i16::MAX)));
            piece.extend(counts.flat_map(|v| (v as i16).to_le_bytes()));
        }
        self.group += 1;
        Ok(piece)
    }
}

impl<S: Samples> Iterator for Rpc3Pieces<S> {
    type Item = io::Result<Vec<u8>>;

    fn next(&mut self) -> Option<io::Result<Vec<u8>>> {
        if self.scales.is_empty() {
            return Some(self.find_scales().map(|scales| {
                let header = self.header(&scales);
                self.scales = scales;
                header
            }));
        }
        (self.group < self.groups()).then(|| self.piece())
    }
}

/// Appends a record. Text that is too long is cut; a character that Windows-1252 lacks becomes a question mark.
fn record(file: &mut Vec<u8>, key: &str, value: &str) {
    let mut place = [0; RECORD];
    place[..key.len()].copy_from_slice(key.as_bytes());
    // The last byte stays zero.
    for (to, character) in place[KEY..RECORD - 1].iter_mut().zip(value.chars()) {
        let mut utf8 = [0; 4];
        let (bytes, _, lost) = encoding_rs::WINDOWS_1252.encode(character.encode_utf8(&mut utf8));
        *to = if lost || character == '\0' { b'?' } else { bytes[0] };
    }
    file.extend(place);
}

/// Seven digits and two digits of an exponent, as `4.882813E-04`.
fn number(value: f64) -> String {
    let text = format!("{value:.6E}");
    let (digits, exponent) = text.split_once('E').expect("an exponent was asked for");
    let (sign, exponent) = exponent.strip_prefix('-').map_or(('+', exponent), |rest| ('-', rest));
    format!("{digits}E{sign}{exponent:0>2}")
}
