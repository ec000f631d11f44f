//! TOML with mistakes: the file, the line or key, what was found and what was expected.

use std::fs;

use crate::support::{Small, fail, shearq, text};

#[test]
fn submissions_with_mistakes_are_refused_with_file_and_place() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("own.toml");
    let cases: [(&str, &[&str]); 19] = [
        (
            "extends = \"paper\"\n[stamp]\nsise = 3\n",
            &["line 3", "unknown field `sise`, expected `size`"],
        ),
        (
            "extends = \"paper\"\n[stmap]\nsize = 3\n",
            &["line 2", "unknown field `stmap`", "`stamp`"],
        ),
        (
            "extends = \"paper\"\n[stamp]\nsize = \"big\"\n",
            &["line 3", "string \"big\""],
        ),
        (
            "extends = \"paper\"\n[stamp]\nsize = -3\n",
            &["line 3", "integer `-3`"],
        ),
        (
            "extends = \"paper\"\n[stamp]\nsize = 500\n",
            &["`stamp.size` is 500; expected 5 to 64 pixels"],
        ),
        (
            "extends = \"paper\"\n[deconvolution]\nlambda = nan\n",
            &["`deconvolution.lambda` is NaN; expected zero"],
        ),
        (
            "extends = \"paper\"\n[psf]\nform = \"stars\"\n",
            &["line 3", "`stars`, expected `star` or `functional`"],
        ),
        (
            "extends = \"paper\"\n[stamp\nsize = 3\n",
            &["line 2", "expected `]`"],
        ),
        (
            "extends = \"paper\"\n[stamp]\nsize = 9\nsize = 10\n",
            &["line 4", "duplicate key"],
        ),
        (
            "extends = \"48/linear/star\"\n[shape]\nacf_share = 0.5\n",
            &[
                "line 3",
                "`shape.acf_share` is not used when method = \"linear\"",
            ],
        ),
        (
            "extends = \"48/linear/star\"\n[shape]\nsoftening = 100.0\n",
            &["line 3", "unknown field `softening`", "`half_snr`"],
        ),
        (
            "extends = \"48/linear/star\"\n[shape]\nhalf_snr = -1.0\n",
            &["`shape.half_snr` is -1; expected 0 to 1000"],
        ),
        (
            "extends = \"23/den/star\"\nmethod = \"linear\"\n[stamp]\nsize = 48\n",
            &["`deconvolution.target_sigma` is set neither here nor in what it extends"],
        ),
        (
            "extends = \"paper\"\n[deconvolution]\nhigh_pass_divisor = 0.0\n",
            &[
                "`deconvolution.high_pass_divisor` is 0",
                "expected 0.001 to 1e6",
            ],
        ),
        (
            "extends = \"paper\"\n[deconvolution]\nupdate = \"accelerated\"\nclipping = \"after-test\"\n",
            &[
                "`deconvolution.clipping` is \"after-test\"",
                "with update = \"accelerated\"",
            ],
        ),
        (
            "extends = \"paper\"\n[shape]\nacf = \"round\"\n",
            &["line 3", "`round`, expected `full` or `circular`"],
        ),
        (
            "extends = \"papr\"\n",
            &[
                "`extends`",
                "no configuration or file named `papr`",
                "23/den/star",
            ],
        ),
        ("extends = \"own.toml\"\n", &["goes round in a circle"]),
        (
            "[stamp]\nsize = 23\n",
            &["`psf.form` is set neither here nor in what it extends"],
        ),
    ];
    for (content, expected) in cases {
        fs::write(&path, content).unwrap();
        let message = fail(&["submissions", "show", text(&path)]);
        for part in [&["own.toml"], expected].concat() {
            assert!(message.contains(part), "{content}: {message}");
        }
    }
    fs::write(&path, b"extends = \"\xff\"").unwrap();
    assert!(
        fail(&["submissions", "show", text(&path)]).contains("cannot read the configuration file")
    );
    assert!(
        fail(&["submissions", "show", text(folder.path())]).contains("no configuration or file")
    );
}

#[test]
fn layouts_with_mistakes_are_refused_with_file_and_place() {
    let small = Small::new("2");
    let raw = ["--submission", "23/raw/star"];
    let cases: [(&str, &str); 10] = [
        ("galaxys = \"x\"\n", "unknown field `galaxys`"),
        ("stamp = \"a\"\n", "line 1"),
        ("stamp = 0\n", "`stamp` is 0; expected 1 to 1024 pixels"),
        (
            "field_degrees = 0.0\n",
            "`field_degrees` is 0.0; expected 0.001 to 360",
        ),
        ("field_degrees = nan\n", "`field_degrees` is NaN"),
        (
            "truth_sign = \"wrong\"\n",
            "expected `challenge` or `standard`",
        ),
        (
            "galaxies = \"galaxies-{image:03}.fits\"\n",
            "expected a pattern with {set} or {set:02}",
        ),
        (
            "galaxies = \"set{set:02}/galaxies.fits\"\n",
            "expected a pattern with {image} or {image:03}",
        ),
        (
            "truth = \"set{set:03}/truth.csv\"\n",
            "`truth` is \"set{set:03}/truth.csv\"; expected the name of a file",
        ),
        ("psf_star = \"\"\n", "`psf_star` is \"\""),
    ];
    for (content, expected) in cases {
        fs::write(small.at("data/layout.toml"), content).unwrap();
        let message = small.fail_to_measure(&raw);
        assert!(
            message.contains("layout.toml") && message.contains(expected),
            "{message}"
        );
        assert!(!small.at("out").exists());
    }
    fs::write(
        small.at("data/layout.toml"),
        "galaxies = \"a/{set}-{image}.fits\"\n",
    )
    .unwrap();
    assert!(
        small
            .fail_to_measure(&raw)
            .contains("expected a/{set}-{image}.fits, as in a/1-1.fits)")
    );
    let usage = shearq(&["measure", "--submission", "23/raw/star"]);
    assert_eq!(usage.status.code(), Some(2));
}

#[test]
fn a_header_that_must_give_the_noise_does_so() {
    let small = Small::new("2");
    let own = small.at("own.toml");
    fs::write(
        &own,
        "extends = \"23/raw/star\"\n[noise]\nsource = \"header\"\n",
    )
    .unwrap();
    let settings = ["--submission", text(&own)];
    small.measure(&settings);
    let image = small.at("data/set02/galaxies-001.fits");
    let mut bytes = fs::read(&image).unwrap();
    let at = bytes.windows(8).position(|w| w == b"NOISESIG").unwrap();
    bytes[at..at + 8].copy_from_slice(b"NOISE   ");
    fs::write(&image, bytes).unwrap();
    let message = small.fail_to_measure(&settings);
    assert!(
        message.contains("header key NOISESIG is absent; expected a positive number"),
        "{message}"
    );
}

#[test]
fn a_network_without_an_iteration_is_noticed() {
    let small = Small::new("2");
    let path = small.at("idle.toml");
    for (setting, warned) in [
        ("step = 0.5", true),
        ("lambda = 1e300", true),
        ("step = 0.002", false),
    ] {
        let settings = format!("extends = \"23/raw/star\"\n[deconvolution]\n{setting}\n");
        fs::write(&path, settings).unwrap();
        let said = small.measure(&["--submission", text(&path)]);
        let expected = "the network makes no iteration (found ";
        assert_eq!(said.contains(expected), warned, "{setting}: {said}");
    }
}
