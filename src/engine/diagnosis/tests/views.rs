use super::rig::{few, friction, hardening, none, request};
use crate::diagnosis::views::{Argument, Path};
use crate::diagnosis::{Effect, Input, Views, diagnose};
use crate::progress::unwatched;

fn views(request: Input) -> Views {
    diagnose(&Input { catalogue: few(), ..request }, &unwatched).unwrap().views
}

fn correlation(a: &[f64], b: &[f64]) -> f64 {
    let mean = |x: &[f64]| x.iter().sum::<f64>() / x.len() as f64;
    let (ma, mb) = (mean(a), mean(b));
    let product =
        |f: &dyn Fn(f64, f64) -> f64| -> f64 { a.iter().zip(b).map(|(a, b)| f(a - ma, b - mb)).sum() };
    product(&|a, b| a * b) / (product(&|a, _| a * a) * product(&|_, b| b * b)).sqrt()
}

#[test]
fn curves_are_small_complete_and_survive_storage() {
    let found = views(request(hardening, 0.01));
    let json = serde_json::to_string(&found).unwrap();
    assert!(json.len() < 300_000 && !json.contains("null"), "{}", json.len());
    assert_eq!(serde_json::from_str::<Views>(&json).unwrap(), found);
    let spectra = &found.spectra[0];
    assert_eq!(spectra.unit, "mm");
    for series in [&spectra.measured, &spectra.error, &spectra.gap, &spectra.noise] {
        assert_eq!(series.len(), spectra.frequency_hz.len());
        assert!(series.iter().all(|p| *p >= 0.0));
    }
    assert!(spectra.frequency_hz.windows(2).all(|f| f[0] < f[1]));
    let unseen = found.unseen.unwrap();
    let n = unseen.measured.len();
    assert!((300..=2000).contains(&n) && unseen.simulated.len() == n);
    assert_eq!(unseen.with_effect.unwrap().len(), n);
}

#[test]
fn a_spring_shows_as_a_force_over_travel_that_its_law_follows() {
    let force = views(request(hardening, 0.01)).force.unwrap();
    assert_eq!((force.path, force.unit.as_str()), (Path::Force, "mm"));
    let law = force.law.unwrap();
    assert_eq!(law.over, Argument::Response);
    // It stiffens: the force rises with travel, and most at the ends.
    let (first, middle, last) =
        (law.value[0], law.value[law.value.len() / 2], law.value[law.value.len() - 1]);
    assert!(first < -1.0 && middle.abs() < 0.3 && last > 1.0, "{first} {middle} {last}");
    let found = correlation(&force.force, &force.fitted.unwrap());
    assert!(found > 0.8, "{found}");
}

#[test]
fn friction_shows_as_a_step_over_velocity() {
    let force = views(request(friction, 0.01)).force.unwrap();
    let law = force.law.unwrap();
    assert_eq!(law.over, Argument::Velocity);
    assert!(law.value[0] < 0.0 && *law.value.last().unwrap() > 0.0);
    let side = |sign: f64| {
        let of: Vec<f64> = force
            .velocity
            .iter()
            .zip(&force.force)
            .filter(|(v, _)| sign * **v > 10.0)
            .map(|p| *p.1)
            .collect();
        of.iter().sum::<f64>() / of.len() as f64
    };
    assert!(side(1.0) > 0.15 && side(-1.0) < -0.15, "{} {}", side(1.0), side(-1.0));
}

#[test]
fn without_a_candidate_there_is_no_law_and_nothing_after() {
    let found = views(request(none, 0.01));
    let unseen = found.unseen.unwrap();
    assert!(unseen.with_effect.is_none() && unseen.spectra.after.is_none());
    assert!(found.force.is_none_or(|f| f.law.is_none() && f.fitted.is_none()));
}

#[test]
fn a_clipped_sensor_shows_on_the_sensor() {
    let mut input = request(none, 0.01);
    for run in &mut input.runs {
        let clipped = run.response.channel(0).iter().map(|y| y.clamp(-1.5, 1.5)).collect();
        run.response = crate::Signal::new(super::rig::RATE, vec![clipped]).unwrap();
    }
    let catalogue = vec![Effect::SensorSaturation, Effect::Gain];
    let force = diagnose(&Input { catalogue, ..input }, &unwatched).unwrap().views.force.unwrap();
    assert_eq!(force.path, Path::Sensor);
    let law = force.law.unwrap();
    // Nothing is missing in the middle; at the ends what was clipped.
    let at = |y: f64| {
        let k = law.at.iter().position(|x| *x >= y).unwrap();
        law.value[k]
    };
    assert!(at(0.0).abs() < 0.05 && at(2.0) < -0.3 && at(-2.0) > 0.3, "{} {} {}", at(0.0), at(2.0), at(-2.0));
}
