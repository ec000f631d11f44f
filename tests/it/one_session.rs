//! Files, simulations in memory and arrays are measured alike, on data that take each way through a session.

use shearq_measure::ndarray::{Array3, Axis, s};
use shearq_measure::{ArraySource, Batch, KnownNoise, Measurement, Measurer, OneThread, Psfs};

use crate::support::{Folder, assert_has, contents, mosaic, shell, stamps_of};

/// Galaxies along a side: more than are surveyed.
const GRID: usize = 33;
const STAMP: usize = 48;

/// An image and its star, or a star of each galaxy.
struct Data {
    stamps: Array3<f32>,
    stars: Array3<f32>,
    noise: Option<f64>,
}

/// Uniform numbers of variance one, from a linear congruential generator: enough to be noise.
fn noise(state: &mut u64) -> f32 {
    *state = state
        .wrapping_mul(6_364_136_223_846_793_005)
        .wrapping_add(1_442_695_040_888_963_407);
    12f32.sqrt() * ((*state >> 40) as f32 / (1u64 << 24) as f32 - 0.5)
}

/// The stamps of an image.
fn cube(folder: &Folder, name: &str) -> Array3<f32> {
    let stamps = stamps_of(&folder.at(name), STAMP);
    let shape = (stamps.len(), STAMP, STAMP);
    Array3::from_shape_vec(shape, stamps.concat()).unwrap()
}

impl Data {
    fn write(&self, folder: &Folder) {
        let mut cards = vec![format!("STAMP   = {STAMP}")];
        cards.extend(self.noise.map(|noise| format!("NOISESIG= {noise:?}")));
        let cards: Vec<&str> = cards.iter().map(String::as_str).collect();
        let along = if self.stars.dim().0 == 1 { 1 } else { GRID };
        for (name, cube, n, cards) in [
            (
                "data/set02/galaxies-001.fits",
                &self.stamps,
                GRID,
                &cards[..],
            ),
            ("data/set02/psf-001.fits", &self.stars, along, &cards[..1]),
        ] {
            let pixels = mosaic(cube.as_slice().unwrap(), STAMP, n);
            folder.image(name, &[n * STAMP; 2], cards, &pixels);
        }
    }

    /// What the library makes of the arrays.
    fn batch(&self, measurer: &Measurer) -> Result<Batch, String> {
        let psfs = match self.stars.dim().0 {
            1 => Psfs::star(self.stars.index_axis(Axis(0), 0)),
            _ => Psfs::stars(self.stars.view()),
        };
        let mut source = ArraySource::new(measurer, self.stamps.view(), &psfs).unwrap();
        let noise = self.noise.map_or(KnownNoise::Unknown, KnownNoise::Stated);
        let batch = measurer.measure_image(&mut source, noise, &OneThread);
        batch.map_err(|error| error.to_string())
    }
}

type Spoil = fn(&mut Data);

/// The value of a column of the catalogue.
type Column = fn(&Measurement) -> f64;

const LINEAR: &str = "48/linear/star";
const NETWORK: &str = "23/raw/star";

/// Name, configuration, what is done to the data, and words of a warning or an error.
const CASES: [(&str, &str, Spoil, &str); 10] = [
    ("as simulated", LINEAR, |_| {}, ""),
    ("a network", NETWORK, |_| {}, ""),
    ("sky", LINEAR, sky, SUBTRACTED),
    ("noisy stars", LINEAR, noisy_stars, "the PSF is noisy"),
    (
        "noisy stars and sky",
        LINEAR,
        noisy_stars_and_sky,
        SUBTRACTED,
    ),
    ("missing pixels", LINEAR, missing_pixels, ""),
    (
        "no stamp to survey",
        LINEAR,
        |data| data.stamps.fill(f32::NAN),
        "cannot measure the noise: on no stamp are there enough pixels that differ",
    ),
    (
        "no stamp to survey for a network",
        NETWORK,
        |data| data.stamps.fill(f32::NAN),
        "pixels are missing",
    ),
    (
        "borders without noise",
        LINEAR,
        blank_borders,
        "expected two or more complete borders",
    ),
    (
        "a stated noise that is wrong",
        LINEAR,
        |data| data.noise = Some(1.3),
        "NOISESIG disagrees with the measured noise",
    ),
];

const SUBTRACTED: &str = "It was subtracted from all stamps";

fn missing_pixels(data: &mut Data) {
    for (k, mut stamp) in data.stamps.outer_iter_mut().enumerate().step_by(3) {
        stamp.slice_mut(s![k % 40..k % 40 + 3, ..4]).fill(f32::NAN);
    }
    data.stamps.index_axis_mut(Axis(0), 5).fill(f32::NAN);
}

fn blank_borders(data: &mut Data) {
    for ((_, y, x), value) in data.stamps.indexed_iter_mut() {
        if y.min(x) < 12 || y.max(x) >= 36 {
            *value = 0.0;
        }
    }
}

fn noisy_stars_and_sky(data: &mut Data) {
    sky(data);
    noisy_stars(data);
}

fn sky(data: &mut Data) {
    for ((_, y, x), value) in data.stamps.indexed_iter_mut() {
        *value += 0.5 + 0.01 * x as f32 - 0.02 * y as f32;
    }
}

/// A star of S/N 80 for each galaxy.
fn noisy_stars(data: &mut Data) {
    let star = data.stars.index_axis(Axis(0), 0).to_owned();
    let sigma = star.iter().map(|v| v * v).sum::<f32>().sqrt() / 80.0;
    let mut state = 7;
    let count = data.stamps.dim().0;
    data.stars = Array3::from_shape_fn((count, STAMP, STAMP), |(_, y, x)| {
        star[(y, x)] + sigma * noise(&mut state)
    });
}

#[test]
fn files_and_arrays_take_the_same_way_through_a_session() {
    let folder = Folder::new();
    folder.run(&format!(
        "simulate --fixed-psf one --sets 2 --images 1 --grid {GRID} --out data"
    ));
    let plain = Data {
        stamps: cube(&folder, "data/set02/galaxies-001.fits"),
        stars: cube(&folder, "data/set02/psf-001.fits"),
        noise: Some(1.0),
    };
    // NaN is not equal to itself.
    let bits = |value: f64| match value.is_nan() {
        true => u64::MAX,
        false => value.to_bits(),
    };
    for (name, configuration, spoil, expected) in CASES {
        let mut data = Data {
            stamps: plain.stamps.clone(),
            stars: plain.stars.clone(),
            ..plain
        };
        spoil(&mut data);
        data.write(&folder);
        let measurer = Measurer::named(configuration, STAMP).unwrap();
        let batch = data.batch(&measurer);
        let outs = [
            "measure --threads 1",
            "measure --threads 3",
            "run --threads 2",
        ]
        .map(|command| {
            let out = command.replace(' ', "");
            folder.remove(&out);
            let line =
                format!("shearq {command} --data data --submission {configuration} --out {out}");
            let output = shell(folder.root(), &line);
            (out, String::from_utf8(output.stderr).unwrap())
        });
        let batch = match batch {
            Ok(batch) => batch,
            Err(error) => {
                assert_has(&error, expected);
                outs.iter().for_each(|(_, said)| assert_has(said, &error));
                continue;
            }
        };
        let warnings: Vec<String> = batch.warnings.iter().map(ToString::to_string).collect();
        let silent = warnings.is_empty();
        assert_eq!(silent, expected.is_empty(), "{name}: {warnings:?}");
        assert_has(&warnings.join("\n"), expected);
        for (out, said) in &outs {
            warnings
                .iter()
                .for_each(|warning| assert_has(said, warning));
            let names = ["e1", "e2", "noise", "R12", "flags"];
            let values: [Column; 5] = [
                |g| g.e1,
                |g| g.e2,
                |g| g.noise,
                |g| g.response.map_or(f64::NAN, |r| r[0][1]),
                |g| f64::from(g.flags.bits()),
            ];
            let found = folder.numbers(&format!("{out}/set02/catalogue-001.parquet"), names);
            for ((column, found), value) in names.iter().zip(found).zip(values) {
                let found = found.into_iter().map(bits);
                let expected = batch.galaxies.iter().map(|galaxy| bits(value(galaxy)));
                assert!(found.eq(expected), "{name}: {column}");
            }
        }
    }
}

#[test]
fn simulated_images_are_measured_like_their_files() {
    let folder = Folder::new();
    let sets = "--sets 2,19 --images 2 --grid 34";
    folder.run(&format!("simulate {sets} --out data"));
    for name in [LINEAR, "48/linear/func", "23/den/star"] {
        let catalogues = |command: &str| -> Vec<[Vec<String>; 5]> {
            folder.remove("out");
            folder.run(&format!("{command} --submission {name} --out out"));
            let files = contents(&folder.at("out"))
                .into_iter()
                .map(|(path, _)| path);
            let files = files.filter(|path| path.ends_with(".parquet"));
            let columns = files.map(|path| {
                let columns = folder.numbers(
                    &format!("out/{path}"),
                    ["e1", "e2", "R11", "noise", "flags"],
                );
                columns.map(|column| column.iter().map(ToString::to_string).collect())
            });
            columns.collect()
        };
        let files = catalogues("measure --data data");
        assert_eq!((files.len(), files[0][0].len()), (4, 34 * 34));
        assert!(
            files == catalogues(&format!("run --simulate {sets}")),
            "{name}"
        );
    }
}
