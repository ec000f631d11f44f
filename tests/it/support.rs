//! Helpers of several tests: the binary and a shell, images that GalSim rendered, numbers from CSV files.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use flate2::Compression;
use flate2::write::GzEncoder;
use shearq_files::table;

/// The images of `tests/data` that fpack made, one for each of its ways.
pub const PACKED: [&str; 4] = ["rice", "gzip", "lossless", "dithered"];

/// Sets that GalSim rendered: a tenth that is stored here, and all if they are in `../shared/galsim-sets`.
pub fn galsim_sets() -> Vec<PathBuf> {
    let stored = Path::new("tests/data/galsim/sets");
    assert!(stored.is_dir(), "{} is missing", stored.display());
    let mut found = vec![stored.to_owned()];
    found.extend(Path::new("../shared/galsim-sets").canonicalize());
    found
}

/// Runs the binary.
pub fn shearq(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_shearq"))
        .args(arguments)
        .output()
        .expect("the binary starts")
}

/// Runs the binary, which must succeed, and gives its standard output.
pub fn succeed(arguments: &[&str]) -> String {
    let output = shearq(arguments);
    assert!(
        output.status.success(),
        "{arguments:?}: {}",
        String::from_utf8_lossy(&output.stderr)
    );
    String::from_utf8(output.stdout).expect("UTF-8")
}

/// Runs the binary, which must fail with exit code 1 and one error, and gives that.
pub fn fail(arguments: &[&str]) -> String {
    one_error(shearq(arguments), &arguments)
}

/// Runs a line of a shell in a folder, where `shearq` is the binary.
pub fn shell(root: &Path, line: &str) -> Output {
    let binary = Path::new(env!("CARGO_BIN_EXE_shearq")).parent().unwrap();
    let path = std::env::var("PATH").unwrap_or_default();
    Command::new("sh")
        .args(["-c", line])
        .current_dir(root)
        .env("PATH", format!("{}:{path}", binary.display()))
        .output()
        .expect("a shell")
}

/// Runs a line of a shell, which must succeed, and gives its standard output.
pub fn printed(root: &Path, line: &str) -> String {
    let output = shell(root, line);
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{line}: {said}");
    String::from_utf8(output.stdout).expect("UTF-8")
}

/// Runs a line of a shell, which must fail with exit code 1 and one error, and gives that.
pub fn refused(root: &Path, line: &str) -> String {
    one_error(shell(root, line), &line)
}

fn one_error(output: Output, command: &dyn std::fmt::Debug) -> String {
    let message = String::from_utf8(output.stderr).expect("UTF-8");
    assert_eq!(output.status.code(), Some(1), "{command:?}: {message}");
    assert!(message.starts_with("error: "), "{message}");
    assert!(!message.contains("panicked"), "{message}");
    message
}

/// Every file below a folder with its content.
pub fn contents(folder: &Path) -> Vec<(String, Vec<u8>)> {
    let mut found = Vec::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(next) = folders.pop() {
        for entry in std::fs::read_dir(next).expect("readable folder") {
            let path = entry.expect("readable folder").path();
            if path.is_dir() {
                folders.push(path);
            } else {
                let name = path.strip_prefix(folder).expect("below the folder");
                let content = std::fs::read(&path).expect("readable file");
                found.push((name.display().to_string(), content));
            }
        }
    }
    found.sort();
    found
}

/// A path as an argument.
pub fn text(path: &Path) -> &str {
    path.to_str().expect("UTF-8 path")
}

/// Columns of a CSV file by name.
pub fn csv(path: &Path, names: &[&str]) -> Vec<Vec<f64>> {
    let content = std::fs::read_to_string(path).expect("readable CSV");
    let mut lines = content.lines();
    let header: Vec<&str> = lines.next().expect("header").split(',').collect();
    let places: Vec<usize> = names
        .iter()
        .map(|name| header.iter().position(|h| h == name).expect("column"))
        .collect();
    let mut columns = vec![Vec::new(); names.len()];
    for line in lines {
        let fields: Vec<&str> = line.split(',').collect();
        for (column, &place) in columns.iter_mut().zip(&places) {
            column.push(fields[place].parse().expect("number"));
        }
    }
    columns
}

/// A simulated set of two images of 8 × 8 galaxies, for tests that spoil one of its files.
pub struct Small {
    root: tempfile::TempDir,
}

impl Small {
    /// Set 2, which has one PSF, or set 19, which has one per galaxy.
    pub fn new(set: &str) -> Self {
        let root = tempfile::tempdir().expect("a temporary folder");
        let data = root.path().join("data");
        let simulate = ["simulate", "--images", "2", "--grid", "8", "--seed", "5"];
        succeed(&[&simulate[..], &["--sets", set, "--out", text(&data)]].concat());
        Small { root }
    }

    /// The temporary folder.
    pub fn root(&self) -> &Path {
        self.root.path()
    }

    /// A path in the temporary folder.
    pub fn at(&self, name: &str) -> PathBuf {
        self.root.path().join(name)
    }

    /// Measures `data` into a new folder `out`, as `settings` say.
    fn measured_into_out(&self, settings: &[&str]) -> Output {
        let line = "rm -rf out; shearq measure --data data --out out";
        shell(self.root.path(), &format!("{line} {}", settings.join(" ")))
    }

    /// The same, and must fail; gives the error.
    pub fn fail_to_measure(&self, settings: &[&str]) -> String {
        one_error(self.measured_into_out(settings), &settings)
    }

    /// The same, and must succeed; gives what was printed on standard error.
    pub fn measure(&self, settings: &[&str]) -> String {
        let output = self.measured_into_out(settings);
        let said = String::from_utf8(output.stderr).expect("UTF-8");
        assert!(output.status.success(), "{said}");
        said
    }

    /// A column of the first image's catalogue in `out`.
    pub fn measured(&self, set: &str, column: &str) -> Vec<f64> {
        let path = self.at(&format!("out/set{set}/catalogue-001.parquet"));
        let table = table::read(&path, None, table::MAX_ROWS).expect("a catalogue");
        table::numbers(&table, column, &path)
            .expect("a column of it")
            .into_owned()
    }
}

/// A FITS file of one image: the cards given after SIMPLE, BITPIX, NAXIS and its sides, and the
/// bytes of its pixels.
pub fn fits_image(bitpix: i32, sides: &[usize], cards: &[&str], pixels: &[u8]) -> Vec<u8> {
    // Files are made of blocks of so many bytes.
    const BLOCK: usize = 2880;
    let mut header = vec![
        "SIMPLE  =                    T".to_owned(),
        format!("BITPIX  = {bitpix:>20}"),
        format!("NAXIS   = {:>20}", sides.len()),
    ];
    for (k, side) in sides.iter().enumerate() {
        header.push(format!("NAXIS{:<3}= {side:>20}", k + 1));
    }
    header.extend(cards.iter().map(|card| (*card).to_owned()));
    header.push("END".to_owned());
    let mut bytes: Vec<u8> = header
        .iter()
        .flat_map(|card| format!("{card:<80}").into_bytes())
        .collect();
    bytes.resize(bytes.len().next_multiple_of(BLOCK), b' ');
    bytes.extend_from_slice(pixels);
    bytes.resize(bytes.len().next_multiple_of(BLOCK), 0);
    bytes
}

/// All pixels of an image, and its side.
pub fn pixels_of(path: &Path) -> (Vec<f32>, usize) {
    let mut image = shearq_files::fits::ImageReader::open(path).expect("an image");
    let side = image.width();
    (image.read_rows(side).expect("its pixels"), side)
}

/// Pixels as FITS stores them.
pub fn floats(pixels: &[f32]) -> Vec<u8> {
    pixels.iter().flat_map(|v| v.to_be_bytes()).collect()
}

/// Bytes as gzip stores them.
pub fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut gzip = GzEncoder::new(Vec::new(), Compression::fast());
    gzip.write_all(bytes).expect("in memory");
    gzip.finish().expect("in memory")
}
