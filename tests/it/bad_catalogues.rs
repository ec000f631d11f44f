//! Catalogues and records with wrong columns, types or bytes: one error that names file and fault.

use std::fs;
use std::path::Path;

use crate::bad_images::gzip;
use crate::support::{Small, fail, fits_image, shearq, succeed, text};

#[test]
fn catalogues_with_mistakes_are_named_with_file_and_place() {
    let small = Small::new("2");
    small.measure(&["--submission", "23/raw/star", "--catalogue-format", "fits"]);
    let fits = fs::read(small.at("out/set02/catalogue-001.fits")).unwrap();
    small.measure(&["--submission", "23/raw/star"]);
    let parquet = fs::read(small.at("out/set02/catalogue-001.parquet")).unwrap();
    let truth = small.at("data/set02/truth.csv");
    let refuse = |name: &str, bytes: &[u8], expected: &str| {
        let path = small.at(name);
        fs::write(&path, bytes).unwrap();
        let message = fail(&["score", "--truth", text(&truth), text(&path)]);
        assert!(
            message.contains(name) && message.contains(expected),
            "{message}"
        );
        assert_eq!(message.lines().count(), 1, "{message}");
    };
    refuse(
        "c.csv",
        b"x,y,e1\n1,2,3\n",
        "there is no column `e2`; columns found: x, y, e1",
    );
    refuse(
        "c.csv",
        b"x,y,e1,e1,e2\n1,2,3,4,5\n",
        "two columns named `e1`",
    );
    refuse(
        "c.csv",
        b"x,y,e1,e2\n1,2,3,zero\n",
        "line 2: `zero` in column `e2` is not a number",
    );
    refuse(
        "c.csv",
        b"x,y,e1,e2\n1,2,3,4\n1,2,3\n",
        "line 3: 3 fields; expected 4",
    );
    refuse(
        "c.csv",
        b"id,x,y,g1,g2\n1,2,3,4,5\n",
        "no column `e1`; columns found: id, x, y, g1, g2; `score --columns`",
    );
    refuse("c.csv", b"x,y,e1,e2\n1,2,\xff,4\n", "line 2 is not UTF-8");
    refuse(
        "c.csv",
        b"x,y,e1,e2\n1e9,2,3,4\n",
        "no row of the 1 catalogue(s) is on the 8",
    );
    refuse("c.fits", b"", "the file is empty; expected a FITS table");
    refuse("c.fits", b"x,y,e1,e2\n1,2,3,4\n", "`SIMPLE`");
    refuse(
        "c.fits",
        &fits_image(8, &[2, 2], &[], &[0; 4]),
        "there is no table in this file",
    );
    refuse("c.fits", &fits[..fits.len() / 2], "truncated");
    let edited = |from: &str, to: &str| {
        let at = fits
            .windows(from.len())
            .position(|w| w == from.as_bytes())
            .unwrap();
        let mut bytes = fits.clone();
        bytes[at..at + to.len()].copy_from_slice(to.as_bytes());
        bytes
    };
    refuse(
        "c.fits",
        &edited("'e2      '", "'shape   '"),
        "no column `e2`; columns found: x, y, e1, shape",
    );
    // Of the same width as the double precision there, so that the rest of the table stands.
    for (column, kind) in [("3", "'1C"), ("3", "'2E"), ("3", "'8A")] {
        let card = format!("TFORM{column}  = ");
        let bytes = edited(&format!("{card}'1D"), &format!("{card}{kind}"));
        refuse(
            "c.fits",
            &bytes,
            "column `e1` does not hold one number per row",
        );
    }
    refuse("c.parquet", b"", "not a readable Parquet file");
    refuse(
        "c.parquet",
        &parquet[..parquet.len() / 2],
        "must end with PAR1",
    );
    let folder = small.at("folder.csv");
    fs::create_dir(&folder).unwrap();
    let message = fail(&["score", "--truth", text(&truth), text(&folder)]);
    assert!(
        message.contains("folder.csv: cannot read the table"),
        "{message}"
    );
    let message = fail(&[
        "score",
        "--truth",
        text(&truth),
        text(&small.at("absent.csv")),
    ]);
    assert!(
        message.contains("absent.csv: cannot read the table"),
        "{message}"
    );
}

/// Whatever the bytes, there is one error or none; polars' own panics are caught and stay silent.
#[test]
fn damaged_parquet_is_one_error_without_a_panic_message() {
    let small = Small::new("2");
    small.measure(&["--submission", "23/raw/star"]);
    let whole = fs::read(small.at("out/set02/catalogue-001.parquet")).unwrap();
    let truth = small.at("data/set02/truth.csv");
    let path = small.at("c.parquet");
    // Every 41st byte of the pages' headers and of the footer.
    for at in (0..whole.len())
        .step_by(41)
        .filter(|at| *at < 200 || *at + 1500 > whole.len())
    {
        let mut bytes = whole.clone();
        bytes[at] ^= 0x7f;
        fs::write(&path, bytes).unwrap();
        let output = shearq(&["score", "--truth", text(&truth), text(&path)]);
        let message = String::from_utf8(output.stderr).unwrap();
        assert!(
            output.status.code().is_some_and(|code| code <= 1),
            "byte {at}: {message}"
        );
        assert!(
            message.lines().count() <= 1 && !message.contains("panicked"),
            "{message}"
        );
    }
}

#[test]
fn records_and_folders_that_are_not_what_they_should_be_are_refused() {
    let small = Small::new("2");
    let raw = ["--submission", "23/raw/star"];
    small.measure(&raw);
    let (data, out) = (small.at("data"), small.at("out"));
    let score = || fail(&["score", "--data", text(&data), "--measured", text(&out)]);
    let measure = |data: &Path, out: &Path| {
        fail(
            &[
                &["measure", "--data", text(data), "--out", text(out)],
                &raw[..],
            ]
            .concat(),
        )
    };
    for (content, expected) in [
        ("{", "not a record"),
        ("{}", "missing field"),
        (
            "{}",
            "the record belongs to another version. Try: another folder",
        ),
        ("\u{1}", "not a record"),
    ] {
        fs::write(out.join("run.json"), content).unwrap();
        for message in [score(), measure(&data, &out)] {
            assert!(
                message.contains("run.json") && message.contains(expected),
                "{message}"
            );
        }
    }
    fs::remove_file(out.join("run.json")).unwrap();
    assert!(score().contains("there is no run.json"));
    let file = small.at("file");
    fs::write(&file, "").unwrap();
    assert!(measure(&data, &file).contains("file/run.json: cannot read the record"));
    assert!(measure(&file, &out).contains("file: there is no such folder; expected a data folder"));
    assert!(measure(&small.at("absent"), &out).contains("there is no such folder"));
}

/// Catalogues of tools that people have give the scores of the same numbers as plain as can be.
#[test]
fn catalogues_of_other_tools_are_scored() {
    let small = Small::new("2");
    small.measure(&["--submission", "23/raw/star"]);
    let truth = small.at("data/set02/truth.csv");
    let columns = ["x", "y", "e1", "e2"].map(|name| small.measured("02", name));
    let write = |name: &str, text: String| {
        let bytes = match name.ends_with(".gz") {
            true => gzip(text.as_bytes()),
            false => text.into_bytes(),
        };
        fs::write(small.at(name), bytes).unwrap();
    };
    let rows = |row: &dyn Fn(usize, [String; 4]) -> String| -> String {
        (0..columns[0].len())
            .map(|k| row(k, std::array::from_fn(|c| columns[c][k].to_string())))
            .collect()
    };
    let score = |name: &str| {
        let path = small.at(name);
        let arguments = ["score", "--truth", text(&truth), "--truth-sign", "standard"];
        succeed(&[&arguments[..], &["--format", "csv", text(&path)]].concat())
    };
    write(
        "plain.dat",
        rows(&|_, [x, y, e1, e2]| format!("{x} {y} {e1} {e2}\n")),
    );
    let plain = score("plain.dat");
    let pandas = rows(&|k, [x, y, e1, e2]| format!("{k},\"a, b\",{x},{y},,{e1},{e2}\n"));
    write("pandas.csv", format!(",name,x,y,class,e1,e2\n{pandas}"));
    let pandas = rows(&|k, [x, y, e1, e2]| format!("{k},{x},{y},{e1},{e2}\r\n"));
    write("pandas.csv.gz", format!("\u{feff},x,y,e1,e2\r\n{pandas}"));
    let european = rows(&|_, [x, y, e1, e2]| format!("{y};{x};{e1};{e2}\n"));
    write(
        "semicolons.csv",
        format!("y;x;e1;e2\n# made, by me\n{european}"),
    );
    let blanks = rows(&|_, [x, y, e1, e2]| format!("  {x}  {y} {e1}\t{e2}\n"));
    write("blanks.txt", format!("# made by me, by hand\n{blanks}"));
    for name in [
        "pandas.csv",
        "pandas.csv.gz",
        "semicolons.csv",
        "blanks.txt",
    ] {
        assert_eq!(score(name), plain, "{name}");
    }
    fs::copy(
        small.at("out/set02/catalogue-001.parquet"),
        small.at("catalogue.pq"),
    )
    .unwrap();
    assert_eq!(score("catalogue.pq"), plain);
    // More rows than any catalogue of this grid has, and a row that has no end.
    write("many.csv.gz", "1,2,3,4\n".repeat(400_000));
    let many = small.at("many.csv.gz");
    let message = fail(&["score", "--truth", text(&truth), text(&many)]);
    assert!(
        message.contains("expected at most 262208 rows"),
        "{message}"
    );
    write("long.csv.gz", "1".repeat(1 << 24));
    let long = small.at("long.csv.gz");
    let message = fail(&["score", "--truth", text(&truth), text(&long)]);
    assert!(message.contains("more than 1048576 bytes"), "{message}");
}
