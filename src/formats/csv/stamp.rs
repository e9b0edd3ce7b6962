//! Date-times in cells: `2026-04-29 21:04:45.125`, `29.04.2026 21:04:45,125`, `4/29/2026 9:04:45 PM`, `29-APR-26`,
//! `21:04:45.125`.

use jiff::civil::Date;

/// A date, a time of the day, or both. Offsets from UTC are left off: one file has one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Stamp {
    /// Days since 1970-01-01.
    pub(super) day: Option<i32>,
    /// Time of the day.
    pub(super) clock: Option<Clock>,
}

/// A time of the day.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Clock {
    /// Seconds since midnight.
    pub(super) seconds: f64,
    /// Digits after the second's mark.
    pub(super) decimals: i32,
}

/// The date-time in a cell; `None` for anything else, numbers included.
pub(super) fn stamp(cell: &[u8]) -> Option<Stamp> {
    let text = std::str::from_utf8(super::number::trim(cell)).ok()?;
    // Every form has a digit first, two marks at least, and no more characters than this.
    if text.len() > 40 || !text.starts_with(|c: char| c.is_ascii_digit()) {
        return None;
    }
    // A T between digits stands for the blank; that of OCT does not.
    let at = text.find('T').filter(|&at| text[..at].ends_with(|c: char| c.is_ascii_digit()));
    let (head, tail) = at.map_or((text, ""), |at| (&text[..at], &text[at + 1..]));
    let mut words = [head, tail].into_iter().flat_map(|part| part.split(' ')).filter(|word| !word.is_empty());
    let first = words.next()?;
    let (day, clock) =
        if first.contains(':') { (None, Some(first)) } else { (Some(day(first)?), words.next()) };
    let Some(clock) = clock else { return Some(Stamp { day, clock: None }) };
    let clock = with_half(clock_of(clock)?, words.next())?;
    words.next().is_none().then_some(Stamp { day, clock: Some(clock) })
}

/// Year, month and day with `-`, month and day with `/` in the order of the file's country, day and month with `.`.
fn day(text: &str) -> Option<i32> {
    let mark = text.chars().find(|c| matches!(c, '-' | '/' | '.'))?;
    let parts: Vec<&str> = text.split(mark).collect();
    let [a, b, c] = parts[..] else { return None };
    let (year, month, day) = match mark {
        _ if a.len() == 4 => (a, number(b)?, number(c)?),
        '-' => (c, number(b).or_else(|| month_of(b))?, number(a)?),
        '/' if number(a)? > 12 => (c, number(b)?, number(a)?),
        '/' => (c, number(a)?, number(b)?),
        _ => (c, number(b)?, number(a)?),
    };
    let year = match year.len() {
        4 => number(year)?,
        2 => 2000 + number(year)?,
        _ => return None,
    };
    let short = |value: i32| i8::try_from(value).ok();
    let date = Date::new(i16::try_from(year).ok()?, short(month)?, short(day)?).ok()?;
    let days = date.duration_since(Date::constant(1970, 1, 1)).as_hours() / 24;
    i32::try_from(days).ok()
}

fn month_of(text: &str) -> Option<i32> {
    const MONTHS: [&str; 12] =
        ["jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec"];
    let text = text.to_ascii_lowercase();
    (1..).zip(MONTHS).find_map(|(number, month)| (text == month).then_some(number))
}

/// Hours, minutes, and seconds with a point or a comma; behind it `Z` or `+02:00`.
fn clock_of(text: &str) -> Option<Clock> {
    let text = text.strip_suffix('Z').unwrap_or(text);
    let text = text.split_once(['+', '-']).map_or(text, |(clock, _)| clock);
    let mut parts = text.split(':');
    let (hours, minutes) = (number(parts.next()?)?, number(parts.next()?)?);
    let seconds = parts.next().unwrap_or("0");
    if parts.next().is_some() || hours > 24 || minutes > 59 {
        return None;
    }
    let (whole, fraction) = seconds.split_once(['.', ',']).unwrap_or((seconds, ""));
    if number(whole)? > 60 || !fraction.bytes().all(|b| b.is_ascii_digit()) {
        return None;
    }
    let seconds: f64 = format!("{whole}.{fraction}0").parse().ok()?;
    let decimals = i32::try_from(fraction.len()).ok()?;
    Some(Clock { seconds: f64::from(3600 * hours + 60 * minutes) + seconds, decimals })
}

/// The time of the day with `AM` or `PM` behind it.
fn with_half(clock: Clock, half: Option<&str>) -> Option<Clock> {
    const HOUR: f64 = 3600.0;
    let Some(half) = half else { return Some(clock) };
    let noon = (12.0 * HOUR..13.0 * HOUR).contains(&clock.seconds);
    let seconds = match half.to_ascii_uppercase().as_str() {
        "AM" if noon => clock.seconds - 12.0 * HOUR,
        "PM" if !noon => clock.seconds + 12.0 * HOUR,
        "AM" | "PM" => clock.seconds,
        _ => return None,
    };
    Some(Clock { seconds, ..clock })
}

/// One to four digits.
fn number(text: &str) -> Option<i32> {
    ((1..=4).contains(&text.len()) && text.bytes().all(|b| b.is_ascii_digit())).then(|| text.parse().ok())?
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 2026-04-29, by `date -d 2026-04-29 +%s` / 86400.
    const DAY: i32 = 20_572;

    #[test]
    fn date_times_of_loggers_and_of_spreadsheets_are_read() {
        let at = |seconds, decimals| Some(Clock { seconds, decimals });
        for (text, day, clock) in [
            ("2026-04-29 21:04:45.125", Some(DAY), at(75_885.125, 3)),
            ("2026-04-29T21:04:45.125Z", Some(DAY), at(75_885.125, 3)),
            ("2026-04-29T21:04:45,1+02:00", Some(DAY), at(75_885.1, 1)),
            ("29.04.2026 21:04:45,125", Some(DAY), at(75_885.125, 3)),
            ("29.4.26 21:04", Some(DAY), at(75_840.0, 0)),
            ("4/29/2026 9:04:45 PM", Some(DAY), at(75_885.0, 0)),
            ("29/04/2026 12:00:01 AM", Some(DAY), at(1.0, 0)),
            ("29-APR-26", Some(DAY), None),
            ("29-OCT-2026 1:00", Some(DAY + 183), at(3600.0, 0)),
            ("2026/04/29", Some(DAY), None),
            ("00:00:00.5", None, at(0.5, 1)),
        ] {
            assert_eq!(stamp(text.as_bytes()), Some(Stamp { day, clock }), "{text}");
        }
    }

    #[test]
    fn what_is_no_date_time_is_left() {
        for text in [
            "",
            "1.5",
            "1.234.567",
            "12,5",
            "2026",
            "31.02.2026",
            "1-2",
            "25:61",
            "12:30:61",
            "a:b",
            "1:2:3:4",
            "21:04:45 XM",
            "-1:2",
        ] {
            assert_eq!(stamp(text.as_bytes()), None, "{text}");
        }
    }
}
