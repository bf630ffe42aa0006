//! The recorder: what is left out when it cannot keep up, and what it leaves.

use super::*;
use control_zones::record::{
    CommandPart, Output, QueueLimits, Recorder, ReplayError, Stop, compare, replay, replay_world,
};
use std::io;
use std::sync::{Condvar, Mutex};

/// An output that writes nothing until it is let.
#[derive(Clone, Default)]
struct Gated(Arc<Gate>);

impl Gated {
    fn open(&self) {
        self.0.state.lock().unwrap().0 = true;
        self.0.opened.notify_all();
    }

    fn bytes(&self) -> Vec<u8> {
        self.0.state.lock().unwrap().1.clone()
    }
}

impl io::Write for Gated {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let mut inner = self.0.opened.wait_while(self.0.state.lock().unwrap(), |(open, _)| !*open).unwrap();
        inner.1.extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Output for Gated {
    fn sync(&mut self) -> io::Result<()> {
        Ok(())
    }
}

#[derive(Default)]
struct Gate {
    /// Whether it is open, and what has passed.
    state: Mutex<(bool, Vec<u8>)>,
    opened: Condvar,
}

#[test]
fn steps_that_come_too_fast_are_left_out_and_reported() {
    let run = small();
    let out = Gated::default();
    let limits = QueueLimits { steps: 4, bytes: 1 << 30 };
    let mut recorder = Recorder::over(out.clone(), run.metadata.clone(), limits);
    let mut refused = Vec::new();
    // Steps 90 to 94 are never even offered.
    for step in run.steps.iter().filter(|s| !(90..95).contains(&s.header.step)) {
        if step.header.step == 120 {
            out.open();
        }
        if step.header.step >= 120 {
            let commands: Vec<_> = step
                .commands
                .iter()
                .map(|c| CommandPart { generation: c.generation, records: &c.records })
                .collect();
            let frames = control_zones::record::StepFrames {
                header: step.header,
                state: &step.state,
                summaries: &[&step.summaries],
                coordination: &[&step.coordination],
                commands: &commands,
                feedback: &[],
                misses: step.misses,
                policy: step.policy,
                state_hash: step.state_hash,
            };
            assert!(recorder.push_or_wait(&frames), "whoever waits is let in");
        } else if !recorder.push_block(step.header.step, &step.encode()) {
            refused.push(step.header.step);
        }
    }
    refused.extend(90..95);
    refused.sort_unstable();
    assert!(refused.len() > 20, "{refused:?}");
    let recorded = recorder.finish(RunEnd::Finished).unwrap();
    let missing: Vec<u64> = recorded.missing.iter().flat_map(|(first, last)| *first..=*last).collect();
    assert_eq!(missing, refused);
    assert_eq!(recorded.missing_steps(), refused.len() as u64);
    let bytes = out.bytes();
    assert_eq!(bytes.len() as u64, recorded.bytes);
    let reader = Reader::new(&bytes[..]).unwrap();
    assert_eq!(reader.footer().unwrap().missing, recorded.missing);
    assert_eq!(reader.gaps(), recorded.missing);
    let (steps, flaws) = honest(&run, &bytes, "with gaps").unwrap();
    assert_eq!((steps, flaws), (recorded.steps, vec![]));
    // Nothing is replayed behind the gap.
    let result = replay(&reader, |_| {});
    assert_eq!(result.stopped, Some(Stop::Gap(recorded.missing[0].0)));
    assert!(result.same());
    assert!(matches!(replay_world(&reader, 150), Err(ReplayError::Missing(step)) if step == refused[0]));
    // The whole recording has more.
    let found = compare(&reader, &run.reader());
    assert_eq!((found.only_first, found.only_second), (0, refused.len() as u64));
    assert!(!found.same() && found.difference.is_none());
}

#[test]
fn a_recorder_that_is_dropped_leaves_what_it_had() {
    let run = small();
    let out = Gated::default();
    out.open();
    let mut recorder = Recorder::over(out.clone(), run.metadata.clone(), QueueLimits::default());
    for step in &run.steps[..40] {
        assert!(recorder.push_block(step.header.step, &step.encode()));
    }
    drop(recorder);
    crate::common::wait_until("the recorder's thread to end", || Arc::strong_count(&out.0) == 1);
    let bytes = out.bytes();
    let (steps, flaws) = honest(&run, &bytes, "dropped").unwrap();
    assert_eq!((steps, flaws), (40, vec![]));
    assert!(Reader::new(&bytes[..]).unwrap().footer().is_none());
}

/// An output that is full after so many bytes.
struct Full(usize);

impl io::Write for Full {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0 = self.0.checked_sub(bytes.len()).ok_or(io::ErrorKind::StorageFull)?;
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Output for Full {
    fn sync(&mut self) -> io::Result<()> {
        Ok(())
    }
}

#[test]
fn a_full_disk_is_an_error_at_the_end_and_stops_nobody() {
    let run = small();
    let mut recorder = Recorder::over(Full(1 << 19), run.metadata.clone(), QueueLimits::default());
    for round in 0..20 {
        for step in &run.steps {
            let number = round * run.steps.len() as u64 + step.header.step;
            let mut step = step.clone();
            step.header.step = number;
            recorder.push_block(number, &step.encode());
        }
    }
    let error = recorder.finish(RunEnd::Finished).unwrap_err().to_string();
    assert!(error.contains("cannot write the recording"), "{error}");
}
