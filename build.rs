//! Tells the program which commit it is built from, where that can be known: `CZ_COMMIT` says it, or git does.

use std::path::Path;
use std::process::Command;

fn main() {
    println!("cargo:rerun-if-env-changed=CZ_COMMIT");
    println!("cargo:rerun-if-changed=build.rs");
    let given = std::env::var("CZ_COMMIT").ok().filter(|commit| !commit.is_empty());
    // Not in debug builds: each commit would have everything built again.
    let is_release = std::env::var("PROFILE").is_ok_and(|profile| profile == "release");
    let commit = given.or_else(|| is_release.then(from_git).flatten());
    println!("cargo:rustc-env=CZ_COMMIT={}", commit.as_deref().unwrap_or("unknown"));
}

/// The commit, with a `+` behind it when the sources differ from it; `None` without git, or outside a clone.
fn from_git() -> Option<String> {
    let commit = git(&["rev-parse", "--short=12", "HEAD"])?;
    let branch = git(&["symbolic-ref", "--quiet", "HEAD"]).unwrap_or_default();
    for name in ["HEAD", "packed-refs", &branch] {
        if let Some(path) = git(&["rev-parse", "--git-path", name]).filter(|path| Path::new(path).is_file()) {
            println!("cargo:rerun-if-changed={path}");
        }
    }
    let sources = ["Cargo.toml", "Cargo.lock", "bins", "ipc_schemas", "scenarios", "src"];
    sources.iter().for_each(|path| println!("cargo:rerun-if-changed={path}"));
    let changed = git(&[&["status", "--porcelain", "--"], &sources[..]].concat())?;
    Some(if changed.is_empty() { commit } else { commit + "+" })
}

fn git(arguments: &[&str]) -> Option<String> {
    let output = Command::new("git").args(arguments).output().ok()?;
    output.status.success().then(|| String::from_utf8_lossy(&output.stdout).trim().to_owned())
}
