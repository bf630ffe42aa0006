//! A short run, recorded once, that targets start from.

#![allow(dead_code)] // every target uses its part of this

use control_zones::lockstep::in_process::InProcess;
use control_zones::record::{Metadata, Processes, Reader, RunEnd, ScenarioSource, Step, Writer};
use control_zones::scenario::{Override, load};
use std::sync::{Arc, LazyLock};

/// The run: its metadata and steps.
pub static RUN: LazyLock<(Metadata, Vec<Step>)> = LazyLock::new(|| {
    let sets: Vec<Override> = ["end.time_s=10", "end.vehicles=6"]
        .iter()
        .map(|set| set.parse().expect("the set is well formed"))
        .collect();
    let scenario = Arc::new(load(Some("paper"), &sets, None).expect("the scenario is embedded"));
    let processes = Processes { coordinators: 2, controllers: 2 };
    let mut metadata = Metadata::new(&scenario, ScenarioSource::default(), InProcess::RUN_ID, processes);
    metadata.created_unix_s = 0;
    let mut run = InProcess::observed(&scenario, 2, 2);
    let mut steps = Vec::new();
    loop {
        let goes_on = run.step().expect("the run goes well");
        let take = |frames: &control_zones::record::StepFrames<'_>| {
            let mut block = Vec::new();
            frames.encode_onto(&mut block);
            steps.push(Step::decode(&block).expect("a block of ours can be decoded"));
        };
        run.frames(take).expect("taps do not fail");
        if !goes_on {
            return (metadata, steps);
        }
    }
});

/// A recording of these steps.
pub fn recording(metadata: &Metadata, steps: &[Step]) -> Vec<u8> {
    let mut writer = Writer::new(Vec::new(), metadata).expect("memory takes everything");
    for step in steps {
        // Steps out of order are refused, which is right.
        let _ = writer.append(&step.encode());
    }
    writer.finish(RunEnd::Finished, Vec::new()).expect("memory takes everything").0
}

/// The whole run's recording.
pub static RECORDING: LazyLock<Vec<u8>> = LazyLock::new(|| recording(&RUN.0, &RUN.1));

/// Its reader.
pub fn reader() -> Reader<&'static [u8]> {
    Reader::new(&RECORDING[..]).expect("our own recording opens")
}

/// Bytes of the input, one value after the other; zeros behind its end.
pub struct Bytes<'a>(pub &'a [u8]);

impl Bytes<'_> {
    pub fn byte(&mut self) -> u8 {
        let Some((first, rest)) = self.0.split_first() else { return 0 };
        self.0 = rest;
        *first
    }

    pub fn word(&mut self) -> u64 {
        u64::from_le_bytes(std::array::from_fn(|_| self.byte()))
    }

    pub fn index(&mut self, length: usize) -> usize {
        usize::from(u16::from_le_bytes([self.byte(), self.byte()])) % length.max(1)
    }

    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Overwrites a field of one record with a value from the input: a word of it, or a telling number.
    pub fn spoil<R: ipc_schemas::Record>(&mut self, records: &mut Vec<R>) {
        const TELLING: [f64; 8] =
            [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 0.0, -0.0, 1e308, -1e308, 5e-324];
        let at = self.index(records.len());
        let choice = self.byte();
        match choice {
            0 if !records.is_empty() => drop(records.remove(at)),
            1 if !records.is_empty() => records.insert(at, records[at]),
            2 => records.insert(at.min(records.len()), R::default()),
            3 => {
                let other = self.index(records.len());
                if !records.is_empty() {
                    records.swap(at, other);
                }
            }
            _ if records.is_empty() => {}
            _ => {
                let fields = R::LAYOUT.fields;
                let field = fields[self.index(fields.len())];
                let telling = TELLING[usize::from(choice) % TELLING.len()].to_bits();
                let value = if choice & 0x40 == 0 { self.word() } else { telling };
                let mut bytes = ipc_schemas::bytes_of(&records[at..=at]).to_vec();
                let size = field.scalar.size();
                bytes[field.offset..field.offset + size].copy_from_slice(&value.to_le_bytes()[..size]);
                records[at] = ipc_schemas::records_from(&bytes).expect("one record")[0];
            }
        }
    }
}
