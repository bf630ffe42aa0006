//! How a record is declared once and described everywhere.
//!
//! [`record!`](macro@crate::record) turns one Rust struct into the layout every other language is held to:
//! the struct itself (`#[repr(C)]`), its [`Layout`] for the generators and the schema hash, and a
//! compile-time proof that it has no padding.

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
    // SAFETY: `record!` proves at compile time that a record has no padding and consists of plain
    // scalars, so every byte is initialised; u8 has no alignment; the length is that of the slice.
    unsafe { core::slice::from_raw_parts(records.as_ptr().cast::<u8>(), size_of_val(records)) }
}
