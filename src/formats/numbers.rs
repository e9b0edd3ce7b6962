//! Binary numbers of files, of any type that measurement programs write, as f64.

/// The kind of a number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Signed,
    Unsigned,
    Float,
}

/// The type of the numbers of an array.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Numbers {
    kind: Kind,
    size: usize,
    big_endian: bool,
}

impl Numbers {
    /// Numbers of `size` bytes; `None` for a size that there is not.
    pub(super) fn of(kind: Kind, size: usize, big_endian: bool) -> Option<Self> {
        let is_known = match kind {
            Kind::Signed | Kind::Unsigned => matches!(size, 1 | 2 | 4 | 8),
            Kind::Float => matches!(size, 4 | 8),
        };
        is_known.then_some(Self { kind, size, big_endian })
    }

    /// Bytes of a number.
    pub(super) fn size(self) -> usize {
        self.size
    }

    /// Appends the numbers of a piece, which holds whole ones. Integers beyond 2^53 become the nearest f64.
    pub(super) fn decode(self, piece: &[u8], to: &mut Vec<f64>) {
        match (self.kind, self.size) {
            (Kind::Signed, 1) => self.each(piece, to, |b| f64::from(i8::from_le_bytes(b))),
            (Kind::Signed, 2) => self.each(piece, to, |b| f64::from(i16::from_le_bytes(b))),
            (Kind::Signed, 4) => self.each(piece, to, |b| f64::from(i32::from_le_bytes(b))),
            (Kind::Signed, _) => self.each(piece, to, |b| i64::from_le_bytes(b) as f64),
            (Kind::Unsigned, 1) => self.each(piece, to, |b| f64::from(u8::from_le_bytes(b))),
            (Kind::Unsigned, 2) => self.each(piece, to, |b| f64::from(u16::from_le_bytes(b))),
            (Kind::Unsigned, 4) => self.each(piece, to, |b| f64::from(u32::from_le_bytes(b))),
            (Kind::Unsigned, _) => self.each(piece, to, |b| u64::from_le_bytes(b) as f64),
            (Kind::Float, 4) => self.each(piece, to, |b| f64::from(f32::from_le_bytes(b))),
            (Kind::Float, _) => self.each(piece, to, f64::from_le_bytes),
        }
    }

    /// Appends numbers of `N` bytes; `number` reads them with the least significant byte first.
    fn each<const N: usize>(self, piece: &[u8], to: &mut Vec<f64>, number: impl Fn([u8; N]) -> f64) {
        let (numbers, _) = piece.as_chunks::<N>();
        if self.big_endian {
            to.extend(numbers.iter().map(|&(mut bytes)| {
                bytes.reverse();
                number(bytes)
            }));
        } else {
            to.extend(numbers.iter().map(|&bytes| number(bytes)));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_of_each_type_are_read_in_either_byte_order() {
        fn check(kind: Kind, little: &[u8], expected: &[f64]) {
            let size = little.len() / expected.len();
            let big: Vec<u8> = little.chunks(size).flat_map(|n| n.iter().rev().copied()).collect();
            for (bytes, big_endian) in [(little, false), (&big[..], true)] {
                let mut read = Vec::new();
                Numbers::of(kind, size, big_endian).expect("known").decode(bytes, &mut read);
                assert_eq!(read, expected, "{kind:?} of {size} bytes");
            }
        }
        let two = |least: f64, most: f64| [least, most];
        check(Kind::Signed, &[0x80, 0x7F], &two(-128.0, 127.0));
        check(Kind::Unsigned, &[0, 0xFF], &two(0.0, 255.0));
        check(Kind::Signed, &[i16::MIN, 258].map(i16::to_le_bytes).concat(), &two(-32768.0, 258.0));
        check(Kind::Unsigned, &[u16::MAX, 258].map(u16::to_le_bytes).concat(), &two(65535.0, 258.0));
        check(Kind::Signed, &[i32::MIN, 3].map(i32::to_le_bytes).concat(), &two(-2_147_483_648.0, 3.0));
        check(Kind::Unsigned, &[u32::MAX, 3].map(u32::to_le_bytes).concat(), &two(4_294_967_295.0, 3.0));
        check(Kind::Signed, &[-(1_i64 << 60), 3].map(i64::to_le_bytes).concat(), &two(-(2f64.powi(60)), 3.0));
        check(Kind::Unsigned, &[1_u64 << 63, 3].map(u64::to_le_bytes).concat(), &two(2f64.powi(63), 3.0));
        check(Kind::Float, &[0.25_f32, -3.5].map(f32::to_le_bytes).concat(), &two(0.25, -3.5));
        check(Kind::Float, &[0.1_f64, -3.5].map(f64::to_le_bytes).concat(), &two(0.1, -3.5));
    }

    #[test]
    fn sizes_that_there_are_not_are_none() {
        for (kind, size) in [(Kind::Float, 2), (Kind::Float, 16), (Kind::Signed, 3), (Kind::Unsigned, 0)] {
            assert_eq!(Numbers::of(kind, size, false), None, "{kind:?} of {size} bytes");
        }
    }
}
