//! What a result was made from: version, command, its settings, the columns that were used, and the files that the command names.

use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use clap::{ArgAction, ArgMatches};
use serde_json::{Map, Value, json};
use shearq_dataset::fingerprint;
use shearq_files::table::Place;

use crate::{program, version_and_commit};

// Settings of a folder of catalogues and of simulated data.
const RECORDS: [&str; 2] = ["run.json", "simulation.json"];

#[derive(Debug, Clone, Default)]
struct Invocation {
    arguments: Vec<OsString>,
    /// By role, of tables of any program.
    columns: Map<String, Value>,
    /// Files and folders that are named and were there before the command, so that results are not among them.
    inputs: Vec<PathBuf>,
}

// Static, because all commands print JSON. Python calls the command line many times.
static INVOCATION: Mutex<Option<Invocation>> = Mutex::new(None);

/// Notes a command with its arguments, the first of which is the program's name. Returns it as a shell reads it.
pub(crate) fn remember(arguments: &[OsString]) -> String {
    let inputs = words_behind_command(arguments)
        .iter()
        .map(|word| input_path(word));
    let invocation = Invocation {
        arguments: arguments.to_vec(),
        columns: Map::new(),
        inputs: inputs.filter(|path| path.exists()).collect(),
    };
    *INVOCATION.lock().unwrap_or_else(PoisonError::into_inner) = Some(invocation);
    command_line(arguments)
}

/// Notes the columns of tables that a command used, by role.
pub(crate) fn remember_columns(columns: impl IntoIterator<Item = (String, String)>) {
    let mut invocation = INVOCATION.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(own) = invocation.as_mut() {
        let named = columns
            .into_iter()
            .map(|(role, column)| (role, column.into()));
        own.columns.extend(named);
    }
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

// The options of a command with their defaults, by name. Flags that were not given are left out.
fn settings(arguments: &[OsString]) -> Map<String, Value> {
    let mut command = program();
    let Ok(matches) = command.try_get_matches_from_mut(arguments) else {
        return Map::new();
    };
    let (mut command, mut matches) = (&command, &matches);
    let mut found = Map::new();
    while let Some((name, own)) = matches.subcommand()
        && let Some(subcommand) = command.find_subcommand(name)
    {
        (command, matches) = (subcommand, own);
        let stated = command.get_arguments().filter_map(|argument| {
            let id = argument.get_id().as_str();
            let value = setting(argument, matches)?;
            Some((argument.get_long().unwrap_or(id).to_owned(), value))
        });
        found.extend(stated.filter(|(_, value)| *value != Value::Bool(false)));
    }
    found
}

fn setting(argument: &clap::Arg, matches: &ArgMatches) -> Option<Value> {
    let id = argument.get_id().as_str();
    let values = matches.try_get_raw(id).ok()??.map(|word| {
        let text = word.to_string_lossy();
        // Numbers and flags have the types that they have in Python.
        let typed = serde_json::from_str(&text).ok();
        let typed = typed.filter(|value: &Value| value.is_number() || value.is_boolean());
        typed.unwrap_or_else(|| text.into_owned().into())
    });
    let mut values: Vec<Value> = values.collect();
    let several = argument
        .get_num_args()
        .is_some_and(|count| count.max_values() > 1);
    let is_list = several || matches!(argument.get_action(), ArgAction::Append);
    match is_list || values.len() > 1 {
        true => Some(values.into()),
        false => values.pop(),
    }
}

/// Version with commit, command, settings, columns, and fingerprints of the files that it names; of a folder those of its records.
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
    json!({
        "version": version_and_commit(),
        "command": command_line(&invocation.arguments),
        "settings": settings(&invocation.arguments),
        "columns": invocation.columns,
        "inputs": inputs,
    })
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

    #[test]
    fn settings_are_options_with_their_types_and_defaults() {
        let of = |line: &str| {
            let words: Vec<OsString> = line.split(' ').map(OsString::from).collect();
            Value::from(settings(&words))
        };
        assert_eq!(
            of("shearq -q bias a.csv b.csv --step 0.02 --columns e1=g_1,e2=g_2 --paired"),
            json!({
                "catalogues": ["a.csv", "b.csv"], "step": 0.02, "columns": ["e1=g_1,e2=g_2"],
                "paired": true, "quiet": true, "format": "table",
            })
        );
        // Commands of a command.
        let listed = of("shearq submissions show 48/linear/star");
        assert_eq!(listed["name"], "48/linear/star");
        assert_eq!(of("shearq bias --no-such-option"), json!({}));
    }
}
