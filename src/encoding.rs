//! Values as bytes.
//!
//! The only module that uses bincode: 2.0.1 is its last release and it is unmaintained (RUSTSEC-2025-0141),
//! so whatever replaces it replaces it here.

use serde::Serialize;
use serde::de::DeserializeOwned;
use thiserror::Error;

/// No more bytes than this are decoded, nor allocated on the word of a length field.
pub const MAX_BYTES: usize = 64 << 20;

/// Why bytes are not an encoded value.
#[derive(Debug, Error)]
pub enum DecodeError {
    /// More bytes than any value of ours has.
    #[error("{0} bytes, expected at most {MAX_BYTES}")]
    TooLong(usize),
    /// The bytes are not an encoded value of this type.
    #[error("not an encoded value: {0}")]
    Malformed(#[from] bincode::error::DecodeError),
    /// Bytes are left over.
    #[error("{0} bytes after the end of the value")]
    Trailing(usize),
}

/// Appends the encoding of a value; equal values give equal bytes.
pub fn encode_onto(bytes: &mut Vec<u8>, value: &impl Serialize) {
    bincode::serde::encode_into_std_write(value, bytes, bincode::config::standard())
        .expect("our values are made of numbers, strings and lists, all of which can be encoded in memory");
}

/// The value of such bytes.
pub fn decode<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, DecodeError> {
    if bytes.len() > MAX_BYTES {
        return Err(DecodeError::TooLong(bytes.len()));
    }
    let config = bincode::config::standard().with_limit::<MAX_BYTES>();
    let (value, used) = bincode::serde::decode_from_slice(bytes, config)?;
    match bytes.len() - used {
        0 => Ok(value),
        left => Err(DecodeError::Trailing(left)),
    }
}
