//! Sizes and values beyond what anybody means: refused at once, naming what was found and what was expected.

use std::fs;
use std::io::Write;
use std::path::Path;

use flate2::Compression;
use flate2::write::GzEncoder;
use shearq_files::frames::polars::df;
use shearq_files::frames::{Metadata, read_parquet, write_parquet};

use crate::support::{Small, fail, run_simulated, shearq, succeed, text};

/// Bytes repeated and compressed.
fn packed(path: &Path, start: &[u8], part: &[u8], times: usize) {
    let mut gzip = GzEncoder::new(fs::File::create(path).unwrap(), Compression::fast());
    gzip.write_all(start).unwrap();
    for _ in 0..times {
        gzip.write_all(part).unwrap();
    }
    gzip.finish().unwrap();
}

fn has(message: &str, words: &[&str]) {
    for word in words {
        assert!(message.contains(word), "`{word}` is not in: {message}");
    }
    // However long what it quotes.
    assert!(message.len() < 20_000);
}

#[test]
fn fields_beyond_the_sky_and_shears_beyond_numbers_are_refused() {
    let small = Small::new("2");
    small.measure(&["--submission", "23/raw/star"]);
    let truth = small.at("data/set02/truth.csv");
    let catalogue = small.at("out/set02/catalogue-001.parquet");
    let out = small.at("new");
    for field in ["1e308", "1e12", "361", "1e-300", "nan"] {
        let plain = ["score", "--truth", text(&truth), text(&catalogue)];
        let error = fail(&[&plain[..], &["--field", field]].concat());
        has(&error, &["degrees per side; expected 0.001 to 360"]);
    }
    for field in ["1e12", "1e-320"] {
        fs::write(
            small.at("data/layout.toml"),
            format!("field_degrees = {field}\n"),
        )
        .unwrap();
        let error = small.fail_to_measure(&["--submission", "23/raw/star"]);
        has(&error, &["layout.toml", "expected 0.001 to 360"]);
    }
    for (option, words) in [
        (
            "--tilt=-300",
            "the simulation's tilt is -300; expected -20 to 20",
        ),
        ("--tilt=1000", "the simulation's tilt is 1000"),
        ("--tilt=-19", "not weak"),
    ] {
        let simulate = ["simulate", "--sets", "2", "--images", "1", "--grid", "8"];
        let more = ["--amplitude", "1e9", option, "--out", text(&out)];
        let output = shearq(&[&simulate[..], &more].concat());
        let error = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(1), "{error}");
        has(
            &error,
            &[if option == "--tilt=-19" {
                "shear"
            } else {
                words
            }],
        );
        assert!(!out.join("set02/truth.csv").exists());
    }
}

#[test]
fn what_small_compressed_files_unpack_to_is_bounded() {
    let small = Small::new("2");
    let truth = small.at("data/set02/truth.csv");
    let rows = fs::read_to_string(&truth).unwrap();
    let table = |name: &str, separator: &str| {
        let lines = rows.lines().skip(1).map(|row| {
            let position: Vec<&str> = row.split(',').take(2).collect();
            format!(
                "{}{separator}0.01{separator}0.02\n",
                position.join(separator)
            )
        });
        let header = ["x", "y", "e1", "e2"].join(separator) + "\n";
        (small.at(name), header + &lines.collect::<String>())
    };
    let blank = vec![b'\n'; 1 << 20];
    let comments = b"#\n".repeat(1 << 19);
    let spaces = b" \n".repeat(1 << 19);
    for (k, (separator, part)) in [
        (" ", &blank),
        (" ", &comments),
        (",", &comments),
        (",", &spaces),
    ]
    .into_iter()
    .enumerate()
    {
        let (path, start) = table(&format!("blanks-{k}.dat.gz"), separator);
        packed(&path, start.as_bytes(), part, 4);
        let error = fail(&["score", "--truth", text(&truth), text(&path)]);
        has(
            &error,
            &[
                "blanks-",
                "a row with what stands before it has more than 1048576 bytes",
            ],
        );
    }
    let many = b"1,2,0,0\n".repeat(100_000);
    let path = small.at("many.csv.gz");
    packed(&path, b"x,y,g1,g2\n", &many, 11);
    let (catalogue, text_of) = table("good.csv", ",");
    fs::write(&catalogue, text_of).unwrap();
    let error = fail(&["score", "--truth", text(&path), text(&catalogue)]);
    has(&error, &["many.csv.gz", "expected at most 1048576 rows"]);
}

#[test]
fn settings_are_no_gigabytes_and_messages_quote_no_megabytes() {
    let small = Small::new("2");
    let comments = "# words\n".repeat(700_000);
    let own = small.at("own.toml");
    fs::write(&own, format!("extends = \"paper\"\n{comments}")).unwrap();
    has(
        &small.fail_to_measure(&["--submission", text(&own)]),
        &["own.toml", "more than 1048576 bytes"],
    );
    let layout = small.at("data/layout.toml");
    fs::write(&layout, &comments).unwrap();
    has(
        &small.fail_to_measure(&["--submission", "23/raw/star"]),
        &["layout.toml", "more than 4194304 bytes"],
    );
    fs::write(&layout, format!("x = \"{}\"\n", "y".repeat(1 << 20))).unwrap();
    has(
        &small.fail_to_measure(&["--submission", "23/raw/star"]),
        &["layout.toml", "…"],
    );
    fs::remove_file(&layout).unwrap();
    let psf = small.at("data/set02/psf-001.csv");
    fs::write(&psf, "x".repeat(1 << 21)).unwrap();
    has(
        &small.fail_to_measure(&["--submission", "23/raw/func"]),
        &["psf-001.csv", "the header is `xxx"],
    );
}

#[test]
fn footers_of_parquet_files_are_bounded() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("long.parquet");
    let frame = df!("x" => [1.0]).unwrap();
    let metadata = Metadata::from([("a".to_owned(), "x".repeat(1 << 24))]);
    write_parquet(fs::File::create(&path).unwrap(), &frame, &metadata).unwrap();
    let error = read_parquet(&path, None, 1).unwrap_err().to_string();
    has(&error, &["long.parquet", "expected at most 16777216"]);
}

#[test]
fn a_galaxy_has_one_psf() {
    let small = Small::new("19");
    let psf = small.at("data/set19/psf-001.csv");
    let table = fs::read_to_string(&psf).unwrap();
    let second = table.lines().nth(1).unwrap();
    fs::write(&psf, format!("{table}{second}\n")).unwrap();
    has(
        &small.fail_to_measure(&["--submission", "23/raw/func"]),
        &[
            "psf-001.csv",
            "the galaxy at (",
            "has two rows; expected one",
        ],
    );
}

#[test]
fn options_and_baselines_hold_finite_positive_limits() {
    let root = tempfile::tempdir().unwrap();
    let (out, folder) = (root.path().join("out"), root.path().join("baselines"));
    for value in ["nan", "inf", "-1", "0"] {
        for arguments in [
            vec!["score", "--truth", "t", "c", "--max-modulus", value],
            vec!["baseline", "check", "--sigma", value],
        ] {
            let output = shearq(&arguments);
            let message = String::from_utf8(output.stderr).unwrap();
            assert_eq!(output.status.code(), Some(2), "{arguments:?}: {message}");
        }
    }
    run_simulated("2,5", "23/raw/star", &out, &[]);
    let record = ["baseline", "record", "mine", "--folder", text(&folder)];
    succeed(&[&record[..], &["--measured", text(&out)]].concat());
    let path = folder.join("mine.toml");
    let sound = fs::read_to_string(&path).unwrap();
    let start = sound.find("\nq = [").unwrap() + "\nq = [".len();
    let end = start + sound[start..].find(',').unwrap();
    let shorter = &sound[..sound.rfind("[[submissions.sets]]").unwrap()];
    let negative = sound[end..].replacen(", ", ", -", 1);
    for (text_of, words) in [
        (
            format!("{}inf{}", &sound[..start], &sound[end..]),
            "set 2: a metric is infinite",
        ),
        (
            format!("{}{negative}", &sound[..end]),
            "its error is infinite or negative",
        ),
        (
            shorter.to_owned(),
            "found 1 sets, expected 2 as in `sets_held`",
        ),
    ] {
        fs::write(&path, text_of).unwrap();
        let error = fail(&["baseline", "check", "--folder", text(&folder)]);
        has(&error, &["mine.toml", words]);
    }
}

#[cfg(unix)]
#[test]
fn results_replace_files_and_nothing_else() {
    use std::os::unix::fs::{FileTypeExt, symlink};
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let (out, folder, pipe) = (at("out"), at("baselines"), at("pipe"));
    run_simulated("2", "23/raw/star", &out, &[]);
    let record = ["baseline", "record", "mine", "--folder", text(&folder)];
    succeed(&[&record[..], &["--measured", text(&out)]].concat());
    let made = std::process::Command::new("mkfifo").arg(&pipe).status();
    assert!(made.unwrap().success());
    let check = ["baseline", "check", "--folder", text(&folder), "--junit"];
    let error = fail(&[&check[..], &[text(&pipe)]].concat());
    has(&error, &["pipe", "no regular file"]);
    assert!(fs::metadata(&pipe).unwrap().file_type().is_fifo());
    // What a link names is written, and the link stays.
    let (link, real) = (at("link.xml"), at("real.xml"));
    fs::write(&real, "before").unwrap();
    symlink("real.xml", &link).unwrap();
    succeed(&[&check[..], &[text(&link)]].concat());
    assert!(link.is_symlink() && fs::read_to_string(&real).unwrap().contains("<testsuite"));
}

#[test]
fn what_is_not_scored_and_what_changed_since_is_said() {
    let small = Small::new("2");
    small.measure(&["--submission", "23/raw/star"]);
    let (data, out) = (small.at("data"), small.at("out"));
    let score = ["score", "--measured", text(&out)];
    assert!(!succeed(&score).contains("no catalogue"));
    let first = out.join("set02/catalogue-001.parquet");
    let kept = fs::read(&first).unwrap();
    fs::remove_file(&first).unwrap();
    let lacking = "1 of the 2 images of set 2 have no catalogue";
    has(&succeed(&score), &[lacking]);
    has(&succeed(&["compare", text(&out), text(&out)]), &[lacking]);
    fs::write(&first, kept).unwrap();
    fs::write(data.join("layout.toml"), "field_degrees = 5\n").unwrap();
    has(
        &fail(&score),
        &["layout.toml", "5.0", "was measured with", "10.0"],
    );
}

#[test]
fn spectra_of_other_multipoles_and_files_of_unknown_sets_are_noticed() {
    let small = Small::new("2");
    small.measure(&["--submission", "23/raw/star"]);
    let (data, out, packed) = (small.at("data"), small.at("out"), small.at("packed"));
    let pack = [
        "pack",
        "--measured",
        text(&out),
        "--kind",
        "spectra",
        "--out",
    ];
    succeed(&[&pack[..], &[text(&packed)]].concat());
    let score = ["score", "--data", text(&data), "--packed", text(&packed)];
    succeed(&score);
    let spectrum = fs::read_dir(&packed)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .find(|path| path.extension().is_some_and(|ending| ending == "dat"))
        .unwrap();
    let lines = fs::read_to_string(&spectrum).unwrap();
    let fields: Vec<Vec<&str>> = lines
        .lines()
        .map(|line| line.split(' ').collect())
        .collect();
    let moved = fields.iter().map(|f| {
        let l: f64 = f[1].parse().unwrap();
        format!("{} {} {}\n", f[0], 2.0 * l, f[2])
    });
    fs::write(&spectrum, moved.collect::<String>()).unwrap();
    let truth = data.join("set02/truth.csv");
    let plain = [
        "score",
        "--truth",
        text(&truth),
        "--spectra",
        text(&spectrum),
    ];
    has(&fail(&plain), &[".dat", "bin 2 has l = ", "8 × 8 cells"]);
    // A catalogue whose name tells no set, where the data have two.
    let simulate = ["simulate", "--images", "1", "--grid", "8", "--sets", "7"];
    let seed = ["--seed", "5", "--out", text(&data)];
    succeed(&[&simulate[..], &seed].concat());
    let rows = fs::read_to_string(&truth).unwrap();
    let own = small.at("own.csv");
    fs::write(&own, rows.replacen("x,y,g1,g2", "x,y,e1,e2", 1)).unwrap();
    let found = succeed(&["check", text(&own), "--data", text(&data)]);
    has(&found, &["[truth]", "not compared with the true shear"]);
}

#[test]
fn lines_that_end_in_carriage_returns_are_named() {
    let small = Small::new("2");
    let truth = small.at("data/set02/truth.csv");
    let old = small.at("old.csv");
    fs::write(&old, "x,y,e1,e2\r24.5,24.5,0.1,0.2\r").unwrap();
    let error = fail(&["score", "--truth", text(&truth), text(&old)]);
    has(&error, &["old.csv", "line 1 holds carriage returns"]);
}
