//! Who owes what to whom: from a zone's geometry and its passing order to every vehicle's duties.
//!
//! The one place where this is decided. The coordinator sends what comes out as assignments; the world's shield
//! and metrics derive the same from the order those carry.

mod duties;
mod geometry;
mod yielding;

pub use duties::{Duties, Duty, DutyKind, Row};
pub use geometry::{Conflicts, Point, PointKind, Run, Use};
pub use yielding::{can_yield, clear_m, has_gone_first, is_in_the_way, line_before_m, stands_on};
