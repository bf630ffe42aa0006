//! Recordings from anybody: whatever the bytes, reading, showing, comparing and replaying come to an end.
//!
//! First byte: 0, the rest is a file as it is; 1, the same with all checksums set right, so that what is
//! behind them is reached; 2, the rest says how to spoil the records of a recording of ours.

#![no_main]

mod common;

use common::{Bytes, RUN, recording};
use control_zones::app::show_everything;
use control_zones::record::{Reader, compare, replay, replay_world, reseal};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let Some((kind, rest)) = bytes.split_first() else { return };
    match kind % 3 {
        0 => try_everything(rest),
        1 => try_everything(&reseal(rest)),
        _ => {
            let mut input = Bytes(rest);
            let (metadata, mut steps) = RUN.clone();
            steps.truncate(40);
            while !input.is_empty() {
                let at = input.index(steps.len());
                let step = &mut steps[at];
                match input.byte() % 8 {
                    0 => input.spoil(&mut step.state),
                    1 => input.spoil(&mut step.summaries),
                    2 => input.spoil(&mut step.coordination),
                    3 | 4 => {
                        let part = input.index(step.commands.len());
                        if let Some(part) = step.commands.get_mut(part) {
                            input.spoil(&mut part.records);
                        }
                    }
                    5 => {
                        let mut headers = vec![step.header];
                        input.spoil(&mut headers);
                        step.header = headers.first().copied().unwrap_or_default();
                    }
                    6 => step.misses ^= input.word(),
                    _ => drop(step.commands.pop()),
                }
            }
            try_everything(&recording(&metadata, &steps));
        }
    }
});

fn try_everything(bytes: &[u8]) {
    let Ok(reader) = Reader::new(bytes) else { return };
    for step in reader.steps().flatten() {
        assert_eq!(
            reader.step(step.header.step).ok().flatten().map(|s| s.header.step),
            Some(step.header.step)
        );
    }
    let result = replay(&reader, |_| {});
    if result.same() && result.stopped.is_none() {
        // The world is one of the roles.
        let until = reader.step_numbers().next_back();
        assert!(until.is_none_or(|until| replay_world(&reader, until).is_ok()));
    }
    assert!(show_everything(&reader) > 0);
    // Against ours, up to the first difference; a recording never differs from itself.
    assert!(compare(&reader, &common::reader()).steps <= RUN.1.len() as u64);
    assert!(compare(&reader, &reader).difference.is_none());
}
