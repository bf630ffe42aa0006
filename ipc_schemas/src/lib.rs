//! Every frame that crosses a Control Zones process boundary.
//!
//! A frame is a [`FrameHeader`] followed by a slice of one kind of record. Records are `#[repr(C)]`,
//! little-endian, without padding or pointers, 8-byte fields first. This crate is the source: the C
//! header `include/cz_schemas.h` and the Python module `python/cz_schemas.py` are generated from it
//! (`cargo run -p ipc_schemas`) and a test fails when they are stale.

mod attach;
pub mod check;
pub mod code;
mod command;
mod coordination;
mod feedback;
pub mod generate;
mod header;
mod member;
pub mod record;
mod run_spec;
mod services;
mod state;
mod summary;

pub use attach::*;
pub use check::{ExpectedHeader, HeaderFault};
pub use code::{Code, CodeValue};
pub use command::*;
pub use coordination::*;
pub use feedback::*;
pub use header::*;
pub use member::*;
pub use record::{Field, Layout, Record, Scalar, bytes_of, records_from};
pub use run_spec::*;
pub use services::*;
pub use state::*;
pub use summary::*;

/// The C header, as it is generated.
pub const C_HEADER: &str = include_str!("../include/cz_schemas.h");

#[cfg(not(target_endian = "little"))]
compile_error!("frames are little-endian and are used in place");

/// The layouts of all record types, in the order the schema hash covers them.
pub const LAYOUTS: [Layout; 12] = [
    FrameHeader::LAYOUT,
    VehicleState::LAYOUT,
    Assignment::LAYOUT,
    ZoneSummary::LAYOUT,
    VehicleCommand::LAYOUT,
    Feedback::LAYOUT,
    Member::LAYOUT,
    AttachRequest::LAYOUT,
    AttachReply::LAYOUT,
    RunSpec::LAYOUT,
    PathSpec::LAYOUT,
    KindSpec::LAYOUT,
];

/// All public codes, flags and service names, one table per module that declares some.
///
/// Not part of the schema hash: a new code does not change a layout. Changing the meaning of an old one
/// is a new version of the record that carries it.
pub const CODES: [&[Code]; 9] = [
    header::CODES,
    state::CODES,
    coordination::CODES,
    summary::CODES,
    command::CODES,
    feedback::CODES,
    attach::CODES,
    run_spec::CODES,
    services::CODES,
];

/// The canonical text of the schema: one line per record and field.
pub fn schema_text() -> String {
    let mut text = String::new();
    for layout in LAYOUTS {
        text.push_str(&format!("{} {}\n", layout.type_name, layout.size));
        for field in layout.fields {
            text.push_str(&format!("  {} {} {}\n", field.offset, field.scalar.name(), field.name));
        }
    }
    text
}

/// The schema hash: XXH3-64 of [`schema_text`]. Compared at attach and in every header.
pub fn schema_hash() -> u64 {
    static HASH: std::sync::LazyLock<u64> =
        std::sync::LazyLock::new(|| xxhash_rust::xxh3::xxh3_64(schema_text().as_bytes()));
    *HASH
}
