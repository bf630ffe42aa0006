//! Is this the frame I am waiting for? The checks a receiver makes before it reads a record.

use core::fmt;

use crate::{FrameHeader, Role, schema_hash};

/// Why a frame is refused.
///
/// Everything but [`OldGeneration`](HeaderFault::OldGeneration) means that a participant broke the
/// protocol. An old generation is what a killed process may leave in the queue: drop it and go on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HeaderFault {
    /// The sender was built from other record layouts.
    OtherSchema {
        /// Our schema hash.
        expected: u64,
        /// The frame's.
        found: u64,
    },
    /// The frame belongs to another run.
    OtherRun {
        /// Our run id.
        expected: u64,
        /// The frame's.
        found: u64,
    },
    /// The frame comes from another process than the one expected.
    OtherSender {
        /// Role waited for.
        expected_role: Role,
        /// Index waited for.
        expected_index: u16,
        /// The frame's role code, which may name no role.
        found_role: u16,
        /// The frame's index.
        found_index: u16,
    },
    /// The sender has been restarted since it sent the frame.
    OldGeneration {
        /// The sender's generation now.
        expected: u32,
        /// The frame's, smaller.
        found: u32,
    },
    /// The sender claims a generation nobody gave it.
    UnknownGeneration {
        /// The sender's generation now.
        expected: u32,
        /// The frame's, greater.
        found: u32,
    },
    /// The frame belongs to another step.
    OtherStep {
        /// Step waited for.
        expected: u64,
        /// The frame's.
        found: u64,
    },
    /// The header announces another number of records than the frame has.
    OtherCount {
        /// Number of records announced.
        announced: u32,
        /// Number of records that follow.
        found: usize,
    },
}

/// A sender in words: role codes come off the wire and may name no role.
struct Sender(u16, u16);

impl fmt::Display for Sender {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match Role::from_code(self.0) {
            Some(role) => write!(f, "{role} {}", self.1),
            None => write!(f, "unknown role {} (index {})", self.0, self.1),
        }
    }
}

impl fmt::Display for HeaderFault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            HeaderFault::OtherSchema { expected, found } => write!(
                f,
                "frame has schema hash {found:016x}, ours is {expected:016x}: \
                 the sender was built from another version of the schemas"
            ),
            HeaderFault::OtherRun { expected, found } => {
                write!(f, "frame belongs to run {found:016x}, this is run {expected:016x}")
            }
            HeaderFault::OtherSender { expected_role, expected_index, found_role, found_index } => write!(
                f,
                "frame comes from {}, expected {}",
                Sender(found_role, found_index),
                Sender(expected_role as u16, expected_index)
            ),
            HeaderFault::OldGeneration { expected, found } => write!(
                f,
                "frame comes from generation {found} of its sender, which has been restarted and is now \
                 generation {expected}"
            ),
            HeaderFault::UnknownGeneration { expected, found } => {
                write!(f, "frame claims generation {found}, but its sender is generation {expected}")
            }
            HeaderFault::OtherStep { expected, found } => {
                write!(f, "frame belongs to step {found}, expected step {expected}")
            }
            HeaderFault::OtherCount { announced, found } => {
                write!(f, "header announces {announced} records, the frame has {found}")
            }
        }
    }
}

impl std::error::Error for HeaderFault {}

/// What a receiver knows about the next frame from one sender.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ExpectedHeader {
    /// Id of this run.
    pub run_id: u64,
    /// Role of the sender.
    pub role: Role,
    /// Index of the sender among the processes of its role.
    pub index: u16,
    /// The sender's current generation.
    pub generation: u32,
    /// Step waited for.
    pub step: u64,
}

impl ExpectedHeader {
    /// Checks the header of a frame with `records` records.
    ///
    /// The first fault in order of trust is reported: with another schema no field means anything,
    /// in another run no sender is ours, and what an earlier generation sent may be of any step.
    pub fn check(&self, header: &FrameHeader, records: usize) -> Result<(), HeaderFault> {
        let schema = schema_hash();
        if header.schema_hash != schema {
            return Err(HeaderFault::OtherSchema { expected: schema, found: header.schema_hash });
        }
        if header.run_id != self.run_id {
            return Err(HeaderFault::OtherRun { expected: self.run_id, found: header.run_id });
        }
        if header.sender_role != self.role as u16 || header.sender_index != self.index {
            return Err(HeaderFault::OtherSender {
                expected_role: self.role,
                expected_index: self.index,
                found_role: header.sender_role,
                found_index: header.sender_index,
            });
        }
        if header.generation < self.generation {
            return Err(HeaderFault::OldGeneration { expected: self.generation, found: header.generation });
        }
        if header.generation > self.generation {
            return Err(HeaderFault::UnknownGeneration {
                expected: self.generation,
                found: header.generation,
            });
        }
        if header.step != self.step {
            return Err(HeaderFault::OtherStep { expected: self.step, found: header.step });
        }
        // Compared as u64: a slice of 2^32 + n records must not pass for one of n.
        if u64::from(header.record_count) != records as u64 {
            return Err(HeaderFault::OtherCount { announced: header.record_count, found: records });
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const EXPECTED: ExpectedHeader =
        ExpectedHeader { run_id: 7, role: Role::Controller, index: 2, generation: 1, step: 40 };

    fn good() -> FrameHeader {
        FrameHeader {
            run_id: 7,
            schema_hash: schema_hash(),
            step: 40,
            sender_role: Role::Controller as u16,
            sender_index: 2,
            generation: 1,
            record_count: 3,
            ..FrameHeader::default()
        }
    }

    /// Checks a good header after `spoil` and returns the fault with its message.
    fn fault(spoil: impl FnOnce(&mut FrameHeader)) -> (HeaderFault, String) {
        let mut header = good();
        spoil(&mut header);
        let fault = EXPECTED.check(&header, 3).expect_err("the header was spoiled");
        (fault, fault.to_string())
    }

    #[test]
    fn the_expected_frame_passes() {
        assert_eq!(EXPECTED.check(&good(), 3), Ok(()));
        let empty = FrameHeader { record_count: 0, ..good() };
        assert_eq!(EXPECTED.check(&empty, 0), Ok(()));
    }

    #[test]
    fn time_masks_and_flags_are_the_receivers_business() {
        let header = FrameHeader {
            time_ns: 9,
            coordinators_acting: 1,
            coordinators_summarised: 1,
            flags: crate::FLAG_END_OF_RUN,
            ..good()
        };
        assert_eq!(EXPECTED.check(&header, 3), Ok(()));
    }

    #[test]
    fn other_schema() {
        let (fault, message) = fault(|h| h.schema_hash ^= 1);
        assert_eq!(fault, HeaderFault::OtherSchema { expected: schema_hash(), found: schema_hash() ^ 1 });
        assert!(message.contains(&format!("ours is {:016x}", schema_hash())), "{message}");
    }

    #[test]
    fn other_run() {
        let (fault, message) = fault(|h| h.run_id = 8);
        assert_eq!(fault, HeaderFault::OtherRun { expected: 7, found: 8 });
        assert_eq!(message, "frame belongs to run 0000000000000008, this is run 0000000000000007");
    }

    #[test]
    fn other_sender_by_role() {
        let (fault, message) = fault(|h| h.sender_role = Role::World as u16);
        assert_eq!(
            fault,
            HeaderFault::OtherSender {
                expected_role: Role::Controller,
                expected_index: 2,
                found_role: 1,
                found_index: 2
            }
        );
        assert_eq!(message, "frame comes from world 2, expected controller 2");
    }

    #[test]
    fn other_sender_by_index() {
        let (fault, message) = fault(|h| h.sender_index = 0);
        assert!(matches!(fault, HeaderFault::OtherSender { found_role: 3, found_index: 0, .. }));
        assert_eq!(message, "frame comes from controller 0, expected controller 2");
    }

    #[test]
    fn a_role_nobody_has() {
        let (_, message) = fault(|h| h.sender_role = 99);
        assert_eq!(message, "frame comes from unknown role 99 (index 2), expected controller 2");
    }

    #[test]
    fn old_generation() {
        let (fault, message) = fault(|h| h.generation = 0);
        assert_eq!(fault, HeaderFault::OldGeneration { expected: 1, found: 0 });
        assert!(message.contains("restarted"), "{message}");
    }

    #[test]
    fn unknown_generation() {
        let (fault, message) = fault(|h| h.generation = 2);
        assert_eq!(fault, HeaderFault::UnknownGeneration { expected: 1, found: 2 });
        assert_eq!(message, "frame claims generation 2, but its sender is generation 1");
    }

    #[test]
    fn other_step() {
        let (fault, message) = fault(|h| h.step = 39);
        assert_eq!(fault, HeaderFault::OtherStep { expected: 40, found: 39 });
        assert_eq!(message, "frame belongs to step 39, expected step 40");
    }

    #[test]
    fn other_count() {
        let (fault, message) = fault(|h| h.record_count = 4);
        assert_eq!(fault, HeaderFault::OtherCount { announced: 4, found: 3 });
        assert_eq!(message, "header announces 4 records, the frame has 3");
    }

    #[cfg(target_pointer_width = "64")]
    #[test]
    fn a_count_that_only_agrees_in_its_low_bits() {
        let records = (1_usize << 32) + 3;
        assert_eq!(
            EXPECTED.check(&good(), records),
            Err(HeaderFault::OtherCount { announced: 3, found: records })
        );
    }

    #[test]
    fn the_least_trustworthy_fault_is_named_first() {
        let spoil_step = |h: &mut FrameHeader| h.step = 39;
        let (first, _) = fault(|h| {
            spoil_step(h);
            h.generation = 0;
        });
        assert!(matches!(first, HeaderFault::OldGeneration { .. }));
        let (first, _) = fault(|h| {
            spoil_step(h);
            h.run_id = 8;
            h.schema_hash = 0;
        });
        assert!(matches!(first, HeaderFault::OtherSchema { .. }));
    }
}
