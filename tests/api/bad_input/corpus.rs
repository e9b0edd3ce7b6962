//! Bad requests of the largest allowed size, and small ones that expand.

use bytes::Bytes;
use serde_json::json;

use super::meter::WEIGHTS;
use crate::support::npy;

pub const CSV: &str = "text/csv";
pub const NPY: &str = "application/x-npy";
pub const JSON: &str = "application/json";
pub const RUNS: &str = "/v1/rigs/bench/runs";
pub const MODELS: &str = "/v1/rigs/bench/models";
pub const PREDICT: &str = "/v1/rigs/bench/predict";
pub const INFER: &str = "/v2/models/bench/infer";

/// A request and its name.
#[derive(Debug, Clone)]
pub struct Case {
    pub name: String,
    pub method: String,
    pub path: String,
    pub headers: Vec<(String, String)>,
    pub body: Bytes,
    /// Bytes of stored objects that the service reads for it.
    pub stored: u64,
    /// Code of the refusal, where only one is right.
    pub code: &'static str,
}

impl Case {
    pub fn new(method: &str, path: &str) -> Self {
        Self {
            name: format!("{method} {}", &path[..path.len().min(40)]),
            method: method.into(),
            path: path.into(),
            headers: Vec::new(),
            body: Bytes::new(),
            stored: 0,
            code: "",
        }
    }

    pub fn file(method: &str, path: &str, media_type: &str, body: impl Into<Vec<u8>>) -> Self {
        let body = Bytes::from(body.into());
        let case = Self { body, ..Self::new(method, path) };
        case.with("content-type", media_type).with("if-match", "*")
    }

    pub fn json(method: &str, path: &str, body: impl Into<Vec<u8>>) -> Self {
        Self::file(method, path, JSON, body)
    }

    pub fn with(mut self, name: &str, value: &str) -> Self {
        self.headers.push((name.into(), value.into()));
        self
    }

    pub fn named(mut self, name: &str, code: &'static str) -> Self {
        (self.name, self.code) = (name.into(), code);
        self
    }

    /// Bytes that it sends.
    pub fn size(&self) -> u64 {
        let headers: usize = self.headers.iter().map(|(n, v)| n.len() + v.len() + 4).sum();
        (self.body.len() + headers + self.path.len()) as u64
    }
}

/// `start`, then `piece` until some `size` bytes are full, then `end`.
fn filled(start: &str, piece: &str, end: &str, size: usize) -> Vec<u8> {
    let mut text = String::with_capacity(size + piece.len());
    text.push_str(start);
    while text.len() + end.len() < size {
        text.push_str(piece);
    }
    text.push_str(end);
    text.into_bytes()
}

/// The same with pieces that differ: `#` in a piece is its number.
fn numbered(start: &str, piece: &str, end: &str, size: usize) -> Vec<u8> {
    let mut text = String::with_capacity(size + piece.len());
    text.push_str(start);
    for i in 0.. {
        if text.len() + end.len() >= size {
            break;
        }
        text.push_str(&piece.replace('#', &i.to_string()));
    }
    text.push_str(end);
    text.into_bytes()
}

fn in_array(before: &str, item: &str, after: &str, size: usize) -> Vec<u8> {
    filled(before, &format!("{item},"), &format!("{item}{after}"), size)
}

/// Whole bodies of some `size` bytes.
pub fn large(size: usize) -> Vec<Case> {
    [files(size), weights(size), bodies(size)].concat()
}

/// Runs and drives.
fn files(size: usize) -> Vec<Case> {
    let csv = |body: Vec<u8>| Case::file("POST", RUNS, CSV, body);
    let wide = vec!["0"; 1024].join(",") + "\n";
    let (i2, f8) = (size / 2, size / 8);
    let mut nan = vec![0; 8 * f8];
    nan[8 * (f8 - 1)..].copy_from_slice(&f64::NAN.to_le_bytes());
    let i2 = npy("<i2", false, &format!("({i2}, 1)"), &vec![0; 2 * i2]);
    vec![
        csv(filled("u,y\n", "0,0\n", "0,x\n", size)).named("csv, last cell no number", "csv.not_a_number"),
        csv(filled("u\n", "0\n", "x\n", size)).named("csv, one column, last no number", "csv.not_a_number"),
        csv(filled("", &wide, "0\n", size)).named("csv, 1024 columns, ragged", "csv.ragged_row"),
        csv(filled("t,u\n", "0,0\n", "0,0\n", size)).named("csv, time stands still", "csv.uneven_time"),
        csv(in_array("", "0", "\n", size)).named("csv, all in one row", "run.too_many_channels"),
        csv([b"u,y\n".to_vec(), in_array("", "0", "\n", size)].concat())
            .named("csv, all in the second row", "csv.ragged_row"),
        csv([b"u,y\n\"\n\"".to_vec(), filled("", ",", "\n", size)].concat())
            .named("csv, a quoted line end and commas", "csv.ragged_row"),
        csv(filled("u,y\n\"", "a", "\n", size)).named("csv, an open quote", ""),
        csv(filled("", "\"\"", "\n", size)).named("csv, quotes", ""),
        csv(filled("", "a", "\n1\n", size)).named("csv, a name as long as the file", ""),
        csv(filled("", "\n", "u\n", size)).named("csv, empty lines", ""),
        Case::file("POST", &format!("{RUNS}?channels=nobody"), NPY, i2.clone())
            .named("npy i2, unknown channel", "run.unknown_channel"),
        Case::file("POST", &format!("{PREDICT}?sample_rate_hz=7"), NPY, i2)
            .named("npy i2 drive, another rate", "predict.sample_rate"),
        Case::file(
            "POST",
            &format!("{RUNS}?channels=u"),
            NPY,
            npy("<f8", false, &format!("({f8}, 1)"), &nan),
        )
        .named("npy f8, last not finite", "run.non_finite"),
        Case::json(
            "POST",
            RUNS,
            in_array(r#"{"sample_rate_hz":100,"channels":{"u":["#, "0", r#"],"y":[0]}}"#, size),
        )
        .named("json run, unequal lengths", "run.unequal_lengths"),
        Case::json(
            "POST",
            RUNS,
            in_array(r#"{"sample_rate_hz":100,"channels":{"u":["#, "0", r#",x]}}"#, size),
        )
        .named("json run, no json at its end", "json.invalid"),
        Case::json(
            "POST",
            RUNS,
            numbered(r#"{"sample_rate_hz":100,"channels":{"#, "\"#\":[0],", "\"u\":[0]}}", size),
        )
        .named("json run, channels without end", "run.too_many_channels"),
        Case::json("POST", RUNS, filled("{\"", "a", "\":1}", size))
            .named("json run, a long key", "json.unknown_field"),
        Case::json("POST", RUNS, filled("", "[", "", size)).named("json run, deep", "json.invalid"),
    ]
}

/// A weight file with this header.
pub fn with_header(header: &[u8], data: &[u8]) -> Vec<u8> {
    [&(header.len() as u64).to_le_bytes()[..], header, data].concat()
}

fn weights(size: usize) -> Vec<Case> {
    let case = |name: &str, header: Vec<u8>| {
        Case::file("POST", MODELS, WEIGHTS, with_header(&header, b"")).named(name, "weights.malformed")
    };
    let tensor = "\"#\":{\"dtype\":\"F32\",\"shape\":[0],\"data_offsets\":[0,0]},";
    let shape = r#"{"a":{"dtype":"F32","shape":["#;
    let meta = "{\"__metadata__\":{";
    vec![
        case("weights, tensors without end", numbered("{", tensor, "\"z\":0}", size)),
        case("weights, a shape without end", in_array(shape, "0", "],\"data_offsets\":[0,0]}}", size)),
        case("weights, metadata without end", numbered(meta, "\"#\":\"\",", "\"z\":\"\"}}", size)),
        case("weights, names without end", {
            let start = "{\"__metadata__\":{\"rigcast\":\"{\\\"schema\\\":1,\\\"kind\\\":\\\"frf\\\",\\\"inputs\\\":[";
            filled(start, "\\\"\\\",", "\\\"\\\"]}\"}}", size)
        }),
        case("weights, deep", filled("", "{\"a\":", "", size)),
        case("weights, blanks", filled("", " ", "{}", size)),
        frf(size),
    ]
}

/// An FRF of many lines, in the shorter type, of a channel that the rig does not have.
fn frf(size: usize) -> Case {
    let lines = size / 16;
    let meta =
        json!({"schema": 1, "kind": "frf", "inputs": ["q"], "outputs": ["y"], "sample_rate_hz": 100.0});
    let tensor = |dtype: &str, shape: &[usize], from: usize, bytes: usize| json!({"dtype": dtype, "shape": shape, "data_offsets": [from, from + bytes]});
    let header = json!({
        "__metadata__": {"rigcast": meta.to_string()},
        "frf.freq_hz": tensor("F64", &[lines], 0, 8 * lines),
        "frf.re": tensor("F32", &[lines, 1, 1], 8 * lines, 4 * lines),
        "frf.im": tensor("F32", &[lines, 1, 1], 12 * lines, 4 * lines),
    });
    let df_hz = 50.0 / (lines - 1) as f64;
    let mut data: Vec<u8> = (0..lines).flat_map(|line| (line as f64 * df_hz).to_le_bytes()).collect();
    data.resize(16 * lines, 0);
    Case::file("POST", MODELS, WEIGHTS, with_header(header.to_string().as_bytes(), &data))
        .named("weights, a long frf of another channel", "model.unknown_channel")
}

/// JSON bodies, with signals and without.
fn bodies(size: usize) -> Vec<Case> {
    let json =
        |name: &str, method: &str, path: &str, code, body| Case::json(method, path, body).named(name, code);
    let drive = r#"{"drive":{"sample_rate_hz":100,"channels":{"u":["#;
    let predicted = r#"{"predicted":{"sample_rate_hz":100,"channels":{"u":["#;
    let other = r#"{"drive":{"sample_rate_hz":7,"channels":{"u":["#;
    let damage = r#"{"predicted":{"sample_rate_hz":100,"channels":{"u":[0]}},"#;
    let tensor = |rest: &str| format!(r#"{{"inputs":[{{"name":"drive","datatype":"FP32",{rest}"#);
    let with = |start: &str, rest: &str| format!("{start}{rest}");
    // Without signals a body is small and expands in memory.
    let document = (1 << 20) - 100;
    let big = |name: &str, method: &str, path: &str, make: &dyn Fn(usize) -> Vec<u8>| {
        json(name, method, path, "", make(document))
    };
    vec![
        json(
            "predict, no number at its end",
            "POST",
            PREDICT,
            "body.syntax",
            in_array(drive, "0", ",x]}}}", size),
        ),
        json(
            "predict, another rate",
            "POST",
            PREDICT,
            "predict.sample_rate",
            in_array(other, "0", "]}}}", size),
        ),
        json(
            "predict, a text at its end",
            "POST",
            PREDICT,
            "body.invalid_value",
            in_array(drive, "0", ",\"\"]}}}", size),
        ),
        json(
            "predict, short arrays",
            "POST",
            PREDICT,
            "",
            numbered("{\"drive\":{\"sample_rate_hz\":100,\"channels\":{", "\"#\":[],", "\"u\":[]}}}", size),
        ),
        json(
            "predict, parts without end",
            "POST",
            PREDICT,
            "",
            in_array(r#"{"drive":{},"include":["#, "\"trust\"", "]}", size),
        ),
        json("predict, a long key", "POST", PREDICT, "body.invalid_value", filled("{\"", "a", "\":1}", size)),
        json(
            "predict, a long text",
            "POST",
            PREDICT,
            "body.invalid_value",
            filled("{\"model\":\"", "a", "\",\"drive\":{}}", size),
        ),
        json("predict, deep", "POST", PREDICT, "body.too_deep", filled("", "{\"channels\":", "", size)),
        json(
            "tensors, no number at its end",
            "POST",
            INFER,
            "body.syntax",
            in_array(&tensor(r#""shape":[1,1],"data":["#), "0", ",x]}]}", size),
        ),
        json(
            "tensors without end",
            "POST",
            INFER,
            "body.invalid_value",
            in_array(r#"{"inputs":["#, r#"{"name":"","datatype":"","shape":[]}"#, "]}", size),
        ),
        json(
            "tensors, a shape without end",
            "POST",
            INFER,
            "body.invalid_value",
            in_array(&tensor(r#""shape":["#), "1", "]}]}", size),
        ),
        json(
            "tensors, rows without numbers",
            "POST",
            INFER,
            "inference.shape",
            in_array(&tensor(r#""shape":[1,1],"data":["#), "[]", "]}]}", size),
        ),
        json(
            "tensors, fields that are ignored",
            "POST",
            INFER,
            "body.missing_field",
            in_array(r#"{"later":["#, "{}", "]}", size),
        ),
        json(
            "damage, no number at its end",
            "POST",
            "/v1/damage",
            "body.syntax",
            in_array(predicted, "0", ",x]}}}", size),
        ),
        json(
            "damage, groups without end",
            "POST",
            "/v1/damage",
            "body.invalid_value",
            numbered(
                &with(damage, "\"groups\":{"),
                "\"#\":[\"\",\"\",\"\"],",
                "\"z\":[\"\",\"\",\"\"]}}",
                size,
            ),
        ),
        json(
            "damage, a group of many",
            "POST",
            "/v1/damage",
            "",
            in_array(&with(damage, "\"groups\":{\"g\":["), "\"\"", "]}}", size),
        ),
        big("patch of a rig, free numbers", "PATCH", "/v1/rigs/bench", &|size| {
            in_array("{\"fit_policy\":[", "0", "]}", size)
        }),
        big("patch of a rig, free keys", "PATCH", "/v1/rigs/bench", &|size| {
            numbered("{", "\"#\":0,", "\"z\":0}", size)
        }),
        big("a rig of channels without end", "POST", "/v1/rigs", &|size| {
            in_array(
                r#"{"id":"a","sample_rate_hz":1,"channels":["#,
                r#"{"name":"","unit":"","role":"drive"}"#,
                "]}",
                size,
            )
        }),
        big("a fit of texts", "POST", "/v1/rigs/bench/fits", &|size| {
            in_array(r#"{"kind":"frf","runs":{"tags":["#, "\"\"", "]}}", size)
        }),
        big("a diagnosis of lists", "POST", "/v1/rigs/bench/diagnoses", &|size| {
            in_array(r#"{"runs":[],"repeats":["#, "[]", "]}", size)
        }),
        big("a diagnosis of texts", "POST", "/v1/rigs/bench/diagnoses", &|size| {
            in_array(r#"{"runs":[],"catalogue":["#, "\"\"", "]}", size)
        }),
        big("an evaluation of models", "POST", "/v1/rigs/bench/evaluations", &|size| {
            in_array(r#"{"models":["#, "1", "]}", size)
        }),
        big("an evaluation of classes", "POST", "/v1/rigs/bench/evaluations", &|size| {
            in_array(r#"{"classes":["#, "\"\"", "]}", size)
        }),
        big("a token for many rigs", "POST", "/v1/tokens", &|size| {
            numbered(r#"{"role":"reader","rigs":["#, "\"#\",", "\"z\"]}", size)
        }),
    ]
}
