//! The README and the pages under `docs/`, read into sections and blocks.

use std::path::{Path, PathBuf};

/// A page of the documentation.
pub struct Page {
    /// Path from the top of the tree, `docs/fits.md`.
    pub name: String,
    pub text: String,
}

/// A fenced block of a page.
#[derive(Debug)]
pub struct Block {
    /// The level-two heading that it stands under.
    pub section: String,
    /// The word after the fence.
    pub language: String,
    pub code: String,
}

/// The top of the tree.
pub fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).to_owned()
}

/// Every page, by name.
pub fn all() -> Vec<Page> {
    let docs = std::fs::read_dir(root().join("docs")).expect("docs/ is there");
    let names = docs.map(|entry| entry.expect("an entry").file_name().into_string().expect("UTF-8"));
    let mut names: Vec<String> =
        names.filter(|name| name.ends_with(".md")).map(|name| format!("docs/{name}")).collect();
    names.push("README.md".to_owned());
    names.sort();
    names.into_iter().map(|name| Page::read(&name)).collect()
}

impl Page {
    /// Reads one page.
    pub fn read(name: &str) -> Self {
        let text = std::fs::read_to_string(root().join(name)).expect(name);
        Self { name: name.to_owned(), text }
    }

    /// Its fenced blocks in their order.
    pub fn blocks(&self) -> Vec<Block> {
        let mut blocks = Vec::new();
        let mut section = String::new();
        let mut open: Option<Block> = None;
        for line in self.text.lines() {
            match (line.strip_prefix("```"), &mut open) {
                (Some(language), None) => {
                    let language = language.to_owned();
                    open = Some(Block { section: section.clone(), language, code: String::new() });
                }
                (Some(_), Some(_)) => blocks.extend(open.take()),
                (None, Some(block)) => block.code.extend([line, "\n"]),
                (None, None) => {
                    if let Some(heading) = line.strip_prefix("## ") {
                        heading.clone_into(&mut section);
                    }
                }
            }
        }
        assert!(open.is_none(), "{}: a block without an end", self.name);
        blocks
    }

    /// The relative links and pictures outside of blocks, without their anchors.
    pub fn links(&self) -> Vec<String> {
        let mut links = Vec::new();
        let mut in_block = false;
        for line in self.text.lines() {
            in_block ^= line.starts_with("```");
            let targets = line.split("](").skip(1).filter_map(|rest| rest.split(')').next());
            let targets = targets.filter(|target| !in_block && !target.contains("://"));
            links.extend(targets.filter_map(|target| target.split('#').next()).map(str::to_owned));
        }
        links.retain(|link| !link.is_empty());
        links
    }
}
