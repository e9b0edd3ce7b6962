//! Killed services whose files were damaged before the next start.
//!
//! `RIGCAST_TEST_FLIPS=200 cargo test --lib storage::journal` tries more places.

use std::path::Path;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use sqlx::ConnectOptions;
use sqlx::sqlite::SqliteConnectOptions;
use tempfile::TempDir;

use jiff::Timestamp;

use super::*;
use crate::domain::{JobState, PageRequest, RunPatch};
use crate::storage::testing::{TestStore, draft, meta, now, setting};
use crate::storage::{ActiveUpdate, JobQuery};

/// Every journaled row.
type Rows = std::collections::BTreeMap<RowName, entry::Image>;

async fn rows(store: &Store) -> Rows {
    let mut connection = store.sqlite().await;
    let mut all = Rows::new();
    for table in TABLES {
        all.extend(table.rows(&mut connection).await.unwrap());
    }
    all
}

/// A service with some of everything, with changes in its write-ahead log.
async fn service() -> TestStore {
    let store = TestStore::open_sqlite().await;
    let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
    let gone = store.insert_rig(&draft("gone"), None, now()).await.unwrap().unwrap();
    store.upload(&gone, &[9.0]).await;
    for k in 0..6 {
        store.upload(&rig, &[0.1, -2.5, f64::from(k)]).await;
    }
    store.import(&rig, b"weights").await;
    let set = store.set_active_model(&rig.id, Some(1), "*", now()).await.unwrap();
    assert!(matches!(set, ActiveUpdate::Updated(_)));
    let mut tagged = meta();
    tagged.name = "named \u{2028} \"so\"\n".into();
    store.upload_with(&rig, tagged, &[7.0]).await;
    let first = store.all_runs(&rig.id).await.unwrap().remove(0);
    let patch: RunPatch = serde_json::from_value(serde_json::json!({"name": "renamed"})).unwrap();
    store.patch_run(&rig.id, first.id, patch).await.unwrap();
    store.queue_fit(&rig).await;
    store.claim_job("w", now(), now()).await.unwrap().unwrap();
    store.queue_fit(&rig).await;
    assert!(store.delete_rig(&gone.id).await.unwrap());
    store
}

/// The files of a running service as they are at this moment, as a kill leaves them.
fn killed(data_dir: &Path) -> TempDir {
    fn copy(from: &Path, to: &Path) {
        std::fs::create_dir_all(to).unwrap();
        for entry in std::fs::read_dir(from).unwrap() {
            let entry = entry.unwrap();
            let place = to.join(entry.file_name());
            if entry.path().is_dir() {
                copy(&entry.path(), &place);
            } else if entry.file_name() != "lock" {
                std::fs::copy(entry.path(), place).unwrap();
            }
        }
    }
    let dir = tempfile::tempdir().unwrap();
    copy(data_dir, dir.path());
    dir
}

/// Names and bytes of all objects, wherever they are kept.
fn objects(data_dir: &Path) -> std::collections::BTreeMap<String, Vec<u8>> {
    let folders = std::fs::read_dir(data_dir.join("objects")).unwrap().map(|entry| entry.unwrap().path());
    let folders = folders.chain([data_dir.join("quarantine")]).filter(|path| path.is_dir());
    let files = folders.flat_map(|folder| std::fs::read_dir(folder).unwrap());
    files
        .map(|file| {
            let path = file.unwrap().path();
            let name = path.file_name().unwrap().to_str().unwrap().to_owned();
            (name, std::fs::read(path).unwrap())
        })
        .collect()
}

fn places() -> usize {
    setting("RIGCAST_TEST_FLIPS", 12)
}

/// A start on damaged files either has everything or is refused, and then a recovery has everything. Returns whether
/// it was refused.
async fn nothing_is_lost(dir: &Path, wanted: &Rows, what: &str) -> bool {
    let kept = objects(dir);
    let opened = Store::open(dir).await;
    let refused = opened.as_ref().err().map(ToString::to_string);
    let store = match opened {
        Ok(store) => store,
        Err(error) => {
            assert!(error.to_string().contains("rigcast recover"), "{what}: {error}");
            recover(dir, None, now()).await.unwrap_or_else(|error| panic!("{what}: {error}"));
            Store::open(dir).await.unwrap_or_else(|error| panic!("{what}: {error}"))
        }
    };
    let found = rows(&store).await;
    for (name, image) in wanted {
        assert_eq!(found.get(name), Some(image), "{what}, refused: {refused:?}: {name}");
    }
    assert_eq!(found.len(), wanted.len(), "{what}: no row comes back that was deleted");
    let now_kept = objects(dir);
    assert!(kept.iter().all(|(name, bytes)| now_kept.get(name) == Some(bytes)), "{what}: an object is gone");
    for run in store.all_runs(&"bench".parse().unwrap()).await.unwrap() {
        store.load_signal(&run).await.unwrap();
    }
    let another = draft("another");
    store.insert_rig(&another, None, now()).await.unwrap().expect("it goes on");
    store.close().await;
    refused.is_some()
}

#[tokio::test]
async fn a_start_without_the_write_ahead_log_is_refused_and_names_what_is_missing() {
    let service = service().await;
    let wanted = rows(&service).await;
    let dir = killed(service.data_dir());
    std::fs::remove_file(dir.path().join("rigcast.db-wal")).unwrap();
    let refused = Store::open(dir.path()).await.unwrap_err();
    let StoreError::Behind(lacking) = &refused else { panic!("{refused}") };
    assert!(lacking.changes > 10 && lacking.rows.contains("rigs bench"), "{refused}");
    assert!(nothing_is_lost(dir.path(), &wanted, "without the log").await);
    let again = Store::open(dir.path()).await.unwrap();
    let job = again.jobs(&JobQuery::default(), &PageRequest::default()).await.unwrap().items;
    assert!(job.iter().any(|job| job.state == JobState::Running), "{job:?}");
    let queued = again.requeue_expired(Timestamp::MAX, &[], now()).await.unwrap();
    assert_eq!(queued.len(), 1, "a job that ran goes on");
}

#[tokio::test]
async fn a_log_that_is_cut_zeroed_or_flipped_anywhere_loses_nothing() {
    let service = service().await;
    let wanted = rows(&service).await;
    let whole = std::fs::read(service.data_dir().join("rigcast.db-wal")).unwrap();
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let mut refused = 0;
    for k in 0..places() {
        let mut log = whole.clone();
        let at = random.random_range(0..log.len());
        let what = match k % 4 {
            0 => {
                log.truncate(at);
                format!("cut at {at}")
            }
            1 if k == 1 => {
                log.fill(0);
                "zeroed".to_owned()
            }
            _ => {
                log[at] ^= 1 << random.random_range(0..8);
                format!("flipped at {at}")
            }
        };
        let dir = killed(service.data_dir());
        std::fs::write(dir.path().join("rigcast.db-wal"), log).unwrap();
        // Its index would be made anew after a kill.
        let _ = std::fs::remove_file(dir.path().join("rigcast.db-shm"));
        refused += usize::from(nothing_is_lost(dir.path(), &wanted, &what).await);
    }
    assert!(refused > places() / 4, "{refused}: most of these lose changes");
}

#[tokio::test]
async fn a_database_that_is_cut_zeroed_or_flipped_anywhere_loses_nothing() {
    let service = service().await;
    let wanted = rows(&service).await;
    let data_dir = service.data_dir().to_owned();
    service.close().await;
    let whole = std::fs::read(data_dir.join("rigcast.db")).unwrap();
    let mut random = ChaCha8Rng::seed_from_u64(2);
    for k in 0..places() {
        let mut database = whole.clone();
        let at = random.random_range(0..database.len());
        let what = match k % 6 {
            0 => {
                database.truncate(at);
                format!("cut at {at}")
            }
            1 if k == 1 => {
                database.fill(0);
                "zeroed".to_owned()
            }
            _ => {
                database[at] ^= 1 << random.random_range(0..8);
                format!("flipped at {at}")
            }
        };
        let dir = killed(&data_dir);
        std::fs::write(dir.path().join("rigcast.db"), database).unwrap();
        nothing_is_lost(dir.path(), &wanted, &what).await;
    }
    let dir = killed(&data_dir);
    std::fs::remove_file(dir.path().join("rigcast.db")).unwrap();
    assert!(nothing_is_lost(dir.path(), &wanted, "removed").await);
}

#[tokio::test]
async fn a_damaged_journal_is_written_anew_from_a_whole_database() {
    let service = service().await;
    let wanted = rows(&service).await;
    let whole = std::fs::read(path_in(service.data_dir())).unwrap();
    let mut random = ChaCha8Rng::seed_from_u64(3);
    for k in 0..places() {
        let mut journal = whole.clone();
        let at = random.random_range(0..journal.len());
        if k % 3 == 0 {
            journal.truncate(at);
        } else {
            journal[at] ^= 1 << random.random_range(0..8);
        }
        let dir = killed(service.data_dir());
        std::fs::write(path_in(dir.path()), journal).unwrap();
        assert!(!nothing_is_lost(dir.path(), &wanted, &format!("at {at}")).await, "at {at}: refused");
        let contents = file::read(&path_in(dir.path())).unwrap().unwrap();
        assert_eq!(contents.damaged, 0);
    }
}

#[tokio::test]
async fn without_its_journal_a_database_is_refused_until_somebody_says_to_go_on() {
    let service = service().await;
    let wanted = rows(&service).await;
    let dir = killed(service.data_dir());
    std::fs::remove_file(path_in(dir.path())).unwrap();
    let refused = Store::open(dir.path()).await.unwrap_err();
    assert!(matches!(refused, StoreError::JournalMissing { .. }), "{refused}");
    assert!(nothing_is_lost(dir.path(), &wanted, "without the journal").await);
}

#[tokio::test]
async fn a_recovery_that_has_nothing_to_start_from_says_so_and_keeps_the_objects() {
    let service = service().await;
    let dir = killed(service.data_dir());
    let kept = objects(dir.path());
    for name in ["rigcast.db", "rigcast.db-wal", "rigcast.journal"] {
        std::fs::remove_file(dir.path().join(name)).unwrap();
    }
    let refused = Store::open(dir.path()).await.unwrap_err();
    assert!(matches!(refused, StoreError::Damaged { .. }), "{refused}");
    let refused = recover(dir.path(), None, now()).await.unwrap_err();
    assert!(matches!(refused, StoreError::NothingToRecover { .. }), "{refused}");
    assert_eq!(objects(dir.path()), kept);
}

#[tokio::test]
async fn a_recovery_names_the_objects_that_are_gone_and_those_that_nobody_names() {
    let service = service().await;
    let rig = "bench".parse().unwrap();
    let runs = service.all_runs(&rig).await.unwrap();
    let dir = killed(service.data_dir());
    std::fs::remove_file(dir.path().join("rigcast.db")).unwrap();
    let place = |digest: &str| dir.path().join("objects").join(&digest[..2]).join(digest);
    std::fs::remove_file(place(&runs[0].object)).unwrap();
    let orphan = "ab".repeat(32);
    std::fs::create_dir_all(place(&orphan).parent().unwrap()).unwrap();
    std::fs::write(place(&orphan), b"whatever").unwrap();
    let recovered = recover(dir.path(), None, now()).await.unwrap();
    let gone = format!("runs bench/{}", runs[0].id);
    assert!(
        recovered.lost.iter().any(|lost| matches!(lost, Lost::Object { row, .. } if *row == gone)),
        "{recovered:?}"
    );
    assert!(recovered.lost.contains(&Lost::Unknown(orphan)), "{recovered:?}");
    assert!(recovered.kept_in.join("rigcast.journal").exists());
    assert!(recovered.sources.iter().any(|source| source.contains("missing")), "{recovered:?}");
}

#[tokio::test]
async fn a_row_that_is_not_as_it_was_written_is_mended() {
    let service = service().await;
    let wanted = rows(&service).await;
    let dir = killed(service.data_dir());
    let options = SqliteConnectOptions::new().filename(dir.path().join("rigcast.db"));
    let mut connection = options.disable_statement_logging().connect().await.unwrap();
    // Damage does not set triggers off.
    let triggers = check::without_triggers(&mut connection).await.unwrap();
    for damage in [
        "UPDATE runs SET duration_s = duration_s + 1e-9 WHERE rowid = 3",
        "UPDATE runs SET quality = 'nothing' WHERE rowid = 4",
        "UPDATE models SET report = '{}'",
        "UPDATE rigs SET active_version = NULL",
        "DELETE FROM jobs WHERE state = 'queued'",
        "DELETE FROM runs WHERE rowid = 5",
    ] {
        sqlx::query(damage).execute(&mut connection).await.unwrap();
    }
    check::with_triggers(&mut connection, triggers).await.unwrap();
    sqlx::Connection::close(connection).await.unwrap();
    assert!(!nothing_is_lost(dir.path(), &wanted, "damaged rows").await);
}

#[tokio::test]
async fn rows_are_mended_while_the_service_runs_and_writes() {
    let service = service().await;
    let wanted = rows(&service).await;
    assert_eq!(service.mend_rows().await.unwrap(), 0);
    let options = SqliteConnectOptions::new().filename(service.data_dir().join("rigcast.db"));
    let mut other = options.disable_statement_logging().connect().await.unwrap();
    let triggers = check::without_triggers(&mut other).await.unwrap();
    for damage in [
        "UPDATE runs SET duration_s = duration_s + 1e-9 WHERE rowid = 3",
        "UPDATE runs SET quality = 'nothing' WHERE rowid = 4",
        "UPDATE rigs SET name = 'another' WHERE id = 'bench'",
    ] {
        sqlx::query(damage).execute(&mut other).await.unwrap();
    }
    check::with_triggers(&mut other, triggers).await.unwrap();
    let meanwhile = draft("meanwhile");
    let write = service.insert_rig(&meanwhile, None, now());
    let (mended, written) = tokio::join!(service.mend_rows(), write);
    written.unwrap().unwrap();
    assert_eq!(mended.unwrap(), 3);
    let after = rows(&service).await;
    assert!(wanted.iter().all(|(name, row)| after.get(name) == Some(row)), "{after:?}");
    assert_eq!(service.mend_rows().await.unwrap(), 0);
}

#[tokio::test]
async fn a_commit_that_a_crash_kept_from_the_journal_is_taken_over_at_the_start() {
    let service = service().await;
    let journal = std::fs::read(path_in(service.data_dir())).unwrap();
    service.insert_rig(&draft("last"), None, now()).await.unwrap().unwrap();
    let dir = killed(service.data_dir());
    std::fs::write(path_in(dir.path()), journal).unwrap();
    let wanted = rows(&service).await;
    assert!(!nothing_is_lost(dir.path(), &wanted, "one commit ahead").await);
    std::fs::remove_file(dir.path().join("rigcast.db")).unwrap();
    recover(dir.path(), None, now()).await.unwrap();
    let store = Store::open(dir.path()).await.unwrap();
    assert!(store.rig(&"last".parse().unwrap()).await.unwrap().is_some());
}

#[tokio::test]
async fn the_journal_and_the_changes_do_not_grow_for_ever() {
    let store = TestStore::open_sqlite().await;
    let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
    let run = store.upload(&rig, &[1.0]).await.run;
    for k in 0..2 * TRIMMED_EVERY {
        let patch = serde_json::from_value(serde_json::json!({"name": format!("name {k}")})).unwrap();
        store.patch_run(&rig.id, run.id, patch).await.unwrap();
    }
    let left: i64 = sqlx::query_scalar("SELECT count(*) FROM changes")
        .fetch_one(&mut *store.sqlite().await)
        .await
        .unwrap();
    assert!(left < TRIMMED_EVERY, "{left}");
    let before = std::fs::metadata(path_in(store.data_dir())).unwrap().len();
    let store = store.reopened().await;
    let after = std::fs::metadata(path_in(store.data_dir())).unwrap().len();
    assert!(after < before / 100, "{before} to {after} bytes");
    let found = store.run(&rig.id, run.id).await.unwrap().unwrap();
    assert_eq!(found.name, format!("name {}", 2 * TRIMMED_EVERY - 1));
}

#[tokio::test]
async fn an_outline_says_where_the_last_line_of_each_row_is_and_nothing_of_what_is_deleted() {
    let store = TestStore::open_sqlite().await;
    let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
    let (kept, gone) = (store.upload(&rig, &[1.0]).await.run, store.upload(&rig, &[2.0]).await.run);
    let patch = serde_json::from_value(serde_json::json!({"name": "renamed"})).unwrap();
    store.patch_run(&rig.id, kept.id, patch).await.unwrap();
    assert!(store.delete_run(&rig.id, gone.id).await.unwrap());
    let path = path_in(store.data_dir());
    let (outline, whole) = (file::outline(&path).unwrap().unwrap(), file::read(&path).unwrap().unwrap());
    assert_eq!((outline.last, outline.damaged), (whole.last, 0));
    let mut deleted = 0;
    for (name, line) in &whole.rows {
        let Some(image) = &line.row else {
            deleted += 1;
            assert!(!outline.rows.contains_key(name), "{name}");
            continue;
        };
        let found = outline.rows[name].row.unwrap();
        assert_eq!(found.digest, file::Outline::digest_of(image), "{name}");
        assert_eq!(found.read(&path).unwrap(), *image, "{name}");
    }
    assert_eq!((deleted, outline.rows.len() + 1), (1, whole.rows.len()));
}
