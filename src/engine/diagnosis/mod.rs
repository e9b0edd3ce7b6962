//! Where model and rig disagree, which unmodelled effect causes it, and how far simulating that
//! effect closes the gap.

mod ar;
mod candidate;
mod catalogue;
mod core;
mod effect;
mod fitting;
mod input;
mod input_map;
mod kernel;
mod law;
mod levmar;
mod linear;
mod modes;
mod noise;
mod output_map;
mod prepare;
mod problem;
mod rows;
mod spline;
mod split;
mod start;

pub use self::core::Core;
pub use ar::Ar;
pub use effect::{Effect, Family};
pub use input::{Channel, Input, Mode, Role, Run};
pub use modes::{Modes, Pole};
pub use split::Piece;

/// Prototype
pub fn explore(input: &Input) -> Vec<(usize, Effect, usize, f64, f64, f64, f64)> {
    use rayon::prelude::*;
    let t = std::time::Instant::now();
    let prepared = prepare::prepare(input).unwrap();
    if std::env::var("V").is_ok() {
        eprintln!("prepare {:?} band {:?} noise {:?}", t.elapsed(), prepared.band, prepared.noises.iter().map(|n| (n.ar.power(0.01).sqrt(), n.drive_coherence)).collect::<Vec<_>>());
    }
    let mut out = Vec::new();
    for problem in &prepared.problems {
        if std::env::var("V").is_ok() {
            eprintln!("order {} natural {:?} lead {}", problem.core.modes.order(), problem.core.natural(), problem.fit[0].lead);
        }
        if std::env::var("V").is_ok() {
            for st in problem.fit.iter().chain(&problem.select) { let mut r = Vec::new(); st.extend(&st.gap(0), &mut r); let n=r.len(); let m = st.rows.samples();
              let w = st.rows.whitened(&st.gap(0)[st.lead..]); let tb: Vec<String> = w.chunks(w.len()/8).map(|c| format!("{:.1}", c.iter().map(|x| x*x).sum::<f64>()*8.0/n as f64)).collect();
              eprintln!("run {} from {} lead {} n {} m {m} chi {:?} time {:?}", st.run, st.from, st.lead, st.measured.len(), r.chunks((n/12).max(1)).map(|c| (c.iter().map(|x| x*x).sum::<f64>()/c.len() as f64 * 10.0).round()/10.0).collect::<Vec<_>>(), tb); }
        }
        let in_situ = input.mode == Mode::InSitu;
        let plain = start::Regression::new(problem, in_situ);
        let tuned = start::Regression::new(problem, true);
        let ranges = catalogue::FreeRanges::of(problem, &plain.smooth);
        let none = problem.chi2_none(&problem.select);
        out.push((problem.response, Effect::PeriodicDisturbance, 0, 0.0, problem.chi2_none(&problem.fit), none, 0.0));
        let parts = catalogue::parts(problem, &input.catalogue, in_situ, ranges);
        let found: Vec<_> = parts
            .into_par_iter()
            .map(|part| {
                let t = std::time::Instant::now();
                let effect = part.effect;
                let drive = part.drive;
                let candidate = candidate::Candidate::of(part, in_situ);
                let regression = if candidate.retune { &tuned } else { &plain };
                let s = regression.starts(&candidate, &[]).first().map_or(f64::NAN, |s| s.cost / problem.fit.iter().map(|s| s.rows.len()).sum::<usize>() as f64);
                let fitted = fitting::fit(problem, regression, &candidate, &[], fitting::Effort { rounds: 15 });
                let (f, c) = fitted.map_or((f64::NAN, f64::NAN), |f| {
                    let c = f.candidate.predictions(problem, &problem.select, &f.p).map_or(f64::NAN, |p| problem.chi2(&problem.select, &p));
                    (f.chi2_fit, c)
                });
                (problem.response, effect, drive, s, f, c, t.elapsed().as_secs_f64())
            })
            .collect();
        out.extend(found);
    }
    out
}
