//! Writes the C header, the Python module and docs/records.md, or with `--check` tells which of them is stale.

use std::path::Path;
use std::process::ExitCode;

use ipc_schemas::generate;

const USAGE: &str = "usage: cargo run -p ipc_schemas [-- --check]";

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let check = match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        [] => false,
        ["--check"] => true,
        _ => {
            eprintln!("{USAGE}");
            return ExitCode::from(2);
        }
    };

    let mut good = true;
    for file in generate::files() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(file.path);
        if check {
            if std::fs::read(&path).ok().as_deref() != Some(file.contents.as_bytes()) {
                eprintln!("ipc_schemas/{} is stale: run `cargo run -p ipc_schemas`", file.path);
                good = false;
            }
        } else if let Err(error) = write(&path, &file.contents) {
            eprintln!("ipc_schemas/{}: {error}", file.path);
            good = false;
        } else {
            println!("wrote ipc_schemas/{}", file.path);
        }
    }
    if good { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

fn write(path: &Path, contents: &str) -> std::io::Result<()> {
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder)?;
    }
    std::fs::write(path, contents)
}
