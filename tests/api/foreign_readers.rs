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

/// Names, units and samples of a file, as JSON.
const RPC3_FILE: &str = "
import json, sys
import rpc3
channels, parameters = rpc3.read(sys.argv[1])
json.dump({
    'names': [channel.name for channel in channels], 'units': [channel.unit for channel in channels],
    'step_s': channels[0].dt, 'samples': [channel.data.tolist() for channel in channels],
}, sys.stdout)
";

/// A file of two channels at 1000 Hz, as counts or as floats, whose samples it prints as JSON.
const RPC3_FILE_WRITES: &str = "
import json, sys
import numpy as np
import rpc3
time = np.arange(5003) / 1000
samples = {'u': 3.5 * np.sin(40 * time), 'y': 1e-3 * np.cos(70 * time) - 2.0}
units = {'u': 'kN', 'y': 'mm'}
channels = [rpc3.Channel(name, units[name], 1e-3, values) for name, values in samples.items()]
rpc3.write(sys.argv[1], channels, datatype={'counts': int, 'floats': float}[sys.argv[2]])
json.dump({name: values.tolist() for name, values in samples.items()}, sys.stdout)
";

/// Names, units, rate and samples of a MAT file, as JSON.
const SCIPY: &str = "
import json, sys
import scipy.io
file = scipy.io.loadmat(sys.argv[1], simplify_cells=True)
json.dump({
    'names': list(file['names']), 'units': list(file['units']), 'fs': file['fs'],
    'samples': file['data'].T.tolist(),
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

/// A file of two channels at 1000 Hz in one of the forms in which programs save arrays, whose samples it prints as JSON.
const ARRAYS: &str = "
import json, sys
import h5py, scipy.io
import numpy as np
path, form = sys.argv[1:]
time = np.arange(1003) / 1000
u, y = 3.5 * np.sin(40 * time), 1e-7 * np.cos(70 * time) - 2.0
both = np.stack([u, y], axis=1)
cell = np.array(['u', 'y'], dtype=object)

def matlab_73(variables):
    # As MATLAB writes version 7.3: a block of text before the file, dimensions turned round, classes as attributes.
    with h5py.File(path, 'w', userblock_size=512) as file:
        references = file.create_group('#refs#')
        def char(at, name, text):
            data = at.create_dataset(name, data=np.array([[ord(c)] for c in text], dtype=np.uint16))
            data.attrs['MATLAB_class'] = np.bytes_('char')
            return data
        for name, value in variables.items():
            if isinstance(value, list):
                cells = [char(references, f'{name}{i}', text).ref for i, text in enumerate(value)]
                data = file.create_dataset(name, data=np.array([cells], dtype=h5py.ref_dtype).T, dtype=h5py.ref_dtype)
                data.attrs['MATLAB_class'] = np.bytes_('cell')
            else:
                value = np.atleast_2d(value).T
                data = file.create_dataset(name, data=value, chunks=value.shape, compression='gzip')
                data.attrs['MATLAB_class'] = np.bytes_('double')
    with open(path, 'r+b') as file:
        file.write(b'MATLAB 7.3 MAT-file, Platform: GLNXA64'.ljust(124) + bytes([0, 2]) + b'IM')

def hdf5(**options):
    with h5py.File(path, 'w') as file:
        file.attrs['fs'] = 1000.0
        for name, unit, values in (('u', 'kN', u), ('y', 'mm', y)):
            file.create_dataset('run/' + name, data=values, **options).attrs['unit'] = unit

def hdf5_matrix():
    with h5py.File(path, 'w', libver='latest') as file:
        file['data'] = both
        file['time'] = time
        file['names'] = ['u', 'y']
        file['units'] = ['kN', 'mm']

save = lambda **more: lambda: scipy.io.savemat(path, more.pop('variables'), **more)
column = {'u': u[:, None], 'y': y[:, None], 't': time[:, None]}
matrix = {'data': both, 'names': cell, 'units': np.array(['kN', 'mm']), 'fs': 1000.0}
{
    'npz': lambda: np.savez(path, u=u, y=y, t=time),
    'npz_compressed': lambda: np.savez_compressed(path, u=u, y=y, dt=0.001),
    'npz_matrix': lambda: np.savez(path, data=np.asfortranarray(both), names=['u', 'y'], units=['kN', 'mm'], fs=1000),
    'npz_numbered': lambda: np.savez(path, u, y),
    'mat': save(variables=column),
    'mat_rows': save(variables={'u': u, 'y': y, 'fs': 1000}, oned_as='row', do_compression=True),
    'mat_matrix': save(variables=matrix),
    'mat_struct': save(variables={'run': column}, do_compression=True),
    'mat_73': lambda: matlab_73({'u': u, 'y': y, 'fs': 1000.0}),
    'mat_73_matrix': lambda: matlab_73({'data': both, 'names': ['u', 'y'], 'fs': 1000.0}),
    'hdf5': hdf5,
    'hdf5_packed': lambda: hdf5(chunks=(100,), compression='gzip', shuffle=True, fletcher32=True),
    'hdf5_big_endian': lambda: hdf5(dtype='>f8'),
    'hdf5_matrix': hdf5_matrix,
    'complex.npz': lambda: np.savez(path, u=u, y=y + 1j),
    'complex.mat': save(variables={'u': u, 'y': y + 1j}),
    'complex.h5': lambda: h5py.File(path, 'w').create_dataset('y', data=y + 1j).file.close(),
    'objects.npz': lambda: np.savez(path, u=cell),
    'cell.mat': save(variables={'u': u, 'cell': cell}),
    'cell.h5': lambda: matlab_73({'u': u, 'cell': ['u', 'y']}),
    'uneven.npz': lambda: np.savez(path, u=u, y=y, t=np.where(time > 0.5, time + 0.01, time)),
}[form]()
json.dump({'u': u.tolist(), 'y': y.tolist()}, sys.stdout)
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
async fn two_foreign_readers_read_our_rpc3_within_half_a_count() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    // More than a group of 2,048 samples.
    let created = app.post_file("/v1/rigs/bench/runs", "text/csv", noise_csv(5000, 1)).await.expect(201);
    let data = format!("{}/data", created.header("location"));
    let run = app.get(&data).await.expect(200).json();
    let counts = app.call("GET", &data).header("accept", "application/x-rpc3").send().await.expect(200).bytes;
    let floats = "application/x-rpc3; numbers=floats";
    let floats = app.call("GET", &data).header("accept", floats).send().await.expect(200).bytes;
    // rpc-reader takes the scale for one of 32,768 counts where it is one of INT_FULL_SCALE; the format's description,
    // nCode's files and rpc3-file have it as the unit of one count. It also leaves the last frame as it was filled.
    for (reader, scale, knows_length) in [(RPC_READER, 32768.0 / 32752.0, false), (RPC3_FILE, 1.0, true)] {
        let Some(read) = read_with(reader, &counts) else { return };
        assert_eq!(read["names"], serde_json::json!(["u", "y"]));
        assert_eq!(read["step_s"], 0.01);
        assert!(!knows_length || read["units"] == serde_json::json!(["kN", "mm"]), "{}", read["units"]);
        for (index, name) in ["u", "y"].into_iter().enumerate() {
            let expected = numbers(&run["channels"][name]);
            let found: Vec<f64> = numbers(&read["samples"][index]).iter().map(|v| v * scale).collect();
            let is_whole =
                if knows_length { found.len() == expected.len() } else { found.len() >= expected.len() };
            assert!(is_whole, "{name}: {} samples", found.len());
            let half_a_count = 0.5 * expected.iter().fold(0.0_f64, |most, v| most.max(v.abs())) / 32752.0;
            let off = found.iter().zip(&expected).fold(0.0_f64, |most, (a, b)| most.max((a - b).abs()));
            assert!(off <= 1.01 * half_a_count, "{name}: off by {off}, half a count is {half_a_count}");
        }
        let Some(read) = read_with(reader, &floats) else { return };
        for (index, name) in ["u", "y"].into_iter().enumerate() {
            let (found, expected) = (numbers(&read["samples"][index]), numbers(&run["channels"][name]));
            let is_same = |(found, expected): (&f64, &f64)| *found as f32 == *expected as f32;
            assert!(found.len() >= expected.len() && found.iter().zip(&expected).all(is_same), "{name}");
        }
    }
}

#[tokio::test]
async fn files_of_rpc3_file_come_in_with_the_samples_that_it_wrote() {
    let app = TestApp::start();
    let mut rig = bench();
    rig["sample_rate_hz"] = 1000.0.into();
    app.rig(&rig).await;
    for (form, rounding) in [("counts", 0.5 / 32752.0), ("floats", f64::from(f32::EPSILON))] {
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join("run.rsp");
        let Some(written) = printed(RPC3_FILE_WRITES, &path, &[form]) else { return };
        let file = std::fs::read(path).expect("written");
        let created = app.post_file("/v1/rigs/bench/runs", "application/x-rpc3", file).await.expect(201);
        let run = created.json();
        assert_eq!((&run["units"], &run["samples"]), (&serde_json::json!(["kN", "mm"]), &5003.into()));
        let data = app.get(&format!("{}/data", created.header("location"))).await.expect(200).json();
        for name in ["u", "y"] {
            let (found, expected) = (numbers(&data["channels"][name]), numbers(&written[name]));
            let most = expected.iter().fold(0.0_f64, |most, v| most.max(v.abs()));
            let off = found.iter().zip(&expected).fold(0.0_f64, |off, (a, b)| off.max((a - b).abs()));
            assert!(off <= 1.01 * rounding * most, "{form}, {name}: off by {off} of {most}");
        }
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

/// A file of `ARRAYS` in this form, and its samples.
fn arrays(form: &str) -> Option<(Vec<u8>, Value)> {
    let directory = tempfile::tempdir().expect("a directory");
    // NumPy adds the ending otherwise.
    let path = directory.path().join("run.npz");
    let path =
        if form.starts_with("mat") || form.ends_with(".mat") { path.with_extension("mat") } else { path };
    let written = printed(ARRAYS, &path, &[form])?;
    Some((std::fs::read(path).expect("written"), written))
}

#[tokio::test]
async fn files_of_numpy_scipy_and_h5py_come_in_with_the_samples_that_they_wrote() {
    let app = TestApp::start();
    let mut rig = bench();
    rig["sample_rate_hz"] = 1000.0.into();
    app.rig(&rig).await;
    for (form, media_type) in [
        ("npz", "application/x-npz"),
        ("npz_compressed", "application/x-npz"),
        ("npz_matrix", "application/x-npz"),
        ("npz_numbered", "application/x-npz"),
        ("mat", "application/x-matlab-data"),
        ("mat_rows", "application/x-matlab-data"),
        ("mat_matrix", "application/x-matlab-data"),
        ("mat_struct", "application/x-matlab-data"),
        ("mat_73", "application/x-matlab-data"),
        ("mat_73_matrix", "application/x-matlab-data"),
        ("hdf5", "application/x-hdf5"),
        ("hdf5_packed", "application/x-hdf5"),
        ("hdf5_big_endian", "application/x-hdf5"),
        ("hdf5_matrix", "application/x-hdf5"),
    ] {
        let Some((file, written)) = arrays(form) else { return };
        // A run of equal samples is told to be the same one, and stored.
        for media_type in [media_type, "application/octet-stream"] {
            let created = app.post_file("/v1/rigs/bench/runs", media_type, file.clone()).await.expect(201);
            let data = app.get(&format!("{}/data", created.header("location"))).await.expect(200).json();
            assert_eq!(data["sample_rate_hz"], 1000.0, "{form}");
            for name in ["u", "y"] {
                assert_eq!(numbers(&data["channels"][name]), numbers(&written[name]), "{form}, {name}");
            }
        }
    }
    for (form, code) in [
        ("complex.npz", "variables.unsupported"),
        ("complex.mat", "variables.unsupported"),
        ("complex.h5", "variables.unsupported"),
        ("objects.npz", "variables.unsupported"),
        ("cell.mat", "variables.unsupported"),
        ("cell.h5", "variables.unsupported"),
        ("uneven.npz", "variables.uneven_time"),
    ] {
        let Some((file, _)) = arrays(form) else { return };
        let answer = app.post_file("/v1/rigs/bench/runs", "application/octet-stream", file).await;
        answer.problem(422, code);
    }
}

#[tokio::test]
async fn scipy_reads_our_mat_files() {
    const MAT: &str = "application/x-matlab-data";
    let app = TestApp::start();
    app.rig(&bench()).await;
    let created = app.post_file("/v1/rigs/bench/runs", "text/csv", noise_csv(5000, 1)).await.expect(201);
    let path = format!("{}/data", created.header("location"));
    let file = app.call("GET", &path).header("accept", MAT).send().await.expect(200).bytes;
    let Some(read) = read_with(SCIPY, &file) else { return };
    let data = app.get(&path).await.expect(200).json();
    assert_eq!(
        (&read["names"], &read["units"]),
        (&serde_json::json!(["u", "y"]), &serde_json::json!(["kN", "mm"]))
    );
    assert_eq!(read["fs"], data["sample_rate_hz"]);
    for (index, name) in ["u", "y"].into_iter().enumerate() {
        assert_eq!(numbers(&read["samples"][index]), numbers(&data["channels"][name]), "{name}");
    }
    // It comes in again as it went out.
    let again = app.post_file("/v1/rigs/bench/runs", MAT, file).await.expect(201);
    assert_eq!(app.get(&format!("{}/data", again.header("location"))).await.expect(200).json(), data);
}
