//! Measured systems of `../shared/data`, where the folder is there.

use std::path::Path;

use crate::diagnosis::screen::{Channel, Place, Record, Recording, Screening, group, screen};
use crate::diagnosis::tests::recorded;
use crate::diagnosis::{Effect, Family};
use crate::measured::shared_data;
use crate::progress::unwatched;
use crate::{Quantity, Signal};

fn recording(rate_hz: f64, runs: Vec<Vec<Vec<f64>>>, quantities: &[Quantity]) -> Recording {
    let channel = |(i, quantity): (usize, &Quantity)| Channel {
        name: format!("channel_{i}"),
        quantity: *quantity,
        size: None,
    };
    let mut channels: Vec<Channel> = quantities.iter().enumerate().map(channel).collect();
    let responses = channels.split_off(1);
    let records = runs
        .into_iter()
        .enumerate()
        .map(|(i, mut run)| {
            let response = Signal::new(rate_hz, run.split_off(1)).unwrap();
            Record {
                drive: Signal::new(rate_hz, run).unwrap(),
                response,
                added: None,
                started_s: 1e3 * i as f64,
            }
        })
        .collect();
    Recording { drives: channels, responses, records }
}

/// One run of a set with one drive and one response of no stated quantity.
fn one(folder: &Path, file: &str, rate_hz: f64, samples: usize) -> Screening {
    let mut run = recorded::channels(&folder.join(file));
    run.iter_mut().for_each(|c| c.truncate(samples));
    let recording = recording(rate_hz, vec![run], &[Quantity::Other; 2]);
    screen(&recording, &group(&recording, &[]), &unwatched).unwrap()
}

#[test]
fn silverbox_stiffens_with_the_cube_of_its_response() {
    let Some(folder) = shared_data("silverbox") else { return };
    let screening = one(&folder, "train.csv", 610.351_562_5, 26_000);
    let foremost = screening.foremost();
    assert_eq!((foremost[0].effect, foremost[0].place), (Effect::CubicStiffness, Place::Response(0)));
    assert!(foremost[0].ratio < 0.12 && foremost[0].ratio < 0.5 * foremost[1].ratio, "{foremost:?}");
}

#[test]
fn a_diode_between_two_filters_is_a_bend_behind_a_filter() {
    let Some(folder) = shared_data("wiener_hammerstein") else { return };
    let screening = one(&folder, "train.csv", 51_200.0, 60_000);
    let first = &screening.standings[0];
    assert_eq!((first.effect, first.place), (Effect::Sandwich, Place::Drive(0)), "{first:?}");
    let free = first.free.as_ref().unwrap();
    assert!(free.ratio < 0.03 && free.worst < 0.04, "{} {}", free.ratio, free.worst);
}

#[test]
fn the_bolted_joint_of_an_aircraft_is_found_between_the_sensors_at_either_side_of_it() {
    let Some(folder) = shared_data("f16") else { return };
    let levels = ["full_level3.npy", "full_level5.npy", "full_level7.npy"];
    // Four of nine periods.
    let run = |file: &str| -> Vec<Vec<f64>> {
        let channels = recorded::channels(&folder.join(file));
        channels.iter().map(|c| c[..4 * 8192].to_vec()).collect()
    };
    let [force, acceleration] = [Quantity::Force, Quantity::Acceleration];
    let quantities = [force, acceleration, acceleration, acceleration];
    let recording = recording(400.0, levels.map(run).to_vec(), &quantities);
    let grouping = group(&recording, &[]);
    assert_eq!(grouping.periods, [Some(8192); 3]);
    let screening = screen(&recording, &grouping, &unwatched).unwrap();
    let foremost = screening.foremost();
    // Clearance and friction of the joint are both documented; at one tenth they are a tie.
    let at = |family| foremost.iter().find(|s| s.family == family).unwrap();
    let joint = [at(Family::Stiffness), at(Family::FrictionHysteresis)];
    for standing in joint {
        assert_eq!(standing.place, Place::Between(2, 1), "{foremost:?}");
        assert!(standing.ratio < 1.1 * foremost[0].ratio, "{foremost:?}");
    }
    assert_eq!(at(Family::Stiffness).effect, Effect::Clearance);
}
