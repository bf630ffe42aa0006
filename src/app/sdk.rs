//! `cz sdk install`: the C ABI under a prefix, for pkg-config and CMake.

use super::args::SdkCommand;
use super::{AppError, print};
use std::path::Path;

/// Installed path and contents. Headers and build files are part of the program.
const FILES: [(&str, &str); 4] = [
    ("include/control_zones/cz_schemas.h", include_str!("../../ipc_schemas/include/cz_schemas.h")),
    ("include/control_zones/plugin.h", include_str!("../../sdk/c/include/control_zones/plugin.h")),
    ("include/control_zones/plugin.hpp", include_str!("../../sdk/c/include/control_zones/plugin.hpp")),
    (
        "lib/cmake/control-zones/control-zones-config.cmake",
        include_str!("../../sdk/c/cmake/control-zones-config.cmake"),
    ),
];

/// The libraries, which are built next to this program.
const LIBRARIES: [&str; 2] = ["libcontrol_zones_c.so", "libcontrol_zones_c.a"];

pub(super) fn sdk(command: &SdkCommand) -> Result<(), AppError> {
    let SdkCommand::Install { prefix } = command;
    let failed = |path: &Path, e: std::io::Error| AppError::Failed(format!("{}: {e}", path.display()));
    let prefix = std::path::absolute(prefix).map_err(|e| failed(prefix, e))?;
    let program = std::env::current_exe().map_err(|e| failed(Path::new("cz"), e))?;
    let beside = program.parent().unwrap_or(Path::new("."));
    let mut installed = Vec::new();
    let write = |name: &str, contents: &[u8]| {
        let path = prefix.join(name);
        if let Some(folder) = path.parent() {
            std::fs::create_dir_all(folder).map_err(|e| failed(folder, e))?;
        }
        // Beside it, and then in its place: whoever runs with the old library keeps it.
        let new = path.with_extension(format!("new-{}", std::process::id()));
        std::fs::write(&new, contents).map_err(|e| failed(&new, e))?;
        std::fs::rename(&new, &path).map_err(|e| failed(&path, e))
    };
    for library in LIBRARIES {
        let from = beside.join(library);
        let contents = std::fs::read(&from).map_err(|e| {
            let build = "build it with `cargo build --release -p control-zones-c`";
            AppError::Failed(format!("{}: {e}; {build}", from.display()))
        })?;
        write(&format!("lib/{library}"), &contents)?;
        installed.push(format!("lib/{library}"));
    }
    for (name, contents) in FILES {
        write(name, contents.as_bytes())?;
        installed.push(name.to_owned());
    }
    let pc = format!(
        "prefix={}\n\nName: control-zones\nDescription: Controllers for Control Zones\nVersion: {}\n\
         Cflags: -I${{prefix}}/include\n\
         Libs: -L${{prefix}}/lib -Wl,-rpath,${{prefix}}/lib -lcontrol_zones_c\n\
         Libs.private: -lpthread -ldl -lm\n",
        prefix.display(),
        env!("CARGO_PKG_VERSION")
    );
    write("lib/pkgconfig/control-zones.pc", pc.as_bytes())?;
    installed.push("lib/pkgconfig/control-zones.pc".to_owned());
    print(&installed.iter().map(|name| format!("{}\n", prefix.join(name).display())).collect::<String>())
}
