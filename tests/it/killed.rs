//! Killed at any moment, or without room on the disk: whatever that interrupts, going on ends in the same bytes.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::support::{contents, printed, refused, succeed, text};

/// Kills of each of the three commands in the ordinary test.
const KILLS: usize = 17;
/// The same in the long one.
const MANY_KILLS: usize = 500;

#[test]
fn killed_commands_go_on_to_the_same_bytes() {
    kill_all(KILLS);
}

#[test]
#[ignore = "minutes of the same with other moments"]
fn commands_killed_many_times_go_on_to_the_same_bytes() {
    kill_all(MANY_KILLS);
}

fn kill_all(kills: usize) {
    let root = tempfile::tempdir().unwrap();
    let sets = "--sets 1,7 --images 3 --grid 12";
    let at = |name: &str| root.path().join(name);
    let measure = format!(
        "measure --submission 23/den/star --data {}",
        text(&at("data"))
    );
    for (seed, (command, out)) in [
        (format!("simulate {sets}"), "data"),
        (measure, "measured"),
        (
            format!("run --submission 23/raw/star --simulate {sets}"),
            "run",
        ),
    ]
    .into_iter()
    .enumerate()
    {
        let command: Vec<&str> = command.split(' ').collect();
        kill(&command, &at(out), kills, seed as u64);
    }
}

/// Runs a command undisturbed into `whole`, then again and again into another folder, with kills
/// spread over the time it took, and each time until it ends by itself.
fn kill(command: &[&str], whole: &Path, kills: usize, seed: u64) {
    let start = Instant::now();
    succeed(&[command, &["--out", text(whole)]].concat());
    let length = start.elapsed();
    let expected: BTreeMap<String, Vec<u8>> = contents(whole).into_iter().collect();
    let mut moments = ChaCha8Rng::seed_from_u64(seed);
    let mut done = 0;
    // Beside the other, so that the way to the data is the same.
    let out = whole.with_extension("again");
    while done < kills {
        let _ = std::fs::remove_dir_all(&out);
        let arguments = [command, &["--out", text(&out)]].concat();
        while !ends_before(&arguments, length.mul_f64(moments.random())) {
            done += 1;
            if !out.exists() {
                continue;
            }
            for (name, bytes) in contents(&out) {
                // A leftover is hidden and known by its ending; everything else is whole.
                if !name.ends_with(".part") {
                    assert!(expected.get(&name) == Some(&bytes), "{command:?}: {name}");
                }
            }
        }
        let found: BTreeMap<String, Vec<u8>> = contents(&out).into_iter().collect();
        let names = |files: &BTreeMap<String, Vec<u8>>| files.keys().cloned().collect::<Vec<_>>();
        assert_eq!(names(&found), names(&expected), "{command:?}");
        assert!(found == expected, "{command:?}: other bytes");
    }
    eprintln!("{}: {done} kills within {length:.2?}", command[0]);
}

#[test]
fn what_killed_commands_leave_is_removed_by_the_next() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let (measured, archive) = (at("measured"), at("whole.tar.gz"));
    let (measured, archive) = (text(&measured), text(&archive));
    let run = "run --simulate --submission 23/raw/star --sets 1,7 --grid 16";
    printed(
        root.path(),
        &format!("shearq {run} --images 20 --out measured"),
    );
    printed(
        root.path(),
        "shearq pack --measured measured --out whole.tar.gz",
    );
    let pack = format!("pack --measured {measured} --out");
    let unpack = format!("unpack {archive} --out");
    let store = format!("score --measured {measured} --store");
    let record = format!("baseline record mine {} --images 4 --folder", &run[4..]);
    // With what is taken away so that the command can run again.
    for (command, out, made) in [
        (&pack, "sent", "sent"),
        (&pack, "sent.tar.gz", "sent.tar.gz"),
        (&unpack, "unpacked", "unpacked"),
        (&store, "store", "nothing"),
        (&record, "baselines", "baselines/mine.toml"),
    ] {
        let place = tempfile::tempdir().unwrap();
        let temporary = place.path().join("tmp");
        std::fs::create_dir(&temporary).unwrap();
        let (out, made) = (place.path().join(out), place.path().join(made));
        let arguments: Vec<&str> = command.split(' ').chain([text(&out)]).collect();
        let run = |delay| {
            let _ = std::fs::remove_dir_all(&made);
            let _ = std::fs::remove_file(&made);
            ends_within(&arguments, delay, &temporary)
        };
        let start = Instant::now();
        assert!(run(Duration::MAX));
        let length = start.elapsed();
        let mut moments = ChaCha8Rng::seed_from_u64(4);
        for _ in 0..KILLS {
            run(length.mul_f64(moments.random()));
        }
        assert!(run(Duration::MAX));
        for folder in [place.path(), &temporary, &out] {
            let names = std::fs::read_dir(folder).into_iter().flatten();
            let names = names.map(|entry| entry.unwrap().file_name().into_string().unwrap());
            let left: Vec<String> = names.filter(|name| name.starts_with('.')).collect();
            assert!(left.is_empty(), "{command}: {left:?}");
        }
    }
}

#[cfg(unix)]
#[test]
fn what_a_full_disk_does_not_take_is_an_error_and_no_file() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let files = |name: &str| contents(&at(name)).into_iter().collect::<BTreeMap<_, _>>();
    // The largest file of each is of 593,280, 17,280 and 12,096 bytes: none of it, half, and all but the end fit.
    for (command, whole, sizes) in [
        (
            "simulate --sets 2 --images 1 --grid 8",
            "data",
            [1, 600, 1158],
        ),
        (
            "measure --submission 23/raw/star --data data --catalogue-format fits",
            "measured",
            [1, 12, 32],
        ),
        (
            "gather --stamps data/set02/psf-001.fits --psf data/set02/psf-001.fits",
            "cube",
            [1, 12, 20],
        ),
    ] {
        printed(root.path(), &format!("shearq {command} --out {whole}"));
        let expected = files(whole);
        let again = format!("shearq {command} --out again");
        for blocks in sizes {
            // No file may be longer than this many blocks of 512 bytes, as on a disk that is full.
            let limit = format!("trap '' XFSZ; ulimit -f {blocks}; exec {again}");
            let message = refused(root.path(), &limit);
            assert!(message.contains("cannot write"), "{command}: {message}");
            let left = match at("again").exists() {
                true => files("again"),
                false => BTreeMap::new(),
            };
            for (name, bytes) in left {
                assert!(expected.get(&name) == Some(&bytes), "{command}: {name}");
            }
            printed(root.path(), &again);
            assert!(
                files("again") == expected,
                "{command} after {blocks} blocks"
            );
            fs::remove_dir_all(at("again")).unwrap();
        }
    }
}

/// Whether the command ends, with success, before it is killed after `delay`.
fn ends_before(arguments: &[&str], delay: Duration) -> bool {
    ends_within(arguments, delay, &std::env::temp_dir())
}

/// The same with another folder for what is temporary.
fn ends_within(arguments: &[&str], delay: Duration, temporary: &Path) -> bool {
    let mut child = Command::new(env!("CARGO_BIN_EXE_shearq"))
        .args(arguments)
        .env("TMPDIR", temporary)
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .expect("the binary starts");
    let start = Instant::now();
    while start.elapsed() < delay && child.try_wait().expect("one's own child").is_none() {
        std::thread::sleep(Duration::from_millis(1));
    }
    // On Unix this is SIGKILL; of a process that has ended already it does nothing.
    child.kill().expect("one's own child can be killed");
    let status = child.wait().expect("one's own child can be waited for");
    assert!(status.code().is_none_or(|code| code == 0), "{arguments:?}");
    status.success()
}

#[cfg(unix)]
#[test]
fn an_output_folder_that_is_taken_away_is_an_error() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let (sets, submission) = ("--sets 2 --images 40 --grid 8", "--submission 23/den/star");
    printed(root.path(), &format!("shearq simulate {sets} --out data"));
    for (name, first, command) in [
        (
            "measured",
            "catalogue-001.parquet",
            format!("measure --data data {submission}"),
        ),
        (
            "run",
            "catalogue-001.parquet",
            format!("run --simulate {submission} {sets}"),
        ),
        ("simulated", "galaxies-001.fits", format!("simulate {sets}")),
    ] {
        let out = at(name);
        let child = Command::new(env!("CARGO_BIN_EXE_shearq"))
            .args(command.split(' '))
            .args(["--threads", "1", "--out", text(&out)])
            .current_dir(root.path())
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
        let expected = "was removed or replaced while results were written";
        assert!(
            message.contains(name) && message.contains(expected),
            "{message}"
        );
    }
}
