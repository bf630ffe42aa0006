//! The C header: C99 and later, C++17 and later.

use std::fmt::Write as _;

use super::{NOTICE, paragraphs, snake_case, wrap};
use crate::{CODES, Code, CodeValue, LAYOUTS, Layout, Scalar, schema_hash};

/// What precedes the constants. C99 has neither static assertions nor `_Alignof`, hence the arrays of
/// negative length and the offset behind a `char`.
const PREAMBLE: &str = r"#ifndef CZ_SCHEMAS_H
#define CZ_SCHEMAS_H

#include <stddef.h>
#include <stdint.h>

#if defined(__BYTE_ORDER__) && defined(__ORDER_LITTLE_ENDIAN__)
#if __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error frames are little-endian and are used in place
#endif
#endif

#if defined(__cplusplus)
#define CZ_ASSERT_(name, condition) static_assert(condition, #name)
#define CZ_ASSERT_ALIGN_(type, align) static_assert(alignof(type) == (align), #type)
#elif defined(__STDC_VERSION__) && __STDC_VERSION__ >= 201112L
#define CZ_ASSERT_(name, condition) _Static_assert(condition, #name)
#define CZ_ASSERT_ALIGN_(type, align) _Static_assert(_Alignof(type) == (align), #type)
#else
#define CZ_ASSERT_(name, condition) typedef char cz_assert_##name[(condition) ? 1 : -1]
#define CZ_ASSERT_ALIGN_(type, align) \
    struct cz_behind_char_##type { char first; type record; }; \
    CZ_ASSERT_(align_##type, offsetof(struct cz_behind_char_##type, record) == (align))
#endif
";

/// The whole header.
pub(super) fn render() -> String {
    let mut out = format!(
        "/* {NOTICE} */\n\
         /*\n \
         * The frames that cross a Control Zones process boundary.\n \
         *\n \
         * A frame is a cz_frame_header_t, which travels as the transport's user header, and a slice of\n \
         * one kind of record. Records are little-endian and have neither padding nor pointers.\n \
         */\n"
    );
    out.push_str(PREAMBLE);
    out.push_str("\n/* Hash of all record layouts: what the fields named schema_hash carry. */\n");
    let _ = writeln!(out, "#define CZ_SCHEMA_HASH UINT64_C(0x{:016x})", schema_hash());

    for table in CODES {
        out.push('\n');
        for code in table {
            constant(&mut out, code);
        }
    }

    out.push_str("\n/* Names under which the transport registers the record types. */\n");
    for layout in LAYOUTS {
        let name = snake_case(layout.name).to_ascii_uppercase();
        let _ = writeln!(out, "#define CZ_TYPE_NAME_{name} \"{}\"", layout.type_name);
    }

    for layout in LAYOUTS {
        record(&mut out, &layout);
    }
    out.push_str("\n#undef CZ_ASSERT_\n#undef CZ_ASSERT_ALIGN_\n\n#endif /* CZ_SCHEMAS_H */\n");
    out
}

/// One `#define` with its comment.
fn constant(out: &mut String, code: &Code) {
    comment(out, "", code.docs);
    let value = match code.value {
        CodeValue::U16(value) => format!("UINT16_C({value})"),
        CodeValue::U32(value) => format!("UINT32_C({value})"),
        CodeValue::U64(value) => format!("UINT64_C({value})"),
        CodeValue::Text(text) => format!("{text:?}"),
    };
    let _ = writeln!(out, "#define CZ_{} {value}", code.name);
}

/// One struct and the assertions about it.
fn record(out: &mut String, layout: &Layout) {
    let name = type_name(layout);
    out.push('\n');
    comment(out, "", layout.docs);
    let _ = writeln!(out, "typedef struct {} {{", name.trim_end_matches("_t"));
    for field in layout.fields {
        comment(out, "    ", field.docs);
        let scalar = match field.scalar {
            Scalar::F64 => "double",
            Scalar::U64 => "uint64_t",
            Scalar::U32 => "uint32_t",
            Scalar::U16 => "uint16_t",
        };
        let _ = writeln!(out, "    {scalar} {};", field.name);
    }
    let _ = writeln!(out, "}} {name};");

    let prefix = snake_case(layout.name);
    let _ = writeln!(out, "CZ_ASSERT_({prefix}_size, sizeof({name}) == {});", layout.size);
    let _ = writeln!(out, "CZ_ASSERT_ALIGN_({name}, {});", layout.align);
    for field in layout.fields {
        let _ = writeln!(
            out,
            "CZ_ASSERT_({prefix}_{field}_offset, offsetof({name}, {field}) == {offset});",
            field = field.name,
            offset = field.offset
        );
    }
}

/// `VehicleState` → `cz_vehicle_state_t`.
fn type_name(layout: &Layout) -> String {
    format!("cz_{}_t", snake_case(layout.name))
}

/// The documentation of an item as a comment in front of it.
fn comment(out: &mut String, indent: &str, docs: &[&str]) {
    let text: Vec<String> = paragraphs(docs, c_name).iter().map(|text| text.replace('→', "->")).collect();
    let open = format!("{indent}/** ");
    let _ = writeln!(out, "{open}{} */", wrap(&text, &format!("{indent} *  "), open.len()));
}

/// The C name of a record or constant.
fn c_name(word: &str) -> Option<String> {
    if let Some(layout) = LAYOUTS.iter().find(|layout| layout.name == word) {
        return Some(type_name(layout));
    }
    CODES.iter().copied().flatten().find(|code| code.name == word).map(|code| format!("CZ_{}", code.name))
}
