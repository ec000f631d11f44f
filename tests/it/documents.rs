//! What the documents promise: links that lead somewhere, and a tutorial that can be followed.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::support::{fits_image, floats, pixels_of, succeed, text};

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
fn images(folder: &Path) {
    let challenge = folder.join("challenge");
    let set = challenge.join("set02");
    let simulate = ["simulate", "--sets", "2", "--images", "2", "--grid", "16"];
    succeed(&[&simulate[..], &["--out", text(&challenge)]].concat());
    let (pixels, width) = pixels_of(&set.join("galaxies-001.fits"));
    let stamps: Vec<f32> = (0..100)
        .flat_map(|k| {
            let (x, y) = (k % 16 * 48, k / 16 * 48);
            (y..y + 48).flat_map(move |row| row * width + x..row * width + x + 48)
        })
        .map(|pixel| pixels[pixel])
        .collect();
    let cube = fits_image(-32, &[48, 48, 100], &[], &floats(&stamps));
    fs::write(folder.join("field.fits"), cube).unwrap();
    fs::copy(set.join("psf-001.fits"), folder.join("star.fits")).unwrap();
}

/// Does what a page says, in `folder`: the lines of its blocks for a shell, which are so many.
fn follow(page: &str, folder: &Path, expected: usize) {
    let text = fs::read_to_string(Path::new("docs").join(page)).unwrap();
    let text = text.replace("\\\n", " ");
    let blocks = text.split("```sh\n").skip(1);
    let lines = blocks.flat_map(|block| block.split("```").next().unwrap_or("").lines());
    let mut commands = 0;
    for line in lines.filter(|line| line.starts_with("shearq ")) {
        let done = Command::new(env!("CARGO_BIN_EXE_shearq"))
            .args(line.split_whitespace().skip(1))
            .current_dir(folder)
            .output()
            .unwrap();
        let said = String::from_utf8_lossy(&done.stderr);
        assert!(done.status.success(), "{page}: {line}: {said}");
        commands += 1;
    }
    assert_eq!(commands, expected, "{page}");
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
    let root = tempfile::tempdir().unwrap();
    images(root.path());
    follow("own-images.md", root.path(), 4);
    written(root.path(), &["galaxy.png"]);
}

#[test]
fn commands_of_the_pages_run() {
    let first = tempfile::tempdir().unwrap();
    follow("quickstart.md", first.path(), 6);
    written(first.path(), &["steps.png"]);
    let scored = tempfile::tempdir().unwrap();
    follow("score-a-catalogue.md", scored.path(), 4);
    let challenge = tempfile::tempdir().unwrap();
    follow("challenge.md", challenge.path(), 10);
    written(
        challenge.path(),
        &["linear.html", "compare.html", "to-send.tar.gz"],
    );
    let organised = tempfile::tempdir().unwrap();
    follow("run-a-challenge.md", organised.path(), 7);
    written(
        organised.path(),
        &[
            "leaderboard.html",
            "pilot/README.md",
            "truth/set08/truth.csv",
        ],
    );
    let recipes = tempfile::tempdir().unwrap();
    follow("recipes.md", recipes.path(), 27);
    let files = [
        "own.toml",
        "parts/scores.csv",
        "spectra.tar.gz",
        "study/report.html",
    ];
    written(recipes.path(), &files);
}
