//! `cz sdk install`: the C ABI under a prefix, for pkg-config and CMake.

use super::args::SdkCommand;
use super::{AppError, print};
use std::path::Path;

/// Installed path and contents. Headers and build files are part of the program.
const FILES: [(&str, &str); 6] = [
    ("include/control_zones/cz_schemas.h", ipc_schemas::C_HEADER),
    ("include/control_zones/plugin.h", include_str!("../../sdk/include/control_zones/plugin.h")),
    ("include/control_zones/plugin.hpp", include_str!("../../sdk/include/control_zones/plugin.hpp")),
    (
        "lib/cmake/control-zones/control-zones-config.cmake",
        include_str!("../../sdk/cmake/control-zones-config.cmake"),
    ),
    (
        "lib/cmake/control-zones/control-zones-config-version.cmake",
        include_str!("../../sdk/cmake/control-zones-config-version.cmake"),
    ),
    ("lib/pkgconfig/control-zones.pc", include_str!("../../sdk/control-zones.pc")),
];

/// The libraries, which are built next to this program, or come with it as a wheel has them: the shared one alone, in `lib`
/// beside the folder of the program. It has its version in its name where it is installed.
const SHARED: &str = "libcontrol_zones_c.so";
const STATIC: &str = "libcontrol_zones_c.a";

/// What of the version stands in the name by which programs ask for the library (sdk/c/build.rs).
fn interface() -> String {
    let [major, minor] = [env!("CARGO_PKG_VERSION_MAJOR"), env!("CARGO_PKG_VERSION_MINOR")];
    if major == "0" { format!("0.{minor}") } else { major.to_owned() }
}

pub(super) fn sdk(command: &SdkCommand) -> Result<(), AppError> {
    let SdkCommand::Install { prefix } = command;
    let failed = |path: &Path, e: std::io::Error| AppError::Failed(format!("{}: {e}", path.display()));
    let prefix = std::path::absolute(prefix).map_err(|e| failed(prefix, e))?;
    let program = std::env::current_exe().map_err(|e| failed(Path::new("cz"), e))?;
    let beside = program.parent().unwrap_or(Path::new("."));
    let mut installed: Vec<String> = Vec::new();
    // Beside it, and then in its place: whoever runs with the old one keeps it.
    let mut place = |name: &str, make: &dyn Fn(&Path) -> std::io::Result<()>| -> Result<(), AppError> {
        let path = prefix.join(name);
        if let Some(folder) = path.parent() {
            std::fs::create_dir_all(folder).map_err(|e| failed(folder, e))?;
        }
        let new = path.with_extension(format!("new-{}", std::process::id()));
        make(&new).map_err(|e| failed(&new, e))?;
        std::fs::rename(&new, &path).map_err(|e| failed(&path, e))?;
        installed.push(format!("{}\n", path.display()));
        Ok(())
    };
    let (version, interface) = (env!("CARGO_PKG_VERSION"), interface());
    let full = format!("{SHARED}.{version}");
    let shipped = beside.join("../lib");
    let is_shipped = !beside.join(SHARED).exists() && shipped.join(SHARED).exists();
    let (from, libraries) = match is_shipped {
        true => (shipped.as_path(), &[(SHARED, full.as_str())][..]),
        false => (beside, &[(SHARED, full.as_str()), (STATIC, STATIC)][..]),
    };
    for (library, name) in libraries {
        let from = from.join(library);
        let contents = std::fs::read(&from).map_err(|e| {
            let build = "build it with `cargo build --release -p control-zones-c`";
            AppError::Failed(format!("{}: {e}; {build}", from.display()))
        })?;
        place(&format!("lib/{name}"), &|path: &Path| std::fs::write(path, &contents))?;
    }
    for link in [format!("{SHARED}.{interface}"), SHARED.to_owned()] {
        place(&format!("lib/{link}"), &|path: &Path| std::os::unix::fs::symlink(&full, path))?;
    }
    for (name, contents) in FILES {
        let contents = contents.replace("@VERSION@", version).replace("@SONAME@", &interface);
        place(name, &|path: &Path| std::fs::write(path, &contents))?;
    }
    print(&installed.concat())
}
