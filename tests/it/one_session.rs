//! Files, simulations in memory and arrays are measured alike, on data that take each way through a session.

use std::path::Path;

use shearq_files::table;
use shearq_measure::ndarray::{Array3, Axis, s};
use shearq_measure::{ArraySource, Batch, KnownNoise, Measurement, Measurer, OneThread, Psfs};

use crate::support::{contents, fits_image, floats, pixels_of, printed, shell};

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

/// The stamps of a mosaic.
fn cube(path: &Path) -> Array3<f32> {
    let ((pixels, width), side) = (pixels_of(path), STAMP);
    let n = width / side;
    let rows = pixels.len() / width / side;
    Array3::from_shape_fn((n * rows, side, side), |(k, y, x)| {
        pixels[(k / n * side + y) * width + k % n * side + x]
    })
}

/// A mosaic of stamps in rows of `n`.
fn mosaic(stamps: &Array3<f32>, n: usize) -> Vec<f32> {
    let (count, side, _) = stamps.dim();
    let (width, height) = (n * side, count / n * side);
    let at = |at: usize| {
        let (x, y) = (at % width, at / width);
        stamps[(y / side * n + x / side, y % side, x % side)]
    };
    (0..width * height).map(at).collect()
}

impl Data {
    fn write(&self, folder: &Path) {
        let side = GRID * STAMP;
        let mut cards = vec![format!("STAMP   = {STAMP:>20}")];
        cards.extend(self.noise.map(|noise| format!("NOISESIG= {noise:>20?}")));
        let cards: Vec<&str> = cards.iter().map(String::as_str).collect();
        let pixels = floats(&mosaic(&self.stamps, GRID));
        let image = fits_image(-32, &[side; 2], &cards, &pixels);
        std::fs::write(folder.join("set02/galaxies-001.fits"), image).unwrap();
        let along = if self.stars.dim().0 == 1 { 1 } else { GRID };
        let stars = floats(&mosaic(&self.stars, along));
        let image = fits_image(-32, &[along * STAMP; 2], &cards[..1], &stars);
        std::fs::write(folder.join("set02/psf-001.fits"), image).unwrap();
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

/// Name, configuration, what is done to the data, and words of a warning or an error.
const CASES: [(&str, &str, Spoil, &str); 10] = [
    ("as simulated", "48/linear/star", |_| {}, ""),
    ("a network", "23/raw/star", |_| {}, ""),
    (
        "sky",
        "48/linear/star",
        |data| sky(data),
        "It was subtracted from all stamps",
    ),
    (
        "noisy stars",
        "48/linear/star",
        |data| noisy_stars(data),
        "the PSF is noisy",
    ),
    (
        "noisy stars and sky",
        "48/linear/star",
        |data| {
            sky(data);
            noisy_stars(data);
        },
        "It was subtracted from all stamps",
    ),
    (
        "missing pixels",
        "48/linear/star",
        |data| {
            for (k, mut stamp) in data.stamps.outer_iter_mut().enumerate().step_by(3) {
                stamp.slice_mut(s![k % 40..k % 40 + 3, ..4]).fill(f32::NAN);
            }
            data.stamps.index_axis_mut(Axis(0), 5).fill(f32::NAN);
        },
        "",
    ),
    (
        "no stamp to survey",
        "48/linear/star",
        |data| data.stamps.fill(f32::NAN),
        "cannot measure the noise: no stamp has enough pixels that differ",
    ),
    (
        "no stamp to survey for a network",
        "23/raw/star",
        |data| data.stamps.fill(f32::NAN),
        "pixels are missing",
    ),
    (
        "borders without noise",
        "48/linear/star",
        |data| {
            data.stamps
                .indexed_iter_mut()
                .for_each(|((_, y, x), value)| {
                    if y.min(x) < 12 || y.max(x) >= 36 {
                        *value = 0.0;
                    }
                });
        },
        "expected two or more complete borders",
    ),
    (
        "a stated noise that is wrong",
        "48/linear/star",
        |data| data.noise = Some(1.3),
        "NOISESIG disagrees with the measured noise",
    ),
];

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
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let folder = at("data");
    let simulate = format!("shearq simulate --sets 2 --images 1 --grid {GRID} --out data");
    printed(root.path(), &simulate);
    let plain = Data {
        stamps: cube(&folder.join("set02/galaxies-001.fits")),
        stars: cube(&folder.join("set02/psf-001.fits")),
        noise: Some(1.0),
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
            let options = format!("--data data --submission {configuration} --out {out}");
            let output = shell(
                root.path(),
                &format!("rm -rf {out}; shearq {command} {options}"),
            );
            (at(&out), String::from_utf8(output.stderr).unwrap())
        });
        let Ok(batch) = batch else {
            let error = batch.unwrap_err();
            assert!(error.contains(expected), "{name}: {error}");
            for (_, said) in &outs {
                assert!(said.contains(&error), "{name}: {said}");
            }
            continue;
        };
        let warnings: Vec<String> = batch.warnings.iter().map(ToString::to_string).collect();
        let silent = warnings.is_empty();
        assert_eq!(silent, expected.is_empty(), "{name}: {warnings:?}");
        let all = warnings.join("\n");
        assert!(all.contains(expected), "{name}: {all}");
        for (out, said) in &outs {
            for warning in &warnings {
                assert!(said.contains(warning), "{name}: {said}\n{warning}");
            }
            let path = out.join("set02/catalogue-001.parquet");
            let read = table::read(&path, None, table::MAX_ROWS).unwrap();
            let columns: [(&str, Column); 5] = [
                ("e1", |g| g.e1),
                ("e2", |g| g.e2),
                ("noise", |g| g.noise),
                ("R12", |g| g.response.map_or(f64::NAN, |r| r[0][1])),
                ("flags", |g| f64::from(g.flags.bits())),
            ];
            // NaN is not equal to itself.
            let bits = |value: f64| {
                if value.is_nan() {
                    u64::MAX
                } else {
                    value.to_bits()
                }
            };
            for (column, value) in columns {
                let found = table::numbers(&read, column, &path).unwrap();
                assert_eq!(found.len(), batch.galaxies.len());
                for (found, galaxy) in found.iter().zip(&batch.galaxies) {
                    assert_eq!(bits(*found), bits(value(galaxy)), "{name}: {column}");
                }
            }
        }
    }
}

#[test]
fn simulated_images_are_measured_like_their_files() {
    let root = tempfile::tempdir().unwrap();
    let sets = "--sets 2,19 --images 2 --grid 34";
    printed(root.path(), &format!("shearq simulate {sets} --out data"));
    for name in ["48/linear/star", "48/linear/func", "23/den/star"] {
        let measure = format!("shearq measure --submission {name} --data data --out files");
        let run = format!("shearq run --submission {name} --simulate {sets} --out memory");
        printed(
            root.path(),
            &format!("rm -rf files memory; {measure} && {run}"),
        );
        let catalogues = |folder: &str| -> Vec<Vec<String>> {
            let folder = root.path().join(folder);
            let all = contents(&folder).into_iter();
            let all = all.filter(|(path, _)| path.ends_with(".parquet"));
            let values = all.flat_map(|(path, _)| {
                let path = folder.join(path);
                let read = table::read(&path, None, table::MAX_ROWS).unwrap();
                ["e1", "e2", "R11", "noise", "flags"].map(|name| {
                    let column = table::numbers(&read, name, &path).unwrap();
                    assert_eq!(column.len(), 34 * 34);
                    column.iter().map(ToString::to_string).collect()
                })
            });
            values.collect()
        };
        let files = catalogues("files");
        assert_eq!(files.len(), 4 * 5);
        assert!(files == catalogues("memory"), "{name}");
    }
}
