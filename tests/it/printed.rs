//! Standard output that nobody reads or that is full, and words of others that would act on a terminal or
//! in a document.

use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};

use shearq_dataset::run::Run;
use shearq_results::store;

use crate::support::{Small, fail, run_simulated, shearq, succeed, text};

/// Commands that print, each in its own way.
fn commands<'a>(out: &'a str, data: &'a str, picture: &'a str) -> Vec<Vec<&'a str>> {
    let measure = [
        "measure",
        "--submission",
        "23/raw/star",
        "--data",
        data,
        "--out",
        out,
    ];
    succeed(&measure);
    vec![
        vec!["--help"],
        vec!["--version"],
        vec!["submissions", "list"],
        vec!["submissions", "show", "23/raw/star"],
        vec!["score", "--measured", out],
        vec!["score", "--measured", out, "--format", "json"],
        vec!["compare", out],
        vec![
            "show",
            "--submission",
            "23/raw/star",
            "--data",
            data,
            "--galaxy",
            "2/1/1",
            "--out",
            picture,
        ],
    ]
}

#[test]
fn a_reader_that_goes_away_is_no_failure() {
    let small = Small::new("2");
    let (out, data, picture) = (small.at("out"), small.at("data"), small.at("galaxy.png"));
    for arguments in commands(text(&out), text(&data), text(&picture)) {
        let mut child = Command::new(env!("CARGO_BIN_EXE_shearq"))
            .args(&arguments)
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        drop(child.stdout.take());
        let output = child.wait_with_output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(0), "{arguments:?}: {said}");
        assert!(
            !said.contains("error") && !said.contains("panicked"),
            "{said}"
        );
    }
    assert!(picture.is_file());
}

#[cfg(target_os = "linux")]
#[test]
fn a_full_disk_at_standard_output_is_one_error() {
    let small = Small::new("2");
    let (out, data, picture) = (small.at("out"), small.at("data"), small.at("galaxy.png"));
    for arguments in commands(text(&out), text(&data), text(&picture)) {
        let full = fs::File::options().write(true).open("/dev/full").unwrap();
        let output = Command::new(env!("CARGO_BIN_EXE_shearq"))
            .args(&arguments)
            .stdout(full)
            .output()
            .unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(1), "{arguments:?}: {said}");
        assert_eq!(said.matches("error: ").count(), 1, "{said}");
        assert!(
            said.contains("standard output: No space left on device"),
            "{said}"
        );
    }
}

/// Names that act on what they are printed to, as TOML has them.
const REFUSED: [&str; 7] = [
    "two\\nlines",
    "\\u001b[2J",
    "\\u009b31m",
    "\\u202etxt.exe",
    "tab\\tstop",
    "\\u007f",
    "",
];

/// Whether nothing in what was said acts on a terminal.
fn quiet(said: &str) -> bool {
    !said.contains(|c: char| shearq_submissions::is_control(c) && c != '\n')
}

#[test]
fn names_that_act_are_refused_wherever_they_are_read() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let (own, out, foreign) = (at("own.toml"), at("out"), at("foreign.toml"));
    run_simulated("2", "23/raw/star", &out, &[]);
    let record = fs::read_to_string(out.join("run.json")).unwrap();
    let long = "x".repeat(101);
    for name in REFUSED.into_iter().chain([long.as_str()]) {
        let refused = |arguments: &[&str]| {
            let message = fail(arguments);
            let expected = "expected 1 to 100 bytes without control characters";
            assert!(
                message.contains(expected) && quiet(&message),
                "{name}: {message}"
            );
        };
        fs::write(&own, format!("extends = \"paper\"\nname = \"{name}\"\n")).unwrap();
        refused(&["submissions", "show", text(&own)]);
        // JSON and TOML write these names alike.
        let spoilt = record.replace("\"23/raw/star\"", &format!("\"{name}\""));
        fs::write(out.join("run.json"), spoilt).unwrap();
        refused(&["score", "--measured", text(&out)]);
        let lines =
            format!("name = \"{name}\"\ncatalogues = \"{{image}}.csv\"\nellipticity = \"shear\"\n");
        fs::write(&foreign, lines).unwrap();
        refused(&["compare", "--data", text(&out), "--foreign", text(&foreign)]);
    }
    fs::write(out.join("run.json"), &record).unwrap();
    let sent = at("sent");
    succeed(&["pack", "--measured", text(&out), "--out", text(&sent)]);
    let manifest = fs::read_to_string(sent.join("manifest.json")).unwrap();
    let spoilt = manifest.replace("\"method\": \"23-raw-star\"", "\"method\": \"\\u001b[2J\"");
    assert_ne!(spoilt, manifest);
    fs::write(sent.join("manifest.json"), spoilt).unwrap();
    let output = shearq(&["check", text(&sent)]);
    let said = String::from_utf8(output.stdout).unwrap();
    assert!(
        said.contains("without control characters") && quiet(&said),
        "{said}"
    );
}

#[test]
fn a_store_with_a_name_that_acts_is_refused() {
    let root = tempfile::tempdir().unwrap();
    let (out, place) = (root.path().join("out"), root.path().join("store"));
    run_simulated("2", "23/raw/star", &out, &["--store", text(&place)]);
    let (mut runs, _) = store::read(&place).unwrap();
    runs[0].configuration = "\u{1b}[2J".into();
    store::write(&place, &runs[0]).unwrap();
    let message = fail(&["compare", "--store", text(&place)]);
    assert!(
        message.contains("without control characters") && quiet(&message),
        "{message}"
    );
}

#[test]
fn nothing_from_a_file_acts_on_the_terminal() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let own = at("own.toml");
    fs::write(&own, "extends = \"paper\"\n\"\\u001b[2J\" = 1\n").unwrap();
    assert!(quiet(&fail(&["submissions", "show", text(&own)])));
    fs::write(
        &own,
        "extends = \"paper\"\n[stamp]\n\u{9b}31m = \u{202e}1\n",
    )
    .unwrap();
    assert!(quiet(&fail(&["submissions", "show", text(&own)])));
    fs::write(&own, "extends = \"\u{202e}repap\"\n").unwrap();
    assert!(quiet(&fail(&["submissions", "show", text(&own)])));
    let sent = at("sent");
    fs::create_dir(&sent).unwrap();
    fs::write(sent.join("\u{1b}[2J\u{202e}.dat"), "24.5 24.5 0 0\n").unwrap();
    for more in [&[][..], &["--json"]] {
        let output = shearq(&[&["check", text(&sent)], more].concat());
        assert_eq!(output.status.code(), Some(1));
        let said = String::from_utf8([output.stdout, output.stderr].concat()).unwrap();
        assert!(
            said.contains("\\u001b[2J\\u202e.dat") && quiet(&said),
            "{said}"
        );
    }
}

#[test]
fn names_with_marks_of_every_format_go_through_the_chain() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let name = "=cmd|'x'!A0 \\input{y} <b>&amp; $x$ 100 % a_b \"q\" [*]";
    let own = at("own.toml");
    fs::write(
        &own,
        format!("extends = \"23/raw/star\"\nname = '''{name}'''\n"),
    )
    .unwrap();
    let (out, place, map) = (at("out"), at("store"), at("map.svg"));
    run_simulated("2,5", text(&own), &out, &["--store", text(&place)]);
    assert_eq!(
        Run::require(Path::new(&out)).unwrap().configuration.name,
        name
    );
    let compare = |format: &str| {
        let folders = [
            "compare",
            text(&out),
            "--heat-map",
            text(&map),
            "--format",
            format,
        ];
        let stored = ["compare", "--store", text(&place), "--format", format];
        succeed(&folders) + &succeed(&stored)
    };
    assert!(compare("csv").contains("\"'=cmd|'x'!A0"));
    assert!(compare("json").contains("\"=cmd|'x'!A0"));
    assert!(compare("markdown").contains("=cmd\\|'x'!A0 \\\\input{y} \\<b\\>\\&amp;"));
    assert!(compare("latex").contains("\\textbackslash{}input\\{y\\}"));
    let picture = fs::read_to_string(&map).unwrap();
    assert!(picture.contains("&lt;b&gt;") && !picture.contains("<b>"));
}
