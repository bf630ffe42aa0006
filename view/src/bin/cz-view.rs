//! The `cz-view` program, which `cz view` runs.

use std::process::ExitCode;

fn main() -> ExitCode {
    cz_view::view()
}
