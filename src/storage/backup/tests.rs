use std::sync::{Arc, Mutex};
use std::time::Instant;

use crate::storage::testing::{TestStore, draft, now, setting};

use super::*;
use crate::domain::PageRequest;

fn objects_of(directory: &Path) -> BTreeSet<(String, Vec<u8>)> {
    let mut found = BTreeSet::new();
    for folder in std::fs::read_dir(directory.join("objects")).unwrap() {
        for file in std::fs::read_dir(folder.unwrap().path()).unwrap() {
            let path = file.unwrap().path();
            let name = path.file_name().unwrap().to_str().unwrap().to_owned();
            found.insert((name, std::fs::read(path).unwrap()));
        }
    }
    found
}

fn quiet() -> Progress {
    Arc::new(|_, _| {})
}

/// A store with a run and a model, and a directory for backups.
async fn lab() -> (TestStore, tempfile::TempDir) {
    let store = TestStore::open_sqlite().await;
    let rig = store.insert_rig(&draft("bench"), None, now()).await.unwrap().unwrap();
    store.upload(&rig, &[1.0, 2.0]).await;
    store.import(&rig, b"weights").await;
    (store, tempfile::tempdir().unwrap())
}

#[tokio::test]
async fn what_is_restored_is_what_was_backed_up_while_the_service_ran() {
    let (store, dir) = lab().await;
    let rig = store.rig(&"bench".parse().unwrap()).await.unwrap().unwrap();
    let (copy, again) = (dir.path().join("backup"), dir.path().join("again"));
    let manifest =
        backup(Source::DataDir(store.data_dir()), None, &copy, None, now(), quiet()).await.unwrap();
    assert_eq!(manifest.objects, 2);
    // Later additions are not in the backup; later deletions still are.
    store.upload(&rig, &[3.0]).await;
    let run = store.all_runs(&rig.id).await.unwrap().remove(0);
    store.delete_run(&rig.id, run.id).await.unwrap();
    assert_eq!(restore(&copy, &again, quiet()).await.unwrap(), manifest);
    assert_eq!(objects_of(&copy), objects_of(&again));
    let restored = Store::open(&again).await.unwrap();
    let runs = restored.all_runs(&rig.id).await.unwrap();
    assert_eq!((runs.len(), runs[0].id), (1, run.id));
    assert_eq!(restored.load_signal(&run).await.unwrap().channel(0), [1.0, 2.0]);
    let models = restored.models(&rig.id, &PageRequest::default()).await.unwrap().unwrap();
    assert_eq!(restored.weights(&models.items[0]).await.unwrap(), b"weights"[..]);
    restored.insert_rig(&draft("new"), None, now()).await.unwrap().unwrap();
}

#[tokio::test]
async fn a_directory_that_holds_something_is_not_written_to() {
    let (store, dir) = lab().await;
    let copy = dir.path().join("backup");
    backup(Source::DataDir(store.data_dir()), None, &copy, None, now(), quiet()).await.unwrap();
    let refused = backup(Source::DataDir(store.data_dir()), None, &copy, None, now(), quiet())
        .await
        .unwrap_err()
        .to_string();
    assert!(refused.contains("not empty"), "{refused}");
    let refused = restore(&copy, store.data_dir(), quiet()).await.unwrap_err().to_string();
    assert!(refused.contains("not empty"), "{refused}");
    let none = backup(
        Source::DataDir(&dir.path().join("nowhere")),
        None,
        &dir.path().join("b"),
        None,
        now(),
        quiet(),
    )
    .await
    .unwrap_err();
    assert!(none.to_string().contains("nowhere is no data directory: it has no rigcast.db"), "{none}");
    assert!(!dir.path().join("b").exists());
}

#[tokio::test]
async fn a_restore_of_something_else_says_what_it_is_and_makes_nothing() {
    let (store, dir) = lab().await;
    let (file, empty, cut) = (dir.path().join("file"), dir.path().join("empty"), dir.path().join("cut"));
    std::fs::write(&file, b"x").unwrap();
    std::fs::create_dir(&empty).unwrap();
    backup(Source::DataDir(store.data_dir()), None, &cut, None, now(), quiet()).await.unwrap();
    std::fs::remove_file(cut.join(MANIFEST)).unwrap();
    let target = dir.path().join("target");
    for (source, words) in [
        (dir.path().join("nowhere"), "nowhere is no backup: there is nothing of that name"),
        (file, "file is no backup: it is a file"),
        (empty, "empty is no backup: it has no backup.json"),
        (cut, "the backup was cut short"),
        (store.data_dir().to_owned(), "it is a data directory; `rigcast backup`"),
    ] {
        let refused = restore(&source, &target, quiet()).await.unwrap_err().to_string();
        assert!(refused.contains(words), "{refused}");
        assert!(!target.exists());
    }
}

#[tokio::test]
async fn every_flipped_byte_of_a_backup_is_found_and_nothing_is_started_on_it() {
    let (store, dir) = lab().await;
    let copy = dir.path().join("backup");
    backup(Source::DataDir(store.data_dir()), None, &copy, None, now(), quiet()).await.unwrap();
    let object = objects_of(&copy).into_iter().next().unwrap().0;
    let files = [copy.join(DATABASE), copy.join("objects").join(&object[..2]).join(&object)];
    for (i, file) in files.iter().enumerate() {
        let whole = std::fs::read(file).unwrap();
        for at in (0..whole.len()).step_by(whole.len() / 7) {
            let mut flipped = whole.clone();
            flipped[at] ^= 1;
            std::fs::write(file, flipped).unwrap();
            let target = dir.path().join(format!("restored-{i}-{at}"));
            assert!(restore(&copy, &target, quiet()).await.is_err(), "{file:?}, byte {at}");
            assert!(!target.join(DATABASE).exists());
        }
        std::fs::write(file, whole).unwrap();
    }
    std::fs::remove_file(copy.join(MANIFEST)).unwrap();
    let cut = restore(&copy, &dir.path().join("cut"), quiet()).await;
    assert!(cut.is_err(), "a backup that was cut short has no manifest");
}

#[tokio::test]
async fn a_damaged_object_is_named_and_not_backed_up() {
    let (store, dir) = lab().await;
    let (object, _) = objects_of(store.data_dir()).into_iter().next().unwrap();
    let path = store.data_dir().join("objects").join(&object[..2]).join(&object);
    std::fs::write(path, b"other").unwrap();
    let target = dir.path().join("backup");
    let refused = backup(Source::DataDir(store.data_dir()), None, &target, None, now(), quiet())
        .await
        .unwrap_err()
        .to_string();
    assert!(refused.contains(&object), "{refused}");
    assert!(!target.join(MANIFEST).exists());
}

#[tokio::test]
async fn a_later_backup_shares_what_an_earlier_one_has_and_is_whole_without_it() {
    use std::os::unix::fs::MetadataExt;
    let (store, dir) = lab().await;
    let rig = store.rig(&"bench".parse().unwrap()).await.unwrap().unwrap();
    let (first, second) = (dir.path().join("first"), dir.path().join("second"));
    backup(Source::DataDir(store.data_dir()), None, &first, None, now(), quiet()).await.unwrap();
    store.upload(&rig, &[3.0]).await;
    let manifest =
        backup(Source::DataDir(store.data_dir()), None, &second, Some(&first), now(), quiet()).await.unwrap();
    assert_eq!(manifest.objects, 3);
    let links = |directory: &Path| {
        let objects = objects_of(directory);
        let path = |name: &str| directory.join("objects").join(&name[..2]).join(name);
        objects.iter().map(|(name, _)| std::fs::metadata(path(name)).unwrap().nlink()).collect::<Vec<_>>()
    };
    let mut shared = links(&second);
    shared.sort_unstable();
    assert_eq!(shared, [1, 2, 2], "two of three are those of the first");
    std::fs::remove_dir_all(&first).unwrap();
    assert_eq!(restore(&second, &dir.path().join("again"), quiet()).await.unwrap(), manifest);
    let refused =
        backup(Source::DataDir(store.data_dir()), None, &dir.path().join("x"), Some(&first), now(), quiet())
            .await;
    assert!(refused.unwrap_err().to_string().contains("first is no backup"));
}

#[tokio::test]
async fn a_damaged_object_of_an_earlier_backup_is_not_shared() {
    let (store, dir) = lab().await;
    let (first, second) = (dir.path().join("first"), dir.path().join("second"));
    backup(Source::DataDir(store.data_dir()), None, &first, None, now(), quiet()).await.unwrap();
    let (object, _) = objects_of(&first).into_iter().next().unwrap();
    std::fs::write(first.join("objects").join(&object[..2]).join(&object), b"other").unwrap();
    backup(Source::DataDir(store.data_dir()), None, &second, Some(&first), now(), quiet()).await.unwrap();
    assert_eq!(objects_of(&second), objects_of(store.data_dir()));
}

#[tokio::test]
async fn a_backup_and_a_restore_that_were_cut_short_go_on_where_they_were() {
    let (store, dir) = lab().await;
    let (object, bytes) = objects_of(store.data_dir()).into_iter().next().unwrap();
    let path = store.data_dir().join("objects").join(&object[..2]).join(&object);
    let (copy, again) = (dir.path().join("copy"), dir.path().join("again"));
    std::fs::write(&path, b"other").unwrap();
    backup(Source::DataDir(store.data_dir()), None, &copy, None, now(), quiet()).await.unwrap_err();
    std::fs::write(&path, bytes).unwrap();
    std::fs::create_dir_all(copy.join("objects").join("le")).unwrap();
    std::fs::write(copy.join("objects").join("le").join("leftover"), b"half").unwrap();
    let told = Arc::new(Mutex::new(Vec::new()));
    let tell: Progress = {
        let told = Arc::clone(&told);
        Arc::new(move |done, all| told.lock().unwrap().push((done, all)))
    };
    let manifest = backup(Source::DataDir(store.data_dir()), None, &copy, None, now(), tell).await.unwrap();
    let mut told = told.lock().unwrap().clone();
    told.sort_unstable();
    assert_eq!(told, [(1, 2), (2, 2)]);
    assert!(!copy.join(UNFINISHED).exists());
    // A restore that was cut short has no database yet.
    begin(&again).unwrap();
    std::fs::create_dir_all(again.join("objects").join("ab")).unwrap();
    std::fs::write(again.join("objects").join("ab").join("abc"), b"half").unwrap();
    assert_eq!(restore(&copy, &again, quiet()).await.unwrap(), manifest);
    assert_eq!(objects_of(&again), objects_of(&copy));
    Store::open(&again).await.unwrap();
}

/// `RIGCAST_TEST_BACKUP_RUNS=10000 cargo test --lib storage::backup -- --nocapture` says how long many take.
#[tokio::test]
async fn a_backup_of_many_runs_has_every_one_and_the_next_copies_what_is_new_only() {
    let (store, dir) = lab().await;
    let rig = store.rig(&"bench".parse().unwrap()).await.unwrap().unwrap();
    let runs: usize = setting("RIGCAST_TEST_BACKUP_RUNS", 100);
    for k in 0..runs {
        store.upload(&rig, &[k as f64, 0.5]).await;
    }
    let (first, second) = (dir.path().join("first"), dir.path().join("second"));
    let timed = async |copy: &Path, previous: Option<&Path>| {
        let started = Instant::now();
        let source = Source::DataDir(store.data_dir());
        let manifest = backup(source, None, copy, previous, now(), quiet()).await.unwrap();
        (manifest.objects, started.elapsed().as_secs_f64())
    };
    let (objects, whole_s) = timed(&first, None).await;
    store.upload(&rig, &[-1.0]).await;
    let (more, again_s) = timed(&second, Some(&first)).await;
    println!("a backup of {objects} objects: {whole_s:.1} s, of one more than the last has: {again_s:.1} s");
    // The run and the model of the lab are there too.
    assert_eq!((objects as usize, more as usize), (runs + 2, runs + 3));
    assert_eq!(objects_of(&second), objects_of(store.data_dir()));
}
