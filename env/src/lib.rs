//! Control Zones behind a C ABI: as an environment to learn in, many runs in one thread, for `control_zones.env`; and with a world
//! that is played from outside, for `control_zones.world`.
//!
//! All unsafe code is here. Its common argument: a handle comes from [`cz_env_new`] and is used by one thread at a time
//! until [`cz_env_free`]; strings end with a zero; buffers have the sizes that the description names.

mod envs;
mod played;
mod run;

pub use envs::{End, EnvError, Envs};
pub use played::{AdmittedVehicle, Callbacks, cz_world_run, cz_world_scenario};
pub use run::{FEATURES, Run, RunError};

use std::cell::RefCell;
use std::ffi::{CStr, CString, c_char, c_int};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::ptr::null_mut;
use std::slice::{from_raw_parts, from_raw_parts_mut};

thread_local! {
    static ERROR: RefCell<CString> = RefCell::new(CString::default());
}

/// What a call came to; `failed` after an error or a panic, of which [`cz_env_error`] tells.
fn guarded<T>(failed: T, call: impl FnOnce() -> Result<T, EnvError>) -> T {
    let said = match catch_unwind(AssertUnwindSafe(call)) {
        Ok(Ok(value)) => return value,
        Ok(Err(error)) => error.to_string(),
        Err(_) => "internal error; the message is on stderr".to_owned(),
    };
    ERROR.with_borrow_mut(|error| *error = CString::new(said.replace('\0', " ")).unwrap_or_default());
    failed
}

/// # Safety
/// `text` is null or ends with a zero.
unsafe fn text<'a>(text: *const c_char) -> Option<std::borrow::Cow<'a, str>> {
    // SAFETY: as the caller promises.
    (!text.is_null()).then(|| unsafe { CStr::from_ptr(text) }.to_string_lossy())
}

/// Why the last call of this thread failed; good until its next.
#[unsafe(no_mangle)]
pub extern "C" fn cz_env_error() -> *const c_char {
    ERROR.with_borrow(|error| error.as_ptr())
}

/// `count` runs to be reset, of a scenario (null: the default one); `sets` are lines `KEY=VALUE`, `zones` lines of names
/// (none: all). Null when that fails.
///
/// # Safety
/// Every string is null or ends with a zero.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn cz_env_new(
    scenario: *const c_char,
    sets: *const c_char,
    zones: *const c_char,
    capacity: u32,
    count: u32,
) -> *mut Envs {
    // SAFETY: as the caller promises.
    let [scenario, sets, zones] = [scenario, sets, zones].map(|string| unsafe { text(string) });
    guarded(null_mut(), || {
        let sets: Vec<&str> = sets.iter().flat_map(|sets| sets.lines()).collect();
        let zones: Vec<&str> = zones.iter().flat_map(|zones| zones.lines()).collect();
        let scenario = scenario.as_deref().map(str::to_owned);
        let envs = Envs::new(scenario, &sets, &zones, capacity.max(1) as usize, count.max(1) as usize)?;
        Ok(Box::into_raw(Box::new(envs)))
    })
}

/// What does not change, as JSON ([`Envs::description`]), to be given back to [`cz_env_forget`].
///
/// # Safety
/// `envs` is a handle.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn cz_env_describe(envs: *const Envs) -> *mut c_char {
    // SAFETY: as the caller promises.
    let envs = unsafe { &*envs };
    guarded(null_mut(), || Ok(CString::new(envs.description()).map_or(null_mut(), CString::into_raw)))
}

/// Takes back what [`cz_env_describe`] gave.
///
/// # Safety
/// `description` is null or came from there, once.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn cz_env_forget(description: *mut c_char) {
    if !description.is_null() {
        // SAFETY: as the caller promises.
        drop(unsafe { CString::from_raw(description) });
    }
}

/// Begins a run anew with a seed, or with the scenario's own unless `is_seeded`. 0, or -1 when that fails.
///
/// # Safety
/// `envs` is a handle.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn cz_env_reset(envs: *mut Envs, index: u32, seed: u64, is_seeded: c_int) -> c_int {
    // SAFETY: as the caller promises.
    let envs = unsafe { &mut *envs };
    guarded(-1, || envs.reset(index as usize, (is_seeded != 0).then_some(seed)).map(|()| 0))
}

/// One step of every run that has not ended. `ends` says 0 for one that goes on, 1 where everybody has left, 2 where time
/// is up. 0, or -1 when that fails.
///
/// # Safety
/// `envs` is a handle; there are count × zones × capacity `actions`, count × zones `rewards`, and count `ends`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn cz_env_step(
    envs: *mut Envs,
    count: u32,
    actions: *const f64,
    rewards: *mut f64,
    ends: *mut u8,
) -> c_int {
    // SAFETY: as the caller promises.
    let envs = unsafe { &mut *envs };
    let (actions_each, rewards_each) = envs.sizes();
    let count = count as usize;
    // SAFETY: as the caller promises.
    let (actions, rewards, ends) = unsafe {
        (
            from_raw_parts(actions, count * actions_each),
            from_raw_parts_mut(rewards, count * rewards_each),
            from_raw_parts_mut(ends, count),
        )
    };
    guarded(-1, || {
        let mut found = vec![End::No; count];
        envs.step(actions, rewards, &mut found)?;
        ends.iter_mut().zip(found).for_each(|(end, found)| *end = found as u8);
        Ok(0)
    })
}

/// Writes what is told of the vehicles of every run, their ids, and how many are behind the last rows of their zones. 0, or
/// -1 when that fails.
///
/// # Safety
/// `envs` is a handle of `count` runs; there is room for count × zones × capacity × features numbers, count × zones ×
/// capacity ids, and `count` numbers of vehicles.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn cz_env_observe(
    envs: *const Envs,
    count: u32,
    features: *mut f64,
    vehicles: *mut u32,
    unseen: *mut u32,
) -> c_int {
    // SAFETY: as the caller promises.
    let envs = unsafe { &*envs };
    let (count, rows) = (count as usize, envs.sizes().0);
    // SAFETY: as the caller promises.
    let (features, vehicles, unseen) = unsafe {
        (
            from_raw_parts_mut(features, count * rows * FEATURES.len()),
            from_raw_parts_mut(vehicles, count * rows),
            from_raw_parts_mut(unseen, count),
        )
    };
    guarded(-1, || {
        let parts = features.chunks_mut(rows * FEATURES.len()).zip(vehicles.chunks_mut(rows)).zip(unseen);
        for (index, ((features, vehicles), unseen)) in parts.enumerate() {
            let run = envs.run(index)?;
            features.copy_from_slice(run.features());
            vehicles.iter_mut().zip(run.vehicles()).for_each(|(place, vehicle)| *place = vehicle);
            *unseen = run.unseen() as u32;
        }
        Ok(0)
    })
}

/// The state hash of a run so far, as `cz run` gives it; 0 when there is none.
///
/// # Safety
/// `envs` is a handle.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn cz_env_state_hash(envs: *const Envs, index: u32) -> u64 {
    // SAFETY: as the caller promises.
    let envs = unsafe { &*envs };
    guarded(0, || Ok(envs.run(index as usize)?.world().state_hash()))
}

/// Ends all of it.
///
/// # Safety
/// `envs` is null or a handle, which is none from then on.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn cz_env_free(envs: *mut Envs) {
    if !envs.is_null() {
        // SAFETY: as the caller promises.
        drop(unsafe { Box::from_raw(envs) });
    }
}
