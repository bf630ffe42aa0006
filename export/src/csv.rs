//! Tables as CSV files. A value that is missing is an empty field.

use crate::out::{Out, OutError};
use crate::tables::{Sink, Table, Value};
use std::io;
use std::path::Path;

/// A table as a CSV file.
#[derive(Debug)]
pub struct CsvFile {
    writer: ::csv::Writer<Out>,
}

impl CsvFile {
    /// Begins a file with the names of the columns.
    pub fn begin(path: &Path, table: &Table) -> Result<CsvFile, OutError> {
        let mut writer = ::csv::Writer::from_writer(Out::create(path)?);
        let names = table.columns.iter().map(|column| &column.name);
        let fault = writer.get_ref().fault();
        writer.write_record(names).map_err(|error| fault(error.into()))?;
        Ok(CsvFile { writer })
    }
}

impl Sink for CsvFile {
    fn row(&mut self, row: &[Value]) -> Result<(), OutError> {
        let fields = row.iter().map(|value| match value {
            Value::None => String::new(),
            // The shortest text that is this number again.
            Value::Number(value) => value.to_string(),
            Value::Count(value) => value.to_string(),
            Value::Text(value) => value.clone(),
            Value::Truth(value) => value.to_string(),
        });
        let fault = self.writer.get_ref().fault();
        self.writer.write_record(fields).map_err(|error| fault(error.into()))
    }

    fn finish(self) -> Result<(), OutError> {
        let fault = self.writer.get_ref().fault();
        let out = self.writer.into_inner().map_err(|error| fault(io::Error::other(error.to_string())))?;
        out.finish()
    }
}
