//! A results store: a folder with one JSON file per recorded run.
//!
//! A file's name is derived from its content. Processes that write into one store therefore do not collide, and
//! recording a run twice has no effect. docs/stores.md lists the keys.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use shearq_dataset::fingerprint;
use shearq_dataset::layout::check_folder;
use shearq_dataset::run::{parse_record, record_text};
use shearq_files::open::{DATA, read_to_string};
use shearq_files::{FileError, atomic};

use super::record::RunRecord;

// Identifies the files of a store.
const SCHEMA: &str = "shearq results store 1";

#[derive(Serialize, Deserialize)]
struct Stored<R> {
    schema: String,
    run: R,
}

/// A store's folder. A new folder that stays empty is removed.
#[derive(Debug)]
#[must_use]
pub struct Prepared(Option<PathBuf>);

impl Drop for Prepared {
    fn drop(&mut self) {
        if let Some(made) = &self.0 {
            // A folder with files is not removed.
            let _ = std::fs::remove_dir(made);
        }
    }
}

/// Makes the folder of a store before a long run, which would otherwise fail at its end.
pub fn prepare(store: &Path) -> Result<Prepared, FileError> {
    if store.exists() {
        // A record beside files that `files` refuses would be written in vain.
        paths(store)?;
        return Ok(Prepared(None));
    }
    std::fs::create_dir_all(store)
        .map_err(FileError::doing(store, "cannot make the results store"))?;
    Ok(Prepared(Some(store.to_owned())))
}

pub fn write(store: &Path, run: &RunRecord) -> Result<PathBuf, FileError> {
    let stored = Stored {
        schema: SCHEMA.into(),
        run,
    };
    let text = record_text(store, &stored)?;
    // The name contains a hash of the content: processes that write at the same time do not collide, and recording a run
    // twice has no effect.
    let path = store.join(file_name(run, text.as_bytes()));
    // A file that cannot be read would make the other runs of the store unreadable, too.
    if text.len() as u64 > DATA {
        let message = format!(
            "the run is too large for a file of a results store (found {} bytes, expected at most {DATA})",
            text.len()
        );
        return Err(FileError::new(&path, message).hint("shearq score with some --sets at a time"));
    }
    atomic::write(&path, text.as_bytes())?;
    Ok(path)
}

fn file_name(run: &RunRecord, bytes: &[u8]) -> String {
    let words: Vec<&str> = run
        .configuration
        .split(|c: char| !c.is_ascii_alphanumeric())
        .filter(|word| !word.is_empty())
        .collect();
    let print = fingerprint::of_bytes(bytes);
    format!("{}-{}-{print}.json", words.join("-"), run.id())
}

fn read_run(path: &Path) -> Result<RunRecord, FileError> {
    let (run, text) =
        parse_run(path).map_err(|error| error.hint("move it out of the folder of the store"))?;
    check_name(path, &file_name(&run, text.as_bytes()))?;
    Ok(run)
}

fn parse_run(path: &Path) -> Result<(RunRecord, String), FileError> {
    // Records of thousands of sets or images exceed the limit of settings.
    let text =
        read_to_string(path, DATA).map_err(FileError::doing(path, "cannot read the record"))?;
    let Stored { schema, run } = parse_record::<Stored<RunRecord>>(path, &text)?;
    if schema != SCHEMA {
        let message = format!(
            "not a file of a results store (found the schema `{schema}`, expected `{SCHEMA}`)"
        );
        return Err(FileError::new(path, message));
    }
    run.check().map_err(|error| FileError::new(path, error))?;
    Ok((run, text))
}

// JSON is easily edited, and other settings would be compared as a run that never was. A copy under another name would be
// taken for other results of the same sets.
fn check_name(path: &Path, expected: &str) -> Result<(), FileError> {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    if name == expected {
        return Ok(());
    }
    let hash = |name: &str| {
        let (_, hash) = name.strip_suffix(".json")?.rsplit_once('-')?;
        let is_hash = hash.len() == 16 && hash.bytes().all(|byte| byte.is_ascii_hexdigit());
        is_hash.then(|| hash.to_owned())
    };
    let (message, hint) = match (hash(&name), hash(expected)) {
        (Some(own), Some(content)) if own != content => (
            format!(
                "the file was changed after it was recorded (found content {content}, expected {own} as in its name)"
            ),
            "remove it, and shearq score --measured OUT --store DIR",
        ),
        _ => (
            format!(
                "the file was renamed or copied after it was recorded (expected the name {expected})"
            ),
            "that name; remove the file if it was edited, too, or if there is one of that name",
        ),
    };
    Err(FileError::new(path, message).hint(hint))
}

/// The run of each file of a store, in order of the names.
pub fn files(store: &Path) -> Result<Vec<(PathBuf, RunRecord)>, FileError> {
    let paths = paths(store)?.into_iter();
    paths
        .map(|path| Ok((path.clone(), read_run(&path)?)))
        .collect()
}

// The records of a store. Files of other kinds, such as notes or a printed table, may lie beside them.
fn paths(store: &Path) -> Result<Vec<PathBuf>, FileError> {
    check_folder(store, "the folder of a results store")?;
    let mut paths = atomic::list(store)?;
    paths.retain(|path| {
        let name = path.file_name().unwrap_or_default();
        let ending = path.extension();
        // Some file systems change the case of names.
        !name.as_encoded_bytes().starts_with(b".")
            && ending.is_some_and(|own| own.eq_ignore_ascii_case("json"))
    });
    Ok(paths)
}

/// All runs of a store, sorted by configuration and id, and warnings about them.
///
/// If several files contain one set of one run, the set with most images is used.
pub fn read(store: &Path) -> Result<(Vec<RunRecord>, Vec<String>), FileError> {
    let mut runs: BTreeMap<(String, String), RunRecord> = BTreeMap::new();
    let mut notes = Vec::new();
    for (path, run) in files(store)? {
        match runs.entry((run.configuration.clone(), run.id())) {
            Entry::Vacant(place) => {
                place.insert(run);
            }
            Entry::Occupied(mut place) => merge(place.get_mut(), run, &path, &mut notes),
        }
    }
    Ok((runs.into_values().collect(), notes))
}

fn merge(run: &mut RunRecord, more: RunRecord, path: &Path, notes: &mut Vec<String>) {
    for set in more.sets {
        match run.sets.iter_mut().find(|own| own.set == set.set) {
            None => run.sets.push(set),
            Some(own) => {
                // A set scored before all of its images were measured is replaced by the complete one.
                if own.images.len() == set.images.len() {
                    notes.push(format!(
                        "warning: {} repeats set {} of another file with other results on as many images; the other file is used.",
                        path.display(),
                        set.set
                    ));
                } else if own.images.len() < set.images.len() {
                    *own = set;
                }
            }
        }
    }
    run.sets.sort_by_key(|set| set.set);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::record::SetRecord;
    use shearq_quantities::Frame;
    use shearq_scoring::{Choice, Convention, Definition, Noise};

    fn run(configuration: &str, sets: &[(u32, u32, f64)]) -> RunRecord {
        let record = |&(set, images, q): &(u32, u32, f64)| {
            let mut record = SetRecord::unknown(set);
            (record.images, record.galaxies) = ((1..=images).collect(), 64);
            (record.metrics.q, record.q_replicates) = (q, vec![q, f64::NAN]);
            if set == 7 {
                record.frame = Frame::Sky;
            }
            record
        };
        RunRecord {
            configuration: configuration.into(),
            version: "1".into(),
            settings: String::new(),
            source: "s".into(),
            definition: Definition::Leaderboard,
            choice: Choice::Insist(Convention::STANDARD),
            noise: Noise::Given(0.01),
            sets: sets.iter().map(record).collect(),
        }
    }

    #[test]
    fn a_file_that_cannot_be_read_is_to_be_moved() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("a.json"), "{").unwrap();
        let error = files(folder.path()).unwrap_err();
        assert!(error.text().contains("Try: move it out"), "{error}");
    }

    #[test]
    fn runs_are_read_back_and_more_images_replace_fewer() {
        let folder = tempfile::tempdir().unwrap();
        let store = folder.path().join("store");
        let _prepared = prepare(&store).unwrap();
        let first = run("b", &[(2, 1, 10.0), (7, 3, 20.0)]);
        let path = write(&store, &first).unwrap();
        assert_eq!(write(&store, &first).unwrap(), path);
        write(&store, &run("b", &[(2, 4, 11.0)])).unwrap();
        write(&store, &run("a", &[(1, 1, 5.5)])).unwrap();
        let (runs, notes) = read(&store).unwrap();
        assert!(notes.is_empty(), "{notes:?}");
        let sets = runs.iter().flat_map(|run| &run.sets);
        assert_eq!(sets.filter(|set| set.frame == Frame::Sky).count(), 1);
        let found = |run: &RunRecord| -> Vec<(u32, usize, f64)> {
            let sets = run.sets.iter();
            sets.map(|set| (set.set, set.images.len(), set.metrics.q))
                .collect()
        };
        assert_eq!(runs.len(), 2);
        assert_eq!(
            (runs[0].configuration.as_str(), found(&runs[0])),
            ("a", vec![(1, 1, 5.5)])
        );
        assert_eq!(found(&runs[1]), [(2, 4, 11.0), (7, 3, 20.0)]);
        assert!(runs[0].sets[0].q_replicates[1].is_nan());
        // Other results on as many images.
        write(&store, &run("a", &[(1, 1, 6.5)])).unwrap();
        let (_, notes) = read(&store).unwrap();
        assert!(
            notes.len() == 1 && notes[0].contains("repeats set 1"),
            "{notes:?}"
        );
    }

    #[test]
    fn values_and_names_that_no_run_has_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        for (edit, expected) in [
            (
                (|run| run.sets[0].galaxies = 1 << 62) as fn(&mut RunRecord),
                "set 1: found ",
            ),
            (|run| run.sets[0].flagged = 65, "set 1: found "),
            (|run| run.sets.clear(), "the run has no sets"),
            (
                |run| run.configuration = "\u{1b}[2J".into(),
                "without control characters",
            ),
            (
                |run| run.sets.push(run.sets[0].clone()),
                "found set 1 twice",
            ),
            (
                |run| run.sets[0].set = 10_000,
                "found set 10000 twice, or above 9999",
            ),
            (
                |run| run.sets[0].images.push(3),
                "set 1: found an image twice",
            ),
            (
                |run| run.sets[0].errors.m1 = -0.1,
                "set 1: the error of m1 is -0.1; expected",
            ),
        ] {
            let mut own = run("a", &[(1, 3, 5.5)]);
            edit(&mut own);
            let path = write(folder.path(), &own).unwrap();
            let message = read(folder.path()).unwrap_err().to_string();
            assert!(
                message.contains(expected) && !message.contains('\u{1b}'),
                "{message}"
            );
            std::fs::remove_file(path).unwrap();
        }
    }

    #[test]
    fn a_run_above_the_limit_of_settings_is_read_back() {
        let folder = tempfile::tempdir().unwrap();
        let own = run("a", &[(1, 400_000, 5.5)]);
        let path = write(folder.path(), &own).unwrap();
        assert!(path.metadata().unwrap().len() > shearq_files::open::SETTINGS);
        let (runs, _) = read(folder.path()).unwrap();
        assert_eq!(runs[0].sets[0].images, own.sets[0].images);
    }
}
