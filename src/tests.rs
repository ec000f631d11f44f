//! The options that go together, and the commands of the documents.

use clap::{Arg, Command, CommandFactory};

use crate::{Cli, causes};

// As a shell splits a line: quoted text is one word, and a redirection ends the command.
fn words(line: &str) -> Vec<String> {
    let (mut words, mut word, mut quote) = (Vec::new(), None::<String>, None);
    for c in line.chars() {
        match quote {
            Some(open) if c == open => quote = None,
            None if c == '\'' || c == '"' => {
                quote = Some(c);
                word.get_or_insert_default();
            }
            None if c.is_whitespace() => words.extend(word.take()),
            _ => word.get_or_insert_default().push(c),
        }
    }
    words.extend(word);
    words.into_iter().take_while(|word| word != ">").collect()
}

// The commands in the documents, except those with shell variables. A backslash joins two lines.
fn documented() -> Vec<(String, String)> {
    let mut found = Vec::new();
    let mut pages = vec!["README.md".into(), "CONTRIBUTING.md".into()];
    pages.extend(
        std::fs::read_dir("docs")
            .unwrap()
            .map(|entry| entry.unwrap().path())
            .filter(|path| path.extension().is_some_and(|ending| ending == "md")),
    );
    for page in pages {
        let text = std::fs::read_to_string(&page).unwrap();
        let text = text.replace("\\\n", " ");
        let mut inside = false;
        for line in text.lines() {
            if line.starts_with("```") {
                inside = !inside;
            } else if inside && line.starts_with("shearq ") && !line.contains('$') {
                found.push((page.display().to_string(), line.to_owned()));
            }
        }
    }
    found
}

#[test]
fn causes_are_printed_once() {
    let error = anyhow::anyhow!("no space")
        .context("cannot write: no space")
        .context("out.csv");
    assert_eq!(causes(&error), "out.csv: cannot write: no space");
    assert_eq!(causes(&anyhow::anyhow!("a").context("b")), "b: a");
}

#[test]
fn the_version_names_the_commit_of_the_repository() {
    // Sources of an archive, and those within another repository, have no commit.
    if option_env!("SHEARQ_COMMIT").is_none() {
        return;
    }
    let mut git = std::process::Command::new("git");
    let head = git.args(["rev-parse", "--short=12", "HEAD"]).output();
    let head = String::from_utf8(head.unwrap().stdout).unwrap();
    let expected = format!("{} ({})", shearq_dataset::VERSION, head.trim());
    assert_eq!(crate::version_and_commit(), expected);
}

#[test]
fn names_contain_no_character_that_messages_escape() {
    for c in (char::MIN..=char::MAX).filter(|c| !['\n', '\t'].contains(c)) {
        let name = c.to_string();
        let is_plain = shearq_render::escape::visible(&name) == name;
        assert_eq!(
            shearq_submissions::check_name(&name).is_ok(),
            is_plain,
            "{c:?}"
        );
    }
}

#[test]
fn documented_commands_parse() {
    let commands = documented();
    assert!(commands.len() > 20);
    for (page, line) in commands {
        let line = line.split(" #").next().unwrap_or(&line);
        let parsed = crate::parsed(words(line));
        assert!(parsed.is_ok(), "{page}: {line}: {}", parsed.unwrap_err());
    }
}

#[test]
fn negative_and_large_numbers_reach_their_checks() {
    for (line, expected) in [
        ("shearq bias --area -3 a.csv", "expected a positive number"),
        (
            "shearq challenge new --name a --kind scenes --scenes 3 --max-m 5 --public b --private c",
            "expected a positive number up to 0.5",
        ),
    ] {
        let error = crate::parsed(words(line)).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    }
    let list = "shearq detect --exposure a b --psf p --noise 1 -2 --out c";
    assert!(crate::parsed(words(list)).is_ok());
}

#[test]
fn every_command_has_examples_that_parse() {
    for command in Cli::command().get_subcommands() {
        let help = command
            .get_after_help()
            .map(ToString::to_string)
            .unwrap_or_default();
        let start = format!("  shearq {}", command.get_name());
        let examples: Vec<&str> = help
            .lines()
            .filter(|line| line.starts_with(&start))
            .collect();
        assert!(!examples.is_empty(), "{}: {help}", command.get_name());
        for example in examples {
            let parsed = crate::parsed(words(example));
            assert!(parsed.is_ok(), "{example}: {}", parsed.unwrap_err());
        }
    }
}

// The ways to use each command, and the options that each way uses. Two options without a common way must be
// refused. Only names are compared where the ways of a command depend on more than two options.
const WAYS: &str = include_str!("ways.txt");

// The ways of a command.
fn ways(path: &str) -> Option<Vec<Vec<&'static str>>> {
    let mut lines = WAYS.lines().skip_while(|line| *line != path);
    lines.next()?;
    let ways = lines.map_while(|line| line.strip_prefix("    "));
    Some(ways.map(|way| way.split(' ').collect()).collect())
}

// Commands whose pairs are not compared.
const NAMES_ONLY: [&str; 2] = ["baseline record", "baseline check"];

// Pairs that the command refuses when it runs.
const REFUSED_WHEN_RUN: [(&str, &str, &str); 7] = [
    ("run", "data", "grid"),
    ("run", "data", "seed"),
    ("run", "data", "amplitude"),
    ("run", "data", "tilt"),
    ("run", "data", "fixed-psf"),
    ("run", "shard", "store"),
    ("run", "shard", "report"),
];

// The name of an option on the command line.
fn name(argument: &Arg) -> String {
    let value = || {
        let names = argument.get_value_names().unwrap_or_default();
        names.first().map(ToString::to_string)
    };
    let name = argument.get_long().map(str::to_owned).or_else(value);
    name.unwrap_or_else(|| argument.get_id().to_string().to_uppercase())
}

// Whether clap refuses two options together.
fn refused(command: &Command, a: &Arg, b: &Arg) -> bool {
    let names = |a: &Arg, b: &Arg| {
        let others = command.get_arg_conflicts_with(a);
        others.iter().any(|other| other.get_id() == b.get_id())
    };
    let exclusive = command.get_groups().any(|group| {
        let mut members = group.get_args();
        let both =
            group.get_args().any(|id| id == a.get_id()) && members.any(|id| id == b.get_id());
        // Flattened structures are groups that allow several members.
        both && !group.clone().is_multiple()
    });
    let alone = a.is_exclusive_set() || b.is_exclusive_set();
    names(a, b) || names(b, a) || exclusive || alone
}

// Compares a command, or its subcommands, with the table.
fn compare(path: &str, command: &Command, wrong: &mut Vec<String>) {
    if command.has_subcommands() {
        for inner in command.get_subcommands() {
            let path = format!("{path} {}", inner.get_name());
            compare(path.trim(), inner, wrong);
        }
        return;
    }
    let Some(ways) = ways(path) else {
        wrong.push(format!("{path}: not in the table of ways"));
        return;
    };
    let options: Vec<&Arg> = command
        .get_arguments()
        .filter(|a| !a.is_global_set() && !["help", "version"].contains(&a.get_id().as_str()))
        .collect();
    for way in ways.iter().flatten() {
        if !options.iter().any(|option| name(option) == *way) {
            wrong.push(format!("{path}: there is no option {way}"));
        }
    }
    for (k, a) in options.iter().enumerate() {
        let first = name(a);
        let has = |way: &&Vec<&str>, name: &str| way.contains(&name);
        if !ways.iter().any(|way| has(&way, &first)) {
            wrong.push(format!("{path}: {first} is in no way of using it"));
        }
        if NAMES_ONLY.contains(&path) {
            continue;
        }
        for b in &options[k + 1..] {
            let second = name(b);
            let used = ways
                .iter()
                .any(|way| has(&way, &first) && has(&way, &second));
            let when_run = |(of, x, y): &(&str, &str, &str)| {
                *of == path && [(*x, *y), (*y, *x)].contains(&(first.as_str(), second.as_str()))
            };
            let when_run = REFUSED_WHEN_RUN.iter().any(when_run);
            match (used && !when_run, refused(command, a, b)) {
                (true, true) => wrong.push(format!("{path}: {first} with {second} is refused")),
                (false, false) if !when_run => {
                    wrong.push(format!("{path}: {first} with {second} is ignored"));
                }
                _ => {}
            }
        }
    }
}

#[test]
fn every_pair_of_options_is_used_or_refused() {
    let mut cli = Cli::command();
    cli.build();
    let mut wrong = Vec::new();
    compare("", &cli, &mut wrong);
    wrong.retain(|line| !line.contains("help"));
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}
