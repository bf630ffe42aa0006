//! Doorbells: how a sender wakes a receiver that sleeps.
//!
//! A ring costs the sender a system call and the sleeper several, so in the hot loop nobody sleeps and
//! nobody rings; coordinators, which sleep from event to event, have a bell.

use super::space::{RunSpace, SpaceError, failed, service_name};
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::service::ipc;
use iceoryx2::service::port_factory::event::PortFactory;
use std::time::Duration;

/// A bell's service, kept by the world for as long as the run lasts.
#[derive(Debug)]
pub struct BellService(#[expect(dead_code, reason = "held for its lifetime")] PortFactory<ipc::Service>);

/// The sleeper's end.
#[derive(Debug)]
pub struct Bell(Listener<ipc::Service>);

/// A sender's end.
#[derive(Debug)]
pub struct BellRope(Notifier<ipc::Service>);

impl Bell {
    /// Sleeps until the bell rings, or has rung since the last time, or the time is up.
    pub fn sleep(&self, at_most: Duration) {
        // A failure shows as a sleep that ends early; whoever called polls again in any case.
        let _ = self.0.timed_wait(|_| {}, at_most);
    }
}

impl BellRope {
    /// Rings. A bell nobody has hung up yet rings nowhere, which is no fault: its owner still polls.
    pub fn ring(&self) {
        let _ = self.0.notify();
    }
}

impl RunSpace {
    /// Creates the bell service of a sleeper, as the run's world.
    pub fn create_bell(&self, name: &str, ringers: usize) -> Result<BellService, SpaceError> {
        let nodes = ringers + 2;
        self.node()
            .service_builder(&service_name(name)?)
            .event()
            .max_listeners(1)
            .max_notifiers(ringers)
            .max_nodes(nodes)
            .event_id_max_value(0)
            .create()
            .map(BellService)
            .map_err(|e| failed(&format!("create bell {name}"), &e))
    }

    /// Hangs up the bell of this process; `None` when there is none, for which polling makes up.
    pub fn bell(&self, name: &str) -> Option<Bell> {
        let service = self.node().service_builder(&service_name(name).ok()?).event().open().ok()?;
        service.listener_builder().create().ok().map(Bell)
    }

    /// Takes hold of another process's bell rope; `None` when it has no bell.
    pub fn bell_rope(&self, name: &str) -> Option<BellRope> {
        let service = self.node().service_builder(&service_name(name).ok()?).event().open().ok()?;
        service.notifier_builder().create().ok().map(BellRope)
    }
}
