//! Steps as the page gets them: little-endian words, made once and drawn from as they lie.
//!
//! A step is a head of 8 words (step, vehicles, misses low and high, flags, state hash low and high, 0) and 9 words per
//! vehicle: number, zone, path or link, then as 32-bit floats position, speed, acceleration commanded (or driven on a
//! link), length; then four bytes mode, verdict, kind, flags; then the binding rows.

use control_zones::step::Step;
use ipc_schemas::{NO_ZONE, VehicleCommand};

/// Flag of a vehicle that has a command in this step.
const COMMANDED: u8 = 0x80;

/// Appends a step.
pub fn encode(step: &Step, bytes: &mut Vec<u8>) {
    let mut commands: Vec<&VehicleCommand> = step.commands.iter().flat_map(|part| &part.records).collect();
    commands.sort_unstable_by_key(|command| command.vehicle);
    let present = || step.state.iter().filter(|s| !s.has_left());
    let head = [
        step.header.step as u32,
        present().count() as u32,
        step.misses as u32,
        (step.misses >> 32) as u32,
        step.header.flags,
        step.state_hash as u32,
        (step.state_hash >> 32) as u32,
        0,
    ];
    bytes.extend(head.iter().flat_map(|word| word.to_le_bytes()));
    for state in present() {
        let command =
            commands.binary_search_by_key(&state.vehicle, |c| c.vehicle).ok().map(|at| commands[at]);
        let place = if state.zone == NO_ZONE { state.link } else { state.path };
        for word in [state.vehicle, state.zone, place] {
            bytes.extend(word.to_le_bytes());
        }
        let u_mps2 = command.map_or(state.u_mps2, |c| c.u_mps2);
        for value in [state.x_m, state.v_mps, u_mps2, state.length_m] {
            bytes.extend((value as f32).to_le_bytes());
        }
        let byte = |value: u16| value.min(255) as u8;
        let (mode, verdict) = command.map_or((0, 0), |c| (byte(c.mode), byte(c.verdict)));
        let flags = byte(state.flags & 0x7f) | if command.is_some() { COMMANDED } else { 0 };
        bytes.extend([mode, verdict, byte(state.kind), flags]);
        bytes.extend(command.map_or(0, |c| c.binding_rows).to_le_bytes());
    }
}
