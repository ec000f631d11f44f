//! Helpers of several tests: the binary in a folder, images that GalSim rendered, numbers of tables.

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use flate2::Compression;
use flate2::write::GzEncoder;
use serde_json::Value;
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
    let output = shell(root, line);
    let message = String::from_utf8(output.stderr).expect("UTF-8");
    assert_eq!(output.status.code(), Some(1), "{line}: {message}");
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

/// A temporary folder in which the binary runs.
pub struct Folder(tempfile::TempDir);

impl Folder {
    pub fn new() -> Self {
        Folder(tempfile::tempdir().expect("a temporary folder"))
    }

    /// With `data`: two images of 8 × 8 galaxies of set 2, which has one PSF, or 19, which has one per galaxy.
    pub fn with_set(set: u32) -> Self {
        let folder = Folder::new();
        let simulate = "simulate --fixed-psf one --images 2 --grid 8 --seed 5 --out data --sets";
        folder.run(&format!("{simulate} {set}"));
        folder
    }

    pub fn root(&self) -> &Path {
        self.0.path()
    }

    pub fn at(&self, name: &str) -> PathBuf {
        self.root().join(name)
    }

    pub fn write(&self, name: &str, content: impl AsRef<[u8]>) {
        let path = self.at(name);
        fs::create_dir_all(path.parent().expect("a folder")).expect("a new folder");
        fs::write(path, content).expect("written");
    }

    /// Writes an image in single precision.
    pub fn image(&self, name: &str, sides: &[usize], cards: &[&str], pixels: &[f32]) {
        self.write(name, fits_image(-32, sides, cards, &floats(pixels)));
    }

    /// Removes a file or folder, if there is one.
    pub fn remove(&self, name: &str) {
        let _ = fs::remove_file(self.at(name));
        let _ = fs::remove_dir_all(self.at(name));
    }

    /// Runs `shearq` with the words of a line, which must succeed, and gives its standard output.
    pub fn run(&self, line: &str) -> String {
        printed(self.root(), &format!("shearq {line}"))
    }

    /// The same, and gives its standard error.
    pub fn said(&self, line: &str) -> String {
        let output = shell(self.root(), &format!("shearq {line}"));
        let said = String::from_utf8(output.stderr).expect("UTF-8");
        assert!(output.status.success(), "{line}: {said}");
        said
    }

    /// Runs a line that must fail with an error, of which `words` are a part.
    pub fn refuses(&self, line: &str, words: &str) {
        assert_has(&refused(self.root(), &format!("shearq {line}")), words);
    }

    pub fn json(&self, line: &str) -> Value {
        let printed = self.run(&format!("{line} --format json"));
        serde_json::from_str(&printed).expect("JSON")
    }

    /// Measures `data` into a new folder `out`, and gives the standard error.
    pub fn measure(&self, options: &str) -> String {
        self.remove("out");
        self.said(&format!("measure --data data --out out {options}"))
    }

    /// Columns of a table.
    pub fn numbers<const N: usize>(&self, name: &str, columns: [&str; N]) -> [Vec<f64>; N] {
        let path = self.at(name);
        let table = table::read(&path, None, table::MAX_ROWS).expect("a table");
        columns.map(|column| {
            let values = table::numbers(&table, column, &path);
            values.expect("a column of it").into_owned()
        })
    }
}

/// A page of the documents is what generates it gives now; `SHEARQ_ACCEPT` writes it.
pub fn assert_page(page: impl AsRef<Path>, expected: &str, test: &str) {
    let page = page.as_ref();
    let found = fs::read_to_string(page).unwrap_or_default();
    if found != expected && std::env::var_os("SHEARQ_ACCEPT").is_some() {
        return fs::write(page, expected).expect("written");
    }
    let page = page.display();
    assert!(
        found == expected,
        "{page} is out of date. Try: SHEARQ_ACCEPT=1 cargo test --release --test it {test}"
    );
}

/// A text contains the parts of `words` between `[..]`, one after the other.
pub fn assert_has(text: &str, words: &str) {
    let mut rest = text;
    for part in words.split("[..]") {
        let Some((_, after)) = rest.split_once(part) else {
            panic!("expected {words}\nfound {text}");
        };
        rest = after;
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

/// The same as an extension of a file of several.
pub fn fits_extension(
    kind: &str,
    bitpix: i32,
    sides: &[usize],
    cards: &[&str],
    pixels: &[u8],
) -> Vec<u8> {
    let counts = ["PCOUNT  = 0", "GCOUNT  = 1"];
    let mut bytes = fits_image(bitpix, sides, &[&counts, cards].concat(), pixels);
    bytes[..80].copy_from_slice(format!("{:<80}", format!("XTENSION= '{kind:<8}'")).as_bytes());
    bytes
}

/// All pixels of an image, and its side.
pub fn pixels_of(path: &Path) -> (Vec<f32>, usize) {
    let mut image = shearq_files::fits::ImageReader::open(path).expect("an image");
    let side = image.width();
    (image.read_rows(side).expect("its pixels"), side)
}

/// The stamps of a mosaic, along its rows.
pub fn stamps_of(path: &Path, side: usize) -> Vec<Vec<f32>> {
    let (pixels, width) = pixels_of(path);
    stamps(&pixels, width, side)
}

pub fn stamps(pixels: &[f32], width: usize, side: usize) -> Vec<Vec<f32>> {
    let (n, rows) = (width / side, pixels.len() / width / side);
    let stamp = |k: usize| {
        let (x, y) = (k % n * side, k / n * side);
        let rows = (y..y + side).map(|row| &pixels[row * width + x..][..side]);
        rows.flatten().copied().collect()
    };
    (0..n * rows).map(stamp).collect()
}

/// The pixels of a mosaic of stamps in rows of `n`.
pub fn mosaic(stamps: &[f32], side: usize, n: usize) -> Vec<f32> {
    let pixel = |at: usize| {
        let (x, y) = (at % (n * side), at / (n * side));
        let stamp = y / side * n + x / side;
        stamps[(stamp * side + y % side) * side + x % side]
    };
    (0..stamps.len()).map(pixel).collect()
}

/// Pixels as FITS stores them.
pub fn floats(pixels: &[f32]) -> Vec<u8> {
    pixels.iter().flat_map(|v| v.to_be_bytes()).collect()
}

/// A Parquet file without the mark of its checksums, as one of another program: damage reaches the decoder.
pub fn without_checksums(mut bytes: Vec<u8>) -> Vec<u8> {
    let mark = bytes.windows(8).position(|own| own == b"CRC-32 1");
    bytes[mark.unwrap()] = b'-';
    bytes
}

/// Bytes as gzip stores them.
pub fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut gzip = GzEncoder::new(Vec::new(), Compression::fast());
    gzip.write_all(bytes).expect("in memory");
    gzip.finish().expect("in memory")
}
