//! Who has which place in a run.

use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;

use crate::record;

record! {
    /// World → coordinators and controllers: the process that has a place in the run.
    ///
    /// A frame lists everybody but the world, and the last one counts. The world sends it before the first
    /// state, and again before whoever takes a place anew may send its first frame. A receiver believes a frame
    /// of a coordinator only when the transport says that it comes from the process that has its place.
    #[type_name("cz.Member.v1")]
    pub struct Member {
        /// The process.
        pub process_id: u32,
        /// Generation in the headers of its frames.
        pub generation: u32,
        /// 2 coordinator, 3 controller.
        pub role: u16,
        /// Index among the processes of the role.
        pub index: u16,
    }
}
