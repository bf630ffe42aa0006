//! Controllers written elsewhere, driven end to end.

mod exits;
mod forged;
mod hostile;
mod sdks;
mod tools;

use std::ops::RangeInclusive;
use std::path::Path;
use std::process::Command;
use std::sync::OnceLock;
use std::time::Duration;
use tempfile::TempDir;

/// A Python with `control_zones`, numpy and quadprog, named by `CZ_PYTHON`; on CI it must be there.
fn python() -> Option<String> {
    let python = std::env::var("CZ_PYTHON").ok();
    assert!(python.is_some() || std::env::var_os("CI").is_none(), "CZ_PYTHON is not set");
    if python.is_none() {
        eprintln!("skipped: CZ_PYTHON is not set");
    }
    python
}

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Where cargo puts what it builds.
fn beside() -> &'static Path {
    Path::new(env!("CARGO_BIN_EXE_cz")).parent().unwrap()
}

fn cz() -> assert_cmd::Command {
    let mut command = assert_cmd::Command::new(env!("CARGO_BIN_EXE_cz"));
    command.current_dir(root()).timeout(Duration::from_secs(120));
    command
}

fn build(arguments: &[&str]) {
    let status = Command::new(env!("CARGO"))
        .current_dir(root())
        .args(["build", "-q", "--profile", "test"])
        .args(arguments)
        .status();
    assert!(status.unwrap().success(), "cargo build {arguments:?}");
}

/// A controller in Rust: an example of the package.
fn rust(name: &str) -> String {
    static BUILT: OnceLock<()> = OnceLock::new();
    BUILT.get_or_init(|| {
        build(&[
            "-p",
            "control-zones-plugin",
            "--example",
            "cruise",
            "--example",
            "pauses",
            "--example",
            "broken",
            "--example",
            "told",
        ]);
    });
    beside().join("examples").join(name).display().to_string()
}

/// The C package, installed somewhere.
fn installed() -> &'static Path {
    static INSTALLED: OnceLock<TempDir> = OnceLock::new();
    let prefix = INSTALLED.get_or_init(|| {
        build(&["-p", "control-zones-c"]);
        let prefix = tempfile::tempdir().unwrap();
        cz().args(["sdk", "install", "--prefix"]).arg(prefix.path()).assert().success();
        prefix
    });
    prefix.path()
}

/// Seeds of what is run many times by hand: `CZ_SEEDS=41-60`, 1 to 100 otherwise.
fn seeds() -> RangeInclusive<u64> {
    let Ok(seeds) = std::env::var("CZ_SEEDS") else { return 1..=100 };
    let (first, last) = seeds.split_once('-').expect("CZ_SEEDS is FIRST-LAST");
    first.parse().unwrap()..=last.parse().unwrap()
}

/// Compiles a controller in C or C++ as its author would: against what is installed, with the flags of the
/// package's `.pc` file.
fn compiled(source: &Path, into: &Path) -> String {
    let prefix = installed();
    let package = std::fs::read_to_string(prefix.join("lib/pkgconfig/control-zones.pc")).unwrap();
    let flags = |key: &str| {
        let line = package.lines().find_map(|line| line.strip_prefix(key)).unwrap();
        let line = line.replace("${prefix}", prefix.to_str().unwrap());
        line.split_whitespace().map(str::to_owned).collect::<Vec<_>>()
    };
    let is_c = source.extension().unwrap() == "c";
    let program = into.join(source.file_stem().unwrap());
    let output = Command::new(if is_c { "cc" } else { "c++" })
        .args([if is_c { "-std=c99" } else { "-std=c++17" }, "-Wall", "-Wextra", "-Werror"])
        .arg(source)
        .args(flags("Cflags:"))
        .args(flags("Libs:"))
        .args(["-lm", "-o"])
        .arg(&program)
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    program.display().to_string()
}
