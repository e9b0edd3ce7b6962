//! A small rig, a model of it and files of runs.

use std::io::{Cursor, Write};

use realfft::num_complex::Complex64;
use rigcast::engine::Signal;
use rigcast::engine::frf::Frf;
use rigcast::engine::lstm::{LstmBlock, LstmNet, Recombine};
use rigcast::engine::model::{InputRange, LstmPart, ModelKind, Preprocess, RigModel, Scaler, to_safetensors};
use rigcast::formats::npy::{self, Dtype, Order};
use rigcast::formats::rpc3::Rpc3Pieces;
use serde_json::{Value, json};

/// A rig of one drive `u` and one response `y` at 100 Hz.
pub fn rig(id: &str) -> Value {
    json!({
        "id": id, "name": "Bench", "sample_rate_hz": 100.0,
        "channels": [
            {"name": "u", "unit": "kN", "role": "drive", "quantity": "force"},
            {"name": "y", "unit": "mm", "role": "response", "quantity": "displacement", "axis": "z"},
        ],
    })
}

/// `y = 2 u` as an FRF, alone or with a network of two cells that adds nothing yet.
pub fn weights(kind: ModelKind) -> Vec<u8> {
    let segment_len = 8;
    let frf = Frf {
        sample_rate_hz: 100.0,
        segment_len,
        n_inputs: 1,
        n_outputs: 1,
        h: vec![Complex64::new(2.0, 0.0); segment_len / 2 + 1],
        usable_hz: [0.0, 50.0],
        x_mean: vec![0.0],
        y_mean: vec![0.0],
    };
    let inputs = if kind == ModelKind::Hybrid2 { 2 } else { 1 };
    let block = LstmBlock {
        inputs,
        cells: 2,
        weight_ih: (0..8 * inputs).map(|i| 0.1 * i as f32).collect(),
        weight_hh: vec![0.1; 16],
        bias: vec![0.5; 8],
    };
    let net = LstmNet { blocks: vec![block], outputs: 1, fc_weight: vec![0.0; 2], fc_bias: vec![0.0] };
    let scaler = |n: usize| Scaler { mean: vec![0.0; n], std: vec![1.0; n] };
    let lstm = LstmPart {
        net,
        x: scaler(inputs),
        y: scaler(1),
        window_len: 16,
        hop: 8,
        recombine: Recombine::Welch,
    };
    to_safetensors(&RigModel {
        kind,
        inputs: vec!["u".into()],
        outputs: vec!["y".into()],
        sample_rate_hz: 100.0,
        preprocess: Preprocess::default(),
        frf: (kind != ModelKind::Lstm).then_some(frf),
        frf_quality: None,
        core: Vec::new(),
        lstm: (kind != ModelKind::Frf).then_some(lstm),
        joint_range: None,
        window_range: Vec::new(),
        range: vec![InputRange { min: -1.0, max: 1.0, max_rate: 1000.0, band_hz: None, local: None }],
        band: None,
        effects: Vec::new(),
    })
}

/// A sample of a varying signal.
fn sample(channel: usize, i: usize) -> f64 {
    (0.9 * i as f64 + channel as f64).sin()
}

/// A run of both channels as CSV.
pub fn csv(samples: usize) -> Vec<u8> {
    let rows =
        (0..samples).map(|i| format!("{:.2},{:.4},{:.4}\n", 0.01 * i as f64, sample(0, i), sample(1, i)));
    ["time_s,u,y\ns,kN,mm\n".to_owned()].into_iter().chain(rows).collect::<String>().into_bytes()
}

/// The first channels of the rig as NPY.
pub fn npy(samples: usize, channels: usize) -> Vec<u8> {
    let channels: Vec<Vec<f64>> =
        (0..channels).map(|c| (0..samples).map(|i| sample(c, i)).collect()).collect();
    npy::write(&channels, Dtype::F8, Order::C).expect("finite and equally long")
}

/// The first channels of the rig as RPC III.
pub fn rpc3(samples: usize, channels: usize) -> Vec<u8> {
    let signal = (0..channels).map(|c| (0..samples).map(|i| sample(c, i)).collect()).collect();
    let signal = Signal::new(100.0, signal).expect("finite and equally long");
    let names = ["u", "y"][..channels].iter().map(|name| (*name).to_owned()).collect();
    let units = ["kN", "mm"][..channels].iter().map(|unit| (*unit).to_owned()).collect();
    let pieces = Rpc3Pieces::new(names, units, false, signal);
    pieces.collect::<std::io::Result<Vec<_>>>().expect("samples in memory").concat()
}

/// The first channels of the rig as data sets 58, or 58b in single precision, after one of another kind.
pub fn uff58(samples: usize, channels: usize, binary: bool) -> Vec<u8> {
    let mut file = b"    -1\n   164\n         1SI\n    -1\n".to_vec();
    for (channel, (name, unit)) in [("u", "kN"), ("y", "mm")].into_iter().enumerate().take(channels) {
        let form = if binary { format!("b{:6}{:6}{:12}{:12}", 1, 2, 11, 4 * samples) } else { String::new() };
        file.extend(format!("    -1\n    58{form}\n{name}\nNONE\nNONE\nNONE\nNONE\n").bytes());
        file.extend(b"    1         0    0         0 NONE               1   3 NONE               0   0\n");
        file.extend(format!("{:10}{samples:10}{:10}  0.00000E+00  1.00000E-02\n", 2, 1).bytes());
        file.extend(b"        17    0    0    0 Time                 s\n");
        file.extend(format!("         1    0    0    0 NONE                 {unit}\n\n\n").bytes());
        for i in 0..samples {
            let value = sample(channel, i);
            if binary {
                file.extend((value as f32).to_le_bytes());
            } else {
                let end = if i % 6 == 5 || i + 1 == samples { "\n" } else { "" };
                file.extend(format!("{value:13.5e}{end}").bytes());
            }
        }
        file.extend(b"    -1\n");
    }
    file
}

/// Both channels and their rate as an archive of NumPy arrays.
pub fn npz(samples: usize, packed: bool) -> Vec<u8> {
    let method = if packed { zip::CompressionMethod::Deflated } else { zip::CompressionMethod::Stored };
    let options = zip::write::SimpleFileOptions::default().compression_method(method);
    let mut archive = zip::ZipWriter::new(Cursor::new(Vec::new()));
    for (channel, name) in ["u.npy", "y.npy"].into_iter().enumerate() {
        let values = (0..samples).map(|i| sample(channel, i)).collect::<Vec<_>>();
        let array = npy::write(&[values], Dtype::F8, Order::C).expect("finite");
        archive.start_file(name, options).expect("a name");
        archive.write_all(&array).expect("memory");
    }
    archive.start_file("fs.npy", options).expect("a name");
    let head = "{'descr': '<f8', 'fortran_order': False, 'shape': (), }\n";
    let head = [&b"\x93NUMPY\x01\0"[..], &(head.len() as u16).to_le_bytes(), head.as_bytes()].concat();
    archive.write_all(&[head, 100f64.to_le_bytes().to_vec()].concat()).expect("memory");
    archive.finish().expect("memory").into_inner()
}

/// Both channels, their rate and their units as a MAT file of version 5, in a struct.
pub fn mat(samples: usize) -> Vec<u8> {
    fn element(kind: u32, data: &[u8]) -> Vec<u8> {
        let mut bytes = [kind.to_le_bytes(), (data.len() as u32).to_le_bytes()].concat();
        bytes.extend(data);
        bytes.resize(bytes.len().next_multiple_of(8), 0);
        bytes
    }
    fn array(class: u32, rows: usize, columns: usize, name: &str, content: &[u8]) -> Vec<u8> {
        let flags = element(6, &[class.to_le_bytes(), [0; 4]].concat());
        let shape = element(5, &[(rows as u32).to_le_bytes(), (columns as u32).to_le_bytes()].concat());
        element(14, &[flags, shape, element(1, name.as_bytes()), content.to_vec()].concat())
    }
    let doubles = |values: &[f64]| element(9, &values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>());
    let channel = |c: usize, name: &str| {
        let values: Vec<f64> = (0..samples).map(|i| sample(c, i)).collect();
        array(6, samples, 1, name, &doubles(&values))
    };
    let text = |text: &str| array(4, 1, text.len(), "", &element(16, text.as_bytes()));
    let units = array(1, 1, 2, "units", &[text("kN"), text("mm")].concat());
    let fields = [element(5, &8_u32.to_le_bytes()), element(1, b"u\0\0\0\0\0\0\0"), channel(0, "")].concat();
    let mut file = format!("{:124}\0\x01IM", "MATLAB 5.0 MAT-file").into_bytes();
    file.extend([array(2, 1, 1, "run", &fields), channel(1, "y"), units].concat());
    file.extend(array(6, 1, 1, "fs", &doubles(&[100.0])));
    file
}

/// Both channels as datasets with units, and their rate.
pub fn hdf5(samples: usize, chunks: bool) -> Vec<u8> {
    let mut file = hdf5_pure::FileBuilder::new();
    file.set_attr("fs", hdf5_pure::AttrValue::F64(100.0));
    for (channel, (name, unit)) in [("u", "kN"), ("y", "mm")].into_iter().enumerate() {
        let values: Vec<f64> = (0..samples).map(|i| sample(channel, i)).collect();
        let data = file.create_dataset(name).with_f64_data(&values).with_shape(&[samples as u64]);
        data.set_attr("unit", hdf5_pure::AttrValue::String(unit.into()));
        if chunks {
            data.with_chunks(&[16]).with_deflate(6);
        }
    }
    file.finish().expect("memory")
}

/// A run of both channels as JSON.
pub fn json(samples: usize) -> Vec<u8> {
    let channel = |c: usize| (0..samples).map(|i| sample(c, i)).collect::<Vec<_>>();
    json!({"sample_rate_hz": 100.0, "channels": {"u": channel(0), "y": channel(1)}}).to_string().into_bytes()
}
