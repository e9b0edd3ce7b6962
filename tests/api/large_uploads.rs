//! Memory of large uploads.
//!
//! `RIGCAST_TEST_UPLOAD_SAMPLES=86400000 cargo test --test api large_uploads -- --nocapture` sends a day at 1 kHz.

use std::fmt::Write;
use std::time::Duration;

use rigcast::client::Client;
use serde_json::{Value, json};
use tempfile::TempDir;

use crate::support::{Program, bench, f4, f8, noise, npy, setting};

const MIB: u64 = 1 << 20;

/// Memory that an upload may take, however long it is.
const ALLOWED: u64 = 20 * MIB;

/// Samples of each of two channels, or as many together; they alone have some 23 MiB.
fn samples() -> usize {
    setting("RIGCAST_TEST_UPLOAD_SAMPLES", 1_500_000)
}

/// Noise in steps of 1/2048, whose text is short and as exact as its four bytes.
fn steps(n: usize, seed: u64) -> Vec<f32> {
    noise(n, seed).iter().map(|v| (v * 2048.0).round() as f32 / 2048.0).collect()
}

/// Uploads a file to a program that was just started on `directory`, because memory left by another upload
/// would hide the peak of this one; returns the run. The memory is back 10 s later.
async fn measured(
    directory: &TempDir,
    rig: &str,
    query: &[(&str, &str)],
    media_type: &str,
    file: Vec<u8>,
) -> (Program, Client, Value) {
    let program = Program::start(directory, &[]);
    let client = Client::new(program.base(), None).expect("a client");
    client.get("/v1/rigs").await.expect("a list");
    program.count_peak();
    let idle = program.memory("RssAnon");
    let sent = file.len() as u64;
    let run = client.upload(rig, query, media_type, file).await.expect("a run");
    // Pages of the program's own file are no upload's: how many are resident hangs on what the kernel has at hand.
    let peak = program.memory("VmHWM").saturating_sub(program.memory("RssFile")).saturating_sub(idle);
    let left = async || {
        for _ in 0..100 {
            if program.memory("RssAnon") <= idle + 32 * MIB {
                break;
            }
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
        program.memory("RssAnon").saturating_sub(idle)
    };
    let left = left().await;
    println!(
        "an upload of {} MiB as {media_type} {query:?}, {} x {} samples: {} MiB at its peak, {} MiB left",
        sent / MIB,
        run["samples"],
        run["channels"].as_array().expect("names").len(),
        peak / MIB,
        left / MIB
    );
    assert!(peak < ALLOWED, "{media_type}: {} MiB", peak / MIB);
    assert!(left <= 32 * MIB, "{media_type}: {} MiB are left", left / MIB);
    (program, client, run)
}

/// Whether the run has these channels.
async fn check(client: &Client, run: &Value, channels: &[Vec<f32>; 2]) {
    let n = channels[0].len();
    assert_eq!(run["samples"], n);
    for (c, (name, samples)) in ["u", "y"].into_iter().zip(channels).enumerate() {
        let quality = &run["quality"]["channels"][c];
        let extreme = |of: fn(f32, f32) -> f32| samples.iter().copied().reduce(of).map(f64::from);
        assert_eq!(quality["min"].as_f64(), extreme(f32::min));
        assert_eq!(quality["max"].as_f64(), extreme(f32::max));
        let squares: f64 = samples.iter().map(|v| f64::from(*v).powi(2)).sum();
        let rms = quality["rms"].as_f64().expect("a number");
        assert!((rms / (squares / n as f64).sqrt() - 1.0).abs() < 1e-9, "{rms}");
        // Across the ends of blocks, and at the end.
        for range in [4_000..4_200, n / 2..n / 2 + 100, n - 50..n] {
            let (from, to) = (range.start as f64 / 100.0, range.end as f64 / 100.0);
            let path = format!(
                "/v1/rigs/bench/runs/{}/data?channels={name}&from_s={from}&to_s={to}",
                run["id"].as_str().expect("an id")
            );
            let data = client.get(&path).await.expect("samples");
            let expected: Vec<f64> = samples[range].iter().map(|v| f64::from(*v)).collect();
            assert_eq!(data["channels"][name], json!(expected), "{path}");
        }
    }
}

#[tokio::test]
async fn a_file_of_any_format_takes_the_memory_of_a_few_pieces_however_long_it_is() {
    let (n, directory) = (samples(), TempDir::new().expect("a directory"));
    let channels = [1, 2].map(|seed| steps(n, seed));
    let [u, y] = &channels;
    {
        let program = Program::start(&directory, &[]);
        let client = Client::new(program.base(), None).expect("a client");
        client.post("/v1/rigs", &bench()).await.expect("a rig");
    }
    const NPY: &str = "application/x-npy";
    let interleaved = || {
        let rows: Vec<f32> = u.iter().zip(y).flat_map(|(u, y)| [*u, *y]).collect();
        npy("<f4", false, &format!("({n}, 2)"), &f4(&rows))
    };
    let (program, client, run) = measured(&directory, "bench", &[], NPY, interleaved()).await;
    check(&client, &run, &channels).await;
    drop((program, client));

    let wide: Vec<f64> = u.iter().chain(y).map(|v| f64::from(*v)).collect();
    let file = npy("<f8", true, &format!("({n}, 2)"), &f8(&wide));
    drop(wide);
    let (program, client, run) = measured(&directory, "bench", &[], NPY, file).await;
    check(&client, &run, &channels).await;
    drop((program, client));

    let mut text = String::from("time_s,u,y\n");
    for (i, (u, y)) in u.iter().zip(y).enumerate() {
        // Hundredths of a second.
        writeln!(text, "{}.{:02},{},{}", i / 100, i % 100, f64::from(*u), f64::from(*y)).expect("in memory");
    }
    let (program, client, run) = measured(&directory, "bench", &[], "text/csv", text.into_bytes()).await;
    assert_eq!(run["sample_rate_hz"], 100.0);
    check(&client, &run, &channels).await;
    drop((program, client));

    let mut text = String::from("{\"sample_rate_hz\": 100, \"channels\": {\"u\": [");
    for (name, channel) in [("u", u), ("y", y)] {
        if name == "y" {
            text.push_str("], \"y\": [");
        }
        for (i, v) in channel.iter().enumerate() {
            write!(text, "{}{}", if i > 0 { "," } else { "" }, f64::from(*v)).expect("in memory");
        }
    }
    text.push_str("]}}");
    let (program, client, run) =
        measured(&directory, "bench", &[], "application/json", text.into_bytes()).await;
    check(&client, &run, &channels).await;
    drop((program, client));

    let query = [("sample_rate_hz", "1000"), ("resample", "true")];
    let (_program, _, run) = measured(&directory, "bench", &query, NPY, interleaved()).await;
    assert_eq!(run["samples"], n / 10);
}

#[tokio::test]
async fn a_file_of_many_channels_takes_no_more() {
    let (channels, directory) = (64, TempDir::new().expect("a directory"));
    let n = 2 * samples() / channels;
    let channel = |c: usize| json!({"name": format!("c{c}"), "unit": "kN", "role": if c.is_multiple_of(2) { "drive" } else { "response" }});
    let rig = json!({
        "id": "wide", "name": "Wide", "sample_rate_hz": 1000.0,
        "channels": (0..channels).map(channel).collect::<Vec<_>>(),
    });
    {
        let program = Program::start(&directory, &[]);
        Client::new(program.base(), None).expect("a client").post("/v1/rigs", &rig).await.expect("a rig");
    }
    let rows = steps(n * channels, 3);
    let file = npy("<f4", false, &format!("({n}, {channels})"), &f4(&rows));
    let (_program, client, run) = measured(&directory, "wide", &[], "application/x-npy", file).await;
    let path = format!(
        "/v1/rigs/wide/runs/{}/data?channels=c63&from_s={}",
        run["id"].as_str().expect("an id"),
        (n - 20) as f64 / 1000.0
    );
    let data = client.get(&path).await.expect("samples");
    let expected: Vec<f64> = (n - 20..n).map(|i| f64::from(rows[i * channels + 63])).collect();
    assert_eq!(data["channels"]["c63"], json!(expected));
}
