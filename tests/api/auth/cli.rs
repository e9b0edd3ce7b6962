//! `rigcast token`, and addresses beyond loopback.

use std::process::{Output, Stdio};

use tempfile::TempDir;

use crate::support::{Program, rigcast};

fn create(directory: &TempDir, arguments: &[&str]) -> Output {
    let path = directory.path().to_str().expect("UTF-8");
    let all = [&["token", "create", "--data-dir", path], arguments].concat();
    rigcast(&all).stdout(Stdio::piped()).output().expect("it ends")
}

/// The secret of a token that must be made: the only thing on standard output.
fn secret(directory: &TempDir, arguments: &[&str]) -> String {
    let made = create(directory, arguments);
    assert!(made.status.success(), "{made:?}");
    String::from_utf8(made.stdout).expect("text").trim_end().to_owned()
}

fn refused(directory: &TempDir, arguments: &[&str], words: &str) {
    let refused = create(directory, arguments);
    assert_eq!((refused.status.success(), refused.stdout.len()), (false, 0), "{refused:?}");
    let told = String::from_utf8_lossy(&refused.stderr);
    assert!(told.contains(words), "{told}");
}

#[tokio::test]
async fn a_wider_bind_is_refused_until_there_is_an_admins_token() {
    let directory = TempDir::new().expect("a directory");
    let path = directory.path().to_str().expect("UTF-8");
    for address in ["0.0.0.0:0", "[::]:0"] {
        let refused = rigcast(&["serve", "--listen", address, "--data-dir", path]).output().expect("it ends");
        assert_eq!(refused.status.code(), Some(1));
        let told = String::from_utf8_lossy(&refused.stderr);
        assert!(told.contains("rigcast token create --role admin") && told.contains(address), "{told}");
    }
    refused(&directory, &["--role", "reader"], "the first token must be an admin's");
    let secret = secret(&directory, &["--role", "admin", "--name", "first"]);
    let program = Program::listening("0.0.0.0:0", directory.path(), &[]);
    let url = format!("{}/v1/rigs", program.base());
    let client = reqwest::Client::new();
    let status = async |token: Option<&str>| {
        let request = client.get(&url).header("host", "rigcast.lab");
        let request = token.into_iter().fold(request, |request, token| request.bearer_auth(token));
        request.send().await.expect("an answer").status().as_u16()
    };
    assert_eq!((status(Some(&secret)).await, status(None).await), (200, 401));
    program.signal("-TERM");
    assert_eq!(program.ended().0, Some(0));
}

#[test]
fn an_admin_whose_token_has_ended_or_is_limited_does_not_open_a_wider_bind() {
    let directory = TempDir::new().expect("a directory");
    secret(&directory, &["--role", "admin", "--expires-in", "1s"]);
    secret(&directory, &["--role", "admin", "--rig", "bench"]);
    std::thread::sleep(std::time::Duration::from_millis(1100));
    let path = directory.path().to_str().expect("UTF-8");
    let refused = rigcast(&["serve", "--listen", "0.0.0.0:0", "--data-dir", path]).output().expect("it ends");
    assert_eq!(refused.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&refused.stderr).contains("no admin's token in force"), "{refused:?}");
}

#[tokio::test]
async fn tokens_are_made_while_the_service_is_stopped_and_a_running_one_is_pointed_to() {
    let directory = TempDir::new().expect("a directory");
    let admin = secret(&directory, &["--role", "admin"]);
    let limited =
        ["--role", "operator", "--name", "line 1", "--rig", "b", "--rig", "a", "--expires-in", "30d"];
    secret(&directory, &limited);
    let program = Program::start(&directory, &[]);
    refused(&directory, &["--role", "admin"], "POST /v1/tokens");
    let client = reqwest::Client::new();
    let list = client.get(format!("{}/v1/tokens", program.base())).bearer_auth(admin).send().await;
    let list: serde_json::Value = list.expect("an answer").json().await.expect("JSON");
    let token = &list["items"][1];
    assert_eq!((&token["role"], &token["name"]), (&"operator".into(), &"line 1".into()), "{list}");
    assert_eq!(token["rigs"], serde_json::json!(["a", "b"]));
    let time = |key: &str| token[key].as_str().expect(key).parse::<jiff::Timestamp>().expect("a time");
    let length = time("expires_at").duration_since(time("created_at"));
    assert!((length.as_secs_f64() - 30.0 * 86400.0).abs() < 1.0, "{length:?}");
    drop(program);
    for (arguments, words) in [
        (&["--role", "root"][..], "reader, operator, admin"),
        (&["--role", "admin", "--rig", "No"], "rig id"),
        (&["--role", "admin", "--expires-in", "soon"], "30d"),
        (&["--role", "admin", "--expires-in", "300000000h"], "too long"),
    ] {
        refused(&directory, arguments, words);
    }
}

#[tokio::test]
async fn the_end_of_the_last_token_does_not_open_the_doors_and_a_new_one_can_be_made() {
    let directory = TempDir::new().expect("a directory");
    let admin = secret(&directory, &["--role", "admin"]);
    let client = reqwest::Client::new();
    let status = async |method: reqwest::Method, url: String, token: Option<&str>| {
        let request =
            token.into_iter().fold(client.request(method, url), |request, token| request.bearer_auth(token));
        request.send().await.expect("an answer").status().as_u16()
    };
    let program = Program::start(&directory, &[]);
    let tokens = format!("{}/v1/tokens", program.base());
    let list = client.get(&tokens).bearer_auth(&admin).send().await.expect("an answer");
    let list: serde_json::Value = list.json().await.expect("JSON");
    let own = format!("{tokens}/{}", list["items"][0]["id"].as_str().expect("an id"));
    assert_eq!(status(reqwest::Method::DELETE, own, Some(&admin)).await, 204);
    assert_eq!(status(reqwest::Method::GET, tokens.clone(), Some(&admin)).await, 401);
    assert_eq!(status(reqwest::Method::GET, tokens, None).await, 401);
    drop(program);
    let again = secret(&directory, &["--role", "admin"]);
    let program = Program::start(&directory, &[]);
    let tokens = format!("{}/v1/tokens", program.base());
    for (token, expected) in [(None, 401), (Some(&*admin), 401), (Some(&*again), 200)] {
        assert_eq!(status(reqwest::Method::GET, tokens.clone(), token).await, expected);
    }
}
