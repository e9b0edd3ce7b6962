//! Rows of the registry that are damaged while the service runs.

use std::time::Duration;

use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{ConnectOptions, Connection};

use crate::support::{TestApp, bench, noise_csv};

#[tokio::test]
async fn a_row_that_cannot_be_read_is_named_in_the_log_and_mended_at_once() {
    let app = TestApp::start();
    app.rig(&bench()).await;
    for seed in 0..3 {
        app.run("kind=other", &noise_csv(100, seed)).await;
    }
    let runs = "/v1/rigs/bench/runs";
    let before = app.get(runs).await.expect(200).json();
    let options = SqliteConnectOptions::new().filename(app.directory().join("rigcast.db"));
    let mut other = options.disable_statement_logging().connect().await.expect("the database");
    // Not what a program writes: damage sets off no trigger.
    let triggers: Vec<String> =
        sqlx::query_scalar("SELECT name FROM sqlite_master WHERE type = 'trigger' AND tbl_name = 'runs'")
            .fetch_all(&mut other)
            .await
            .expect("triggers");
    let mut damage = other.begin().await.expect("a transaction");
    let mut definitions = Vec::new();
    for trigger in &triggers {
        let sql: String = sqlx::query_scalar("SELECT sql FROM sqlite_master WHERE name = ?")
            .bind(trigger)
            .fetch_one(&mut *damage)
            .await
            .expect("a definition");
        definitions.push(sql);
        let drop = sqlx::AssertSqlSafe(format!("DROP TRIGGER {trigger}"));
        sqlx::query(drop).execute(&mut *damage).await.expect("dropped");
    }
    let flipped = "UPDATE runs SET quality = '{' || quality WHERE rowid = 2";
    sqlx::query(flipped).execute(&mut *damage).await.expect("damaged");
    for definition in definitions {
        sqlx::query(sqlx::AssertSqlSafe(definition)).execute(&mut *damage).await.expect("made again");
    }
    damage.commit().await.expect("committed");

    let refused = app.get(runs).await;
    assert_eq!(refused.header("retry-after"), "1");
    refused.problem(503, "store.row");
    for _ in 0..100 {
        let after = app.get(runs).await;
        if after.status == 200 {
            assert_eq!(after.json(), before);
            return;
        }
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    panic!("the row was not mended");
}
