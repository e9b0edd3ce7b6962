//! The real program: started, stopped, refused.

use std::time::Duration;

use tempfile::TempDir;

use crate::support::{Program, rigcast};

#[tokio::test]
async fn sigterm_finishes_the_answer_under_way_and_exits_with_0() {
    for signal in ["-TERM", "-INT"] {
        let directory = TempDir::new().expect("a directory");
        let running = Program::start(&directory, &[]);
        let rig = crate::support::bench();
        let client = reqwest::Client::new();
        let created =
            client.post(format!("{}/v1/rigs", running.base())).json(&rig).send().await.expect("an answer");
        assert_eq!(created.status(), 201);
        // A body that is still coming when the signal does.
        let (sender, body) = tokio::sync::mpsc::channel::<Result<Vec<u8>, std::io::Error>>(1);
        sender.send(Ok(b"u,y\n1,2\n".to_vec())).await.expect("room");
        let stream = reqwest::Body::wrap_stream(tokio_stream::wrappers::ReceiverStream::new(body));
        let url = format!("{}/v1/rigs/bench/runs", running.base());
        let upload = client.post(url).header("content-type", "text/csv").body(stream).send();
        let upload = tokio::spawn(upload);
        tokio::time::sleep(Duration::from_millis(300)).await;
        running.signal(signal);
        tokio::time::sleep(Duration::from_millis(300)).await;
        assert!(
            client.get(format!("{}/livez", running.base())).send().await.is_err(),
            "no new connection is taken"
        );
        sender.send(Ok(b"3,4\n".to_vec())).await.expect("room");
        drop(sender);
        let answer = upload.await.expect("no panic").expect("the answer under way is finished");
        assert_eq!(answer.status(), 201);
        drop(client);
        let (code, log) = running.ended();
        assert_eq!(code, Some(0), "{log:?}");
        assert!(log.iter().any(|line| line.contains("stopped")), "{log:?}");
        let line = log.iter().find(|line| line.contains("/v1/rigs/{rig}/runs")).expect("a line a request");
        assert!(!line.contains("3,4"), "no samples in the log");
    }
}

#[test]
fn a_second_program_on_the_same_data_is_refused() {
    let directory = TempDir::new().expect("a directory");
    let running = Program::start(&directory, &[]);
    let path = directory.path().to_str().expect("UTF-8");
    let second =
        rigcast(&["serve", "--listen", "127.0.0.1:0", "--data-dir", path]).output().expect("it ends");
    assert_eq!(second.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&second.stderr).contains("in use by another rigcast"), "{second:?}");
    running.signal("-TERM");
    assert_eq!(running.ended().0, Some(0));
}
