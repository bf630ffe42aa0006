//! A controller for Control Zones: implement [`Controller`], call [`run`].
//!
//! ```no_run
#![doc = include_str!("../examples/cruise.rs")]
//! ```
//!
//! Started by `cz run --controller merge-2=PROGRAM`, or by hand with `CZ_RUN` and `CZ_CONTROLLER` set. The
//! contract behind it is `docs/plugin-contract.md`; [`Session`] is the same without a loop, for programs
//! that have one of their own.

mod attach;
mod inbox;
mod session;
mod space;
mod view;

pub use inbox::Refused;
pub use ipc_schemas as schemas;
pub use session::{Commands, Session, Wake};
pub use view::{Partner, PartnerKind, Path, Run, Step, Summary, Vehicle};

pub use ipc_schemas::Feedback;

use ipc_schemas::VehicleCommand;
use std::time::Duration;

/// Why a plug-in cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Neither the caller nor the environment says which run or controller.
    #[error("{0} is not set; start the program with `cz run --controller`, or set CZ_RUN and CZ_CONTROLLER")]
    NotConfigured(&'static str),
    /// Nobody answered.
    #[error("no world of run {run} answered within {seconds} s")]
    NoWorld {
        /// Run name.
        run: String,
        /// How long was waited.
        seconds: f64,
    },
    /// The world did not let the controller in.
    #[error("the world refused controller {controller}: {reason}")]
    Refused {
        /// Own name.
        controller: String,
        /// Why, as the world said it.
        reason: String,
    },
    /// The world is no longer there.
    #[error("the world (process {0}) has ended without an end of the run")]
    WorldGone(u32),
    /// The world is no longer there, and had refused this controller's answer.
    #[error(
        "the world (process {process_id}) has ended without an end of the run; it had refused an answer: {refusal}"
    )]
    AnswerRefused {
        /// The world's process.
        process_id: u32,
        /// What was wrong with the answer.
        refusal: Feedback,
    },
    /// The reply to the attach request cannot be read.
    #[error(
        "the world's reply has {0} bytes, which are not what it should say; build both from the same version"
    )]
    BadReply(usize),
    /// A call came at the wrong time, such as a send without a step to answer.
    #[error("{0}")]
    OutOfTurn(&'static str),
    /// iceoryx2 failed.
    #[error("{what}: {reason}")]
    Transport {
        /// What was attempted.
        what: String,
        /// What was said.
        reason: String,
    },
}

/// Which run to join, as which controller.
#[derive(Clone, Debug)]
pub struct Options {
    /// Run name.
    pub run: String,
    /// The controller's name in the scenario.
    pub controller: String,
    /// How long to wait for the world.
    pub attach_timeout: Duration,
    /// Schema hash to claim, for tests of those who check it.
    #[doc(hidden)]
    pub schema_hash: u64,
}

impl Options {
    /// What the environment says: `CZ_RUN` and `CZ_CONTROLLER`, as `cz run` sets them.
    pub fn from_env() -> Result<Options, Error> {
        let variable = |name| std::env::var(name).map_err(|_| Error::NotConfigured(name));
        Ok(Options {
            run: variable("CZ_RUN")?,
            controller: variable("CZ_CONTROLLER")?,
            attach_timeout: Duration::from_secs(30),
            schema_hash: ipc_schemas::schema_hash(),
        })
    }
}

/// A controller: from what it sees to one acceleration per vehicle.
pub trait Controller {
    /// Called once, before the first step.
    fn attached(&mut self, _run: &Run) {}

    /// Called every step. `u_mps2` has one place per vehicle of [`Step::vehicles`], 0 to begin with.
    fn step(&mut self, step: &Step<'_>, u_mps2: &mut [f64]);

    /// Whatever else the commands are to say: the plan and broadcast intent. They are filled in otherwise.
    fn annotate(&mut self, _step: &Step<'_>, _commands: &mut [VehicleCommand]) {}

    /// Called once, when the run is over.
    fn on_end(&mut self, _summary: &Summary) {}
}

/// Joins the run the environment names and answers every step to its end.
pub fn run(controller: &mut impl Controller) -> Result<(), Error> {
    run_with(&Options::from_env()?, controller)
}

/// Joins a run and answers every step to its end.
pub fn run_with(options: &Options, controller: &mut impl Controller) -> Result<(), Error> {
    let mut session = Session::attach(options)?;
    controller.attached(session.run());
    let mut accelerations = Vec::new();
    loop {
        match session.wait(Duration::from_secs(1))? {
            Wake::Timeout => {}
            Wake::End => {
                controller.on_end(&session.summary());
                return Ok(());
            }
            Wake::Step => {
                accelerations.clear();
                accelerations.resize(session.count(), 0.0);
                controller.step(&session.step(), &mut accelerations);
                let mut commands = session.take_commands()?;
                for (command, u) in commands.records_mut().iter_mut().zip(&accelerations) {
                    command.u_mps2 = *u;
                }
                controller.annotate(&session.step(), commands.records_mut());
                session.send(commands)?;
            }
        }
    }
}
