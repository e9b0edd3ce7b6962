//! Dependencies point one way (docs/architecture.md): this test reads the sources.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

/// Layers from the bottom up. A module may name itself and those of the layers below. Modules that
/// share a layer do not know each other.
const LAYERS: &[&[&str]] = &[
    &["engine", "telemetry"],
    &["domain"],
    &["formats", "storage", "ui"],
    &["compute"],
    &["models"],
    &["jobs"],
    &["http"],
    &["client", "health"],
    &["config"],
    &["app", "token"],
    &["demo"],
    &["program"],
];

/// Crates that a layer must not use.
const FOREIGN: &[(&str, &[&str])] = &[
    (
        "engine",
        &["sqlx", "axum", "tokio", "object_store", "jiff", "uuid", "futures", "tower", "hyper", "reqwest"],
    ),
    ("domain", &["sqlx", "axum", "tokio", "object_store", "tower", "hyper", "reqwest"]),
    ("formats", &["sqlx", "axum", "tokio", "object_store", "tower", "hyper", "reqwest"]),
    ("storage", &["axum", "tower", "hyper", "reqwest"]),
    (
        "ui",
        &["sqlx", "axum", "tokio", "object_store", "jiff", "uuid", "futures", "tower", "hyper", "reqwest"],
    ),
    ("models", &["sqlx", "axum", "object_store", "tower", "hyper", "reqwest"]),
    ("jobs", &["sqlx", "axum", "object_store", "tower", "hyper", "reqwest"]),
    ("http", &["sqlx", "object_store", "reqwest"]),
];

/// Words that begin an SQL statement; only `storage` may hold them in a string.
const SQL: &[&str] = &["SELECT ", "INSERT INTO ", "UPDATE ", "DELETE FROM ", "PRAGMA "];

fn sources(root: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut directories = vec![root.to_owned()];
    while let Some(directory) = directories.pop() {
        for entry in fs::read_dir(&directory).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                directories.push(path);
            } else if path.extension().is_some_and(|extension| extension == "rs") {
                found.push(path);
            }
        }
    }
    found.sort();
    found
}

/// Text of a source without comments and without its test module, which is at its end.
fn code(path: &Path) -> String {
    let text = fs::read_to_string(path).unwrap();
    let code = text.split("\n#[cfg(test)]\nmod tests {").next().unwrap();
    code.lines().filter(|line| !line.trim_start().starts_with("//")).flat_map(|line| [line, "\n"]).collect()
}

/// Every source below `src` with the top-level module that it belongs to, and its code.
fn modules() -> Vec<(String, PathBuf, String)> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    sources(&root)
        .into_iter()
        .filter(|path| !path.ends_with("tests.rs") && !path.ends_with("testing.rs"))
        .filter(|path| !path.components().any(|part| part.as_os_str() == "tests"))
        .map(|path| {
            let inside = path.strip_prefix(&root).unwrap();
            let first = inside.components().next().unwrap().as_os_str().to_str().unwrap();
            let module = first.trim_end_matches(".rs").to_owned();
            let code = code(&path);
            (module, path, code)
        })
        .collect()
}

/// Top-level modules that the code names: `crate::a`, `crate::{a, b::c}`, `rigcast::a`.
fn named(code: &str) -> BTreeSet<String> {
    let mut names = after(code, "crate::");
    names.append(&mut after(code, "rigcast::"));
    names
}

/// Names after a prefix, in lists too.
fn after(code: &str, prefix: &str) -> BTreeSet<String> {
    let word =
        |text: &str| -> String { text.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect() };
    let mut names = BTreeSet::new();
    for (at, _) in code.match_indices(prefix) {
        let rest = &code[at + prefix.len()..];
        let Some(list) = rest.strip_prefix('{') else {
            names.insert(word(rest));
            continue;
        };
        let mut depth = 0;
        let mut start = true;
        for (i, c) in list.char_indices() {
            match c {
                '{' => depth += 1,
                '}' if depth == 0 => break,
                '}' => depth -= 1,
                ',' if depth == 0 => start = true,
                c if start && depth == 0 && !c.is_whitespace() => {
                    names.insert(word(&list[i..]));
                    start = false;
                }
                _ => {}
            }
        }
    }
    names
}

fn layer(module: &str) -> Option<usize> {
    LAYERS.iter().position(|layer| layer.contains(&module))
}

#[test]
fn no_module_names_one_above_or_beside_it() {
    let mut wrong = Vec::new();
    for (module, path, code) in modules() {
        // The engine is a crate of its own, to which those above it are unknown: the compiler holds that.
        if ["lib", "main", "engine"].contains(&module.as_str()) {
            continue;
        }
        let own = layer(&module).unwrap_or_else(|| panic!("{module} has no layer: add it to LAYERS"));
        for name in named(&code) {
            let above = layer(&name).is_some_and(|other| other >= own);
            if name != module && above {
                wrong.push(format!("{} names {name}", path.display()));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn every_layer_does_without_the_crates_of_others() {
    let mut wrong = Vec::new();
    for (module, path, code) in modules() {
        for crates in FOREIGN.iter().filter(|(layer, _)| *layer == module).map(|(_, crates)| crates) {
            for name in *crates {
                let direct = format!("{name}::");
                let uses = code.match_indices(&direct).any(|(at, _)| {
                    let before = code[..at].chars().next_back();
                    before.is_none_or(|c| !(c.is_alphanumeric() || c == '_' || c == ':'))
                });
                if uses {
                    wrong.push(format!("{} uses {name}", path.display()));
                }
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn every_sql_string_is_in_storage() {
    let mut wrong = Vec::new();
    for (module, path, code) in modules() {
        let holds_sql = SQL.iter().any(|word| code.contains(&format!("\"{word}")));
        if module != "storage" && holds_sql {
            wrong.push(path.display().to_string());
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// Rooms of the diagnosis from the bottom up.
const ROOMS: &[&str] = &[
    "numerics",
    "core",
    "effects",
    "input",
    "report",
    "data",
    "fit",
    "search",
    "screen",
    "augmented",
    "transfer",
    "findings",
    "verdict",
    "views",
    "diagnose",
];

#[test]
fn no_room_of_the_diagnosis_names_one_above_it() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src/engine/diagnosis");
    let rank = |room: &str| ROOMS.iter().position(|name| *name == room);
    let mut wrong = Vec::new();
    for path in sources(&root) {
        let inside: Vec<&str> =
            path.strip_prefix(&root).unwrap().iter().map(|part| part.to_str().unwrap()).collect();
        let room = inside[0].trim_end_matches(".rs");
        if inside == ["mod.rs"] || inside.contains(&"tests") || path.ends_with("tests.rs") {
            continue;
        }
        let own = rank(room).unwrap_or_else(|| panic!("{room} has no rank: add it to ROOMS"));
        let code = code(&path);
        let mut names = after(&code, "crate::diagnosis::");
        // What is above a room's own module, or beside a file of the floor.
        if inside.len() == 1 || inside[1..] == ["mod.rs"] {
            names.append(&mut after(&code, "super::"));
        }
        for name in names.into_iter().filter(|name| name != room) {
            if rank(&name).is_none_or(|other| other > own) {
                wrong.push(format!("{} names {name}", path.display()));
            }
        }
        if code.contains("super::super::") {
            wrong.push(format!("{} leaves its room by super::super", path.display()));
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// Parts of the blind check, and the modules of the service and of the check that each may name.
const BLIND_CHECK: &[(&str, &[&str])] = &[
    ("generate", &["AnyError", "seeds"]),
    ("diagnose", &["AnyError", "client", "demo"]),
    ("score", &["AnyError", "seeds"]),
    ("seeds", &[]),
];

#[test]
fn the_blind_check_makes_cases_apart_from_the_service_and_diagnoses_them_without_their_labels() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/blind_check");
    let mut wrong = Vec::new();
    for (part, allowed) in BLIND_CHECK {
        let (folder, file) = (root.join(part), root.join(format!("{part}.rs")));
        let paths = if file.exists() { vec![file] } else { sources(&folder) };
        assert!(!paths.is_empty(), "{part} is gone");
        for path in paths {
            let code = code(&path);
            let leaves_its_part = path.ends_with("mod.rs") && code.contains("super::");
            let other_way = code.contains("#[path") || code.contains("include!") || leaves_its_part;
            let strangers: Vec<String> =
                named(&code).into_iter().filter(|name| !allowed.contains(&name.as_str())).collect();
            if other_way || !strangers.is_empty() {
                wrong.push(format!("{} names {strangers:?}", path.display()));
            }
            let sees_labels = code.contains("labels") || code.contains("truth");
            if *part == "diagnose" && sees_labels {
                wrong.push(format!("{} knows of labels", path.display()));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn the_population_of_the_decision_and_the_blind_check_share_no_rigs() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples");
    let own: &[&str] = &["drives", "law", "logit", "rig", "AnyError", "engine"];
    for (program, other) in [("fit_decision", "blind_check"), ("blind_check", "fit_decision")] {
        for path in sources(&root.join(program)) {
            let code = code(&path);
            // The documentation of the one may name the other; no path of code may.
            assert!(!code.contains(other), "{} names {other}", path.display());
            if program == "fit_decision" {
                let found = named(&code);
                let stranger = found.iter().find(|name| !own.contains(&name.as_str()));
                assert_eq!(stranger, None, "{}", path.display());
                assert!(!code.contains("#[path") && !code.contains("include!"), "{}", path.display());
            }
        }
    }
}

#[test]
fn the_reader_of_imports_sees_lists_and_paths() {
    let code = "use crate::{engine::{Signal, x}, storage::Store};\nlet a = crate::jobs::fit::check;";
    let found: Vec<String> = named(code).into_iter().collect();
    assert_eq!(found, ["engine", "jobs", "storage"]);
}
