//! A parser's messages in a client's words: serde names the types of our code, which say nothing to
//! anybody else.

/// The message without names of types: `invalid type: string "a", expected u32` becomes `expected a
/// whole number, 0 or above, found the string "a"`. What is not such a message stays as it is.
pub fn plain(text: &str) -> String {
    if let Some(rest) = text.strip_prefix("unknown variant ") {
        let (found, allowed) = rest.split_once(", ").unwrap_or((rest, "expected something else"));
        return format!("{allowed}, found {found}");
    }
    if text.starts_with("data did not match any variant of untagged enum") {
        return "is in none of the forms that are allowed".to_owned();
    }
    let mismatch = ["invalid type: ", "invalid value: ", "invalid length "];
    let Some(prefix) = mismatch.into_iter().find(|prefix| text.starts_with(prefix)) else {
        return text.to_owned();
    };
    // What was found may hold any text of the client's, what was expected is ours.
    let Some((found, wanted)) = text[prefix.len()..].rsplit_once(", expected ") else {
        return text.to_owned();
    };
    let found = if prefix == "invalid length " { format!("{found} values") } else { thing(found) };
    format!("expected {}, found {found}", expected(wanted))
}

/// What serde calls that which was found.
fn thing(found: &str) -> String {
    let quoted = |name: &str| {
        let value = found.strip_prefix(name)?.strip_prefix(" `")?;
        Some(value.strip_suffix('`').unwrap_or(value).to_owned())
    };
    if let Some(number) = quoted("integer").or_else(|| quoted("floating point")) {
        return format!("the number {number}");
    }
    if let Some(word) = quoted("boolean") {
        return word;
    }
    match found {
        "map" => "an object".to_owned(),
        "sequence" => "an array".to_owned(),
        "unit value" | "Option value" => "null".to_owned(),
        "unit variant" => "a string".to_owned(),
        _ if found.ends_with("variant") => "an object".to_owned(),
        _ if found.starts_with("string ") || found.starts_with("character ") => format!("the {found}"),
        _ => found.to_owned(),
    }
}

/// What serde calls that which was expected.
fn expected(wanted: &str) -> String {
    let counted = ["a tuple of size ", "an array of length ", "an array of size ", "tuple of "]
        .into_iter()
        .find_map(|prefix| wanted.strip_prefix(prefix));
    if let Some(count) = counted {
        return format!("an array of {} values", count.split(' ').next().unwrap_or(count));
    }
    let kind = |prefix: &str| wanted.starts_with(prefix);
    match wanted {
        "u8" | "u16" | "u32" | "u64" | "u128" | "usize" => "a whole number, 0 or above".to_owned(),
        "i8" | "i16" | "i32" | "i64" | "i128" | "isize" => "a whole number".to_owned(),
        "f32" | "f64" => "a number".to_owned(),
        "a boolean" => "true or false".to_owned(),
        "a sequence" => "an array".to_owned(),
        "a map" => "an object".to_owned(),
        "a borrowed string" | "variant identifier" | "field identifier" => "a string".to_owned(),
        "unit" | "option" => "null".to_owned(),
        _ if kind("tuple") || kind("a tuple") => "an array".to_owned(),
        _ if kind("struct ") || wanted.contains(" tagged enum") => "an object".to_owned(),
        _ if wanted == "enum" || kind("enum ") || kind("variant of enum") => "a string".to_owned(),
        _ => wanted.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use serde::Deserialize;
    use serde::de::DeserializeOwned;

    use super::*;

    #[derive(Debug, Deserialize)]
    #[serde(deny_unknown_fields)]
    #[expect(dead_code, reason = "only its refusals are looked at")]
    struct Body {
        count: usize,
        level: f64,
        offset: i32,
        on: bool,
        name: String,
        list: Vec<u8>,
        pair: [f64; 2],
        map: std::collections::BTreeMap<String, f64>,
    }

    #[derive(Debug, Deserialize)]
    #[serde(rename_all = "snake_case")]
    enum Word {
        Half,
        Whole,
    }

    fn message<T: DeserializeOwned + std::fmt::Debug>(json: &str) -> String {
        let text = serde_json::from_str::<T>(json).expect_err(json).to_string();
        plain(text.split(" at line ").next().unwrap_or(&text))
    }

    #[test]
    fn types_are_named_as_json_names_them() {
        for (json, expected) in [
            (
                r#"{"count": "a, expected b"}"#,
                r#"expected a whole number, 0 or above, found the string "a, expected b""#,
            ),
            (r#"{"count": -1}"#, "expected a whole number, 0 or above, found the number -1"),
            (r#"{"count": 1.5}"#, "expected a whole number, 0 or above, found the number 1.5"),
            (r#"{"level": true}"#, "expected a number, found true"),
            (r#"{"level": null}"#, "expected a number, found null"),
            (r#"{"offset": {}}"#, "expected a whole number, found an object"),
            (r#"{"on": 1}"#, "expected true or false, found the number 1"),
            (r#"{"name": []}"#, "expected a string, found an array"),
            (r#"{"list": {}}"#, "expected an array, found an object"),
            (r#"{"pair": [1]}"#, "expected an array of 2 values, found 1 values"),
            (r#"{"pair": 5}"#, "expected an array of 2 values, found the number 5"),
            (r#"{"map": 5}"#, "expected an object, found the number 5"),
            ("5", "expected an object, found the number 5"),
            ("{}", "missing field `count`"),
            (
                r#"{"cuont": 1}"#,
                "unknown field `cuont`, expected one of `count`, `level`, `offset`, `on`, `name`, `list`, `pair`, `map`",
            ),
        ] {
            assert_eq!(message::<Body>(json), expected, "{json}");
        }
        assert_eq!(message::<Word>("\"third\""), "expected `half` or `whole`, found `third`");
    }

    #[test]
    fn what_is_no_such_message_stays() {
        for text in ["", "a rig id is short", "expected value", "invalid type: ", "invalid length"] {
            assert_eq!(plain(text), text);
        }
    }
}
