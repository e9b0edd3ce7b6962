//! Numbers in the form in which people write them.

/// Three digits, without an exponent from a thousandth to a million; powers of ten beyond.
pub(super) fn number(x: f64) -> String {
    if !x.is_finite() {
        return "not known".into();
    }
    let size = x.abs();
    if size == 0.0 {
        return "0".into();
    }
    if !(1e-3..1e6).contains(&size) {
        let mut exponent = size.log10().floor() as i32;
        let mut mantissa = format!("{:.2}", x / 10.0_f64.powi(exponent));
        if mantissa.trim_start_matches('-').starts_with("10") {
            exponent += 1;
            mantissa = format!("{:.2}", x / 10.0_f64.powi(exponent));
        }
        return format!("{}·10{}", minus(trimmed(&mantissa)), superscript(exponent));
    }
    let decimals = (2 - size.log10().floor() as i32).max(0) as usize;
    minus(trimmed(&format!("{x:.decimals$}")))
}

/// A share as a percentage; near 0 and near 1 with enough decimals to differ from them.
pub(super) fn percent(share: f64) -> String {
    let p = 100.0 * share;
    let text = if !p.is_finite() {
        return "not known".into();
    } else if p == 0.0 || p == 100.0 {
        format!("{p:.0}")
    } else if p > 0.0 && p < 0.1 {
        "less than 0.1".into()
    } else if p > 99.95 && p < 100.0 {
        "more than 99.9".into()
    } else if p.abs() < 10.0 || (p > 98.95 && p < 100.0) {
        trimmed(&format!("{p:.1}")).to_owned()
    } else {
        format!("{p:.0}")
    };
    format!("{}\u{a0}%", minus(&text))
}

/// A closure in percent without the sign; it has more decimals the nearer it is to 1.
pub(super) fn share(x: f64) -> String {
    let p = 100.0 * x;
    if !p.is_finite() {
        return "not known".into();
    }
    let decimals = match p {
        p if p >= 99.9 => 2,
        p if p >= 90.0 => 1,
        _ => 0,
    };
    minus(trimmed(&format!("{p:.decimals$}")))
}

/// A number with its unit; the unit `1` is not written.
pub(super) fn with_unit(x: f64, unit: &str) -> String {
    if unit.is_empty() || unit == "1" { number(x) } else { format!("{}\u{a0}{}", number(x), exponents(unit)) }
}

/// Longest name that a plot or a list of choices writes out.
const NAME: usize = 40;

/// A name, cut where it is long, for places that no style sheet reaches.
pub(super) fn cut(name: &str) -> String {
    cut_to(name, NAME)
}

/// A text, cut to this many characters.
pub(super) fn cut_to(text: &str, most: usize) -> String {
    if text.chars().count() <= most {
        return text.to_owned();
    }
    text.chars().take(most - 1).chain(['…']).collect()
}

/// `mm^2/Hz` as `mm²/Hz`.
pub(super) fn exponents(unit: &str) -> String {
    unit.replace("^2", "²").replace("^3", "³")
}

/// The unit of a density over frequency.
pub(super) fn density_unit(unit: &str) -> String {
    let single = unit.chars().all(char::is_alphanumeric);
    if single { format!("{unit}²/Hz") } else { format!("({})²/Hz", exponents(unit)) }
}

/// `10^n` without the ten.
pub(super) fn superscript(exponent: i32) -> String {
    let digits = exponent.abs().to_string();
    let high = digits.chars().map(|c| match c {
        '1' => '¹',
        '2' => '²',
        '3' => '³',
        '4' => '⁴',
        '5' => '⁵',
        '6' => '⁶',
        '7' => '⁷',
        '8' => '⁸',
        '9' => '⁹',
        _ => '⁰',
    });
    let sign = if exponent < 0 { "⁻" } else { "" };
    format!("{sign}{}", high.collect::<String>())
}

/// `a`, `a or b`, `a, b or c`.
pub(super) fn listed(items: &[String], word: &str) -> String {
    match items {
        [] => String::new(),
        [one] => one.clone(),
        [most @ .., last] => format!("{} {word} {last}", most.join(", ")),
    }
}

fn trimmed(text: &str) -> &str {
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { text }
}

fn minus(text: &str) -> String {
    if text == "-0" { "0".into() } else { text.replace('-', "−") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_have_three_digits_and_no_needless_zeros() {
        for (x, text) in [
            (0.0, "0"),
            (1.0, "1"),
            (-0.25, "−0.25"),
            (1234.6, "1235"),
            (0.001_234, "0.00123"),
            (1.5e-5, "1.5·10⁻⁵"),
            (9.999e-6, "1·10⁻⁵"),
            (-2.0e12, "−2·10¹²"),
            (f64::NAN, "not known"),
        ] {
            assert_eq!(number(x), text);
        }
    }

    #[test]
    fn percentages_tell_almost_all_from_all() {
        for (share, text) in [
            (0.0, "0"),
            (1.0, "100"),
            (0.5, "50"),
            (0.9926, "99.3"),
            (0.9999, "more than 99.9"),
            (0.0002, "less than 0.1"),
            (0.034, "3.4"),
            (-0.2, "−20"),
        ] {
            assert_eq!(percent(share), format!("{text}\u{a0}%"));
        }
    }

    #[test]
    fn closures_get_decimals_where_they_count() {
        for (x, text) in [(1.0, "100"), (0.99534, "99.5"), (0.99987, "99.99"), (0.42, "42"), (-0.5, "−50")]
        {
            assert_eq!(share(x), text);
        }
    }

    #[test]
    fn lists_read_like_a_sentence() {
        let list = |items: &[&str]| listed(&items.iter().map(|s| s.to_string()).collect::<Vec<_>>(), "or");
        assert_eq!(list(&["a"]), "a");
        assert_eq!(list(&["a", "b", "c"]), "a, b or c");
    }

    #[test]
    fn units_keep_their_powers() {
        assert_eq!(with_unit(2.0, "mm^2/Hz"), "2\u{a0}mm²/Hz");
        assert_eq!(with_unit(2.0, "1"), "2");
    }
}
