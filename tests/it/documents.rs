//! What the documents promise: links that lead somewhere, and a tutorial that can be followed.

use std::fs;
use std::path::{Path, PathBuf};

use crate::support::{Folder, printed, shell, stamps_of};

/// The documents.
pub(crate) fn pages() -> Vec<PathBuf> {
    let mut pages: Vec<PathBuf> = fs::read_dir("docs")
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|ending| ending == "md"))
        .collect();
    pages.extend(["README.md", "CONTRIBUTING.md", "CHANGELOG.md"].map(PathBuf::from));
    pages
}

/// What a page links to within the project.
fn links(page: &Path) -> Vec<String> {
    let text = fs::read_to_string(page).unwrap();
    let targets = text.split("](").skip(1);
    targets
        .filter_map(|rest| rest.split(')').next())
        .filter(|target| !target.contains("://") && !target.starts_with('#'))
        .map(|target| target.split('#').next().unwrap_or(target).to_owned())
        .collect()
}

#[test]
fn links_lead_to_files_and_the_summary_has_every_page() {
    let mut count = 0;
    for page in pages() {
        for target in links(&page) {
            let path = page.parent().unwrap().join(&target);
            assert!(path.exists(), "{}: {target}", page.display());
            // The site has the documents alone.
            let inside = !page.starts_with("docs") || !target.starts_with("..");
            assert!(inside, "{}: {target}", page.display());
            count += 1;
        }
    }
    assert!(count > 20, "{count} links");
    let listed = links(Path::new("docs/SUMMARY.md"));
    for page in pages() {
        let name = page.file_name().unwrap().to_string_lossy().into_owned();
        let listed = listed.contains(&name);
        let expected = page.starts_with("docs") && name != "SUMMARY.md";
        assert_eq!(listed, expected, "{name}");
    }
}

/// Simulated images instead of those that the tutorial's script renders.
fn images() -> Folder {
    let folder = Folder::new();
    folder.run("simulate --fixed-psf one --sets 2 --images 2 --grid 16 --out challenge");
    let stamps = stamps_of(&folder.at("challenge/set02/galaxies-001.fits"), 48);
    folder.image("field.fits", &[48, 48, 100], &[], &stamps[..100].concat());
    let star = folder.at("challenge/set02/psf-001.fits");
    fs::copy(star, folder.at("star.fits")).unwrap();
    folder
}

/// Words with one blank between them, and no rules of tables: the width of a terminal and rules are not the page's.
fn words(text: &str) -> String {
    let words = text
        .split_whitespace()
        .filter(|word| !word.starts_with(['─', '═']));
    words.collect::<Vec<_>>().join(" ")
}

/// Does what a page says, in `folder`: the commands of its blocks for a shell, which are so many. Each line of a block of
/// text that follows one of them has to be in what the commands print, if the data are the page's.
fn follow(page: &str, folder: &Path, expected: usize, own_data: bool) {
    let text = fs::read_to_string(Path::new("docs").join(page)).unwrap();
    let text = text.replace("\\\n", " ");
    let mut done = 0;
    for part in text.split("```sh\n").skip(1) {
        let (block, rest) = part.split_once("```").unwrap();
        let mut said = String::new();
        for line in block.lines().filter(|line| line.starts_with("shearq ")) {
            said += &printed(folder, line);
            done += 1;
        }
        let said = words(&said);
        let shown = rest
            .split("```text\n")
            .skip(1)
            .filter_map(|text| text.split("```").next());
        for line in shown.flat_map(str::lines).filter(|_| own_data) {
            assert!(said.contains(&words(line)), "{page}: {line}: {said}");
        }
    }
    assert_eq!(done, expected, "{page}");
}

/// The files are there and hold something.
fn written(folder: &Path, files: &[&str]) {
    for file in files {
        let size = fs::metadata(folder.join(file)).unwrap().len();
        assert!(size > 1000, "{file}: {size} bytes");
    }
}

#[test]
fn own_images_are_measured_as_their_page_says() {
    let folder = images();
    // The page shows GalSim's galaxies: python/tests/test_tutorial.py compares its output.
    follow("own-images.md", folder.root(), 4, false);
    written(folder.root(), &["galaxy.png"]);
}

#[test]
fn commands_of_the_pages_run() {
    for (page, commands, files) in [
        ("../README.md", 2, &["example/plus.csv"][..]),
        (
            "tutorial-bias.md",
            4,
            &["example/plus.csv", "bias.svg", "bias.html"],
        ),
        (
            "run-a-challenge.md",
            13,
            &[
                "leaderboard.html",
                "pilot/README.md",
                "truth/set08/truth.csv",
                "to-send.tar.gz",
            ],
        ),
        ("stores.md", 10, &["parts/scores.csv"]),
        ("regression.md", 7, &["baselines/mycode.units.json"]),
        ("install.md", 1, &["shearq-quickstart/report.html"]),
    ] {
        let root = tempfile::tempdir().unwrap();
        follow(page, root.path(), commands, true);
        written(root.path(), files);
    }
}

/// The commands of the steps of the workflow in docs/regression.yml, but for the installation.
fn workflow() -> Vec<String> {
    let text = fs::read_to_string("docs/regression.yml").unwrap();
    let steps = text.split("- name: ").skip(1);
    let steps = steps.filter(|step| !step.starts_with("Install"));
    let commands = steps.map(|step| {
        let (_, command) = step.split_once("run: ").unwrap();
        command
            .trim_start_matches('|')
            .trim()
            .replace("\n          ", "\n")
    });
    commands.collect()
}

#[test]
fn workflow_of_a_toy_code_fails_on_a_changed_m() {
    let folder = Folder::new();
    let code = fs::read_to_string("docs/regression-measure.py").unwrap();
    // Prints of each run, and its exit code.
    let run = || {
        let steps = workflow().join("\n");
        let line = format!("export GITHUB_STEP_SUMMARY=summary.md\nset -e\n{steps}");
        fs::write(folder.at("steps.sh"), line).unwrap();
        let output = shell(folder.root(), "bash steps.sh");
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        let summary = fs::read_to_string(folder.at("summary.md")).unwrap_or_default();
        fs::remove_file(folder.at("summary.md")).unwrap();
        (output.status.code(), summary, said)
    };
    folder.write("measure.py", &code);
    assert!(shell(folder.root(), "python3 measure.py").status.success());
    folder.run("baseline record mycode --folder baselines -- bias plus.csv minus.csv");
    let (status, summary, said) = run();
    assert_eq!(status, Some(0), "{summary} {said}");
    assert!(
        summary.contains("| m1 ") && summary.contains("0.0005 (m)"),
        "{summary}"
    );
    // By a tenth of the error of m1 of these galaxies, whose noise is in both measurements.
    folder.write(
        "measure.py",
        code.replace("M = 0.02, 0.010", "M = 0.02, 0.012"),
    );
    let (status, summary, said) = run();
    assert_eq!(status, Some(1), "{summary} {said}");
    let row = |name: &str| {
        summary
            .lines()
            .find(|line| line.contains(&format!("| {name} ")))
            .unwrap()
    };
    assert!(
        row("m1").contains("yes") && row("c1").contains("no"),
        "{summary}"
    );
    // An accepted change passes.
    folder.run("baseline check mycode --folder baselines --update");
    assert_eq!(run().0, Some(0));
    // Of other galaxies, nothing can be said.
    folder.write("measure.py", code.replace("range(5000)", "range(4000)"));
    let (status, _, said) = run();
    assert!(
        status == Some(1) && said.contains("needs the same galaxies"),
        "{said}"
    );
}
