//! What is exported is read back by other people's readers, with the run's vehicles and energies in it.
//!
//! The readers are Python packages: eclipse-sumo, lxml, pyarrow, polars, mcap, jsonschema, perfetto. Where one is
//! missing (in the Python that `CZ_PYTHON` names, `python3` by default) its test says so and passes.

#![allow(clippy::unwrap_used)]

mod common;

use common::Recording;
use cz_export::export::{Format, write};
use serde_json::Value;
use std::path::Path;
use std::process::{Command, Stdio};

/// Writes a recording and has it read; `None` where there is no reader.
fn read_back(recording: &Recording, format: Format, name: &str) -> Option<Value> {
    let out = recording.directory().join(name);
    let ended = write(&recording.reader(), format, &out).unwrap();
    assert_eq!((ended.steps, ended.lost, ended.damage.len()), (recording.steps, None, 0));
    assert_eq!(ended.summary.as_ref(), Some(&recording.summary));
    read_by(&format!("{format:?}").to_lowercase(), &out)
}

/// Has a file read; `None` where there is no reader.
fn read_by(what: &str, file: &Path) -> Option<Value> {
    let python = std::env::var("CZ_PYTHON").unwrap_or_else(|_| "python3".to_owned());
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/readers.py");
    let output = Command::new(&python).arg(script).arg(what).arg(file).stdin(Stdio::null()).output();
    let said = |bytes: &[u8]| String::from_utf8_lossy(bytes).trim().to_owned();
    match output {
        Ok(output) if output.status.success() => Some(serde_json::from_slice(&output.stdout).unwrap()),
        Ok(output) if output.status.code() == Some(3) => {
            eprintln!("not read back: {python}: {}", said(&output.stderr));
            None
        }
        Ok(output) => panic!("{what} cannot be read: {}", said(&output.stderr)),
        Err(error) => {
            eprintln!("not read back: {python}: {error}");
            None
        }
    }
}

fn near(value: &Value, expected: f64) -> bool {
    value.as_f64().is_some_and(|value| (value - expected).abs() <= 1e-9 * expected.abs().max(1.0))
}

#[test]
fn sumo_reads_floating_car_data() {
    for recording in
        [Recording::of("paper", &["end.vehicles=40"]), Recording::of("corridor-8", &["end.vehicles=30"])]
    {
        let Some(said) = read_back(&recording, Format::Fcd, "a.xml") else { return };
        assert_eq!(said["vehicles"], recording.summary.arrived, "{said}");
        assert_eq!(said["steps"], recording.steps);
        assert_eq!(said["invalid"], "", "SUMO's schema");
        assert!(said["lines_of_xml2csv"].as_u64() > Some(recording.steps));
        // The part of a step in which a vehicle leaves the network is in no sample, and links are in no zone's energy.
        if recording.links == 0 {
            let energy = said["energy"].as_f64().unwrap();
            let u_mps2 = 3.0_f64.max(-recording.u_min_mps2);
            let at_most = f64::from(recording.summary.arrived) * 0.5 * u_mps2 * u_mps2 * recording.dt_s;
            assert!((energy - recording.energy).abs() < at_most, "{energy} of {}", recording.energy);
        }
    }
}

#[test]
fn sumo_reads_trips() {
    let recording = Recording::of("paper", &["end.time_s=100"]);
    let Some(said) = read_back(&recording, Format::Tripinfo, "a.xml") else { return };
    assert_eq!(
        (&said["vehicles"], &said["arrived"]),
        (&recording.summary.arrived.into(), &recording.summary.departed.into())
    );
    assert!(recording.summary.arrived > recording.summary.departed, "some are still inside");
    assert!(near(&said["energy"], recording.energy), "{said} has not {}", recording.energy);
    assert_eq!(said["invalid"], "", "SUMO's schema");
    assert!(
        said["stats"].as_str().unwrap().contains(&format!("count {}", recording.summary.arrived)),
        "{said}"
    );
}

#[test]
fn sumo_reads_conflicts() {
    let recording = Recording::of("paper", &["end.vehicles=60"]);
    let Some(said) = read_back(&recording, Format::Ssm, "a.xml") else { return };
    assert!(said["conflicts"].as_u64() > Some(0), "dense traffic has conflicts: {said}");
    assert_eq!(said["spans_agree"], true);
    assert!(said["min_ttc"].as_f64().is_none_or(|ttc| ttc > 0.0 && ttc < 3.0), "{said}");
}

#[test]
fn polars_reads_tables() {
    let recording = Recording::of("roundabout", &["end.vehicles=20"]);
    let Some(said) = read_back(&recording, Format::Csv, "a") else { return };
    tables(&recording, &said);
}

#[test]
fn pyarrow_reads_tables_with_units() {
    let recording = Recording::of("paper", &["end.vehicles=40"]);
    let Some(said) = read_back(&recording, Format::Parquet, "a") else { return };
    tables(&recording, &said);
    let unit = |name: &str| said["units"][name].as_str().unwrap().to_owned();
    assert_eq!(
        (unit("x_m"), unit("v_mps"), unit("u_mps2"), unit("time_s")),
        ("m".into(), "m/s".into(), "m/s^2".into(), "s".into())
    );
    assert_eq!(unit("vehicle"), "");
    assert_eq!(said["described"], true);
    assert!(said["rows"].as_object().unwrap().values().all(|rows| rows.as_u64() > Some(0)), "{said}");
}

fn tables(recording: &Recording, said: &Value) {
    let summary = &recording.summary;
    assert_eq!((&said["vehicles"], &said["seen"]), (&summary.arrived.into(), &summary.arrived.into()));
    assert_eq!(said["departed"], summary.departed);
    let visits: u32 = summary.zones.iter().map(|zone| zone.vehicles).sum();
    assert_eq!(said["visits"], visits);
    assert!(near(&said["energy"], recording.energy), "{said} has not {}", recording.energy);
    assert!(near(&said["energy_of_vehicles"], recording.energy));
}

#[test]
fn mcap_reads_scenes() {
    let recording = Recording::of("intersection", &["end.vehicles=30"]);
    let Some(said) = read_back(&recording, Format::Mcap, "a.mcap") else { return };
    assert_eq!(said["invalid"], serde_json::json!([]), "the publisher's schemas");
    assert_eq!(said["vehicles"], recording.summary.arrived);
    assert_eq!(said["lengths"], serde_json::json!([recording.length_m]));
    assert!(near(&said["energy"], recording.energy), "{} has not {}", said["energy"], recording.energy);
    assert_eq!(said["topics"]["/scene"][0], "foxglove.SceneUpdate");
    assert_eq!(said["topics"]["/scene"][2], recording.steps);
    assert_eq!(said["topics"]["/network"][2], 1);
    assert_eq!(said["run"]["scenario"], "intersection");
}

#[test]
fn perfetto_reads_the_trace() {
    let recording = Recording::of("paper", &["end.vehicles=40"]);
    let Some(said) = read_back(&recording, Format::Perfetto, "a.perfetto-trace") else { return };
    assert_eq!((&said["wrong"], &said["open"]), (&serde_json::json!([]), &0.into()), "{said}");
    assert_eq!(said["vehicles"], recording.summary.departed);
    assert!(near(&said["energy"], recording.energy), "{said} has not {}", recording.energy);
    assert!(said["counters"].as_u64() > Some(0) && said["inner"].as_u64() > Some(0), "{said}");
}

#[test]
fn perfetto_reads_what_processes_did() {
    let program = Path::new(env!("CARGO_BIN_EXE_cz-export")).with_file_name("cz");
    if !program.is_file() {
        eprintln!(
            "{} is not built: no run can be traced (cargo test --workspace builds it)",
            program.display()
        );
        return;
    }
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("a.json");
    let run = Command::new(program)
        .args(["run", "--set", "end.vehicles=10", "--json", "-", "--trace"])
        .arg(&file)
        .output()
        .unwrap();
    assert!(run.status.success(), "{run:?}");
    let summary: Value = serde_json::from_slice(&run.stdout).unwrap();
    let Some(said) = read_by("processes", &file) else { return };
    assert_eq!(said["lost"], 0, "{said}");
    assert_eq!(said["spans"]["controller 0: publish"], summary["steps"], "{said}");
    for name in
        ["world: compute", "world: publish", "world: wait", "coordinator 0: wait", "controller 0: compute"]
    {
        assert!(said["spans"][name].as_u64() > Some(0), "{name}: {said}");
    }
}
