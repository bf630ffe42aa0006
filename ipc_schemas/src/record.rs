//! How a record is declared once and described everywhere.
//!
//! [`record!`](macro@crate::record) turns one Rust struct into the layout every other language is held to:
//! the struct itself (`#[repr(C)]`), its [`Layout`] for the generators and the schema hash, and a
//! compile-time proof that it has no padding.

use zerocopy::IntoBytes;

/// The scalar types a record field may have. All are little-endian on the wire.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scalar {
    /// IEEE 754 double precision.
    F64,
    /// Unsigned, 64 bits.
    U64,
    /// Unsigned, 32 bits.
    U32,
    /// Unsigned, 16 bits.
    U16,
}

impl Scalar {
    /// The scalar's name in the canonical schema text, which is also its Rust name.
    pub const fn name(self) -> &'static str {
        match self {
            Scalar::F64 => "f64",
            Scalar::U64 => "u64",
            Scalar::U32 => "u32",
            Scalar::U16 => "u16",
        }
    }

    /// Size and alignment in bytes.
    pub const fn size(self) -> usize {
        match self {
            Scalar::F64 | Scalar::U64 => 8,
            Scalar::U32 => 4,
            Scalar::U16 => 2,
        }
    }
}

/// Maps a Rust field type to its [`Scalar`].
pub trait ScalarType: Copy {
    /// The scalar that stands for this type.
    const SCALAR: Scalar;
}

impl ScalarType for f64 {
    const SCALAR: Scalar = Scalar::F64;
}
impl ScalarType for u64 {
    const SCALAR: Scalar = Scalar::U64;
}
impl ScalarType for u32 {
    const SCALAR: Scalar = Scalar::U32;
}
impl ScalarType for u16 {
    const SCALAR: Scalar = Scalar::U16;
}

/// One field of a record.
#[derive(Clone, Copy, Debug)]
pub struct Field {
    /// Field name, unit suffix included.
    pub name: &'static str,
    /// Scalar type.
    pub scalar: Scalar,
    /// Offset from the start of the record, bytes.
    pub offset: usize,
    /// First lines of the field's documentation.
    pub docs: &'static [&'static str],
}

/// The full description of a record type.
#[derive(Clone, Copy, Debug)]
pub struct Layout {
    /// Rust (and C and Python) name.
    pub name: &'static str,
    /// Name under which the transport registers the type, version included.
    pub type_name: &'static str,
    /// Size in bytes.
    pub size: usize,
    /// Alignment in bytes.
    pub align: usize,
    /// Fields in memory order.
    pub fields: &'static [Field],
    /// The record's documentation.
    pub docs: &'static [&'static str],
}

/// A fixed-layout record that may cross a process boundary.
///
/// Every bit pattern is a valid value (plain scalars only), which is what lets a receiver look at a
/// frame before having validated it.
pub trait Record:
    Copy
    + Default
    + core::fmt::Debug
    + Send
    + iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend
    + zerocopy::FromBytes
    + IntoBytes
    + zerocopy::Immutable
    + 'static
{
    /// The record's layout.
    const LAYOUT: Layout;
}

/// Declares a record: struct, layout, transport type name, and the proof that it has no padding.
#[macro_export]
macro_rules! record {
    (
        $(#[doc = $doc:literal])*
        #[type_name($type_name:literal)]
        pub struct $name:ident {
            $(
                $(#[doc = $fdoc:literal])*
                pub $field:ident : $ty:ty,
            )*
        }
    ) => {
        $(#[doc = $doc])*
        #[repr(C)]
        #[derive(
            Clone, Copy, Debug, Default, PartialEq,
            iceoryx2_bb_derive_macros::ZeroCopySend,
            zerocopy::FromBytes, zerocopy::IntoBytes, zerocopy::Immutable,
            serde::Serialize, serde::Deserialize,
        )]
        #[type_name($type_name)]
        pub struct $name {
            $(
                $(#[doc = $fdoc])*
                pub $field: $ty,
            )*
        }

        impl $crate::record::Record for $name {
            const LAYOUT: $crate::record::Layout = $crate::record::Layout {
                name: stringify!($name),
                type_name: $type_name,
                size: core::mem::size_of::<$name>(),
                align: core::mem::align_of::<$name>(),
                fields: &[
                    $($crate::record::Field {
                        name: stringify!($field),
                        scalar: <$ty as $crate::record::ScalarType>::SCALAR,
                        offset: core::mem::offset_of!($name, $field),
                        docs: &[$($fdoc),*],
                    },)*
                ],
                docs: &[$($doc),*],
            };
        }

        const _: () = {
            let fields = <$name as $crate::record::Record>::LAYOUT.fields;
            let mut end = 0;
            let mut i = 0;
            while i < fields.len() {
                assert!(fields[i].offset == end, "records have no padding between fields");
                end += fields[i].scalar.size();
                i += 1;
            }
            assert!(end == core::mem::size_of::<$name>(), "records have no padding at the end");
        };
    };
}

/// The memory of records as bytes, for hashing and storage.
pub fn bytes_of<R: Record>(records: &[R]) -> &[u8] {
    records.as_bytes()
}

/// The records of such bytes, which may lie anywhere in memory; `None` when their number is not that of
/// whole records. Every bit pattern is a record, so nothing more is checked.
pub fn records_from<R: Record>(bytes: &[u8]) -> Option<Vec<R>> {
    if !bytes.len().is_multiple_of(size_of::<R>()) {
        return None;
    }
    let mut records = vec![R::default(); bytes.len() / size_of::<R>()];
    records.as_mut_bytes().copy_from_slice(bytes);
    Some(records)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::VehicleState;

    #[test]
    fn records_survive_as_bytes_wherever_these_lie() {
        let records = [VehicleState { x_m: 1.5, vehicle: 7, ..VehicleState::default() }; 3];
        for shift in 0..8 {
            let mut bytes = vec![0xaa; shift];
            bytes.extend_from_slice(bytes_of(&records));
            assert_eq!(records_from::<VehicleState>(&bytes[shift..]).as_deref(), Some(&records[..]));
            assert_eq!(records_from::<VehicleState>(&bytes[shift..bytes.len() - 1]), None);
        }
        assert_eq!(records_from::<VehicleState>(&[]).as_deref(), Some(&[][..]));
    }
}
