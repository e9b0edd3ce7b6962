//! Which laws are tried at which place.

use super::law::Law;
use super::place::{Argument, Place};
use crate::Quantity;

/// Laws over an argument, with the second argument of a law of two as an index into `arguments`.
pub(super) fn laws(arguments: &[Argument], at: usize) -> Vec<(Law, Option<usize>)> {
    let argument = &arguments[at];
    let alone = |laws: Vec<Law>| laws.into_iter().map(|law| (law, None));
    let mut out: Vec<(Law, Option<usize>)> = alone(Law::stiffness()).collect();
    match argument.place {
        Place::Drive(_) => {
            // The rate of a force is no motion.
            if argument.quantity == Quantity::Force {
                out.extend(alone(Law::sliding()));
            } else {
                out.extend(alone(Law::friction()));
                out.extend(alone(Law::damping()));
            }
            out.extend(alone(Law::rate_limits()));
            out.push((Law::StiffnessDrift, None));
            out.extend(valve_flow(arguments));
        }
        // An error of control has no rate.
        Place::Error(..) => {
            out.extend(alone(Law::sliding()));
            out.extend(valve_flow(arguments));
        }
        Place::Response(_) => {
            out.extend(alone(Law::friction()));
            out.extend(alone(Law::damping()));
            out.push((Law::StiffnessDrift, None));
        }
        Place::Between(..) | Place::OnTable(..) => {
            out.extend(alone(Law::friction()));
            out.extend(alone(Law::damping()));
        }
        Place::Output(_) => return over_output(),
    }
    out.extend(others(arguments, at).into_iter().map(|i| (Law::CrossAxisKinematic, Some(i))));
    out
}

/// A valve whose flow falls with the load, which any response may stand for.
fn valve_flow(arguments: &[Argument]) -> impl Iterator<Item = (Law, Option<usize>)> {
    let responses = |i: &usize| matches!(arguments[*i].place, Place::Response(_));
    (0..arguments.len()).filter(responses).map(|i| (Law::ValveFlow, Some(i)))
}

/// Laws of a sensor, or behind all dynamics.
fn over_output() -> Vec<(Law, Option<usize>)> {
    let kinks = [0.5, 0.9, 1.3, 1.7, 2.1, 2.6].map(|at| Law::Kink { at });
    let sides = [-2.0, -1.3, -0.6, 0.0, 0.6, 1.3, 2.0].map(|at| Law::OneSided { at });
    let rest = [Law::Cubic, Law::Quadratic, Law::Polynomial, Law::Sandwich];
    rest.into_iter().chain(kinks).chain(sides).map(|law| (law, None)).collect()
}

/// Other axes of an argument: channels of its quantity and side, or beside a lone response the drives.
fn others(arguments: &[Argument], at: usize) -> Vec<usize> {
    let this = &arguments[at];
    let like = |i: usize| -> bool {
        let other = &arguments[i];
        match (this.place, other.place) {
            (Place::Drive(a), Place::Drive(b)) => a != b && this.quantity == other.quantity,
            (Place::Response(a), Place::Response(b)) => a != b && this.quantity == other.quantity,
            _ => false,
        }
    };
    let found: Vec<usize> = (0..arguments.len()).filter(|&i| like(i)).collect();
    let drives: Vec<usize> =
        (0..arguments.len()).filter(|&i| matches!(arguments[i].place, Place::Drive(_))).collect();
    match this.place {
        Place::Response(_) if found.is_empty() && drives.len() > 1 => drives,
        _ => found,
    }
}
