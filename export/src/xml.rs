//! What SUMO's XML files have in common.

use crate::out::{Out, OutError};
use quick_xml::Writer;
use quick_xml::events::{BytesDecl, BytesEnd, BytesStart, Event};
use std::io;
use std::path::Path;

/// A document being written.
pub(crate) struct Document {
    writer: Writer<Out>,
    root: &'static str,
}

impl Document {
    /// Begins a document with SUMO's schema of that name.
    pub fn begin(path: &Path, root: &'static str, schema: &str) -> Result<Document, OutError> {
        let mut document = Document { writer: Writer::new_with_indent(Out::create(path)?, b' ', 4), root };
        document.event(Event::Decl(BytesDecl::new("1.0", Some("UTF-8"), None)))?;
        let location = format!("http://sumo.dlr.de/xsd/{schema}");
        document.start(
            root,
            &[
                ("xmlns:xsi", "http://www.w3.org/2001/XMLSchema-instance"),
                ("xsi:noNamespaceSchemaLocation", &location),
            ],
        )?;
        Ok(document)
    }

    fn event(&mut self, event: Event<'_>) -> Result<(), OutError> {
        let fault = self.writer.get_ref().fault();
        self.writer.write_event(event).map_err(|error| fault(io::Error::other(error)))
    }

    /// An element with others inside.
    pub fn start(&mut self, name: &str, attributes: &[(&str, &str)]) -> Result<(), OutError> {
        self.event(Event::Start(BytesStart::new(name).with_attributes(attributes.iter().copied())))
    }

    /// Its end.
    pub fn end(&mut self, name: &str) -> Result<(), OutError> {
        self.event(Event::End(BytesEnd::new(name)))
    }

    /// An element with nothing inside.
    pub fn empty(&mut self, name: &str, attributes: &[(&str, &str)]) -> Result<(), OutError> {
        self.event(Event::Empty(BytesStart::new(name).with_attributes(attributes.iter().copied())))
    }

    /// Ends the document.
    pub fn finish(mut self) -> Result<(), OutError> {
        self.end(self.root)?;
        let mut out = self.writer.into_inner();
        let fault = out.fault();
        io::Write::write_all(&mut out, b"\n").map_err(fault)?;
        out.finish()
    }
}

/// An instant in seconds, exactly, with two decimals at least.
pub(crate) fn seconds(time_ns: u64) -> String {
    let mut text = format!("{}.{:09}", time_ns / 1_000_000_000, time_ns % 1_000_000_000);
    let kept = text.trim_end_matches('0').len().max(text.len() - 7);
    text.truncate(kept);
    text
}

/// A number with six decimals at most.
pub(crate) fn number(value: f64) -> String {
    let text = format!("{value:.6}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    if text == "-0" { "0".to_owned() } else { text.to_owned() }
}

#[cfg(test)]
mod tests {
    use super::{number, seconds};

    #[test]
    fn numbers_are_short_and_instants_exact() {
        assert_eq!(seconds(0), "0.00");
        assert_eq!(seconds(12_300_000_000), "12.30");
        assert_eq!(seconds(12_345_000_000), "12.345");
        assert_eq!(seconds(1), "0.000000001");
        assert_eq!((number(-0.0000001), number(1.5), number(20.0)), ("0".into(), "1.5".into(), "20".into()));
    }
}
