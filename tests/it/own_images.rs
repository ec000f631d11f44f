//! Images that people have: compressed, or with stamps of another size.

use std::fs;
use std::path::Path;

use serde_json::Value;
use shearq_files::fits::{self, ImageWriter};
use shearq_files::table;

use crate::support::{Small, fail, gzip, pixels_of, shearq, succeed, text};

const RAW: [&str; 2] = ["--submission", "23/raw/star"];

#[test]
fn compressed_images_and_stars_are_found() {
    let small = Small::new("2");
    small.measure(&RAW);
    let plain = columns(&small);
    let at = |name: &str| small.at("data/set02").join(name);
    let compress = |name: &str| {
        fs::write(
            at(&format!("{name}.gz")),
            gzip(&fs::read(at(name)).unwrap()),
        )
        .unwrap();
        fs::remove_file(at(name)).unwrap();
    };
    compress("galaxies-001.fits");
    compress("psf-002.fits");
    // What a file is follows from its content: fpack's ending is enough to find it.
    fs::rename(at("galaxies-002.fits"), at("galaxies-002.fits.fz")).unwrap();
    fs::rename(at("psf-001.fits"), at("psf-001.fits.fz")).unwrap();
    small.measure(&RAW);
    assert_eq!(columns(&small), plain);
    let (data, out) = (small.at("data"), small.at("out"));
    succeed(&["score", "--data", text(&data), "--measured", text(&out)]);
}

/// Bits of the numbers of both catalogues, which also name the fingerprints of the files measured.
fn columns(small: &Small) -> Vec<Vec<u64>> {
    let mut columns = Vec::new();
    for image in 1..=2 {
        let path = small.at(&format!("out/set02/catalogue-{image:03}.parquet"));
        let names = ["x", "y", "e1", "e2", "flags"];
        let table = table::read(&path, Some(&names), table::MAX_ROWS).unwrap();
        for name in names {
            let values = table::numbers(&table, name, &path).unwrap();
            columns.push(values.iter().map(|value| value.to_bits()).collect());
        }
    }
    columns
}

/// Puts the stamps of an image into larger ones and says so in its header.
fn enlarge(path: &Path, n: usize, stamp: usize, larger: usize) {
    let (pixels, side) = pixels_of(path);
    assert_eq!(side, n * stamp);
    let margin = (larger - stamp) / 2;
    let mut image = vec![0.0; n * larger * n * larger];
    for (y, row) in pixels.chunks(side).enumerate() {
        let line = y / stamp * larger + y % stamp + margin;
        for (ix, part) in row.chunks(stamp).enumerate() {
            let at = line * n * larger + ix * larger + margin;
            image[at..at + stamp].copy_from_slice(part);
        }
    }
    fs::remove_file(path).unwrap();
    let side = n * larger;
    let keys = [("STAMP", fits::Value::Int(larger as i64))];
    let mut writer = ImageWriter::create(path, side, side, &keys).unwrap();
    writer.write_rows(&image).unwrap();
    writer.finish().unwrap();
}

#[test]
fn stamps_of_the_header_are_measured_scored_packed_and_checked() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let (data, out, sent) = (at("data"), at("out"), at("sent"));
    let simulate = ["simulate", "--sets", "2", "--images", "2", "--grid", "16"];
    succeed(&[&simulate[..], &["--out", text(&data)]].concat());
    for image in ["galaxies-001.fits", "galaxies-002.fits"] {
        enlarge(&data.join("set02").join(image), 16, 48, 64);
    }
    let path = data.join("set02/truth.csv");
    let truth = fs::read_to_string(&path).unwrap();
    let mut moved = String::from("x,y,g1,g2\n");
    for line in truth
        .lines()
        .filter(|line| line.starts_with(|c: char| c.is_ascii_digit()))
    {
        let fields: Vec<&str> = line.split(',').collect();
        let place = |field: &str| (field.parse::<f64>().unwrap() - 24.5) / 48.0 * 64.0 + 32.5;
        let (x, y) = (place(fields[0]), place(fields[1]));
        moved += &format!("{x},{y},{},{}\n", fields[2], fields[3]);
    }
    fs::write(&path, moved).unwrap();
    let measure = ["measure", "--data", text(&data), "--out", text(&out)];
    succeed(&[&measure[..], &RAW].concat());
    let score = |input: &[&str]| -> Value {
        let arguments = [&["score", "--data", text(&data), "--format", "json"], input];
        serde_json::from_str(&succeed(&arguments.concat())).unwrap()
    };
    let q = |scores: &Value| scores["rows"][0]["q"].as_f64().unwrap();
    let measured = q(&score(&["--measured", text(&out)]));
    for (kind, expected) in [("catalogues", "q"), ("spectra", "q"), ("cross-spectra", "")] {
        let folder = sent.join(kind);
        let pack = ["pack", "--measured", text(&out), "--kind", kind];
        succeed(&[&pack[..], &["--out", text(&folder)]].concat());
        let packed = q(&score(&["--packed", text(&folder)]));
        assert!(
            expected.is_empty() || (packed / measured - 1.0).abs() < 1e-6,
            "{kind}: {packed} {measured}"
        );
        let check = shearq(&["check", text(&folder), "--data", text(&data)]);
        let found = String::from_utf8(check.stdout).unwrap();
        for fault in ["outside", "missing", "multipole", "duplicates"] {
            assert!(!found.contains(&format!("[{fault}]")), "{found}");
        }
    }
    // The layout says what images do not.
    fs::remove_file(data.join("set02/galaxies-001.fits")).unwrap();
    fs::remove_file(data.join("set02/galaxies-002.fits")).unwrap();
    let command = ["score", "--data", text(&data), "--measured", text(&out)];
    assert!(fail(&command).contains("truth.csv"));
    fs::write(data.join("layout.toml"), "stamp = 64\n").unwrap();
    assert_eq!(q(&score(&["--measured", text(&out)])), measured);
}
