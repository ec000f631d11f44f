//! Killed at any moment: whatever that interrupts, going on ends in the same bytes.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::support::{Folder, contents, succeed, text};

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
    let folder = Folder::new();
    let sets = "--sets 1,7 --images 3 --grid 12";
    let data = folder.at("data");
    for (seed, command, out) in [
        (0, format!("simulate {sets}"), "data"),
        (
            1,
            format!("measure --submission 23/den/star --data {}", text(&data)),
            "measured",
        ),
        (
            2,
            format!("run --submission 23/raw/star --simulate {sets}"),
            "run",
        ),
    ] {
        let command: Vec<&str> = command.split(' ').collect();
        kill(&command, &folder.at(out), kills, seed);
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
    let (mut done, temporary) = (0, std::env::temp_dir());
    // Beside the other, so that the way to the data is the same.
    let out = whole.with_extension("again");
    while done < kills {
        let _ = std::fs::remove_dir_all(&out);
        let arguments = [command, &["--out", text(&out)]].concat();
        while !ends_within(&arguments, length.mul_f64(moments.random()), &temporary) {
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
    let folder = Folder::new();
    let at = |name: &str| text(&folder.at(name)).to_owned();
    let run = "--simulate --submission 23/raw/star --sets 1,7 --grid 16";
    folder.run(&format!("run {run} --images 20 --out measured"));
    folder.run("pack --measured measured --out whole.tar.gz");
    let pack = format!("pack --measured {} --out", at("measured"));
    let unpack = format!("unpack {} --out", at("whole.tar.gz"));
    let store = format!("score --measured {} --store", at("measured"));
    let record = format!("baseline record mine {run} --images 4 --folder");
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

/// Whether the command ends, with success, before it is killed after `delay`.
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
