//! Wrong data through each entry point: the library's `batch`, `gather`, `measure`, `run` and Python.
//!
//! To print the messages as a Markdown table, run
//! `cargo test --release --test it entry_points -- --nocapture`. The column of Python is filled if the interpreter
//! in SHEARQ_PYTHON (by default `python3`) can import shearq.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use ndarray::{Array2, Array3, s};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use shearq_measure::{FunctionalPsf, Measurer, Psfs};
use shearq_simulate::kinds::SetKind;
use shearq_simulate::render::RenderScratch;
use shearq_simulate::set::{STAMP, SetSimulator, SimulationSettings};

use crate::support::{fits_image, floats, galsim_sets, shearq, succeed, text};

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
        let simulator =
            SetSimulator::new(SetKind::of(2).unwrap(), SimulationSettings::new(SEED, GRID))
                .unwrap();
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

    /// The stamps side by side.
    fn mosaic(&self) -> Vec<f32> {
        let side = GRID * STAMP;
        let places = (0..side * side).map(|k| (k / side, k % side));
        places
            .map(|(y, x)| self.stamps[(y / STAMP * GRID + x / STAMP, y % STAMP, x % STAMP)])
            .collect()
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

fn add_gradient(data: &mut Data, per_pixel: f32) {
    for ((_, _, x), value) in data.stamps.indexed_iter_mut() {
        *value += per_pixel * (x as f32 - 23.5);
    }
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

/// Adds noise to the star, of S/N √(Σ p²)/σ.
fn add_star_noise(data: &mut Data, snr: f32) {
    let sigma = data.star.mapv(|v| v * v).sum().sqrt() / snr;
    let noise = normal((1, STAMP, STAMP), 7);
    data.star.scaled_add(sigma, &noise.slice(s![0, .., ..]));
}

/// What an entry point must do.
#[derive(Clone, Copy)]
enum Expected {
    /// Warn with these words.
    Warning(&'static str),
    /// Warn with these words when the galaxies are measured; `gather` may leave it at that.
    WhenMeasured(&'static str),
    /// Refuse to measure, with these words.
    Refused(&'static str),
    /// Say nothing, for this reason.
    Silent(&'static str),
}

use Expected::{Refused, Silent, Warning, WhenMeasured};

/// What is done to the data, its name in the table, and what an entry point must do.
const CASES: &str = "
none                | none                             | silent: good data
sky 0.5             | sky 0.5σ                         | warning: the stamps contain sky
sky -0.5            | sky −0.5σ                        | warning: the stamps contain sky
sky 3               | sky 3σ                           | warning: the stamps contain sky
sky -3              | sky −3σ                          | warning: the stamps contain sky
sky 100             | sky 100σ                         | warning: the stamps contain sky
slope 0.01          | sky gradient 0.01 σ/px           | warning: the sky has a gradient
slope 0.02          | sky gradient 0.02 σ/px           | warning: the sky has a gradient
slope 0.05          | sky gradient 0.05 σ/px           | warning: the sky has a gradient
psf background 0.01 | PSF + 1 % of its peak            | warning: the PSF contains a background
psf scale 0.5       | PSF sampled 0.5 times as finely  | silent: larger galaxies behind this PSF look alike
psf scale 1.1       | PSF sampled 1.1 times too finely | silent: smaller galaxies behind this PSF look alike (m = +0.13)
psf scale 1.5       | PSF sampled 1.5 times too finely | measured: the PSF is nearly as broad as the galaxies
psf scale 2         | PSF sampled 2 times too finely   | refused: the PSF is broader than the galaxies
psf offset 0.4      | PSF 0.4 px off centre            | silent: half a pixel does not change shapes
psf offset 1.5      | PSF 1.5 px off centre            | warning: the star is off the centre of its stamp
psf offset 3        | PSF 3 px off centre              | warning: the star is off the centre of its stamp
psf snr 20          | PSF noise, S/N 20                | warning: the PSF is noisy
psf snr 50          | PSF noise, S/N 50                | warning: the PSF is noisy
psf snr 100         | PSF noise, S/N 100               | warning: the PSF is noisy
psf pixel           | PSF is a single pixel            | warning: the PSF is narrower than the pixels can show
psf swap            | PSF with x and y swapped         | silent: a PSF of other ellipticity looks alike
move 1 1            | galaxies 1 px off centre         | warning: the galaxies are off the centre of their stamps
move 2 0            | galaxies 2 px off centre         | warning: the galaxies are off the centre of their stamps
move 0 4            | galaxies 4 px off centre         | warning: the galaxies are off the centre of their stamps
move 8 0            | galaxies 8 px off centre         | warning: the galaxies are off the centre of their stamps
scatter             | galaxies scattered by 5 px       | warning: the galaxies are scattered over their stamps
scale -1            | negative galaxies                | warning: galaxies are darker than their surroundings
depths              | stamps of two depths             | warning: the noise differs between stamps
correlated          | noise correlated over 6 px       | warning: the noise is correlated over more than 3 px
copies 32           | 32 of 576 stamps are copies      | warning: stamps are copies of each other
copies 576          | all stamps are copies            | warning: stamps are copies of each other
scale 0             | blank stamps                     | warning: the stamps are blank
scale 1e20          | pixel values × 1e20              | refused: pixel values are out of range
scale 1e-22         | pixel values × 1e-22             | refused: pixel values are out of range
noise 2             | stated noise twice too large     | measured: disagrees with the ";

/// The lines of `CASES`.
fn cases() -> impl Iterator<Item = (&'static str, &'static str, Expected)> {
    CASES.lines().skip(1).map(|line| {
        let mut cells = line.split('|').map(str::trim_start);
        let [what, name, expected] = [(); 3].map(|()| cells.next().unwrap());
        let (kind, words) = expected.split_once(": ").unwrap();
        let expected = match kind {
            "silent" => Silent(words),
            "warning" => Warning(words),
            "measured" => WhenMeasured(words),
            _ => Refused(words),
        };
        (what.trim_end(), name.trim_end(), expected)
    })
}

impl Data {
    /// Spoils the data in the way of a line of `CASES`.
    fn spoil(&mut self, what: &str) {
        let words: Vec<&str> = what.split(' ').collect();
        let number = |text: &str| text.parse::<f64>().unwrap();
        match words[..] {
            ["none"] => {}
            ["sky", level] => self.stamps += number(level) as f32,
            ["slope", slope] => add_gradient(self, number(slope) as f32),
            ["psf", "background", share] => {
                let peak = self.star.iter().copied().fold(0.0, f32::max);
                self.star += number(share) as f32 * peak;
            }
            ["psf", "scale", scale] => draw_star(self, number(scale), 0.0),
            ["psf", "offset", offset] => draw_star(self, 1.0, number(offset)),
            ["psf", "snr", snr] => add_star_noise(self, number(snr) as f32),
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
    /// Warnings and errors on standard error.
    fn of(output: &Output) -> Self {
        let said = String::from_utf8(output.stderr.clone()).unwrap();
        assert!(!said.contains("panicked"), "{said}");
        let lines = said.lines();
        Found {
            messages: lines
                .filter(|line| line.starts_with("warning: ") || line.starts_with("error: "))
                .map(str::to_owned)
                .collect(),
            failed: !output.status.success(),
        }
    }

    /// Whether this is what the case expects of an entry point.
    fn fits(&self, expected: Expected, gathers: bool) -> bool {
        let says = |words: &str| self.messages.iter().any(|text| text.contains(words));
        match expected {
            Silent(_) => self.messages.is_empty() && !self.failed,
            Warning(words) => says(words),
            WhenMeasured(words) => says(words) || (gathers && self.messages.is_empty()),
            Refused(words) if gathers => says(words) || self.messages.is_empty(),
            // The library gives flagged rows.
            Refused(words) => {
                says(words) && (self.failed || says("576 of 576 galaxies are flagged"))
            }
        }
    }

    /// A cell of the table: the messages without numbers and advice.
    fn cell(&self, expected: Expected) -> String {
        if self.messages.is_empty() {
            return match expected {
                Silent(reason) => format!("silent ({reason})"),
                _ => "silent (`measure` and `run` report it)".to_owned(),
            };
        }
        let short = self.messages.iter().map(|text| {
            let text = text.split(" (found").next().unwrap_or(text);
            let kind = text.split(": ").next().unwrap_or_default();
            let what = text.rsplit(": ").next().unwrap_or_default();
            match kind {
                "warning" | "error" => format!("{kind}: {what}"),
                _ => text.to_owned(),
            }
        });
        let status = if self.failed { "**fails** " } else { "" };
        status.to_owned() + &short.collect::<Vec<_>>().join("; ")
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

/// A folder with data of all forms.
struct Folder {
    root: tempfile::TempDir,
}

impl Folder {
    fn new() -> Self {
        let root = tempfile::tempdir().unwrap();
        let (grid, seed) = (GRID.to_string(), SEED.to_string());
        let data = root.path().join("data");
        let simulate = ["simulate", "--sets", "2", "--images", "1"];
        let rest = ["--grid", &grid, "--seed", &seed, "--out", text(&data)];
        succeed(&[&simulate[..], &rest].concat());
        Folder { root }
    }

    fn at(&self, name: &str) -> PathBuf {
        self.root.path().join(name)
    }

    /// Writes the image as a data folder, as a cube of stamps, and as arrays of NumPy.
    fn write(&self, data: &Data) {
        let side = GRID * STAMP;
        let noise = data.noise.unwrap_or(1.0);
        let cards = [
            format!("STAMP   = {STAMP:>20}"),
            format!("NOISESIG= {noise:>20?}"),
        ];
        let cards = cards.each_ref().map(String::as_str);
        let stamps = data.stamps.as_standard_layout();
        let (cube, star) = (stamps.as_slice().unwrap(), data.star.as_standard_layout());
        let star = star.as_slice().unwrap();
        for (name, bytes) in [
            (
                "data/set02/galaxies-001.fits",
                fits_image(-32, &[side, side], &cards, &floats(&data.mosaic())),
            ),
            (
                "data/set02/psf-001.fits",
                fits_image(-32, &[STAMP; 2], &[], &floats(star)),
            ),
            (
                "cube.fits",
                fits_image(-32, &[STAMP, STAMP, GRID * GRID], &[], &floats(cube)),
            ),
            ("stamps.npy", numpy(&[GRID * GRID, STAMP, STAMP], cube)),
            ("star.npy", numpy(&[STAMP, STAMP], star)),
        ] {
            fs::write(self.at(name), bytes).unwrap();
        }
    }

    fn gather(&self, data: &Data) -> Found {
        let (cube, psf) = (self.at("cube.fits"), self.at("data/set02/psf-001.fits"));
        let noise = data.noise.map(|noise| noise.to_string());
        let mut arguments = vec!["--stamps", text(&cube), "--psf", text(&psf)];
        if let Some(noise) = &noise {
            arguments.extend(["--noise", noise]);
        }
        self.run("gather", &arguments)
    }

    fn on_folder(&self, command: &str) -> Found {
        let data = self.at("data");
        self.run(command, &["--data", text(&data), "--submission", LINEAR])
    }

    /// Runs a command with a new folder for its output.
    fn run(&self, command: &str, arguments: &[&str]) -> Found {
        let out = self.at("out");
        let _ = fs::remove_dir_all(&out);
        let output = shearq(&[&[command], arguments, &["--out", text(&out)]].concat());
        Found::of(&output)
    }

    /// Measures in Python; none if Python cannot import shearq.
    fn python(&self, python: &str, data: &Data) -> Found {
        let noise = data
            .noise
            .map_or("None".to_owned(), |noise| noise.to_string());
        let script = format!(
            "import sys, warnings, numpy, shearq\n\
             warnings.simplefilter('always')\n\
             warnings.showwarning = lambda message, *_: print('warning:', message, file=sys.stderr)\n\
             try:\n    shearq.measure(numpy.load('stamps.npy'), numpy.load('star.npy'), noise={noise})\n\
             except ValueError as error:\n    sys.exit(f'error: {{error}}')\n"
        );
        let mut command = Command::new(python);
        let output = command.arg("-c").arg(script).current_dir(self.root.path());
        Found::of(&output.output().unwrap())
    }
}

/// A file of NumPy.
fn numpy(shape: &[usize], pixels: &[f32]) -> Vec<u8> {
    let shape: Vec<String> = shape.iter().map(ToString::to_string).collect();
    let shape = shape.join(", ");
    let head = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({shape}), }}");
    // The whole header has a multiple of 64 bytes and ends with a new line.
    let length = (10 + head.len() + 1).next_multiple_of(64) - 10;
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((length as u16).to_le_bytes());
    bytes.extend(format!("{head:<width$}\n", width = length - 1).bytes());
    bytes.extend(pixels.iter().flat_map(|value| value.to_le_bytes()));
    bytes
}

/// A Python that can import shearq. In SHEARQ_PYTHON it must be able to.
fn python() -> Option<String> {
    let named = std::env::var("SHEARQ_PYTHON").ok();
    let python = named.clone().unwrap_or_else(|| "python3".to_owned());
    let output = Command::new(&python).args(["-c", "import shearq"]).output();
    let imports = output.is_ok_and(|output| output.status.success());
    assert!(imports || named.is_none(), "{python} cannot import shearq");
    imports.then_some(python)
}

#[test]
fn every_entry_point_reports_wrong_data() {
    let python = python();
    let (good, folder) = (Data::good(), Folder::new());
    let mut table =
        "| data set | batch | gather | measure | run | Python |\n|---|---|---|---|---|---|\n"
            .to_owned();
    let mut wrong = Vec::new();
    for (what, name, expected) in cases() {
        let mut data = good.clone();
        data.spoil(what);
        folder.write(&data);
        let found = [
            Some(batch(&data)),
            Some(folder.gather(&data)),
            Some(folder.on_folder("measure")),
            Some(folder.on_folder("run")),
            python.as_ref().map(|python| folder.python(python, &data)),
        ];
        let cells = found.each_ref().map(|found| match found {
            Some(found) => found.cell(expected),
            None => "–".to_owned(),
        });
        table += &format!("| {name} | {} |\n", cells.join(" | "));
        let entries = ["batch", "gather", "measure", "run", "Python"];
        for (entry, found) in entries.iter().zip(&found) {
            if let Some(found) = found
                && !found.fits(expected, *entry == "gather")
            {
                wrong.push(format!("{name}, {entry}: {:?}", found.messages));
            }
        }
    }
    table += &positions(&folder, &good, &mut wrong);
    eprintln!("{table}");
    assert!(wrong.is_empty(), "{wrong:#?}");
}

/// Rows of the table about positions, which `gather` alone reads.
fn positions(folder: &Folder, data: &Data, wrong: &mut Vec<String>) -> String {
    type Place = fn(usize) -> [f64; 2];
    /// Centre of a stamp in FITS pixels.
    fn centre(k: usize) -> [f64; 2] {
        [k % GRID, k / GRID].map(|at| (at * STAMP) as f64 + 24.5)
    }
    let cases: [(&str, Place, &str); 4] = [
        (
            "positions in degrees",
            |k| [150.0 + 1e-3 * k as f64, -2.0],
            "Are these degrees",
        ),
        (
            "some positions outside the exposure",
            |k| match k % 9 {
                0 => [-500.0, 24.5],
                _ => centre(k),
            },
            "positions are outside the exposure",
        ),
        (
            "repeated positions",
            |k| centre(k / 2 * 2),
            "are within 0.5 px of an earlier one",
        ),
        (
            "positions that count from 0 instead of 1",
            |k| centre(k).map(|at| at - 1.0),
            "Try: --first-pixel 0",
        ),
    ];
    folder.write(data);
    let (mosaic, psf) = (
        folder.at("data/set02/galaxies-001.fits"),
        folder.at("data/set02/psf-001.fits"),
    );
    let table = folder.at("positions.csv");
    let mut rows = String::new();
    let mut add = |name: &str, found: &Found, expected: &'static str| {
        if !found.fits(Warning(expected), true) {
            wrong.push(format!("{name}: {:?}", found.messages));
        }
        rows += &format!("| {name} | – | {} | – | – | – |\n", found.cell(Warning("")));
    };
    for (name, place, expected) in cases {
        let lines = (0..GRID * GRID).map(|k| format!("{},{}\n", place(k)[0], place(k)[1]));
        fs::write(&table, format!("x,y\n{}", lines.collect::<String>())).unwrap();
        let arguments = ["--exposure", text(&mosaic), "--positions", text(&table)];
        let found = folder.run("gather", &[&arguments[..], &["--psf", text(&psf)]].concat());
        add(name, &found, expected);
    }
    let found = folder.run("gather", &["--stamps", text(&mosaic), "--psf", text(&psf)]);
    add("mosaic given to `--stamps`", &found, "A mosaic is read as");
    rows
}

#[test]
fn batch_compares_the_noise_in_the_call_with_the_stamps() {
    let good = Data::good();
    for (noise, silent) in [(1.0, true), (0.9, false), (2.0, false)] {
        let found = batch(&Data {
            noise: Some(noise),
            ..good.clone()
        });
        let expected = match silent {
            true => Silent(""),
            false => Warning("the given noise disagrees with the noise of the stamps (found "),
        };
        assert!(found.fits(expected, false), "{noise}: {:?}", found.messages);
    }
}

#[test]
fn all_simulated_sets_are_measured_without_a_warning() {
    let folder = tempfile::tempdir().unwrap();
    for (sets, name) in [
        ("all", "48/linear/func"),
        ("all", "48/linear/star"),
        ("2,5,8,20", "23/raw/star"),
    ] {
        let out = folder.path().join(name.replace('/', "-"));
        let run = [
            "run",
            "--simulate",
            "--sets",
            sets,
            "--images",
            "1",
            "--grid",
            "16",
        ];
        is_silent(&[&run[..], &["--submission", name, "--out", text(&out)]].concat());
    }
}

#[test]
fn galaxies_of_galsim_and_cosmos_are_measured_without_a_warning() {
    let folder = tempfile::tempdir().unwrap();
    let cosmos = Path::new("tests/data/galsim/cosmos").to_owned();
    let sets = galsim_sets().into_iter();
    let sets = sets.map(|sets| (sets, &[LINEAR, "48/linear/func", "23/raw/star"][..]));
    // GalSim's COSMOS image has no formula of its PSF.
    for (data, names) in sets.chain([(cosmos, &[LINEAR, "23/raw/star"][..])]) {
        for name in names {
            let out = folder.path().join("out");
            let _ = fs::remove_dir_all(&out);
            let measure = ["measure", "--data", text(&data), "--submission", name];
            is_silent(&[&measure[..], &["--out", text(&out)]].concat());
        }
    }
}

fn is_silent(arguments: &[&str]) {
    let output = shearq(arguments);
    let found = Found::of(&output);
    assert!(
        output.status.success() && found.messages.is_empty(),
        "{arguments:?}: {}",
        String::from_utf8_lossy(&output.stderr)
    );
}
