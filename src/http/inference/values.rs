//! The numbers of a tensor in JSON: flat, or a list of rows, in row-major order.

use std::fmt;

use serde::Deserialize;
use serde::de::{DeserializeSeed, Deserializer, Error, SeqAccess, Visitor};

/// Numbers that stand together: half a MiB.
const CHUNK: usize = 1 << 16;

/// Numbers in row-major order, in chunks: they are in memory once, while they come as while they become channels.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Values {
    /// Every chunk but the last has [`CHUNK`] numbers.
    chunks: Vec<Vec<f64>>,
    /// Numbers of each row, where they came in rows.
    pub row: Option<usize>,
}

impl Values {
    /// Number of numbers.
    pub fn len(&self) -> usize {
        self.chunks.iter().map(Vec::len).sum()
    }

    /// The numbers; the memory of each chunk is given back when it has been read.
    pub fn into_numbers(self) -> impl Iterator<Item = f64> {
        self.chunks.into_iter().flatten()
    }

    fn push(&mut self, number: f64) {
        match self.chunks.last_mut().filter(|chunk| chunk.len() < CHUNK) {
            Some(chunk) => chunk.push(number),
            None => self.chunks.push(vec![number]),
        }
    }
}

impl<'de> Deserialize<'de> for Values {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_seq(Rows)
    }
}

/// Reads the outer list.
struct Rows;

impl<'de> Visitor<'de> for Rows {
    type Value = Values;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a list of numbers, or of lists of numbers")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Values, A::Error> {
        let mut values = Values::default();
        // The elements of one list are all numbers (0) or all rows of one length.
        let mut first = None;
        while let Some(length) = list.next_element_seed(Element(&mut values))? {
            if *first.get_or_insert(length) != length {
                return Err(A::Error::custom("rows differ in length"));
            }
        }
        values.row = first.flatten();
        Ok(values)
    }
}

/// Reads an element of the outer list, a number or a row, and appends it; gives the length of the row.
struct Element<'a>(&'a mut Values);

impl<'de> DeserializeSeed<'de> for Element<'_> {
    type Value = Option<usize>;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Option<usize>, D::Error> {
        deserializer.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for Element<'_> {
    type Value = Option<usize>;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a number, or a list of numbers")
    }

    fn visit_f64<E: Error>(self, number: f64) -> Result<Option<usize>, E> {
        self.0.push(number);
        Ok(None)
    }

    fn visit_u64<E: Error>(self, number: u64) -> Result<Option<usize>, E> {
        self.visit_f64(number as f64)
    }

    fn visit_i64<E: Error>(self, number: i64) -> Result<Option<usize>, E> {
        self.visit_f64(number as f64)
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut row: A) -> Result<Option<usize>, A::Error> {
        let mut length = 0;
        while let Some(number) = row.next_element()? {
            self.0.push(number);
            length += 1;
        }
        Ok(Some(length))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<Values, String> {
        serde_json::from_str(text).map_err(|error: serde_json::Error| error.to_string())
    }

    #[test]
    fn numbers_come_flat_or_in_rows_and_in_no_other_way() {
        let values = |numbers: &[f64], row| {
            let mut values = Values { row, ..Values::default() };
            numbers.iter().for_each(|&number| values.push(number));
            Ok(values)
        };
        assert_eq!(read("[1, -2, 0.5]"), values(&[1.0, -2.0, 0.5], None));
        assert_eq!(read("[[1, 2], [3, 4]]"), values(&[1.0, 2.0, 3.0, 4.0], Some(2)));
        assert_eq!(read("[]"), values(&[], None));
        assert_eq!(read("[[], []]"), values(&[], Some(0)));
        for text in ["[[1], [2, 3]]", "[1, [2]]", "[[1], 2]"] {
            assert!(read(text).is_err_and(|error| error.starts_with("rows differ in length")), "{text}");
        }
        for text in ["[[[1]]]", "[true]", "[\"1\"]", "[null]", "5", "{}"] {
            assert!(read(text).is_err(), "{text}");
        }
    }

    #[test]
    fn chunks_keep_the_order_of_the_numbers() {
        let numbers: Vec<f64> = (0..2 * CHUNK + 3).map(|i| i as f64).collect();
        let values = read(&serde_json::to_string(&numbers).expect("JSON")).expect("values");
        assert_eq!((values.len(), values.chunks.len()), (numbers.len(), 3));
        assert!(values.into_numbers().eq(numbers));
    }
}
