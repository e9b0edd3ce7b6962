//! All final rounds together: shares of every round that says which sources it stands for.

use std::collections::BTreeMap;

use serde_json::{Map, Value, json};

use super::row::{Figure, Row};
use super::statistics::Share;

/// The shares of a round, by suite and figure, for its line in the log.
pub fn shares(rows: &[Row]) -> Map<String, Value> {
    let share = |row: &Row| match row.figure {
        Figure::Share(share) => Some((row.title(), json!([share.of, share.all]))),
        Figure::Number(_) => None,
    };
    rows.iter().filter_map(share).collect()
}

/// Rows of a round with the counts of all rounds in the log; those that no round counted are left out.
pub fn rows(log: &[Value], of_round: &[Row]) -> Vec<Row> {
    let mut all: BTreeMap<&str, Share> = BTreeMap::new();
    for (figure, counts) in log.iter().filter_map(|line| line["shares"].as_object()).flatten() {
        let count = |at: usize| counts[at].as_u64().unwrap_or_default() as usize;
        let pooled = all.entry(figure).or_default();
        *pooled = Share { of: pooled.of + count(0), all: pooled.all + count(1) };
    }
    let pooled = |row: &Row| {
        let share = *all.get(row.title().as_str())?;
        Some(Row { figure: Figure::Share(share), ..row.clone() })
    };
    of_round.iter().filter_map(pooled).collect()
}

/// Numbers of the rounds that are pooled.
pub fn rounds(log: &[Value]) -> Vec<u64> {
    log.iter().filter(|line| line["shares"].is_object()).filter_map(|line| line["round"].as_u64()).collect()
}

#[cfg(test)]
mod tests {
    use super::super::row::Bar;
    use super::*;

    #[test]
    fn a_later_round_is_added_and_replaces_nothing() {
        let row = |of, all| Row::share("in-situ", "right", Share { of, all }, Bar::AtLeast(0.9));
        let time = Row::number("time", "a case, s", Some(1.0), Bar::None);
        let line = |round: u64, of, all| json!({"event": "scored", "round": round, "shares": shares(&[row(of, all), time.clone()])});
        let older = json!({"event": "scored", "round": 0, "figures": {"in-situ: right": "100.0 % (4 of 4)"}});
        let log = [older, line(1, 5, 10), line(2, 10, 10)];
        let pooled = rows(&log, &[row(10, 10), time]);
        assert_eq!(pooled.len(), 1);
        assert!(matches!(pooled[0].figure, Figure::Share(Share { of: 15, all: 20 })));
        assert_eq!(pooled[0].passes(), Some(false));
        assert_eq!(rounds(&log), [1, 2]);
    }
}
