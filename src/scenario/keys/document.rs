//! `docs/scenario.md`, made from the declarations: `CZ_BLESS=1 cargo test --lib scenario_document` writes it.

use super::*;

/// What stands before each table.
const PARTS: [(&str, &str, Keys); 22] = [
    ("Top level", "", ROOT),
    ("`[end]`", "All optional.", END),
    ("`[vehicle]`", "All optional.", VEHICLE),
    (
        "`[[fleet]]`",
        "Optional. Without it all vehicles are of one kind. What a kind does not say is as in `[vehicle]`; its `v_max_mps` \
         is at most that.",
        FLEET,
    ),
    ("`[objective]`", "Exactly one of the two.", OBJECTIVE),
    ("`[control]`", "All optional.", CONTROL),
    ("`control.viable`", "All optional.", VIABLE),
    ("`[gate]`", "Optional.", GATE),
    ("`[coordination]`", "All optional.", COORDINATION),
    ("`[[roads]]`", "", ROADS),
    ("`roads.routes`", "", ROUTES),
    ("`roads.demand`: a trace", "", TRACE),
    ("`roads.demand`: random arrivals", "", RANDOM),
    ("`[[zones]]`", "", ZONES),
    ("`zones.approaches`", "", APPROACHES),
    ("`zones.segments`", "", SEGMENTS),
    ("`zones.paths`", "", PATHS),
    ("`zones.exits`", "", EXITS),
    ("`zones.crossings`", "", CROSSINGS),
    (
        "`flow` of a zone or exit",
        "`feedback` and `mean_speed` observe the zone downstream and need one.",
        crate::scenario::flow::KEYS,
    ),
    ("`[[controllers]]`", "", CONTROLLERS),
    (
        "`[faults]`",
        "All optional. A scope is `zones` and `paths` as in `[[controllers]]` (default: everywhere) and `fraction`, the \
         share of the vehicles (default 1). Each fault may have `from_s` and `until_s`.",
        FAULTS,
    ),
];

const HEAD: &str = "# Keys of a scenario

Made from the declarations in `src/scenario/keys.rs` by `CZ_BLESS=1 cargo test --lib scenario_document`.

A scenario is a TOML file. `--set KEY=VALUE` changes any key and may be repeated. Keys are dotted; an element of a list
is addressed by its `name` or its index from 0. The value is TOML, and what is not TOML is taken as a string:

    --set control.replan=from_state
    --set end.vehicles=400
    --set 'zones.merge-1.flow={policy=\"fixed\",terminal_mps=15}'
    --set 'roads.0.demand.trace=sumo-varying-{seed}'
";

/// All keys of scenarios, as Markdown.
pub fn document() -> String {
    let mut text = HEAD.to_owned();
    for (title, words, keys) in PARTS {
        text += &format!("\n## {title}\n");
        if !words.is_empty() {
            text += &format!("\n{words}\n");
        }
        text += "\n| key | takes | default | meaning |\n|---|---|---|---|\n";
        for key in keys {
            text += &format!(
                "| `{}` | {} | {} | {} |\n",
                key.name(),
                key.takes(),
                key.by_default(),
                key.meaning()
            );
        }
    }
    text
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn scenario_document_is_what_is_declared() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/docs/scenario.md");
        let document = document();
        if std::env::var_os("CZ_BLESS").is_some() {
            std::fs::write(path, &document).unwrap();
        }
        let written = std::fs::read_to_string(path).unwrap();
        assert!(
            written == document,
            "docs/scenario.md is stale: CZ_BLESS=1 cargo test --lib scenario_document"
        );
    }
}
