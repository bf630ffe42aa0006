//! The schemas as other languages and other versions see them: pinned layouts, and generated files that
//! are up to date, compile, and agree with Rust.

use std::io::Write as _;
use std::path::Path;
use std::process::{Command, Stdio};

use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;
use ipc_schemas::{
    Assignment, AttachReply, AttachRequest, CODES, CodeValue, Feedback, FrameHeader, KindSpec, LAYOUTS,
    Member, PathSpec, Role, RunSpec, VehicleCommand, VehicleState, ZoneSummary, generate, schema_hash,
    schema_text,
};

/// Type name, size, and the fields with their scalar types and offsets.
type Golden = (&'static str, usize, &'static [(&'static str, &'static str, usize)]);

/// The layouts of version 1, written out by hand. A change here breaks every program that was built
/// with the old frames: give the record a new version in its type name instead.
const GOLDEN: [Golden; 12] = [
    (
        "cz.FrameHeader.v1",
        64,
        &[
            ("run_id", "u64", 0),
            ("schema_hash", "u64", 8),
            ("step", "u64", 16),
            ("time_ns", "u64", 24),
            ("coordinators_acting", "u64", 32),
            ("coordinators_summarised", "u64", 40),
            ("sender_role", "u16", 48),
            ("sender_index", "u16", 50),
            ("generation", "u32", 52),
            ("record_count", "u32", 56),
            ("flags", "u32", 60),
        ],
    ),
    (
        "cz.VehicleState.v2",
        96,
        &[
            ("x_m", "f64", 0),
            ("v_mps", "f64", 8),
            ("u_mps2", "f64", 16),
            ("entry_time_s", "f64", 24),
            ("entry_speed_mps", "f64", 32),
            ("planned_exit_time_s", "f64", 40),
            ("planned_exit_speed_mps", "f64", 48),
            ("length_m", "f64", 56),
            ("vehicle", "u32", 64),
            ("zone", "u32", 68),
            ("path", "u32", 72),
            ("next_zone", "u32", 76),
            ("next_path", "u32", 80),
            ("then_path", "u32", 84),
            ("link", "u32", 88),
            ("kind", "u16", 92),
            ("flags", "u16", 94),
        ],
    ),
    (
        "cz.Assignment.v3",
        80,
        &[
            ("own_conflict_m", "f64", 0),
            ("partner_conflict_m", "f64", 8),
            ("gap_m", "f64", 16),
            ("until_m", "f64", 24),
            ("terminal_speed_mps", "f64", 32),
            ("scheduled_at_m", "f64", 40),
            ("scheduled_time_s", "f64", 48),
            ("vehicle", "u32", 56),
            ("partner", "u32", 60),
            ("zone", "u32", 64),
            ("point", "u32", 68),
            ("rank", "u32", 72),
            ("kind", "u16", 76),
            ("flags", "u16", 78),
        ],
    ),
    (
        "cz.ZoneSummary.v2",
        80,
        &[
            ("segment_m", "f64", 0),
            ("segment_mean_speed_mps", "f64", 8),
            ("x_m", "f64", 16),
            ("v_mps", "f64", 24),
            ("planned_exit_time_s", "f64", 32),
            ("planned_exit_speed_mps", "f64", 40),
            ("from_zone", "u32", 48),
            ("to_zone", "u32", 52),
            ("vehicles", "u32", 56),
            ("segment_vehicles", "u32", 60),
            ("vehicle", "u32", 64),
            ("path", "u32", 68),
            ("next_path", "u32", 72),
            ("kind", "u16", 76),
            ("flags", "u16", 78),
        ],
    ),
    (
        "cz.VehicleCommand.v2",
        104,
        &[
            ("u_mps2", "f64", 0),
            ("planned_exit_time_s", "f64", 8),
            ("planned_exit_speed_mps", "f64", 16),
            ("memory_0", "f64", 24),
            ("memory_1", "f64", 32),
            ("memory_2", "f64", 40),
            ("memory_3", "f64", 48),
            ("memory_4", "f64", 56),
            ("memory_5", "f64", 64),
            ("memory_6", "f64", 72),
            ("memory_7", "f64", 80),
            ("vehicle", "u32", 88),
            ("zone", "u32", 92),
            ("binding_rows", "u32", 96),
            ("mode", "u16", 100),
            ("verdict", "u16", 102),
        ],
    ),
    (
        "cz.Feedback.v1",
        56,
        &[
            ("value", "f64", 0),
            ("least", "f64", 8),
            ("greatest", "f64", 16),
            ("step", "u64", 24),
            ("vehicle", "u32", 32),
            ("zone", "u32", 36),
            ("toward", "u32", 40),
            ("record", "u32", 44),
            ("controller", "u16", 48),
            ("row", "u16", 50),
            ("rule", "u16", 52),
            ("field", "u16", 54),
        ],
    ),
    (
        "cz.Member.v1",
        12,
        &[("process_id", "u32", 0), ("generation", "u32", 4), ("role", "u16", 8), ("index", "u16", 10)],
    ),
    (
        "cz.AttachRequest.v1",
        48,
        &[
            ("instance", "u64", 0),
            ("schema_hash", "u64", 8),
            ("scenario_hash", "u64", 16),
            ("controller", "u64", 24),
            ("process_id", "u32", 32),
            ("role", "u16", 36),
            ("wanted_index", "u16", 38),
            ("phase", "u32", 40),
            ("index", "u32", 44),
        ],
    ),
    (
        "cz.AttachReply.v1",
        72,
        &[
            ("instance", "u64", 0),
            ("run_id", "u64", 8),
            ("schema_hash", "u64", 16),
            ("scenario_hash", "u64", 24),
            ("first_step", "u64", 32),
            ("status", "u32", 40),
            ("world_process_id", "u32", 44),
            ("generation", "u32", 48),
            ("index", "u32", 52),
            ("coordinators", "u32", 56),
            ("controllers", "u32", 60),
            ("waiting", "u32", 64),
            ("reserved", "u32", 68),
        ],
    ),
    (
        "cz.RunSpec.v2",
        168,
        &[
            ("dt_s", "f64", 0),
            ("max_time_s", "f64", 8),
            ("beta", "f64", 16),
            ("u_min_mps2", "f64", 24),
            ("u_max_mps2", "f64", 32),
            ("v_min_mps", "f64", 40),
            ("v_max_mps", "f64", 48),
            ("reaction_time_s", "f64", 56),
            ("standstill_gap_m", "f64", 64),
            ("vehicle_length_m", "f64", 72),
            ("k_rear_end_per_s", "f64", 80),
            ("k_merge_per_s", "f64", 88),
            ("k_speed_per_s", "f64", 96),
            ("clf_rate_per_s", "f64", 104),
            ("slack_weight", "f64", 112),
            ("fe_fraction", "f64", 120),
            ("dt_ns", "u64", 128),
            ("seed", "u64", 136),
            ("zones", "u32", 144),
            ("paths", "u32", 148),
            ("kinds", "u32", 152),
            ("reserved", "u32", 156),
            ("law_flags", "u32", 160),
            ("shield", "u32", 164),
        ],
    ),
    (
        "cz.PathSpec.v2",
        40,
        &[
            ("length_m", "f64", 0),
            ("link_m", "f64", 8),
            ("zone", "u32", 16),
            ("path", "u32", 20),
            ("exit", "u32", 24),
            ("next_zone", "u32", 28),
            ("controller", "u32", 32),
            ("flags", "u32", 36),
        ],
    ),
    (
        "cz.KindSpec.v1",
        56,
        &[
            ("u_min_mps2", "f64", 0),
            ("u_max_mps2", "f64", 8),
            ("v_min_mps", "f64", 16),
            ("v_max_mps", "f64", 24),
            ("length_m", "f64", 32),
            ("reaction_time_s", "f64", 40),
            ("standstill_gap_m", "f64", 48),
        ],
    ),
];

/// XXH3-64 of the schema text of [`GOLDEN`].
const GOLDEN_HASH: u64 = 0x817d_84fa_9a9e_d0eb;

fn crate_dir() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// A command for `program`, or `None` (and a word about it) when there is no such program here. On CI
/// every program must be there, so that no check is lost unnoticed.
fn tool(program: &str) -> Option<Command> {
    let present = Command::new(program)
        .arg("--version")
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .status()
        .is_ok_and(|status| status.success());
    if present {
        return Some(Command::new(program));
    }
    assert!(std::env::var_os("CI").is_none(), "CI needs `{program}` for this test");
    println!("skipped: no `{program}` on this machine");
    None
}

/// Feeds `input` to the command; its output must be empty on stderr and the exit clean.
fn run(mut command: Command, input: &str) -> String {
    let mut child = command
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("the tool was present a moment ago");
    child
        .stdin
        .take()
        .expect("stdin is piped")
        .write_all(input.as_bytes())
        .expect("the tool reads its input");
    let output = child.wait_with_output().expect("the tool ends");
    let complaints = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && complaints.is_empty(), "{command:?}:\n{complaints}");
    String::from_utf8(output.stdout).expect("the tool prints UTF-8")
}

#[test]
fn checked_in_files_are_up_to_date() {
    for file in generate::files() {
        let found = std::fs::read_to_string(crate_dir().join(file.path)).unwrap_or_default();
        // Not assert_eq: two whole files would bury the message.
        assert!(
            found == file.contents,
            "ipc_schemas/{} is stale: run `cargo run -p ipc_schemas` and commit the result",
            file.path
        );
    }
}

#[test]
fn layouts_are_the_pinned_ones() {
    assert_eq!(LAYOUTS.len(), GOLDEN.len());
    for (layout, (type_name, size, fields)) in LAYOUTS.iter().zip(GOLDEN) {
        assert_eq!(layout.type_name, type_name);
        let widest = if fields.iter().any(|(_, scalar, _)| scalar.ends_with("64")) { 8 } else { 4 };
        assert_eq!((layout.size, layout.align), (size, widest), "{type_name}");
        let found: Vec<_> = layout.fields.iter().map(|f| (f.name, f.scalar.name(), f.offset)).collect();
        assert_eq!(found, fields, "{type_name}");
    }
}

#[test]
fn schema_text_and_hash_are_the_pinned_ones() {
    let mut expected = String::new();
    for (type_name, size, fields) in GOLDEN {
        expected.push_str(&format!("{type_name} {size}\n"));
        for (name, scalar, offset) in fields {
            expected.push_str(&format!("  {offset} {scalar} {name}\n"));
        }
    }
    assert_eq!(schema_text(), expected);
    assert_eq!(schema_hash(), GOLDEN_HASH, "found {:#018x}", schema_hash());
}

#[test]
fn the_transport_registers_the_same_type_names() {
    // SAFETY: `type_name` has no precondition for a caller; it is unsafe for what an implementation
    // promises, and these are derived.
    let registered = unsafe {
        [
            FrameHeader::type_name(),
            VehicleState::type_name(),
            Assignment::type_name(),
            ZoneSummary::type_name(),
            VehicleCommand::type_name(),
            Feedback::type_name(),
            Member::type_name(),
            AttachRequest::type_name(),
            AttachReply::type_name(),
            RunSpec::type_name(),
            PathSpec::type_name(),
            KindSpec::type_name(),
        ]
    };
    assert_eq!(registered, LAYOUTS.map(|layout| layout.type_name));
}

#[test]
fn roles_and_their_codes_agree() {
    for role in [Role::World, Role::Coordinator, Role::Controller] {
        assert_eq!(Role::from_code(role as u16), Some(role));
        let name = format!("ROLE_{}", role.to_string().to_uppercase());
        let code =
            CODES.iter().copied().flatten().find(|code| code.name == name).expect("every role has a code");
        assert_eq!(code.value, CodeValue::U16(role as u16));
    }
    assert_eq!(Role::from_code(0), None);
    assert_eq!(Role::from_code(4), None);
}

#[test]
fn code_names_are_unique_and_documented() {
    let mut names: Vec<_> = CODES.iter().copied().flatten().map(|code| code.name).collect();
    assert!(CODES.iter().copied().flatten().all(|code| !code.docs.is_empty()));
    let count = names.len();
    names.sort_unstable();
    names.dedup();
    assert_eq!(names.len(), count);
}

/// Compiles a source that includes the header twice, as programs do.
fn compile(program: &str, language: &str, standard: &str) {
    let Some(mut command) = tool(program) else { return };
    command.args(["-x", language, standard, "-Wall", "-Wextra", "-Werror", "-pedantic", "-fsyntax-only"]);
    command.arg("-I").arg(crate_dir().join("include")).arg("-");
    let source = "#include \"cz_schemas.h\"\n\
                  #include \"cz_schemas.h\"\n\
                  cz_vehicle_command_t command;\n\
                  uint64_t hash = CZ_SCHEMA_HASH;\n\
                  uint32_t zone = CZ_NO_ZONE;\n\
                  uint16_t mode = CZ_MODE_OCBF;\n\
                  char service[] = CZ_SERVICE_COMMAND;\n\
                  char type[] = CZ_TYPE_NAME_VEHICLE_COMMAND;\n";
    run(command, source);
}

#[test]
fn header_is_c99() {
    compile("cc", "c", "-std=c99");
}

#[test]
fn header_is_c11() {
    // Not the same text to the compiler as C99: C11 has static assertions of its own.
    compile("cc", "c", "-std=c11");
}

#[test]
fn header_is_cpp17() {
    compile("c++", "c++", "-std=c++17");
}

#[test]
fn python_module_agrees_with_rust() {
    let Some(mut command) = tool("python3") else { return };
    command.arg("-").env("PYTHONPATH", crate_dir().join("python")).env("PYTHONDONTWRITEBYTECODE", "1");
    let script = "import ctypes, json, cz_schemas as cz\n\
                  records = [\n\
                  \x20   [r.__name__, r.type_name(), ctypes.sizeof(r), ctypes.alignment(r),\n\
                  \x20    [[n, getattr(r, n).offset, getattr(r, n).size] for n, _ in r._fields_]]\n\
                  \x20   for r in cz.RECORDS\n\
                  ]\n\
                  assert cz.TYPE_NAMES == {r[0]: r[1] for r in records}\n\
                  codes = {n: v for n, v in vars(cz).items() if n[0].isupper() and type(v) in (int, str)}\n\
                  del codes['SCHEMA_HASH']\n\
                  print(json.dumps([cz.SCHEMA_HASH, records, codes], separators=(',', ':')))\n";
    let found = run(command, script);

    let join = |items: Vec<String>| items.join(",");
    let records = join(
        LAYOUTS
            .iter()
            .map(|layout| {
                let fields = layout.fields.iter();
                let fields = join(
                    fields.map(|f| format!("[{:?},{},{}]", f.name, f.offset, f.scalar.size())).collect(),
                );
                format!(
                    "[{:?},{:?},{},{},[{fields}]]",
                    layout.name, layout.type_name, layout.size, layout.align
                )
            })
            .collect(),
    );
    let codes = join(
        CODES
            .iter()
            .copied()
            .flatten()
            .map(|code| match code.value {
                CodeValue::U16(value) => format!("{:?}:{value}", code.name),
                CodeValue::U32(value) => format!("{:?}:{value}", code.name),
                CodeValue::U64(value) => format!("{:?}:{value}", code.name),
                CodeValue::Text(text) => format!("{:?}:{text:?}", code.name),
            })
            .collect(),
    );
    assert_eq!(found.trim_end(), format!("[{},[{records}],{{{codes}}}]", schema_hash()));
}

#[test]
fn python_records_are_bounded_by_the_frame() {
    let Some(mut command) = tool("python3") else { return };
    command.arg("-").env("PYTHONPATH", crate_dir().join("python")).env("PYTHONDONTWRITEBYTECODE", "1");
    let script = r"
import ctypes, gc, types, weakref, cz_schemas as cz

class Sample:
    def __init__(self, count):
        self.memory = (cz.ZoneSummary * 4)()
        self.payload_ptr = ctypes.addressof(self.memory)
        self.header = types.SimpleNamespace(number_of_elements=count)

sample = Sample(3)
array = cz.records(sample, cz.ZoneSummary)
array[2].vehicles = 5
assert len(array) == 3 and sample.memory[2].vehicles == 5
try:
    array[3]
    raise SystemExit('read past the frame')
except IndexError:
    pass
assert list(cz.records(Sample(0), cz.ZoneSummary)) == []

alive = weakref.ref(sample)
last = array[2]
del sample, array
gc.collect()
assert alive() is not None and last.vehicles == 5
del last
gc.collect()
assert alive() is None
";
    run(command, script);
}

#[test]
fn check_accepts_the_checked_in_files_and_rejects_unknown_arguments() {
    let generator = env!("CARGO_BIN_EXE_ipc_schemas");
    let status = |argument| Command::new(generator).arg(argument).stderr(Stdio::null()).status();
    assert_eq!(status("--check").expect("the generator runs").code(), Some(0));
    assert_eq!(status("--chekc").expect("the generator runs").code(), Some(2));
}
