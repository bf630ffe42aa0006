//! What no controller can do better than, and what one that knew everything could do.
//!
//! [`alone`] is rigorous: each vehicle as if it were alone. So is [`merging`], which has pairs and triples of
//! vehicles meet at a merge, in whatever order. [`joint`] is the centralised optimum for a given
//! passing order, all vehicles at once: a local optimum, as the problem is not convex.

pub mod alone;
pub mod joint;
pub mod merging;
pub mod traffic;

pub use traffic::{Bounds, Entrant, Traffic};
