//! How a constant is declared once and described everywhere.
//!
//! `codes!` is to constants what [`record!`](macro@crate::record) is to structs: it defines
//! them and the table from which the generators write their C and Python names.

/// The value of a [`Code`], with its Rust type.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CodeValue {
    /// Value of a 16-bit field.
    U16(u16),
    /// Value of a 32-bit field.
    U32(u32),
    /// Value of a 64-bit field.
    U64(u64),
    /// A name.
    Text(&'static str),
}

/// One public constant: a field's code, a flag, or a service name.
#[derive(Clone, Copy, Debug)]
pub struct Code {
    /// Rust (and Python) name; C puts `CZ_` in front.
    pub name: &'static str,
    /// Its value.
    pub value: CodeValue,
    /// The constant's documentation.
    pub docs: &'static [&'static str],
}

/// Turns a constant into its [`CodeValue`] by type. Inherent functions per type rather than a trait,
/// because trait functions cannot be called in a constant.
pub(crate) struct Typed<T>(pub(crate) T);

impl Typed<u16> {
    pub(crate) const fn value(self) -> CodeValue {
        CodeValue::U16(self.0)
    }
}
impl Typed<u32> {
    pub(crate) const fn value(self) -> CodeValue {
        CodeValue::U32(self.0)
    }
}
impl Typed<u64> {
    pub(crate) const fn value(self) -> CodeValue {
        CodeValue::U64(self.0)
    }
}
impl Typed<&'static str> {
    pub(crate) const fn value(self) -> CodeValue {
        CodeValue::Text(self.0)
    }
}

/// Declares the public constants of a module, and the module's table of them, `CODES`.
///
/// At most once per module; the crate's [`CODES`](crate::CODES) lists the tables.
macro_rules! codes {
    ($(
        $(#[doc = $doc:literal])*
        pub const $name:ident : $ty:ty = $value:expr;
    )*) => {
        $(
            $(#[doc = $doc])*
            pub const $name: $ty = $value;
        )*

        /// Every constant of this module, for the generators.
        pub(crate) const CODES: &[$crate::code::Code] = &[
            $($crate::code::Code {
                name: stringify!($name),
                value: $crate::code::Typed::<$ty>($name).value(),
                docs: &[$($doc),*],
            },)*
        ];
    };
}
pub(crate) use codes;
