//! One vehicle's controller: reference trajectory, barrier rows, QP, feasibility-enforcement mode.
//!
//! Everything here is a pure function of what the state and coordination frames carry.

pub mod clarabel;
pub mod law;
pub mod ocbf;
pub mod pool;
pub mod qp;
pub mod reference;
pub mod rows;
pub mod slot;
pub mod viable;

pub use law::{Decision, Law, Laws, Partner, Schedule, Situation, Verdict, Words};
pub use ocbf::{Memory, Mode, Ocbf};
pub use pool::ControllerPool;
pub use reference::{Optimum, Reference, Terminal};
pub use viable::Viable;
