//! For the fuzzer: bytes that are nearly a recording, with all checksums set right.

use super::block::{BLOCK_MAGIC, BlockHead, HEAD};
use super::format::{
    Digest, END_MAGIC, EndHead, FILE_MAGIC, FORMAT_VERSION, FileHead, Metadata, Seal, Tail, digest, padded,
    unpadded,
};
use crate::scenario::{kept, scenario_hash};
use xxhash_rust::xxh3::xxh3_64;
use zerocopy::{FromBytes, IntoBytes};

/// A recording made of these bytes: head, metadata, blocks and end are taken where they would be, and sealed
/// as the writer would.
pub fn reseal(bytes: &[u8]) -> Vec<u8> {
    let Ok((head, rest)) = FileHead::read_from_prefix(bytes) else { return Vec::new() };
    let length = (head.metadata as usize).min(rest.len());
    let (metadata, mut rest) = rest.split_at(length);
    let metadata = truthful(metadata);
    let mut out = Vec::new();
    let head = FileHead::new(ipc_schemas::schema_hash(), &metadata);
    debug_assert_eq!((head.magic, head.version), (FILE_MAGIC, FORMAT_VERSION));
    out.extend_from_slice(head.as_bytes());
    out.extend_from_slice(&metadata);
    let mut link = head.digest;
    while let Ok((mut head, _)) = BlockHead::read_from_prefix(rest) {
        if rest.starts_with(&END_MAGIC) {
            break;
        }
        head.magic = BLOCK_MAGIC;
        head.header.schema_hash = ipc_schemas::schema_hash();
        head.seal();
        let own = usize::try_from(head.length).unwrap_or(usize::MAX).min(rest.len());
        let mut block = rest[..own].to_vec();
        block[..HEAD].copy_from_slice(head.as_bytes());
        let seal = Seal::new(&link, &block);
        link = seal.link;
        out.extend_from_slice(&block);
        out.extend_from_slice(seal.as_bytes());
        rest = rest.get(own + size_of::<Seal>()..).unwrap_or_default();
    }
    if let Ok((mut head, _)) = EndHead::read_from_prefix(rest)
        && head.magic == END_MAGIC
    {
        let at = out.len() as u64;
        head.check = head.checksum();
        let section = head.section().and_then(|n| usize::try_from(n).ok()).unwrap_or(usize::MAX);
        let mut body = rest[..section.saturating_sub(size_of::<Digest>()).min(rest.len())].to_vec();
        if body.len() >= size_of::<EndHead>() {
            body[..size_of::<EndHead>()].copy_from_slice(head.as_bytes());
        }
        let seal = digest(&[&body]);
        for piece in [&body[..], &seal, Tail::new(at).as_bytes()] {
            out.extend_from_slice(piece);
        }
    }
    out
}

/// The metadata with what depends on the scenario set right, if it can be read.
fn truthful(bytes: &[u8]) -> Vec<u8> {
    let Ok(mut metadata) = unpadded::<Metadata>(bytes) else { return bytes.to_vec() };
    if let Ok(scenario) = kept(&metadata.scenario) {
        metadata.scenario_hash = scenario_hash(&scenario);
        metadata.seed = scenario.seed;
        metadata.dt_ns = scenario.dt_ns;
    } else {
        metadata.scenario_hash = xxh3_64(&metadata.scenario);
    }
    padded(&metadata)
}
