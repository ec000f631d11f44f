//! Kernels by size.

use std::hint::black_box;

use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use shearq::deconvolve::{Network, Rule, Step};
use shearq::pipeline::galaxy::Measurer;
use shearq::pipeline::measure::functional_psf;
use shearq::psf::functional::{FunctionalPsf, PsfProfile};
use shearq::shape::Autocorrelation;
use shearq_benches::{stamp, submission};
use shearq_scoring::Shear;
use shearq_submissions::Start;

fn moffat(size: usize) -> ndarray::Array2<f64> {
    let profile = PsfProfile::Moffat { beta: 3.0 };
    let psf = FunctionalPsf::new(profile, 3.4, Shear::new(0.02, -0.015)).expect("a valid PSF");
    functional_psf(&psf, size)
}

fn network(c: &mut Criterion) {
    let mut group = c.benchmark_group("network_10_iterations");
    for n in [11, 19, 23, 29, 48] {
        let mut network = Network::<f32>::plan(n, 15, 1e-4).expect("a valid size");
        network.set_psf(moffat(15).view()).expect("a valid PSF");
        let rule = Rule {
            step: Step::Adaptive(0.25),
            unit: 1e-3,
            max_iterations: 10,
            start: Start::ClippedData,
        };
        let mut scratch = network.scratch();
        let (data, mut out) = (stamp(n), vec![0.0; n * n]);
        group.bench_function(BenchmarkId::from_parameter(n), |b| {
            b.iter(|| network.deconvolve(&rule, black_box(&data), &mut scratch, &mut out));
        });
    }
    group.finish();
}

fn autocorrelation(c: &mut Criterion) {
    let mut group = c.benchmark_group("autocorrelation");
    for n in [11, 19, 23, 29, 48] {
        let plan = Autocorrelation::new(n);
        let mut scratch = plan.scratch();
        let (data, mut out) = (stamp(n), vec![0.0; plan.len()]);
        group.bench_function(BenchmarkId::from_parameter(n), |b| {
            b.iter(|| plan.compute(black_box(&data), &mut scratch, &mut out));
        });
    }
    group.finish();
}

fn galaxy(c: &mut Criterion) {
    let mut group = c.benchmark_group("galaxy");
    for name in ["23/raw/star", "23/den/star", "29/den/func"] {
        let measurer = Measurer::new(&submission(name), 48).expect("a valid submission");
        let mut scratch = measurer.scratch();
        measurer.set_psf(&mut scratch, Some(moffat(15).view()));
        let data = stamp(48);
        group.bench_function(name, |b| {
            b.iter(|| measurer.measure(black_box(&data), 48, None, &mut scratch));
        });
    }
    group.finish();
}

criterion_group!(benches, network, autocorrelation, galaxy);
criterion_main!(benches);
