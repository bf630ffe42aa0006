//! What authors of controllers work with: what a controller is shown beside states.

use crate::common::TestRun;
use crate::python;
use std::path::Path;

/// Runs a law in Python for a minute as the controller of merge-2; what it and the run said.
fn driven(python: &str, law: &Path, arguments: &[&str]) -> crate::common::Ended {
    let test_run = TestRun::new("views");
    let controller = format!("merge-2={python} {}", law.display());
    let own = ["--controller", controller.as_str(), "--set", "end.time_s=60"];
    let ended = test_run.start("cz", &[&own[..], arguments].concat()).ended();
    test_run.assert_clean();
    ended
}

#[test]
fn a_controller_is_shown_partners_flags_and_what_became_of_its_last_commands() {
    let Some(python) = python() else { return };
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("law.py");
    let law = r#"
import control_zones
from control_zones import schemas

seen = dict(partners=0, intents=0, entered=0, bounded=0, frames=0)

class Law:
    def __call__(self, views):
        out = []
        for zone in views:
            assert not zone.missed and zone.skipped == 0
            assert zone.own.sum() == len(zone) and (zone.states["vehicle"][zone.own] == zone.vehicle).all()
            assert len(zone.frame) >= len(zone.states)
            seen["frames"] += len(set(zone.frame["zone"])) > 1
            seen["entered"] += int(zone.entered.sum())
            for partners in zone.partners:
                for p in partners:
                    record = zone.states[p.place]
                    assert record["vehicle"] == p.vehicle and record["planned_exit_time_s"] == p.exit_time
                    seen["partners"] += 1
                    seen["intents"] += p.exit_time > 0
            known = zone.commanded == zone.commanded
            new = zone.entered & known
            assert not new.any(), "nobody is commanded before it comes"
            seen["bounded"] += int((abs(zone.u - zone.commanded)[known] > 1e-9).sum())
            out.append((30.0 - zone.v).clip(-4, 4))
        return out

    def on_end(self, summary):
        print(summary, flush=True)
        print(" ".join(f"{name}={count}" for name, count in seen.items()), flush=True)

control_zones.run(Law(), joint=True)
"#;
    std::fs::write(&path, law).unwrap();
    let ended = driven(&python, &path, &["--shield", "on"]);
    ended.expect(0, &["merge-2] Summary(step=600, time=60.0", "answered=600, skipped=0, missed=0)"]);
    let counts =
        ended.err.lines().find(|line| line.contains("partners=")).unwrap_or_else(|| panic!("{ended:?}"));
    // Whoever goes for 30 m/s is bounded now and then.
    for name in ["partners", "entered", "bounded", "frames"] {
        assert!(!counts.contains(&format!("{name}=0")), "{counts}");
    }
    let wrong = "import control_zones\ncontrol_zones.run(lambda views: [1, 2, 3], joint=True)\n";
    std::fs::write(&path, wrong).unwrap();
    let ended = driven(&python, &path, &[]);
    ended.expect(1, &["returned 3 lists; expected "]);
}
