//! Gives the library the name by which programs ask for it: another one whenever what they were built with no longer
//! fits, which before 1.0 is at every minor version.

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    let [major, minor] = ["CARGO_PKG_VERSION_MAJOR", "CARGO_PKG_VERSION_MINOR"].map(|key| {
        println!("cargo:rerun-if-env-changed={key}");
        std::env::var(key).unwrap_or_default()
    });
    let version = if major == "0" { format!("0.{minor}") } else { major };
    println!("cargo:rustc-cdylib-link-arg=-Wl,-soname,libcontrol_zones_c.so.{version}");
}
