//! Files that are cut off, damaged or forged.

use super::*;
use control_zones::record::{Stop, replay};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

#[test]
fn a_file_cut_off_anywhere_reads_to_its_last_whole_step() {
    let run = small();
    let count = run.steps.len();
    for cut in run.offsets[count - 2]..run.bytes.len() {
        let what = format!("cut at {cut}");
        let bytes = &run.bytes[..cut];
        let (steps, flaws) = honest(&run, bytes, &what).expect("the head is there");
        let whole = run.offsets[1..].iter().filter(|end| **end <= cut).count() as u64;
        assert_eq!(steps, whole, "{what}");
        let at_a_border = run.offsets.contains(&cut);
        match &flaws[..] {
            [] => assert!(at_a_border, "{what}"),
            // Behind the last step it is the index or the footer that is cut.
            [Flaw::CutOff] => assert!(!at_a_border, "{what}"),
            [Flaw::End] => assert!(cut > run.offsets[count], "{what}"),
            other => panic!("{what}: {other:?}"),
        }
        let reader = Reader::new(bytes).unwrap();
        assert!(reader.footer().is_none() || flaws == [Flaw::End], "{what}");
        for number in whole.saturating_sub(2)..whole {
            assert_eq!(reader.step(number).unwrap().as_ref(), run.steps.get(number as usize), "{what}");
        }
        assert_eq!(reader.step(whole), Ok(None), "{what}");
    }
    // And what is there still replays.
    let result = replay(&Reader::new(&run.bytes[..run.offsets[count - 1] + 9]).unwrap(), |_| {});
    assert!(result.same());
    assert!(matches!(result.stopped, Some(Stop::Damage(d)) if d.flaw == Flaw::CutOff));
    assert_eq!(result.steps, count as u64 - 1);
}

#[test]
fn a_wrong_byte_anywhere_is_noticed_and_spoils_one_step_at_most() {
    let run = small();
    let count = run.steps.len() as u64;
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let mut refused = 0;
    for _ in 0..10_000 {
        let at = random.random_range(0..run.bytes.len());
        let flip = random.random_range(1..=255_u8);
        let what = format!("byte {at} xor {flip}");
        let mut bytes = run.bytes.clone();
        bytes[at] ^= flip;
        let Some((steps, flaws)) = honest(&run, &bytes, &what) else {
            assert!(at < run.offsets[0], "{what}: refused to open");
            refused += 1;
            continue;
        };
        assert!(!flaws.is_empty(), "{what}: not noticed");
        let in_a_step = at < *run.offsets.last().unwrap();
        assert_eq!(steps, if in_a_step { count - 1 } else { count }, "{what}: {flaws:?}");
        // A step asked for by itself is there exactly if it is among all, also the next ones.
        let reader = Reader::new(&bytes[..]).unwrap();
        let hit = run.offsets.partition_point(|offset| *offset <= at).saturating_sub(1);
        let number = (hit + random.random_range(0..3)).min(count as usize - 1);
        let is_there = reader.steps().flatten().any(|step| step.header.step == number as u64);
        match reader.step(number as u64) {
            Ok(Some(step)) => assert!(is_there && run.steps[number] == step, "{what}: step {number}"),
            missing => assert!(!is_there, "{what}: step {number}: {missing:?}"),
        }
    }
    assert!(refused > 0, "the head was never hit");
}

#[test]
fn exchanged_and_forged_steps_are_noticed() {
    let run = small();
    let other = run.with(|steps| steps[50].state[0].x_m += 1.0);
    // A forged step, sealed as if it had been written there: everything after it tells.
    let range = run.offsets[50]..run.offsets[51];
    let mut bytes = run.bytes.clone();
    bytes[range.clone()].copy_from_slice(&other.bytes[range.clone()]);
    let reader = Reader::new(&bytes[..]).unwrap();
    assert!(matches!(reader.step(51), Err(d) if d.flaw == Flaw::Chain));
    let first = reader.steps().find_map(Result::err).unwrap();
    assert_eq!((first.flaw, first.after), (Flaw::Chain, Some(50)));
    assert!(matches!(replay(&reader, |_| {}).stopped, Some(Stop::Damage(_))));
    // The rest of the other recording as well: the links fit, the footer does not.
    bytes[run.offsets[50]..*run.offsets.last().unwrap()]
        .copy_from_slice(&other.bytes[run.offsets[50]..*run.offsets.last().unwrap()]);
    let reader = Reader::new(&bytes[..]).unwrap();
    let damage: Vec<_> = reader.steps().filter_map(Result::err).map(|d| d.flaw).collect();
    assert_eq!(damage, [Flaw::Footer]);
    // Two steps exchanged.
    let mut swapped = run.bytes[..run.offsets[0]].to_vec();
    for i in [0, 2, 1] {
        swapped.extend_from_slice(&run.bytes[run.offsets[i]..run.offsets[i + 1]]);
    }
    let reader = Reader::new(&swapped[..]).unwrap();
    assert_eq!(reader.steps().filter_map(Result::err).map(|d| d.flaw).next(), Some(Flaw::Chain));
}

#[test]
fn a_tail_that_points_beyond_the_file_is_damage() {
    let run = small();
    let mut bytes = run.bytes.clone();
    let tail = bytes.len() - 24;
    bytes[tail + 8..tail + 16].copy_from_slice(&(1_u64 << 40).to_le_bytes());
    let check = xxhash_rust::xxh3::xxh3_64(&bytes[tail..tail + 16]);
    bytes[tail + 16..].copy_from_slice(&check.to_le_bytes());
    let (steps, flaws) = honest(&run, &bytes, "tail beyond the end").unwrap();
    assert_eq!((steps, &flaws[..]), (run.steps.len() as u64, &[Flaw::End][..]));
}
