//! Files that replace what was there only once they are whole.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

/// Why something cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum OutError {
    /// The file system refuses.
    #[error("cannot write {path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// What is to be written does not fit the format.
    #[error("{path}: {what}")]
    Format {
        /// The file.
        path: PathBuf,
        /// Why.
        what: String,
    },
}

/// A file under another name until [`Out::finish`]; dropped before that, it is gone.
#[derive(Debug)]
pub(crate) struct Out {
    file: Option<BufWriter<File>>,
    beside: PathBuf,
    path: PathBuf,
}

impl Out {
    pub fn create(path: &Path) -> Result<Out, OutError> {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let beside = path.with_file_name(format!(".{name}.{}", std::process::id()));
        let failed = |source| OutError::Io { path: path.to_owned(), source };
        if path.is_dir() {
            return Err(failed(io::ErrorKind::IsADirectory.into()));
        }
        let file = File::create(&beside).map_err(failed)?;
        Ok(Out { file: Some(BufWriter::new(file)), beside, path: path.to_owned() })
    }

    /// What went wrong with this file.
    pub fn fault(&self) -> impl Fn(io::Error) -> OutError + use<> {
        let path = self.path.clone();
        move |source| OutError::Io { path: path.clone(), source }
    }

    /// Gives the file its name.
    pub fn finish(mut self) -> Result<(), OutError> {
        let fault = self.fault();
        let file = self.file.take().expect("it is taken here only");
        file.into_inner().map_err(|e| fault(e.into_error()))?.sync_all().map_err(&fault)?;
        std::fs::rename(&self.beside, &self.path).map_err(&fault)
    }
}

impl Write for Out {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.file.as_mut().expect("it is open until it is finished").write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.as_mut().expect("it is open until it is finished").flush()
    }
}

impl io::Seek for Out {
    fn seek(&mut self, to: io::SeekFrom) -> io::Result<u64> {
        self.file.as_mut().expect("it is open until it is finished").seek(to)
    }
}

impl Drop for Out {
    fn drop(&mut self) {
        // Once it is finished it has another name.
        let _ = std::fs::remove_file(&self.beside);
    }
}
