//! What makes results the same results: every digit of a setting, and the data they were measured from.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use shearq_dataset::record::{read_record, write_record};
use shearq_files::fits::{ImageReader, ImageWriter, Value};
use shearq_render::table::{Cell, Heading, Table, TableFormat};
use shearq_simulate::field::ShearSpectrum;
use shearq_simulate::set::SimulationSettings;
use shearq_submissions::{Configuration, Denoise, Method, Registry};

use crate::support::{contents, succeed, text};

/// Finite numbers of every size.
fn numbers(count: usize) -> Vec<f64> {
    let mut random = ChaCha8Rng::seed_from_u64(17);
    let mut numbers = vec![
        0.0,
        -0.0,
        f64::MIN_POSITIVE,
        f64::MAX,
        5e-324,
        1.8554865613500826,
    ];
    // Settings are near one more often than numbers of random bits.
    numbers.extend((0..count).map(|_| random.random::<f64>() * 10.0));
    let bits = (0..count).map(|_| f64::from_bits(random.random()));
    numbers.extend(bits.filter(|number| number.is_finite()));
    numbers
}

#[test]
fn every_number_is_read_as_it_was_written() {
    let folder = tempfile::tempdir().unwrap();
    let numbers = numbers(40_000);
    let bits = |numbers: &[f64]| numbers.iter().map(|n| n.to_bits()).collect::<Vec<_>>();
    let path = folder.path().join("numbers.json");
    write_record(&path, &numbers).unwrap();
    let read: Vec<f64> = read_record(&path).unwrap().unwrap();
    assert!(bits(&read) == bits(&numbers), "JSON");
    for some in numbers.chunks(1000) {
        let table = toml::Table::from_iter([("n".to_owned(), some.to_vec().into())]);
        let read: toml::Table = toml::to_string(&table).unwrap().parse().unwrap();
        let read = read["n"]
            .as_array()
            .unwrap()
            .iter()
            .map(|n| n.as_float().unwrap());
        assert!(bits(&read.collect::<Vec<_>>()) == bits(some), "TOML");
    }
    let table = Table {
        headings: vec![Heading::new("n", "N")],
        rows: numbers.iter().map(|&n| vec![Cell::number(n, 2)]).collect(),
        ..Table::default()
    };
    let csv = table.render(TableFormat::Csv);
    let read: Vec<f64> = csv
        .lines()
        .skip(1)
        .map(|line| line.parse().unwrap())
        .collect();
    assert!(bits(&read) == bits(&numbers), "CSV");
}

#[test]
fn every_number_of_a_header_is_read_as_it_was_written() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("header.fits");
    // cfitsio reads what is below the normal numbers as zero.
    let numbers: Vec<f64> = numbers(500)
        .into_iter()
        .filter(|n| *n == 0.0 || n.is_normal())
        .collect();
    let names: Vec<String> = (0..numbers.len()).map(|k| format!("N{k}")).collect();
    let header: Vec<(&str, Value)> = names
        .iter()
        .map(String::as_str)
        .zip(numbers.iter().map(|&n| Value::Real(n)))
        .collect();
    let mut image = ImageWriter::create(&path, 1, 1, &header).unwrap();
    image.write_rows(&[0.0]).unwrap();
    image.finish().unwrap();
    let image = ImageReader::open(&path).unwrap();
    for (name, number) in names.iter().zip(numbers) {
        let read = image.number(name).unwrap().unwrap();
        assert!(
            read.to_bits() == number.to_bits() || (read, number) == (0.0, 0.0),
            "{number:e}: {read:e}"
        );
    }
}

#[test]
fn settings_of_all_digits_are_read_as_they_were_written() {
    let mut random = ChaCha8Rng::seed_from_u64(3);
    let folder = tempfile::tempdir().unwrap();
    let base = Registry::embedded()
        .unwrap()
        .get("paper")
        .unwrap()
        .configuration;
    for _ in 0..500 {
        let mut submission = base.clone();
        let Method::Network(network) = &mut submission.method else {
            panic!("a submission of the network");
        };
        network.deconvolution.lambda = 10.0 * random.random::<f64>();
        if let Denoise::WaveletWiener(wavelet) = &mut network.denoise {
            wavelet.strength = 0.1 + random.random::<f64>();
        }
        network.shape.acf_share = 0.5 + 0.5 * random.random::<f64>();
        let simulation = SimulationSettings {
            spectrum: ShearSpectrum {
                amplitude: 100.0 * random.random::<f64>(),
                tilt: random.random::<f64>() - 0.5,
                scatter: 1.0 + random.random::<f64>(),
            },
            ..SimulationSettings::new(random.random(), 12)
        };
        let path = folder.path().join("settings.json");
        write_record(&path, &(&submission, simulation)).unwrap();
        let read: (Configuration, SimulationSettings) = read_record(&path).unwrap().unwrap();
        assert_eq!(read, (submission.clone(), simulation));
        let written = toml::to_string(&submission).unwrap();
        assert_eq!(
            toml::from_str::<Configuration>(&written).unwrap(),
            submission
        );
    }
}

#[test]
fn folders_with_settings_of_seventeen_digits_are_gone_on_with() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let (data, own) = (at("data"), at("own.toml"));
    let simulate = ["simulate", "--sets", "2", "--images", "2", "--grid", "8"];
    let digits = [
        "--amplitude",
        "1.8554865613500826",
        "--tilt",
        "-0.12837465019283746",
    ];
    let simulate = [&simulate[..], &digits, &["--out", text(&data)]].concat();
    let settings = "extends = \"23/raw/star\"\n[deconvolution]\nlambda = 0.30000000000000004\n[shape]\nacf_share = 0.8554865613500826\n";
    fs::write(&own, settings).unwrap();
    let out = at("out");
    let measure = [
        "measure",
        "--submission",
        text(&own),
        "--data",
        text(&data),
        "--out",
        text(&out),
    ];
    let mut before = Vec::new();
    // A fresh process each: what is compared is what was read.
    for round in 0..2 {
        succeed(&simulate);
        succeed(&measure);
        let after = contents(root.path());
        assert!(round == 0 || before == after);
        before = after;
    }
}

/// A command stopped after its first set, then done, against one done in one go: all files but those that
/// hold the time it took, which begin with one of `clock`, are the same bytes.
fn resumed(command: &[&str], clock: &[&str]) {
    let root = tempfile::tempdir().unwrap();
    let run = |out: &str, sets: &str| {
        let out = root.path().join(out);
        succeed(&[command, &["--sets", sets, "--out", text(&out)]].concat());
        let mut files = contents(&out);
        files.retain(|(name, _)| !clock.iter().any(|start| name.starts_with(start)));
        files
    };
    let whole = run("whole", "2,5");
    run("parts", "2");
    let parts = run("parts", "2,5");
    let names = |files: &[(String, Vec<u8>)]| -> Vec<String> {
        files.iter().map(|(name, _)| name.clone()).collect()
    };
    assert_eq!(names(&parts), names(&whole));
    for ((name, bytes), (_, other)) in parts.iter().zip(&whole) {
        assert!(bytes == other, "{name}");
    }
}

#[test]
fn a_resumed_reproduction_is_the_same_bytes() {
    let reproduce = [
        "reproduce",
        "--images",
        "2",
        "--grid",
        "8",
        "--galaxies",
        "10",
    ];
    resumed(&reproduce, &[]);
}

#[test]
fn a_resumed_study_is_the_same_bytes() {
    let study = [
        "study",
        "--submission",
        "23/raw/star",
        "--images",
        "2",
        "--grid",
        "8",
    ];
    // What is left is read back from the sets' results, biases and spectra alike.
    let clock = ["report.html", "bias/", "data/quality", "data/study"];
    resumed(&study, &clock);
}

/// A simulated data folder `d`, measured from beside it by a relative path.
struct Beside {
    root: tempfile::TempDir,
}

impl Beside {
    fn new() -> Self {
        let beside = Beside {
            root: tempfile::tempdir().unwrap(),
        };
        for place in ["here", "elsewhere"] {
            fs::create_dir(beside.at(place)).unwrap();
        }
        beside.simulate("here/d", "5");
        beside.simulate("elsewhere/d", "6");
        beside.succeed(
            "here",
            &[
                "measure",
                "--submission",
                "23/raw/star",
                "--data",
                "d",
                "--out",
                "out",
            ],
        );
        beside
    }

    fn at(&self, name: &str) -> PathBuf {
        self.root.path().join(name)
    }

    fn simulate(&self, folder: &str, seed: &str) {
        let simulate = [
            "simulate", "--sets", "2", "--images", "2", "--grid", "8", "--seed", seed,
        ];
        succeed(&[&simulate[..], &["--out", text(&self.at(folder))]].concat());
    }

    /// Runs the binary in a folder.
    fn run(&self, place: &str, arguments: &[&str]) -> Output {
        Command::new(env!("CARGO_BIN_EXE_shearq"))
            .args(arguments)
            .current_dir(self.at(place))
            .output()
            .expect("the binary starts")
    }

    fn succeed(&self, place: &str, arguments: &[&str]) -> String {
        let output = self.run(place, arguments);
        let said = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.success(), "{arguments:?}: {said}");
        String::from_utf8(output.stdout).unwrap() + &said
    }

    fn fail(&self, place: &str, arguments: &[&str]) -> String {
        let output = self.run(place, arguments);
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(1), "{arguments:?}: {said}");
        assert!(
            said.starts_with("error: ") && !said.contains("panicked"),
            "{said}"
        );
        said
    }

    /// Puts a file of the other data in the place of one of these.
    fn replace(&self, file: &str) {
        fs::copy(
            self.at("elsewhere/d").join(file),
            self.at("here/d").join(file),
        )
        .unwrap();
    }
}

#[test]
fn data_are_found_from_wherever_their_results_are_read() {
    let beside = Beside::new();
    let score = |place: &str, out: &str| {
        beside.succeed(place, &["score", "--measured", out, "--format", "csv"])
    };
    let expected = score("here", "out");
    // There is a folder of the same name, too.
    assert_eq!(score("elsewhere", "../here/out"), expected);
    let measure = |data: &str| {
        let measure = ["measure", "--submission", "23/raw/star", "--out", "out"];
        beside.succeed("here", &[&measure[..], &["--data", data]].concat())
    };
    let absolute = beside.at("here/d");
    for same in ["d", "./d", "d/", "../here/d", text(&absolute)] {
        assert!(measure(same).contains("2 there already"), "{same}");
    }
    beside.succeed(
        "here",
        &[
            "measure",
            "--submission",
            "23/raw/func",
            "--data",
            "./d/",
            "--out",
            "deep/func",
        ],
    );
    beside.succeed(
        "elsewhere",
        &["compare", "../here/out", "../here/deep/func"],
    );
    let other = [
        "measure",
        "--submission",
        "23/raw/star",
        "--out",
        "out",
        "--data",
        "../elsewhere/d",
    ];
    assert!(
        beside
            .fail("here", &other)
            .contains("\"../d\" ≠ \"../../elsewhere/d\"")
    );
    // Data and results that move together stay together.
    fs::rename(beside.at("here"), beside.at("there")).unwrap();
    assert_eq!(score("there", "out"), expected);
}

#[test]
fn a_replaced_truth_is_not_scored_against() {
    let beside = Beside::new();
    let score = ["score", "--measured", "out"];
    let other = [&score[..], &["--data", "../elsewhere/d"]].concat();
    assert!(
        beside
            .fail("here", &other)
            .contains("the file has changed since out/set02/catalogue-001.parquet was measured")
    );
    beside.replace("set02/truth.csv");
    for command in [&score[..], &["compare", "out"]] {
        let message = beside.fail("here", command);
        assert!(
            message.contains("d/set02/truth.csv: the file has changed since"),
            "{message}"
        );
    }
    fs::remove_file(beside.at("here/d/set02/truth.csv")).unwrap();
    beside.fail("here", &score);
}

#[test]
fn a_replaced_image_is_noticed() {
    for format in ["parquet", "fits"] {
        let beside = Beside::new();
        let measure = |name: &str, out: &str| {
            [
                "measure",
                "--submission",
                name,
                "--data",
                "d",
                "--out",
                out,
                "--catalogue-format",
                format,
            ]
            .map(str::to_owned)
        };
        let (star, func) = (
            measure("23/raw/star", "star"),
            measure("23/raw/func", "func"),
        );
        let (star, func) = (
            star.each_ref().map(|a| a.as_str()),
            func.each_ref().map(|a| a.as_str()),
        );
        beside.succeed("here", &star);
        beside.succeed("here", &func);
        let removed = beside.at(&format!("here/star/set02/catalogue-001.{format}"));
        let measured = fs::read(&removed).unwrap();
        let unfinished = || fs::remove_file(&removed).unwrap();
        unfinished();
        beside.replace("set02/psf-002.fits");
        let message = beside.fail("here", &star);
        assert!(
            message.contains("d/set02/psf-002.fits: the file has changed since"),
            "{message}"
        );
        // What is not there is measured, and what does not use the file is none the worse.
        fs::write(&removed, measured).unwrap();
        assert!(beside.fail("here", &star).contains("psf-002.fits"));
        assert!(beside.succeed("here", &func).contains("2 there already"));
        beside.replace("set02/galaxies-002.fits");
        for command in [
            &func[..],
            &["score", "--measured", "func"],
            &["merge", "func"],
        ] {
            let output = beside.run("here", command);
            assert_eq!(output.status.code(), Some(1), "{command:?}");
            let said = [output.stdout, output.stderr].concat();
            let said = String::from_utf8(said).unwrap();
            assert!(said.contains("galaxies"), "{command:?}: {said}");
        }
        // Of the galaxies, not of the truth, nothing is needed to score.
        fs::remove_file(Path::new(&beside.at("here/d/set02/galaxies-002.fits"))).unwrap();
        beside.succeed("here", &["score", "--measured", "func"]);
    }
}
