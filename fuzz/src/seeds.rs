//! Small valid inputs from which the targets start, written when one starts.

use std::path::Path;

use rigcast::engine::model::ModelKind;
use serde_json::json;

use crate::fixtures;

/// Puts the seeds of a target where cargo fuzz looks for them.
///
/// # Panics
/// If they cannot be written.
pub fn plant(target: &str) {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus").join(target);
    std::fs::create_dir_all(&folder).expect("a folder");
    for (name, bytes) in seeds(target) {
        std::fs::write(folder.join(format!("seed-{name}")), bytes).expect("written");
    }
}

fn seeds(target: &str) -> Vec<(String, Vec<u8>)> {
    let named = |name: &str, bytes: &[u8]| (name.to_owned(), bytes.to_vec());
    match target {
        "csv" => vec![
            named("time", &fixtures::csv(5)),
            named("semicolons", b"u;y\n1,5;2,5\n-3e-2;4\n"),
            named("quoted", b"\"force, x\"\t\"two\nlines\"\r\n1\t2\r\n\r\n"),
            named("plain", b"\xef\xbb\xbf1,2\n3,4"),
        ],
        "npy" => vec![
            named("f8", &fixtures::npy(3, 1)),
            named("f8-two", &fixtures::npy(3, 2)),
            named("i2", &big_endian()),
        ],
        "rpc3" => vec![named("one", &fixtures::rpc3(3, 1)), named("two", &fixtures::rpc3(2100, 2))],
        "uff58" => vec![
            named("text", &fixtures::uff58(8, 1, false)),
            named("binary", &fixtures::uff58(8, 1, true)),
            named("two", &[fixtures::uff58(3, 2, false), fixtures::uff58(3, 2, true)].concat()),
        ],
        "npz" => vec![
            named("stored", &fixtures::npz(3, false)),
            named("packed", &fixtures::npz(300, true)),
        ],
        "mat" => vec![named("two", &fixtures::mat(5)), named("long", &fixtures::mat(100))],
        "hdf5" => vec![named("plain", &fixtures::hdf5(5, false)), named("chunks", &fixtures::hdf5(100, true))],
        "run_json" => vec![named("run", &fixtures::json(4))],
        "weights" => [ModelKind::Frf, ModelKind::Lstm, ModelKind::Hybrid1, ModelKind::Hybrid2]
            .map(|kind| named(kind.as_str(), &fixtures::weights(kind)))
            .to_vec(),
        "form_data" => {
            let form = b"\x04--b\r\nContent-Disposition: form-data; name=\"kind\"\r\n\r\nnoise\r\n--b\r\n\
                Content-Disposition: form-data; name=file; filename*=utf-8''a\r\nContent-Type: text/csv\r\n\r\nu\n1\r\n--b--";
            vec![named("two", form)]
        }
        "bodies" => bodies(),
        // The other targets are driven by raw bytes, so that any bytes will do as a start.
        _ => (0..4_u32)
            .map(|seed| {
                let bytes = (0..200_u32).map(|i| (i.wrapping_mul(2 * seed + 37) >> 2) as u8).collect();
                (seed.to_string(), bytes)
            })
            .collect(),
    }
}

fn big_endian() -> Vec<u8> {
    let header = b"{'descr': '>i2', 'fortran_order': True, 'shape': (2, 1), }";
    [b"\x93NUMPY\x02\x00\x3a\x00\x00\x00", &header[..], b"\x01\x02\x03\x04"].concat()
}

/// A body for each operation of the target, which the first byte names.
fn bodies() -> Vec<(String, Vec<u8>)> {
    let drive = json!({"sample_rate_hz": 100.0, "channels": {"u": [0.0, 0.5, -1e-3]}});
    let target = json!({"sample_rate_hz": 100.0, "channels": {"y": [0.0, 1.0, 0.0]}});
    let mut rig = fixtures::rig("other");
    rig["fit_policy"] = json!({"kinds": ["noise"], "min_total_s": 60.0, "fits": [{"kind": "frf"}]});
    let all = [
        json!({"model": "active", "drive": drive, "target": target, "include": ["response", "damage", "errors", "trust"],
               "damage": {"slope": 5, "constant": 1e7, "residue": "repeated", "directions": 5}}),
        json!({"predicted": drive, "target": drive, "groups": {"g": ["u", "u", "u"]}, "classes": {"count": 8}}),
        rig,
        json!({"name": "Bench 2", "fit_policy": null}),
        json!({"version": 1}),
        drive,
        json!({"hypothesis": 0, "activate": "never"}),
        json!({"inputs": [{"name": "drive", "datatype": "FP32", "shape": [2, 1], "data": [0.0, 0.5]}], "outputs": [{"name": "response"}]}),
    ];
    let with_place = |(which, body): (usize, &serde_json::Value)| {
        (which.to_string(), [vec![which as u8], body.to_string().into_bytes()].concat())
    };
    all.iter().enumerate().map(with_place).collect()
}
