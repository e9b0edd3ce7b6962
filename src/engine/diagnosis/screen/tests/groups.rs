use super::systems::{noise, recording};
use crate::Quantity;
use crate::diagnosis::screen::{Grouping, Transfer, group};

fn grouped(drives: Vec<Vec<f64>>) -> Grouping {
    let runs = drives.into_iter().map(|u| (vec![u.clone()], vec![u])).collect();
    group(&recording(&[Quantity::Force], &[Quantity::Displacement], runs), &[])
}

fn scaled(x: &[f64], by: f64) -> Vec<f64> {
    x.iter().map(|x| by * x).collect()
}

#[test]
fn one_run_is_held_out_by_stretches() {
    let found = grouped(vec![noise(1000, 1)]);
    assert_eq!((found.transfer, found.groups), (Transfer::Stretches, 5));
    assert_eq!(found.stretches.last().unwrap().samples, 800..1000);
}

#[test]
fn runs_of_one_level_are_held_out_whole_and_repeats_together() {
    let mut drives: Vec<Vec<f64>> = (0..4).map(|i| noise(1500, 20 + i)).collect();
    // A measured repeat is never the same to the last digit.
    let jitter = noise(1500, 9);
    drives.push(drives[1].iter().zip(&jitter).map(|(u, e)| u + 0.03 * e).collect());
    let found = grouped(drives);
    assert_eq!((found.transfer, found.groups), (Transfer::Runs, 4));
    assert_eq!(found.repeats, [[1, 4]]);
    let group_of = |record: usize| found.stretches.iter().find(|s| s.record == record).unwrap().group;
    assert_eq!(group_of(1), group_of(4));
    assert_ne!(group_of(0), group_of(1));
}

#[test]
fn levels_of_one_drive_are_classes_from_low_to_high() {
    let u = noise(1500, 3);
    let found = grouped(vec![scaled(&u, 4.0), u.clone(), scaled(&u, 2.0)]);
    assert_eq!((found.transfer, found.groups), (Transfer::Classes, 3));
    let group_of = |record: usize| found.stretches.iter().find(|s| s.record == record).unwrap().group;
    assert_eq!([group_of(1), group_of(2), group_of(0)], [0, 1, 2]);
}

#[test]
fn two_levels_are_each_seen_in_part_while_the_other_part_is_held_out() {
    let found = grouped(vec![noise(1500, 3), scaled(&noise(1500, 4), 0.5)]);
    assert_eq!((found.transfer, found.groups), (Transfer::TwoClasses, 4));
}

#[test]
fn an_offset_makes_a_class_of_its_own() {
    let with = |seed: u64, offset: f64| noise(1500, seed).iter().map(|u| u + offset).collect::<Vec<f64>>();
    let found = grouped(vec![with(3, 0.0), with(4, 1.5), with(5, -1.5)]);
    assert_eq!((found.transfer, found.groups), (Transfer::Classes, 3));
}

#[test]
fn periods_of_one_drive_are_no_groups() {
    let one = noise(400, 5);
    let u: Vec<f64> = (0..2800).map(|k| one[k % 400]).collect();
    let found = grouped(vec![u]);
    assert_eq!(found.periods, [Some(400)]);
    assert_eq!(found.transfer, Transfer::OneDrive);
    // Equal phases of all periods are held out together, and the rig settles first.
    let phases = |group: usize| {
        let of = found.stretches.iter().filter(|s| s.group == group);
        of.map(|s| s.samples.start % 1200).collect::<Vec<usize>>()
    };
    assert!((0..found.groups).all(|g| phases(g).windows(2).all(|w| w[0] == w[1])), "{:?}", found.stretches);
    assert!(found.stretches.iter().all(|s| s.samples.start >= 400));
}

#[test]
fn a_stretch_at_rest_is_left_out() {
    let mut u = noise(2000, 6);
    u[1600..].fill(0.0);
    let found = grouped(vec![u]);
    assert!(found.stretches.iter().all(|s| s.samples.end <= 1600), "{:?}", found.stretches);
}
