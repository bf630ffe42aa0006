//! The Python module: ctypes structures, as the iceoryx2 wheel takes them.

use std::fmt::Write as _;

use super::{NOTICE, paragraphs, wrap};
use crate::{CODES, CodeValue, LAYOUTS, Layout, Scalar, schema_hash};

/// Checked at import with `raise`, which unlike `assert` survives `python -O`.
const LAYOUT_CHECK: &str = r#"

def _check_layouts() -> None:
    """Refuses to be imported where ctypes lays the records out differently."""
    if sys.byteorder != "little":
        raise ImportError("frames are little-endian and are used in place")
    for record, (size, align, offsets) in _LAYOUTS.items():
        found = {field[0]: getattr(record, field[0]).offset for field in record._fields_}
        if (ctypes.sizeof(record), ctypes.alignment(record), found) != (size, align, offsets):
            raise ImportError(f"{record.__name__} is not laid out as its frames are")


_check_layouts()
"#;

/// Takes the place of the wheel's `payload()`, which in 0.10.0 makes a slice of as many elements as
/// there are bytes (eclipse-iceoryx/iceoryx2#1533): its `len()` and its bounds check cannot be trusted.
const RECORDS_OF: &str = r#"

def records(sample: typing.Any, record: type[Record]) -> ctypes.Array[Record]:
    """The records of an iceoryx2 sample, in place, as a ctypes array of `record`.

    Use it instead of `sample.payload()`: the slice that iceoryx2 0.10.0 returns takes the number of
    bytes for the number of elements, so that a loop over it leaves the frame. The array and its
    elements keep the sample alive; drop them to give the sample back.
    """
    array: typing.Any = (record * sample.header.number_of_elements).from_address(sample.payload_ptr)
    array.sample = sample
    found: ctypes.Array[Record] = array
    return found
"#;

/// The whole module.
pub(super) fn render() -> String {
    let mut out = format!(
        "# {NOTICE}\n\
         \"\"\"The frames that cross a Control Zones process boundary.\n\
         \n\
         A frame is a `FrameHeader`, which travels as the transport's user header, and a slice of one kind\n\
         of record. Every record has the static method `type_name()` that the iceoryx2 wheel asks for, so\n\
         `.publish_subscribe(iceoryx2.Slice[VehicleState]).user_header(FrameHeader)` opens the same service\n\
         as the Rust processes do. `records(sample, VehicleState)` is the slice of a sample.\n\
         \"\"\"\n\
         \n\
         from __future__ import annotations\n\
         \n\
         import ctypes\n\
         import sys\n\
         import typing\n\
         \n\
         if typing.TYPE_CHECKING:\n    \
             Record = typing.TypeVar(\"Record\", bound=ctypes._CData)\n\
         \n\
         #: Hash of all record layouts: what the fields named `schema_hash` carry.\n\
         SCHEMA_HASH = 0x{:016x}\n",
        schema_hash()
    );

    for table in CODES {
        out.push('\n');
        for code in table {
            let _ = writeln!(out, "#: {}", wrap(&paragraphs(code.docs, |_| None), "#: ", 3));
            let value = match code.value {
                CodeValue::U16(value) => value.to_string(),
                CodeValue::U32(value) => value.to_string(),
                CodeValue::U64(value) => value.to_string(),
                CodeValue::Text(text) => format!("{text:?}"),
            };
            let _ = writeln!(out, "{} = {value}", code.name);
        }
    }

    for layout in LAYOUTS {
        record(&mut out, &layout);
    }

    out.push_str(
        "\n\n#: All record types, in the order the schema hash covers them.\n\
         RECORDS: tuple[type[ctypes.Structure], ...] = (\n",
    );
    for layout in LAYOUTS {
        let _ = writeln!(out, "    {},", layout.name);
    }
    out.push_str(")\n\n#: Name under which the transport registers each record type.\nTYPE_NAMES = {\n");
    for layout in LAYOUTS {
        let _ = writeln!(out, "    \"{}\": \"{}\",", layout.name, layout.type_name);
    }
    out.push_str(
        "}\n\n# Size, alignment and field offsets of each record, as Rust has them.\n_LAYOUTS: dict[type[ctypes.Structure], tuple[int, int, dict[str, int]]] = {\n",
    );
    for layout in LAYOUTS {
        let _ = writeln!(
            out,
            "    {}: (\n        {},\n        {},\n        {{",
            layout.name, layout.size, layout.align
        );
        for field in layout.fields {
            let _ = writeln!(out, "            \"{}\": {},", field.name, field.offset);
        }
        out.push_str("        },\n    ),\n");
    }
    out.push_str("}\n");
    out.push_str(LAYOUT_CHECK);
    out.push_str(RECORDS_OF);
    out
}

/// One class.
fn record(out: &mut String, layout: &Layout) {
    let _ = writeln!(out, "\n\nclass {}(ctypes.Structure):", layout.name);
    let docs = wrap(&paragraphs(layout.docs, |_| None), "    ", 7);
    let _ = writeln!(out, "    \"\"\"{docs}\n\n    Fields:");
    for field in layout.fields {
        let start = format!("        {}: ", field.name);
        let docs = wrap(&paragraphs(field.docs, |_| None), "            ", start.len());
        let _ = writeln!(out, "{start}{docs}");
    }
    out.push_str("    \"\"\"\n\n    _fields_ = [\n");
    for field in layout.fields {
        let scalar = match field.scalar {
            Scalar::F64 => "c_double",
            Scalar::U64 => "c_uint64",
            Scalar::U32 => "c_uint32",
            Scalar::U16 => "c_uint16",
        };
        let _ = writeln!(out, "        (\"{}\", ctypes.{scalar}),", field.name);
    }
    out.push_str("    ]\n\n");
    for field in layout.fields {
        let kind = if field.scalar == Scalar::F64 { "float" } else { "int" };
        let _ = writeln!(out, "    {}: {kind}", field.name);
    }
    let _ = writeln!(
        out,
        "\n    @staticmethod\n    def type_name() -> str:\n        \
         \"\"\"Name under which the transport registers the type.\"\"\"\n        return \"{}\"",
        layout.type_name
    );
}
