//! Frames that are not taken: counted and attributed, and no reason to end anything.

use super::Identity;
use crate::control::pool::PoolError;
use crate::scenario::ControllerNames;
use crate::trace;
use crate::world::CommandFault;
use ipc_schemas::{self as frames, Feedback, FrameHeader, HeaderFault, Role};
use serde::{Deserialize, Serialize};

/// Why a frame was not taken.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Refusal {
    /// The header is not what the protocol asks for.
    #[error("{0}")]
    Header(#[from] HeaderFault),
    /// The frame was sent by another process than the one that has this place.
    #[error("it claims to come from {claimed}, which is process {expected}")]
    Stranger {
        /// Whom the header names.
        claimed: Claim,
        /// The process that has that place.
        expected: u32,
    },
    /// A second frame of the same step, or one nobody asked for in this step.
    #[error("step {step}: nobody asked for it")]
    Unexpected {
        /// Step in its header.
        step: u64,
    },
    /// A controller's commands do not fit the state.
    #[error("step {step}, {fault}")]
    Command {
        /// Step.
        step: u64,
        /// What is wrong.
        fault: CommandFault,
    },
    /// A coordinator's assignments do not fit the state.
    #[error("step {step}, {fault}")]
    Coordination {
        /// Step.
        step: u64,
        /// What is wrong.
        fault: PoolError,
    },
    /// A coordinator's assignments name zones that are not its own.
    #[error("step {step}, record {record}, field zone: {zone} is not a zone of this coordinator that acts")]
    ForeignZone {
        /// Step.
        step: u64,
        /// Place in the frame.
        record: usize,
        /// Zone named.
        zone: u32,
    },
}

impl Refusal {
    /// The same as a controller is told it, of its answer to this step.
    pub fn feedback(&self, step: u64, controller: u16) -> Option<Feedback> {
        let header = |field, found: u64, expected: u64| Feedback {
            value: found as f64,
            least: expected as f64,
            greatest: expected as f64,
            rule: frames::RULE_OTHER,
            field,
            vehicle: frames::NO_VEHICLE,
            zone: frames::NO_ZONE,
            toward: frames::NO_VEHICLE,
            ..Feedback::default()
        };
        let told = match self {
            Refusal::Command { fault, .. } => fault.feedback(),
            Refusal::Unexpected { step: found } => {
                Feedback { rule: frames::RULE_UNASKED, ..header(frames::FIELD_STEP, *found, step) }
            }
            Refusal::Header(fault) => match *fault {
                HeaderFault::OtherSchema { .. } => header(frames::FIELD_SCHEMA_HASH, 0, 0),
                HeaderFault::OtherRun { .. } => header(frames::FIELD_RUN_ID, 0, 0),
                HeaderFault::OtherSender { .. } => header(frames::FIELD_SENDER, 0, 0),
                HeaderFault::OldGeneration { expected, found }
                | HeaderFault::UnknownGeneration { expected, found } => {
                    header(frames::FIELD_GENERATION, found.into(), expected.into())
                }
                HeaderFault::OtherStep { expected, found } => header(frames::FIELD_STEP, found, expected),
                HeaderFault::OtherCount { announced, found } => {
                    header(frames::FIELD_RECORD_COUNT, announced.into(), found as u64)
                }
            },
            Refusal::Stranger { .. } | Refusal::Coordination { .. } | Refusal::ForeignZone { .. } => {
                return None;
            }
        };
        Some(Feedback { step, controller, ..told })
    }
}

/// The sender a header names; the codes come off the wire and may name nobody.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Claim {
    role: u16,
    index: u16,
}

impl Claim {
    /// Of a header.
    pub fn of(header: &FrameHeader) -> Claim {
        Claim { role: header.sender_role, index: header.sender_index }
    }
}

impl std::fmt::Display for Claim {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match Role::from_code(self.role) {
            Some(Role::World) => f.write_str("the world"),
            Some(role) => write!(f, "{role} {}", self.index),
            None => write!(f, "a sender of unknown role {}", self.role),
        }
    }
}

/// What was refused of one sender.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RefusedFrames {
    /// Who refused them.
    pub receiver: String,
    /// Who sent them: the role and index claimed, and the process where it is known.
    pub sender: String,
    /// Their number.
    pub frames: u64,
    /// What was wrong with the last one.
    pub last: String,
}

impl std::fmt::Display for RefusedFrames {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let RefusedFrames { receiver, sender, frames, last } = self;
        write!(f, "{receiver} refused {frames} frames of {sender}; the last: {last}")
    }
}

/// Accounts are kept for this many senders; the rest share one.
const MAX_ACCOUNTS: usize = 64;

#[derive(Debug)]
struct Account {
    origin: u128,
    claim: Claim,
    process_id: Option<u32>,
    frames: u64,
    last: Refusal,
}

/// What one receiver has refused, by sender.
#[derive(Debug, Default)]
pub(super) struct Refusals {
    accounts: Vec<Account>,
    /// Answers that came after the run had gone on, or twice: what a participant that was slow, or has been
    /// replaced, leaves behind.
    pub late: u64,
}

impl Refusals {
    /// Enters a frame; `process` is asked once per sender. Returns the sender's process, where it is known.
    pub fn enter(
        &mut self,
        header: &FrameHeader,
        origin: u128,
        refusal: Refusal,
        process: impl FnOnce() -> Option<u32>,
    ) -> Option<u32> {
        let claim = Claim::of(header);
        let full = self.accounts.len() >= MAX_ACCOUNTS;
        let known = self.accounts.iter_mut().find(|a| a.origin == origin && a.claim == claim);
        let account = match known {
            Some(account) => account,
            None if full => self.accounts.last_mut().expect("there are accounts"),
            None => {
                let process_id = process();
                let account = Account { origin, claim, process_id, frames: 0, last: refusal.clone() };
                self.accounts.push(account);
                self.accounts.last_mut().expect("one was added")
            }
        };
        trace::note(|| format!("frame refused: {refusal}"));
        account.frames += 1;
        account.last = refusal;
        account.process_id
    }

    /// Of how many senders.
    pub fn senders(&self) -> usize {
        self.accounts.len()
    }

    /// All of it, as refused by this receiver.
    pub fn report(&self, receiver: &Identity, names: &ControllerNames) -> Vec<RefusedFrames> {
        let receiver = Claim { role: receiver.role as u16, index: receiver.index }.to_string();
        let claimed = |claim: Claim| match Role::from_code(claim.role) {
            Some(Role::Controller) => names.of(u32::from(claim.index)),
            _ => claim.to_string(),
        };
        let sender = |a: &Account| match a.process_id {
            Some(id) => format!("{} (process {id})", claimed(a.claim)),
            None => claimed(a.claim),
        };
        self.accounts
            .iter()
            .map(|a| RefusedFrames {
                receiver: receiver.clone(),
                sender: sender(a),
                frames: a.frames,
                last: a.last.to_string(),
            })
            .collect()
    }
}
