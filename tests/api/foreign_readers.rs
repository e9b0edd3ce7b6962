//! Files that the service writes, read by other programs: Python packages that `scripts/python_env.sh readers` installs.

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

/// Python with the packages that read measurement files; nothing where they are not installed.
pub fn python() -> Option<Command> {
    let Some(readers) = std::env::var_os("RIGCAST_READERS").filter(|path| !path.is_empty()) else {
        println!("skipped: RIGCAST_READERS names no environment of Python (scripts/python_env.sh readers)");
        return None;
    };
    Some(Command::new(Path::new(&readers).join("bin/python")))
}

/// What a Python program prints about a file; nothing without Python.
fn read_with(program: &str, file: &[u8]) -> Option<Value> {
    let mut python = python()?;
    let directory = tempfile::tempdir().expect("a directory");
    let path = directory.path().join("run.rsp");
    std::fs::write(&path, file).expect("written");
    let output = python.args(["-c", program]).arg(&path).output().expect("Python runs");
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{errors}");
    Some(serde_json::from_slice(&output.stdout).expect("JSON"))
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
        let numbers = |value: &Value| -> Vec<f64> {
            value.as_array().expect("samples").iter().map(|v| v.as_f64().expect("a number")).collect()
        };
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
