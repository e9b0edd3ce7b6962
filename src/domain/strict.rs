//! A stricter and kinder serde: it refuses duplicate keys in every object and an array in place of an
//! object, and accepts a single value in place of a list of one.
//!
//! Serde's derived code refuses duplicate fields of a struct, but its maps and free JSON keep the last
//! one. It also accepts an array for a struct, field by field in the order of declaration. Some programs
//! write a list of one as its element (MATLAB's `jsonencode`). [`Strict`] wraps a deserializer and passes
//! everything else through.

use std::collections::HashSet;
use std::fmt;

use serde::de::value::MapAccessDeserializer;
use serde::de::{
    DeserializeSeed, Deserializer, EnumAccess, Error, IntoDeserializer, MapAccess, SeqAccess, VariantAccess,
    Visitor,
};

/// A deserializer, visitor or access of serde, made strict.
pub struct Strict<T>(pub T);

/// Largest number of keys of an object; all of them are kept for comparison.
const MAX_KEYS: usize = 10_000;

/// Longest key, bytes; the longest sensible keys are channel names.
const MAX_KEY_BYTES: usize = 4096;

/// The entries of an object, with the keys seen so far.
struct Entries<A> {
    access: A,
    seen: HashSet<String>,
}

macro_rules! pass_to_format {
    ($($method:ident($($name:ident: $type:ty),*))*) => {$(
        fn $method<V: Visitor<'de>>(self, $($name: $type,)* visitor: V) -> Result<V::Value, D::Error> {
            self.0.$method($($name,)* Strict(visitor))
        }
    )*};
}

impl<'de, D: Deserializer<'de>> Deserializer<'de> for Strict<D> {
    type Error = D::Error;

    pass_to_format! {
        deserialize_any() deserialize_bool() deserialize_i8() deserialize_i16() deserialize_i32()
        deserialize_i64() deserialize_i128() deserialize_u8() deserialize_u16() deserialize_u32()
        deserialize_u64() deserialize_u128() deserialize_f32() deserialize_f64() deserialize_char()
        deserialize_str() deserialize_string() deserialize_bytes() deserialize_byte_buf()
        deserialize_option() deserialize_unit() deserialize_map()
        deserialize_identifier() deserialize_ignored_any()
        deserialize_unit_struct(name: &'static str) deserialize_newtype_struct(name: &'static str)
        deserialize_tuple(len: usize) deserialize_tuple_struct(name: &'static str, len: usize)
    }

    fn deserialize_seq<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, D::Error> {
        self.0.deserialize_any(Strict(OneOrMany(visitor)))
    }

    /// serde_json calls a number in the place of a word no JSON at all.
    fn deserialize_enum<V: Visitor<'de>>(
        self,
        _: &'static str,
        words: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, D::Error> {
        self.0.deserialize_any(Strict(OneOfWords { words, visitor }))
    }

    fn deserialize_struct<V: Visitor<'de>>(
        self,
        _: &'static str,
        _: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, D::Error> {
        self.0.deserialize_map(Strict(visitor))
    }

    fn is_human_readable(&self) -> bool {
        self.0.is_human_readable()
    }
}

macro_rules! pass_to_type {
    ($($method:ident($type:ty))*) => {$(
        fn $method<E: Error>(self, value: $type) -> Result<V::Value, E> {
            self.0.$method(value)
        }
    )*};
}

impl<'de, V: Visitor<'de>> Visitor<'de> for Strict<V> {
    type Value = V::Value;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.expecting(f)
    }

    pass_to_type! {
        visit_bool(bool) visit_i8(i8) visit_i16(i16) visit_i32(i32) visit_i64(i64) visit_i128(i128)
        visit_u8(u8) visit_u16(u16) visit_u32(u32) visit_u64(u64) visit_u128(u128) visit_f32(f32)
        visit_f64(f64) visit_char(char) visit_str(&str) visit_borrowed_str(&'de str) visit_string(String)
        visit_bytes(&[u8]) visit_borrowed_bytes(&'de [u8]) visit_byte_buf(Vec<u8>)
    }

    fn visit_none<E: Error>(self) -> Result<V::Value, E> {
        self.0.visit_none()
    }

    fn visit_unit<E: Error>(self) -> Result<V::Value, E> {
        self.0.visit_unit()
    }

    fn visit_some<D: Deserializer<'de>>(self, deserializer: D) -> Result<V::Value, D::Error> {
        self.0.visit_some(Strict(deserializer))
    }

    fn visit_newtype_struct<D: Deserializer<'de>>(self, deserializer: D) -> Result<V::Value, D::Error> {
        self.0.visit_newtype_struct(Strict(deserializer))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, access: A) -> Result<V::Value, A::Error> {
        self.0.visit_seq(Strict(access))
    }

    fn visit_map<A: MapAccess<'de>>(self, access: A) -> Result<V::Value, A::Error> {
        self.0.visit_map(Entries { access, seen: HashSet::new() })
    }

    fn visit_enum<A: EnumAccess<'de>>(self, access: A) -> Result<V::Value, A::Error> {
        self.0.visit_enum(Strict(access))
    }
}

/// Makes a list of one of what is no list.
struct OneOrMany<V>(V);

macro_rules! one_of_list {
    ($($method:ident($type:ty))*) => {$(
        fn $method<E: Error>(self, value: $type) -> Result<V::Value, E> {
            self.0.visit_seq(One(Some(value.into_deserializer())))
        }
    )*};
}

impl<'de, V: Visitor<'de>> Visitor<'de> for OneOrMany<V> {
    type Value = V::Value;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.expecting(f)
    }

    one_of_list! {
        visit_bool(bool) visit_i64(i64) visit_i128(i128) visit_u64(u64) visit_u128(u128) visit_f64(f64)
        visit_str(&str) visit_string(String)
    }

    fn visit_seq<A: SeqAccess<'de>>(self, access: A) -> Result<V::Value, A::Error> {
        self.0.visit_seq(access)
    }

    fn visit_map<A: MapAccess<'de>>(self, access: A) -> Result<V::Value, A::Error> {
        self.0.visit_seq(One(Some(MapAccessDeserializer::new(access))))
    }
}

/// The elements of a list of one.
struct One<D>(Option<D>);

impl<'de, D: Deserializer<'de>> SeqAccess<'de> for One<D> {
    type Error = D::Error;

    fn next_element_seed<T: DeserializeSeed<'de>>(&mut self, seed: T) -> Result<Option<T::Value>, D::Error> {
        self.0.take().map(|value| seed.deserialize(Strict(value))).transpose()
    }

    fn size_hint(&self) -> Option<usize> {
        Some(usize::from(self.0.is_some()))
    }
}

/// Takes one of some words, alone or as the key of what belongs to it.
struct OneOfWords<V> {
    words: &'static [&'static str],
    visitor: V,
}

impl<'de, V: Visitor<'de>> Visitor<'de> for OneOfWords<V> {
    type Value = V::Value;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("one of ")?;
        for (i, word) in self.words.iter().enumerate() {
            write!(f, "{}`{word}`", if i == 0 { "" } else { ", " })?;
        }
        Ok(())
    }

    fn visit_str<E: Error>(self, word: &str) -> Result<V::Value, E> {
        self.visitor.visit_enum(word.into_deserializer())
    }

    fn visit_map<A: MapAccess<'de>>(self, access: A) -> Result<V::Value, A::Error> {
        self.visitor.visit_enum(MapAccessDeserializer::new(access))
    }
}

impl<'de, S: DeserializeSeed<'de>> DeserializeSeed<'de> for Strict<S> {
    type Value = S::Value;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<S::Value, D::Error> {
        self.0.deserialize(Strict(deserializer))
    }
}

impl<'de, A: SeqAccess<'de>> SeqAccess<'de> for Strict<A> {
    type Error = A::Error;

    fn next_element_seed<T: DeserializeSeed<'de>>(&mut self, seed: T) -> Result<Option<T::Value>, A::Error> {
        self.0.next_element_seed(Strict(seed))
    }

    fn size_hint(&self) -> Option<usize> {
        self.0.size_hint()
    }
}

impl<'de, A: MapAccess<'de>> MapAccess<'de> for Entries<A> {
    type Error = A::Error;

    fn next_key_seed<K: DeserializeSeed<'de>>(&mut self, seed: K) -> Result<Option<K::Value>, A::Error> {
        let Some(key) = self.access.next_key::<String>()? else { return Ok(None) };
        if key.len() > MAX_KEY_BYTES {
            return Err(Error::custom(format_args!("a key of more than {MAX_KEY_BYTES} bytes")));
        }
        if self.seen.len() == MAX_KEYS {
            return Err(Error::custom(format_args!("more than {MAX_KEYS} keys")));
        }
        if self.seen.contains(&key) {
            return Err(Error::custom(format_args!("duplicate field `{key}`")));
        }
        let found = seed.deserialize(key.as_str().into_deserializer())?;
        self.seen.insert(key);
        Ok(Some(found))
    }

    fn next_value_seed<T: DeserializeSeed<'de>>(&mut self, seed: T) -> Result<T::Value, A::Error> {
        self.access.next_value_seed(Strict(seed))
    }

    fn size_hint(&self) -> Option<usize> {
        self.access.size_hint()
    }
}

impl<'de, A: EnumAccess<'de>> EnumAccess<'de> for Strict<A> {
    type Error = A::Error;
    type Variant = Strict<A::Variant>;

    fn variant_seed<T: DeserializeSeed<'de>>(self, seed: T) -> Result<(T::Value, Self::Variant), A::Error> {
        self.0.variant_seed(Strict(seed)).map(|(value, variant)| (value, Strict(variant)))
    }
}

impl<'de, A: VariantAccess<'de>> VariantAccess<'de> for Strict<A> {
    type Error = A::Error;

    fn unit_variant(self) -> Result<(), A::Error> {
        self.0.unit_variant()
    }

    fn newtype_variant_seed<T: DeserializeSeed<'de>>(self, seed: T) -> Result<T::Value, A::Error> {
        self.0.newtype_variant_seed(Strict(seed))
    }

    fn tuple_variant<V: Visitor<'de>>(self, len: usize, visitor: V) -> Result<V::Value, A::Error> {
        self.0.tuple_variant(len, Strict(visitor))
    }

    fn struct_variant<V: Visitor<'de>>(
        self,
        fields: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, A::Error> {
        self.0.struct_variant(fields, Strict(visitor))
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use proptest::prelude::*;
    use serde::Deserialize;
    use serde::de::DeserializeOwned;
    use serde_json::{Value, json};

    use super::*;

    fn strict<T: DeserializeOwned>(text: &str) -> Result<T, String> {
        let mut json = serde_json::Deserializer::from_str(text);
        T::deserialize(Strict(&mut json)).map_err(|error| error.to_string())
    }

    #[derive(Debug, PartialEq, Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Inner {
        #[serde(default)]
        a: i64,
    }

    #[derive(Debug, PartialEq, Deserialize)]
    #[serde(rename_all = "snake_case")]
    enum Word {
        Plain,
        With(Inner),
        Fields { x: f64 },
    }

    #[derive(Debug, PartialEq, Deserialize)]
    #[serde(untagged)]
    enum Either {
        List(Vec<u32>),
        Inner(Inner),
    }

    #[derive(Debug, PartialEq, Deserialize)]
    struct Outer {
        inner: Option<Inner>,
        map: BTreeMap<String, [f64; 2]>,
        words: Vec<Word>,
        either: Either,
        free: Value,
        id: uuid::Uuid,
    }

    fn outer() -> Value {
        json!({
            "inner": {"a": 1}, "map": {"x": [1, 2.5]}, "either": {"a": 2}, "free": {"b": [null, true, "c"]},
            "words": ["plain", {"with": {"a": 3}}, {"fields": {"x": -1e-3}}],
            "id": "0197f1a0-0000-7000-8000-000000000000",
        })
    }

    #[test]
    fn what_is_right_is_read_as_ever() {
        let text = outer().to_string();
        assert_eq!(strict::<Outer>(&text).unwrap(), serde_json::from_str::<Outer>(&text).unwrap());
    }

    #[test]
    fn a_key_that_comes_twice_is_refused_wherever_it_is() {
        for (plain, twice) in [
            (r#"{"a":1}"#, r#"{"a":1,"a":1}"#),
            (r#"{"x":[1,2.5]}"#, r#"{"x":[1,2.5],"\u0078":[1,2.5]}"#),
            (r#"{"a":2}"#, r#"{"a":2,"a":2}"#),
            (r#"{"b":[null,true,"c"]}"#, r#"{"b":[{"c":1,"c":2}]}"#),
            (r#"{"a":3}"#, r#"{"a":3,"a":3}"#),
            (r#"{"x":-0.001}"#, r#"{"x":1,"x":1}"#),
        ] {
            let text = outer().to_string();
            assert!(text.contains(plain), "{plain} in {text}");
            let error = strict::<Outer>(&text.replace(plain, twice)).expect_err(twice);
            assert!(error.starts_with("duplicate field"), "{error}");
        }
    }

    #[test]
    fn a_single_value_stands_for_a_list_of_one_and_nothing_else_does() {
        #[derive(Debug, PartialEq, Deserialize)]
        #[serde(deny_unknown_fields)]
        struct Lists {
            #[serde(default)]
            numbers: Option<Vec<f64>>,
            #[serde(default)]
            counts: Vec<usize>,
            #[serde(default)]
            words: Vec<Word>,
            #[serde(default)]
            inner: Vec<Inner>,
            #[serde(default)]
            ids: Vec<uuid::Uuid>,
            #[serde(default)]
            nested: Vec<Vec<String>>,
        }
        for (one, list) in [
            (r#"{"numbers": 5}"#, r#"{"numbers": [5]}"#),
            (r#"{"numbers": -0.5}"#, r#"{"numbers": [-0.5]}"#),
            (r#"{"counts": 7}"#, r#"{"counts": [7]}"#),
            (r#"{"words": "plain"}"#, r#"{"words": ["plain"]}"#),
            (r#"{"words": {"with": {"a": 3}}}"#, r#"{"words": [{"with": {"a": 3}}]}"#),
            (r#"{"inner": {"a": 4}}"#, r#"{"inner": [{"a": 4}]}"#),
            (r#"{"nested": "a"}"#, r#"{"nested": [["a"]]}"#),
            (r#"{"nested": ["a", ["b", "c"]]}"#, r#"{"nested": [["a"], ["b", "c"]]}"#),
            (
                r#"{"ids": "0197f1a0-0000-7000-8000-000000000000"}"#,
                r#"{"ids": ["0197f1a0-0000-7000-8000-000000000000"]}"#,
            ),
        ] {
            let value: Value = serde_json::from_str(one).unwrap();
            assert_eq!(strict::<Lists>(one).unwrap(), serde_json::from_str::<Lists>(list).unwrap(), "{one}");
            assert_eq!(Lists::deserialize(Strict(value)).unwrap(), strict::<Lists>(list).unwrap(), "{one}");
        }
        for text in [
            r#"{"counts": null}"#,
            r#"{"counts": -1}"#,
            r#"{"counts": "5"}"#,
            r#"{"inner": 5}"#,
            r#"{"inner": {"b": 1}}"#,
            r#"{"inner": {"a": 1, "a": 1}}"#,
            r#"{"inner": [[{"a": 1}]]}"#,
            r#"{"words": "odd"}"#,
            r#"{"words": {"with": {"a": 3}, "plain": 1}}"#,
        ] {
            assert!(strict::<Lists>(text).is_err(), "{text}");
        }
        assert!(strict::<[f64; 1]>("5").is_err(), "an array of a fixed length is no list");
    }

    #[test]
    fn a_word_of_the_wrong_type_is_no_broken_json() {
        let error = strict::<Word>("5").unwrap_err();
        assert!(error.contains("expected one of `plain`, `with`, `fields`"), "{error}");
        assert!(strict::<Word>("\"odd\"").unwrap_err().contains("unknown variant"));
    }

    #[test]
    fn an_array_is_no_object() {
        assert!(serde_json::from_str::<Inner>("[5]").is_ok(), "serde takes it");
        for text in ["[5]", "[]"] {
            assert!(strict::<Inner>(text).is_err(), "{text}");
            assert!(strict::<Option<Inner>>(text).is_err(), "{text}");
            assert!(strict::<Vec<Word>>(&format!("[{{\"with\": {text}}}]")).is_err(), "{text}");
        }
    }

    proptest! {
        #[test]
        fn free_json_without_repeats_is_read_as_it_stands(
            keys in prop::collection::btree_set("[a-c\"\\\\\u{e9}]{0,3}", 0..4), x in any::<f64>(), n in any::<i64>()
        ) {
            let x = if x.is_finite() { x } else { 0.0 };
            let entries: serde_json::Map<_, _> = keys.into_iter().map(|k| (k, json!([x, n, {"k": x}]))).collect();
            let value = Value::Object(entries);
            prop_assert_eq!(strict::<Value>(&value.to_string()).unwrap(), value);
        }
    }
}
