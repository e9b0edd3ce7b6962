//! Small requests that declare large sizes, and invalid values.

use super::corpus::{CSV, Case, JSON, MODELS, NPY, PREDICT, RUNS, with_header};
use super::meter::WEIGHTS;
use crate::support::{f8, gain_weights, npy};

/// Small bodies that declare much.
pub fn lies() -> Vec<Case> {
    [sizes(), rates(), bombs(), heads()].concat()
}

/// A data set 58b of 40 GB.
const BINARY_58: &str = "    58b     1     2          11 39999999996";

fn sizes() -> Vec<Case> {
    let mut cases = Vec::new();
    for shape in [
        "(1000000000000, 2)",
        "(2, 1000000000000)",
        "(18446744073709551615, 18446744073709551615)",
        "(4294967296, 4294967296)",
        "(99999999999999999999, 1)",
        "(-1, 2)",
        "(0, 18446744073709551615)",
        "((1,), 2)",
    ] {
        cases
            .push(Case::file("POST", RUNS, NPY, npy("<f8", false, shape, &f8(&[1.0, 2.0]))).named(shape, ""));
        let path = format!("{PREDICT}?sample_rate_hz=100");
        cases.push(Case::file("POST", &path, NPY, npy("<i2", true, shape, &[0; 4])).named(shape, ""));
    }
    let mut long = b"\x93NUMPY\x02\x00\xff\xff\xff\xff".to_vec();
    long.extend(b"{'descr': '<f8'");
    cases.push(Case::file("POST", RUNS, NPY, long).named("npy, a header of 4 GiB", "npy.header"));
    let brackets = format!("{{'descr': {}", "[".repeat(60_000));
    let mut deep = b"\x93NUMPY\x01\x00".to_vec();
    deep.extend((brackets.len() as u16).to_le_bytes());
    deep.extend(brackets.bytes());
    cases.push(Case::file("POST", RUNS, NPY, deep).named("npy, a deep descr", "npy.dtype"));
    for length in [u64::MAX, 1 << 62, 100_000_000, 1 << 20, 0] {
        let file = [&length.to_le_bytes()[..], b"{}"].concat();
        cases.push(
            Case::file("POST", MODELS, WEIGHTS, file)
                .named("weights, a header that is not there", "weights.malformed"),
        );
    }
    for (kind, numbers) in [("    58", "  1.00000E+00"), (BINARY_58, "1234")] {
        let head =
            "u\n\n\n\n\n    1\n         29999999999         1  0.00000E+00  1.00000E-02\n        17\n\n\n\n";
        let file = format!("    -1\n{kind}\n{head}{numbers}\n    -1\n");
        let case = Case::file("POST", RUNS, "application/x-uff58", file);
        cases.push(case.named(&format!("{kind} of 9999999999 numbers"), "uff58.size"));
    }
    for (shape, offsets) in [
        ("[18446744073709551615,18446744073709551615]", "[0,8]"),
        ("[4294967296,4294967296]", "[0,0]"),
        ("[1]", "[0,18446744073709551615]"),
        ("[1]", "[8,4]"),
    ] {
        let header = format!(r#"{{"frf.re":{{"dtype":"F64","shape":{shape},"data_offsets":{offsets}}}}}"#);
        let file = with_header(header.as_bytes(), &[0; 8]);
        cases.push(
            Case::file("POST", MODELS, WEIGHTS, file).named("weights, offsets that lie", "weights.malformed"),
        );
    }
    cases
}

fn rates() -> Vec<Case> {
    let mut cases = Vec::new();
    for rate in ["0", "-1", "1e300", "1e-300", "NaN", "inf", "5e-324", "1e400", "-0", ""] {
        let query = format!("{RUNS}?sample_rate_hz={rate}");
        cases.push(
            Case::file("POST", &query, CSV, "u,y\n0,1\n1,0\n").named(&format!("rate {rate} of a csv"), ""),
        );
        let query = format!("{query}&resample=true");
        cases.push(
            Case::file("POST", &query, CSV, "u,y\n0,1\n1,0\n").named(&format!("rate {rate}, resampled"), ""),
        );
        let query = format!("{PREDICT}?sample_rate_hz={rate}");
        let drive = npy("<f8", false, "(2, 1)", &f8(&[0.5, 1.0]));
        cases.push(Case::file("POST", &query, NPY, drive).named(&format!("rate {rate} of a drive"), ""));
        let number = if ["0", "-1", "1e300", "1e-300", "5e-324", "1e400", "-0"].contains(&rate) {
            rate
        } else {
            "\"\""
        };
        let signals = format!(r#"{{"sample_rate_hz":{number},"channels":{{"u":[0,1]}}}}"#);
        let named = |what: &str| format!("rate {rate} of {what}");
        cases.push(Case::json("POST", RUNS, signals.clone()).named(&named("a json run"), ""));
        cases.push(
            Case::json("POST", PREDICT, format!(r#"{{"drive":{signals}}}"#))
                .named(&named("a prediction"), ""),
        );
        let channels = r#"[{"name":"u","unit":"","role":"drive"}]"#;
        let rig = format!(r#"{{"id":"other","sample_rate_hz":{number},"channels":{channels}}}"#);
        cases.push(Case::json("POST", "/v1/rigs", rig).named(&named("a rig"), ""));
    }
    for times in [
        "0\n1e300\n2e300\n",
        "0\n1e-300\n2e-300\n",
        "0\n5e-324\n1e-323\n",
        "0\n-1\n-2\n",
        "1e308\n-1e308\n1e308\n",
    ] {
        let file = format!("t\n{times}").replace('\n', ",1\n").replacen(",1", ",u", 1);
        let path = format!("{RUNS}?resample=true");
        cases.push(Case::file("POST", &path, CSV, file).named("times that make no rate", ""));
    }
    cases
}

/// Compressed bodies, small and with large content: none is inflated or accepted.
fn bombs() -> Vec<Case> {
    // The beginning of a GZIP member that would inflate to many zeros.
    let gzip = [
        &b"\x1f\x8b\x08\x00\x00\x00\x00\x00\x00\x03"[..],
        &[0xed, 0xc1, 1, 1, 0, 0, 0, 0x80, 0x90, 0xfe],
        &[0xff; 200],
    ]
    .concat();
    let zip = [
        &b"PK\x03\x04\x14\x00\x00\x00\x08\x00"[..],
        &[0; 8],
        &[0xff; 8],
        b"\x05\x00\x00\x00u.npy",
        &[0xff; 200],
    ]
    .concat();
    let mut cases = Vec::new();
    for encoding in ["gzip", "deflate", "br", "zstd", "gzip, gzip", "identity, gzip"] {
        for (path, media_type) in [(RUNS, CSV), (PREDICT, JSON), (MODELS, WEIGHTS), ("/v1/rigs", JSON)] {
            let case = Case::file("POST", path, media_type, gzip.clone()).with("content-encoding", encoding);
            cases.push(case.named(&format!("{encoding} at {path}"), "content_encoding.unsupported"));
        }
    }
    let types = [
        "application/zip",
        "application/x-npz",
        "application/x-hdf5",
        "application/x-matlab-data",
        "application/gzip",
    ];
    for media_type in types {
        // Formats that runs and drives come in.
        let is_file = media_type.starts_with("application/x-");
        let refused = if is_file { &[MODELS][..] } else { &[RUNS, PREDICT, MODELS] };
        for &path in refused {
            let case = Case::file("POST", path, media_type, zip.clone());
            cases.push(case.named(&format!("{media_type} at {path}"), "content_type.unsupported"));
        }
    }
    for bytes in [&gzip, &zip] {
        for (media_type, code) in [
            ("application/x-npz", "npz.invalid"),
            ("application/x-hdf5", "hdf5.invalid"),
            ("application/x-matlab-data", "mat.invalid"),
        ] {
            for path in [RUNS, PREDICT] {
                let name = format!("{:02x?} as {media_type} at {path}", &bytes[..2]);
                cases.push(Case::file("POST", path, media_type, bytes.clone()).named(&name, code));
            }
        }
        let name = format!("{:02x?} as RPC III", &bytes[..2]);
        let case = Case::file("POST", RUNS, "application/x-rpc3", bytes.clone());
        cases.push(case.named(&name, "rpc3.header"));
        let name = format!("{:02x?} as UFF 58", &bytes[..2]);
        let case = Case::file("POST", RUNS, "application/x-uff58", bytes.clone());
        cases.push(case.named(&name, "uff58.header"));
        for (path, media_type) in [(RUNS, CSV), (RUNS, NPY), (RUNS, JSON), (MODELS, WEIGHTS), (PREDICT, JSON)]
        {
            let name = format!("{:02x?} as {media_type}", &bytes[..2]);
            cases.push(Case::file("POST", path, media_type, bytes.clone()).named(&name, ""));
        }
    }
    cases
}

/// Headers and queries of up to a hundred kilobytes.
fn heads() -> Vec<Case> {
    let long = "a".repeat(100_000);
    let mut cases = Vec::new();
    for name in [
        "authorization",
        "idempotency-key",
        "content-digest",
        "accept",
        "content-encoding",
        "x-request-id",
        "cookie",
    ] {
        let case = Case::file("POST", RUNS, CSV, "u,y\n0,x\n").with(name, &long);
        cases.push(case.named(&format!("{name} of 100 kB"), ""));
    }
    cases.push(
        Case { headers: vec![("content-type".into(), long.clone())], ..Case::new("POST", RUNS) }
            .named("content-type of 100 kB", "content_type.unsupported"),
    );
    cases.push(
        Case { headers: vec![("if-match".into(), long)], ..Case::new("PUT", "/v1/rigs/bench/active-model") }
            .named("if-match of 100 kB", ""),
    );
    let rest = "a".repeat(60_000);
    cases.push(Case::new("GET", &format!("/v1/{rest}")).named("a path of 60 kB", "route.not_found"));
    cases.push(Case::new("GET", &format!("/v1/rigs/{rest}")).named("a rig of 60 kB", "rig.not_found"));
    cases.push(
        Case::new("GET", &format!("/v1/rigs?{rest}=1"))
            .named("a parameter of 60 kB", "query.unknown_parameter"),
    );
    cases
        .push(Case::new("GET", &format!("/v1/rigs?limit={rest}")).named("a value of 60 kB", "query.invalid"));
    let many: Vec<String> = (0..8000).map(|i| format!("p{i}=")).collect();
    cases.push(
        Case::new("GET", &format!("/v1/rigs?{}", many.join("&")))
            .named("8000 parameters", "query.unknown_parameter"),
    );
    let tags = vec!["tag=a"; 9000].join("&");
    cases.push(
        Case::file("POST", &format!("{RUNS}?{tags}"), CSV, "u,y\n0,0\n").named("9000 tags", "query.invalid"),
    );
    for span in ["from_s=1e300", "to_s=-1", "from_s=NaN", "from_s=1e308&to_s=1e-308", "to_s=inf"] {
        let path = format!("{RUNS}/0197f1a0-0000-7000-8000-000000000000/data?{span}");
        cases.push(Case::new("GET", &path).named(span, ""));
    }
    cases
}

/// Models of the bench that diverge when they predict: each is imported, then asked.
pub fn diverging() -> Vec<Vec<u8>> {
    [1e300, 1e308, f64::MAX].into_iter().map(|gain| gain_weights(&["u"], &["y"], gain)).collect()
}
