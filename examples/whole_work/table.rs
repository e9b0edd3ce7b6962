//! The figures beside the aims.

use comfy_table::Table;
use comfy_table::presets::UTF8_FULL_CONDENSED;

use crate::lab::Done;

/// Channels of the rigs, squared, as a ratio: no stage of the large rig may take longer than so many times.
const SQUARES: f64 = (64.0 / 9.0) * (64.0 / 9.0);

/// All stages, the large rig's beside those of the small one, and the aims.
pub fn print(done: &[Done]) {
    let mut table = Table::new();
    table.load_style(UTF8_FULL_CONDENSED);
    table.set_header(["rig", "stage", "s", "MiB", "CPU s", "of peak", "times demo"]);
    let same = |stage: &str| done.iter().find(|d| d.rig == "demo" && d.stage == stage);
    for d in done {
        let times =
            same(d.stage).filter(|_| d.rig != "demo").map(|small| d.cost.seconds / small.cost.seconds);
        table.add_row([
            d.rig.to_owned(),
            d.stage.to_owned(),
            format!("{:.2}", d.cost.seconds),
            format!("{:.0}", d.cost.resident_mib),
            format!("{:.1}", d.cost.cpu_s),
            d.share.map_or_else(String::new, |share| format!("{share:.2}")),
            times.map_or_else(String::new, |times| format!("{times:.1}")),
        ]);
    }
    println!("{table}");
    let mut aims = Table::new();
    aims.load_style(UTF8_FULL_CONDENSED);
    aims.set_header(["aim", "limit", "found", ""]);
    let seconds =
        |stages: &[&str]| -> Option<f64> { stages.iter().map(|s| Some(same(s)?.cost.seconds)).sum() };
    let counted = |stage: &str, what: &str| same(stage)?.counted[what].as_f64();
    for (aim, limit, found) in [
        ("noise uploaded to hybrid 2 active, s", 60.0, seconds(&["upload", "hybrid2", "activate"])),
        ("one iteration of a 60 s drive, ms", 50.0, counted("iterate", "ms_per_iteration")),
        ("diagnosis, s", 60.0, seconds(&["diagnose"])),
    ] {
        let found_text = found.map_or_else(|| "-".to_owned(), |found| format!("{found:.1}"));
        let verdict = found.map_or("not run", |found| if found <= limit { "met" } else { "MISSED" });
        aims.add_row([aim.to_owned(), format!("{limit}"), found_text, verdict.to_owned()]);
    }
    let growth = done.iter().filter(|d| d.rig != "demo").filter_map(|d| {
        Some((
            d.stage,
            d.cost.seconds / same(d.stage).filter(|small| small.cost.seconds > 0.05)?.cost.seconds,
        ))
    });
    if let Some((stage, most)) = growth.max_by(|a, b| a.1.total_cmp(&b.1)) {
        let verdict = if most <= SQUARES { "met" } else { "MISSED" };
        let aim = format!("large rig: times the demo's, at most ({stage})");
        aims.add_row([aim, format!("{SQUARES:.1}"), format!("{most:.1}"), verdict.to_owned()]);
    }
    println!("{aims}");
}
