//! Numbers of sets and images beyond two and three digits, and files that look like data and are not read: either all
//! commands work with them, or they are named.

use std::fs;
use std::path::Path;

use crate::support::{Small, fail, fits_image, floats, shearq, succeed, text};

const RAW: [&str; 2] = ["--submission", "23/raw/star"];

/// Runs the binary, which must succeed, and gives all that it reported.
fn reported(arguments: &[&str]) -> String {
    let done = shearq(arguments);
    let said = String::from_utf8([done.stdout, done.stderr].concat()).unwrap();
    assert!(done.status.success(), "{arguments:?}: {said}");
    said
}

fn rename(small: &Small, from: &str, to: &str) {
    let to = small.at(to);
    fs::create_dir_all(to.parent().unwrap()).unwrap();
    fs::rename(small.at(from), to).unwrap();
}

#[test]
fn image_1000_of_set_100_goes_through_all_commands() {
    let small = Small::new("2");
    // The second image moves, and the set.
    for name in ["galaxies", "psf"] {
        rename(
            &small,
            &format!("data/set02/{name}-002.fits"),
            &format!("data/set02/{name}-1000.fits"),
        );
    }
    rename(&small, "data/set02/psf-002.csv", "data/set02/psf-1000.csv");
    rename(
        &small,
        "data/set02/intrinsic-002.csv",
        "data/set02/intrinsic-1000.csv",
    );
    rename(&small, "data/set02", "data/set100");
    let at = |name: &str| small.at(name);
    let (data, out, sent, unpacked) = (at("data"), at("out"), at("sent.tar.gz"), at("unpacked"));
    let said = small.measure(&RAW);
    assert!(said.contains("2 images"), "{said}");
    // The headers state the places before; there is no other warning.
    let warnings = said.lines().filter(|line| line.contains("warning"));
    for line in warnings {
        let other = ["states another image", "other-image"];
        assert!(other.iter().any(|kind| line.contains(kind)), "{said}");
    }
    assert!(out.join("set100/catalogue-1000.parquet").exists());
    let store = at("store");
    let score = ["score", "--measured", text(&out), "--store", text(&store)];
    let said = reported(&[&score[..], &["--sets", "100"]].concat());
    assert!(said.contains("100") && !said.contains("arning"), "{said}");
    let listed = reported(&["compare", "--store", text(&store), "--where", "set == 100"]);
    assert!(listed.contains("23/raw/star"), "{listed}");
    succeed(&["mean", "--measured", text(&out)]);
    succeed(&["merge", text(&out)]);
    succeed(&[
        "pack",
        "--measured",
        text(&out),
        "--method",
        "ME",
        "--out",
        text(&sent),
    ]);
    succeed(&["unpack", text(&sent), "--out", text(&unpacked)]);
    assert!(unpacked.join("g10_v1_objs_100_1000.ME.dat").exists());
    let check = shearq(&[
        "check",
        text(&sent),
        "--data",
        text(&data),
        "--images",
        "1000",
    ]);
    let said = String::from_utf8(check.stdout).unwrap();
    assert!(
        !said.contains("[name]") && !said.contains("neither"),
        "{said}"
    );
    // A gathered one.
    let stamp = fits_image(-32, &[48, 48, 2], &[], &floats(&vec![1.0; 2 * 48 * 48]));
    fs::write(at("stamps.fits"), stamp).unwrap();
    let psf = data.join("set100/psf-1000.fits");
    let (stamps, gathered) = (at("stamps.fits"), at("gathered"));
    let gather = [
        "gather",
        "--stamps",
        text(&stamps),
        "--psf",
        text(&psf),
        "--out",
        text(&gathered),
    ];
    succeed(&[&gather[..], &["--set", "100", "--image", "1000"]].concat());
    for name in ["galaxies-1000.fits", "psf-1000.fits", "stamps-1000.csv"] {
        assert!(gathered.join("set100").join(name).exists(), "{name}");
    }
}

fn copy(small: &Small, from: &str, to: &str) {
    let (from, to) = (small.at(from), small.at(to));
    fs::create_dir_all(to.parent().unwrap()).unwrap();
    fs::copy(from, to).unwrap();
}

#[test]
fn what_looks_like_data_and_is_not_read_is_named_once() {
    let image = "data/set02/galaxies-001.fits";
    let cases: [(&[&str], &str); 8] = [
        (
            &["data/set02/galaxies-03.FITS"],
            "galaxies-03.FITS: this file is not read, because of its name (found galaxies-03.FITS, expected galaxies-003.fits). Try: rename it",
        ),
        (
            &[
                "data/set02/galaxies_003.fits",
                "data/set02/galaxies_004.fits",
            ],
            "galaxies_003.fits: this file is not read, like 1 other file, because of its name (found galaxies_003.fits, expected galaxies-003.fits)",
        ),
        (
            &["data/set02/galaxies-0003.fits"],
            "expected galaxies-003.fits",
        ),
        (
            &["data/set02/galaxies-1000000.fits"],
            "expected galaxies-{1 to 999999}.fits",
        ),
        (
            &["data/set02/galaxies-000.fits"],
            "expected galaxies-{1 to 999999}.fits",
        ),
        (
            &["data/set2/galaxies-001.fits"],
            "set2: this folder is not read, because of its name (found set2, expected set02). Try: rename it",
        ),
        (
            &["data/SET_3/galaxies-001.fits"],
            "SET_3: this folder is not read, because of its name (found SET_3, expected set03)",
        ),
        (
            &["data/set02/galaxies-001.fits.gz"],
            "galaxies-001.fits.gz: this file is not read, because galaxies-001.fits is read instead. Try: remove one of them",
        ),
    ];
    for (others, expected) in cases {
        let small = Small::new("2");
        let silent = small.measure(&RAW);
        assert!(!silent.contains("warning"), "{silent}");
        for other in others {
            copy(&small, image, other);
        }
        let said = small.measure(&RAW);
        assert_eq!(said.matches("warning: ").count(), 1, "{said}");
        assert!(said.contains(expected), "{expected}: {said}");
        let out = small.at("out");
        let scores = reported(&["score", "--measured", text(&out)]);
        assert!(scores.replace("\n", " ").contains("not read"), "{scores}");
    }
    // One of a set that is not wanted is not looked for.
    let small = Small::new("2");
    copy(&small, image, "data/set3/galaxies-001.fits");
    let said = small.measure(&[&RAW[..], &["--sets", "2"]].concat());
    assert!(!said.contains("warning"), "{said}");
}

#[test]
fn a_folder_without_images_is_told_which_layout_is_expected() {
    let small = Small::new("2");
    let out = small.at("measured");
    let measure = |data: &Path| {
        let measure = ["measure", "--data", text(data), "--out", text(&out)];
        fail(&[&measure[..], &RAW].concat())
    };
    let message = measure(&small.at("data/set02"));
    assert!(
        message.contains(
            "there are no galaxy images here (found galaxies-001.fits, galaxies-002.fits,"
        ),
        "{message}"
    );
    assert!(
        message.contains(
            "expected set{set:02}/galaxies-{image:03}.fits, as in set01/galaxies-001.fits"
        ),
        "{message}"
    );
    let expected = format!(
        "This is the folder of one set. Try: --data {}",
        text(&small.at("data"))
    );
    assert!(message.contains(&expected), "{message}");
    let measure_two = ["measure", "--sets", "2", "--out", text(&out)];
    let set = small.at("data/set02");
    let message = fail(&[&measure_two[..], &RAW, &["--data", text(&set)]].concat());
    assert!(message.contains(&expected), "{message}");
    fs::create_dir(small.at("empty")).unwrap();
    let message = measure(&small.at("empty"));
    assert!(
        message.contains("(found an empty folder, expected set{set:02}"),
        "{message}"
    );
    fs::create_dir(small.at("set2")).unwrap();
    fs::rename(small.at("data/set02"), small.at("data/Set 2")).unwrap();
    let message = measure(&small.at("data"));
    assert!(
        message.contains("(found Set 2, expected set02)"),
        "{message}"
    );
}

#[test]
fn stamps_that_are_too_small_come_with_a_configuration_that_measures_them() {
    for (side, submission) in [
        (32usize, "48/linear/star"),
        (25, "48/linear/star"),
        (20, "23/den/star"),
    ] {
        let small = Small::new("2");
        let at = |name: &str| small.at(name);
        let (pixels, width) = crate::support::pixels_of(&at("data/set02/galaxies-001.fits"));
        let first = (48 - side) / 2;
        let stamps: Vec<f32> = (0..64)
            .flat_map(|k| {
                let (x, y) = (k % 8 * 48 + first, k / 8 * 48 + first);
                let rows = (y..y + side).map(move |row| row * width + x);
                rows.flat_map(|start| pixels[start..start + side].to_vec())
                    .collect::<Vec<_>>()
            })
            .collect();
        fs::write(
            at("cube.fits"),
            fits_image(-32, &[side, side, 64], &[], &floats(&stamps)),
        )
        .unwrap();
        let (cube, psf, data, out) = (
            at("cube.fits"),
            at("data/set02/psf-001.fits"),
            at("own"),
            at("own-out"),
        );
        succeed(&[
            "gather",
            "--stamps",
            text(&cube),
            "--psf",
            text(&psf),
            "--noise",
            "1",
            "--out",
            text(&data),
        ]);
        let measure = [
            "measure",
            "--data",
            text(&data),
            "--out",
            text(&out),
            "--submission",
        ];
        let message = fail(&[&measure[..], &[submission]].concat());
        assert!(
            message.contains(&format!("the stamps are too small for the configuration {submission} (found {side} px a side, expected ")),
            "{message}"
        );
        let (_, lines) = message.split_once("of these lines:\n").unwrap();
        if side == 32 {
            assert_eq!(lines, "  extends = \"48/linear/star\"\n  stamp.size = 32\n");
        }
        let own = at("own.toml");
        fs::write(&own, lines).unwrap();
        let _ = fs::remove_dir_all(&out);
        reported(&[&measure[..], &[text(&own)]].concat());
    }
}

#[test]
fn unread_files_are_named_by_compare_pack_and_check() {
    let small = Small::new("2");
    small.measure(&RAW);
    let (data, out) = (small.at("data"), small.at("out"));
    let said = |arguments: &[&str]| {
        let done = shearq(arguments);
        let said = String::from_utf8([done.stdout, done.stderr].concat()).unwrap();
        assert!(!said.contains("error: "), "{arguments:?}: {said}");
        said.split_whitespace().collect::<Vec<_>>().join(" ")
    };
    let pack = |to: &str| {
        said(&[
            "pack",
            "--measured",
            text(&out),
            "--out",
            text(&small.at(to)),
        ])
    };
    let first = small.at("first");
    let compare = || said(&["compare", text(&out)]);
    let check = || said(&["check", text(&first), "--data", text(&data)]);
    for silent in [pack("first"), compare(), check()] {
        assert!(!silent.contains("not read"), "{silent}");
    }
    copy(
        &small,
        "data/set02/galaxies-001.fits",
        "data/set02/galaxies-03.FITS",
    );
    for warned in [compare(), check()] {
        let expected = "galaxies-03.FITS: this file is not read, because of its name";
        assert!(warned.contains("warning: "), "{warned}");
        assert!(warned.replace("- ", "-").contains(expected), "{warned}");
    }
    copy(
        &small,
        "out/set02/catalogue-001.parquet",
        "out/set02/catalogue-03.parquet",
    );
    let warned = pack("second");
    assert!(
        warned.contains("catalogue-03.parquet: this file is not read"),
        "{warned}"
    );
}
