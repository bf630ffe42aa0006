//! `cz export`: a recording in the formats of other tools.

use crate::csv::CsvFile;
use crate::fcd::Fcd;
use crate::out::OutError;
use crate::parquet::ParquetFile;
use crate::ssm::Ssm;
use crate::tables::{self, Sheets, Sink, Table, tables};
use crate::trips::Trips;
use crate::walk::{Ended, walk};
use crate::{mcap, perfetto, tripinfo};
use clap::{Parser, ValueEnum};
use control_zones::app::{AppError, open_recording, print};
use control_zones::record::{FileSource, Flaw, Reader};
use std::path::{Path, PathBuf};

/// Write a recording in the format of another tool.
#[derive(Debug, Parser)]
#[command(name = "cz export", version)]
pub struct ExportArgs {
    /// The recording.
    pub file: PathBuf,
    /// The format.
    #[arg(long, value_name = "FORMAT")]
    pub to: Format,
    /// The file to write, or the directory with csv and parquet, which have a file per table; beside the recording by
    /// default.
    #[arg(long, value_name = "PATH")]
    pub out: Option<PathBuf>,
}

/// A format.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Format {
    /// SUMO's floating car data: every vehicle at every step, XML.
    Fcd,
    /// SUMO's trip information: a line per vehicle, XML.
    Tripinfo,
    /// SUMO's surrogate safety measures: conflicts between vehicles, XML.
    Ssm,
    /// Tables as CSV files.
    Csv,
    /// Tables as Parquet files, with units in the schema.
    Parquet,
    /// A scene, a log and values to plot, for Foxglove and Lichtblick.
    Mcap,
    /// A trace in simulated time, for Perfetto.
    Perfetto,
}

impl Format {
    /// What is written beside `NAME.czlog`: `NAME` with this behind it.
    fn ending(self) -> &'static str {
        match self {
            Format::Fcd => ".fcd.xml",
            Format::Tripinfo => ".tripinfo.xml",
            Format::Ssm => ".ssm.xml",
            Format::Csv => ".csv",
            Format::Parquet => ".parquet",
            Format::Mcap => ".mcap",
            Format::Perfetto => ".perfetto-trace",
        }
    }
}

/// Runs `cz export`.
pub fn main(args: &ExportArgs) -> Result<(), AppError> {
    let reader = open_recording(&args.file)?;
    let out = args.out.clone().unwrap_or_else(|| {
        let stem = args.file.file_stem().unwrap_or_default().to_string_lossy();
        args.file.with_file_name(format!("{stem}{}", args.to.ending()))
    });
    let ended = write(&reader, args.to, &out).map_err(|error| AppError::Failed(error.to_string()))?;
    print(&format!("{}: {} steps\n", out.display(), ended.steps))?;
    judge(&args.file, &ended)
}

/// Says what a recording lacks; one that is damaged decides the exit code, as with `cz show`.
pub(crate) fn judge(path: &Path, ended: &Ended) -> Result<(), AppError> {
    let path = path.display();
    if let Some((step, why)) = &ended.lost {
        eprintln!("cz: {path}: visits and energies are known up to step {step} only: {why}");
    }
    match ended.damage.iter().find(|damage| damage.flaw != Flaw::CutOff) {
        Some(damage) => Err(AppError::Usage(format!("{path}: damaged at {damage}"))),
        None => Ok(()),
    }
}

/// Writes a recording.
pub fn write(reader: &Reader<FileSource>, format: Format, out: &Path) -> Result<Ended, OutError> {
    let scenario = reader.scenario();
    match format {
        Format::Fcd => {
            let mut file = Fcd::begin(out, scenario)?;
            let ended = walk(reader, |moment| file.step(moment))?;
            file.finish()?;
            Ok(ended)
        }
        Format::Tripinfo => {
            let mut trips = Trips::of(scenario);
            let ended = walk(reader, |moment| {
                trips.step(moment);
                Ok::<(), OutError>(())
            })?;
            tripinfo::write(out, scenario, &trips)?;
            Ok(ended)
        }
        Format::Ssm => {
            let mut file = Ssm::begin(out, scenario)?;
            let ended = walk(reader, |moment| file.step(moment))?;
            file.finish()?;
            Ok(ended)
        }
        Format::Csv => tables::write(reader, sheets(out, "csv", CsvFile::begin)?),
        Format::Parquet => tables::write(reader, sheets(out, "parquet", ParquetFile::begin)?),
        Format::Mcap => mcap::write(out, reader),
        Format::Perfetto => perfetto::write(out, reader),
    }
}

/// A file per table in a directory.
fn sheets<S: Sink>(
    directory: &Path,
    ending: &str,
    begin: impl Fn(&Path, &Table) -> Result<S, OutError>,
) -> Result<Sheets<S>, OutError> {
    let failed = |source| OutError::Io { path: directory.to_owned(), source };
    std::fs::create_dir_all(directory).map_err(failed)?;
    let files: Result<Vec<S>, OutError> = tables()
        .iter()
        .map(|table| begin(&directory.join(format!("{}.{ending}", table.name)), table))
        .collect();
    Ok(files?.try_into().unwrap_or_else(|_| unreachable!("there is a file per table")))
}
