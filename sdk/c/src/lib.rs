//! The C ABI of `control-zones-plugin`; declared in `sdk/include/control_zones/plugin.h`, by hand, and held to
//! it by the assertions in both and by `examples/run_all.sh`, which compiles and runs programs against it.
//!
//! The only crate of the project with unsafe interfaces. Their common argument: a handle comes from
//! `cz_attach` and is used by one thread at a time until `cz_detach`, as the header demands; whatever
//! pointer a function returns points into the handle and lives until the next call that the header names.

use control_zones_plugin::schemas::{
    Assignment, CONSTRAINT_CROSS, CONSTRAINT_MERGE, CONSTRAINT_REAR_END, Feedback, FrameHeader, PathSpec,
    RunSpec, VehicleCommand, VehicleState,
};
use control_zones_plugin::{Commands, Error, Options, PartnerKind, Session, Wake};
use std::cell::RefCell;
use std::ffi::{CStr, CString, c_char, c_double, c_int};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::ptr::{null, null_mut};
use std::time::Duration;

/// A step is to be answered.
pub const CZ_STEP: c_int = 1;
/// Nothing came in time.
pub const CZ_TIMEOUT: c_int = 0;
/// The run is over.
pub const CZ_END: c_int = 2;
/// See `cz_last_error`.
pub const CZ_ERROR: c_int = -1;

thread_local! {
    static LAST_ERROR: RefCell<CString> = RefCell::new(CString::default());
}

/// An attachment, opaque to C.
pub struct Plugin {
    // Before the session it was lent from.
    commands: Option<Commands>,
    session: Session,
    paths: Vec<PathSpec>,
    names: Vec<CString>,
    vehicles: Vec<Vehicle>,
    /// Partners of all vehicles, and where each one's end.
    partners: Vec<Partner>,
    ends: Vec<usize>,
}

/// A vehicle that another must respect.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct Partner {
    /// Its record in the state frame.
    pub state: *const VehicleState,
    /// Its position in the vehicle's own coordinate, m.
    pub x_m: f64,
    /// Distance of the conflict point on the vehicle's path, m; means nothing toward a leader.
    pub at_m: f64,
    /// Distance to be kept to it beside phi v, m.
    pub gap_m: f64,
    /// `CZ_CONSTRAINT_REAR_END`, `CZ_CONSTRAINT_MERGE` or `CZ_CONSTRAINT_CROSS`: what is owed to it now.
    pub kind: u64,
    /// Its place among the records of the zone.
    pub place: u64,
}

const _: () = assert!(size_of::<Partner>() == 40 + size_of::<usize>());

/// One vehicle to be commanded, with its partners looked up.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct Vehicle {
    /// Its record in the state frame.
    pub state: *const VehicleState,
    /// The nearest vehicle ahead on its way, or null.
    pub ahead: *const VehicleState,
    /// The vehicle that passes the nearest conflict point first, or null. `cz_partners` has all.
    pub merge: *const VehicleState,
    /// Length of its path, m.
    pub length_m: f64,
    /// Terminal speed, m/s; NaN when it is free.
    pub terminal_mps: f64,
    /// Position of `ahead` in the vehicle's own coordinate, m; NaN without one.
    pub ahead_x_m: f64,
    /// Position of `merge` in the vehicle's own coordinate, m; NaN without one.
    pub merge_x_m: f64,
    /// Distance of the conflict point shared with `merge` on the vehicle's path, m; NaN without one.
    pub merge_at_m: f64,
    /// Place on its path that its coordinator has scheduled it for, m; NaN when nothing is scheduled.
    pub scheduled_at_m: f64,
    /// Instant before which it is not to be there, s; NaN when nothing is scheduled.
    pub scheduled_time_s: f64,
    /// What this controller commanded it for the step just ended, m/s^2; NaN when it did not.
    pub commanded_mps2: f64,
    /// Its place among the records of the zone.
    pub place: u64,
    /// All records of its zone, and their number.
    pub zone_states: *const VehicleState,
    /// Their number.
    pub zone_count: u64,
    /// What the shield found of its last command, or null where it let it pass.
    pub bounded: *const Feedback,
}

const _: () = assert!(size_of::<Vehicle>() == 80 + 5 * size_of::<usize>());

/// A step to be answered.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default)]
pub struct StepInfo {
    /// Its number.
    pub step: u64,
    /// Simulated time, s.
    pub time_s: f64,
    /// Steps that have passed without this controller since its last answer.
    pub skipped: u64,
    /// 1 when the world put something in for a controller that was late in the step before, otherwise 0.
    pub missed: u64,
}

/// What a run has been for a controller, as the controller saw it.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default)]
pub struct RunSummary {
    /// Step of the last state seen.
    pub step: u64,
    /// Simulated time of it, s.
    pub time_s: f64,
    /// Steps answered.
    pub answered: u64,
    /// Steps that passed without this controller between its answers.
    pub skipped: u64,
    /// Of the states seen, those before which the world had put something in for a controller that was late.
    pub missed: u64,
    /// Answers that the world refused, as far as it said so: once in a step.
    pub refused: u64,
}

const _: () = assert!(size_of::<StepInfo>() == 32 && size_of::<RunSummary>() == 48);

fn fail(message: &str) {
    let text = CString::new(message.replace('\0', " ")).unwrap_or_default();
    LAST_ERROR.with(|last| *last.borrow_mut() = text);
}

/// Runs `body`, turning errors and panics (which must not cross into C) into `otherwise`.
fn guarded<T>(otherwise: T, body: impl FnOnce() -> Result<T, Error>) -> T {
    match catch_unwind(AssertUnwindSafe(body)) {
        Ok(Ok(value)) => value,
        Ok(Err(error)) => {
            fail(&error.to_string());
            otherwise
        }
        Err(_) => {
            fail("internal error: a panic; see stderr");
            otherwise
        }
    }
}

/// What went wrong last on this thread, UTF-8; valid until the next failure on it.
#[unsafe(no_mangle)]
pub extern "C" fn cz_last_error() -> *const c_char {
    LAST_ERROR.with(|last| last.borrow().as_ptr())
}

/// Joins a run; null names stand for the environment's `CZ_RUN` and `CZ_CONTROLLER`. Null on failure.
///
/// # Safety
/// `run` and `controller` are null or null-terminated strings.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn cz_attach(
    run: *const c_char,
    controller: *const c_char,
    timeout_s: c_double,
) -> *mut Plugin {
    let text = |pointer: *const c_char, variable: &'static str| {
        if pointer.is_null() {
            return std::env::var(variable).map_err(|_| Error::NotConfigured(variable));
        }
        // SAFETY: not null, so by the caller's promise a null-terminated string.
        Ok(unsafe { CStr::from_ptr(pointer) }.to_string_lossy().into_owned())
    };
    guarded(null_mut(), || {
        let options = Options {
            run: text(run, "CZ_RUN")?,
            controller: text(controller, "CZ_CONTROLLER")?,
            attach_timeout: duration(timeout_s),
            schema_hash: control_zones_plugin::schemas::schema_hash(),
        };
        let session = Session::attach(&options)?;
        let paths = session.run().paths.iter().map(|a| a.spec).collect();
        let names = session.run().paths.iter();
        let names = names.map(|a| CString::new(a.name.as_str()).unwrap_or_default()).collect();
        let plugin = Plugin {
            commands: None,
            session,
            paths,
            names,
            vehicles: Vec::new(),
            partners: Vec::new(),
            ends: Vec::new(),
        };
        Ok(Box::into_raw(Box::new(plugin)))
    })
}

fn duration(seconds: f64) -> Duration {
    Duration::try_from_secs_f64(seconds.clamp(0.0, 1e6)).unwrap_or_default()
}

/// Leaves the run. Null is allowed.
///
/// # Safety
/// `plugin` is null or from `cz_attach`, and is not used again.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn cz_detach(plugin: *mut Plugin) {
    if !plugin.is_null() {
        // SAFETY: by the caller's promise it came out of `Box::into_raw` and this is its last use.
        let plugin = unsafe { Box::from_raw(plugin) };
        guarded((), || {
            drop(plugin);
            Ok(())
        });
    }
}

/// Waits up to `timeout_s` for a step: `CZ_STEP`, `CZ_TIMEOUT`, `CZ_END` or `CZ_ERROR`.
///
/// # Safety
/// `plugin` is from `cz_attach`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn cz_wait(plugin: *mut Plugin, timeout_s: c_double) -> c_int {
    // SAFETY: a live handle, used by one thread at a time.
    let plugin = unsafe { &mut *plugin };
    guarded(CZ_ERROR, || {
        Ok(match plugin.session.wait(duration(timeout_s))? {
            Wake::Timeout => CZ_TIMEOUT,
            Wake::End => CZ_END,
            Wake::Step => {
                plugin.look_up();
                CZ_STEP
            }
        })
    })
}

impl Plugin {
    fn look_up(&mut self) {
        self.vehicles.clear();
        self.partners.clear();
        self.ends.clear();
        for vehicle in self.session.step().vehicles() {
            let (scheduled_at_m, scheduled_time_s) = vehicle.schedule().unwrap_or((f64::NAN, f64::NAN));
            let mut found = Vehicle {
                state: vehicle.state,
                ahead: null(),
                merge: null(),
                length_m: vehicle.length_m,
                terminal_mps: vehicle.terminal_mps().unwrap_or(f64::NAN),
                ahead_x_m: f64::NAN,
                merge_x_m: f64::NAN,
                merge_at_m: f64::NAN,
                scheduled_at_m,
                scheduled_time_s,
                commanded_mps2: vehicle.commanded_mps2.unwrap_or(f64::NAN),
                place: vehicle.place as u64,
                zone_states: vehicle.zone_states().as_ptr(),
                zone_count: vehicle.zone_states().len() as u64,
                bounded: vehicle.bounded.map_or(null(), std::ptr::from_ref),
            };
            for partner in vehicle.partners() {
                let control_zones_plugin::Partner { state, place, kind, x_m, conflict_m, gap_m } = partner;
                let code = match kind {
                    PartnerKind::RearEnd => CONSTRAINT_REAR_END,
                    PartnerKind::Merge => CONSTRAINT_MERGE,
                    PartnerKind::Cross => CONSTRAINT_CROSS,
                };
                self.partners.push(Partner {
                    state,
                    x_m,
                    at_m: conflict_m,
                    gap_m,
                    kind: code.into(),
                    place: place as u64,
                });
                // The nearest of several.
                if kind == PartnerKind::RearEnd {
                    if found.ahead.is_null() || x_m < found.ahead_x_m {
                        (found.ahead, found.ahead_x_m) = (state, x_m);
                    }
                } else if found.merge.is_null() || conflict_m < found.merge_at_m {
                    (found.merge, found.merge_x_m, found.merge_at_m) = (state, x_m, conflict_m);
                }
            }
            self.vehicles.push(found);
            self.ends.push(self.partners.len());
        }
    }
}

/// The run's numbers; valid until detached.
///
/// # Safety
/// `plugin` is from `cz_attach`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn cz_run_spec(plugin: *const Plugin) -> *const RunSpec {
    // SAFETY: a live handle.
    unsafe { &(*plugin).session.run().spec }
}

/// All paths; valid until detached.
///
/// # Safety
/// `plugin` is from `cz_attach`; `count` may be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn cz_paths(plugin: *const Plugin, count: *mut usize) -> *const PathSpec {
    // SAFETY: a live handle, and a place to write to.
    unsafe {
        let paths = &(*plugin).paths;
        *count = paths.len();
        paths.as_ptr()
    }
}

/// The name of a path, `ZONE.PATH`; null beyond the last one.
///
/// # Safety
/// `plugin` is from `cz_attach`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn cz_path_name(plugin: *const Plugin, index: usize) -> *const c_char {
    // SAFETY: a live handle.
    let names = unsafe { &(*plugin).names };
    names.get(index).map_or(null(), |name| name.as_ptr())
}

/// The step to be answered: its number, time and flags; zeros without one.
///
/// # Safety
/// `plugin` is from `cz_attach`, and `cz_wait` has returned `CZ_STEP`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn cz_step(plugin: *const Plugin) -> StepInfo {
    // SAFETY: a live handle.
    let session = unsafe { &(*plugin).session };
    guarded(StepInfo::default(), || {
        let step = session.step();
        let (time_s, skipped, missed) = (step.time_s, step.skipped, u64::from(step.missed));
        Ok(StepInfo { step: step.header.step, time_s, skipped, missed })
    })
}

/// What the run has been so far, as this controller saw it.
///
/// # Safety
/// `plugin` is from `cz_attach`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn cz_summary(plugin: *const Plugin) -> RunSummary {
    // SAFETY: a live handle.
    let control_zones_plugin::Summary { step, time_s, answered, skipped, missed, refused } =
        unsafe { (*plugin).session.summary() };
    RunSummary { step, time_s, answered, skipped, missed, refused }
}

/// The header of the state frame; valid until `cz_send`. Null without a step.
///
/// # Safety
/// `plugin` is from `cz_attach`, and `cz_wait` has returned `CZ_STEP`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn cz_header(plugin: *const Plugin) -> *const FrameHeader {
    // SAFETY: a live handle.
    let session = unsafe { &(*plugin).session };
    guarded(null(), || Ok(std::ptr::from_ref(session.step().header)))
}

/// The state frame, where it lies in shared memory; valid until `cz_send`. Null without a step.
///
/// # Safety
/// `plugin` is from `cz_attach`, `cz_wait` has returned `CZ_STEP`; `count` may be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn cz_states(plugin: *const Plugin, count: *mut usize) -> *const VehicleState {
    // SAFETY: a live handle, and a place to write to.
    let (session, count) = unsafe { (&(*plugin).session, &mut *count) };
    *count = 0;
    guarded(null(), || {
        let states = session.step().states;
        *count = states.len();
        Ok(states.as_ptr())
    })
}

/// The vehicles to be commanded, in the order of the commands; valid until `cz_send`.
///
/// # Safety
/// `plugin` is from `cz_attach`; `count` may be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn cz_vehicles(plugin: *const Plugin, count: *mut usize) -> *const Vehicle {
    // SAFETY: a live handle, and a place to write to.
    unsafe {
        let vehicles = &(*plugin).vehicles;
        *count = vehicles.len();
        vehicles.as_ptr()
    }
}

/// The answers that the world refused since the last one it took, with field and rule; valid until `cz_send`.
///
/// # Safety
/// `plugin` is from `cz_attach`; `count` may be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn cz_refusals(plugin: *const Plugin, count: *mut usize) -> *const Feedback {
    // SAFETY: a live handle, and a place to write to.
    let (session, count) = unsafe { (&(*plugin).session, &mut *count) };
    *count = 0;
    guarded(null(), || {
        let refusals = session.step().refusals;
        *count = refusals.len();
        Ok(refusals.as_ptr())
    })
}

/// Writes feedback in words, UTF-8, ended by 0 and cut to `size` bytes; returns how many bytes all of it has.
///
/// # Safety
/// `feedback` may be read, and `size` bytes at `text` written; `text` may be null where `size` is 0.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn cz_feedback_text(
    feedback: *const Feedback,
    text: *mut c_char,
    size: usize,
) -> usize {
    // SAFETY: by the caller's promise it may be read.
    let words = unsafe { *feedback }.to_string();
    if let Some(room) = size.checked_sub(1) {
        let count = words.len().min(room);
        // SAFETY: by the caller's promise there is room for `size` bytes, of which this writes `count + 1`.
        unsafe {
            std::ptr::copy_nonoverlapping(words.as_ptr().cast(), text, count);
            text.add(count).write(0);
        }
    }
    words.len()
}

/// All vehicles that one to be commanded (its place among `cz_vehicles`) must respect where they are now; valid until
/// `cz_send`.
///
/// # Safety
/// `plugin` is from `cz_attach`; `count` may be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn cz_partners(
    plugin: *const Plugin,
    vehicle: usize,
    count: *mut usize,
) -> *const Partner {
    // SAFETY: a live handle, and a place to write to.
    unsafe {
        let Plugin { partners, ends, .. } = &*plugin;
        let to = ends.get(vehicle).copied().unwrap_or(0);
        let from = vehicle.checked_sub(1).and_then(|before| ends.get(before).copied()).unwrap_or(0).min(to);
        *count = to - from;
        partners[from..to].as_ptr()
    }
}

/// The coordination in force in a zone; valid until the next `cz_wait`.
///
/// # Safety
/// `plugin` is from `cz_attach`, `cz_wait` has returned `CZ_STEP`; `count` may be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn cz_assignments(
    plugin: *const Plugin,
    zone: u32,
    count: *mut usize,
) -> *const Assignment {
    // SAFETY: a live handle, and a place to write to.
    let (session, count) = unsafe { (&(*plugin).session, &mut *count) };
    *count = 0;
    guarded(null(), || {
        let assignments = session.assignments(zone);
        *count = assignments.len();
        Ok(assignments.as_ptr())
    })
}

/// Lends the command frame of this step, vehicles and zones filled in, accelerations 0; valid until
/// `cz_send`. Called again before that, it returns the same frame. Null on failure.
///
/// # Safety
/// `plugin` is from `cz_attach`; `count` may be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn cz_commands(plugin: *mut Plugin, count: *mut usize) -> *mut VehicleCommand {
    // SAFETY: a live handle used by one thread, and a place to write to.
    let (plugin, count) = unsafe { (&mut *plugin, &mut *count) };
    *count = 0;
    guarded(null_mut(), || {
        if plugin.commands.is_none() {
            plugin.commands = Some(plugin.session.take_commands()?);
        }
        let records = plugin.commands.as_mut().map(Commands::records_mut).unwrap_or_default();
        *count = records.len();
        Ok(records.as_mut_ptr())
    })
}

/// Sends the command frame: 0, or `CZ_ERROR`.
///
/// # Safety
/// `plugin` is from `cz_attach`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn cz_send(plugin: *mut Plugin) -> c_int {
    // SAFETY: a live handle, used by one thread at a time.
    let plugin = unsafe { &mut *plugin };
    guarded(CZ_ERROR, || {
        let commands = match plugin.commands.take() {
            Some(commands) => commands,
            None => plugin.session.take_commands()?,
        };
        plugin.vehicles.clear();
        plugin.partners.clear();
        plugin.ends.clear();
        plugin.session.send(commands)?;
        Ok(0)
    })
}
