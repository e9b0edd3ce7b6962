//! Machines whose clocks are wrong, by `libfaketime` (Debian's package `faketime`).

use std::path::Path;
use std::time::Duration;

use serde_json::json;

use super::{Cluster, Kind, until};
use crate::support::{bench, noise_csv};

/// Where Debian keeps it.
const FAKETIME: &str = "/usr/lib/x86_64-linux-gnu/faketime/libfaketime.so.1";

#[tokio::test(flavor = "multi_thread")]
async fn clocks_that_are_ten_minutes_off_end_no_lease_and_no_token() {
    let Some(cluster) = Cluster::start() else { return };
    if !Path::new(FAKETIME).exists() {
        println!("skipped: no libfaketime on this machine");
        return;
    }
    let off = |kind, clock| {
        cluster.machine_with(
            kind,
            &[("LD_PRELOAD", FAKETIME), ("FAKETIME", clock), ("DONT_FAKE_MONOTONIC", "1")],
        )
    };
    let (early, late) = (off(Kind::Serve, "-10m"), off(Kind::Serve, "+10m"));
    let worker = off(Kind::Work, "-10m");
    let (at_early, at_late) = (early.client(None), late.client(None));
    at_early.post("/v1/rigs", &bench()).await.expect("a rig");
    let csv = noise_csv(6000, 1).into_bytes();
    let run = at_late.upload("bench", &[("kind", "noise")], "text/csv", csv).await.expect("a run");

    // A fit of many leases is not taken from its worker by one whose clock is twenty minutes ahead.
    let lstm = json!({"blocks": [24], "window_len": 128, "epochs": 4000, "seeds": [1]});
    let fit = json!({"kind": "lstm", "runs": [run["id"]], "lstm": lstm});
    let job = at_late.fit("bench", &fit).await.expect("a job");
    let _other = off(Kind::Work, "+10m");
    let ended = at_early.wait(&job, |_| {}).await.expect("a model");
    let (tokens, deaths) = (
        cluster.postgres.run("SELECT max(lease_token) FROM jobs"),
        cluster.postgres.run("SELECT max(service_deaths) FROM jobs"),
    );
    assert_eq!((tokens.trim(), deaths.trim(), &ended["attempt"]), ("1", "0", &json!(1)), "{ended}");

    // What is stamped is stamped by the database's clock.
    let stamp = |value: &serde_json::Value| -> jiff::Timestamp {
        value.as_str().expect("a time").parse().expect("RFC 3339")
    };
    for at in [&run["created_at"], &ended["finished_at"]] {
        let age = jiff::Timestamp::now().duration_since(stamp(at)).abs();
        assert!(age < jiff::SignedDuration::from_mins(2), "{at} is {age:?} off");
    }

    // A token of five minutes holds at both, and one that has expired at neither.
    let made = at_early.post("/v1/tokens", &json!({"name": "lab", "role": "admin"})).await.expect("a token");
    let admin = early.client(made["secret"].as_str());
    let expires = |after: Duration| (jiff::Timestamp::now() + after).to_string();
    let soon = json!({"name": "soon", "role": "reader", "expires_at": expires(Duration::from_secs(300))});
    let soon = admin.post("/v1/tokens", &soon).await.expect("a token");
    let brief = json!({"name": "brief", "role": "reader", "expires_at": expires(Duration::from_secs(4))});
    let brief = admin.post("/v1/tokens", &brief).await.expect("a token");
    for machine in [&early, &late] {
        let holds = machine.client(soon["secret"].as_str());
        until(Duration::from_secs(5), "a new token", async || holds.get("/v1/rigs").await.is_ok()).await;
        let ends = machine.client(brief["secret"].as_str());
        until(Duration::from_secs(10), "its end", async || ends.get("/v1/rigs").await.is_err()).await;
    }

    for (machine, side) in [(early, "behind"), (late, "ahead of")] {
        let told = admin_metrics(&machine, made["secret"].as_str()).await;
        let wanted = if side == "behind" { -600.0 } else { 600.0 };
        assert!((told - wanted).abs() < 30.0, "{told}");
        machine.program.signal("-TERM");
        let (status, log) = machine.program.ended();
        assert_eq!(status, Some(0));
        let log = log.join("\n");
        assert!(log.contains(&format!("s {side} that of the database")), "{log}");
    }
    drop(worker);
}

/// What a machine says of its clock.
async fn admin_metrics(machine: &super::Machine, token: Option<&str>) -> f64 {
    let url = format!("{}/metrics", machine.program.base());
    let sent = reqwest::Client::new().get(url).bearer_auth(token.expect("a secret")).send().await;
    let text = sent.expect("an answer").text().await.expect("text");
    let line = text.lines().find_map(|line| line.strip_prefix("rigcast_clock_offset_seconds "));
    line.unwrap_or_else(|| panic!("{text}")).parse().expect("a number")
}
