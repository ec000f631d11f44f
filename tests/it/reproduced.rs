//! The paper's Table 1 on small simulated sets: what the named configurations fulfil, and where what is printed, read by the
//! letter, misses it.

use ndarray::{Array2, Array3};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use shearq_dataset::threads::Quiet;
use shearq_measure::{FunctionalPsf, Measurer, Psfs, Shear};
use shearq_pipeline::run::{measurers, run_set};
use shearq_pipeline::simulate::simulator;
use shearq_results::catalogues::OWN;
use shearq_scoring::{Metrics, Options, SetImages, SetScorer};
use shearq_simulate::kinds::shares;
use shearq_simulate::render::RenderScratch;
use shearq_simulate::set::{FixedPsf, PsfField, STAMP, SimulationSettings};
use shearq_submissions::{PsfForm, Registry};

use crate::support::shearq;

/// A set of each kind.
const KINDS: [u32; 10] = [2, 5, 8, 11, 14, 16, 18, 20, 22, 24];

/// Ellipticities of the galaxies of an image: the true ones, then those of each measurer, NaN if flagged.
fn ellipticities(
    set: u32,
    settings: SimulationSettings,
    measurers: &[Measurer],
) -> Vec<Vec<[f64; 2]>> {
    let simulator = simulator(set, settings).unwrap();
    let mut found = Vec::new();
    run_set(&simulator, &[1], measurers, 2, &mut Quiet, |image, _| {
        found.push(image.observed.iter().map(|e| [e.e1, e.e2]).collect());
        for batch in image.batches {
            found.push(batch.galaxies.iter().map(|e| [e.e1, e.e2]).collect());
        }
        Ok(())
    })
    .unwrap();
    found
}

/// The mean response of each measurer to a shear of either sign, with the galaxies turned by 90 degrees or not, so that
/// intrinsic shapes cancel.
fn responses(set: u32, grid: usize, measurers: &[Measurer]) -> Vec<[f64; 2]> {
    const SHEAR: f64 = 0.02;
    let versions = [
        (SHEAR, false),
        (SHEAR, true),
        (-SHEAR, false),
        (-SHEAR, true),
    ];
    let versions = versions.map(|(g, rotated)| {
        let settings = SimulationSettings {
            constant_shear: Some([g, g]),
            rotated,
            ..SimulationSettings::new(7, grid)
        };
        ellipticities(set, settings, measurers)
    });
    let of_measurer = |place: usize| {
        [0, 1].map(|k| {
            let [a, b, c, d] = [0, 1, 2, 3].map(|v| versions[v][place].iter().map(|e| e[k]));
            let galaxies = a.zip(b).zip(c).zip(d);
            let each = galaxies.map(|(((a, b), c), d)| (a + b - c - d) / (4.0 * SHEAR));
            let good: Vec<f64> = each.filter(|response| response.is_finite()).collect();
            good.iter().sum::<f64>() / good.len() as f64
        })
    };
    (1..=measurers.len()).map(of_measurer).collect()
}

/// The variance of a component of each measurer about its regression on the true ellipticity.
fn residual_variances(set: u32, grid: usize, measurers: &[Measurer]) -> Vec<f64> {
    let found = ellipticities(set, SimulationSettings::new(6, grid), measurers);
    let of_measurer = |own: &Vec<[f64; 2]>| {
        let variances = [0, 1].map(|k| {
            let pairs = found[0].iter().zip(own).map(|(t, e)| [t[k], e[k]]);
            let pairs: Vec<[f64; 2]> = pairs.filter(|pair| pair[1].is_finite()).collect();
            let n = pairs.len() as f64;
            let [t, e] = [0, 1].map(|i| pairs.iter().map(|pair| pair[i]).sum::<f64>() / n);
            let mean = |i: usize, j: usize| {
                let products = pairs.iter().map(|pair| {
                    let off = [pair[0] - t, pair[1] - e];
                    off[i] * off[j]
                });
                products.sum::<f64>() / n
            };
            mean(1, 1) - mean(0, 1).powi(2) / mean(0, 0)
        });
        (variances[0] + variances[1]) / 2.0
    };
    found[1..].iter().map(of_measurer).collect()
}

/// Metrics of 200 images of 100 × 100 galaxies whose ellipticities follow the set's own shear with this response, scatter
/// with this variance, and have this part of the ellipticity of the set's PSF field, the same in all images.
fn at_full_size(set: u32, response: [f64; 2], variance: f64, leakage: f64) -> Metrics {
    let simulator = simulator(set, SimulationSettings::new(15, 100)).unwrap();
    let grid = simulator.grid();
    let psfs = simulator.image_fields(1).psf;
    // Eight sums of 25 images each: their noise is white, and the mean is what counts.
    let (groups, sigma) = (8, (variance / 25.0).sqrt());
    let images: Vec<[Array2<f64>; 2]> = (0..groups)
        .map(|group| {
            // The same noise for all configurations.
            let mut rng = ChaCha8Rng::seed_from_u64(u64::from(100 * set) + group);
            let mut draw = |k: usize| {
                Array2::from_shape_fn((grid.n, grid.n), |(ix, iy)| {
                    let (shear, psf) = (simulator.shear_at(ix, iy), psfs.at(ix, iy).shape);
                    let noise: f64 = StandardNormal.sample(&mut rng);
                    let leaked = leakage * [psf.e1, psf.e2][k];
                    response[k] * [shear.e1, shear.e2][k] + leaked + sigma * noise
                })
            };
            [draw(0), draw(1)]
        })
        .collect();
    let views = images.iter().map(|[e1, e2]| [e1.view(), e2.view()]);
    let images = SetImages::of_arrays(&grid, views).unwrap();
    let options = Options {
        choice: OWN,
        ..Options::default()
    };
    let scorer = SetScorer::new(grid, simulator.truth(), options).unwrap();
    scorer.score(&images).unwrap().metrics
}

/// Mean over the 24 sets of Q, M/2 and √A at full size of each configuration, from `grid`² galaxies of each kind for the
/// response, drawn four times each, and twice as many for the scatter: without leakage of the PSF, and with that of fiducial galaxies.
fn table_one(names: &[&str], grid: usize) -> Vec<[[f64; 3]; 2]> {
    let registry = Registry::embedded().unwrap();
    let configuration = |name: &&str| registry.get(name).unwrap().configuration;
    let configurations: Vec<_> = names.iter().map(configuration).collect();
    let measurers = measurers(&configurations).unwrap();
    let mut means = vec![[[0.0; 3]; 2]; names.len()];
    let leakages = leakages(grid, &measurers);
    for (set, share) in KINDS.into_iter().zip(shares(&KINDS)) {
        let responses = responses(set, grid, &measurers);
        let variances = residual_variances(set, grid * 7 / 5, &measurers);
        for (place, (response, variance)) in responses.into_iter().zip(variances).enumerate() {
            let [leakage, _] = leakages[place][0];
            for (mean, leakage) in means[place].iter_mut().zip([0.0, leakage]) {
                let metrics = at_full_size(set, response, variance, leakage);
                let found = [metrics.q, metrics.m_half, metrics.sqrt_a];
                let name = names[place];
                eprintln!("{name} {set:02}: a {leakage:.3} Q, M/2, √A {found:.4?} R {response:?}");
                for (mean, value) in mean.iter_mut().zip(found) {
                    *mean += share * value;
                }
            }
        }
    }
    means
}

#[test]
fn table_one_comes_out_at_full_size() {
    // 400 galaxies drawn four times tell the response of a kind of set to 1 to 2 %, at S/N 10 to 5 %, and 784 the
    // variance to 5 %: the means over ten kinds are good to 4 % in Q, which goes as the variance, and to 0.01 in M/2.
    // Galaxies and noise are the same for raw and denoised, whose ratio is good to 1 %. Two of these errors beside the
    // bounds of full size: 15 % of the published Q, 0.05 of M/2, 3 to 15 % for denoising. What is printed is four times
    // as far off in Q and eight in M/2.
    let names = [
        "23/raw/star",
        "23/den/star",
        "as-printed/23/raw/star",
        "as-printed/23/den/star",
    ];
    let found = table_one(&names, 20);
    for (name, found) in names.iter().zip(&found) {
        eprintln!("{name}: Q, M/2, √A without and with leakage {found:.4?}");
    }
    let fulfils = |[raw, _]: [[f64; 3]; 2], [den, _]: [[f64; 3]; 2]| {
        let near = |q: f64, published: f64| (q / published - 1.0).abs() < 0.15 + 2.0 * 0.04;
        let unbiased = |m_half: f64| m_half.abs() < 0.05 + 2.0 * 0.01;
        let over = den[0] / raw[0];
        [
            near(raw[0], 80.33),
            near(den[0], 87.06),
            unbiased(raw[1]),
            unbiased(den[1]),
            over > 1.03 - 2.0 * 0.01 && over < 1.15 + 2.0 * 0.01,
        ]
    };
    assert_eq!(fulfils(found[0], found[1]), [true; 5]);
    // What is printed misses every one of these.
    assert_eq!(fulfils(found[2], found[3]), [false; 5]);
    // Leakage has its power at low ℓ, as the shear has, and raises M/2 by a² over the powers' ratio; the noise is the same.
    for [without, with] in &found[..2] {
        let raised = with[1] - without[1];
        assert!(
            with[0] < without[0] && (0.02..0.12).contains(&raised),
            "{without:?} {with:?}"
        );
    }
}

/// e of each measurer on fiducial galaxies behind a PSF of ε₁ = `psf_e1`.
fn behind(psf_e1: f64, grid: usize, measurers: &[Measurer]) -> Vec<Vec<[f64; 2]>> {
    let settings = SimulationSettings {
        fixed_psf: FixedPsf::One,
        ..SimulationSettings::new(9, grid)
    };
    let simulator = simulator(2, settings).unwrap();
    let mut fields = simulator.image_fields(1);
    let psf = FunctionalPsf {
        shape: Shear::new(psf_e1, 0.0),
        ..*fields.psf.at(0, 0)
    };
    fields.psf = PsfField::One(psf);
    let mut stamps = Array3::zeros((grid * grid, STAMP, STAMP));
    let mut scratch = RenderScratch::new();
    for (k, mut stamp) in stamps.outer_iter_mut().enumerate() {
        let pixels = stamp.as_slice_mut().unwrap();
        simulator.draw(&fields, k % grid, k / grid, &mut scratch, pixels);
    }
    let star = psf.stamp(STAMP);
    let found = measurers.iter().map(|measurer| {
        let psfs = match measurer.configuration().psf.form {
            PsfForm::Star => Psfs::star(star.view()),
            PsfForm::Functional => Psfs::functional(vec![psf; grid * grid]),
        };
        let batch = measurer.batch(stamps.view(), &psfs, None).unwrap();
        let galaxies = batch.galaxies.iter();
        galaxies.map(|galaxy| [galaxy.e1, galaxy.e2]).collect()
    });
    let found: Vec<_> = found.collect();
    let shapes = fields.intrinsic.t();
    let shapes = shapes.iter().map(|e| [e.re, e.im]).collect();
    std::iter::once(shapes).chain(found).collect()
}

/// Slope and its standard error of a regression through the mean.
fn slope(pairs: &[[f64; 2]]) -> [f64; 2] {
    let n = pairs.len() as f64;
    let mean = [0, 1].map(|k| pairs.iter().map(|pair| pair[k]).sum::<f64>() / n);
    let off = pairs
        .iter()
        .map(|pair| [pair[0] - mean[0], pair[1] - mean[1]]);
    let [xx, xy] = off
        .clone()
        .fold([0.0; 2], |[xx, xy], [x, y]| [xx + x * x, xy + x * y]);
    let slope = xy / xx;
    let rest = off.map(|[x, y]| (y - slope * x).powi(2)).sum::<f64>() / n;
    [slope, (rest / xx).sqrt()]
}

/// a and s of each measurer in e = a ε_PSF + s ε of fiducial galaxies, with their standard errors; ε is the shear-type ellipticity
/// of the galaxy before the PSF.
fn leakages(grid: usize, measurers: &[Measurer]) -> Vec<[[f64; 2]; 2]> {
    const PSF_E1: f64 = 0.05;
    let [plus, minus] = [PSF_E1, -PSF_E1].map(|e1| behind(e1, grid, measurers));
    let truth = &plus[0];
    let of_measurer = |(plus, minus): (&Vec<[f64; 2]>, &Vec<[f64; 2]>)| {
        let pairs = plus.iter().zip(minus).zip(truth);
        let is_good = |((p, m), _): &((&[f64; 2], &[f64; 2]), &[f64; 2])| {
            p[0].is_finite() && m[0].is_finite()
        };
        let good: Vec<_> = pairs.filter(is_good).collect();
        let n = good.len() as f64;
        let leaks = good
            .iter()
            .map(|((p, m), _)| (p[0] - m[0]) / (2.0 * PSF_E1));
        let a = leaks.clone().sum::<f64>() / n;
        let a_error = leaks.map(|leak| (leak - a).powi(2)).sum::<f64>().sqrt() / n;
        let shapes = good
            .iter()
            .flat_map(|((p, _), e)| [0, 1].map(|k| [e[k], p[k]]));
        [[a, a_error], slope(&shapes.collect::<Vec<_>>())]
    };
    plus[1..].iter().zip(&minus[1..]).map(of_measurer).collect()
}

#[test]
fn the_network_leaks_the_ellipticity_of_the_psf() {
    let names = [
        "subm/19/den/star",
        "23/den/func",
        "23/den/star",
        "23/raw/func",
        "23/raw/star",
        "29/den/func",
        "as-printed/23/raw/star",
    ];
    let registry = Registry::embedded().unwrap();
    let configuration = |name: &&str| registry.get(name).unwrap().configuration;
    let configurations: Vec<_> = names.iter().map(configuration).collect();
    // For the numbers of docs/reproduction.md: 100.
    let grid = std::env::var("SHEARQ_LEAKAGE_GRID").map_or(30, |side| side.parse().unwrap());
    let found = leakages(grid, &measurers(&configurations).unwrap());
    for (name, [[a, a_error], [s, s_error]]) in names.iter().zip(found) {
        eprintln!("{name}: a = {a:.4} ± {a_error:.4}, s = {s:.4} ± {s_error:.4}");
        assert!(a > 3.0 * a_error && a < 0.3, "{name}: {a} ± {a_error}");
        assert!((0.3..1.3).contains(&s), "{name}: {s} ± {s_error}");
    }
}

#[test]
fn named_configurations_keep_their_baselines() {
    for name in ["named", "linear", "printed"] {
        let folder = "submissions/baselines";
        let output = shearq(&["baseline", "check", name, "--folder", folder]);
        let [found, said] = [output.stdout, output.stderr].map(String::from_utf8);
        assert!(output.status.success(), "{found:?} {said:?}");
    }
}
