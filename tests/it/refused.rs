//! Refusals that name what was given and what to give instead, and work that fails without a trace.

use std::fs;
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use crate::support::{Small, contents, fail, run_simulated, shearq, succeed, text};

fn has(message: &str, parts: &[&str]) {
    for part in parts {
        assert!(message.contains(part), "{part}: {message}");
    }
}

#[test]
fn missing_folders_and_data_in_place_of_catalogues_are_called_so() {
    let small = Small::new("2");
    let (absent, data, file) = (small.at("absent"), small.at("data"), small.at("file"));
    fs::write(&file, "").unwrap();
    let out = small.at("packed.tar.gz");
    for command in [
        &["mean", "--measured"][..],
        &["score", "--measured"],
        &["pack", "--out", text(&out), "--measured"],
        &["merge"],
    ] {
        let refusal = |folder: &Path| fail(&[command, &[text(folder)]].concat());
        has(
            &refusal(&absent),
            &["absent: there is no such folder; expected a folder"],
        );
        has(
            &refusal(&file),
            &["file: this is a file; expected a folder"],
        );
        // What `simulate` wrote can be merged.
        if command[0] != "merge" {
            let message = refusal(&data);
            has(
                &message,
                &["data: this is a data folder", "Try: shearq measure --data"],
            );
        }
    }
    let nothing = small.at("nothing");
    fs::create_dir(&nothing).unwrap();
    has(
        &fail(&["mean", "--measured", text(&nothing)]),
        &["nothing: there is no run.json; expected a folder of catalogues"],
    );
}

#[test]
fn catalogues_in_place_of_data_are_called_so() {
    let small = Small::new("2");
    small.measure(&["--submission", "23/raw/star"]);
    let (out, data) = (small.at("out"), small.at("data"));
    let picture = small.at("steps.png");
    let again = small.at("again");
    let show = ["show", "--galaxy", "2/1/1", "--out", text(&picture)];
    let measure = ["measure", "--out", text(&again)];
    for command in [&show[..], &measure] {
        let swapped = ["--submission", "23/raw/star", "--data", text(&out)];
        let message = fail(&[command, &swapped].concat());
        let advice = format!("Try: --data {}", data.display());
        has(
            &message,
            &["this folder contains catalogues (run.json)", &advice],
        );
    }
    assert!(!again.exists());
}

#[test]
fn a_folder_of_other_settings_lists_the_few_that_matter() {
    let root = tempfile::tempdir().unwrap();
    let out = root.path().join("out");
    run_simulated("2", "23/den/star", &out, &[]);
    let run = [
        "run",
        "--simulate",
        "--sets",
        "2",
        "--images",
        "3",
        "--grid",
        "16",
    ];
    let other = ["--submission", "48/linear/star", "--out", text(&out)];
    let message = fail(&[&run[..], &other].concat());
    let lines: Vec<&str> = message.lines().collect();
    has(
        lines[0],
        &["this folder contains results of other settings"],
    );
    has(
        lines[1],
        &["submission.name: \"23/den/star\" ≠ \"48/linear/star\""],
    );
    has(lines[2], &["submission.method"]);
    has(lines[3], &["source.simulated.grid: 12 ≠ 16"]);
    assert!(
        lines[7].trim().starts_with("and ") && lines[7].ends_with(" more"),
        "{message}"
    );
    assert_eq!(lines.len(), 9, "{message}");
}

#[test]
fn a_submission_is_named_once() {
    let root = tempfile::tempdir().unwrap();
    let out = root.path().join("out");
    let twice = ["--submission", "23/raw/star", "--submission", "23/raw/star"];
    for command in [
        &["study", "--out", text(&out)][..],
        &["bench"],
        &["reproduce", "--out", text(&out)],
        &[
            "baseline",
            "record",
            "mine",
            "--simulate",
            "--sets",
            "2",
            "--images",
            "1",
            "--folder",
            text(&out),
        ],
    ] {
        let message = fail(&[command, &twice].concat());
        has(&message, &["--submission 23/raw/star is given twice"]);
    }
    assert!(!out.exists());
}

#[test]
fn the_manual_refers_to_pages_that_are_there() {
    let root = tempfile::tempdir().unwrap();
    succeed(&["manual", text(root.path())]);
    let pages = contents(root.path());
    assert!(
        pages
            .iter()
            .any(|(name, _)| name == "shearq-baseline-check.1")
    );
    for (name, page) in &pages {
        let page = String::from_utf8_lossy(page).replace("\\-", "-");
        for (before, _) in page.match_indices("(1)").map(|(at, _)| page.split_at(at)) {
            let reference = before
                .rsplit(|c: char| !(c.is_alphanumeric() || c == '-'))
                .next()
                .unwrap();
            let file = format!("{reference}.1");
            assert!(
                pages.iter().any(|(name, _)| *name == file),
                "{name}: {reference}"
            );
        }
    }
}

#[test]
fn a_new_configuration_is_the_recommended_one() {
    let root = tempfile::tempdir().unwrap();
    let [linear, network] = ["linear.toml", "network.toml"].map(|name| root.path().join(name));
    succeed(&["submissions", "init", text(&linear)]);
    succeed(&["submissions", "init", text(&network), "--method", "network"]);
    let read = |path: &Path| fs::read_to_string(path).unwrap();
    assert!(read(&linear).contains("method = \"linear\""));
    assert!(!read(&network).contains("method = \"linear\""));
}

#[test]
fn kinds_are_those_of_simulated_sets_alone() {
    let small = Small::new("1");
    small.measure(&["--submission", "23/raw/star"]);
    let (out, store) = (small.at("out"), small.at("store"));
    let score = || {
        succeed(&[
            "score",
            "--measured",
            text(&out),
            "--store",
            text(&store),
            "--format",
            "json",
        ])
    };
    has(&score(), &["Fiducial", "Kinds: as the GREAT10 sets"]);
    let chosen = [
        "compare",
        "--store",
        text(&store),
        "--where",
        "set_kind == 'Fiducial'",
    ];
    succeed(&chosen);
    // The same images without a word of where they come from.
    fs::remove_file(small.at("data/simulation.json")).unwrap();
    fs::remove_dir_all(&store).unwrap();
    let own = score();
    assert!(
        !own.contains("Fiducial") && !own.contains("Kinds: as the"),
        "{own}"
    );
    assert!(!shearq(&chosen).status.success());
}

/// Runs the binary with files of at most `blocks` of 512 bytes.
#[cfg(unix)]
fn limited(blocks: u32, arguments: &[&str]) -> Output {
    Command::new("sh")
        .arg("-c")
        .arg(format!("ulimit -f {blocks} && exec \"$0\" \"$@\""))
        .arg(env!("CARGO_BIN_EXE_shearq"))
        .args(arguments)
        .output()
        .unwrap()
}

#[cfg(unix)]
#[test]
fn a_limit_of_file_sizes_is_an_error_that_leaves_nothing_half_written() {
    let small = Small::new("2");
    small.measure(&["--submission", "23/raw/star"]);
    let at = |name: &str| small.at(name);
    let (data, out, archive) = (at("data"), at("out"), at("sent.tar.gz"));
    succeed(&[
        "pack",
        "--measured",
        text(&out),
        "--method",
        "NN",
        "--out",
        text(&archive),
    ]);
    let star = ["--submission", "23/raw/star"];
    let (new, folder, picture) = (at("new"), at("new/packed"), at("new/steps.png"));
    let (packed, report) = (at("new/sent.tar.gz"), at("new/report.html"));
    let commands: [Vec<&str>; 9] = [
        vec![
            "simulate",
            "--sets",
            "2",
            "--images",
            "1",
            "--grid",
            "8",
            "--out",
            text(&new),
        ],
        [
            &["measure", "--data", text(&data), "--out", text(&new)],
            &star[..],
        ]
        .concat(),
        [
            &[
                "run",
                "--simulate",
                "--sets",
                "2",
                "--images",
                "1",
                "--grid",
                "8",
                "--out",
                text(&new),
            ],
            &star[..],
        ]
        .concat(),
        vec![
            "pack",
            "--measured",
            text(&out),
            "--method",
            "NN",
            "--out",
            text(&folder),
        ],
        vec![
            "pack",
            "--measured",
            text(&out),
            "--method",
            "NN",
            "--out",
            text(&packed),
        ],
        vec!["unpack", text(&archive), "--out", text(&folder)],
        [
            &[
                "show",
                "--data",
                text(&data),
                "--galaxy",
                "2/1/1",
                "--out",
                text(&picture),
            ],
            &star[..],
        ]
        .concat(),
        vec!["score", "--measured", text(&out), "--report", text(&report)],
        vec!["manual", text(&new)],
    ];
    for command in &commands {
        let _ = fs::remove_dir_all(&new);
        let output = limited(1, command);
        let message = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{command:?}: {message}");
        assert!(
            message.contains("error: ") && message.contains("cannot"),
            "{command:?}: {message}"
        );
        let left = if new.exists() {
            contents(&new)
        } else {
            Vec::new()
        };
        let part = left.iter().find(|(name, _)| name.contains(".part"));
        assert!(part.is_none(), "{command:?}: {part:?}");
    }
}

#[cfg(unix)]
#[test]
fn an_output_folder_that_is_taken_away_is_an_error() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let data = at("data");
    succeed(&[
        "simulate",
        "--sets",
        "2",
        "--images",
        "40",
        "--grid",
        "8",
        "--out",
        text(&data),
    ]);
    let sets = ["--sets", "2", "--images", "40", "--grid", "8"];
    let submission = ["--submission", "23/den/star"];
    for (name, first, command) in [
        (
            "measured",
            "catalogue-001.parquet",
            [&["measure", "--data", text(&data)], &submission[..]].concat(),
        ),
        (
            "run",
            "catalogue-001.parquet",
            [&["run", "--simulate"], &submission[..], &sets].concat(),
        ),
        (
            "simulated",
            "galaxies-001.fits",
            [&["simulate"], &sets[..]].concat(),
        ),
    ] {
        let out = at(name);
        let child = Command::new(env!("CARGO_BIN_EXE_shearq"))
            .args(&command)
            .args(["--threads", "1", "--out", text(&out)])
            .stderr(Stdio::piped())
            .stdout(Stdio::null())
            .spawn()
            .unwrap();
        let start = Instant::now();
        while !out.join("set02").join(first).exists() {
            assert!(
                start.elapsed() < Duration::from_secs(60),
                "{name}: nothing is written"
            );
            std::thread::sleep(Duration::from_millis(1));
        }
        fs::rename(&out, at(&format!("{name}-away"))).unwrap();
        let output = child.wait_with_output().unwrap();
        let message = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{name}: {message}");
        has(
            &message,
            &[name, "was removed or replaced while results were written"],
        );
    }
}

#[test]
fn the_name_of_a_file_is_no_formula_in_the_table_of_stamps() {
    let small = Small::new("2");
    let folder = small.at("data");
    let from = folder.join("set02");
    fs::copy(from.join("galaxies-001.fits"), folder.join("=cmd.fits")).unwrap();
    let output = Command::new(env!("CARGO_BIN_EXE_shearq"))
        .current_dir(&folder)
        .args(["gather", "--exposure", "=cmd.fits", "--out", "own"])
        .args(["--positions", "set02/intrinsic-001.csv"])
        .args(["--psf", "set02/psf-001.fits"])
        .output()
        .unwrap();
    let message = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{message}");
    let table = fs::read_to_string(folder.join("own/set01/stamps-001.csv")).unwrap();
    has(table.lines().nth(1).unwrap(), &[",'=cmd.fits,"]);
}
