//! Memory of large answers whose clients read slowly, or nothing.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::Duration;

use realfft::num_complex::Complex64;
use rigcast::client::Client;
use rigcast::engine::model::to_safetensors;
use serde_json::json;
use tempfile::TempDir;

use crate::support::{Program, bench, f4, gain_model, gain_weights, noise, npy};

/// Clients that read the head of an answer and nothing more.
const READERS: usize = 10;

const MIB: u64 = 1 << 20;

/// A program that holds a run of two channels of `samples` noise and a model `y = 2 u`, just started.
struct Service {
    program: Program,
    run: String,
    channels: [Vec<f32>; 2],
    _directory: TempDir,
}

impl Service {
    async fn start(samples: usize) -> Self {
        Self::start_with(samples, gain_weights(&["u"], &["y"], 2.0)).await
    }

    /// The same with another model.
    async fn start_with(samples: usize, weights: Vec<u8>) -> Self {
        let directory = TempDir::new().expect("a directory");
        let channels =
            [1, 2].map(|seed| noise(samples, seed).iter().map(|v| *v as f32).collect::<Vec<f32>>());
        let run = {
            // What an upload leaves behind would hide what an answer takes.
            let program = Program::start(&directory, &[]);
            let client = Client::new(program.base(), None).expect("a client");
            client.post("/v1/rigs", &bench()).await.expect("a rig");
            client.import("bench", weights).await.expect("a model");
            let file = npy("<f4", true, &format!("({samples}, 2)"), &f4(&channels.concat()));
            let run = client.upload("bench", &[("kind", "noise")], "application/x-npy", file).await;
            run.expect("a run")["id"].as_str().expect("an id").to_owned()
        };
        let program = Program::start_on(directory.path(), &[]);
        Self { program, run, channels, _directory: directory }
    }

    fn request(&self, method: &str, path: &str, headers: &str, body: &str) -> TcpStream {
        let address = self.program.base().strip_prefix("http://").expect("a URL");
        let mut stream = TcpStream::connect(address).expect("a connection");
        let head = format!(
            "{method} {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n{headers}\
             Content-Length: {}\r\n\r\n{body}",
            body.len()
        );
        stream.write_all(head.as_bytes()).expect("sent");
        stream.set_read_timeout(Some(Duration::from_secs(60))).expect("a timeout");
        stream
    }

    /// A request for the run's samples.
    fn data(&self, media_type: &str) -> TcpStream {
        let path = format!("/v1/rigs/bench/runs/{}/data", self.run);
        self.request("GET", &path, &format!("Accept: {media_type}\r\n"), "")
    }

    /// A request for the model's FRF.
    fn frf(&self, query: &str, media_type: &str) -> TcpStream {
        let path = format!("/v1/rigs/bench/models/1/frf?{query}");
        self.request("GET", &path, &format!("Accept: {media_type}\r\n"), "")
    }

    /// A request for the response to the run.
    fn prediction(&self) -> TcpStream {
        let body = json!({"model": 1, "drive": {"run": self.run}, "include": ["response"]}).to_string();
        self.request("POST", "/v1/rigs/bench/predict", "Content-Type: application/json\r\n", &body)
    }
}

/// Reads the beginning of an answer.
fn begin(mut client: &TcpStream) {
    let mut status = [0; 12];
    client.read_exact(&mut status).expect("an answer");
    assert_eq!(&status, b"HTTP/1.1 200");
}

/// The rest of an answer in chunks, or of declared length, without its head.
fn body(mut client: TcpStream) -> Vec<u8> {
    let mut answer = Vec::new();
    client.read_to_end(&mut answer).expect("a whole answer");
    let end = answer.windows(4).position(|four| four == b"\r\n\r\n").expect("the end of the head") + 4;
    let head = String::from_utf8(answer[..end].to_ascii_lowercase()).expect("text");
    let mut rest = &answer[end..];
    if let Some(length) = head.split("content-length: ").nth(1) {
        let length: usize = length.split("\r\n").next().and_then(|n| n.parse().ok()).expect("a number");
        assert_eq!(rest.len(), length);
        return rest.to_vec();
    }
    assert!(head.contains("transfer-encoding: chunked"), "{head}");
    let mut whole = Vec::new();
    loop {
        let line = rest.iter().position(|byte| *byte == b'\r').expect("the size of a chunk");
        let size = std::str::from_utf8(&rest[..line]).ok().and_then(|n| usize::from_str_radix(n, 16).ok());
        let size = size.expect("a number");
        rest = &rest[line + 2..];
        if size == 0 {
            return whole;
        }
        whole.extend_from_slice(&rest[..size]);
        rest = &rest[size + 2..];
    }
}

#[tokio::test]
async fn samples_of_a_run_take_the_memory_of_a_few_pieces_in_every_format() {
    let service = Service::start(2_000_000).await;
    let idle = service.program.count_peak();
    for media_type in ["application/json", "text/csv", "application/x-npy"] {
        let readers: Vec<TcpStream> = (0..READERS).map(|_| service.data(media_type)).collect();
        readers.iter().for_each(begin);
        let grown = service.program.memory("VmHWM").saturating_sub(idle) / MIB;
        println!("{READERS} readers of 2,000,000 samples of two channels as {media_type}: {grown} MiB");
        // A single answer has 32 MiB as NPY, and more than twice that as text.
        assert!(grown < 64, "{media_type}: {grown} MiB");
    }
    let wide: Vec<Vec<f64>> =
        service.channels.iter().map(|channel| channel.iter().map(|v| f64::from(*v)).collect()).collect();
    let text = |channel: &Vec<f64>| serde_json::to_string(channel).expect("JSON");
    let expected = format!(
        "{{\"sample_rate_hz\":100.0,\"channels\":{{\"u\":{},\"y\":{}}}}}",
        text(&wide[0]),
        text(&wide[1])
    );
    assert!(body(service.data("application/json")) == expected.as_bytes(), "the same text as ever");
    let rows: Vec<f64> = wide[0].iter().zip(&wide[1]).flat_map(|(u, y)| [*u, *y]).collect();
    let file = body(service.data("application/x-npy"));
    let numbers: Vec<u8> = rows.iter().flat_map(|v| v.to_le_bytes()).collect();
    assert!(file.ends_with(&numbers) && file.len() - numbers.len() == 128, "the same file as ever");
    let table = String::from_utf8(body(service.data("text/csv"))).expect("text");
    assert_eq!(table.lines().count(), 2 + wide[0].len());
    let last = table.lines().last().expect("a row");
    assert_eq!(last, format!("{:?},{:?},{:?}", 19_999.99, wide[0][1_999_999], wide[1][1_999_999]));
    let grown = service.program.memory("VmHWM").saturating_sub(idle) / MIB;
    assert!(grown < 64, "{grown} MiB");
}

#[tokio::test]
async fn large_predictions_share_a_budget_until_their_answers_are_read() {
    let samples = 4_000_000;
    let service = Service::start(samples).await;
    let idle = service.program.count_peak();
    let readers: Vec<TcpStream> = (0..READERS).map(|_| service.prediction()).collect();
    // Some are answered, and the others wait for memory.
    let begun = || {
        let begun = readers.iter().filter(|reader| {
            reader.set_nonblocking(true).expect("a socket");
            reader.peek(&mut [0]).is_ok_and(|n| n > 0)
        });
        begun.count()
    };
    let mut answered = 0;
    while answered < 2 || answered < begun() {
        answered = begun();
        tokio::time::sleep(Duration::from_secs(4)).await;
    }
    let grown = service.program.memory("VmHWM").saturating_sub(idle) / MIB;
    println!("{answered} of {READERS} readers have predictions of {samples} samples: {grown} MiB");
    assert!(answered < READERS, "all of them would take more than the budget");
    // The response has 31 MiB; with its drive, and as text, more than 130.
    assert!(grown < 256, "{grown} MiB");
    drop(readers);
    let answer = body(service.prediction());
    let text = std::str::from_utf8(&answer).expect("text");
    let response = text.split("\"y\":[").nth(1).and_then(|rest| rest.split(']').next()).expect("numbers");
    assert_eq!(response.split(',').count(), samples);
}

#[tokio::test]
async fn an_frf_of_many_lines_takes_the_memory_of_a_few_pieces_in_every_format() {
    let lines = 600_001;
    let mut model = gain_model(&["u"], &["y"], 2.0);
    let frf = model.frf.as_mut().expect("an FRF");
    frf.segment_len = 2 * (lines - 1);
    frf.h = vec![Complex64::new(2.0, 0.0); lines];
    let service = Service::start_with(10, to_safetensors(&model)).await;
    // The model is loaded once.
    body(service.frf("to_hz=1", "application/json"));
    let idle = service.program.count_peak();
    for media_type in ["application/json", "text/csv", "application/x-npy"] {
        let readers: Vec<TcpStream> = (0..READERS).map(|_| service.frf("", media_type)).collect();
        readers.iter().for_each(begin);
        let grown = service.program.memory("VmHWM").saturating_sub(idle) / MIB;
        println!("{READERS} readers of an FRF of {lines} lines as {media_type}: {grown} MiB");
        // A single answer has 9 MiB and more.
        assert!(grown < 40, "{media_type}: {grown} MiB");
    }
    let document = body(service.frf("", "application/json"));
    let document: serde_json::Value = serde_json::from_slice(&document).expect("JSON");
    assert_eq!(document["freq_hz"].as_array().map(Vec::len), Some(lines));
    assert_eq!(
        (&document["freq_hz"][lines - 1], &document["h"]["re"][lines - 1]),
        (&json!(50.0), &json!([[2.0]]))
    );
    let file = body(service.frf("", "application/x-npy"));
    assert_eq!(file.len(), 128 + 16 * lines);
    let gain = [2.0_f64.to_le_bytes(), 0.0_f64.to_le_bytes()].concat();
    assert!(file[128..].chunks(16).all(|z| z == gain));
}
