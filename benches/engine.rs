//! Single computations of the engine, measured one by one: `cargo bench --bench engine`.

use std::slice::from_ref;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use rigcast::engine::checkpoint::NoCheckpoints;
use rigcast::engine::fatigue::{DamageSettings, multi_rain};
use rigcast::engine::frf::estimate;
use rigcast::engine::lstm::{Recombine, Until, predict, train};
use rigcast::engine::progress::unwatched;

#[path = "../examples/speed/works.rs"]
mod works;

use works::{FS, HOP, WINDOW};

/// Prediction; elements are samples of signal.
fn infer(c: &mut Criterion) {
    let (net, all) = (works::net(), works::net_input(600));
    let mut group = c.benchmark_group("infer");
    group.sample_size(20);
    for seconds in [10, 60, 600] {
        let x: Vec<Vec<f32>> = all.iter().map(|x| x[..seconds * FS].to_vec()).collect();
        group.throughput(Throughput::Elements((seconds * FS) as u64));
        group.bench_function(format!("{seconds}s"), |b| {
            b.iter(|| predict(&net, &x, WINDOW, HOP, Recombine::Welch).expect("the input suits the network"));
        });
    }
}

/// One epoch over ten minutes; elements are windows.
fn training(c: &mut Criterion) {
    let (stretch, validation) = works::training();
    let windows = (stretch.x[0].len() - WINDOW) / HOP + 1;
    let mut group = c.benchmark_group("train_epoch");
    group.sample_size(10).throughput(Throughput::Elements(windows as u64));
    for batch_size in [32, 128, 512] {
        let settings = works::training_settings(batch_size, 1);
        group.bench_function(format!("b{batch_size}"), |b| {
            b.iter(|| {
                train(
                    from_ref(&stretch),
                    Until::Best(from_ref(&validation)),
                    &works::net(),
                    (&settings, 1),
                    (&NoCheckpoints, ""),
                    &unwatched,
                )
                .expect("the data suit the network")
            });
        });
    }
}

fn frf(c: &mut Criterion) {
    let mut group = c.benchmark_group("frf");
    group.sample_size(10);
    let (x, y) = (works::drives(1800).expect("finite"), works::responses(1800).expect("finite"));
    let once = || estimate(&[(&x, &y)], &works::frf_settings(), &unwatched).expect("long enough");
    group.bench_function("h1_30min", |b| b.iter(once));
    let (filter, drive) = (once().frf.filter().expect("a whole FRF"), works::drives(600).expect("finite"));
    group.bench_function("apply_10min", |b| b.iter(|| filter.apply(&drive).expect("three drives")));
}

fn rainflow(c: &mut Criterion) {
    let [x, y, z] = &works::group();
    let mut group = c.benchmark_group("multirain");
    group.sample_size(10);
    group.bench_function("500x600s", |b| {
        b.iter(|| multi_rain([x, y, z], &DamageSettings::default()).expect("finite"));
    });
}

criterion_group!(benches, infer, training, frf, rainflow);
criterion_main!(benches);
