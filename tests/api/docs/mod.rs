//! The README and the pages under `docs/`: their blocks are run, their links lead somewhere.

mod pages;
mod python;
mod sessions;
mod shell;

use std::collections::BTreeSet;
use std::process::Stdio;

use sessions::SESSIONS;

use crate::support::rigcast;

/// Languages of blocks. `sh` is run, as is the `python` of `docs/clients.md`; `console` would be run on another machine or for too long; `text` is no command.
const LANGUAGES: &[&str] = &["sh", "console", "text", "json", "python", "matlab"];

#[test]
fn each_runnable_block_of_each_page_belongs_to_a_session() {
    let mut found = BTreeSet::new();
    for page in pages::all() {
        for block in page.blocks() {
            let (name, section, language) = (&page.name, block.section, block.language);
            assert!(
                LANGUAGES.contains(&language.as_str()),
                "{name}, {section}: language of a block '{language}'"
            );
            if language == "sh" {
                found.insert((name.clone(), section));
            }
        }
    }
    let run: BTreeSet<_> =
        SESSIONS.iter().map(|(page, section)| ((*page).to_owned(), (*section).to_owned())).collect();
    assert_eq!(found, run, "sections with sh blocks; sections that a session runs");
    assert_eq!(run.len(), SESSIONS.len(), "a section is run twice");
}

#[test]
fn each_relative_link_of_each_page_leads_to_a_file() {
    let mut checked = 0;
    for page in pages::all() {
        let at = pages::root().join(&page.name);
        for link in page.links() {
            let target = at.parent().expect("a folder").join(&link);
            assert!(target.exists(), "{}: {link} is missing", page.name);
            checked += 1;
        }
    }
    assert!(checked >= 10, "only {checked} links were found");
}

#[test]
fn the_readme_is_short_and_names_every_page() {
    let pages = pages::all();
    let readme = pages.iter().find(|page| page.name == "README.md").expect("the README");
    let lines = readme.text.lines().count();
    assert!(lines <= 150, "README.md has {lines} lines");
    let links = readme.links();
    for page in pages.iter().filter(|page| page.name != "README.md") {
        assert!(links.contains(&page.name), "README.md does not link to {}", page.name);
    }
}

#[test]
fn the_systemd_unit_sets_what_the_program_knows() {
    let unit = std::fs::read_to_string(pages::root().join("docs/rigcast.service")).expect("the unit");
    let settings: Vec<(&str, &str)> = unit.lines().filter_map(|line| line.split_once('=')).collect();
    let all =
        |key: &'static str| settings.iter().filter(move |(name, _)| *name == key).map(|(_, value)| *value);
    let help = rigcast(&["serve", "--help"]).stdout(Stdio::piped()).output().expect("the program runs");
    let help = String::from_utf8(help.stdout).expect("UTF-8");
    let variables = all("Environment").chain(all("#Environment")).filter_map(|pair| pair.split('=').next());
    let variables: Vec<&str> = variables.collect();
    assert!(variables.len() >= 4, "{variables:?}");
    for name in variables {
        assert!(help.contains(&format!("[env: {name}=")), "serve does not know {name}");
    }
    assert_eq!(all("KillSignal").collect::<Vec<_>>(), ["SIGTERM"]);
    let stop: u64 = all("TimeoutStopSec").next().and_then(|s| s.parse().ok()).expect("seconds");
    assert!(stop > 30, "a stop may take 30 s");
    assert!(all("ExecStart").next().is_some_and(|command| command.ends_with("rigcast serve")));
}
