//! `docs/records.md`: every record with its fields, and every code, for readers.

use super::{NOTICE, paragraphs};
use crate::code::{Code, CodeValue};
use crate::{CODES, LAYOUTS, Layout, schema_hash};

/// The document.
pub(super) fn render() -> String {
    let mut text = format!(
        "# Records and codes\n\n<!-- {NOTICE} -->\n\nWhat frames are made of ([plug-in contract](plugin-contract.md), \
         [protocol](protocol.md)). Records are little-endian, without padding; offsets and sizes are in bytes. \
         Schema hash {:016x}.\n",
        schema_hash()
    );
    LAYOUTS.iter().for_each(|layout| record(&mut text, layout));
    text.push_str("\n## Codes\n\nC puts `CZ_` in front.\n\n| code | value | |\n|---|---|---|\n");
    CODES.iter().flat_map(|codes| codes.iter()).for_each(|code| row_of(&mut text, code));
    text
}

fn record(text: &mut String, layout: &Layout) {
    let about = paragraphs(layout.docs, |_| None).join("\n\n");
    text.push_str(&format!(
        "\n## {}\n\n{about}\n\nType `{}`, {} bytes.\n\n| field | type | offset | |\n|---|---|---|---|\n",
        layout.name, layout.type_name, layout.size
    ));
    for field in layout.fields {
        let (name, scalar, at) = (field.name, field.scalar.name(), field.offset);
        text.push_str(&format!("| `{name}` | {scalar} | {at} | {} |\n", cell(field.docs)));
    }
}

fn row_of(text: &mut String, code: &Code) {
    let value = match code.value {
        CodeValue::U16(value) => value.to_string(),
        CodeValue::U32(value) => value.to_string(),
        CodeValue::U64(value) => value.to_string(),
        CodeValue::Text(name) => format!("`{name}`"),
    };
    text.push_str(&format!("| `{}` | {value} | {} |\n", code.name, cell(code.docs)));
}

/// Documentation as one cell of a table.
fn cell(docs: &[&str]) -> String {
    paragraphs(docs, |_| None).join(" ").replace('|', "\\|")
}
