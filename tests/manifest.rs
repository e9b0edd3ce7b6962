//! The manifest and the files that are read before the compiler is: what the container's build stage has, and what
//! the dependencies are for.

use std::collections::BTreeSet;
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;

#[expect(dead_code, reason = "the parts that only a build calls")]
#[path = "../build.rs"]
mod build;

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn read(name: &str) -> String {
    fs::read_to_string(root().join(name)).unwrap_or_else(|error| panic!("{name}: {error}"))
}

fn files(directory: &Path, found: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(directory).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() { files(&path, found) } else { found.push(path) }
    }
}

/// Instructions of a Dockerfile in their order: the word and the rest of the line, continuations joined.
fn instructions(dockerfile: &str) -> Vec<(String, String)> {
    let joined: String = dockerfile
        .lines()
        .filter(|line| !line.trim_start().starts_with('#'))
        .map(|line| line.strip_suffix('\\').map_or_else(|| format!("{line}\n"), |line| format!("{line} ")))
        .collect();
    let lines = joined.lines().filter_map(|line| line.trim().split_once(char::is_whitespace));
    lines.map(|(word, rest)| (word.to_uppercase(), rest.trim().to_owned())).collect()
}

/// Whether the build context has a file: the last pattern of `.dockerignore` that names it or a folder above it
/// decides.
fn in_context(ignore: &str, path: &str) -> bool {
    let mut kept = true;
    for pattern in ignore.lines().map(str::trim).filter(|line| !line.is_empty() && !line.starts_with('#')) {
        let (keeps, pattern) = pattern.strip_prefix('!').map_or((false, pattern), |rest| (true, rest));
        let pattern = pattern.trim_matches('/');
        assert!(pattern == "*" || !pattern.contains(['*', '?', '[']), "{pattern:?} is not understood here");
        if pattern == "*" || path == pattern || path.starts_with(&format!("{pattern}/")) {
            kept = keeps;
        }
    }
    kept
}

/// The working directory of a container's build stage.
struct Stage {
    directory: tempfile::TempDir,
    ignore: String,
}

impl Stage {
    fn path(&self, name: &str) -> PathBuf {
        self.directory.path().join(name)
    }

    /// `COPY` of files and folders of the context.
    fn copy(&self, arguments: &str) {
        let words: Vec<&str> = arguments.split_whitespace().collect();
        let (target, sources) = words.split_last().unwrap();
        for source in sources {
            let from = root().join(source);
            let mut found = vec![from.clone()];
            if from.is_dir() {
                found.clear();
                files(&from, &mut found);
            }
            for file in found {
                let name = file.strip_prefix(root()).unwrap().to_str().unwrap();
                if name.starts_with("target/") || name.starts_with(".git") || !in_context(&self.ignore, name)
                {
                    continue;
                }
                let place = match *target {
                    "." | "./" => self.path(name),
                    folder if from.is_dir() => self.path(folder).join(file.strip_prefix(&from).unwrap()),
                    file => self.path(file),
                };
                fs::create_dir_all(place.parent().unwrap()).unwrap();
                fs::copy(&file, place).unwrap();
            }
        }
    }

    /// `RUN`, with a cargo that reads the manifest as every build does first, and compiles nothing.
    fn run(&self, command: &str) {
        let tools = self.path(".tools");
        fs::create_dir_all(&tools).unwrap();
        let cargo = tools.join("cargo");
        let real = env!("CARGO");
        let script = format!(
            "#!/bin/sh\n[ \"$1\" = build ] || exit 9\nexec {real} metadata --offline --locked --no-deps --format-version 1\n"
        );
        fs::write(&cargo, script).unwrap();
        fs::set_permissions(&cargo, fs::Permissions::from_mode(0o755)).unwrap();
        let path = format!("{}:{}", tools.display(), std::env::var("PATH").unwrap_or_default());
        let run = Command::new("sh")
            .args(["-e", "-c", command])
            .current_dir(self.directory.path())
            .env("PATH", path)
            .output()
            .expect("a shell");
        assert!(run.status.success(), "RUN {command}\n{}", String::from_utf8_lossy(&run.stderr));
    }
}

/// How the part of a source begins that is compiled for tests alone.
const TESTS: &str = "\n#[cfg(test)]\nmod tests {";

/// Files outside `src` that the sources take in when they are compiled.
fn taken_in() -> BTreeSet<String> {
    let mut sources = Vec::new();
    files(&root().join("src"), &mut sources);
    let mut found = BTreeSet::new();
    for source in sources.iter().filter(|path| path.extension().is_some_and(|e| e == "rs")) {
        let text = fs::read_to_string(source).unwrap();
        // The image is not tested.
        let text = text.split(TESTS).next().unwrap();
        for word in ["include_str!(\"", "include_bytes!(\""] {
            for (at, _) in text.match_indices(word) {
                let name = text[at + word.len()..].split('"').next().unwrap();
                let file = source.parent().unwrap().join(name).canonicalize().expect("it is there");
                found
                    .insert(file.strip_prefix(root().canonicalize().unwrap()).unwrap().display().to_string());
            }
        }
    }
    found
}

#[test]
fn the_images_build_stage_has_every_file_that_cargo_and_the_compiler_ask_for() {
    let dockerfile = instructions(&read("Dockerfile"));
    let first = dockerfile.iter().position(|(word, _)| word == "FROM").expect("a stage");
    let steps = dockerfile[first + 1..].iter().take_while(|(word, _)| word != "FROM");
    let stage = Stage { directory: tempfile::tempdir().unwrap(), ignore: read(".dockerignore") };
    let mut builds = 0;
    for (word, rest) in steps {
        match word.as_str() {
            "COPY" => stage.copy(rest),
            "RUN" => {
                builds += rest.matches("cargo build").count();
                stage.run(rest);
            }
            "WORKDIR" | "ARG" => {}
            other => panic!("{other} is not understood here"),
        }
    }
    assert_eq!(builds, 2, "the dependencies, then the program");
    assert!(fs::metadata(stage.path("src/main.rs")).unwrap().len() > 100, "the program replaces its stub");
    let mut expected = taken_in();
    assert!(expected.contains("openapi.yaml") && expected.len() > 5, "{expected:?}");
    expected.extend(["src/main.rs", "src/lib.rs", "Cargo.lock", "build.rs"].map(String::from));
    for name in expected {
        let (ours, theirs) = (root().join(&name), stage.path(&name));
        assert!(
            fs::read(ours).ok() == fs::read(theirs).ok(),
            "{name} is not in the image's build stage as it is here"
        );
    }
}

#[test]
fn the_image_has_the_pinned_toolchain_and_asks_the_program_itself_for_its_health() {
    let dockerfile = instructions(&read("Dockerfile"));
    let channel = read("rust-toolchain.toml");
    let channel =
        channel.split("channel = \"").nth(1).and_then(|rest| rest.split('"').next()).expect("a channel");
    let image = &dockerfile.iter().find(|(word, _)| word == "FROM").expect("a stage").1;
    let tag =
        image.strip_prefix("rust:").and_then(|rest| rest.split('-').next()).expect("rust:<version>-...");
    assert!(
        channel == tag || channel.starts_with(&format!("{tag}.")),
        "{image}, but the toolchain is {channel}"
    );
    let check = &dockerfile.iter().find(|(word, _)| word == "HEALTHCHECK").expect("HEALTHCHECK").1;
    assert!(check.ends_with(r#"CMD ["rigcast", "health"]"#), "{check}");
}

#[test]
fn a_later_pattern_of_the_ignored_takes_back_an_earlier_one() {
    let ignore = "*\n!src\n/src/secret\n";
    let kept = |path| in_context(ignore, path);
    assert_eq!([kept("src/main.rs"), kept("docs/a.md"), kept("src/secret/x")], [true, false, false]);
}

/// Runs git in a directory without anybody's own settings.
fn git(directory: &Path, arguments: &[&str]) {
    let run = Command::new("git")
        .current_dir(directory)
        .args(["-c", "user.name=test", "-c", "user.email=test@example.org", "-c", "commit.gpgsign=false"])
        .args(arguments)
        .env("GIT_CONFIG_GLOBAL", "/dev/null")
        .output()
        .expect("git");
    assert!(run.status.success(), "git {arguments:?}: {}", String::from_utf8_lossy(&run.stderr));
}

#[test]
fn a_version_names_its_commit_and_says_if_the_sources_differ_from_it() {
    let directory = tempfile::tempdir().unwrap();
    let root = directory.path();
    if Command::new("git").arg("--version").output().is_err() {
        println!("skipped: there is no git");
        return;
    }
    assert_eq!(build::commit(root), None, "no repository");
    git(root, &["init", "--quiet"]);
    assert_eq!(build::commit(root), None, "no commit");
    fs::create_dir(root.join("src")).unwrap();
    fs::write(root.join("src/main.rs"), "fn main() {}").unwrap();
    git(root, &["add", "."]);
    git(root, &["commit", "--quiet", "--message", "Begin"]);
    let commit = build::commit(root).expect("a commit");
    assert!(commit.len() == 12 && commit.bytes().all(|b| b.is_ascii_hexdigit()), "{commit}");
    fs::write(root.join("notes"), "no source").unwrap();
    assert_eq!(build::commit(root).as_ref(), Some(&commit));
    fs::write(root.join("src/lib.rs"), "").unwrap();
    assert_eq!(build::commit(root), Some(format!("{commit}-dirty")));
    assert_eq!(build::commit(&root.join("src")), None, "a folder of another project's repository");
    let watched = build::watched(root);
    assert!(watched.iter().any(|path| path.ends_with(".git/HEAD")), "{watched:?}");
    assert!(watched.iter().all(|path| path.exists()), "{watched:?}");
}

#[test]
fn a_commit_that_was_given_is_taken_if_it_fits_into_a_version() {
    assert_eq!(build::named("f8d4022").as_deref(), Some("f8d4022"));
    for other in ["", "a b", "a+b", "\u{f6}"] {
        assert_eq!(build::named(other), None, "{other:?}");
    }
}

/// Names under a heading of the manifest, one dependency a line, without crates of this repository.
fn dependencies(manifest: &str, heading: &str) -> Vec<String> {
    let lines = manifest.lines().skip_while(|line| line.trim() != heading).skip(1);
    let lines = lines.take_while(|line| !line.starts_with('[')).filter(|line| !line.contains("path = "));
    lines.filter_map(|line| line.split_once('=')).map(|(name, _)| name.trim().to_owned()).collect()
}

/// The engine's folder: a crate of its own inside `src`.
const ENGINE: &str = "src/engine";

/// Code of the sources below some folders, without comments; with the tests among it or without. The engine's code
/// is the code of its own folder only.
fn code(folders: &[&str], with_tests: bool) -> String {
    let mut all = String::new();
    for folder in folders {
        let mut sources = Vec::new();
        files(&root().join(folder), &mut sources);
        sources.retain(|path| path.extension().is_some_and(|extension| extension == "rs"));
        if *folder != ENGINE {
            sources.retain(|path| !path.starts_with(root().join(ENGINE)));
        }
        if !with_tests {
            sources.retain(|path| {
                let of_tests =
                    |part: &std::ffi::OsStr| ["tests", "tests.rs", "testing.rs"].iter().any(|t| part == *t);
                !path.components().any(|part| of_tests(part.as_os_str()))
            });
        }
        for source in sources {
            let text = fs::read_to_string(source).unwrap();
            let end = if with_tests { None } else { text.find(TESTS) };
            let lines = text[..end.unwrap_or(text.len())].lines();
            all.extend(
                lines.filter(|line| !line.trim_start().starts_with("//")).flat_map(|line| [line, "\n"]),
            );
        }
    }
    all
}

/// Whether the code names a crate: `name::`, with nothing before it that would make it a part of another name.
fn names(code: &str, dependency: &str) -> bool {
    let wanted = format!("{}::", dependency.replace('-', "_"));
    code.match_indices(&wanted).any(|(at, _)| {
        let before = code[..at].chars().next_back();
        before.is_none_or(|c| !(c.is_alphanumeric() || c == '_' || c == ':'))
    })
}

/// A manifest, the folder of its program, and the folders of its tests.
type Package = (&'static str, &'static str, &'static [&'static str]);

const PACKAGES: [Package; 2] = [
    ("Cargo.toml", "src", &["src", "tests", "examples", "benches"]),
    ("src/engine/Cargo.toml", ENGINE, &[ENGINE]),
];

#[test]
fn every_dependency_is_used_where_the_manifest_says_so() {
    for (name, program, tests) in PACKAGES {
        let manifest = read(name);
        let (program, tests) = (code(&[program], false), code(tests, true));
        let (needed, for_tests) =
            (dependencies(&manifest, "[dependencies]"), dependencies(&manifest, "[dev-dependencies]"));
        assert!(needed.len() > 10 && for_tests.len() > 1, "{needed:?} {for_tests:?}");
        let unused: Vec<&String> = needed.iter().filter(|name| !names(&program, name)).collect();
        assert!(
            unused.is_empty(),
            "{name}: the program does not use {unused:?}: remove them, or move them to dev-dependencies"
        );
        let unused: Vec<&String> = for_tests.iter().filter(|name| !names(&tests, name)).collect();
        assert!(unused.is_empty(), "{name}: no test, example or bench uses {unused:?}");
    }
}

#[test]
fn a_crate_is_named_by_its_path_and_by_nothing_else() {
    for (code, found) in [
        ("use csv_core::Reader;", true),
        ("let a = ::csv_core::x();", false),
        ("use my_csv_core::Reader;", false),
        ("use formats::csv_core::Reader;", false),
        ("// csv_core", false),
    ] {
        assert_eq!(names(code, "csv-core"), found, "{code}");
    }
    let manifest = "[a]\nx = \"1\"\n[dependencies]\no = { path = \"o\" }\ny = \"1\"\nz-z = { version = \"2\" }\n\n[b]\nw = 1\n";
    assert_eq!(dependencies(manifest, "[dependencies]"), ["y", "z-z"]);
}
