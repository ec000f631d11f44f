//! What a result was made from: version, command, and the files that the command names.

use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use serde_json::{Map, Value, json};
use shearq_dataset::fingerprint;
use shearq_files::table::Place;

use crate::version_and_commit;

// Settings of a folder of catalogues and of simulated data.
const RECORDS: [&str; 2] = ["run.json", "simulation.json"];

#[derive(Debug, Clone, Default)]
struct Invocation {
    command: String,
    /// Files and folders that are named and were there before the command, so that results are not among them.
    inputs: Vec<PathBuf>,
}

// Static, because all commands print JSON. Python calls the command line many times.
static INVOCATION: Mutex<Option<Invocation>> = Mutex::new(None);

/// Notes a command with its arguments, the first of which is the program's name. Returns it as a shell reads it.
pub(crate) fn remember(arguments: &[OsString]) -> String {
    let command = command_line(arguments);
    let inputs = words_behind_command(arguments)
        .iter()
        .map(|word| input_path(word));
    let invocation = Invocation {
        command: command.clone(),
        inputs: inputs.filter(|path| path.exists()).collect(),
    };
    *INVOCATION.lock().unwrap_or_else(PoisonError::into_inner) = Some(invocation);
    command
}

/// The arguments behind the command's name, before which there may be `-q` and `-v`.
pub(crate) fn words_behind_command(arguments: &[OsString]) -> &[OsString] {
    let is_name = |word: &OsString| !word.to_string_lossy().starts_with('-');
    let name = arguments.iter().skip(1).position(is_name);
    name.map_or(&[], |name| &arguments[name + 2..])
}

// The path of `PATH`, `--option=PATH` or `PATH[TABLE]`.
fn input_path(word: &OsStr) -> PathBuf {
    let text = word.to_str().filter(|text| text.starts_with("--"));
    let value = text.and_then(|text| text.split_once('='));
    Place::of(value.map_or(Path::new(word), |(_, value)| Path::new(value))).path
}

fn command_line(arguments: &[OsString]) -> String {
    let words = arguments.iter().skip(1).map(|word| {
        let word = word.to_string_lossy();
        match word.contains(|c: char| c.is_whitespace() || "'\"()*<>|&;$".contains(c)) {
            true => format!(" '{}'", word.replace('\'', r"'\''")),
            false => format!(" {word}"),
        }
    });
    format!("shearq{}", words.collect::<String>())
}

/// Version with commit, command, and fingerprints of the files that it names; of a folder those of its records.
pub(crate) fn origin() -> Value {
    let invocation = INVOCATION.lock().unwrap_or_else(PoisonError::into_inner);
    let invocation = invocation.clone().unwrap_or_default();
    let records = |folder: &Path| RECORDS.map(|name| folder.join(name)).into_iter();
    let files = invocation
        .inputs
        .iter()
        .flat_map(|path| match path.is_dir() {
            true => records(path).filter(|path| path.is_file()).collect(),
            false => vec![path.clone()],
        });
    let inputs: Map<String, Value> = files
        .filter_map(|path| {
            // A pipe has no content any more.
            let print = path
                .is_file()
                .then(|| fingerprint::of_image(&path).ok())??;
            Some((path.display().to_string(), print.into()))
        })
        .collect();
    json!({ "version": version_and_commit(), "command": invocation.command, "inputs": inputs })
}

/// Time since the start and, on Linux, the most memory that was used.
pub(crate) fn cost(start: Instant) -> String {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let peak = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    let peak = peak.and_then(|text| text.trim().strip_suffix(" kB")?.parse::<f64>().ok());
    let memory = peak.map_or_else(String::new, |kilobytes| {
        format!(", at most {:.0} MB of memory", kilobytes / 1e3)
    });
    format!("{:.1} s{memory}", start.elapsed().as_secs_f64())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn commands_are_as_a_shell_reads_them() {
        let words = ["shearq", "bias", "a b.csv", "--where", "snr > 10", "it's"];
        let text = command_line(&words.map(OsString::from));
        assert_eq!(text, r"shearq bias 'a b.csv' --where 'snr > 10' 'it'\''s'");
    }
}
