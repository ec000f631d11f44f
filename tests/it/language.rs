//! The language of user-visible text: `--help` (doc comments of `src`), string literals of messages, and documents.
//! Sentences have at most [`MOST_WORDS`] words, and phrases that are hard to read are banned.

use std::fs;
use std::path::{Path, PathBuf};

/// Most words of a sentence; clauses before `:` and `;` count separately.
const MOST_WORDS: usize = 30;

/// Most words of a sentence of `--help`.
const MOST_WORDS_OF_HELP: usize = 25;

/// Source code whose string literals are checked. Test modules are left out.
const SOURCES: [&str; 5] = [
    "src",
    "crates",
    "scoring/src",
    "submissions/src",
    "python/src",
];

/// Source code whose doc comments are checked too. The doc comments of `src` are the text of `--help`.
const DOCUMENTED: [&str; 2] = ["src", "crates/results/src"];

/// Documents whose sentences are checked for their length.
const PAGES: [&str; 45] = [
    "README.md",
    "CONTRIBUTING.md",
    "docs/architecture.md",
    "docs/challenge.md",
    "docs/choosing.md",
    "docs/citing.md",
    "docs/clusters.md",
    "docs/files-catalogues.md",
    "docs/files-challenge.md",
    "docs/files-data.md",
    "docs/files-stores.md",
    "docs/files.md",
    "docs/glossary.md",
    "docs/install.md",
    "docs/library.md",
    "docs/limitations.md",
    "docs/other-codes.md",
    "docs/own-images.md",
    "docs/python.md",
    "docs/quickstart.md",
    "docs/recipes.md",
    "docs/reproduction.md",
    "docs/roadmap.md",
    "docs/run-a-challenge.md",
    "docs/score-a-catalogue.md",
    "docs/scoring.md",
    "docs/simulation.md",
    "docs/speed.md",
    "docs/troubleshooting.md",
    "docs/upgrading.md",
    "docs/validate-shapes.md",
    "docs/validation.md",
    "crates/bias/README.md",
    "crates/files/README.md",
    "crates/fourier/README.md",
    "crates/measure/README.md",
    "crates/pipeline/README.md",
    "crates/quantities/README.md",
    "crates/render/README.md",
    "crates/results/README.md",
    "crates/simulate/README.md",
    "crates/studies/README.md",
    "scoring/README.md",
    "submissions/README.md",
    "crates/challenge/README.md",
];

/// Banned phrases and their replacement.
const BANNED: [(&str, &str); 25] = [
    ("told", "stated, given"),
    ("tell", "determine, report, distinguish"),
    ("tells", "determines, reports, distinguishes"),
    ("anew", "again"),
    ("of which", "split the sentence"),
    ("by which", "split the sentence"),
    ("from which on", "split the sentence"),
    ("that of", "repeat the noun"),
    ("those of", "repeat the noun"),
    ("beside", "next to, with"),
    ("as it is", "unchanged"),
    ("as they are", "unchanged"),
    ("nothing is", "state what happens"),
    ("nothing was", "state what happened"),
    ("nothing that", "state what happens"),
    ("what is asked", "name the thing"),
    ("what is left", "name the thing"),
    ("what is looked at", "name the thing"),
    ("what is printed", "name the thing"),
    ("hold against", "compare with"),
    ("holds against", "compares with"),
    ("in one go", "in one step"),
    ("µs a galaxy", "µs per galaxy"),
    ("an image a line", "one image per line"),
    ("goes on where", "resumes"),
];

/// Every Rust file below a folder.
fn rust_files(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        if path.is_dir() {
            if !["tests", "examples", "target"].contains(&name.as_str()) {
                rust_files(&path, found);
            }
        } else if name.ends_with(".rs") && name != "tests.rs" {
            found.push(path);
        }
    }
}

/// The source without its test module, which ends a file.
fn without_tests(source: &str) -> &str {
    let end = source.find("#[cfg(test)]\nmod tests {");
    &source[..end.unwrap_or(source.len())]
}

/// A text with its line.
type Text = (usize, String);

/// The string literals of Rust code with escapes replaced; comments and characters are skipped.
fn literals(source: &str) -> Vec<Text> {
    let code: Vec<char> = source.chars().collect();
    let (mut found, mut at, mut line) = (Vec::new(), 0, 1);
    while at < code.len() {
        match code[at] {
            '\n' => line += 1,
            '/' if code.get(at + 1) == Some(&'/') => {
                while at < code.len() && code[at] != '\n' {
                    at += 1;
                }
                continue;
            }
            'r' if is_raw(&code, at) => {
                let start = (at + 1..).find(|&k| code[k] == '"').unwrap() + 1;
                let closing = format!("\"{}", "#".repeat(start - at - 2));
                let closing: Vec<char> = closing.chars().collect();
                let end = (start..)
                    .find(|&k| code[k..].starts_with(&closing))
                    .unwrap();
                let text: String = code[start..end].iter().collect();
                let lines = text.matches('\n').count();
                found.push((line, text));
                line += lines;
                at = end + closing.len();
                continue;
            }
            '"' => {
                let (text, end) = literal(&code, at + 1);
                found.push((line, text));
                line += code[at..end].iter().filter(|&&c| c == '\n').count();
                at = end;
                continue;
            }
            // A character; a lifetime has no closing quote there.
            '\'' if code.get(at + 1) == Some(&'\\') => {
                at += 3;
                while code[at] != '\'' {
                    at += 1;
                }
            }
            '\'' if code.get(at + 2) == Some(&'\'') => at += 2,
            _ => {}
        }
        at += 1;
    }
    found
}

/// Whether a raw string starts here.
fn is_raw(code: &[char], at: usize) -> bool {
    let part_of_name = at > 0 && (code[at - 1].is_alphanumeric() || code[at - 1] == '_');
    let after = code[at + 1..].iter().find(|&&c| c != '#');
    let bare = matches!(code.get(at + 1), Some('"' | '#'));
    !part_of_name && bare && after == Some(&'"')
}

/// The string literal that starts at `at`, and the place behind its closing quote.
fn literal(code: &[char], mut at: usize) -> (String, usize) {
    let mut text = String::new();
    while code[at] != '"' {
        if code[at] != '\\' {
            text.push(code[at]);
            at += 1;
            continue;
        }
        match code[at + 1] {
            'n' => text.push('\n'),
            // The line goes on at the next word.
            '\n' => {
                while code[at + 2].is_whitespace() {
                    at += 1;
                }
            }
            other => text.push(other),
        }
        at += 2;
    }
    (text, at + 1)
}

/// Paragraphs of Markdown lines, each line with its number; code blocks, tables, headings and links are left out.
fn paragraphs<'a>(lines: impl Iterator<Item = (usize, &'a str)>) -> Vec<Text> {
    let (mut found, mut inside): (Vec<Text>, bool) = (Vec::new(), false);
    let mut ended = true;
    for (number, line) in lines {
        let line = line.trim();
        if line.starts_with("```") {
            inside = !inside;
            ended = true;
        } else if inside || line.is_empty() || line.starts_with(['|', '#', '<', '!', '[']) {
            ended = true;
        } else {
            let item = line.starts_with("* ") || line.starts_with("- ");
            let numbered = line.trim_start_matches(|c: char| c.is_ascii_digit());
            let item = item || (numbered != line && numbered.starts_with(". "));
            match found.last_mut() {
                Some((_, text)) if !ended && !item => {
                    text.push(' ');
                    text.push_str(line);
                }
                _ => found.push((number, line.to_owned())),
            }
            ended = false;
        }
    }
    found
}

/// The paragraphs of doc comments.
fn doc_comments(source: &str) -> Vec<Text> {
    paragraphs(source.lines().enumerate().map(|(number, line)| {
        let line = line.trim();
        let text = line.strip_prefix("///").or(line.strip_prefix("//!"));
        (number + 1, text.unwrap_or(""))
    }))
}

/// The sentences of a text. Code counts as one word, and text in parentheses does not count.
fn sentences(text: &str) -> Vec<String> {
    let mut plain = String::new();
    for (k, part) in text.split('`').enumerate() {
        plain.push_str(if k % 2 == 1 { "CODE" } else { part });
    }
    while let Some(end) = plain.find(')') {
        let Some(start) = plain[..end].rfind('(') else {
            plain.remove(end);
            continue;
        };
        plain.replace_range(start..=end, "");
    }
    let mut found = vec![String::new()];
    for word in plain.split_whitespace() {
        let sentence = found.last_mut().unwrap();
        sentence.push(' ');
        sentence.push_str(word);
        if word.ends_with(['.', '!', '?', ':', ';']) {
            found.push(String::new());
        }
    }
    found
}

/// Faults of a text: sentences above `most` words, and banned phrases if `phrases`.
fn faults(text: &str, most: usize, phrases: bool) -> Vec<String> {
    let mut found = Vec::new();
    for paragraph in text.lines() {
        for sentence in sentences(paragraph) {
            let words: Vec<String> = sentence
                .split_whitespace()
                .map(|word| {
                    word.trim_matches(|c: char| !c.is_alphanumeric())
                        .to_lowercase()
                })
                .filter(|word| !word.is_empty())
                .collect();
            if words.len() > most {
                found.push(format!("{} words: {}…", words.len(), words[..12].join(" ")));
            }
            let spaced = format!(" {} ", words.join(" "));
            for (phrase, advice) in BANNED.iter().filter(|_| phrases) {
                if spaced.contains(&format!(" {phrase} ")) {
                    found.push(format!("\"{phrase}\" ({advice}):{sentence}"));
                }
            }
        }
    }
    let prefix = ["Warning: ", "Error: ", "Note: "];
    if phrases && prefix.iter().any(|prefix| text.starts_with(prefix)) {
        found.push(format!("prefixes are in lower case: {text}"));
    }
    found
}

#[test]
fn user_visible_text_is_plain() {
    let (mut wrong, mut messages) = (Vec::new(), 0);
    let mut check = |path: &Path, line: usize, text: &str, most: usize, phrases: bool| {
        for fault in faults(text, most, phrases) {
            wrong.push(format!("{}:{line}: {fault}", path.display()));
        }
    };
    for folder in SOURCES {
        let mut files = Vec::new();
        rust_files(Path::new(folder), &mut files);
        files.sort();
        for path in files {
            let source = fs::read_to_string(&path).unwrap();
            let source = without_tests(&source);
            for (line, text) in literals(source) {
                if text.split_whitespace().count() > 2 {
                    messages += 1;
                    check(&path, line, &text, MOST_WORDS, true);
                }
            }
            if DOCUMENTED.iter().any(|folder| path.starts_with(folder)) {
                for (line, text) in doc_comments(source) {
                    let help = path.starts_with("src");
                    let most = if help { MOST_WORDS_OF_HELP } else { MOST_WORDS };
                    check(&path, line, &text, most, true);
                }
            }
        }
    }
    for page in PAGES {
        let path = Path::new(page);
        let text = fs::read_to_string(path).unwrap();
        let lines = text.lines().enumerate();
        for (line, text) in paragraphs(lines.map(|(number, line)| (number + 1, line))) {
            check(path, line, &text, MOST_WORDS, false);
        }
    }
    assert!(messages > 500, "{messages} messages");
    assert!(
        wrong.is_empty(),
        "{} faults:\n{}",
        wrong.len(),
        wrong.join("\n")
    );
}

#[test]
fn the_check_finds_long_sentences_and_banned_phrases() {
    let source = "//! No \"literal\".\nlet a = 'x'; let b = '\"'; fn f<'a>() {}\nlet c = \"the noise \\\n   is that of\\nthe sky\";\nlet d = r#\"raw \"text\"\"#;";
    let found = literals(source);
    let expected = [
        (3, "the noise is that of\nthe sky".to_owned()),
        (5, "raw \"text\"".to_owned()),
    ];
    assert_eq!(found, expected);
    assert_eq!(faults(&found[0].1, MOST_WORDS, true).len(), 1);
    assert_eq!(
        faults("Warning: the stamps contain sky", MOST_WORDS, true).len(),
        1
    );
    let thirty = "word ".repeat(30);
    assert!(faults(&thirty, MOST_WORDS, true).is_empty());
    assert!(faults(&format!("{thirty}; {thirty} (more)."), MOST_WORDS, true).is_empty());
    assert_eq!(
        faults(&format!("{thirty} `more`"), MOST_WORDS, true).len(),
        1
    );
    let comment = "/// First line\n/// of which the second\n///\n/// ```text\n/// that of code\n/// ```\nfn f() {}\n";
    let found = doc_comments(comment);
    assert_eq!(found, [(1, "First line of which the second".to_owned())]);
}
