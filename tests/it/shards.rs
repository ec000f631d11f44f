//! Work split among processes that write to one folder, and what `merge` says of it.

use std::fs;
use std::path::Path;
use std::process::{Child, Command, Stdio};

use crate::support::{contents, fail, shearq, succeed, text};

const SIMULATION: [&str; 8] = [
    "--sets", "1,7,19", "--images", "2", "--grid", "12", "--seed", "5",
];

/// Arguments of a command on the small simulation, written to `out`.
fn arguments<'a>(command: &[&'a str], out: &'a Path) -> Vec<&'a str> {
    [command, &["--out", text(out), "--threads", "1"]].concat()
}

/// Starts all parts at once and waits for all of them.
fn in_parts(arguments: &[&str], parts: u32) {
    let start = |number: u32| {
        Command::new(env!("CARGO_BIN_EXE_shearq"))
            .args(arguments)
            .args(["--shard", &format!("{number}/{parts}")])
            .stderr(Stdio::piped())
            .spawn()
            .unwrap()
    };
    let started: Vec<Child> = (1..=parts).map(start).collect();
    for child in started {
        let output = child.wait_with_output().unwrap();
        let message = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{message}");
    }
}

#[test]
fn shards_end_in_the_bytes_of_one_process() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let submission = ["--submission", "23/raw/star"];
    let run = [&["run", "--simulate"], &submission[..], &SIMULATION].concat();
    let simulate = [&["simulate"], &SIMULATION[..]].concat();
    succeed(&arguments(&run, &at("whole")));
    succeed(&arguments(&simulate, &at("images")));
    // More parts than images, too: some have nothing to do.
    for parts in [4, 8] {
        let (merged, images) = (at(&format!("run-{parts}")), at(&format!("images-{parts}")));
        in_parts(&arguments(&run, &merged), parts);
        assert!(!merged.join("scores.csv").exists());
        let expected = ["merge", text(&merged), "--sets", "1,7,19", "--images", "2"];
        assert!(succeed(&expected).contains("Q"));
        assert_eq!(contents(&merged), contents(&at("whole")));
        in_parts(&arguments(&simulate, &images), parts);
        succeed(&["merge", text(&images), "--sets", "1,7,19", "--images", "2"]);
        assert_eq!(contents(&images), contents(&at("images")));
    }
    let data = at("images");
    for command in ["measure", "run"] {
        let command = [&[command, "--data", text(&data)], &submission[..]].concat();
        let (one, many) = (
            at(&format!("{}-one", command[0])),
            at(&format!("{}-many", command[0])),
        );
        succeed(&arguments(&command, &one));
        in_parts(&arguments(&command, &many), 4);
        for folder in [&one, &many] {
            succeed(&["merge", text(folder)]);
        }
        assert_eq!(contents(&one), contents(&many));
    }
}

#[test]
fn the_same_work_by_several_processes_at_once_does_no_harm() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let run = [
        &["run", "--simulate", "--submission", "23/raw/star"],
        &SIMULATION[..],
    ]
    .concat();
    let (alone, together) = (at("alone"), at("together"));
    succeed(&arguments(&run, &alone));
    let started: Vec<Child> = (0..4)
        .map(|_| {
            Command::new(env!("CARGO_BIN_EXE_shearq"))
                .args(arguments(&run, &together))
                .stdout(Stdio::null())
                .stderr(Stdio::null())
                .spawn()
                .unwrap()
        })
        .collect();
    for mut child in started {
        assert!(child.wait().unwrap().success());
    }
    assert_eq!(contents(&alone), contents(&together));
}

#[test]
fn merge_lists_what_is_missing_damaged_or_of_other_settings() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let simulation = [
        "--sets", "2,8", "--images", "3", "--grid", "12", "--seed", "5",
    ];
    for format in ["parquet", "fits"] {
        let run = |submission: &'static str| {
            let command = ["run", "--simulate", "--submission", submission];
            [&command, &simulation[..], &["--catalogue-format", format]].concat()
        };
        let (out, other) = (at(format), at(&format!("{format}-other")));
        succeed(&arguments(&run("23/raw/star"), &out));
        succeed(&arguments(&run("23/raw/func"), &other));
        let whole = contents(&out);
        let file = |folder: &Path, set: u32, image: u32| {
            folder.join(format!("set{set:02}/catalogue-{image:03}.{format}"))
        };
        fs::remove_file(file(&out, 2, 1)).unwrap();
        let bytes = fs::read(file(&out, 2, 3)).unwrap();
        fs::write(file(&out, 2, 3), &bytes[..bytes.len() / 2]).unwrap();
        fs::copy(file(&other, 8, 1), file(&out, 8, 1)).unwrap();
        fs::copy(file(&out, 8, 3), file(&out, 8, 2)).unwrap();
        fs::remove_file(out.join("scores.csv")).unwrap();
        let merge = |more: &[&str]| {
            let expected = ["merge", text(&out), "--sets", "2,8", "--images", "3"];
            shearq(&[&expected[..], more].concat())
        };
        let output = merge(&["--shards", "4", "--discard-damaged"]);
        assert_eq!(output.status.code(), Some(1));
        let found = String::from_utf8(output.stdout).unwrap();
        let lines: Vec<&str> = found.lines().collect();
        assert_eq!(lines.len(), 6, "{found}");
        for (line, (image, said)) in lines.iter().zip([
            ("2/1 (shard 1/4): ", "there is no such file"),
            ("2/3 (shard 3/4): ", "set02/catalogue-003"),
            ("8/1 (shard 4/4): ", "does not match set 8 image 1"),
            ("8/2 (shard 1/4): ", "does not match set 8 image 2"),
        ]) {
            assert!(line.starts_with(image) && line.contains(said), "{line}");
        }
        assert!(lines[4].ends_with("4 of 6 images are missing or damaged"));
        assert_eq!(lines[5], "shards to run again: 1,3,4");
        assert!(!out.join("scores.csv").exists());
        // The shards named, and no others, make it whole.
        for shard in ["1/4", "3/4", "4/4"] {
            let again = [arguments(&run("23/raw/star"), &out), vec!["--shard", shard]].concat();
            succeed(&again);
        }
        assert!(merge(&[]).status.success());
        assert_eq!(contents(&out), whole);
    }
    let message = fail(&["merge", text(&at("parquet"))]);
    assert!(message.contains("Try: --sets LIST --images N"), "{message}");
    let message = fail(&["merge", text(root.path())]);
    assert!(
        message.contains("neither run.json nor simulation.json"),
        "{message}"
    );
    let usage = shearq(&arguments(&["simulate", "--shard", "3/2"], &at("never")));
    assert_eq!(usage.status.code(), Some(2));
}
