//! Images that follow the true shear differently from the others of their set.
use ndarray::Array2;
use shearq_quantities::fourier::Complex64;
use shearq_scoring::{
    AddedImages, Choice, Convention, Definition, Fault, FieldSum, Grid, OddResponse, Options,
    ScoredImages, SetScorer, SetSession, TrueShear,
};

use crate::common::{Content, Normal, field, rows, sum_of, truth};

const N: usize = 24;

fn grid() -> Grid {
    Grid::great10(N).unwrap()
}

/// Images of `shear` with `noise` per component; 0.01 is an error of the slope of 0.14.
fn noisy(shear: &Array2<Complex64>, count: usize, noise: f64, seed: u64) -> Vec<Array2<Complex64>> {
    let mut normal = Normal(seed);
    let image = |_| shear.mapv(|g| g + noise * Complex64::new(normal.draw(), normal.draw()));
    (0..count).map(image).collect()
}

fn odd(truth: TrueShear, images: &[Array2<Complex64>]) -> Vec<OddResponse> {
    let standard = Choice::Insist(Convention::STANDARD);
    of_set(truth, images, standard, |added| {
        added.odd(Convention::STANDARD).responses
    })
}

/// The cells in another order.
fn permuted(image: &Array2<Complex64>) -> Array2<Complex64> {
    let turned = |(ix, iy): (usize, usize)| image[((7 * ix + 3) % N, (11 * iy + ix) % N)];
    Array2::from_shape_fn((N, N), turned)
}

#[test]
fn response_is_the_slope_with_its_error() {
    // Without noise, a response of 0.8 is found exactly; with it, the scatter over 200 images is the mean error.
    let shear = field(&grid(), Content::E, 3);
    let scorer = SetScorer::new(grid(), truth(&shear), Options::default()).unwrap();
    let of = |image: &Array2<Complex64>| {
        let (sum, _) = sum_of(&grid(), &rows(&grid(), image));
        scorer.response(&sum, Convention::STANDARD).unwrap()
    };
    let exact = of(&shear.mapv(|g| 0.8 * g));
    assert!((exact.slope - 0.8).abs() < 1e-12 && exact.error < 1e-9);
    assert!((exact.correlation - 1.0).abs() < 1e-12);
    let all: Vec<_> = noisy(&shear, 200, 0.05, 5).iter().map(of).collect();
    let mean = |value: &dyn Fn(usize) -> f64| (0..200).map(value).sum::<f64>() / 200.0;
    let slope = mean(&|k| all[k].slope);
    let scatter = mean(&|k| (all[k].slope - slope).powi(2)).sqrt();
    let error = mean(&|k| all[k].error);
    assert!(
        (slope - 1.0).abs() < 4.0 * scatter / 200_f64.sqrt(),
        "{slope}"
    );
    // 200 images determine a scatter to 5 %; the larger of two estimates is some percent too large.
    assert!(
        (0.9..1.35).contains(&(error / scatter)),
        "{error} {scatter}"
    );
}

#[test]
fn one_wrong_image_of_several_is_named() {
    let shear = field(&grid(), Content::E, 3);
    let other = field(&grid(), Content::E, 4);
    for count in [2, 3, 4, 9] {
        let good = noisy(&shear, count, 0.004, 11);
        for (fault, what) in [
            (good[1].t().to_owned(), "x and y exchanged"),
            (permuted(&good[1]), "permuted"),
            (good[1].mapv(|e| 2.0 * e), "doubled"),
            (good[1].mapv(|e| -e), "flipped"),
            (good[1].mapv(|e| e.conj()), "e2 flipped"),
            (noisy(&other, 1, 0.004, 12).remove(0), "another set"),
        ] {
            let mut images = good.clone();
            images[1] = fault;
            let found = odd(truth(&shear), &images);
            let places: Vec<usize> = found.iter().map(|odd| odd.place).collect();
            assert_eq!(places, [1], "{what} of {count}: {found:?}");
        }
    }
}

#[test]
fn honest_images_are_not_named() {
    // 600 sets of few images with shapes as noise, also in images of different noise and response: the chance of a false
    // alarm is at most 10⁻³ per set.
    let shear = field(&grid(), Content::E, 3);
    let mut alarms = 0;
    for seed in 0..600 {
        let mut images = noisy(&shear, 2 + seed % 5, 0.02, 1000 + seed as u64);
        images[0].mapv_inplace(|e| 1.2 * e);
        alarms += odd(truth(&shear), &images).len();
    }
    assert!(alarms <= 2, "{alarms}");
}

#[test]
fn constant_shear_shows_flipped_and_doubled_images() {
    let shear = Array2::from_elem((N, N), Complex64::new(0.03, -0.02));
    let good = noisy(&shear, 4, 0.05, 21);
    assert!(odd(truth(&shear), &good).is_empty());
    for factor in [-1.0, 2.0] {
        let mut images = good.clone();
        images[2].mapv_inplace(|e| factor * e);
        let places: Vec<usize> = odd(truth(&shear), &images)
            .iter()
            .map(|odd| odd.place)
            .collect();
        assert_eq!(places, [2]);
    }
}

#[test]
fn images_with_gaps_have_the_response_of_their_galaxies() {
    let shear = field(&grid(), Content::E, 3);
    let scorer = SetScorer::new(grid(), truth(&shear), Options::default()).unwrap();
    let all = rows(&grid(), &shear);
    let half: Vec<_> = all.into_iter().filter(|row| row.x < 600.0).collect();
    let response = scorer
        .response(&sum_of(&grid(), &half).0, Convention::STANDARD)
        .unwrap();
    assert!((response.slope - 1.0).abs() < 1e-12, "{response:?}");
    let blank = FieldSum {
        images: 1,
        ..FieldSum::new(&grid())
    };
    assert_eq!(scorer.response(&blank, Convention::STANDARD), None);
}

/// What `read` finds in a set of images.
fn of_set<T>(
    truth: TrueShear,
    images: &[Array2<Complex64>],
    choice: Choice,
    read: impl FnOnce(&AddedImages<'_>) -> T,
) -> T {
    let options = Options {
        choice,
        ..Options::default()
    };
    let session = SetSession::new(grid(), Some(truth), options).unwrap();
    let mut added = session.begin();
    for image in images {
        let (sum, counts) = sum_of(&grid(), &rows(&grid(), image));
        added.add(&session.examine(sum, counts).unwrap()).unwrap();
    }
    read(&added)
}

fn scored(truth: TrueShear, images: &[Array2<Complex64>], choice: Choice) -> ScoredImages {
    of_set(truth, images, choice, |added| added.finish().unwrap())
}

#[test]
fn odd_images_are_sought_in_the_matched_convention() {
    // All images have the other sign of e2, and one has not.
    let shear = field(&grid(), Content::E, 3);
    let mut images = noisy(&shear, 6, 0.01, 5);
    images
        .iter_mut()
        .skip(1)
        .for_each(|image| image.mapv_inplace(|e| e.conj()));
    for choice in [Choice::Matched, Choice::Best] {
        let found = scored(truth(&shear), &images, choice);
        let places: Vec<usize> = found.odd.responses.iter().map(|own| own.place).collect();
        assert_eq!(places, [0], "{choice}");
    }
}

#[test]
fn odd_images_explain_faults_of_the_set() {
    let shear = field(&grid(), Content::E, 3);
    let standard = Choice::Insist(Convention::STANDARD);
    let is_biased = |fault: &Fault| matches!(fault, Fault::Biased { .. });
    // Half of the response is missing, in all images or because half of them have one value.
    let half: Vec<_> = noisy(&shear, 6, 0.01, 5)
        .iter()
        .map(|e| e.mapv(|e| 0.5 * e))
        .collect();
    let found = scored(truth(&shear), &half, standard);
    assert!(found.findings.iter().any(is_biased), "{:?}", found.findings);
    let mut constant = noisy(&shear, 6, 0.01, 5);
    constant[..3]
        .iter_mut()
        .for_each(|image| image.fill(Complex64::new(0.1, 0.2)));
    let found = scored(truth(&shear), &constant, standard);
    assert_eq!((found.odd.repeated.len(), found.findings), (3, vec![]));
    // Noise that all images share looks like faults of the order, unless they are copies.
    let noise = noisy(&Array2::zeros((N, N)), 1, 0.05, 7);
    let copies = vec![noise[0].clone(); 6];
    let found = scored(truth(&shear), &copies, standard);
    assert_eq!((found.odd.copies.len(), found.findings), (5, vec![]));
    let others = noisy(&noise[0], 6, 0.001, 8);
    let found = scored(truth(&shear), &others, standard);
    assert!(
        matches!(found.findings[..], [Fault::Uncorrelated { .. }]),
        "{:?}",
        found.findings
    );
}

/// What is found in images whose galaxies have weights, 0 for a galaxy that is missing.
fn of_weighted(
    shear: &Array2<Complex64>,
    weight: impl Fn(usize, usize) -> f64,
    definition: Definition,
) -> ScoredImages {
    let options = Options {
        choice: Choice::Insist(Convention::STANDARD),
        definition,
        ..Options::default()
    };
    let session = SetSession::new(grid(), Some(truth(shear)), options).unwrap();
    let mut added = session.begin();
    for (number, image) in noisy(shear, 6, 0.004, 11).iter().enumerate() {
        let mut sum = FieldSum::new(&grid());
        let rows = rows(&grid(), image).into_iter().enumerate();
        let rows = rows.map(|(galaxy, row)| (row, weight(number, galaxy)));
        let counts = sum.add_weighted(&grid(), rows.filter(|(_, weight)| *weight > 0.0));
        added.add(&session.examine(sum, counts).unwrap()).unwrap();
    }
    added.finish().unwrap()
}

#[test]
fn weights_are_no_fault_of_the_order() {
    let shear = field(&grid(), Content::E, 3);
    // An image of a quarter of the weight of the others, and galaxies whose weights scatter by a factor of ten.
    let of_images = |number: usize, _| [0.3, 1.14][usize::from(number > 0)];
    let of_galaxies = |_, galaxy: usize| [0.1, 0.2, 0.3, 3.4][(7 * galaxy + galaxy / 5) % 4];
    let found = of_weighted(&shear, of_images, Definition::Leaderboard);
    assert!(found.odd.responses.is_empty(), "{:?}", found.odd);
    let found = of_weighted(&shear, of_galaxies, Definition::Leaderboard);
    let is_uncorrelated = |fault: &Fault| matches!(fault, Fault::Uncorrelated { .. });
    assert!(
        !found.findings.iter().any(is_uncorrelated),
        "{:?}",
        found.findings
    );
}

#[test]
fn missing_galaxies_explain_a_low_response() {
    let shear = field(&grid(), Content::E, 3);
    let half = |number, galaxy| f64::from(u8::from((number + galaxy) % 2 == 0));
    let found = of_weighted(&shear, half, Definition::Leaderboard);
    let [Fault::Biased { m, missing, .. }] = found.findings[..] else {
        panic!("{:?}", found.findings);
    };
    assert!(
        (m + 0.5).abs() < 0.05 && (missing - 0.5).abs() < 1e-12,
        "{m} {missing}"
    );
    let found = of_weighted(&shear, half, Definition::Corrected);
    assert_eq!(found.findings, []);
}
