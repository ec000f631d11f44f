//! The paper's statements on small simulated sets: those that the named configurations fulfil, and where what is
//! printed, read by the letter, misses them.

use ndarray::Array2;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use shearq_dataset::threads::Quiet;
use shearq_pipeline::run::measurers;
use shearq_pipeline::simulate::simulator;
use shearq_results::catalogues::OWN;
use shearq_scoring::{Metrics, Options, SetImages, SetScorer};
use shearq_simulate::kinds::shares;
use shearq_simulate::set::SimulationSettings;
use shearq_studies::bias::biases;
use shearq_studies::calibration::{Curves, LOG_LAMBDA, LambdaSums, PAPER_LAMBDA, calibrate};
use shearq_studies::reproduce::{Plan, Study, run_sets};
use shearq_submissions::{Configuration, Registry};

use crate::support::shearq;

/// A set of each kind.
const KINDS: [u32; 10] = [2, 5, 8, 11, 14, 16, 18, 20, 22, 24];

fn configurations(names: &[&str]) -> Vec<Configuration> {
    let registry = Registry::embedded().unwrap();
    names
        .iter()
        .map(|name| registry.get(name).unwrap().configuration)
        .collect()
}

/// How a submission's ellipticities follow shear on one kind of set.
#[derive(Debug, Clone, Copy)]
struct Follows {
    response: [f64; 2],
    variance: f64,
}

/// Figures of 200 images of 100 × 100 galaxies that answer the set's own shear so, and scatter so.
fn at_full_size(set: u32, follows: &Follows) -> Metrics {
    let simulator = simulator(set, SimulationSettings::new(15, 100)).unwrap();
    let grid = simulator.grid();
    // Eight sums of 25 images each: their noise is white, and the mean is what counts.
    let (groups, sigma) = (8, (follows.variance / 25.0).sqrt());
    let images: Vec<[Array2<f64>; 2]> = (0..groups)
        .map(|group| {
            // The same noise for all configurations.
            let mut rng = ChaCha8Rng::seed_from_u64(u64::from(100 * set) + group);
            let mut draw = |k: usize| {
                Array2::from_shape_fn((grid.n, grid.n), |(ix, iy)| {
                    let shear = simulator.shear_at(ix, iy);
                    let noise: f64 = StandardNormal.sample(&mut rng);
                    follows.response[k] * [shear.e1, shear.e2][k] + sigma * noise
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

/// Mean over the 24 sets of Q and M/2 at full size of each submission, from `grid`² galaxies of each kind for the
/// response, drawn eight times each, and four times as many for the scatter.
fn table_one(names: &[&str], grid: usize) -> Vec<[f64; 2]> {
    let plan = Plan {
        version: "test".into(),
        simulation: SimulationSettings::new(6, 2 * grid),
        images: 1,
        configurations: configurations(names),
    };
    let folder = tempfile::tempdir().unwrap();
    let study = Study::open(&plan, folder.path()).unwrap();
    let measurers = measurers(&plan.configurations).unwrap();
    let mut means = vec![[0.0; 2]; names.len()];
    for (set, share) in KINDS.into_iter().zip(shares(&KINDS)) {
        let results = run_sets(&study, &[set], 2, &mut Quiet).unwrap();
        let paired = simulator(set, SimulationSettings::new(7, grid)).unwrap();
        let paired = biases(&paired, &[1], &measurers, 2, &mut Quiet).unwrap();
        for (k, mean) in means.iter_mut().enumerate() {
            let single = results[0].results[k].response;
            let scatter = single.scatter.map(|s| s * s);
            // The scatter is told after dividing by the slope.
            let variance = |c: usize| scatter[c] * single.slope[c] * single.slope[c];
            let follows = Follows {
                response: paired[k].m.map(|m| 1.0 + m),
                variance: (variance(0) + variance(1)) / 2.0,
            };
            let figures = at_full_size(set, &follows);
            mean[0] += share * figures.q;
            mean[1] += share * figures.m_half;
        }
    }
    means
}

#[test]
fn table_one_comes_out_at_full_size() {
    // 196 galaxies drawn eight times tell the response of a kind of set to 1 to 2 %, at S/N 10 to 5 %, and 784 the
    // variance to 5 %: the means over ten kinds are good to 4 % in Q, which goes as the variance, and to 0.01 in M/2.
    // Galaxies and noise are the same for raw and denoised, whose ratio is good to 1 %. Two of these errors beside the
    // bounds of full size: 15 % of the published Q, 0.05 of M/2, 3 to 15 % for denoising. What is printed is four times
    // as far off in Q and eight in M/2.
    let found = table_one(
        &[
            "23/raw/star",
            "23/den/star",
            "as-printed/23/raw/star",
            "as-printed/23/den/star",
        ],
        14,
    );
    eprintln!("Q and M/2: {found:?}");
    let fulfils = |raw: [f64; 2], den: [f64; 2]| {
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
}

#[test]
fn updates_compare_as_the_paper_found() {
    let of = |name: &str| {
        // CTR rests on 10⁴ transitions a galaxy; 1/RMSD of both rules on the same galaxies.
        let submission = &configurations(&[name])[0];
        calibrate(submission, 40, 3, 2, &mut Quiet).unwrap()
    };
    let (adopted, printed) = (of("paper"), of("as-printed/paper"));
    let [weak, strong] = [PAPER_LAMBDA, LOG_LAMBDA.len() - 1];
    // CTR is highest at λ = 10^−3.5 at each S/N, but not as printed.
    let ctr_is_highest = |curve: &Vec<LambdaSums>| {
        let ctr = |k: usize| curve[k].ctr().0;
        (0..curve.len()).all(|k| LOG_LAMBDA[k] == -3.5 || ctr(k) < ctr(weak + 1))
    };
    assert!(adopted.over_lambda[0].iter().all(ctr_is_highest));
    assert!(!printed.over_lambda[0].iter().all(ctr_is_highest));
    // 1/RMSD of the adaptive update is the better one for λ ≤ 10⁻⁴, whatever the S/N.
    for curves in [&adopted, &printed] {
        let [adaptive, constant] = [&curves.over_lambda[0], &curves.over_lambda[1]];
        for (adaptive, constant) in adaptive.iter().zip(constant) {
            for k in 0..=weak {
                assert!(adaptive[k].inverse_rmsd().0 >= constant[k].inverse_rmsd().0);
            }
        }
    }
    // As printed, the adaptive update has the higher CTR at each S/N, and dSNR rises with S/N and decreases with λ.
    let [adaptive, constant] = [&printed.over_snr[0], &printed.over_snr[1]];
    for (adaptive, constant) in adaptive.iter().zip(constant) {
        assert!(adaptive.ctr().0 > constant.ctr().0);
    }
    let dsnr = |k: usize| {
        printed.over_lambda[0]
            .iter()
            .map(move |c| c[k].mean_dsnr().0)
    };
    assert!(dsnr(weak).is_sorted_by(|a, b| a < b));
    assert!(
        dsnr(strong)
            .zip(dsnr(weak))
            .all(|(strong, weak)| strong < weak)
    );
    for curve in &adopted.over_lambda[0] {
        // By two decibels and more, each known to a few tenths.
        assert!(curve[strong].mean_dsnr().0 < curve[weak].mean_dsnr().0 - 1.0);
    }
    // The mean over S/N; λ has steps of half a decade.
    let highest = |curves: &Curves| {
        let mean = |k: usize| {
            curves.over_lambda[0]
                .iter()
                .map(|c| c[k].ctr().0)
                .sum::<f64>()
        };
        let best = (0..LOG_LAMBDA.len()).max_by(|a, b| mean(*a).total_cmp(&mean(*b)));
        LOG_LAMBDA[best.unwrap()]
    };
    let (adopted, printed) = (highest(&adopted), highest(&printed));
    eprintln!("highest CTR at 10^{adopted}, as printed 10^{printed}");
    assert!((-4.0..=-3.0).contains(&adopted), "10^{adopted}");
    assert!(printed > 0.0, "10^{printed}");
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
