//! Pages of reference that are generated from the program: commands and configuration keys.
//!
//! To write changed pages, run `SHEARQ_ACCEPT=1 cargo test --release --test it reference`.

use std::fmt::Write;
use std::fs;

use crate::support::succeed;

/// Compares a page with its expected text, or writes it if changes are accepted.
fn same(page: &str, expected: &str) {
    let found = fs::read_to_string(page).unwrap_or_default();
    if found != expected && std::env::var_os("SHEARQ_ACCEPT").is_some() {
        fs::write(page, expected).unwrap();
        return;
    }
    assert!(
        found == expected,
        "{page} is out of date. Try: SHEARQ_ACCEPT=1 cargo test --release --test it reference"
    );
}

/// The names of the commands in the help of `arguments`.
fn commands(arguments: &[&str]) -> Vec<String> {
    let help = succeed(&[arguments, &["--help"]].concat());
    let list = help.split("Commands:\n").nth(1).unwrap_or("");
    let list = list.split("\n\n").next().unwrap_or("");
    let names = list
        .lines()
        .filter(|line| line.starts_with("  ") && !line.starts_with("   "));
    names
        .filter_map(|line| line.split_whitespace().next())
        .filter(|name| *name != "help")
        .map(str::to_owned)
        .collect()
}

#[test]
fn the_page_of_commands_equals_their_help() {
    let mut page =
        String::from("# Commands\n\nThis page is generated from `shearq COMMAND --help`.\n");
    for command in commands(&[]) {
        write!(
            page,
            "\n## {command}\n\n```text\n{}```\n",
            help(&[&command])
        )
        .unwrap();
        for sub in commands(&[&command]) {
            write!(
                page,
                "\n### {command} {sub}\n\n```text\n{}```\n",
                help(&[&command, &sub])
            )
            .unwrap();
        }
    }
    same("docs/commands.md", &page);
}

/// The help without blanks at the ends of lines.
fn help(arguments: &[&str]) -> String {
    let help = succeed(&[arguments, &["--help"]].concat());
    help.lines()
        .fold(String::new(), |text, line| text + line.trim_end() + "\n")
}

#[test]
fn the_page_of_configurations_equals_their_templates() {
    let mut page = String::from(
        "# Configurations\n\nThis page is generated from `shearq submissions list` and the commented files of the two methods.\n\n```text\n",
    );
    page += &succeed(&["submissions", "list"])
        .lines()
        .fold(String::new(), |text, line| text + line.trim_end() + "\n");
    page += "```\n";
    for (title, file) in [
        ("The linear method", "submissions/named/48-linear-star.toml"),
        ("The network of the paper", "submissions/named/paper.toml"),
    ] {
        write!(
            page,
            "\n## {title}\n\n```toml\n{}```\n",
            fs::read_to_string(file).unwrap()
        )
        .unwrap();
    }
    same("docs/configurations.md", &page);
}
