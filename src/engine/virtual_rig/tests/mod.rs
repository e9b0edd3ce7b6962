mod fit;

use super::drives::*;
use super::*;

fn stats(x: &[f64]) -> String {
    let m = fit::mean(x);
    let s = (x.iter().map(|v| (v - m).powi(2)).sum::<f64>() / x.len() as f64).sqrt();
    let lo = x.iter().cloned().fold(f64::MAX, f64::min);
    let hi = x.iter().cloned().fold(f64::MIN, f64::max);
    format!("{m:6.2} sd{s:5.2} [{lo:6.2},{hi:6.2}]")
}

#[test]
fn probe() {
    for seed in 0..5 {
        let rig = VirtualRig::draw(seed);
        let clock = std::time::Instant::now();
        let runs: Vec<_> = (0..2)
            .map(|k| {
                let d = linear_noise(60.0, 100 + k).unwrap();
                let r = rig.simulate(&d, k).unwrap();
                (d, r)
            })
            .collect();
        println!("seed {seed}: 120 s in {:.2?}", clock.elapsed());
        let model = fit::h1(&runs);
        for f in [0.0, 5.0, 10.0, 20.0, 40.0] {
            let h = &model.lines[(f * 4.096f64).round() as usize];
            let t = &rig.linear_response(&[f])[0];
            println!("   {f} H {:?} underlying {:?}", (0..6).map(|r| (h[r][r % 3].norm() * 1e3).round() / 1e3).collect::<Vec<_>>(),
               (0..6).map(|r| (t[r][r % 3].norm() * 1e3).round() / 1e3).collect::<Vec<_>>());
        }
        let sl = |scale, offset_kn| service_load(&ServiceLoad { shape: ServiceShape::HandlingCourse, duration_s: 60.0, scale, offset_kn }, 9).unwrap();
        let list = vec![
            ("lin", linear_noise(30.0, 77).unwrap()),
            ("n1", mixed_noise(&MixedNoise { duration_s: 120.0, stretch_s: 15.0, region: NoiseRegion::Interior }, 5).unwrap()),
            ("n2", mixed_noise(&MixedNoise { duration_s: 120.0, stretch_s: 15.0, region: NoiseRegion::Boundary }, 5).unwrap()),
            ("sl.3", sl(0.3, 0.0)),
            ("sl.5", sl(0.5, 0.0)),
            ("sl1", sl(1.0, 0.0)),
            ("sl-", sl(0.5, -SERVICE_OFFSET_KN)),
            ("sl+", sl(0.5, SERVICE_OFFSET_KN)),
        ];
        for (name, d) in &list {
            let y = rig.simulate(d, 3).unwrap();
            let p = model.predict(d);
            let e: Vec<String> = (0..6).map(|c| format!("{:.3}", fit::rms_error(&p[c], y.channel(c)))).collect();
            println!("{name:5} err {e:?}");
            if seed == 0 {
                for c in 0..3 { println!("      drive {}  disp {}  force {}", stats(d.channel(c)), stats(y.channel(c)), stats(y.channel(c + 3))); }
            }
        }
    }
}

#[test]
fn timing() {
    let rig = VirtualRig::draw(1);
    let d = mixed_noise(&MixedNoise { duration_s: 120.0, stretch_s: 15.0, region: NoiseRegion::Interior }, 5).unwrap();
    for _ in 0..3 {
        let clock = std::time::Instant::now();
        rig.simulate(&d, 1).unwrap();
        println!("{:.0} simulated s per s", 120.0 / clock.elapsed().as_secs_f64());
    }
    let a = rig.simulate_exact(&d, 8).unwrap();
    let c = rig.simulate_exact(&d, 64).unwrap();
    for n in [4, 6, 8, 12, 16, 32] {
        let b = rig.simulate_exact(&d, n).unwrap();
        println!("{n} {:?}", (0..6).map(|r| fit::rms_error(&b[r], &c[r])).collect::<Vec<_>>());
    }
    println!("{}", a.len());
}
