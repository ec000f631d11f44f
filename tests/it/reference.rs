//! Pages of reference that are generated from the program: commands and configuration keys.
//!
//! To write changed pages, run `SHEARQ_ACCEPT=1 cargo test --release --test it reference`.

use std::fs;

use crate::support::{assert_page, succeed};

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
        let help = trimmed(&[&command, "--help"]);
        page += &format!("\n## {command}\n\n```text\n{help}```\n");
        for sub in commands(&[&command]) {
            let help = trimmed(&[&command, &sub, "--help"]);
            page += &format!("\n### {command} {sub}\n\n```text\n{help}```\n");
        }
    }
    assert_page("docs/commands.md", &page, "reference");
}

/// What a command prints, without blanks at the ends of lines.
fn trimmed(arguments: &[&str]) -> String {
    let printed = succeed(arguments);
    let lines = printed
        .lines()
        .map(|line| line.trim_end().to_owned() + "\n");
    lines.collect()
}

#[test]
fn the_page_of_configurations_equals_their_templates() {
    let mut page = String::from(
        "# Configurations\n\nThis page is generated from `shearq submissions list` and the commented files of the two methods.\n\n```text\n",
    );
    page += &trimmed(&["submissions", "list"]);
    page += "```\n";
    for (title, file) in [
        ("The linear method", "submissions/named/48-linear-star.toml"),
        ("The network of the paper", "submissions/named/paper.toml"),
    ] {
        let text = fs::read_to_string(file).unwrap();
        page += &format!("\n## {title}\n\n```toml\n{text}```\n");
    }
    assert_page("docs/configurations.md", &page, "reference");
}
