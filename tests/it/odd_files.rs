//! Pipes, devices, folders and links to nothing in the place of files: an error that names them, at once,
//! and nothing left out without a word.

use std::fs;
use std::os::unix::fs::symlink;
use std::path::Path;
use std::process::Command;

use crate::support::{Small, text};

/// Runs the binary, which must fail with an error before long, and gives that.
fn fail_soon(arguments: &[&str]) -> String {
    let output = Command::new("timeout")
        .args(["60", env!("CARGO_BIN_EXE_shearq")])
        .args(arguments)
        .output()
        .expect("timeout starts");
    // `check` prints what it finds.
    let message = String::from_utf8([output.stdout, output.stderr].concat()).expect("UTF-8");
    assert_eq!(output.status.code(), Some(1), "{arguments:?}: {message}");
    message
}

fn remove(path: &Path) {
    if path.is_dir() {
        fs::remove_dir_all(path).expect("removed");
    } else {
        let _ = fs::remove_file(path);
    }
}

#[test]
fn pipes_and_devices_are_refused_wherever_a_file_is_read() {
    let small = Small::new("2");
    let (data, out, other) = (small.at("data"), small.at("out"), small.at("other"));
    let measure = ["--submission", "23/raw/star"];
    small.measure(&measure);
    let archive = small.at("a.tar.gz");
    let (data, out, other, archive) = (text(&data), text(&out), text(&other), text(&archive));
    let odd = small.at("odd");
    let odd_text = text(&odd).to_owned();
    let measure_star = [
        "measure",
        "--data",
        data,
        "--out",
        other,
        "--submission",
        "23/raw/star",
    ];
    let measure_func = [
        "measure",
        "--data",
        data,
        "--out",
        other,
        "--submission",
        "23/raw/func",
    ];
    let score = ["score", "--data", data, "--measured", out];
    let foreign = ["score", "--data", data, "--foreign", &odd_text];
    let truth = format!("{data}/set02/truth.csv");
    let catalogue = format!("{out}/set02/catalogue-001.parquet");
    let score_files = ["score", "--truth", &truth, &odd_text];
    let score_truth = ["score", "--truth", &odd_text, &catalogue];
    let check = ["check", &odd_text];
    let unpack = ["unpack", &odd_text, "--out", archive];
    let cases: [(&str, &[&str]); 12] = [
        ("data/set02/galaxies-001.fits", &measure_star),
        ("data/set02/psf-001.fits", &measure_star),
        ("data/set02/psf-001.csv", &measure_func),
        ("data/layout.toml", &measure_star),
        ("data/set02/truth.csv", &score),
        ("out/set02/catalogue-001.parquet", &score),
        ("out/run.json", &score),
        ("odd", &foreign),
        ("odd", &score_files),
        ("odd", &score_truth),
        ("odd", &check),
        ("odd", &unpack),
    ];
    let odd_things: [&dyn Fn(&Path); 3] = [
        &|path| {
            let made = Command::new("mkfifo")
                .arg(path)
                .status()
                .expect("mkfifo starts");
            assert!(made.success());
        },
        &|path| symlink("/dev/zero", path).expect("a link"),
        &|path| symlink("/nowhere", path).expect("a link"),
    ];
    for (name, arguments) in cases {
        let path = small.at(name);
        let whole = fs::read(&path).ok();
        for make in odd_things {
            remove(&path);
            remove(Path::new(other));
            make(&path);
            let message = fail_soon(arguments);
            let name = path.file_name().unwrap().to_str().unwrap();
            assert!(
                message.contains(name) || message.contains(out),
                "{name}: {message}"
            );
        }
        remove(&path);
        if let Some(whole) = whole {
            fs::write(&path, whole).expect("written");
        }
    }
    // A results store reads whatever is called like a part of it.
    fs::create_dir(small.at("store")).expect("made");
    symlink("/dev/zero", small.at("store/a.parquet")).expect("a link");
    let store = small.at("store");
    let message = fail_soon(&["compare", "--store", text(&store)]);
    assert!(message.contains("a.parquet"), "{message}");
}

#[test]
fn images_and_folders_that_cannot_be_read_are_named_and_missed() {
    let small = Small::new("2");
    let (data, out) = (small.at("data"), small.at("out"));
    let second = small.at("data/set02/galaxies-002.fits");
    let raw = ["--submission", "23/raw/star"];
    let merge = ["merge", text(&out)];
    let things: [&dyn Fn(); 2] = [&|| symlink("/nowhere", &second).expect("a link"), &|| {
        fs::create_dir(&second).expect("a folder");
    }];
    for make in things {
        remove(&second);
        make();
        let message = small.fail_to_measure(&raw);
        assert!(
            message.contains("galaxies-002.fits: cannot open the file"),
            "{message}"
        );
        // The first image is done, and the second one is missed.
        let output = crate::support::shearq(&merge);
        let said = String::from_utf8(output.stdout).expect("UTF-8");
        assert_eq!(output.status.code(), Some(1), "{said}");
        assert!(
            said.contains("2/2: ") && said.contains("1 of 2 images"),
            "{said}"
        );
    }
    // A set that cannot be read beside one that can.
    for (target, expected) in [
        ("set05", "cannot read the folder"),
        ("nowhere", "broken link"),
    ] {
        let link = data.join("set05");
        remove(&link);
        symlink(target, &link).expect("a link");
        let message = small.fail_to_measure(&raw);
        assert!(
            message.contains("set05") && message.contains(expected),
            "{message}"
        );
    }
}
