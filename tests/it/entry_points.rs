//! Wrong data through each entry point: the library's `batch`, `gather`, `measure` and `run`. Python has
//! `python/tests/test_wrong_data.py`.

use std::path::Path;

use ndarray::{Array2, Array3, s};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use shearq_measure::{FunctionalPsf, Measurer, Psfs};
use shearq_simulate::kinds::SetKind;
use shearq_simulate::render::RenderScratch;
use shearq_simulate::set::{FixedPsf, STAMP, SetSimulator, SimulationSettings};

use crate::support::{Folder, galsim_sets, mosaic, shell, text};

/// Galaxies per axis of the images.
const GRID: usize = 24;
const SEED: u64 = 11;
const LINEAR: &str = "48/linear/star";

/// Stamps along the first axis.
type Stamps = Array3<f32>;

/// The data of one image.
#[derive(Clone)]
struct Data {
    stamps: Stamps,
    star: Array2<f32>,
    psf: FunctionalPsf,
    /// The noise stated for the image.
    noise: Option<f64>,
}

impl Data {
    /// An image of simulated set 2.
    fn good() -> Self {
        let settings = SimulationSettings {
            fixed_psf: FixedPsf::One,
            ..SimulationSettings::new(SEED, GRID)
        };
        let simulator = SetSimulator::new(SetKind::of(2).unwrap(), settings).unwrap();
        let fields = simulator.image_fields(1);
        let mut stamps = Stamps::zeros((GRID * GRID, STAMP, STAMP));
        let mut scratch = RenderScratch::new();
        for (k, mut stamp) in stamps.outer_iter_mut().enumerate() {
            let pixels = stamp.as_slice_mut().unwrap();
            simulator.draw(&fields, k % GRID, k / GRID, &mut scratch, pixels);
        }
        let psf = *fields.psf.at(0, 0);
        let star = psf.stamp(STAMP).mapv(|value| value as f32);
        Data {
            stamps,
            star,
            psf,
            noise: None,
        }
    }

    /// Writes the image as a data folder and as a cube of stamps.
    fn write(&self, folder: &Folder) {
        let noise = format!("NOISESIG= {:?}", self.noise.unwrap_or(1.0));
        let cards = [format!("STAMP   = {STAMP}"), noise];
        let cards = cards.each_ref().map(String::as_str);
        let stamps = self.stamps.as_standard_layout();
        let (cube, star) = (stamps.as_slice().unwrap(), self.star.as_standard_layout());
        let image = mosaic(cube, STAMP, GRID);
        folder.image(
            "data/set02/galaxies-001.fits",
            &[GRID * STAMP; 2],
            &cards,
            &image,
        );
        folder.image(
            "data/set02/psf-001.fits",
            &[STAMP; 2],
            &[],
            star.as_slice().unwrap(),
        );
        folder.image("cube.fits", &[STAMP, STAMP, GRID * GRID], &[], cube);
    }
}

fn normal(shape: (usize, usize, usize), seed: u64) -> Stamps {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    Stamps::from_shape_simple_fn(shape, || StandardNormal.sample(&mut random))
}

/// Moves all stamps by whole pixels; what leaves at an edge comes in at the other.
fn moved(stamps: &Stamps, dx: usize, dy: usize) -> Stamps {
    Stamps::from_shape_fn(stamps.dim(), |(k, y, x)| {
        stamps[(k, (y + STAMP - dy) % STAMP, (x + STAMP - dx) % STAMP)]
    })
}

/// Sums over squares of pixels, which correlates noise.
fn summed(stamps: &Stamps, side: usize) -> Stamps {
    Stamps::from_shape_fn(stamps.dim(), |(k, y, x)| {
        let at = |dy: usize, dx: usize| stamps[(k, (y + dy) % STAMP, (x + dx) % STAMP)];
        let all = (0..side).flat_map(|dy| (0..side).map(move |dx| (dy, dx)));
        all.map(|(dy, dx)| at(dy, dx)).sum::<f32>() / side as f32
    })
}

/// Draws the star with a factor on its FWHM, and off the centre along x.
fn draw_star(data: &mut Data, scale: f64, offset: f64) {
    let psf = FunctionalPsf {
        fwhm: scale * data.psf.fwhm,
        ..data.psf
    };
    let mut star = Array2::zeros((STAMP, STAMP));
    psf.draw_into(23.5 + offset, 23.5, star.view_mut());
    data.star = star.mapv(|value| value as f32);
}

/// What is done to the data, and what an entry point must do: warn with these words, when the galaxies are measured if not
/// before (`gather` may leave it at that), refuse to measure, or be silent for this reason.
const CASES: &str = "
none                | silent: good data
noise 1             | silent: the stated noise is right
sky 0.5             | warning: the stamps contain sky
sky -0.5            | warning: the stamps contain sky
sky 3               | warning: the stamps contain sky
sky -3              | warning: the stamps contain sky
sky 100             | warning: the stamps contain sky
slope 0.01          | warning: the sky has a gradient
slope 0.02          | warning: the sky has a gradient
slope 0.05          | warning: the sky has a gradient
psf background 0.01 | warning: the PSF contains a background
psf scale 0.5       | silent: larger galaxies behind this PSF look alike
psf scale 1.1       | silent: smaller galaxies behind this PSF look alike (m = +0.13)
psf scale 1.5       | measured: the PSF is nearly as broad as the galaxies
psf scale 2         | refused: the PSF is broader than the galaxies
psf offset 0.4      | silent: half a pixel does not change shapes
psf offset 1.5      | warning: the star is off the centre of its stamp
psf offset 3        | warning: the star is off the centre of its stamp
psf snr 20          | warning: the PSF is noisy
psf snr 50          | warning: the PSF is noisy
psf snr 100         | warning: the PSF is noisy
psf pixel           | warning: the PSF is narrower than the pixels can show
psf swap            | silent: a PSF of other ellipticity looks alike
move 1 1            | warning: the galaxies are off the centre of their stamps
move 2 0            | warning: the galaxies are off the centre of their stamps
move 0 4            | warning: the galaxies are off the centre of their stamps
move 8 0            | warning: the galaxies are off the centre of their stamps
scatter             | warning: the galaxies are scattered over their stamps
scale -1            | warning: galaxies are darker than their surroundings
depths              | warning: the noise differs between stamps
correlated          | warning: the noise is correlated over more than 3 px
copies 32           | warning: stamps are copies of each other
copies 576          | warning: stamps are copies of each other
scale 0             | warning: the stamps are blank
scale 1e20          | refused: pixel values are out of range
scale 1e-22         | refused: pixel values are out of range
noise 2             | measured: disagrees with the 
noise 0.9           | measured: disagrees with the ";

impl Data {
    /// Spoils the data as a line of `CASES` states.
    fn spoil(&mut self, what: &str) {
        let words: Vec<&str> = what.split(' ').collect();
        let number = |text: &str| text.parse::<f64>().unwrap();
        match words[..] {
            ["none"] => {}
            ["sky", level] => self.stamps += number(level) as f32,
            ["slope", slope] => {
                for ((_, _, x), value) in self.stamps.indexed_iter_mut() {
                    *value += number(slope) as f32 * (x as f32 - 23.5);
                }
            }
            ["psf", "background", share] => {
                let peak = self.star.iter().copied().fold(0.0, f32::max);
                self.star += number(share) as f32 * peak;
            }
            ["psf", "scale", scale] => draw_star(self, number(scale), 0.0),
            ["psf", "offset", offset] => draw_star(self, 1.0, number(offset)),
            ["psf", "snr", snr] => {
                let sigma = self.star.mapv(|v| v * v).sum().sqrt() / number(snr) as f32;
                let noise = normal((1, STAMP, STAMP), 7);
                self.star.scaled_add(sigma, &noise.slice(s![0, .., ..]));
            }
            ["psf", "pixel"] => {
                self.star.fill(0.0);
                self.star[(STAMP / 2, STAMP / 2)] = 1.0;
            }
            ["psf", "swap"] => self.star = self.star.t().to_owned(),
            ["move", dx, dy] => {
                self.stamps = moved(&self.stamps, number(dx) as usize, number(dy) as usize);
            }
            ["scatter"] => {
                let good = self.stamps.clone();
                for (k, mut stamp) in self.stamps.outer_iter_mut().enumerate() {
                    let (dx, dy) = ([0, 5, 43][k % 3], [0, 5, 43][k / 3 % 3]);
                    let one = good.slice(s![k..=k, .., ..]).to_owned();
                    stamp.assign(&moved(&one, dx, dy).slice(s![0, .., ..]));
                }
            }
            ["scale", "0"] => self.stamps.fill(0.0),
            ["scale", factor] => self.stamps *= number(factor) as f32,
            ["depths"] => {
                let noise = normal(self.stamps.dim(), 4);
                let mut half = self.stamps.slice_mut(s![GRID * GRID / 2.., .., ..]);
                half.scaled_add(0.9, &noise.slice(s![GRID * GRID / 2.., .., ..]));
            }
            ["correlated"] => {
                let noise = summed(&normal(self.stamps.dim(), 5), 6);
                self.stamps.scaled_add(2.0, &noise);
            }
            ["copies", "32"] => {
                let first = self.stamps.slice(s![..32, .., ..]).to_owned();
                self.stamps.slice_mut(s![64..96, .., ..]).assign(&first);
            }
            ["copies", _] => {
                let first = self.stamps.slice(s![0, .., ..]).to_owned();
                let mut stamps = self.stamps.outer_iter_mut();
                stamps.by_ref().for_each(|mut stamp| stamp.assign(&first));
            }
            ["noise", noise] => self.noise = Some(number(noise)),
            _ => panic!("{what}"),
        }
    }
}

/// What an entry point said.
#[derive(Default)]
struct Found {
    messages: Vec<String>,
    failed: bool,
}

impl Found {
    /// Warnings and errors of a command with a new folder for its output.
    fn of(folder: &Folder, command: &str) -> Self {
        let line = format!("rm -rf out; shearq {command} --out out");
        let output = shell(folder.root(), &line);
        let said = String::from_utf8(output.stderr).unwrap();
        assert!(!said.contains("panicked"), "{said}");
        let is_message = |line: &&str| line.starts_with("warning: ") || line.starts_with("error: ");
        Found {
            messages: said.lines().filter(is_message).map(str::to_owned).collect(),
            failed: !output.status.success(),
        }
    }

    /// Whether this is what a case expects of an entry point.
    fn fits(&self, kind: &str, words: &str, gathers: bool) -> bool {
        let silent = self.messages.is_empty() && !self.failed;
        let says = |words: &str| self.messages.iter().any(|text| text.contains(words));
        match kind {
            "silent" => silent,
            "warning" => says(words),
            _ if gathers => says(words) || silent,
            "measured" => says(words),
            // The library gives flagged rows.
            _ => says(words) && (self.failed || says("576 of 576 galaxies are flagged")),
        }
    }
}

/// The library's `batch`.
fn batch(data: &Data) -> Found {
    let measurer = Measurer::named(LINEAR, STAMP).unwrap();
    let psf = Psfs::star(data.star.view());
    match measurer.batch(data.stamps.view(), &psf, data.noise) {
        Ok(batch) => Found {
            messages: batch.warnings.iter().map(ToString::to_string).collect(),
            failed: false,
        },
        Err(error) => Found {
            messages: vec![error.to_string()],
            failed: true,
        },
    }
}

#[test]
fn every_entry_point_reports_wrong_data() {
    let (good, folder) = (Data::good(), Folder::new());
    let simulate = "simulate --fixed-psf one --sets 2 --images 1 --out data";
    folder.run(&format!("{simulate} --grid {GRID} --seed {SEED}"));
    let mut wrong = Vec::new();
    for line in CASES.lines().skip(1) {
        let (what, expected) = line.split_once("| ").unwrap();
        let (kind, words) = expected.split_once(": ").unwrap();
        let mut data = good.clone();
        data.spoil(what.trim_end());
        data.write(&folder);
        let noise = data.noise.map(|noise| format!("--noise {noise}"));
        let gather = format!(
            "gather --stamps cube.fits --psf data/set02/psf-001.fits {}",
            noise.unwrap_or_default()
        );
        let on_folder = format!("--data data --submission {LINEAR}");
        for (entry, found) in [
            ("batch", batch(&data)),
            ("gather", Found::of(&folder, &gather)),
            (
                "measure",
                Found::of(&folder, &format!("measure {on_folder}")),
            ),
            ("run", Found::of(&folder, &format!("run {on_folder}"))),
        ] {
            if !found.fits(kind, words, entry == "gather") {
                wrong.push(format!("{what}, {entry}: {:?}", found.messages));
            }
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn simulated_and_galsims_images_are_measured_silently() {
    let mut lines: Vec<String> = [
        ("all", "48/linear/func"),
        ("all", "48/linear/star"),
        ("2,5,8,20", "23/raw/star"),
    ]
    .map(|(sets, name)| {
        format!(
            "run --simulate --fixed-psf one --images 1 --grid 16 --sets {sets} --submission {name}"
        )
    })
    .into();
    let cosmos = Path::new("tests/data/galsim/cosmos").to_owned();
    for data in galsim_sets().into_iter().chain([cosmos]) {
        let data = data.canonicalize().unwrap();
        // GalSim's COSMOS image has no formula of its PSF.
        let names = [LINEAR, "23/raw/star", "48/linear/func"];
        let count = if data.ends_with("cosmos") { 2 } else { 3 };
        let measure = |name: &&str| format!("measure --data {} --submission {name}", text(&data));
        lines.extend(names[..count].iter().map(measure));
    }
    let folder = Folder::new();
    for line in lines {
        let messages = Found::of(&folder, &line).messages;
        assert!(messages.is_empty(), "{line}: {messages:?}");
    }
}
