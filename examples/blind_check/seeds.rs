//! The seeds of a run: those for calibration of the decision, for tests and for the final figures are
//! disjoint, and final ones are used once.

use std::io::Write;
use std::path::Path;

use clap::ValueEnum;
use serde_json::Value;

/// The purpose of a run of the check.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Seeds {
    /// To set the numbers of the decision.
    Calibration,
    /// To examine while the diagnosis is developed.
    Test,
    /// For the figures that are stated: each round is used once.
    Final,
}

/// Rounds of one kind.
pub const ROUNDS: u64 = 1000;
/// Seeds of one round: room for a hundred suites of ten thousand cases.
const ROUND: u64 = 1_000_000;
const SUITE: u64 = 10_000;

impl Seeds {
    /// The seed of a case.
    ///
    /// # Panics
    /// Outside the ranges, which would run into another kind's seeds.
    pub fn of(self, round: u64, suite: u64, index: u64) -> u64 {
        assert!(round < ROUNDS && suite < ROUND / SUITE && index < SUITE, "a seed of another kind");
        let kind = match self {
            Self::Calibration => 1,
            Self::Test => 2,
            Self::Final => 3,
        };
        kind * ROUNDS * ROUND + round * ROUND + suite * SUITE + index
    }

    /// As the command line writes it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Calibration => "calibration",
            Self::Test => "test",
            Self::Final => "final",
        }
    }
}

/// Lines of the log of final runs, oldest first; none where there is no log yet.
///
/// # Errors
/// A file that cannot be read or is not JSON by line.
pub fn logged(log: &Path) -> std::io::Result<Vec<Value>> {
    if !log.exists() {
        return Ok(Vec::new());
    }
    std::fs::read_to_string(log)?.lines().map(|line| Ok(serde_json::from_str(line)?)).collect()
}

/// Adds a line to the log of final runs.
///
/// # Errors
/// A file that cannot be written.
pub fn append(log: &Path, line: &Value) -> std::io::Result<()> {
    let mut file = std::fs::OpenOptions::new().create(true).append(true).open(log)?;
    writeln!(file, "{line}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seeds_of_one_kind_end_before_the_next_begin() {
        let kinds = [Seeds::Calibration, Seeds::Test, Seeds::Final];
        let last = |kind: Seeds| kind.of(ROUNDS - 1, ROUND / SUITE - 1, SUITE - 1);
        for two in kinds.windows(2) {
            assert!(last(two[0]) < two[1].of(0, 0, 0));
        }
        assert!(Seeds::Test.of(0, 3, SUITE - 1) < Seeds::Test.of(0, 4, 0));
        assert!(Seeds::Test.of(0, ROUND / SUITE - 1, SUITE - 1) < Seeds::Test.of(1, 0, 0));
    }
}
