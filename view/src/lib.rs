//! Runs and recordings of Control Zones for people: a page in the browser (`cz view`), a terminal (`cz top`).

mod cli;
pub mod detail;
pub mod index;
pub mod live;
pub mod network;
pub mod run;
pub mod server;
pub mod steps;
mod top;
pub mod wire;

pub use cli::view;
pub use top::top;
