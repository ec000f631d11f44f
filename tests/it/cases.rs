//! Runs the pages of `tests/cases`: commands, and what they print. `SHEARQ_ACCEPT=1` writes what they print now, and
//! `SHEARQ_CASES=positions` runs the page of this name alone.
//!
//! A page has cases under `##` headings, each in a new folder, and may start with functions of the shell. In blocks of `console`, `$` starts a command of the shell,
//! `>` continues it, and `? 1` states an exit code other than 0; then comes the output. In it `[..]` is any text and a line
//! `...` any lines. Times and checksums are printed as `[..]`, and the folder as `[CASE]`. Commands of [`crate::inputs`] make images.

use std::path::Path;

use crate::inputs;
use crate::support::shell;

/// A command with what it is expected to print.
struct Step {
    line: usize,
    command: String,
    status: i32,
    output: Vec<String>,
}

/// Whether a line is one with `[..]` for any text.
fn fits(pattern: &str, line: &str) -> bool {
    let Some((start, rest)) = pattern.split_once("[..]") else {
        return pattern == line;
    };
    let Some(line) = line.strip_prefix(start) else {
        return false;
    };
    let mut ends = (0..=line.len()).filter(|at| line.is_char_boundary(*at));
    ends.any(|at| fits(rest, &line[at..]))
}

/// Whether lines are as expected, with `...` for any number of them.
fn agree(expected: &[String], lines: &[String]) -> bool {
    match expected.split_first() {
        None => lines.is_empty(),
        Some((dots, rest)) if dots == "..." => {
            (0..=lines.len()).any(|skip| agree(rest, &lines[skip..]))
        }
        Some((pattern, rest)) => lines
            .split_first()
            .is_some_and(|(line, others)| fits(pattern, line) && agree(rest, others)),
    }
}

/// The output without the place of the folder, and without times, which differ from run to run.
fn redacted(output: &str, root: &str) -> Vec<String> {
    let line = |line: &str| {
        let mut words: Vec<&str> = line.trim_end().split(' ').collect();
        for k in 1..words.len() {
            let unit = words[k].trim_end_matches([',', '.', ';', ')']);
            if ["s", "ms", "µs"].contains(&unit) && words[k - 1].parse::<f64>().is_ok() {
                words[k - 1] = "[..]";
            }
        }
        // Fingerprints and checksums change with versions.
        let sum = |word: &str| {
            let word = word.trim_matches(|c: char| !c.is_ascii_alphanumeric());
            word.len() >= 16 && word.bytes().all(|b| b.is_ascii_hexdigit())
        };
        let words = words.into_iter();
        let words: Vec<&str> = words.map(|w| if sum(w) { "[..]" } else { w }).collect();
        let line = words.join(" ");
        // Systems number their errors differently.
        match line.split_once("(os error ") {
            Some((start, rest)) => {
                let end = rest.find(')').unwrap_or(rest.len());
                format!("{start}(os error [..]{}", &rest[end..])
            }
            None => line,
        }
    };
    output.replace(root, "[CASE]").lines().map(line).collect()
}

/// Runs a command in `root`, and gives its exit code and what it printed.
fn run(functions: &str, command: &str, root: &Path) -> (i32, Vec<String>) {
    if let Some(printed) = inputs::run(command, root) {
        return (0, printed.lines().map(str::to_owned).collect());
    }
    let data = std::env::current_dir().unwrap().join("tests/data");
    let settings = "exec 2>&1; export LC_ALL=C COLUMNS=120";
    let lines = format!("{settings}\n{functions}\n{command}");
    let output = shell(root, &lines.replace("[tests/data]", data.to_str().unwrap()));
    let printed = String::from_utf8_lossy(&output.stdout);
    assert!(!printed.contains("panicked"), "{command}: {printed}");
    let root = root.to_str().unwrap();
    (output.status.code().unwrap_or(-1), redacted(&printed, root))
}

/// Runs a page, and gives it with the output of today and the differences.
fn page(text: &str, chosen: &str) -> (String, Vec<String>) {
    let (mut now, mut wrong) = (String::new(), Vec::new());
    let (mut title, mut root) = (String::new(), None);
    let functions = text
        .split("```")
        .nth(1)
        .and_then(|block| block.strip_prefix("sh\n"));
    let functions = functions.unwrap_or_default();
    let mut lines = text.lines().enumerate().peekable();
    let mut inside = false;
    while let Some((number, line)) = lines.next() {
        now += &format!("{line}\n");
        if line.starts_with("```") {
            inside = line == "```console";
        }
        if let Some(heading) = line.strip_prefix("## ") {
            (title, root) = (heading.to_owned(), None);
        }
        let Some(command) = line.strip_prefix("$ ").filter(|_| inside) else {
            continue;
        };
        let (mut status, mut output) = (0, Vec::new());
        let mut command = command.to_owned();
        while let Some((_, line)) = lines.next_if(|(_, line)| line.starts_with("> ")) {
            now += &format!("{line}\n");
            command += &format!("\n{}", &line[2..]);
        }
        while let Some((_, line)) = lines.next_if(|(_, l)| !l.starts_with("$ ") && *l != "```") {
            match line.strip_prefix("? ") {
                Some(code) if output.is_empty() => status = code.parse().expect("an exit code"),
                _ => output.push(line.to_owned()),
            }
        }
        let mut step = Step {
            line: number + 1,
            command,
            status,
            output,
        };
        if title.contains(chosen) {
            let folder = root.get_or_insert_with(|| tempfile::tempdir().unwrap());
            let found = run(
                functions,
                &step.command,
                &folder.path().canonicalize().unwrap(),
            );
            if found.0 != step.status || !agree(&step.output, &found.1) {
                let Step { line, command, .. } = &step;
                let [expected, printed] = [&step.output, &found.1].map(|lines| lines.join("\n"));
                wrong.push(format!(
                    "line {line}, {title}: {command}\nexpected {}:\n{expected}\nfound {}:\n{printed}\n",
                    step.status, found.0
                ));
                (step.status, step.output) = found;
            }
        }
        if step.status != 0 {
            now += &format!("? {}\n", step.status);
        }
        now.extend(step.output.iter().map(|line| format!("{line}\n")));
    }
    (now, wrong)
}

/// Runs the page of a file, and gives the differences.
fn differences(path: &Path) -> Vec<String> {
    let text = std::fs::read_to_string(path).unwrap();
    // `CASE=words` runs the cases whose heading has these words.
    let (now, wrong) = page(&text, &std::env::var("CASE").unwrap_or_default());
    if std::env::var_os("SHEARQ_ACCEPT").is_some() {
        std::fs::write(path, now).unwrap();
        return Vec::new();
    }
    let place = |wrong: String| format!("{}: {wrong}", path.display());
    wrong.into_iter().map(place).collect()
}

#[test]
fn commands_of_the_cases_print_what_their_pages_say() {
    let pages = std::fs::read_dir("tests/cases").unwrap();
    let mut pages: Vec<_> = pages.map(|entry| entry.unwrap().path()).collect();
    if let Ok(name) = std::env::var("SHEARQ_CASES") {
        pages.retain(|page| page.file_stem().is_some_and(|stem| *stem == *name));
        assert!(!pages.is_empty(), "there is no page tests/cases/{name}.md");
    }
    let wrong: Vec<String> = std::thread::scope(|scope| {
        let running: Vec<_> = pages
            .iter()
            .map(|page| scope.spawn(|| differences(page)))
            .collect();
        let found = running.into_iter().map(|page| page.join().unwrap());
        found.flatten().collect()
    });
    assert!(
        wrong.is_empty(),
        "{} commands differ (SHEARQ_ACCEPT=1 rewrites the pages):\n{}",
        wrong.len(),
        wrong.join("\n")
    );
}
