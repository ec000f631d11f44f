//! A noisy star for each galaxy, from files and from arrays.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use shearq_measure::ndarray::{Array3, Axis};
use shearq_measure::{ArraySource, KnownNoise, Measurer, OneThread, Pixels, Psfs, Session};

use crate::support::{Small, fits_image, floats, pixels_of, succeed, text};

/// Stamps in a row of the images: more stamps than are surveyed.
const COLUMNS: usize = 34;

#[test]
fn files_and_arrays_with_a_noisy_star_per_galaxy_give_the_same() {
    let small = Small::new("2");
    let (star, side) = pixels_of(&small.at("data/set02/psf-001.fits"));
    let n = COLUMNS;
    std::fs::remove_file(small.at("data/set02/galaxies-002.fits")).unwrap();
    let sigma = star.iter().map(|v| v * v).sum::<f32>().sqrt() / 200.0;
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    // Broad wings, which the fit of single stars misses.
    let middle = (side as f32 - 1.0) / 2.0;
    let total: f32 = star.iter().sum();
    let mosaic: Vec<f32> = (0..n * side * n * side)
        .map(|at| {
            let (x, y) = (at % (n * side) % side, at / (n * side) % side);
            let square = (x as f32 - middle).powi(2) + (y as f32 - middle).powi(2);
            let wing = 0.1 * total / 800.0 * (-square / 255.0).exp();
            let noise: f32 = StandardNormal.sample(&mut rng);
            star[y * side + x] + wing + sigma * noise
        })
        .collect();
    let card = format!("STAMP   = {side:>20}");
    let file = fits_image(-32, &[n * side, n * side], &[&card], &floats(&mosaic));
    std::fs::write(small.at("data/set02/psf-001.fits"), file).unwrap();
    // The stamps of a small image again and again.
    let (pixels, width) = pixels_of(&small.at("data/set02/galaxies-001.fits"));
    let full = width / 8;
    let tiled: Vec<f32> = (0..n * full * n * full)
        .map(|at| {
            let (x, y) = (at % (n * full) % width, at / (n * full) % width);
            pixels[y * width + x]
        })
        .collect();
    let card = format!("STAMP   = {full:>20}");
    let file = fits_image(-32, &[n * full, n * full], &[&card], &floats(&tiled));
    std::fs::write(small.at("data/set02/galaxies-001.fits"), file).unwrap();
    let (data, out) = (small.at("data"), small.at("out"));
    succeed(&[
        "measure",
        "--submission",
        "48/linear/star",
        "--data",
        text(&data),
        "--out",
        text(&out),
    ]);
    let rows = |pixels: &[f32], side: usize| {
        let mut stamps = Vec::new();
        for row in pixels.chunks_exact(n * side * side) {
            let Pixels::Single(row) = Pixels::strip(row.to_vec(), n, side).unwrap() else {
                unreachable!("a strip in single precision");
            };
            stamps.extend(row.iter().copied());
        }
        Array3::from_shape_vec((n * n, side, side), stamps).unwrap()
    };
    let (stamps, stars) = (rows(&tiled, full), rows(&mosaic, side));
    let measurer = Measurer::named("48/linear/star", full).unwrap();
    let psfs = Psfs::stars(stars.view());
    let mut worker = measurer.worker();
    let mut responses = |known: &Psfs<'_>| {
        let mut source = ArraySource::new(&measurer, stamps.view(), known).unwrap();
        let session = Session::open(&measurer, &mut source, KnownNoise::Unknown, &OneThread);
        let session = session.unwrap();
        let mut image = session.image(&mut worker);
        let galaxies = image.measure_each(stamps.view(), &psfs).unwrap();
        let first = galaxies.iter().map(|one| one.response_diagonal()[0]);
        first.collect::<Vec<f64>>()
    };
    let of_files = small.measured("02", "R11");
    assert_eq!(of_files, responses(&psfs));
    // One star for all has nothing in common with others.
    assert_ne!(
        of_files,
        responses(&Psfs::star(stars.index_axis(Axis(0), 0)))
    );
}
