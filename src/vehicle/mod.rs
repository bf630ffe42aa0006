//! One vehicle's motion, exactly, and what it means to be safe beside another.

pub mod driver;
mod held;
mod safety;

pub use held::Held;
pub use safety::{Inequality, Merge, Pair, RearEnd, satisfiable_at};
