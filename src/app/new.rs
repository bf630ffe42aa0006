//! `cz plugin new`: a project of a controller that builds and keeps the contract.

use super::args::{Language, PluginNewArgs};
use super::{AppError, print};
use std::path::{Path, PathBuf};

const MAKEFILE: &str = include_str!("new/Makefile.in");

pub(super) fn new(args: &PluginNewArgs) -> Result<(), AppError> {
    let bad = |problem: String| AppError::Usage(format!("{}: {problem}", args.directory.display()));
    let name = args.directory.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    let is_letter = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
    if !name.starts_with(|c: char| c.is_ascii_alphabetic()) || !name.chars().all(is_letter) {
        let expected = "a directory whose name is letters, digits, _ and -, a letter first";
        return Err(bad(format!("expected {expected}")));
    }
    // What somebody has written is not written over.
    let is_empty = std::fs::read_dir(&args.directory).map_or(true, |mut entries| entries.next().is_none());
    if !is_empty || args.directory.is_file() {
        return Err(bad("is there and not empty; expected a directory that is to be made".to_owned()));
    }
    let failed = |path: &Path, e: std::io::Error| AppError::Failed(format!("{}: {e}", path.display()));
    let mut made = String::new();
    for (file, contents) in files(args, name)? {
        let path = args.directory.join(file);
        if let Some(folder) = path.parent() {
            std::fs::create_dir_all(folder).map_err(|e| failed(folder, e))?;
        }
        std::fs::write(&path, contents.replace("@NAME@", name)).map_err(|e| failed(&path, e))?;
        made.push_str(&format!("{}\n", path.display()));
    }
    print(&format!("{made}next:\n{}", commands(args.language, name, &args.directory.display().to_string())))
}

/// Names and contents of the files of a project.
fn files(args: &PluginNewArgs, name: &str) -> Result<Vec<(&'static str, String)>, AppError> {
    let makefile = |compiler: &str, default: &str, flags: &str, suffix: &str| {
        let text = MAKEFILE.replace("@COMPILER@", compiler).replace("@DEFAULT@", default);
        ("Makefile", text.replace("@FLAGS@", flags).replace("@SUFFIX@", suffix))
    };
    let mut files = match args.language {
        Language::Python => vec![("controller.py", include_str!("new/controller.py").to_owned())],
        Language::C => vec![
            ("controller.c", include_str!("../../examples/c/headway.c").to_owned()),
            makefile("CC", "cc", "CFLAGS", "c"),
        ],
        Language::Cpp => vec![
            ("controller.cpp", include_str!("new/controller.cpp").to_owned()),
            makefile("CXX", "c++", "CXXFLAGS", "cpp"),
        ],
        Language::Rust => {
            let dependency = match &args.sdk {
                Some(path) => Some(package(path).ok_or_else(|| {
                    let expected = "a clone of Control Zones, or its sdk/rust";
                    AppError::Usage(format!("--sdk {}: expected {expected}", path.display()))
                })?),
                None => clone_of_this_program(),
            };
            let dependency = match dependency {
                Some(path) => format!("path = {}", toml::Value::String(path.display().to_string())),
                None => format!("version = \"{}\"", env!("CARGO_PKG_VERSION")),
            };
            vec![
                ("src/main.rs", include_str!("new/controller.rs").to_owned()),
                ("Cargo.toml", include_str!("new/Cargo.toml.in").replace("@DEPENDENCY@", &dependency)),
            ]
        }
    };
    let told = commands(args.language, name, ".");
    let told: Vec<String> = told.lines().skip(1).map(|line| format!("    {}", line.trim_start())).collect();
    files.push(("README.md", include_str!("new/README.md.in").replace("@COMMANDS@", &told.join("\n"))));
    Ok(files)
}

/// The package for Rust in a clone, or the package itself.
fn package(path: &Path) -> Option<PathBuf> {
    let found = [path.join("sdk/rust"), path.to_owned()].into_iter().find(|p| is_package(p))?;
    std::path::absolute(found).ok()
}

fn is_package(path: &Path) -> bool {
    let text = std::fs::read_to_string(path.join("Cargo.toml")).unwrap_or_default();
    text.contains("name = \"control-zones-plugin\"")
}

/// The package in the clone that this program was built in, if it lies there.
fn clone_of_this_program() -> Option<PathBuf> {
    let program = std::env::current_exe().ok()?;
    program.ancestors().map(|above| above.join("sdk/rust")).find(|path| is_package(path))
}

/// What to type next.
fn commands(language: Language, name: &str, directory: &str) -> String {
    let (build, command) = match language {
        Language::Python => ("pip install control-zones numpy", "python3 controller.py".to_owned()),
        Language::C | Language::Cpp => ("make", "./controller".to_owned()),
        Language::Rust => ("cargo build --release", format!("target/release/{name}")),
    };
    format!(
        "  cd {directory}\n  {build}\n  cz plugin check -- {command}\n  \
         cz run --controller merge-2=\"{command}\" --shield on\n"
    )
}
