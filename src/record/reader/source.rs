//! Bytes at any place of a file that may end anywhere.

use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;
use zerocopy::{FromBytes, IntoBytes};

/// Bytes that can be read at any place.
pub trait Source {
    /// Their number.
    fn length(&self) -> u64;
    /// Fills the buffer from the bytes at `offset`, all of which are there.
    fn read_at(&self, offset: u64, buffer: &mut [u8]) -> io::Result<()>;
}

/// A file, as long as it was when it was opened.
///
/// Read, not mapped: a mapped file that somebody cuts short ends the reader with a signal.
#[derive(Debug)]
pub struct FileSource {
    pub(super) file: File,
    pub(super) length: u64,
}

impl Source for FileSource {
    fn length(&self) -> u64 {
        self.length
    }

    fn read_at(&self, offset: u64, buffer: &mut [u8]) -> io::Result<()> {
        self.file.read_exact_at(buffer, offset)
    }
}

impl Source for &[u8] {
    fn length(&self) -> u64 {
        self.len() as u64
    }

    fn read_at(&self, offset: u64, buffer: &mut [u8]) -> io::Result<()> {
        let from = usize::try_from(offset).ok().and_then(|offset| self.get(offset..));
        match from.and_then(|from| from.get(..buffer.len())) {
            Some(bytes) => buffer.copy_from_slice(bytes),
            None => return Err(io::ErrorKind::UnexpectedEof.into()),
        }
        Ok(())
    }
}

/// A value of fixed size; `None` when the file ends before it does.
pub(super) fn fixed<T: FromBytes + IntoBytes, S: Source>(source: &S, offset: u64) -> io::Result<Option<T>> {
    if source.length().saturating_sub(offset) < size_of::<T>() as u64 {
        return Ok(None);
    }
    let mut value = T::new_zeroed();
    source.read_at(offset, value.as_mut_bytes())?;
    Ok(Some(value))
}

/// So many bytes; `None` when the file ends before that.
pub(super) fn bytes<S: Source>(source: &S, offset: u64, length: u64) -> io::Result<Option<Vec<u8>>> {
    if source.length().saturating_sub(offset) < length {
        return Ok(None);
    }
    let mut bytes = vec![0; length as usize];
    source.read_at(offset, &mut bytes)?;
    Ok(Some(bytes))
}
