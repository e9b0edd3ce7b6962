//! Clients that leave before their answer comes, and those that only look as if they did.

use std::io::{Read, Write};
use std::net::{Shutdown, TcpStream};
use std::time::Duration;

use rigcast::compute::fair_queue::QueueSettings;
use serde_json::json;

use super::{depth, predict_npy, slow_weights, until};
use crate::support::{TestApp, bench, gain_weights, npy, read_all};

/// A service with one long prediction at once, whose model takes two million operations a sample.
async fn slow() -> TestApp {
    let app = TestApp::start_as(|mut config| {
        config.compute.long = QueueSettings::new(1, 32, Duration::from_secs(600));
        config.limits.deadline = Duration::from_secs(600);
        // The work is counted here, not the memory that it takes.
        config.limits.prediction_bytes = 4 << 30;
        config
    });
    app.rig(&bench()).await;
    app.activate("bench", slow_weights()).await;
    app
}

fn drive(samples: usize) -> Vec<u8> {
    npy("<f4", false, &format!("({samples}, 1)"), &vec![0; 4 * samples])
}

/// Sends a whole request for a prediction.
fn send(app: &TestApp, drive: &[u8], version: &str) -> TcpStream {
    let mut stream = TcpStream::connect(app.address()).expect("a connection");
    let head = format!(
        "POST /v1/rigs/bench/predict?sample_rate_hz=100 HTTP/{version}\r\nHost: localhost\r\n\
         Content-Type: application/x-npy\r\nAccept: application/json\r\nContent-Length: {}\r\n\r\n",
        drive.len()
    );
    stream.write_all(head.as_bytes()).expect("sent");
    stream.write_all(drive).expect("sent");
    stream
}

#[tokio::test]
async fn twenty_predictions_whose_clients_have_gone_end_the_waiting_ones_too() {
    let app = slow().await;
    // Each would take minutes, on any machine.
    let drive = drive(2_000_000);
    let clients: Vec<TcpStream> = (0..20).map(|_| send(&app, &drive, "1.1")).collect();
    until(&app, "long", (1, 19)).await;
    for (i, client) in clients.into_iter().enumerate() {
        if i % 2 == 1 {
            client.set_nonblocking(true).expect("a socket");
            let client = tokio::net::TcpStream::from_std(client).expect("a socket");
            client.set_zero_linger().expect("a reset at its end");
        }
    }
    until(&app, "long", (0, 0)).await;
    app.activate("bench", gain_weights(&["u"], &["y"], 2.0)).await;
    predict_npy(&app, &drive).await.expect("no panic").expect(200);
}

#[tokio::test]
async fn tensors_whose_client_has_gone_are_given_up_too() {
    let app = slow().await;
    let samples = 2_000_000;
    let tensor = json!({
        "name": "drive", "datatype": "FP32", "shape": [samples, 1],
        "parameters": {"binary_data_size": 4 * samples},
    });
    let request = json!({"inputs": [tensor]}).to_string();
    let head = format!(
        "POST /v2/models/bench/infer HTTP/1.1\r\nHost: localhost\r\nContent-Length: {}\r\n\
         Inference-Header-Content-Length: {}\r\n\r\n{request}",
        request.len() + 4 * samples,
        request.len()
    );
    let mut client = TcpStream::connect(app.address()).expect("a connection");
    client.write_all(head.as_bytes()).expect("sent");
    client.write_all(&vec![0; 4 * samples]).expect("sent");
    until(&app, "long", (1, 0)).await;
    drop(client);
    until(&app, "long", (0, 0)).await;
}

#[tokio::test]
async fn a_client_that_has_only_stopped_sending_reads_its_answer() {
    let app = slow().await;
    // More than a second on any machine.
    let drive = drive(100_000);
    let call = app.call("POST", "/v1/rigs/bench/predict?sample_rate_hz=100");
    let expected = call.header("accept", "application/json").body("application/x-npy", drive.as_slice());
    let expected = expected.send().await.expect(200);
    for version in ["1.1", "1.0"] {
        let mut client = send(&app, &drive, version);
        client.shutdown(Shutdown::Write).expect("half closed");
        until(&app, "long", (1, 0)).await;
        client.set_read_timeout(Some(Duration::from_secs(30))).expect("a timeout");
        let mut first = [0];
        client.read_exact(&mut first).expect("a byte that was sent ahead");
        assert_eq!(depth(&app, "long").await, (1, 0), "it is still being computed");
        let answer = format!("{}{}", char::from(first[0]), read_all(client));
        let (head, body) = answer.split_once("\r\n\r\n").expect("a head");
        assert!(head.starts_with(&format!("HTTP/{version} 200 OK\r\n")), "{head}");
        assert!(body == expected.text(), "the same answer as for any other client");
    }
}
