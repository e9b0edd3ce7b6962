//! A table of measured and published figures.

use comfy_table::Table;
use comfy_table::presets::UTF8_FULL_CONDENSED;

use super::dataset::Dataset;
use crate::Score;

/// One scored model: kind, whether it was chosen on validation data, test file, score.
pub type Row = (String, bool, String, Score);

/// A table with one line per model and one column per test file (or output), published figures below.
pub fn compare(data: &Dataset, rows: &[Row]) -> Table {
    let mut table = Table::new();
    table.load_style(UTF8_FULL_CONDENSED);
    let mut files: Vec<&str> = Vec::new();
    let mut kinds: Vec<(&str, bool)> = Vec::new();
    for (kind, chosen, file, _) in rows {
        if !files.contains(&file.as_str()) {
            files.push(file);
        }
        if !kinds.iter().any(|(k, _)| k == kind) {
            kinds.push((kind, *chosen));
        }
    }
    let scores = |kind: &str| -> Vec<f64> {
        let of_kind = rows.iter().filter(|r| r.0 == kind);
        of_kind.flat_map(|r| if r.3.rmse.len() == 1 { r.3.rmse.clone() } else { r.3.nrmse.clone() }).collect()
    };
    let outputs = rows.first().map_or(0, |r| r.3.rmse.len());
    let unit = rows.first().map_or("", |r| r.3.unit.as_str());
    let mut header = vec!["model".to_string()];
    if outputs == 1 {
        header.extend(files.iter().map(|file| format!("{file}, RMSE {unit}")));
    } else {
        header.extend(
            files.iter().flat_map(|file| (1..=outputs).map(move |o| format!("{file}, NRMSE output {o}"))),
        );
    }
    table.set_header(header);
    for (kind, chosen) in kinds {
        let name = if chosen { format!("{kind} (chosen)") } else { kind.to_string() };
        table.add_row([vec![name], scores(kind).iter().map(|v| format!("{v:.4}")).collect()].concat());
    }
    let (columns, published) = data.published();
    for (method, values) in published {
        let cell = |file: &&str| {
            let value = columns.iter().position(|c| c == file).and_then(|i| values.get(i).copied().flatten());
            value.map_or("-".into(), |v| v.to_string())
        };
        table.add_row([vec![format!("published: {method}")], files.iter().map(cell).collect()].concat());
    }
    let nrmse = data.published_nrmse();
    if nrmse.len() == outputs && outputs > 1 {
        let name = vec!["published: FRF, on its own training run".to_string()];
        table.add_row([name, nrmse.iter().map(f64::to_string).collect()].concat());
    }
    table
}
