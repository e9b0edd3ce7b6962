//! The recipes for Python are run as they stand, one block after the other.

use super::pages::Page;
use super::shell::ADDRESS;
use crate::foreign_readers::python;
use crate::support::TestApp;

#[test]
fn the_recipes_for_python_work_as_they_stand() {
    let Some(mut python) = python() else { return };
    let app = TestApp::start();
    let blocks = Page::read("docs/clients.md").blocks();
    let program: String =
        blocks.iter().filter(|block| block.language == "python").map(|block| block.code.as_str()).collect();
    assert!(program.contains("iter_parts"), "the recipes are there");
    let program = program.replace(ADDRESS, &format!("http://{}", app.address()));
    let output = python.arg("-c").arg(&program).output().expect("Python runs");
    let (out, err) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{out}\n{err}");
    let lines: Vec<&str> = out.lines().collect();
    let [warnings, response, candidates @ ..] = &lines[..] else { panic!("{out}") };
    assert!(warnings.starts_with('['), "{out}");
    let fields: Vec<&str> = response.split(' ').collect();
    let [channels, inside, off] = fields[..] else { panic!("{out}") };
    assert_eq!((channels, inside), ("disp", "1"));
    assert!(off.parse::<f64>().is_ok_and(|off| off < 0.05), "{out}");
    let inside: Vec<f64> = candidates
        .iter()
        .map(|line| line.split(' ').next().and_then(|share| share.parse().ok()).expect("a share"))
        .collect();
    // The third candidate leaves the range of the training.
    assert!(inside.len() == 3 && inside[0] == 1.0 && inside[2] < 0.9, "{out}");
}
