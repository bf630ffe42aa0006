#!/usr/bin/env bash
# Fuzzes: fuzz/run.sh [SECONDS [TARGET...]], 60 s of each target when nothing is said.
#
# Stable Rust does: the coverage counters libFuzzer steers by are an LLVM pass, which is asked for here as
# cargo-fuzz would. What a target finds is left in fuzz/artifacts; new inputs that reach new code go to
# fuzz/found/TARGET, the committed ones are read and not written. `MERGE=1 fuzz/run.sh 60 TARGET` then puts
# the smallest inputs that reach all of it into fuzz/corpus/TARGET.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")"

seconds=${1:-60}
shift || true
targets=("$@")
if ((${#targets[@]} == 0)); then
    targets=(czlog scenario trace frames attach)
fi

sancov=(
    -Cpasses=sancov-module
    -Cllvm-args=-sanitizer-coverage-level=4
    -Cllvm-args=-sanitizer-coverage-inline-8bit-counters
    -Cllvm-args=-sanitizer-coverage-pc-table
    -Cllvm-args=-sanitizer-coverage-trace-compares
)
# With a target triple the flags do not reach build scripts and procedural macros.
triple=$(rustc -vV | sed -n 's/^host: //p')
export CARGO_TARGET_DIR=${CARGO_TARGET_DIR:-../target/fuzz}
RUSTFLAGS="${sancov[*]} --cfg fuzzing -Cdebug-assertions -Coverflow-checks" \
    cargo build --locked --release --target "$triple" --bins

mkdir -p artifacts
for target in "${targets[@]}"; do
    printf '\n--- %s, %s s\n' "$target" "$seconds"
    mkdir -p "found/$target" "corpus/$target"
    log=artifacts/$target.log
    status=0
    "$CARGO_TARGET_DIR/$triple/release/$target" "found/$target" "corpus/$target" \
        -max_total_time="$seconds" -timeout=20 -rss_limit_mb=2048 -print_final_stats=1 -verbosity=0 \
        -artifact_prefix="artifacts/$target-" -max_len=20000 >"$log" 2>&1 || status=$?
    grep -E '^stat::|ERROR|panicked|SUMMARY|Test unit' "$log" || true
    if ((status != 0)); then
        printf '%s: found something, see fuzz/%s\n' "$target" "$log"
        exit 1
    fi
    if [[ -n ${MERGE:-} ]]; then
        mkdir -p "merged/$target"
        "$CARGO_TARGET_DIR/$triple/release/$target" -merge=1 "merged/$target" "corpus/$target" "found/$target" \
            -max_len=20000 -verbosity=0
    fi
done
