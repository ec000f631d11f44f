//! Names the commit that is built, for `shearq --version` and the origin of results.

use std::path::Path;
use std::process::Command;

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-env-changed=SHEARQ_COMMIT");
    // Builds of releases set it, and compile without the repository.
    if std::env::var_os("SHEARQ_COMMIT").is_some() {
        return;
    }
    // An archive of the sources may have been unpacked in the repository of something else.
    let is_top = git(&["rev-parse", "--show-prefix"]).is_some_and(|prefix| prefix.is_empty());
    let commit = git(&["rev-parse", "--short=12", "HEAD"]).filter(|_| is_top);
    let Some(commit) = commit else { return };
    println!("cargo::rustc-env=SHEARQ_COMMIT={commit}");
    // Each commit changes the branch or, if that is packed, the log. A path that is absent would run this at each build.
    let branch = git(&["symbolic-ref", "HEAD"]);
    for name in ["HEAD", "logs/HEAD"].into_iter().chain(branch.as_deref()) {
        if let Some(path) = git(&["rev-parse", "--git-path", name])
            && Path::new(&path).exists()
        {
            println!("cargo::rerun-if-changed={path}");
        }
    }
}

fn git(arguments: &[&str]) -> Option<String> {
    let output = Command::new("git").args(arguments).output().ok()?;
    let text = String::from_utf8(output.stdout).ok()?;
    output.status.success().then(|| text.trim().to_owned())
}
