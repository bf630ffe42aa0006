//! The `cz-top` program, which `cz top` runs.

use std::process::ExitCode;

fn main() -> ExitCode {
    cz_view::top()
}
