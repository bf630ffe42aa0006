//! How a participant joins a run: a request, answered by the world.

use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;

use crate::code::codes;
use crate::record;

codes! {
    /// [`AttachRequest::controller`]: a process of the built-in pool, or a coordinator.
    pub const BUILT_IN: u64 = 0;
    /// [`AttachRequest::wanted_index`]: any free index will do.
    pub const ANY_INDEX: u16 = u16::MAX;
    /// [`AttachRequest::scenario_hash`]: no scenario of one's own, take the world's.
    pub const ANY_SCENARIO: u64 = 0;

    /// [`AttachRequest::phase`]: asks for admission.
    pub const ATTACH_JOIN: u32 = 1;
    /// [`AttachRequest::phase`]: has been admitted, has opened its ends of the services, and can start.
    pub const ATTACH_READY: u32 = 2;
    /// [`AttachRequest::phase`]: has fallen behind the run and asks for what it needs to catch up.
    pub const ATTACH_RESTORE: u32 = 3;

    /// [`AttachReply::waiting`]: world and controllers poll, coordinators sleep.
    pub const WAITING_HYBRID: u32 = 0;
    /// [`AttachReply::waiting`]: everyone spins.
    pub const WAITING_SPIN: u32 = 1;
    /// [`AttachReply::waiting`]: everyone sleeps until rung.
    pub const WAITING_BLOCK: u32 = 2;
    /// [`AttachReply::waiting`]: everyone polls while that pays, and sleeps until rung otherwise.
    pub const WAITING_ADAPTIVE: u32 = 3;

    /// [`AttachReply::status`]: welcome; the other fields and the scenario bytes are valid.
    pub const ATTACH_ACCEPTED: u32 = 0;
    /// [`AttachReply::status`]: the participant's schema hash is not the world's.
    pub const ATTACH_OTHER_SCHEMA: u32 = 1;
    /// [`AttachReply::status`]: the participant's scenario hash is not the world's.
    pub const ATTACH_OTHER_SCENARIO: u32 = 2;
    /// [`AttachReply::status`]: every index of that role is taken.
    pub const ATTACH_NO_ROOM: u32 = 3;
    /// [`AttachReply::status`]: the request names a role no participant has.
    pub const ATTACH_BAD_ROLE: u32 = 4;
    /// [`AttachReply::status`]: the scenario declares no controller of that name.
    pub const ATTACH_NO_CONTROLLER: u32 = 5;
    /// [`AttachReply::status`]: the run is under way and does without newcomers.
    pub const ATTACH_UNDER_WAY: u32 = 6;
    /// [`AttachReply::status`]: the request names a phase there is not.
    pub const ATTACH_BAD_PHASE: u32 = 7;
}

record! {
    /// Participant → world: let me in; later, I am ready.
    ///
    /// Repeated until answered. The other services are opened only between the two, so that a
    /// participant of another schema is refused before its frames could be misread. `instance` is drawn at
    /// random by the participant and tells its answer from those to others.
    #[type_name("cz.AttachRequest.v1")]
    pub struct AttachRequest {
        /// Random number that names this participant.
        pub instance: u64,
        /// The participant's schema hash.
        pub schema_hash: u64,
        /// Hash of the scenario the participant was given, or 0 to take the world's.
        pub scenario_hash: u64,
        /// Which plug-in this is: FNV-1a, 64 bits, of the name the scenario gives it; 0 for a process
        /// of the built-in pool.
        pub controller: u64,
        /// Process id, for liveness checks and messages.
        pub process_id: u32,
        /// 2 coordinator, 3 controller.
        pub role: u16,
        /// Index wanted among the processes of the role, or 65535 for any.
        pub wanted_index: u16,
        /// 1 join, 2 ready, 3 restore.
        pub phase: u32,
        /// Index assigned in the reply to the join; 0 while joining.
        pub index: u32,
    }
}

record! {
    /// World → participant: the answer. Behind it: for a coordinator or a process of the
    /// built-in pool the encoded scenario, for a plug-in a `RunSpec` and what goes with it, and for
    /// whoever is refused the reason in words, UTF-8.
    #[type_name("cz.AttachReply.v1")]
    pub struct AttachReply {
        /// The `instance` of the request this answers.
        pub instance: u64,
        /// Run id for all frames.
        pub run_id: u64,
        /// The world's schema hash.
        pub schema_hash: u64,
        /// The world's scenario hash.
        pub scenario_hash: u64,
        /// First step the participant will be asked to answer.
        pub first_step: u64,
        /// 0 accepted, otherwise why not.
        pub status: u32,
        /// The world's process id.
        pub world_process_id: u32,
        /// Generation the participant is to put in its headers.
        pub generation: u32,
        /// Index assigned among the processes of the role.
        pub index: u32,
        /// Number of coordinator processes in the run.
        pub coordinators: u32,
        /// Number of controller processes in the run.
        pub controllers: u32,
        /// How the built-in processes of the run wait: 0 hybrid, 1 spin, 2 block, 3 adaptive. A plug-in may
        /// wait as it likes: nobody rings for it, and the world does not expect it to ring.
        pub waiting: u32,
        /// Zero.
        pub reserved: u32,
    }
}
