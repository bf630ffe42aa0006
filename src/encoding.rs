//! Values as bytes, in two ways: for processes of one build, and to be kept.
//!
//! Between processes bincode, which is small and says nothing of itself; they have compared schemas before. In
//! files CBOR, which names each field, so that a reader of another build can tell what it does not know.
//!
//! The only module that uses bincode: 2.0.1 is its last release and it is unmaintained (RUSTSEC-2025-0141),
//! so whatever replaces it replaces it here.

use serde::Serialize;
use serde::de::DeserializeOwned;
use thiserror::Error;

/// No more bytes than this are decoded, nor allocated on the word of a length field. A network of grids that holds a
/// hundred thousand vehicles takes 114 million.
pub const MAX_BYTES: usize = 192 << 20;

/// No more bytes than this are read of a kept value: what processes can be handed, with names around it.
pub const MAX_KEPT_BYTES: usize = 480 << 20;

/// Why bytes are not an encoded value.
#[derive(Debug, Error)]
pub enum DecodeError {
    /// More bytes than any value of ours has.
    #[error("{found} bytes, expected at most {limit}")]
    TooLong {
        /// How many there are.
        found: usize,
        /// How many there may be.
        limit: usize,
    },
    /// The bytes are not an encoded value of this type.
    #[error("not an encoded value: {0}")]
    Malformed(#[from] bincode::error::DecodeError),
    /// The bytes are not a kept value, or one with other fields.
    #[error("{0}")]
    Kept(String),
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
        return Err(DecodeError::TooLong { found: bytes.len(), limit: MAX_BYTES });
    }
    let config = bincode::config::standard().with_limit::<MAX_BYTES>();
    let (value, used) = bincode::serde::decode_from_slice(bytes, config)?;
    match bytes.len() - used {
        0 => Ok(value),
        left => Err(DecodeError::Trailing(left)),
    }
}

/// Appends a value with the names of its fields; equal values give equal bytes.
pub fn keep_onto(bytes: &mut Vec<u8>, value: &impl Serialize) {
    ciborium::into_writer(value, bytes)
        .expect("our values are made of numbers, strings and lists, all of which can be written to memory");
}

/// The value of such bytes. Fields this program does not know are passed over; of one that is missing the
/// error gives the name.
pub fn kept<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, DecodeError> {
    use ciborium::de::Error;
    if bytes.len() > MAX_KEPT_BYTES {
        return Err(DecodeError::TooLong { found: bytes.len(), limit: MAX_KEPT_BYTES });
    }
    let mut rest = bytes;
    let value = ciborium::from_reader(&mut rest).map_err(|error| {
        DecodeError::Kept(match error {
            Error::Io(_) => "it ends too early".to_owned(),
            Error::Syntax(at) => format!("no value at byte {at}"),
            Error::Semantic(_, problem) => problem,
            Error::RecursionLimitExceeded => "values within values without end".to_owned(),
        })
    })?;
    match rest.len() {
        0 => Ok(value),
        left => Err(DecodeError::Trailing(left)),
    }
}

/// The first field of a kept value that another value has not: names from the outermost one on.
pub fn first_unknown_field(bytes: &[u8], known: &[u8]) -> Option<String> {
    use ciborium::Value;
    fn within(value: &Value, known: &Value, path: &str) -> Option<String> {
        match (value, known) {
            (Value::Map(fields), Value::Map(known)) => fields.iter().find_map(|(name, value)| {
                let path = format!("{path}{}{}", if path.is_empty() { "" } else { "." }, name.as_text()?);
                match known.iter().find(|(other, _)| other == name) {
                    Some((_, known)) => within(value, known, &path),
                    None => Some(path),
                }
            }),
            (Value::Array(values), Value::Array(known)) => {
                values.iter().zip(known).find_map(|(value, known)| within(value, known, path))
            }
            _ => None,
        }
    }
    within(&kept(bytes).ok()?, &kept(known).ok()?, "")
}
