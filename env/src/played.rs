//! Worlds played from other languages: a `Traffic` that calls back.
//!
//! The callbacks are called in the thread that called [`cz_world_run`], and in no other.

use crate::text;
use control_zones::scenario::{Override, Scenario, load};
use control_zones::world::{Admitted, Coming, Done, Newcomer, Task, Traffic, TrafficError};
use std::ffi::{CString, c_char, c_int, c_void};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::ptr::null_mut;

/// Newcomers of one step at most; more come a step later.
const MOST_NEWCOMERS: usize = 4096;

/// A vehicle that the world's gates have let in.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct AdmittedVehicle {
    /// Position on the first of its paths, m.
    pub x_m: f64,
    /// Speed, m/s.
    pub v_mps: f64,
    /// The vehicle.
    pub vehicle: u32,
    /// Kind: index in the scenario's fleet.
    pub kind: u32,
    /// Road by which it comes.
    pub road: u32,
    /// Number of zones on its way.
    pub hops: u32,
    /// 1: it does what it is commanded; to be set to 0 where it does not.
    pub is_commanded: u32,
    /// Nothing.
    pub reserved: u32,
}

/// What a world is played by. `context` is handed to all of them.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct Callbacks {
    /// The caller's.
    pub context: *mut c_void,
    /// One step: fills in `done`, one for each of `count` tasks, and up to `room` newcomers, whose number goes to `came`.
    /// 0 when more may come, 1 when nobody does any more, -1 when it failed.
    pub step: unsafe extern "C" fn(
        context: *mut c_void,
        step: u64,
        count: u32,
        tasks: *const Task,
        done: *mut Done,
        room: u32,
        newcomers: *mut Newcomer,
        came: *mut u32,
    ) -> c_int,
    /// Puts `count` vehicles where the gates have let them in; `ways` has a pair of zone and path for each hop of each.
    /// 0, or -1 when it failed.
    pub admit: unsafe extern "C" fn(
        context: *mut c_void,
        count: u32,
        vehicles: *mut AdmittedVehicle,
        ways: *const [u32; 2],
    ) -> c_int,
    /// 1 if it brings its vehicles itself.
    pub brings: c_int,
    /// Told once, before anything else, what is played: the scenario as JSON. May be null.
    pub begin: Option<unsafe extern "C" fn(context: *mut c_void, scenario: *const c_char)>,
}

#[derive(Debug)]
struct Called {
    name: String,
    callbacks: Callbacks,
    newcomers: Vec<Newcomer>,
}

impl Traffic for Called {
    fn name(&self) -> String {
        self.name.clone()
    }

    fn begin(&mut self, scenario: &Scenario) {
        let Callbacks { context, begin: Some(call), .. } = self.callbacks else { return };
        let Some(json) = serde_json::to_string(scenario).ok().and_then(|json| CString::new(json).ok()) else {
            return;
        };
        // SAFETY: the string ends with a zero, and outlives the call.
        unsafe { call(context, json.as_ptr()) };
    }

    fn brings(&self) -> bool {
        self.callbacks.brings != 0
    }

    fn step(
        &mut self,
        step: u64,
        tasks: &[Task],
        done: &mut [Done],
        newcomers: &mut Vec<Newcomer>,
    ) -> Result<Coming, TrafficError> {
        let (room, mut came) = (self.newcomers.len() as u32, 0);
        let Callbacks { context, step: call, .. } = self.callbacks;
        let (tasks_at, done_at) = (tasks.as_ptr(), done.as_mut_ptr());
        let to = self.newcomers.as_mut_ptr();
        // SAFETY: the slices are as long as it is told, and outlive the call.
        let result =
            unsafe { call(context, step, tasks.len() as u32, tasks_at, done_at, room, to, &raw mut came) };
        newcomers.extend_from_slice(&self.newcomers[..came.min(room) as usize]);
        match result {
            0 => Ok(Coming::More),
            1 => Ok(Coming::Nobody),
            _ => Err(TrafficError(format!("step {step} failed; what went wrong stands above"))),
        }
    }

    fn admit(&mut self, vehicles: &mut [Admitted]) -> Result<(), TrafficError> {
        let ways: Vec<[u32; 2]> =
            vehicles.iter().flat_map(|v| v.way.iter().map(|&(zone, path)| [zone, path])).collect();
        let plain = vehicles.iter().map(|v| AdmittedVehicle {
            x_m: v.x_m,
            v_mps: v.v_mps,
            vehicle: v.vehicle,
            kind: v.kind,
            road: v.road,
            hops: v.way.len() as u32,
            is_commanded: 1,
            reserved: 0,
        });
        let mut plain: Vec<AdmittedVehicle> = plain.collect();
        let Callbacks { context, admit, .. } = self.callbacks;
        // SAFETY: the lists are as long as it is told, and outlive the call.
        let result = unsafe { admit(context, plain.len() as u32, plain.as_mut_ptr(), ways.as_ptr()) };
        for (vehicle, said) in vehicles.iter_mut().zip(&plain) {
            vehicle.is_commanded = said.is_commanded != 0;
        }
        match result {
            0 => Ok(()),
            _ => Err(TrafficError("vehicles could not be let in; what went wrong stands above".to_owned())),
        }
    }
}

/// A run, or the world of one, whose vehicles the callbacks move: `arguments` are lines with those of `cz`, `run
/// --in-process …` or `world …`. Returns the exit code.
///
/// # Safety
/// The strings end with a zero; the callbacks keep to what they say, and do not call back.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn cz_world_run(
    name: *const c_char,
    arguments: *const c_char,
    callbacks: *const Callbacks,
) -> c_int {
    // SAFETY: as the caller promises.
    let ([name, arguments], callbacks) = unsafe { ([text(name), text(arguments)], *callbacks) };
    let (Some(name), Some(arguments)) = (name, arguments) else { return 2 };
    let called =
        Called { name: name.into_owned(), callbacks, newcomers: vec![Newcomer::default(); MOST_NEWCOMERS] };
    let arguments: Vec<String> = arguments.lines().map(str::to_owned).collect();
    let run = || control_zones::app::played(&arguments, Box::new(called));
    catch_unwind(AssertUnwindSafe(run)).map_or(1, c_int::from)
}

/// A scenario as JSON, as a command line would name it (null: the default one), changed by lines `KEY=VALUE`, to be given
/// back to `cz_env_forget`. Null when it cannot be loaded; `cz_env_error` says why.
///
/// # Safety
/// Every string is null or ends with a zero.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn cz_world_scenario(scenario: *const c_char, sets: *const c_char) -> *mut c_char {
    // SAFETY: as the caller promises.
    let [scenario, sets] = [scenario, sets].map(|string| unsafe { text(string) });
    crate::guarded(null_mut(), || {
        let sets = sets.iter().flat_map(|sets| sets.lines()).map(str::parse);
        let sets = sets.collect::<Result<Vec<Override>, _>>()?;
        let scenario = load(scenario.as_deref(), &sets, None)?;
        let shapes = control_zones::scenario::shapes::Shapes::of(&scenario.network);
        let shapes: Vec<_> =
            (0..scenario.network.zones.len() as u32).map(|zone| shapes.segments(zone).to_vec()).collect();
        let json = serde_json::json!({ "scenario": scenario, "shapes": shapes }).to_string();
        Ok(CString::new(json).map_or(null_mut(), CString::into_raw))
    })
}
