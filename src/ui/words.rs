//! Times, lengths and states in the form in which people write them; terms explained in one line.

use std::fmt::Display;

use maud::{Markup, html};
use serde::Serialize;

use super::text::{cut_to, number};
use crate::domain::JobState;

/// Longest word of a sentence; no word of ours is as long.
const LONGEST_WORD: usize = 60;

/// A length of time.
pub(super) fn duration(s: f64) -> String {
    match s {
        s if !s.is_finite() || s < 0.0 => "not known".into(),
        s if s < 1.0 => format!("{} ms", number(1e3 * s)),
        s if s < 120.0 => format!("{} s", number(s)),
        s if s < 7200.0 => format!("{} min", number(s / 60.0)),
        s => format!("{} h", number(s / 3600.0)),
    }
}

/// A number of bytes.
pub(super) fn bytes(n: u64) -> String {
    let n = n as f64;
    match n {
        n if n < 1e3 => format!("{n} bytes"),
        n if n < 1e6 => format!("{} kB", number(n / 1e3)),
        n if n < 1e9 => format!("{} MB", number(n / 1e6)),
        n => format!("{} GB", number(n / 1e9)),
    }
}

/// A count with its noun.
pub(super) fn count(n: usize, one: &str, many: &str) -> String {
    if n == 1 { format!("1 {one}") } else { format!("{n} {many}") }
}

/// The contract's word for a value.
pub(super) fn word(value: impl Serialize) -> String {
    let word = serde_json::to_value(value).ok().and_then(|value| Some(value.as_str()?.to_owned()));
    word.unwrap_or_default().replace('_', " ")
}

/// A time, to the minute.
pub(super) fn minute(at: &impl Display) -> String {
    // RFC 3339: the date, a T, the time to fractions of a second.
    let text = at.to_string();
    text.get(..16).unwrap_or(&text).replace('T', " ")
}

/// The state of a job as a label.
pub(super) fn state(state: JobState) -> Markup {
    let class = match state {
        JobState::Queued | JobState::Running => "tag busy",
        JobState::Succeeded => "tag good",
        JobState::Failed => "tag bad",
        JobState::Cancelled => "tag",
    };
    html! { span class=(class) data-live="state" { (state.as_str()) } }
}

/// A name that somebody gave, on one line. The style sheet cuts it where it is long; its title has the whole of it.
pub(super) fn clamped(name: &str) -> Markup {
    html! { bdi.clamp title=(name) { (name) } }
}

/// A sentence with names in it: long words are cut, and its title has the whole of it. Characters that would turn the
/// direction of the rest of the sentence are left out.
pub(super) fn sentence(text: &str) -> Markup {
    let turns = |c: char| matches!(c, '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}');
    let shown: Vec<String> =
        text.replace(turns, "").split(' ').map(|word| cut_to(word, LONGEST_WORD)).collect();
    let shown = shown.join(" ");
    html! { @if shown == text { (text) } @else { span title=(text) { (shown) } } }
}

/// A term with its explanation, in one line.
pub(super) fn term(name: &str) -> &'static str {
    match name {
        "coherence" => {
            "Coherence is the share of a response's power that the drives explain linearly: 1 is all of it, 0 is none."
        }
        "residue" => {
            "The residue is the turning points that close no cycle in one pass of the signal; here it is run through twice."
        }
        "multi_rain" => {
            "Multi-Rain is the largest damage of a three-axis signal over all directions in space, so that no axis is favoured."
        }
        "damage" => {
            "Damage is the Palmgren-Miner sum of the rainflow cycles for the stated slope: a measure for comparing, not a life."
        }
        "psd" => "The power spectral density is the signal's mean square by frequency.",
        "trust" => {
            "Outside the range that a model was fitted on its prediction is a guess: those spans are shaded."
        }
        "band" => {
            "The band holds the measured response at nine samples in ten, as it did on the data that compared the model."
        }
        "from_to" => {
            "A cell counts the rainflow cycles that begin in the class of its row and turn in the class of its column."
        }
        "range_pair" => "Range pair counts the cycles that have at least this range.",
        "level_crossing" => "Level crossing counts how often the signal rises through a level.",
        _ => "",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lengths_of_time_have_the_unit_that_people_use() {
        for (s, text) in
            [(0.25, "250 ms"), (90.0, "90 s"), (600.0, "10 min"), (9000.0, "2.5 h"), (f64::NAN, "not known")]
        {
            assert_eq!(duration(s), text);
        }
    }

    #[test]
    fn sizes_and_counts_are_words() {
        assert_eq!(
            (bytes(12), bytes(1_500), bytes(2_500_000)),
            ("12 bytes".into(), "1.5 kB".into(), "2.5 MB".into())
        );
        assert_eq!((count(1, "run", "runs"), count(0, "run", "runs")), ("1 run".into(), "0 runs".into()));
    }

    #[test]
    fn a_long_name_is_whole_in_its_title_and_is_text() {
        let name = format!("<b>\"{}", "x".repeat(2000));
        let html = clamped(&name).into_string();
        assert_eq!(html.matches(&"x".repeat(2000)).count(), 2);
        assert!(
            html.starts_with("<bdi class=\"clamp\" title=\"&lt;b&gt;&quot;x") && !html.contains("<b>"),
            "{html}"
        );
    }

    #[test]
    fn a_sentence_keeps_its_words_and_direction_whatever_name_is_in_it() {
        assert_eq!(sentence("u & y repeat").into_string(), "u &amp; y repeat");
        let text = format!("\u{202e}{} repeats", "y".repeat(1000));
        let html = sentence(&text).into_string();
        assert!(html.ends_with(&format!("\">{}… repeats</span>", "y".repeat(59))), "{html}");
        assert_eq!(html.matches('\u{202e}').count(), 1, "only in the title: {html}");
    }
}
