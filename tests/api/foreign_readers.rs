//! Files that the service writes, read by other programs, and files that other programs write: Python packages that
//! `scripts/python_env.sh readers` installs.

use std::path::Path;
use std::process::Command;

use serde_json::Value;

use crate::support::{TestApp, bench, noise_csv};

/// Names and samples of a file, as JSON.
const RPC_READER: &str = "
import contextlib, json, sys
from rpc_reader.rpc_reader import ReadRPC
# It tells its progress on the same output.
with contextlib.redirect_stdout(sys.stderr):
    file = ReadRPC(sys.argv[1])
    file.import_rpc_data_from_file()
channels = file.get_channels()
data = file.get_data()
json.dump({
    'names': [channels[i]['Description'] for i in sorted(channels)],
    'step_s': float(file.get_headers()['DELTA_T']),
    'samples': data.T.tolist(),
}, sys.stdout)
";

/// A file of one or more channels at 1000 Hz, whose samples it prints as JSON.
const PYUFF: &str = "
import json, sys
import numpy as np
import pyuff
time = np.arange(1003) / 1000
samples = {'u': 3.5 * np.sin(40 * time), 'y': 1e-7 * np.cos(70 * time) - 2.0}
file = pyuff.UFF(sys.argv[1])
for index, (name, values) in enumerate(samples.items()):
    file._write_set({
        'type': 58, 'binary': int(sys.argv[2] == 'binary'), 'func_type': 1, 'id1': name,
        'rsp_node': index + 1, 'rsp_dir': 3, 'ref_node': 0, 'ref_dir': 0,
        'abscissa_spacing': 1, 'abscissa_spec_data_type': 17, 'abscissa_axis_units_lab': 's',
        'ordinate_spec_data_type': 0, 'ordinate_axis_units_lab': {'u': 'kN', 'y': 'mm'}[name],
        'orddenom_spec_data_type': 0, 'x': time, 'data': values,
    }, 'add')
json.dump({name: values.tolist() for name, values in samples.items()}, sys.stdout)
";

/// Python with the packages that read measurement files; nothing where they are not installed.
pub fn python() -> Option<Command> {
    let Some(readers) = std::env::var_os("RIGCAST_READERS").filter(|path| !path.is_empty()) else {
        println!("skipped: RIGCAST_READERS names no environment of Python (scripts/python_env.sh readers)");
        return None;
    };
    Some(Command::new(Path::new(&readers).join("bin/python")))
}

/// What a Python program prints; nothing without Python.
fn printed(program: &str, file: &Path, more: &[&str]) -> Option<Value> {
    let output = python()?.args(["-c", program]).arg(file).args(more).output().expect("Python runs");
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{errors}");
    Some(serde_json::from_slice(&output.stdout).expect("JSON"))
}

/// What a Python program prints about a file.
fn read_with(program: &str, file: &[u8]) -> Option<Value> {
    let directory = tempfile::tempdir().expect("a directory");
    let path = directory.path().join("run.rsp");
    std::fs::write(&path, file).expect("written");
    printed(program, &path, &[])
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().expect("samples").iter().map(|v| v.as_f64().expect("a number")).collect()
}

#[tokio::test]
async fn rpc_reader_reads_our_rpc3_within_half_a_count() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    // More than a group of 2,048 samples.
    let created = app.post_file("/v1/rigs/bench/runs", "text/csv", noise_csv(5000, 1)).await.expect(201);
    let data = format!("{}/data", created.header("location"));
    let run = app.get(&data).await.expect(200).json();
    let file = app.call("GET", &data).header("accept", "application/x-rpc3").send().await.expect(200).bytes;
    let Some(read) = read_with(RPC_READER, &file) else { return };
    assert_eq!(read["names"], serde_json::json!(["u", "y"]));
    assert_eq!(read["step_s"], 0.01);
    for (index, name) in ["u", "y"].into_iter().enumerate() {
        let expected = numbers(&run["channels"][name]);
        // That reader takes the scale for one of 32,768 counts where it is one of INT_FULL_SCALE; the format's
        // description and nCode's files have it as the unit of one count.
        let found: Vec<f64> =
            numbers(&read["samples"][index]).iter().map(|v| v * 32768.0 / 32752.0).collect();
        assert!(found.len() >= expected.len(), "{name}: the last frame is filled");
        let half_a_count = 0.5 * expected.iter().fold(0.0_f64, |most, v| most.max(v.abs())) / 32752.0;
        let off = found.iter().zip(&expected).fold(0.0_f64, |most, (a, b)| most.max((a - b).abs()));
        assert!(off <= 1.01 * half_a_count, "{name}: off by {off}, half a count is {half_a_count}");
    }
}

#[tokio::test]
async fn files_of_pyuff_come_in_with_the_samples_that_it_wrote() {
    let app = TestApp::start();
    let mut rig = bench();
    rig["sample_rate_hz"] = 1000.0.into();
    app.rig(&rig).await;
    // Text has twelve digits.
    for (form, digits) in [("text", 1e-11), ("binary", 0.0)] {
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join("run.uff");
        let Some(written) = printed(PYUFF, &path, &[form]) else { return };
        let file = std::fs::read(path).expect("written");
        let created = app.post_file("/v1/rigs/bench/runs", "application/x-uff58", file).await.expect(201);
        let run = created.json();
        assert_eq!((&run["units"], &run["samples"]), (&serde_json::json!(["kN", "mm"]), &1003.into()));
        let data = app.get(&format!("{}/data", created.header("location"))).await.expect(200).json();
        assert_eq!(data["sample_rate_hz"], 1000.0);
        for name in ["u", "y"] {
            let (found, expected) = (numbers(&data["channels"][name]), numbers(&written[name]));
            assert_eq!(found.len(), expected.len());
            let same = |(a, b): (&f64, &f64)| (a - b).abs() <= digits * b.abs();
            assert!(found.iter().zip(&expected).all(same), "{form}, {name}");
        }
    }
}
