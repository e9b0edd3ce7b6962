use std::collections::BTreeSet;
use std::sync::Arc;

use jiff::ToSpan;
use object_store::memory::InMemory;
use object_store::path::Path as Key;
use tempfile::TempDir;

use super::*;
use crate::domain::{Rig, TokenDraft, TokenRole};
use crate::engine::Loss;
use crate::storage::testing::{TestStore, draft, new_database, now};
use crate::storage::{Checkpoint, Outcome, TokenInsert};

fn quiet() -> Progress {
    Arc::new(|_, _| {})
}

fn settings() -> BucketSettings {
    BucketSettings {
        url: "s3://lab/one".into(),
        endpoint: None,
        region: None,
        virtual_hosted: false,
        cache_bytes: u64::MAX,
    }
}

fn bucket(storage: &Arc<InMemory>) -> Bucket {
    Bucket::of(storage.clone(), Key::from("one"), "s3://lab/one", u64::MAX)
}

/// A PostgreSQL for a test; `None` where the tests have none.
async fn database() -> Option<PostgresSettings> {
    let Ok(server) = std::env::var("RIGCAST_TEST_DATABASE") else {
        println!("skipped: RIGCAST_TEST_DATABASE names no PostgreSQL");
        return None;
    };
    Some(PostgresSettings { url: new_database(&server).await })
}

/// A directory with something in most tables.
async fn filled() -> (TestStore, Rig) {
    let store = TestStore::open_sqlite().await;
    let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
    let run = store.upload(&rig, &[1.0, 2.0]).await.run;
    store.upload(&rig, &[1.0, 2.0]).await;
    store.import_fitted_on(&rig, b"weights", &run).await;
    store.set_active_model(&rig.id, Some(1), "*", now()).await.unwrap();
    store.queue_fit(&rig).await;
    store.queue_fit(&rig).await;
    let done = store.claim_job("w", now() + 30.seconds(), now()).await.unwrap().unwrap().lease;
    store.finish_job(&done, Outcome::Cancelled, now()).await.unwrap();
    let lease = store.claim_job("w", now() + 30.seconds(), now()).await.unwrap().unwrap().lease;
    let checkpoint = Checkpoint { part: "a".into(), fits: "f".into(), state: vec![0, 1, 255].into() };
    store.keep_checkpoint(&lease, &checkpoint, now()).await.unwrap();
    let losses: Vec<Loss> = (0..3000)
        .map(|epoch| Loss { seed: u64::MAX, epoch, training: 0.1 + epoch as f64, stopping: None })
        .collect();
    store.add_losses(&lease, true, &losses).await.unwrap();
    let token = TokenDraft { name: "ü".into(), role: TokenRole::Admin, rigs: None, expires_at: None };
    let secret = crate::domain::Secret::draw().unwrap();
    let made = store.insert_token(&token, secret.digest(), None, now()).await.unwrap();
    assert!(matches!(made, TokenInsert::Inserted(_)));
    (store, rig)
}

#[tokio::test(flavor = "multi_thread")]
async fn a_registry_is_the_same_on_postgresql_and_its_directory_is_no_longer_one() {
    let Some(database) = database().await else { return };
    let storage = Arc::new(InMemory::new());
    let (store, rig) = filled().await;
    let (jobs, models) = (store.jobs(&Default::default(), &Default::default()).await.unwrap(), 1);
    let dir = store.stopped().await;
    let into = async || move_into_opened(dir.path(), &settings(), bucket(&storage), &database, quiet()).await;
    assert_eq!(into().await.unwrap(), Moved { objects: 2 });

    let shared = StoreSettings { bucket: None, database: Some(database.clone()) };
    let own = TempDir::new().unwrap();
    let moved = Store::open_in(own.path(), Some(bucket(&storage)), shared).await.unwrap();
    assert_eq!(moved.jobs(&Default::default(), &Default::default()).await.unwrap(), jobs);
    assert_eq!(moved.active_model(&rig.id).await.unwrap().unwrap().version, Some(models));
    let runs = moved.all_runs(&rig.id).await.unwrap();
    assert_eq!(runs[1].duplicate_of, Some(runs[0].id));
    assert_eq!(moved.load_signal(&runs[0]).await.unwrap().channel(0), [1.0, 2.0]);
    let running = jobs.items.iter().find(|job| job.state == crate::domain::JobState::Running).unwrap();
    assert_eq!(moved.losses(running.id).await.unwrap().len(), 3000);
    assert_eq!(moved.checkpoints(running.id, "f").await.unwrap().len(), 1);
    assert_eq!(moved.token_table().await.unwrap().tokens[0].1.name, "ü");

    // The directory is closed, in words that say where to go.
    let again = into().await.unwrap_err().to_string();
    assert!(again.contains("Start it with that one as --database"), "{again}");
    let opened = Store::open(dir.path()).await.unwrap_err().to_string();
    assert!(opened.contains("name it with --objects"), "{opened}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_move_that_was_cut_short_goes_on_and_another_registry_is_left_alone() {
    let Some(database) = database().await else { return };
    let storage = Arc::new(InMemory::new());
    let (store, _) = filled().await;
    let (other, _) = filled().await;
    let (dir, other) = (store.stopped().await, other.stopped().await);
    let into = async |dir: &TempDir, progress| {
        move_into_opened(dir.path(), &settings(), bucket(&storage), &database, progress).await
    };
    let cut: Progress = Arc::new(|done, _| assert!(done < 2, "cut"));
    let first = dir.path().to_owned();
    let (at, to, kept) = (bucket(&storage), database.clone(), settings());
    let died = std::thread::spawn(move || {
        let runtime = tokio::runtime::Runtime::new().unwrap();
        runtime.block_on(move_into_opened(&first, &kept, at, &to, cut))
    });
    assert!(died.join().is_err());
    assert_eq!(into(&dir, quiet()).await.unwrap(), Moved { objects: 2 });
    // It was cut again just before the directory was told.
    std::fs::remove_file(dir.path().join("bucket.json")).unwrap();
    assert_eq!(into(&dir, quiet()).await.unwrap(), Moved { objects: 2 });
    let refused = into(&other, quiet()).await.unwrap_err().to_string();
    assert!(refused.contains("it has another registry"), "{refused}");
    let marks: BTreeSet<bool> = [&dir, &other].map(|dir| dir.path().join("bucket.json").exists()).into();
    assert_eq!(marks.len(), 2, "the other directory stays as it was");
    Store::open(other.path()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn an_object_that_is_damaged_stops_a_move_by_its_name() {
    let Some(database) = database().await else { return };
    let storage = Arc::new(InMemory::new());
    let (store, rig) = filled().await;
    let object = store.all_runs(&rig.id).await.unwrap()[0].object.clone();
    std::fs::write(store.objects().path_of(&object), b"other").unwrap();
    let dir = store.stopped().await;
    let moved = move_into_opened(dir.path(), &settings(), bucket(&storage), &database, quiet()).await;
    assert!(matches!(moved, Err(StoreError::ObjectDamaged { digest, .. }) if digest == object));
    Store::open(dir.path()).await.unwrap();
}
