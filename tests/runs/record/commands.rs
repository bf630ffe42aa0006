//! What the commands say of a recording.

use super::*;
use crate::common::TestRun;
use std::os::unix::fs::PermissionsExt;

#[test]
fn a_recording_of_another_version_is_refused_by_all_who_read_it() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("old.czlog");
    let name = file.to_str().unwrap();
    for (found, version) in [(1_u32, "1"), (2, "2"), (4, "4"), (u32::MAX, "4294967295")] {
        let mut bytes = small().bytes;
        bytes[8..12].copy_from_slice(&found.to_le_bytes());
        std::fs::write(&file, &bytes).unwrap();
        for arguments in [
            &["show", name][..],
            &["verify", name, name],
            &["replay", name],
            &["resume", name],
            &["branch", name, "--at", "5", "--set", "objective.beta=1.0"],
        ] {
            let output = TestRun::new("old").command("cz").args(arguments).output().unwrap();
            let said = String::from_utf8(output.stderr).unwrap();
            let expected = format!(
                "cz: {name}: the recording has format version {version}, this program reads version 3\n"
            );
            assert_eq!((output.status.code(), said), (Some(2), expected), "{arguments:?}");
        }
    }
}

#[test]
fn the_commands_tell_what_is_in_a_file() {
    let test_run = TestRun::new("rec");
    let directory = tempfile::tempdir().unwrap();
    let path = |name: &str| directory.path().join(name).to_str().unwrap().to_owned();
    let cz = |arguments: &[&str]| {
        let output = test_run.command("cz").args(arguments).output().unwrap();
        let text = |bytes| String::from_utf8(bytes).unwrap();
        (output.status.code().unwrap(), text(output.stdout), text(output.stderr))
    };
    let (file, other) = (path("a.czlog"), path("b.czlog"));
    let record = |file: &str, arguments: &[&str]| {
        let all = ["run", "--in-process", "--set", "end.vehicles=12", "--json", "-", "--record", file];
        let (code, out, err) = cz(&[&all[..], arguments].concat());
        assert_eq!(code, 0, "{err}");
        assert!(err.contains("recorded") && err.contains(file), "{err}");
        crate::common::hash(&serde_json::from_str(&out).unwrap())
    };
    let hash = record(&file, &[]);
    assert_eq!(record(&other, &["--coord-procs", "2", "--ctrl-procs", "2"]), hash);
    let mode = |path: &str| std::fs::metadata(path).unwrap().permissions().mode() & 0o777;
    assert_eq!(mode(&file), 0o600);

    let (code, out, _) = cz(&["show", &file]);
    assert_eq!(code, 0);
    for word in ["two-merges", "seed 1", "end.vehicles=12", "1 controller", &hash, "every step checked"] {
        assert!(out.contains(word), "no {word:?} in {out}");
    }
    let json = |arguments: &[&str]| -> serde_json::Value {
        let (code, out, err) = cz(arguments);
        assert_eq!(code, 0, "{err}");
        serde_json::from_str(&out).unwrap()
    };
    let shown = json(&["show", &other, "--json"]);
    assert_eq!(shown["state_hash"], hash);
    assert_eq!(shown["whole"], true);
    let step = json(&["show", &file, "--step", "200", "--json"]);
    let reader = Reader::open(file.as_ref()).unwrap();
    let recorded = reader.step(200).unwrap().unwrap();
    assert_eq!(step["state"].as_array().unwrap().len(), recorded.state.len());
    assert_eq!(step["state"][0]["x_m"].as_f64(), Some(recorded.state[0].x_m));
    let (_, out, _) = cz(&["show", &file, "--step", "200"]);
    assert!(out.contains("merge-1.main") && out.contains("verdict"), "{out}");
    let vehicle = recorded.commands[0].records[0].vehicle.to_string();
    let course = json(&["show", &file, "--vehicle", &vehicle, "--json"]);
    assert!(course["course"].as_array().unwrap().iter().any(|row| row["step"] == 200), "{course}");
    let (_, out, _) = cz(&["show", &file, "--vehicle", &vehicle]);
    assert!(out.contains("scheduled"), "{out}");
    let (_, out, _) = cz(&["show", &file, "--scenario"]);
    assert!(out.contains("--set end.vehicles=12") && out.contains("[[zones]]"), "{out}");

    assert_eq!(cz(&["verify", &file, &other]).0, 0);
    let (code, out, _) = cz(&["replay", &other]);
    assert_eq!(code, 0, "{out}");
    assert!(out.contains("coordinator 1") && out.contains(&hash), "{out}");
    assert_eq!(json(&["replay", &file, "--json"])["same"], true);

    // Another seed is another run.
    record(&other, &["--seed", "2"]);
    let (code, out, err) = cz(&["verify", &file, &other]);
    assert_eq!(code, 1, "{out}");
    assert!(out.contains("scenarios differ") && out.contains("first difference: step 1, vehicle 0"), "{out}");
    assert!(err.contains("differ"), "{err}");

    // Damage and a cut.
    let mut bytes = std::fs::read(&file).unwrap();
    bytes.truncate(bytes.len() * 2 / 3);
    std::fs::write(&other, &bytes).unwrap();
    let (code, out, _) = cz(&["show", &other]);
    assert!(code == 0 && out.contains("cut off") && out.contains("whole       no"), "{out}");
    assert_eq!(cz(&["replay", &other]).0, 0);
    assert_eq!(cz(&["verify", &file, &other]).0, 1);
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    std::fs::write(&other, &bytes).unwrap();
    for command in [&["show", &other][..], &["replay", &other], &["verify", &file, &other]] {
        let (code, _, err) = cz(command);
        assert!(code == 2 && err.contains("damaged at byte"), "{command:?}: {err}");
    }

    // What is no recording is neither read nor replaced.
    let text = path("notes.txt");
    std::fs::write(&text, "notes").unwrap();
    assert_eq!(cz(&["show", &text]).0, 2);
    let (code, _, err) = cz(&["run", "--in-process", "--record", &text]);
    assert!(code == 2 && err.contains("not a recording"), "{err}");
    assert_eq!(std::fs::read_to_string(&text).unwrap(), "notes");
    // One that others may read is replaced by one they may not.
    std::fs::set_permissions(&other, PermissionsExt::from_mode(0o644)).unwrap();
    record(&other, &[]);
    assert_eq!(mode(&other), 0o600);
    for arguments in [&["show", &file, "--step", "99999"][..], &["show", &file, "--vehicle", "99999"]] {
        let (code, _, err) = cz(arguments);
        assert!(code == 2 && err.contains("99999"), "{err}");
    }
}

/// The recording with other metadata, sealed again.
fn with_metadata(run: &Run, change: impl FnOnce(&mut Metadata)) -> Vec<u8> {
    let mut metadata = run.metadata.clone();
    change(&mut metadata);
    Run::of(metadata, run.steps.clone(), run.state_hash).bytes
}

#[test]
fn a_recording_of_another_build_is_read_and_named() {
    let (test_run, directory) = (TestRun::new("build"), tempfile::tempdir().unwrap());
    let file = directory.path().join("other.czlog");
    let name = file.to_str().unwrap();
    let other = with_metadata(&small(), |metadata| {
        metadata.build.version = "0.0.9".to_owned();
        metadata.build.commit = "0123456789ab".to_owned();
    });
    std::fs::write(&file, other).unwrap();
    for arguments in [&["show", name][..], &["verify", name, name], &["replay", name]] {
        let output = test_run.command("cz").args(arguments).output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.success(), "{said}");
        assert!(said.contains("written by control-zones 0.0.9 (commit 0123456789ab"), "{said}");
        assert!(said.contains(&format!("this is control-zones {}", env!("CARGO_PKG_VERSION"))), "{said}");
    }
    std::fs::write(&file, small().bytes).unwrap();
    let output = test_run.command("cz").args(["show", name]).output().unwrap();
    assert!(output.stderr.is_empty(), "{output:?}");
}

#[test]
fn a_recording_with_other_fields_is_refused_by_their_names() {
    use ciborium::Value;
    let run = small();
    let text = |name: &str| Value::Text(name.to_owned());
    /// The map that a field of the outermost map holds.
    fn field<'a>(value: &'a mut Value, name: &str) -> &'a mut Vec<(Value, Value)> {
        let fields = value.as_map_mut().unwrap();
        let (_, inner) = fields.iter_mut().find(|(key, _)| key.as_text() == Some(name)).unwrap();
        inner.as_map_mut().unwrap()
    }
    let scenario_with = |change: &dyn Fn(&mut Value)| {
        with_metadata(&run, |metadata| {
            let mut scenario: Value = ciborium::from_reader(&metadata.scenario[..]).unwrap();
            change(&mut scenario);
            metadata.scenario.clear();
            ciborium::into_writer(&scenario, &mut metadata.scenario).unwrap();
            // The hash is of what its writer knew.
            metadata.scenario_hash ^= 1;
        })
    };
    let refused = |bytes: &[u8]| Reader::new(bytes).unwrap_err().to_string();
    let error = refused(&scenario_with(&|scenario| {
        field(scenario, "vehicle").push((text("mass_kg"), Value::Float(1500.0)));
    }));
    assert!(error.contains("has vehicle.mass_kg, which this program does not know"), "{error}");
    let error = refused(&scenario_with(&|scenario| {
        field(scenario, "vehicle").retain(|(name, _)| name.as_text() != Some("v_max_mps"));
    }));
    assert!(error.contains("missing field `v_max_mps`") && error.contains("written by"), "{error}");

    // Records of another layout, as a build would write them that has one.
    let bytes = with_metadata(&run, |metadata| {
        metadata.schema = metadata.schema.replacen("x_m", "s_m", 1);
    });
    let mut head = bytes[..48].to_vec();
    head[16..24].copy_from_slice(&7_u64.to_le_bytes());
    let length = u64::from_le_bytes(head[24..32].try_into().unwrap()) as usize;
    let digest = xxhash_rust::xxh3::xxh3_128(&[&head[..32], &bytes[48..48 + length]].concat());
    head[32..].copy_from_slice(&digest.to_le_bytes());
    let error = refused(&[&head[..], &bytes[48..]].concat());
    assert!(error.contains("the file has `") && error.contains(" s_m`"), "{error}");
    assert!(error.contains("this program has `") && error.contains(" x_m`"), "{error}");
}
