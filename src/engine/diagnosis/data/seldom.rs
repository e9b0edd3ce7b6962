//! Roles of the quarters of runs where an effect acts so seldom, or so much more in one of them, that the
//! usual ones would fit what hardly shows it and choose on what it never met.

use super::overview::NOISE_ONLY;
use super::split::QUARTERS;
use crate::diagnosis::input::Role;

/// Share of the largest gap of a quarter that the fitted ones have at least.
const SHOWS: f64 = 0.25;
/// Mean square in noise floors from which a gap is there for certain.
pub const PLAIN_GAP: f64 = 2.0;

/// Roles by what each quarter's gap is, in noise floors squared; `None` where the usual ones serve. The
/// largest is fitted beside the smallest, the next is chosen on, the third tells how far the gap closes.
pub fn roles(chi2: [f64; QUARTERS]) -> Option<[Role; QUARTERS]> {
    let gap = chi2.map(|c| (c - 1.0).max(0.0));
    let mut order = [0, 1, 2, 3];
    order.sort_by(|&a, &b| gap[b].total_cmp(&gap[a]));
    let shows = |gap_of: f64| gap_of >= SHOWS * gap[order[0]];
    let fit_misses = !shows(0.5 * (gap[0] + gap[1]));
    let plain = |gap_of: f64| gap_of >= PLAIN_GAP - 1.0;
    // What is small beside the largest is still there to choose on where it is plain.
    let next = gap[order[1]];
    let select_misses = chi2[2] < NOISE_ONLY && (shows(next) || plain(next));
    if !plain(gap[order[0]]) || !(fit_misses || select_misses) {
        return None;
    }
    let mut roles = [Role::Fit; QUARTERS];
    roles[order[1]] = Role::Select;
    roles[order[2]] = Role::Test;
    Some(roles)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_usual_roles_serve_unless_the_fit_misses_the_gap_or_the_choice_does() {
        assert_eq!(roles([90.0, 40.0, 120.0, 200.0]), None);
        assert_eq!(roles([1.0, 1.1, 1.2, 1.0]), None, "there is no gap");
        let [fit, select, test] = [Role::Fit, Role::Select, Role::Test];
        assert_eq!(roles([1.0, 1.1, 20.0, 3000.0]), Some([fit, test, select, fit]));
        assert_eq!(roles([50.0, 40.0, 1.1, 60.0]), Some([select, test, fit, fit]));
        assert_eq!(roles([50.0, 40.0, 1.1, 2.0]), Some([fit, select, fit, test]));
        assert_eq!(roles([17.0, 1.4, 1.1, 2.6]), Some([fit, test, fit, select]));
        assert_eq!(roles([50.0, 1.9, 1.1, 1.2]), None, "no other quarter shows it well enough to choose on");
    }
}
