//! Signals as JSON, piece by piece: the same text as [`write_json`](super::signals::write_json) makes.

use std::io;

use super::signals::{begin_channel, begin_signal, numbers};
use crate::engine::Samples;
use crate::formats::NUMBERS_AT_ONCE;

/// The pieces of a signal and the names of its channels.
#[derive(Debug)]
pub struct JsonPieces<S> {
    names: Vec<String>,
    samples: S,
    channel: usize,
    /// Samples of the channel that are written.
    at: usize,
    buffer: Vec<f64>,
}

impl<S: Samples> JsonPieces<S> {
    /// A signal whose channels have these names.
    pub fn new(names: Vec<String>, samples: S) -> Self {
        debug_assert_eq!(names.len(), samples.n_channels());
        Self { names, samples, channel: 0, at: 0, buffer: Vec::new() }
    }
}

impl<S: Samples> Iterator for JsonPieces<S> {
    type Item = io::Result<Vec<u8>>;

    fn next(&mut self) -> Option<io::Result<Vec<u8>>> {
        let name = self.names.get(self.channel)?;
        let mut text = Vec::new();
        if self.at == 0 {
            if self.channel == 0 {
                begin_signal(&mut text, self.samples.sample_rate_hz());
            }
            begin_channel(&mut text, self.channel, name);
        }
        let n = self.samples.n_samples();
        let range = self.at..n.min(self.at + NUMBERS_AT_ONCE);
        self.buffer.clear();
        if let Err(error) = self.samples.read(self.channel, range.clone(), &mut self.buffer) {
            return Some(Err(error));
        }
        let of_channel = numbers(&self.buffer);
        // Every number but the first of a channel has a comma before it.
        text.extend_from_slice(&of_channel[usize::from(self.at == 0 && n > 0)..]);
        self.at = range.end;
        if self.at == n {
            text.push(b']');
            (self.channel, self.at) = (self.channel + 1, 0);
            if self.channel == self.names.len() {
                text.extend_from_slice(b"}}");
            }
        }
        Some(Ok(text))
    }
}

#[cfg(test)]
mod tests {
    use super::super::signals::write_json;
    use super::*;
    use crate::engine::Signal;

    #[test]
    fn pieces_make_the_text_of_the_whole() {
        let names = ["a\"\u{f6}".to_owned(), "b".to_owned()];
        for n in [0, 1, NUMBERS_AT_ONCE, NUMBERS_AT_ONCE + 1, 3 * NUMBERS_AT_ONCE] {
            let channel =
                |k: f64| (0..n).map(move |i| (k * i as f64).sin() * 1e10_f64.powi(i as i32 % 7 - 3));
            let signal = Signal::new(0.1, vec![channel(1.0).collect(), channel(2.0).collect()]);
            let signal = signal.expect("a signal");
            let mut whole = Vec::new();
            write_json(&mut whole, &names, &signal);
            let pieces: Vec<Vec<u8>> =
                JsonPieces::new(names.to_vec(), signal).collect::<io::Result<_>>().expect("in memory");
            assert_eq!(pieces.len(), 2 * n.div_ceil(NUMBERS_AT_ONCE).max(1));
            assert!(pieces.concat() == whole, "{n} samples");
        }
    }
}
