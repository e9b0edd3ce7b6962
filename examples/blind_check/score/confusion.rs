//! The confusion matrix: the verdicts for each true effect, without zeros.

use std::collections::BTreeMap;

use comfy_table::Table;
use comfy_table::presets::UTF8_FULL_CONDENSED;

use super::case::Case;

/// One line per suite and true effect, with its verdicts, the most frequent first.
pub fn table(cases: &[Case]) -> Table {
    let mut counts: BTreeMap<(&str, String), BTreeMap<String, usize>> = BTreeMap::new();
    for case in cases {
        let names: Vec<&str> = case.effects().filter_map(|e| e["effect"].as_str()).collect();
        let stated = counts.entry((&case.suite, names.join(" + "))).or_default();
        *stated.entry(case.stated()).or_default() += 1;
    }
    let mut table = Table::new();
    table.load_style(UTF8_FULL_CONDENSED);
    table.set_header(["suite", "true effect", "cases", "stated"]);
    for ((suite, truth), stated) in counts {
        let mut stated: Vec<(String, usize)> = stated.into_iter().collect();
        stated.sort_by_key(|(_, count)| std::cmp::Reverse(*count));
        let total: usize = stated.iter().map(|s| s.1).sum();
        let words: Vec<String> = stated.iter().map(|(word, count)| format!("{word} {count}")).collect();
        table.add_row([suite.to_owned(), truth, total.to_string(), words.join(", ")]);
    }
    table
}
