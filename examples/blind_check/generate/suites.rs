//! The suites of the check: number of cases, flaws, data.

use clap::ValueEnum;
use rand::{Rng, RngExt};
use serde_json::{Value, json};

use super::effects::{self, Named};

/// A row, or part of a row, of the table of figures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Suite {
    /// Effects of the catalogue.
    Catalogue,
    /// Nothing, noise, hum, quantisation.
    Nothing,
    /// Effects outside the catalogue.
    Outside,
    /// The true effect and its siblings struck from the catalogue.
    Struck,
    /// The same physics in another equation.
    OtherEquation,
    /// The baseline runs have the effect already.
    InSitu,
    /// Two effects at once.
    TwoEffects,
    /// Three drives, three displacements, three forces, the effect on one axis.
    ThreeAxes,
    /// Runs of one level that leave effects ambiguous, and a rig that can be run once more.
    NextExperiment,
    /// 100 s of one response, and of three drives and six responses.
    Time,
    /// No run made twice, no baseline, no model from before: the FRF that the service fits to the runs, and the runs.
    NoRepeats,
    /// Models of the service that err: an FRF of few averages, a network of a short fit.
    SimsThatErr,
    /// Forces where no sensor is, a weak nonlinearity everywhere, a position loop, forces that nobody measures.
    RoughRigs,
    /// Several sensors, a law at one of them or between two.
    Place,
    /// Drives that are displacements, responses that are forces.
    ForceOverDisplacement,
    /// Three axes as above, an effect on two of them.
    TwoAxes,
}

/// Lengths of the runs of one case, s. `long` and `half` (at half the level) are each run twice.
#[derive(Debug, Clone, Copy)]
pub struct Lengths {
    pub long: f64,
    /// None: one level only.
    pub half: Option<f64>,
    pub baseline: f64,
}

/// Step through a suite's list, prime to the length of each.
const STRIDE: usize = 11;

impl Suite {
    /// All of them, in the order of the table.
    pub const ALL: [Self; 16] = [
        Self::Catalogue,
        Self::Nothing,
        Self::Outside,
        Self::Struck,
        Self::OtherEquation,
        Self::InSitu,
        Self::TwoEffects,
        Self::ThreeAxes,
        Self::NextExperiment,
        Self::Time,
        Self::NoRepeats,
        Self::SimsThatErr,
        Self::RoughRigs,
        Self::Place,
        Self::ForceOverDisplacement,
        Self::TwoAxes,
    ];

    /// As labels and the command line write it.
    pub fn name(self) -> String {
        self.to_possible_value().map_or_else(String::new, |v| v.get_name().to_owned())
    }

    /// Its place among the seeds.
    pub fn number(self) -> u64 {
        Self::ALL.iter().position(|s| *s == self).map_or(0, |i| i as u64)
    }

    /// Cases of the whole check.
    pub fn cases(self) -> usize {
        match self {
            Self::Catalogue | Self::Nothing | Self::NextExperiment => 200,
            Self::Outside | Self::Struck | Self::OtherEquation | Self::InSitu => 60,
            Self::NoRepeats | Self::SimsThatErr | Self::RoughRigs => 60,
            Self::TwoEffects | Self::ThreeAxes | Self::Place => 40,
            Self::ForceOverDisplacement | Self::TwoAxes => 40,
            Self::Time => 2,
        }
    }

    /// Axes of the rig of one case.
    pub fn axes(self, index: usize) -> usize {
        if matches!(self, Self::ThreeAxes | Self::TwoAxes) || (self == Self::Time && index % 2 == 1) {
            3
        } else {
            1
        }
    }

    /// Lengths of its runs: 100 s as the clocked cases but for the three axes, of six responses, and the next
    /// experiment, which begins with a short look that leaves more open.
    pub fn lengths(self) -> Lengths {
        match self {
            Self::ThreeAxes | Self::TwoAxes => Lengths { long: 20.0, half: Some(15.0), baseline: 40.0 },
            Self::NextExperiment => Lengths { long: 8.0, half: None, baseline: 30.0 },
            _ => Lengths { long: 30.0, half: Some(20.0), baseline: 40.0 },
        }
    }

    /// The runs that are asked about, with nothing else; `None` of suites that say all that there is to say.
    pub fn asked(self, index: usize) -> Option<&'static [&'static str]> {
        match self {
            Self::NoRepeats if index % 3 == 2 => Some(&["run-0"]),
            Self::NoRepeats => Some(&["run-0", "run-1"]),
            _ => None,
        }
    }

    /// Whether its rigs are frames.
    pub fn is_of_frames(self) -> bool {
        matches!(self, Self::RoughRigs | Self::Place | Self::ForceOverDisplacement)
    }

    /// The fit that makes the model, to the baseline run alone; `None` where the case brings one.
    pub fn fit(self, index: usize) -> Option<Value> {
        let small = |kind: &str| {
            let lstm = json!({"blocks": [12], "window_len": 256, "hop": 128, "epochs": 25, "seeds": [1]});
            json!({"kind": kind, "lstm": lstm})
        };
        (self == Self::SimsThatErr).then(|| match index % 3 {
            // Four averages or so of forty seconds.
            0 => json!({"kind": "frf", "frf": {"segment_len": 8192}}),
            1 => small("lstm"),
            _ => small("hybrid2"),
        })
    }

    /// Whether nothing but model and runs is said, in every second case of the suites that have both.
    pub fn is_default_request(self, index: usize) -> bool {
        match self {
            Self::SimsThatErr => index % 2 == 1,
            // Four kinds of rig take turns.
            Self::RoughRigs => (index / 4).is_multiple_of(2),
            Self::Place | Self::ForceOverDisplacement => index.is_multiple_of(2),
            _ => false,
        }
    }

    /// Whether fresh runs are predicted with the effect adopted, to see what the intervals of closure hold.
    pub fn is_checked(self) -> bool {
        matches!(self, Self::Catalogue | Self::InSitu)
    }

    /// The flaws of one case; `index` walks through the list evenly, a few cases through all of it.
    pub fn flaws(self, index: usize, rng: &mut impl Rng) -> Vec<Named> {
        let list = match self {
            Self::Catalogue | Self::Struck => effects::catalogue(rng),
            Self::Nothing => effects::nothing(rng),
            Self::Outside => effects::outside(rng),
            Self::OtherEquation => effects::other_equation(rng),
            Self::InSitu => effects::in_situ(rng),
            Self::TwoEffects => return pair(effects::for_pairs(rng), rng),
            Self::TwoAxes => return effects::on_two_axes(rng),
            Self::ThreeAxes => effects::three_axes(rng),
            Self::NextExperiment | Self::Time => effects::ambiguous(rng),
            Self::NoRepeats => effects::without_repeats(rng),
            Self::SimsThatErr => effects::beside_errors(index, self.is_default_request(index), rng),
            Self::RoughRigs | Self::Place | Self::ForceOverDisplacement => {
                unreachable!("frames have laws of their own")
            }
        };
        vec![list[STRIDE * index % list.len()]]
    }
}

fn pair(list: Vec<Named>, rng: &mut impl Rng) -> Vec<Named> {
    loop {
        let two = [(); 2].map(|()| list[rng.random_range(0..list.len())]);
        if two[0].family != two[1].family {
            return two.to_vec();
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::*;

    #[test]
    fn a_suite_goes_through_its_whole_list() {
        let effects = |suite: Suite, n: usize| {
            let of = |i| suite.flaws(i, &mut ChaCha8Rng::seed_from_u64(1))[0].effect;
            (0..n).map(of).collect::<std::collections::BTreeSet<_>>().len()
        };
        assert_eq!(effects(Suite::Catalogue, 28), 28);
        assert_eq!(effects(Suite::Nothing, 4), 4);
        assert_eq!(effects(Suite::Outside, 5), 5);
        assert_eq!(effects(Suite::OtherEquation, 5), 5);
        assert_eq!(effects(Suite::InSitu, 21), 21);
        assert_eq!(effects(Suite::ThreeAxes, 26), 26);
        assert_eq!(effects(Suite::NextExperiment, 15), 15);
    }

    #[test]
    fn two_effects_are_of_two_families() {
        for seed in 0..50 {
            let two = Suite::TwoEffects.flaws(0, &mut ChaCha8Rng::seed_from_u64(seed));
            assert_eq!(two.len(), 2);
            assert_ne!(two[0].family, two[1].family);
        }
    }
}
