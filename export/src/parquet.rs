//! Tables as Parquet files, with units and meanings in the schema.

use crate::out::{Out, OutError};
use crate::tables::{Sink, Table, Type, Value};
use ::parquet::arrow::ArrowWriter;
use ::parquet::basic::Compression;
use ::parquet::file::properties::WriterProperties;
use arrow_array::builder::{BooleanBuilder, Float64Builder, StringBuilder, UInt64Builder};
use arrow_array::{ArrayRef, RecordBatch};
use arrow_schema::{DataType, Field, Schema};
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Rows that are put together before they are written.
const BATCH: usize = 16_384;

/// A table as a Parquet file.
pub struct ParquetFile {
    writer: ArrowWriter<Out>,
    schema: Arc<Schema>,
    columns: Vec<Builder>,
    rows: usize,
    path: PathBuf,
}

enum Builder {
    Number(Float64Builder),
    Count(UInt64Builder),
    Text(StringBuilder),
    Truth(BooleanBuilder),
}

impl ParquetFile {
    /// Begins a file.
    pub fn begin(path: &Path, table: &Table) -> Result<ParquetFile, OutError> {
        let fields = table.columns.iter().map(|column| {
            let kind = match column.kind {
                Type::Number => DataType::Float64,
                Type::Count => DataType::UInt64,
                Type::Text => DataType::Utf8,
                Type::Truth => DataType::Boolean,
            };
            let mut metadata = HashMap::from([("description".to_owned(), column.meaning.clone())]);
            if let Some(unit) = column.unit {
                metadata.insert("unit".to_owned(), unit.to_owned());
            }
            Field::new(&column.name, kind, true).with_metadata(metadata)
        });
        let schema = Arc::new(Schema::new(fields.collect::<Vec<_>>()));
        let columns = table.columns.iter().map(|column| match column.kind {
            Type::Number => Builder::Number(Float64Builder::new()),
            Type::Count => Builder::Count(UInt64Builder::new()),
            Type::Text => Builder::Text(StringBuilder::new()),
            Type::Truth => Builder::Truth(BooleanBuilder::new()),
        });
        let properties = WriterProperties::builder().set_compression(Compression::SNAPPY).build();
        let out = Out::create(path)?;
        let writer = ArrowWriter::try_new(out, schema.clone(), Some(properties));
        let path = path.to_owned();
        let writer =
            writer.map_err(|error| OutError::Format { path: path.clone(), what: error.to_string() })?;
        Ok(ParquetFile { writer, schema, columns: columns.collect(), rows: 0, path })
    }

    fn fault(&self, error: impl ToString) -> OutError {
        OutError::Format { path: self.path.clone(), what: error.to_string() }
    }

    fn write_batch(&mut self) -> Result<(), OutError> {
        let arrays = self.columns.iter_mut().map(|column| -> ArrayRef {
            match column {
                Builder::Number(values) => Arc::new(values.finish()),
                Builder::Count(values) => Arc::new(values.finish()),
                Builder::Text(values) => Arc::new(values.finish()),
                Builder::Truth(values) => Arc::new(values.finish()),
            }
        });
        let batch = RecordBatch::try_new(self.schema.clone(), arrays.collect());
        let batch = batch.map_err(|error| self.fault(error))?;
        self.writer
            .write(&batch)
            .map_err(|error| OutError::Format { path: self.path.clone(), what: error.to_string() })?;
        self.rows = 0;
        Ok(())
    }
}

impl Sink for ParquetFile {
    fn row(&mut self, row: &[Value]) -> Result<(), OutError> {
        for (column, value) in self.columns.iter_mut().zip(row) {
            match (column, value) {
                (Builder::Number(values), Value::Number(value)) => values.append_value(*value),
                (Builder::Number(values), _) => values.append_null(),
                (Builder::Count(values), Value::Count(value)) => values.append_value(*value),
                (Builder::Count(values), _) => values.append_null(),
                (Builder::Text(values), Value::Text(value)) => values.append_value(value),
                (Builder::Text(values), _) => values.append_null(),
                (Builder::Truth(values), Value::Truth(value)) => values.append_value(*value),
                (Builder::Truth(values), _) => values.append_null(),
            }
        }
        self.rows += 1;
        if self.rows == BATCH { self.write_batch() } else { Ok(()) }
    }

    fn finish(mut self) -> Result<(), OutError> {
        self.write_batch()?;
        let path = self.path;
        let out = self.writer.into_inner();
        out.map_err(|error| OutError::Format { path, what: error.to_string() })?.finish()
    }
}
