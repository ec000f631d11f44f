//! Kernels by size.

use std::hint::black_box;

use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use ndarray::ArrayView2;
use shearq_benches::{configuration, stamp};
use shearq_measure::Measurer;
use shearq_measure::parts::{
    ClippedAcf, HexLattice, Network, RoundMoments, Rule, Spectral, Step, TypicalGalaxy,
    WaveletWiener,
};
use shearq_quantities::Shear;
use shearq_quantities::{FunctionalPsf, PsfProfile};
use shearq_submissions::{Clipping, Kept, Method, PsfScale, Start};

fn moffat(size: usize) -> ndarray::Array2<f64> {
    let profile = PsfProfile::Moffat { beta: 3.0 };
    let psf = FunctionalPsf::new(profile, 3.4, Shear::new(0.02, -0.015)).expect("a valid PSF");
    psf.stamp(size)
}

fn network(c: &mut Criterion) {
    let mut group = c.benchmark_group("network_10_iterations");
    for n in [11, 19, 23, 29, 48] {
        let mut network = Network::plan(n, 15, 1e-4).expect("a valid size");
        let psf = moffat(15);
        network
            .set_psf(psf.view(), PsfScale::Sum)
            .expect("a valid PSF");
        let rule = Rule {
            step: Step::Adaptive(0.25),
            unit: 1e-3,
            max_iterations: 10,
            start: Start::ClippedData,
            clipping: Clipping::BeforeTest,
            kept: Kept::Lowest,
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
    let configuration = configuration("23/raw/star");
    let Method::Network(settings) = &configuration.method else {
        panic!("23/raw/star is a network");
    };
    let mut group = c.benchmark_group("autocorrelation");
    for n in [11, 19, 23, 29, 48] {
        let plan = ClippedAcf::new(n, &settings.shape);
        let (data, mut scratch) = (stamp(n), plan.scratch());
        group.bench_function(BenchmarkId::from_parameter(n), |b| {
            b.iter(|| plan.autocorrelate(black_box(&data), &mut scratch));
        });
    }
    group.finish();
}

fn denoise(c: &mut Criterion) {
    let configuration = configuration("23/den/star");
    let settings = configuration.wavelet().expect("a denoised submission");
    let mut group = c.benchmark_group("denoise");
    for n in [24, 48] {
        let filter = WaveletWiener::new(n, settings);
        let mut scratch = filter.scratch();
        let data = stamp(n);
        let mut work = data.clone();
        group.bench_function(BenchmarkId::from_parameter(n), |b| {
            b.iter(|| {
                work.copy_from_slice(&data);
                filter.apply(black_box(&mut work), 1.0, &mut scratch);
            });
        });
    }
    group.finish();
}

fn linear(c: &mut Criterion) {
    let configuration = configuration("48/linear/star");
    let method = configuration.linear().expect("a linear submission");
    let settings = &method.deconvolution;
    let mut group = c.benchmark_group("linear");
    for n in [32, 40, 48] {
        let plan = Spectral::new(n, n, settings).expect("valid sizes");
        let white = plan.noise(&shearq_measure::StampNoise::white(1.0));
        let (mut psf, mut scratch, mut lags) = (plan.psf(), plan.scratch(), plan.lags());
        let moffat = moffat(n);
        group.bench_function(BenchmarkId::new("take a PSF", n), |b| {
            b.iter(|| plan.set_psf(black_box(moffat.view()), &white, &mut scratch, &mut psf));
        });
        plan.set_psf(moffat.view(), &white, &mut scratch, &mut psf)
            .expect("a valid PSF");
        let data = stamp(n);
        group.bench_function(BenchmarkId::new("autocorrelate", n), |b| {
            b.iter(|| plan.autocorrelate(&psf, black_box(&data), 1.0, &mut scratch, &mut lags));
        });
    }
    let lattice = HexLattice {
        row_spacing: 2.0,
        reach: 10,
    };
    let typical = TypicalGalaxy {
        variance: settings.reference_extent,
        target: settings.target_sigma,
        window: settings.window_sigma,
    };
    let moments = RoundMoments::new(method.shape.weight_scale, typical, lattice);
    let acf: Vec<f32> = lattice
        .places()
        .map(|[x, y]| (-(x * x + y * y + 0.3 * x * y) / 20.0).exp() as f32)
        .collect();
    group.bench_function("round moments", |b| {
        b.iter(|| moments.measure(black_box(&acf), 0.0));
    });
    group.finish();
}

fn galaxy(c: &mut Criterion) {
    let mut group = c.benchmark_group("galaxy");
    for name in [
        "23/raw/star",
        "23/den/star",
        "29/den/func",
        "48/linear/star",
    ] {
        let configuration = configuration(name);
        let measurer = Measurer::new(&configuration, 48).expect("a valid submission");
        let mut worker = measurer.worker();
        let mut image = worker.image(shearq_measure::ImageNoise::Level(1.0));
        let mut worker = image
            .psf(moffat(configuration.psf.size).view())
            .expect("a valid PSF");
        let data = stamp(48);
        let data = ArrayView2::from_shape((48, 48), &data).expect("a full stamp");
        group.bench_function(name, |b| {
            b.iter(|| worker.measure(black_box(data)));
        });
    }
    group.finish();
}

criterion_group!(benches, network, autocorrelation, denoise, linear, galaxy);
criterion_main!(benches);
